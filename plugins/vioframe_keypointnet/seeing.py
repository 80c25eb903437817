"""What a network sees of an image on a CPU: the grey levels, or, for a network of peaks, local contrast, folded."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.jit import kernel
from vioframe.types import Image
from vioframe_keypointnet.architecture import FAINT, Architecture

COARSE_PX = 4
"""Side of the squares of pixels whose means the local means are made of."""
ZERO = 128
"""What stands for 0 in 8 bits; also the whole grey level nearest to the neutral one."""
CONTRAST_STEP = np.float32(6.0 / 127.0)
"""Of local contrast in 8 bits, which end at 6 deviations: what lies farther out is noise on a blank surface."""

_FAINT = np.float32((255.0 * FAINT) ** 2)
_AROUND = 5
"""So many squares along either axis make a local mean."""

Floats = NDArray[np.float32]


class Eye:
    """Sees images whose sides are multiples of 8; what it gives stays as it is until the next image.

    The grey levels themselves, (1, H, W); for a network of peaks the local contrast of
    :func:`vioframe_keypointnet.network.locally_normalised`, f x f pixels folded, (f^2, H/f, W/f), or, in
    ``eight_bits``, steps of :data:`CONTRAST_STEP` from :data:`ZERO`.
    """

    def __init__(self, architecture: Architecture, *, eight_bits: bool) -> None:
        self._fold, self._eight_bits = architecture.fold, eight_bits
        self._make_room(0, 0)

    def _make_room(self, rows: int, columns: int) -> None:
        """Arrays for images of one size: as new ones each time they would take longer than what fills them."""
        self._contrast = np.empty((rows, columns), np.uint8 if self._eight_bits else np.float32)
        f = self._fold
        self._seen = np.empty((f * f, rows // f, columns // f), np.uint8 if self._eight_bits else np.float32)
        self._coarse, self._means = (np.empty((rows // COARSE_PX, columns // COARSE_PX), np.float32) for _ in range(2))
        self._mean, self._variance = (np.empty((rows // COARSE_PX, columns), np.float32) for _ in range(2))

    def __call__(self, image: Image) -> Floats | Image:
        if self._fold == 1:
            return image[None]
        rows, columns = image.shape
        f = self._fold
        if image.shape != self._contrast.shape:
            self._make_room(rows, columns)
        _means(image, self._coarse)
        self._smooth(self._mean)
        _variances(image, self._mean, self._coarse)
        self._smooth(self._variance)
        if self._eight_bits:
            _contrast_in_steps(image, self._mean, self._variance, self._contrast)
            # The pixels of a row that one place holds are one whole number, of which a cast takes the lowest.
            places = self._contrast.view(f"<u{f}").reshape(rows // f, f, columns // f).swapaxes(0, 1)
            for k in range(f):
                np.right_shift(places, 8 * k, out=self._seen[k::f], casting="unsafe")
        else:
            _contrast(image, self._mean, self._variance, self._contrast)
            by_place = self._contrast.reshape(rows // f, f, columns // f, f).transpose(1, 3, 0, 2)
            self._seen.reshape(f, f, rows // f, columns // f)[:] = by_place
        return self._seen

    def _smooth(self, around: Floats) -> None:
        """Fill ``around`` (H/4, W) with the mean of the coarse values about each, interpolated within the rows; kernels
        do it between."""
        import cv2

        cv2.blur(self._coarse, (_AROUND, _AROUND), self._means, borderType=cv2.BORDER_REPLICATE)
        cv2.resize(self._means, around.shape[::-1], around, interpolation=cv2.INTER_LINEAR)


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
def _contrast(image: Image, mean: Floats, variance: Floats, contrast: Floats) -> None:
    """Fill ``contrast`` (H, W) with the image less its local mean, over the local deviation."""
    for y in range(len(image)):
        _contrast_of_row(image[y], mean, variance, y, contrast[y])


@kernel
def _contrast_in_steps(image: Image, mean: Floats, variance: Floats, steps: Image) -> None:
    """The same in 8 bits."""
    contrast = np.empty(image.shape[1], np.float32)
    per_step = np.float32(1.0) / CONTRAST_STEP
    for y in range(len(image)):
        _contrast_of_row(image[y], mean, variance, y, contrast)
        for x in range(len(contrast)):
            rounded = contrast[x] * per_step + np.float32(ZERO + 0.5)
            # By way of int32, as processors convert no vector of floats to bytes.
            steps[y, x] = np.uint8(np.int32(min(max(rounded, np.float32(0.0)), np.float32(255.0))))


@kernel(inlined=True)
def _contrast_of_row(grey: Image, mean: Floats, variance: Floats, y: int, contrast: Floats) -> None:
    """That of row ``y``, ``grey`` and ``contrast`` (W,)."""
    above, below, share = _between(y, len(mean))
    rest = np.float32(1.0) - share
    for x in range(len(grey)):
        off = np.float32(grey[x]) - (rest * mean[above, x] + share * mean[below, x])
        contrast[x] = off / np.sqrt(rest * variance[above, x] + share * variance[below, x] + _FAINT)
