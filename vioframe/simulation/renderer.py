"""A camera in a world: rays through every pixel, distortion included, to light."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry.cameras import Camera
from vioframe.geometry.meshes import import_open3d, ray_scene
from vioframe.interfaces import World
from vioframe.simulation.movers import Movers
from vioframe.simulation.shading import MISS, Float32, mip_pyramid, shade
from vioframe.types import Float, Int, Mesh

# A pixel where surfaces meet is the mean over eight places in it, no two of which share a row or a column.
_SAMPLES_PX = (np.array([[k, 3 * k % 8] for k in range(8)]) + 0.5) / 8.0 - 0.5
# Unless the two are as good as equally bright there: 1 is white.
_LEAST_STEP = 3.0 / 255.0
# Rays cast at a time: few enough for what they hit to stay in the processor's cache, which halves the time.
_BLOCK = 8192


class Renderer:
    """Renders ``world``, and the ``movers`` in it, through ``camera``.

    ``contrast`` scales what the textures have around their means; ``fog_per_m`` is the extinction of the air.
    """

    def __init__(
        self,
        camera: Camera,
        world: World,
        movers: Movers | None = None,
        *,
        contrast: float = 1.0,
        fog_per_m: float = 0.0,
    ) -> None:
        self._contrast, self._fog_per_m, self._movers = contrast, fog_per_m, movers
        width, height = camera.resolution
        self._shape = (height, width)
        self._focal_px = camera.focal_px
        pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
        self._rays_C = [_rays(camera, pixels + offset) for offset in (np.zeros(2), *_SAMPLES_PX)]
        self._row = np.repeat(np.arange(height), width)
        self._scene = ray_scene(world.mesh.corners, threads=1)
        self._static = len(world.mesh.corners)
        meshes = [world.mesh] if movers is None else [world.mesh, movers.mesh]
        self._uv = np.concatenate([mesh.uv for mesh in meshes]).astype(np.float32)
        self._normals = np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32)
        self._density = np.concatenate([_density(mesh) for mesh in meshes]).astype(np.float32)
        self._texture = np.concatenate([mesh.texture for mesh in meshes])
        # Faces of movers are numbered after those of the world; the last entry is where there is nothing.
        beyond = world.mesh.surface.max() + 1
        surfaces = [mesh.surface + i * beyond for i, mesh in enumerate(meshes)]
        self._surface = np.concatenate([*surfaces, [-1]]).astype(np.int32)
        self._texels, self._offsets, self._size = mip_pyramid(world.textures)

    def render(self, R_WC: Float, p_WC: Float, p_WM: Float | None = None) -> Float32:
        """Light (height, width), 1 for white in full light, seen from the pose (3, 3), (3,) m.

        For a rolling shutter the pose is one a row: (height, 3, 3) and (height, 3). ``p_WM`` (M, 3) m is where the
        movers are.
        """
        movers = None if self._movers is None or p_WM is None else ray_scene(self._movers.corners(p_WM), threads=1)
        everywhere = np.arange(len(self._row))
        light, surface = self._trace(0, everywhere, R_WC, p_WC, movers)
        edges = np.flatnonzero(_edges(surface.reshape(self._shape), light.reshape(self._shape)))
        if len(edges):
            samples = [self._trace(s, edges, R_WC, p_WC, movers)[0] for s in range(1, len(self._rays_C))]
            light[edges] = np.mean(samples, axis=0)
        return light.reshape(self._shape)

    def _trace(
        self, sample: int, pixels: Int, R_WC: Float, p_WC: Float, movers: Any
    ) -> tuple[Float32, NDArray[np.int32]]:
        """Light and surface (N,) at ``pixels`` (N,), for one of the places of a ray within its pixel."""
        begins = range(0, len(pixels), _BLOCK)
        blocks = [self._trace_block(sample, pixels[b : b + _BLOCK], R_WC, p_WC, movers) for b in begins]
        light, surface = zip(*blocks, strict=True)
        return np.concatenate(light), np.concatenate(surface)

    def _trace_block(
        self, sample: int, pixels: Int, R_WC: Float, p_WC: Float, movers: Any
    ) -> tuple[Float32, NDArray[np.int32]]:
        rays_C = self._rays_C[sample][pixels]
        rays = np.empty((len(pixels), 6), np.float32)
        if R_WC.ndim == 2:
            rays[:, :3] = p_WC
            rays[:, 3:] = rays_C @ R_WC.T.astype(np.float32)
        else:
            row = self._row[pixels]
            rays[:, :3] = p_WC[row]
            rays[:, 3:] = np.einsum("nij,nj->ni", R_WC.astype(np.float32)[row], rays_C)
        triangle, barycentric, depth = _cast(self._scene, rays)
        if movers is not None:
            other, other_barycentric, other_depth = _cast(movers, rays)
            nearer = other_depth < depth
            triangle[nearer] = other[nearer] + np.uint32(self._static)
            barycentric[nearer], depth[nearer] = other_barycentric[nearer], other_depth[nearer]
        light = np.empty(len(pixels), np.float32)
        shade(
            triangle,
            barycentric,
            depth,
            rays[:, 3:],
            self._focal_px,
            self._uv,
            self._normals,
            self._density,
            self._texture,
            self._texels,
            self._offsets,
            self._size,
            self._contrast,
            self._fog_per_m,
            light,
        )
        return light, self._surface[np.where(triangle == MISS, len(self._surface) - 1, triangle)]


def _rays(camera: Camera, pixels: Float) -> Float32:
    xy = camera.undistort(pixels)
    return np.column_stack([xy, np.ones(len(xy))]).astype(np.float32)


def _density(mesh: Mesh) -> Float:
    """(T,) widths of texture a metre: the root of the ratio of the areas."""
    u, v = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    a, b = mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0]
    area = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / np.maximum(area, 1e-12)))


def _edges(surface: NDArray[np.int32], light: Float32) -> NDArray[np.bool_]:
    """Where a pixel and its right or lower neighbour lie on different surfaces and differ in light, both of them."""
    edges = np.zeros(surface.shape, np.bool_)
    across = (surface[:, 1:] != surface[:, :-1]) & (np.abs(np.diff(light, axis=1)) > _LEAST_STEP)
    down = (surface[1:] != surface[:-1]) & (np.abs(np.diff(light, axis=0)) > _LEAST_STEP)
    edges[:, 1:] |= across
    edges[:, :-1] |= across
    edges[1:] |= down
    edges[:-1] |= down
    return edges


def _cast(scene: Any, rays: Float32) -> tuple[NDArray[np.uint32], Float32, Float32]:
    """Triangle (N,), weights (N, 2) of its second and third corner, and distance in ray lengths (N,)."""
    hits = scene.cast_rays(import_open3d("rendering").core.Tensor.from_numpy(rays), nthreads=1)
    return hits["primitive_ids"].numpy(), hits["primitive_uvs"].numpy(), hits["t_hit"].numpy()
