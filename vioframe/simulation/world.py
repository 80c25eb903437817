"""A world to look at: triangles with texture coordinates, the images on them, and boxes that fly around in it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.arrays import Float, Image, Int
from vioframe.errors import ConfigError
from vioframe.geometry.meshes import import_open3d, ray_scene
from vioframe.interfaces import World
from vioframe.types import Mesh

# Of movers: their size, how far they swing and how often, and how clear of the cameras they stay.
_SIZE_M = (0.3, 1.1)
_SWING_M = (0.4, 1.6)
_AROUND_M = np.array([2.2, 2.2, 1.2])  # with the swing still within the walls of a hall
_PERIOD_S = (3.0, 9.0)
_CLEARANCE_M = 1.2
_TRIES = 400


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


@dataclass(frozen=True)
class Movers:
    """M boxes swinging about ``centre_W`` (M, 3) m by ``swing_m`` (M, 3), in ``period_s`` (M, 3) from ``phase`` rad.

    ``mesh`` holds each about its own origin and ``owner`` (T,) the box that a triangle belongs to.
    """

    mesh: Mesh
    owner: Int
    centre_W: Float
    swing_m: Float
    period_s: Float
    phase: Float

    def at(self, t_s: Float) -> Float:
        """Where they are at times (N,) s: (N, M, 3) m."""
        angle = 2.0 * np.pi * np.asarray(t_s)[:, None, None] / self.period_s + self.phase
        return np.asarray(self.centre_W + self.swing_m * np.sin(angle))

    def corners(self, p_W: Float) -> Float:
        """(T, 3, 3) m with the boxes at ``p_W`` (M, 3)."""
        return np.asarray(self.mesh.corners + p_W[self.owner][:, None, :])


def draw_movers(count: int, t_s: Float, p_WC: Float, textures: int, rng: np.random.Generator) -> Movers | None:
    """``count`` boxes around the paths ``p_WC`` (C, N, 3) m, flown at ``t_s`` (N,), that never come near them.

    Fewer, or None, where the paths leave no room for them.
    """
    low, high = p_WC.min(axis=(0, 1)) - _AROUND_M, p_WC.max(axis=(0, 1)) + _AROUND_M
    builder = MeshBuilder()
    swings: list[tuple[Float, Float, Float, Float]] = []
    for _ in range(_TRIES):
        if len(swings) == count:
            break
        size = rng.uniform(*_SIZE_M, 3)
        centre = rng.uniform(low, high)
        amplitude = rng.uniform(*_SWING_M, 3) * [1.0, 1.0, 0.3]
        period = rng.uniform(*_PERIOD_S, 3)
        phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        path = centre + amplitude * np.sin(2.0 * np.pi * t_s[:, None] / period + phase)
        if np.linalg.norm(path - p_WC, axis=2).min() >= _CLEARANCE_M + 0.5 * float(np.linalg.norm(size)):
            builder.box(-0.5 * size, 0.5 * size, rng.integers(textures, size=6), float(size.max()), rng.random(2))
            swings.append((centre, amplitude, period, phase))
    if not swings:
        return None
    owner = np.repeat(np.arange(len(swings)), 12)  # two triangles a face
    return Movers(builder.build(), owner, *(np.array(part) for part in zip(*swings, strict=True)))


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
    """The triangles as a PLY file, m in W."""
    o3d = import_open3d("writing a world")
    corners = o3d.utility.Vector3dVector(mesh.corners.reshape(-1, 3))
    triangles = o3d.utility.Vector3iVector(np.arange(3 * len(mesh.corners), dtype=np.int32).reshape(-1, 3))
    written = o3d.geometry.TriangleMesh(corners, triangles).remove_duplicated_vertices()
    o3d.io.write_triangle_mesh(str(path), written)
