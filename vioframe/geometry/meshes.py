"""Triangle meshes by Open3D, an optional extra: reading them, casting rays at them and measuring distances to them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vioframe.arrays import Float
from vioframe.errors import ConfigError


def import_open3d(purpose: str) -> Any:
    """The module; without it a :class:`ConfigError` says what needs it, "``purpose`` needs", and how to get it."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        reason = "" if isinstance(error, ModuleNotFoundError) and error.name == "open3d" else f" ({error})"
        raise ConfigError(
            f"{purpose} needs Open3D, which is not installed{reason}: pip install 'vioframe[open3d]'"
        ) from error
    return open3d


def read_mesh(path: Path) -> Float:
    """The triangles (T, 3, 3) m of a mesh file: PLY, OBJ, STL or OFF. Raises :class:`ConfigError`."""
    if not path.is_file():
        raise ConfigError(f"there is no mesh {path}; name the world's file, such as flight.bag.simulation/world.ply")
    o3d = import_open3d(f"the mesh {path.name}")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
    corners: Float = np.asarray(mesh.vertices)[np.asarray(mesh.triangles)]
    if not len(corners) or not np.isfinite(corners).all():
        raise ConfigError(f"{path} holds no triangles that can be read; give a mesh in PLY, OBJ, STL or OFF, in metres")
    return corners


def ray_scene(corners: Float, threads: int = 0) -> Any:
    """Open3D's ``RaycastingScene`` of triangles (T, 3, 3) m, built by ``threads``; 0 leaves their number to Open3D."""
    o3d = import_open3d("ray casting")
    scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
    vertices = np.ascontiguousarray(corners.reshape(-1, 3), dtype=np.float32)
    indices = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(indices))
    return scene


def distances(points: Float, corners: Float) -> Float:
    """(N,) m from each of ``points`` (N, 3) to the nearest point of triangles (T, 3, 3), unsigned.

    Computed in single precision about the mesh's middle: good to some micrometres in a hall.
    """
    o3d = import_open3d("the distance to a mesh")
    middle = 0.5 * (corners.min(axis=(0, 1)) + corners.max(axis=(0, 1)))
    query = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points - middle, dtype=np.float32))
    return np.asarray(ray_scene(corners - middle).compute_distance(query).numpy(), dtype=np.float64)
