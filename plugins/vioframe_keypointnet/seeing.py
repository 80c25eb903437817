"""What a network sees of an image on a CPU: the grey levels, or, for a network of peaks, local contrast, folded."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image
from vioframe_keypointnet.architecture import FAINT, FOLD_PX, Architecture

COARSE_PX = 4
"""Side of the squares of pixels whose means the local means are made of."""
ZERO = 128
"""What stands for 0 in 8 bits; also the whole grey level nearest to the neutral one."""
CONTRAST_STEP = np.float32(6.0 / 127.0)
"""Of local contrast in 8 bits, which end at 6 deviations: what lies farther out is noise on a blank surface."""

_FAINT = np.float32((255.0 * FAINT) ** 2)

Floats = NDArray[np.float32]


class Eye:
    """Sees images of one ``shape`` (H, W), multiples of 8; what it sees is in ``seen``, which stays where it is.

    Of the published network that are the grey levels, (H, W, 1); for a network of peaks the local contrast of
    :func:`vioframe_keypointnet.network.locally_normalised`, 4 x 4 pixels folded, (H/4, W/4, 16), or, in
    ``eight_bits``, steps of :data:`CONTRAST_STEP` from :data:`ZERO`.
    """

    def __init__(self, architecture: Architecture, shape: tuple[int, int], *, eight_bits: bool) -> None:
        self._peaks, f = architecture.peaks, architecture.fold
        self._see = _contrast_in_steps if eight_bits else _contrast
        kind = np.uint8 if eight_bits or not self._peaks else np.float32
        self.seen: NDArray[Any] = np.empty((shape[0] // f, shape[1] // f, f * f), kind)
        # New arrays each time would take longer than what fills them.
        self._coarse = np.empty((shape[0] // COARSE_PX, shape[1] // COARSE_PX), np.float32)
        self._mean, self._variance = (np.empty((shape[0] // COARSE_PX, shape[1]), np.float32) for _ in range(2))

    def __call__(self, image: Image) -> None:
        if not self._peaks:
            self.seen[..., 0] = image
            return
        _means(image, self._coarse)
        _smooth(self._coarse, self._mean)
        _variances(image, self._mean, self._coarse)
        _smooth(self._coarse, self._variance)
        self._see(image, self._mean, self._variance, self.seen)


@kernel
def _between(y: int, rows: int) -> tuple[int, int, np.float32]:
    """The two of so many ``rows`` of means that row ``y`` of the image lies between, and the second one's share."""
    at = min(max((y + 0.5) / COARSE_PX - 0.5, 0.0), rows - 1.0)
    above = int(at)
    return above, min(above + 1, rows - 1), np.float32(at - above)


@kernel
def _means(image: Image, coarse: Floats) -> None:
    """Fill ``coarse`` (H/4, W/4) with the mean of each 4 x 4 px."""
    rows, columns = coarse.shape
    total = np.empty(image.shape[1], np.int32)
    for r in range(rows):
        y = COARSE_PX * r
        for x in range(len(total)):
            total[x] = np.int32(image[y, x]) + image[y + 1, x] + image[y + 2, x] + image[y + 3, x]
        for c in range(columns):
            x = COARSE_PX * c
            coarse[r, c] = np.float32(total[x] + total[x + 1] + total[x + 2] + total[x + 3]) / np.float32(16.0)


@kernel
def _smooth(coarse: Floats, around: Floats) -> None:
    """Fill ``around`` (H/4, W) with the mean of 5 x 5 ``coarse`` values (H/4, W/4), interpolated within the rows; what
    is beyond the border is as at it."""
    rows, columns = coarse.shape
    total, mean = np.empty(columns + 4, np.float32), np.empty(columns + 2, np.float32)
    far, near = np.float32(0.375), np.float32(0.125)  # of four pixels those at the sides, and those in the middle
    for r in range(rows):
        above, below = coarse[max(r - 2, 0)], coarse[min(r + 2, rows - 1)]
        over, under = coarse[max(r - 1, 0)], coarse[min(r + 1, rows - 1)]
        for c in range(columns):
            total[c + 2] = above[c] + over[c] + coarse[r, c] + under[c] + below[c]
        total[:2], total[-2:] = total[2], total[-3]
        for c in range(columns):
            five = total[c] + total[c + 1] + total[c + 2] + total[c + 3] + total[c + 4]
            mean[c + 1] = five * np.float32(1.0 / 25.0)
        mean[0], mean[-1] = mean[1], mean[-2]
        for c in range(columns):
            before, here, after = mean[c], mean[c + 1], mean[c + 2]
            around[r, COARSE_PX * c] = here + far * (before - here)
            around[r, COARSE_PX * c + 1] = here + near * (before - here)
            around[r, COARSE_PX * c + 2] = here + near * (after - here)
            around[r, COARSE_PX * c + 3] = here + far * (after - here)


@kernel
def _variances(image: Image, mean: Floats, variance: Floats) -> None:
    """Fill ``variance`` (H/4, W/4) with the mean square, over each 4 x 4 px, of the image less its local ``mean``."""
    rows, columns = variance.shape
    total = np.empty(image.shape[1], np.float32)
    for r in range(rows):
        total[:] = 0.0
        for y in range(COARSE_PX * r, COARSE_PX * (r + 1)):
            above, below, share = _between(y, rows)
            rest = np.float32(1.0) - share
            for x in range(len(total)):
                difference = np.float32(image[y, x]) - (rest * mean[above, x] + share * mean[below, x])
                total[x] += difference * difference
        for c in range(columns):
            x = COARSE_PX * c
            variance[r, c] = (total[x] + total[x + 1] + total[x + 2] + total[x + 3]) / np.float32(16.0)


@kernel
def _contrast(image: Image, mean: Floats, variance: Floats, seen: Floats) -> None:
    """Fill ``seen`` (H/4, W/4, 16) with the image less its local mean, over the local deviation."""
    contrast = np.empty(image.shape[1], np.float32)
    for y in range(len(image)):
        _contrast_of_row(image[y], mean, variance, y, contrast)
        first = FOLD_PX * (y % FOLD_PX)
        for x in range(len(contrast)):
            seen[y // FOLD_PX, x // FOLD_PX, first + x % FOLD_PX] = contrast[x]


@kernel
def _contrast_in_steps(image: Image, mean: Floats, variance: Floats, seen: Image) -> None:
    """The same in 8 bits."""
    contrast, steps = np.empty(image.shape[1], np.float32), np.empty(image.shape[1], np.uint8)
    # The pixels of a row that are of one place are moved together.
    of_row, of_places = steps.view(np.uint32), seen.view(np.uint32)
    per_step = np.float32(1.0) / CONTRAST_STEP
    for y in range(len(image)):
        _contrast_of_row(image[y], mean, variance, y, contrast)
        for x in range(len(contrast)):
            rounded = contrast[x] * per_step + np.float32(ZERO + 0.5)
            # By way of int32, as processors convert no vector of floats to bytes.
            steps[x] = np.uint8(np.int32(min(max(rounded, np.float32(0.0)), np.float32(255.0))))
        places = of_places[y // FOLD_PX]
        for place in range(len(places)):
            places[place, y % FOLD_PX] = of_row[place]


@kernel(inlined=True)
def _contrast_of_row(grey: Image, mean: Floats, variance: Floats, y: int, contrast: Floats) -> None:
    """That of row ``y``, ``grey`` and ``contrast`` (W,)."""
    above, below, share = _between(y, len(mean))
    rest = np.float32(1.0) - share
    for x in range(len(grey)):
        off = np.float32(grey[x]) - (rest * mean[above, x] + share * mean[below, x])
        contrast[x] = off / np.sqrt(rest * variance[above, x] + share * variance[below, x] + _FAINT)
