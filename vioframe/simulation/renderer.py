"""A camera in a world: rays through every pixel, distortion included, to light.

Open3D tells what a ray hits; a compiled loop, what light it brings back.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Float, Image, Int
from vioframe.geometry.cameras import Camera
from vioframe.geometry.meshes import import_open3d, ray_scene
from vioframe.interfaces import World
from vioframe.jit import kernel
from vioframe.simulation.world import Movers
from vioframe.types import Int32, Mesh

Float32 = NDArray[np.float32]

# A pixel where surfaces meet is the mean over eight places in it, no two of which share a row or a column.
_SAMPLES_PX = (np.array([[k, 3 * k % 8] for k in range(8)]) + 0.5) / 8.0 - 0.5
# Unless the two are as good as equally bright there: 1 is white.
_LEAST_STEP = 3.0 / 255.0
# Rays cast at a time: few enough for what they hit to stay in the processor's cache, which halves the time.
_BLOCK = 8192
_MISS = np.uint32(0xFFFFFFFF)  # triangle number of a ray that hits nothing
_SKY = 0.5


class _Faces(NamedTuple):
    """By triangle: ``uv`` (T, 3, 2), ``normals`` (T, 3), ``density`` (T,) texture widths a metre, ``texture`` (T,)."""

    uv: Float32
    normals: Float32
    density: Float32
    texture: Int32


class _Pyramid(NamedTuple):
    """Textures at every power of two below their ``size``: all texels in one row, ``offsets`` where a level starts."""

    texels: Image
    offsets: NDArray[np.int64]
    size: int


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
        self._faces = _Faces(
            np.concatenate([mesh.uv for mesh in meshes]).astype(np.float32),
            np.concatenate([mesh.normals for mesh in meshes]).astype(np.float32),
            np.concatenate([_density(mesh) for mesh in meshes]).astype(np.float32),
            np.concatenate([mesh.texture for mesh in meshes]),
        )
        # Faces of movers are numbered after those of the world; the last entry is where there is nothing.
        beyond = world.mesh.surface.max() + 1
        surfaces = [mesh.surface + i * beyond for i, mesh in enumerate(meshes)]
        self._surface = np.concatenate([*surfaces, [-1]]).astype(np.int32)
        self._pyramid = _mip_pyramid(world.textures)

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

    def _trace(self, sample: int, pixels: Int, R_WC: Float, p_WC: Float, movers: Any) -> tuple[Float32, Int32]:
        """Light and surface (N,) at ``pixels`` (N,), for one of the places of a ray within its pixel."""
        light, surface = np.empty(len(pixels), np.float32), np.empty(len(pixels), np.int32)
        for begin in range(0, len(pixels), _BLOCK):
            block = slice(begin, begin + _BLOCK)
            rays = self._rays_W(sample, pixels[block], R_WC, p_WC)
            triangle, barycentric, depth = _cast(self._scene, rays)
            if movers is not None:
                other, other_barycentric, other_depth = _cast(movers, rays)
                nearer = other_depth < depth
                triangle[nearer] = other[nearer] + np.uint32(self._static)
                barycentric[nearer], depth[nearer] = other_barycentric[nearer], other_depth[nearer]
            look = self._focal_px, self._faces, self._pyramid, self._contrast, self._fog_per_m
            _shade(triangle, barycentric, depth, rays[:, 3:], *look, light[block])
            surface[block] = self._surface[np.where(triangle == _MISS, len(self._surface) - 1, triangle)]
        return light, surface

    def _rays_W(self, sample: int, pixels: Int, R_WC: Float, p_WC: Float) -> Float32:
        """Origins and directions (N, 6) of the rays through ``pixels`` (N,)."""
        rays_C = self._rays_C[sample][pixels]
        rays = np.empty((len(pixels), 6), np.float32)
        if R_WC.ndim == 2:
            rays[:, :3] = p_WC
            rays[:, 3:] = rays_C @ R_WC.T.astype(np.float32)
        else:
            row = self._row[pixels]
            rays[:, :3] = p_WC[row]
            rays[:, 3:] = np.einsum("nij,nj->ni", R_WC.astype(np.float32)[row], rays_C)
        return rays


def _rays(camera: Camera, pixels: Float) -> Float32:
    xy = camera.undistort(pixels)
    return np.column_stack([xy, np.ones(len(xy))]).astype(np.float32)


def _density(mesh: Mesh) -> Float:
    """(T,) widths of texture a metre: the root of the ratio of the areas."""
    u, v = mesh.uv[:, 1] - mesh.uv[:, 0], mesh.uv[:, 2] - mesh.uv[:, 0]
    a, b = mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0]
    area = np.linalg.norm(np.cross(a, b), axis=1)
    return np.asarray(np.sqrt(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / np.maximum(area, 1e-12)))


def _edges(surface: Int32, light: Float32) -> NDArray[np.bool_]:
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


def _mip_pyramid(textures: tuple[Image, ...]) -> _Pyramid:
    level = np.stack(textures).astype(np.float32)
    size = level.shape[1]
    rows, offsets, total = [], [], 0
    while True:
        offsets.append(total)
        rows.append(np.round(level).astype(np.uint8).ravel())
        total += level.size
        if level.shape[1] == 1:
            return _Pyramid(np.concatenate(rows), np.array(offsets), size)
        level = 0.25 * (level[:, ::2, ::2] + level[:, 1::2, ::2] + level[:, ::2, 1::2] + level[:, 1::2, 1::2])


@kernel
def _bilinear(texels: Image, start: int, size: int, u: float, v: float) -> float:
    """A level that begins at ``start``, at (u, v) in widths; it repeats."""
    x, y = (u - math.floor(u)) * size - 0.5, (v - math.floor(v)) * size - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    # Sizes are powers of two, so that a mask wraps.
    left, right = int(x0) & (size - 1), (int(x0) + 1) & (size - 1)
    top, bottom = start + (int(y0) & (size - 1)) * size, start + ((int(y0) + 1) & (size - 1)) * size
    upper = texels[top + left] * (1.0 - fx) + texels[top + right] * fx
    lower = texels[bottom + left] * (1.0 - fx) + texels[bottom + right] * fx
    return float(upper * (1.0 - fy) + lower * fy)


@kernel
def _shade(
    triangle: NDArray[np.uint32],
    barycentric: Float32,
    depth: Float32,
    directions_W: Float32,
    focal_px: float,
    faces: _Faces,
    pyramid: _Pyramid,
    contrast: float,
    fog_per_m: float,
    out: Float32,
) -> None:
    """Light (N,) from ``triangle`` (N,), hit at ``barycentric`` (N, 2) and ``depth`` (N,) along ``directions_W``.

    The mip level is where a texel is as wide as the pixel's footprint on the surface (Williams 1983); ``contrast``
    scales what a texture has around its mean.
    """
    uv, normals, density, texture = faces
    texels, offsets, size = pyramid
    levels = len(offsets)
    for i in range(len(triangle)):
        k = triangle[i]
        if k == _MISS:
            out[i] = _SKY
            continue
        b1, b2 = barycentric[i, 0], barycentric[i, 1]
        b0 = 1.0 - b1 - b2
        u = b0 * uv[k, 0, 0] + b1 * uv[k, 1, 0] + b2 * uv[k, 2, 0]
        v = b0 * uv[k, 0, 1] + b1 * uv[k, 1, 1] + b2 * uv[k, 2, 1]
        dx, dy, dz = directions_W[i, 0], directions_W[i, 1], directions_W[i, 2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        facing = (dx * nx + dy * ny + dz * nz) / length
        flip = -1.0 if facing > 0.0 else 1.0
        slant = max(abs(facing), 0.05)
        # Between the two axes of a slanted footprint: neither aliased along the one nor smeared along the other.
        footprint = depth[i] / (focal_px * math.sqrt(slant)) * density[k] * size
        level = min(max(math.log2(max(footprint, 1e-6)), 0.0), levels - 1.001)
        fine = int(level)
        blend = level - fine
        fine_size, coarse_size = size >> fine, size >> (fine + 1)
        fine_start = offsets[fine] + texture[k] * fine_size * fine_size
        coarse_start = offsets[fine + 1] + texture[k] * coarse_size * coarse_size
        albedo = (1.0 - blend) * _bilinear(texels, fine_start, fine_size, u, v)
        albedo += blend * _bilinear(texels, coarse_start, coarse_size, u, v)
        mean = texels[offsets[levels - 1] + texture[k]]
        albedo = mean + contrast * (albedo - mean)
        # Light from above, and a little from one side, so that no two walls of a corner are equally bright.
        light = 1.0 + flip * (0.20 * nz + 0.22 * nx + 0.11 * ny)
        value = albedo * light / 255.0
        if fog_per_m > 0.0:
            clear = math.exp(-fog_per_m * depth[i] * length)
            value = value * clear + _SKY * (1.0 - clear)
        out[i] = value
