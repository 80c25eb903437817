"""A world to look at: triangles with texture coordinates, and the images on them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.errors import ConfigError
from vioframe.geometry.meshes import import_open3d, ray_scene
from vioframe.interfaces import World
from vioframe.types import Float, Image, Int, Mesh


@dataclass(frozen=True)
class MeshWorld:
    """What a camera sees: a mesh and its ``textures``, square uint8 images of one size, a power of two.

    Raises :class:`ConfigError` where they are not, or where the mesh names a texture that is not there.
    """

    mesh: Mesh
    textures: tuple[Image, ...]

    def __post_init__(self) -> None:
        mesh, count = self.mesh, len(self.mesh.corners)
        shapes = [mesh.corners.shape, mesh.uv.shape, mesh.texture.shape, mesh.surface.shape]
        if not count or shapes != [(count, 3, 3), (count, 3, 2), (count,), (count,)]:
            raise ConfigError(f"a world's mesh needs arrays (T, 3, 3), (T, 3, 2), (T,), (T,) for T > 0, got {shapes}")
        if not (np.isfinite(mesh.corners).all() and np.isfinite(mesh.uv).all()):
            raise ConfigError("a world's mesh has corners or texture coordinates that are not finite")
        sizes = {texture.shape for texture in self.textures}
        size = next(iter(sizes), (0,))[0]
        if sizes != {(size, size)} or size & (size - 1) or any(t.dtype != np.uint8 for t in self.textures):
            raise ConfigError(
                f"a world's textures must be square uint8 images of one size, a power of two, got {sizes}"
            )
        if mesh.texture.min() < 0 or mesh.texture.max() >= len(self.textures):
            raise ConfigError(f"a world's mesh asks for texture {mesh.texture.max()} of {len(self.textures)}")


class MeshBuilder:
    """Collects faces; ``tile_m`` is the width of a texture on the surface."""

    def __init__(self) -> None:
        self._faces: list[tuple[Float, Float, int, int]] = []
        self._surfaces = 0

    def quad(self, corner: Float, u: Float, v: Float, texture: int, tile_m: float, at: Float) -> None:
        """A rectangle from ``corner`` along the edges ``u`` and ``v`` (3,) m; ``at`` (2,) is its texture's origin."""
        size = np.array([np.linalg.norm(u), np.linalg.norm(v)]) / tile_m
        uv = at + np.array([[0.0, 0.0], [size[0], 0.0], size, [0.0, size[1]]])
        corners = np.array([corner, corner + u, corner + u + v, corner + v])
        for pick in ([0, 1, 2], [0, 2, 3]):
            self._faces.append((corners[pick], uv[pick], texture, self._surfaces))
        self._surfaces += 1

    def box(self, low: Float, high: Float, textures: Int, tile_m: float, at: Float) -> None:
        """An upright box; ``textures`` (6,)."""
        x, y, z = np.diag(high - low)
        faces = ((low, x, z), (low + y, x, z), (low, y, z), (low + x, y, z), (low, x, y), (low + z, x, y))
        for (corner, u, v), texture in zip(faces, textures.tolist(), strict=True):
            self.quad(corner, u, v, texture, tile_m, at)

    def tube(self, start: Float, end: Float, radius_m: float, texture: int, tile_m: float, at: Float) -> None:
        """A cylinder without lids."""
        facets = 20
        axis = end - start
        side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 * np.linalg.norm(axis) else [1.0, 0.0, 0.0])
        side *= radius_m / np.linalg.norm(side)
        other = np.cross(axis, side)
        other *= radius_m / np.linalg.norm(other)
        angles = np.arange(facets + 1) * (2.0 * np.pi / facets)
        ring = start + np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * other
        width = float(np.linalg.norm(ring[1] - ring[0])) / tile_m
        for i in range(facets):
            self.quad(ring[i], ring[i + 1] - ring[i], axis, texture, tile_m, at + np.array([i * width, 0.0]))

    def build(self) -> Mesh:
        corners, uv, texture, surface = zip(*self._faces, strict=True)
        return Mesh(np.array(corners), np.array(uv), np.array(texture, np.int32), np.array(surface, np.int32))


def check_clear(world: World, t_s: Float, p_W: Float) -> None:
    """Raise :class:`ConfigError` where the path ``p_W`` (N, 3) m at times ``t_s`` (N,) goes through a surface."""
    o3d = import_open3d("checking a flight against its world")
    steps = np.diff(p_W, axis=0)
    rays = np.concatenate([p_W[:-1], steps], axis=1).astype(np.float32)
    hit = ray_scene(world.mesh.corners).cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)["t_hit"].numpy()
    through = np.flatnonzero((hit <= 1.0) & (np.linalg.norm(steps, axis=1) > 0.0))
    if through.size:
        x, y, z = p_W[through[0]]
        raise ConfigError(
            f"the flight goes through a wall of the world {t_s[through[0]]:.2f} s after its start, at "
            f"({x:.2f}, {y:.2f}, {z:.2f}) m; choose another flight or world, or a shorter duration"
        )


def write_mesh(mesh: Mesh, path: Path) -> None:
    """The triangles as a binary PLY file, m in W."""
    vertices, which = np.unique(mesh.corners.reshape(-1, 3).astype("<f4"), axis=0, return_inverse=True)
    faces = np.empty(len(mesh.corners), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, which.reshape(-1, 3)
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())
