"""Which triangle every ray hits, and what light comes back from there: the compiled half of a renderer.

A ray d = (x, y, 1) in C hits a triangle with corners p_0, p_1, p_2 where it lies on the inner side of three planes, all
through the camera and an edge, with normals N_0 = p_1 x p_2 and so on. How far inside it lies is linear in x and y. So
is the inverse depth w = d (N_0 + N_1 + N_2) / det, with det = p_0 N_0, and w times whatever is interpolated between the
corners, such as w u = d (u_0 N_0 + u_1 N_1 + u_2 N_2) / det (Olano and Greer, Triangle Scan Conversion using 2D
Homogeneous Coordinates, 1997). Nothing has to be clipped, and a lens may bend the rays as it likes.

The image is cut into tiles. To each go the triangles that it may see, and its rays are held against these alone.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Bool, Float, Image, Int
from vioframe.jit import kernel
from vioframe.types import Int32

Float32 = NDArray[np.float32]

SKY = 0.5
"""The light where a ray hits nothing; 1 is white."""
NOTHING = -1
"""The surface that such a ray hits."""

# How far beyond its edge a triangle is still hit, as an angle: some ten-thousandths of a pixel, which is far more than
# what rounding might leave open between two triangles.
_BEYOND = np.float32(1e-6)
_WHITE = 255.0
# Tiles are looked at by blocks of so many to a side first.
_BLOCK = 8
# Places in a texture are whole numbers of texels of the finest level and 2 ** -16 of one.
_FRACTION_BITS = 16
_ONE_TEXEL = 1 << _FRACTION_BITS
_OF_A_TEXEL = np.float32(1.0 / _ONE_TEXEL)


class Faces(NamedTuple):
    """Triangles: ``corners`` (T, 3, 3) m in W within ``spheres`` (T, 4) of centre and radius, ``normals`` (T, 3).

    ``uv`` (T, 3, 2) are widths of the ``texture`` (T,), of which ``density`` (T,) go to a metre; triangles of one
    ``surface`` (T,) belong together.
    """

    corners: Float
    spheres: Float
    normals: Float
    uv: Float
    density: Float
    texture: Int32
    surface: Int32


class Pyramid(NamedTuple):
    """Textures at every power of two below their ``size``: all texels in one row, ``offsets`` where a level starts."""

    texels: Image
    offsets: Int
    size: int


class Tiles(NamedTuple):
    """An image cut into tiles of ``height`` x ``width`` px, fewer at its right and lower end.

    ``boxes`` (rows, columns, 4) hold the least and the greatest x, then y, of all rays through each; where a lens lets
    none through, they are infinite, the wrong way round.
    """

    boxes: Float32
    height: int
    width: int


class Seen(NamedTuple):
    """S triangles as seen from a pose; ``of_tile`` lists those a tile may see, in its ``span`` (rows, columns, 2).

    ``forms`` (S, 4, 3) are linear in a ray: three edges, inverse depth. So are ``looks`` (S, 3, 3), which take
    more digits: inverse depth, and u and v times it. ``lights`` (S, 4) are the distance of the plane, the texels along
    a pixel at unit depth, and what makes light of a texel: factor and summand. ``face`` (S,) numbers the triangle.
    """

    forms: Float32
    looks: Float
    lights: Float
    face: Int32
    span: Int
    of_tile: Int32


@kernel
def see(
    faces: Faces, pyramid: Pyramid, tiles: Tiles, R_WC: Float, p_WC: Float, focal_px: float, contrast: float
) -> Seen:
    """What is seen from a pose, (1, 3, 3) and (1, 3) m, or from one for each row of tiles.

    ``contrast`` scales what a texture has around its mean.
    """
    boxes = tiles.boxes
    rows, columns = boxes.shape[:2]
    forms, looks = np.empty((1024, 4, 3), np.float32), np.empty((1024, 3, 3))
    lights, face = np.empty((1024, 4)), np.empty(1024, np.int32)
    span, of_tile = np.empty((rows, columns, 2), np.int64), np.empty(1 << 16, np.int32)
    met, normals = np.empty(len(faces.corners), np.int32), np.empty((3, 3))
    of_view = near = np.empty(0, np.int32)
    begin = end = pairs = 0
    still = len(p_WC) == 1
    down = _BLOCK if still else 1
    for top in range(0, rows, down):
        if top == 0 or not still:
            view = _around(boxes if still else boxes[top : top + 1])
            begin = end
            for k in met[: _meet(faces.spheres, view, R_WC[top], p_WC[top], met)]:
                if end == len(face):
                    forms, looks, lights, face = _longer(forms), _longer(looks), _longer(lights), _longer(face)
                det = _set_edges(faces.corners, k, R_WC[top], p_WC[top], normals, forms, end)
                if det != 0.0 and _may_hit(forms, end, view[0], view[1], view[2], view[3]):
                    _set_looks(faces, pyramid, k, normals, det, focal_px, contrast, forms, looks, lights, end)
                    face[end] = k
                    end += 1
            of_view = np.arange(begin, end).astype(np.int32)
            near = np.empty_like(of_view)
        for left in range(0, columns, _BLOCK):
            count = _pick(forms, of_view, _around(boxes[top : top + down, left : left + _BLOCK]), near)
            for row in range(top, min(top + down, rows)):
                for column in range(left, min(left + _BLOCK, columns)):
                    while pairs + count > len(of_tile):
                        of_tile = _longer(of_tile)
                    span[row, column, 0] = pairs
                    pairs += _pick(forms, near[:count], boxes[row, column], of_tile[pairs:])
                    span[row, column, 1] = pairs
    return Seen(forms, looks, lights, face, span, of_tile)


@kernel
def draw(
    seen: Seen,
    faces: Faces,
    pyramid: Pyramid,
    tiles: Tiles,
    rays: Float32,
    fog_per_m: float,
    where: Bool,
    light: Float32,
    surface: Int32,
) -> None:
    """Put the mean over where the ``rays`` (S, 2, H, W) end into ``light`` (H, W), there ``where`` (H, W) has it.

    ``surface`` (H, W) is what the last of them hits.
    """
    height, width = light.shape
    samples = len(rays)
    size = tiles.height * tiles.width * samples
    x, y = np.empty(size, np.float32), np.empty(size, np.float32)
    inverse_depth, value = np.empty(size, np.float32), np.empty(size, np.float32)
    found = np.empty(size, np.int32)
    for row, column in np.ndindex(seen.span.shape[:2]):
        top, left = row * tiles.height, column * tiles.width
        bottom, right = min(top + tiles.height, height), min(left + tiles.width, width)
        count = 0
        for i in range(top, bottom):
            for j in range(left, right):
                if where[i, j]:
                    for sample in range(samples):
                        x[count], y[count] = rays[sample, 0, i, j], rays[sample, 1, i, j]
                        count += 1
        if count == 0:
            continue
        _cast(seen, row, column, x[:count], y[:count], inverse_depth, found)
        _shade(seen, faces, pyramid, found, x[:count], y[:count], fog_per_m, value)
        count = 0
        for i in range(top, bottom):
            for j in range(left, right):
                if where[i, j]:
                    total = np.float32(0.0)
                    for sample in range(samples):
                        total += value[count + sample]
                    count += samples
                    light[i, j] = total / samples
                    s = found[count - 1]
                    surface[i, j] = NOTHING if s < 0 else faces.surface[seen.face[s]]


@kernel
def _around(boxes: Float32) -> Any:
    """The box (4,) around ``boxes`` (N, M, 4)."""
    around = boxes[0, 0].copy()
    for i in range(len(boxes)):
        for j in range(boxes.shape[1]):
            around[0], around[1] = min(around[0], boxes[i, j, 0]), max(around[1], boxes[i, j, 1])
            around[2], around[3] = min(around[2], boxes[i, j, 2]), max(around[3], boxes[i, j, 3])
    return around


@kernel
def _longer(array: NDArray[Any]) -> Any:
    return np.concatenate((array, array))


@kernel
def _meet(spheres: Float, view: Float32, R_WC: Float, p_WC: Float, met: Int32) -> int:
    """Write which ``spheres`` (T, 4) rays through the box ``view`` (4,) may meet to ``met``; returns how many.

    Those do that are not beyond any of five planes: that of the camera, and those through it and a side of the box.
    """
    left, right, top, bottom = float(view[0]), float(view[1]), float(view[2]), float(view[3])
    of_left, of_right = math.sqrt(1.0 + left * left), math.sqrt(1.0 + right * right)
    of_top, of_bottom = math.sqrt(1.0 + top * top), math.sqrt(1.0 + bottom * bottom)
    count = 0
    for k in range(len(spheres)):
        X, Y, Z, radius = spheres[k, 0] - p_WC[0], spheres[k, 1] - p_WC[1], spheres[k, 2] - p_WC[2], spheres[k, 3]
        x = R_WC[0, 0] * X + R_WC[1, 0] * Y + R_WC[2, 0] * Z
        y = R_WC[0, 1] * X + R_WC[1, 1] * Y + R_WC[2, 1] * Z
        z = R_WC[0, 2] * X + R_WC[1, 2] * Y + R_WC[2, 2] * Z
        met[count] = k
        count += (
            (z > -radius)
            & (x - left * z > -radius * of_left)
            & (right * z - x > -radius * of_right)
            & (y - top * z > -radius * of_top)
            & (bottom * z - y > -radius * of_bottom)
        )
    return count


@kernel
def _in_camera(p_W: Float, k: int, i: int, R_WC: Float, p_WC: Float) -> tuple[float, float, float]:
    X, Y, Z = p_W[k, i, 0] - p_WC[0], p_W[k, i, 1] - p_WC[1], p_W[k, i, 2] - p_WC[2]
    return (
        R_WC[0, 0] * X + R_WC[1, 0] * Y + R_WC[2, 0] * Z,
        R_WC[0, 1] * X + R_WC[1, 1] * Y + R_WC[2, 1] * Z,
        R_WC[0, 2] * X + R_WC[1, 2] * Y + R_WC[2, 2] * Z,
    )


@kernel
def _set_edges(corners: Float, k: int, R_WC: Float, p_WC: Float, N: Float, forms: Float32, s: int) -> Any:
    """The normals ``N`` (3, 3) of triangle ``k`` and, of unit length and pointing inward, the edges of ``forms[s]``.

    Returns det: positive where the triangle is seen from behind, zero where from its edge.
    """
    ax, ay, az = _in_camera(corners, k, 0, R_WC, p_WC)
    bx, by, bz = _in_camera(corners, k, 1, R_WC, p_WC)
    cx, cy, cz = _in_camera(corners, k, 2, R_WC, p_WC)
    N[0, 0], N[0, 1], N[0, 2] = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    N[1, 0], N[1, 1], N[1, 2] = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    N[2, 0], N[2, 1], N[2, 2] = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    det = ax * N[0, 0] + ay * N[0, 1] + az * N[0, 2]
    for i in range(3):
        scale = math.copysign(1.0, det) / math.sqrt(N[i, 0] ** 2 + N[i, 1] ** 2 + N[i, 2] ** 2)
        for j in range(3):
            forms[s, i, j] = scale * N[i, j]
    return det


@kernel
def _set_looks(
    faces: Faces,
    pyramid: Pyramid,
    k: int,
    N: Float,
    det: float,
    focal_px: float,
    contrast: float,
    forms: Float32,
    looks: Float,
    lights: Float,
    s: int,
) -> None:
    """All else of triangle ``k``, of normals ``N`` (3, 3) and ``det``: see :class:`Seen`."""
    area = 0.0
    for j in range(3):
        n = N[0, j] + N[1, j] + N[2, j]
        area += n * n
        looks[s, 0, j] = forms[s, 3, j] = n / det
        for i in range(2):
            uv = faces.uv[k, 0, i] * N[0, j] + faces.uv[k, 1, i] * N[1, j] + faces.uv[k, 2, i] * N[2, j]
            looks[s, i + 1, j] = uv / det
    lights[s, 0] = abs(det) / math.sqrt(area)
    lights[s, 1] = faces.density[k] * pyramid.size / focal_px
    # Light from above, and a little from one side, so that no two walls of a corner are equally bright.
    slope = 0.20 * faces.normals[k, 2] + 0.22 * faces.normals[k, 0] + 0.11 * faces.normals[k, 1]
    brightness = (1.0 - math.copysign(1.0, det) * slope) / _WHITE
    mean = pyramid.texels[pyramid.offsets[-1] + faces.texture[k]]
    lights[s, 2], lights[s, 3] = contrast * brightness, (1.0 - contrast) * mean * brightness


@kernel
def _may_hit(forms: Float32, s: int, left: float, right: float, top: float, bottom: float) -> bool:
    """Whether a triangle may be hit by rays of a box: none of its edges has the whole box on its outer side."""
    half = np.float32(0.5)
    x, y, dx, dy = half * (left + right), half * (top + bottom), half * (right - left), half * (bottom - top)
    hit = True
    for i in range(3):
        a, b, c = forms[s, i, 0], forms[s, i, 1], forms[s, i, 2]
        # Rounding is a little different here than where single rays are cast.
        hit &= a * x + b * y + c + abs(a) * dx + abs(b) * dy >= -2 * _BEYOND
    return hit


@kernel
def _pick(forms: Float32, candidates: Int32, box: Float32, picked: Int32) -> int:
    """Write those ``candidates`` (N,) that rays of the ``box`` (4,) may hit to ``picked``; returns how many."""
    left, right, top, bottom = box[0], box[1], box[2], box[3]
    count = 0
    for s in candidates:
        picked[count] = s  # to be written over, unless it is counted
        count += _may_hit(forms, s, left, right, top, bottom)
    return count


@kernel
def _cast(seen: Seen, row: int, column: int, x: Float32, y: Float32, inverse_depth: Float32, found: Int32) -> None:
    """The triangle that rays (N,) of a tile hit first: ``found`` (N,), -1 where there is none."""
    for i in range(len(x)):
        inverse_depth[i], found[i] = 0.0, -1
    for s in seen.of_tile[seen.span[row, column, 0] : seen.span[row, column, 1]]:
        (ax, ay, az), (bx, by, bz), (cx, cy, cz), (wx, wy, wz) = seen.forms[s]
        for i in range(len(x)):
            w = wx * x[i] + wy * y[i] + wz
            hit = (
                (ax * x[i] + ay * y[i] + az >= -_BEYOND)
                & (bx * x[i] + by * y[i] + bz >= -_BEYOND)
                & (cx * x[i] + cy * y[i] + cz >= -_BEYOND)
                & (w > inverse_depth[i])
            )
            inverse_depth[i] = w if hit else inverse_depth[i]
            found[i] = s if hit else found[i]


@kernel
def _shade(
    seen: Seen,
    faces: Faces,
    pyramid: Pyramid,
    found: Int32,
    x: Float32,
    y: Float32,
    fog_per_m: float,
    value: Float32,
) -> None:
    """The light ``value`` (N,) that comes back along rays (x, y, 1) from what they were ``found`` (N,) to hit.

    The mip level is where a texel is as wide as the pixel's footprint on the surface (Williams 1983).
    """
    looks, lights, face, texture = seen.looks, seen.lights, seen.face, faces.texture
    texels, offsets, levels = pyramid.texels, pyramid.offsets, len(pyramid.offsets)
    count = len(x)
    U, V = np.empty(count, np.int64), np.empty(count, np.int64)
    covered, length = np.empty(count, np.float32), np.empty(count, np.float32)
    whole, most = float(pyramid.size * _ONE_TEXEL), 4.0 ** (levels - 1.001)
    for i in range(count):
        s = max(found[i], 0)
        inverse_depth = looks[s, 0, 0] * x[i] + looks[s, 0, 1] * y[i] + looks[s, 0, 2]
        depth = 1.0 / inverse_depth
        U[i] = int(whole * depth * (looks[s, 1, 0] * x[i] + looks[s, 1, 1] * y[i] + looks[s, 1, 2]))
        V[i] = int(whole * depth * (looks[s, 2, 0] * x[i] + looks[s, 2, 1] * y[i] + looks[s, 2, 2]))
        ray = math.sqrt(1.0 + x[i] * x[i] + y[i] * y[i])
        length[i] = depth * ray
        slant = max(lights[s, 0] * inverse_depth / ray, 0.05)
        # Between the two axes of a slanted footprint: neither aliased along the one nor smeared along the other.
        covered[i] = min(max((depth * lights[s, 1]) ** 2 / slant, 1.0), most)
    bits = covered.view(np.int32)
    for i in range(count):
        s = found[i]
        if s < 0:
            value[i] = SKY
            continue
        level = _half_log2(bits[i])
        fine = int(level)
        image, blend = texture[face[s]], level - fine
        below = _bilinear(texels, offsets[fine], image, levels - 1 - fine, U[i] >> fine, V[i] >> fine)
        fine += 1
        above = _bilinear(texels, offsets[fine], image, levels - 1 - fine, U[i] >> fine, V[i] >> fine)
        light = lights[s, 2] * (below + blend * (above - below)) + lights[s, 3]
        if fog_per_m > 0.0:
            clear = math.exp(-fog_per_m * length[i])
            light = light * clear + SKY * (1.0 - clear)
        value[i] = light


@kernel
def _half_log2(bits: int) -> float:
    """Half the logarithm of a float32 of at least 1, given its bits, within 3e-6."""
    t = float((bits & 0x7FFFFF) * 2.0**-23)
    # A fit by Chebyshev's polynomials, exact at both ends: the logarithm has no step where the exponent has one.
    bend = 0.44262243 + t * (-0.27629831 + t * (0.18363433 + t * (-0.09720727 + t * 0.02595345)))
    return 0.5 * ((bits >> 23) - 127 + t + t * (1.0 - t) * bend)


@kernel
def _bilinear(texels: Image, start: int, image: int, bits: int, U: int, V: int) -> float:
    """Of an ``image`` of 2 ** ``bits`` texels a side, in the level that begins at ``start``, at (U, V); it repeats."""
    # A texel's value is that of its middle.
    U, V = U - _ONE_TEXEL // 2, V - _ONE_TEXEL // 2
    fx, fy = (U & (_ONE_TEXEL - 1)) * _OF_A_TEXEL, (V & (_ONE_TEXEL - 1)) * _OF_A_TEXEL
    x, y, mask = U >> _FRACTION_BITS, V >> _FRACTION_BITS, (1 << bits) - 1
    left, right, top = x & mask, (x + 1) & mask, start + (image << 2 * bits)
    upper, lower = top + ((y & mask) << bits), top + (((y + 1) & mask) << bits)
    a, b = np.float32(texels[upper + left]), np.float32(texels[upper + right])
    c, d = np.float32(texels[lower + left]), np.float32(texels[lower + right])
    above, below = a + (b - a) * fx, c + (d - c) * fx
    return float(above + (below - above) * fy)
