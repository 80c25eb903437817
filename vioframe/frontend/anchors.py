"""What points looked like when they were first seen, against which they are found again in every later image.

Lucas-Kanade follows a patch from each image to the next as if it only moved. It turns and grows as well, and is thereby
found a little off, the same way image after image: a point slides off its landmark, by a pixel in a second. Here its
first patch, its anchor, is laid over each new image by an affine map that is refined from image to image, so that
nothing adds up (Shi and Tomasi, "Good features to track", CVPR 1994; solved inversely as by Baker and Matthews,
"Lucas-Kanade 20 years on", IJCV 2004). Brightness and contrast of a patch may change.
Derivation: ``docs/derivations/anchors.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.frontend.lucas_kanade import Pixels, Pyramid
from vioframe.jit import kernel
from vioframe.types import Bool, Float, Image

_ITERATIONS, _EPSILON_PX = 6, 0.02
# Pixels weigh by a Gaussian of this width, of half the side of a patch: turned or grown the middle is what it was.
_SPREAD = 0.7
# How surely a patch is what it was, as a share of what its gradients say of where it is: of the other four numbers.
_STIFFNESS = 0.02
# A patch is not its anchor any more where its correlation with that is less than this share of the image's median: of
# noise and blur all have the same.
_LEAST_LIKENESS = 0.8
# Of the numbers of a map, whether it moves pixels down, and the powers of u across and of v down that it moves them by.
_PARTS = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 0, 1))
# Farther than this from where the patch before leads, px, is something else that looks alike.
_FARTHEST_PX = 3.0


@dataclass(frozen=True, slots=True)
class Anchors:
    """Of N points: patches (N, S, S) less their mean, weighted gradients of these, and ``information`` inverted.

    ``contrast`` (N,) is the deviation of a patch, ``warp`` (N, 2, 2) the affine map from it to the newest image.
    """

    patch: Pixels
    by_x: Pixels
    by_y: Pixels
    inverse: Float
    contrast: Float
    warp: Float

    @staticmethod
    def of(pyramid: Pyramid, xy: Float) -> Anchors:
        """Of the patches about ``xy`` (N, 2) px of ``pyramid``, as large as those that it is followed by."""
        side, count = pyramid.window_px, len(xy)
        patch, by_x, by_y = (np.empty((count, side, side), np.float32) for _ in range(3))
        information, contrast = np.empty((count, 6, 6)), np.empty(count)
        at = np.ascontiguousarray(xy, np.float64) + pyramid.border_px
        _anchor(pyramid.images[0], at, patch, by_x, by_y, information, contrast)
        # Of what does not vary nothing can be told: it stays where it is put.
        inverse: Float = np.linalg.inv(information + 1e-3 * np.eye(6)).astype(np.float64)
        return Anchors(patch, by_x, by_y, inverse, contrast, np.tile(np.eye(2), (count, 1, 1)))

    def keep(self, mask: Bool) -> Anchors:
        """Only those of the points ``mask`` (N,)."""
        return Anchors(*(values[mask] for values in self._values))

    def joined(self, more: Anchors) -> Anchors:
        return Anchors(*map(np.concatenate, zip(self._values, more._values, strict=True)))

    def refine(self, pyramid: Pyramid, xy: Float, tried: Bool) -> tuple[Anchors, Float, Bool]:
        """Find the patches ``tried`` (N,) in ``pyramid``, beginning at ``xy`` (N, 2) px.

        Returns them with their new maps, (N, 2) px where they are, and (N,) which were found; others are as before.
        """
        border = pyramid.border_px
        found, warp, likeness = xy + border, self.warp.copy(), np.full(len(xy), -1.0)
        fixed = self.patch, self.by_x, self.by_y, self.inverse, self.contrast
        _refine(pyramid.images[0], *fixed, tried, found, warp, likeness)
        found -= border
        converged = likeness > 0.0
        typical = float(np.median(likeness[converged])) if converged.any() else 1.0
        near = ((found - xy) ** 2).sum(axis=1) < _FARTHEST_PX**2
        held = converged & near & (likeness > _LEAST_LIKENESS * typical)
        warp[~held], found[~held] = self.warp[~held], xy[~held]
        return replace(self, warp=warp), found, held

    @property
    def _values(self) -> tuple[NDArray[Any], ...]:
        return self.patch, self.by_x, self.by_y, self.inverse, self.contrast, self.warp


def warm_up() -> None:
    """Compile the kernels, or load them from the cache, so that the first frame does not wait."""
    pyramid, xy = Pyramid.of(np.zeros((64, 64), np.uint8), 0, 15), np.full((1, 2), 32.0)
    Anchors.of(pyramid, xy).refine(pyramid, xy, np.ones(1, np.bool_))


@kernel(inlined=True)
def _sample(
    flat: Image, width: int, x: np.float32, y: np.float32, across: np.float32, down: np.float32, row: Pixels
) -> None:
    """``row`` becomes what an image has at ``x``, ``y`` and on from there, a step of ``across``, ``down`` each.

    ``flat`` holds its rows, each ``width`` long, one after the other.
    """
    for k in range(len(row)):
        u, v = x + across * np.float32(k), y + down * np.float32(k)
        i, j = np.int32(u), np.int32(v)
        a, b, at = u - np.float32(i), v - np.float32(j), np.uint64(j * width + i)
        below = at + np.uint64(width)
        left, under = np.float32(flat[at]), np.float32(flat[below])
        upper = left + a * (np.float32(flat[at + np.uint64(1)]) - left)
        lower = under + a * (np.float32(flat[below + np.uint64(1)]) - under)
        row[k] = upper + b * (lower - upper)


@kernel(reorder_sums=True)
def _anchor(
    image: Image, xy: Float, patch: Pixels, by_x: Pixels, by_y: Pixels, information: Float, contrast: Float
) -> None:
    """Fill what :class:`Anchors` holds of the patches about ``xy`` (N, 2) px of the bordered ``image``."""
    side = patch.shape[1]
    half = side // 2
    flat, width = image.reshape(-1), image.shape[1]
    along = np.empty(side, np.float32)
    weight = np.empty(side, np.float32)
    for k in range(side):
        along[k] = (k - half) / half
        weight[k] = math.exp(-0.5 * along[k] * along[k] / (_SPREAD * _SPREAD))
    # With a pixel more all round, for the gradients.
    wide = np.empty((side + 2, side + 2), np.float32)
    sums = np.empty((3, 3, 3))
    for n in range(len(xy)):
        for r in range(side + 2):
            x, y = np.float32(xy[n, 0] - half - 1), np.float32(xy[n, 1] - half - 1 + r)
            _sample(flat, width, x, y, np.float32(1.0), np.float32(0.0), wide[r])
        total = np.float32(0.0)
        for r in range(1, side + 1):
            for c in range(1, side + 1):
                total += wide[r, c]
        mean = total / np.float32(side * side)
        square = 0.0
        sums[:] = 0.0
        for r in range(side):
            above, here, below, v = wide[r], wide[r + 1], wide[r + 2], along[r]
            xx_0, xx_1, xx_2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            xy_0, xy_1, xy_2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            yy_0, yy_1, yy_2 = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            squares = np.float32(0.0)
            for c in range(side):
                dx, dy = np.float32(0.5) * (here[c + 2] - here[c]), np.float32(0.5) * (below[c + 1] - above[c + 1])
                along_x, along_y, u = weight[r] * weight[c] * dx, weight[r] * weight[c] * dy, along[c]
                xx, xy_, yy = along_x * dx, along_x * dy, along_y * dy
                xx_0 += xx
                xx_1 += xx * u
                xx_2 += xx * u * u
                xy_0 += xy_
                xy_1 += xy_ * u
                xy_2 += xy_ * u * u
                yy_0 += yy
                yy_1 += yy * u
                yy_2 += yy * u * u
                value = here[c + 1] - mean
                squares += value * value
                patch[n, r, c], by_x[n, r, c], by_y[n, r, c] = value, along_x, along_y
            square += float(squares)
            for k in range(3):
                power = v**k
                sums[0, 0, k] += power * xx_0
                sums[0, 1, k] += power * xx_1
                sums[0, 2, k] += power * xx_2
                sums[1, 0, k] += power * xy_0
                sums[1, 1, k] += power * xy_1
                sums[1, 2, k] += power * xy_2
                sums[2, 0, k] += power * yy_0
                sums[2, 1, k] += power * yy_1
                sums[2, 2, k] += power * yy_2
        # The six numbers move a pixel by dx [1 u v] and dy [1 u v]: these are in the order below.
        for i in range(6):
            for k in range(6):
                p, q = _PARTS[i], _PARTS[k]
                information[n, i, k] = sums[p[0] + q[0], p[1] + q[1], p[2] + q[2]]
        stiffness = 0.5 * _STIFFNESS * (information[n, 0, 0] + information[n, 1, 1])
        for i in range(2, 6):
            information[n, i, i] += stiffness
        contrast[n] = math.sqrt(square / (side * side))


@kernel(reorder_sums=True)
def _refine(
    image: Image,
    patch: Pixels,
    by_x: Pixels,
    by_y: Pixels,
    inverse: Float,
    contrast: Float,
    tried: Bool,
    xy: Float,
    warp: Float,
    likeness: Float,
) -> None:
    """Move ``xy`` (N, 2) px of the bordered ``image`` and ``warp`` (N, 2, 2) to where the patches are that are tried.

    ``likeness`` (N,) becomes the correlation with the anchor; it stays -1 where the patch leads out of the image.
    """
    side = patch.shape[1]
    half, pixels = side // 2, side * side
    height, width = image.shape
    flat = image.ravel()
    now, g = np.empty((side, side), np.float32), np.empty(6)
    for n in range(len(xy)):
        if not tried[n]:
            continue
        x, y = xy[n, 0], xy[n, 1]
        a, b, c, d = warp[n, 0, 0], warp[n, 0, 1], warp[n, 1, 0], warp[n, 1, 1]
        alike = -1.0
        for _ in range(_ITERATIONS):
            reach_x, reach_y = half * (abs(a) + abs(b)) + 1.0, half * (abs(c) + abs(d)) + 1.0
            if not (reach_x <= x < width - 1 - reach_x and reach_y <= y < height - 1 - reach_y):
                alike = -1.0
                break
            total, square, product = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for r in range(side):
                from_x, from_y = x + b * (r - half) - a * half, y + d * (r - half) - c * half
                _sample(flat, width, np.float32(from_x), np.float32(from_y), np.float32(a), np.float32(c), now[r])
                for k in range(side):
                    value = now[r, k]
                    total += value
                    square += value * value
                    product += value * patch[n, r, k]
            mean = total / pixels
            deviation = math.sqrt(max(square / pixels - mean * mean, 1e-6))
            alike = product / pixels / (deviation * max(contrast[n], 1e-3))
            gain, level = np.float32(contrast[n] / deviation), np.float32(mean)
            g[:] = 0.0
            for r in range(side):
                v = (r - half) / half
                x0, x1, y0, y1 = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
                for k in range(side):
                    off, u = gain * (now[r, k] - level) - patch[n, r, k], np.float32((k - half) / half)
                    along_x, along_y = off * by_x[n, r, k], off * by_y[n, r, k]
                    x0 += along_x
                    x1 += along_x * u
                    y0 += along_y
                    y1 += along_y * u
                g[0] += x0
                g[1] += y0
                g[2] += x1
                g[3] += x0 * v
                g[4] += y1
                g[5] += y0 * v
            dx, dy, da, db, dc, dd = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(6):
                dx += inverse[n, 0, i] * g[i]
                dy += inverse[n, 1, i] * g[i]
                da += inverse[n, 2, i] * g[i] / half
                db += inverse[n, 3, i] * g[i] / half
                dc += inverse[n, 4, i] * g[i] / half
                dd += inverse[n, 5, i] * g[i] / half
            # Of the map, what it does to pixels half way to the edge.
            turned = 0.25 * half * half * (da * da + db * db + dc * dc + dd * dd)
            if dx * dx + dy * dy + turned < _EPSILON_PX * _EPSILON_PX:
                break
            # The step belongs to the anchor: it is undone before the map.
            determinant = (1.0 + da) * (1.0 + dd) - db * dc
            if not determinant > 0.2:
                alike = -1.0
                break
            a, b, c, d = (
                (a * (1.0 + dd) - b * dc) / determinant,
                (b * (1.0 + da) - a * db) / determinant,
                (c * (1.0 + dd) - d * dc) / determinant,
                (d * (1.0 + da) - c * db) / determinant,
            )
            x, y = x - (a * dx + b * dy), y - (c * dx + d * dy)
        xy[n, 0], xy[n, 1], likeness[n] = x, y, alike
        warp[n, 0, 0], warp[n, 0, 1], warp[n, 1, 0], warp[n, 1, 1] = a, b, c, d
