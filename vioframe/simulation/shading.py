"""Compiled loop from what rays hit to the light they bring back."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image

Float32 = NDArray[np.float32]
Int32 = NDArray[np.int32]

MISS = np.uint32(0xFFFFFFFF)
"""Triangle number of a ray that hits nothing."""
_SKY = 0.5


def mip_pyramid(textures: tuple[Image, ...]) -> tuple[Image, NDArray[np.int64], int]:
    """Textures at every power of two below their size: all texels in one row, where each level starts, the size."""
    level = np.stack(textures).astype(np.float32)
    size = level.shape[1]
    rows, offsets, total = [], [], 0
    while True:
        offsets.append(total)
        rows.append(np.round(level).astype(np.uint8).ravel())
        total += level.size
        if level.shape[1] == 1:
            return np.concatenate(rows), np.array(offsets), size
        level = 0.25 * (level[:, ::2, ::2] + level[:, 1::2, ::2] + level[:, ::2, 1::2] + level[:, 1::2, 1::2])


@kernel
def bilinear(texels: Image, start: int, size: int, u: float, v: float) -> float:
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
def shade(
    triangle: NDArray[np.uint32],
    barycentric: Float32,
    depth: Float32,
    directions_W: Float32,
    focal_px: float,
    uv: Float32,
    normals: Float32,
    density: Float32,
    texture: Int32,
    texels: Image,
    offsets: NDArray[np.int64],
    size: int,
    contrast: float,
    fog_per_m: float,
    out: Float32,
) -> None:
    """Light (N,) from ``triangle`` (N,), hit at ``barycentric`` (N, 2) and ``depth`` (N,) along ``directions_W``.

    The tables by triangle are ``uv`` (T, 3, 2), ``normals`` (T, 3), ``density`` (T,) texture widths a metre and
    ``texture`` (T,). The mip level is where a texel is as wide as the pixel's footprint on the surface (Williams 1983);
    ``contrast`` scales what a texture has around its mean.
    """
    levels = len(offsets)
    for i in range(len(triangle)):
        k = triangle[i]
        if k == MISS:
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
        albedo = (1.0 - blend) * bilinear(texels, fine_start, fine_size, u, v)
        albedo += blend * bilinear(texels, coarse_start, coarse_size, u, v)
        mean = texels[offsets[levels - 1] + texture[k]]
        albedo = mean + contrast * (albedo - mean)
        # Light from above, and a little from one side, so that no two walls of a corner are equally bright.
        light = 1.0 + flip * (0.20 * nz + 0.22 * nx + 0.11 * ny)
        value = albedo * light / 255.0
        if fog_per_m > 0.0:
            clear = math.exp(-fog_per_m * depth[i] * length)
            value = value * clear + _SKY * (1.0 - clear)
        out[i] = value
