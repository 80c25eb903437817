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
        self._contrast, self._steps = np.empty((rows, columns), np.float32), np.empty((rows, columns), np.uint8)
        f = self._fold
        self._seen = np.empty((f * f, rows // f, columns // f), np.uint8 if self._eight_bits else np.float32)
        self._coarse, self._means = (np.empty((rows // COARSE_PX, columns // COARSE_PX), np.float32) for _ in range(2))
        self._around = np.empty((rows // COARSE_PX, columns), np.float32)

    def __call__(self, image: Image) -> Floats | Image:
        if self._fold == 1:
            return image[None]
        rows, columns = image.shape
        f = self._fold
        if image.shape != self._contrast.shape:
            self._make_room(rows, columns)
        _means(image, self._coarse)
        _take_away(image, self._smoothed(), self._contrast, self._coarse)
        _divide(self._contrast, self._smoothed(), _FAINT)
        if self._eight_bits:
            _round(self._contrast, np.float32(1.0) / CONTRAST_STEP, self._steps)
            # The pixels of a row that one place holds are one whole number, of which a cast takes the lowest.
            places = self._steps.view(f"<u{f}").reshape(rows // f, f, columns // f).swapaxes(0, 1)
            for k in range(f):
                np.right_shift(places, 8 * k, out=self._seen[k::f], casting="unsafe")
        else:
            by_place = self._contrast.reshape(rows // f, f, columns // f, f).transpose(1, 3, 0, 2)
            self._seen.reshape(f, f, rows // f, columns // f)[:] = by_place
        return self._seen

    def _smoothed(self) -> Floats:
        """(H/4, W): the mean of the coarse values around each, interpolated within the rows; kernels do it between."""
        import cv2

        cv2.blur(self._coarse, (_AROUND, _AROUND), self._means, borderType=cv2.BORDER_REPLICATE)
        cv2.resize(self._means, self._around.shape[::-1], self._around, interpolation=cv2.INTER_LINEAR)
        return self._around


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
def _take_away(image: Image, mean: Floats, off: Floats, variance: Floats) -> None:
    """``off`` (H, W) becomes the image less its local ``mean``, ``variance`` the mean square of each 4 x 4 px."""
    rows, columns = variance.shape
    total = np.empty(image.shape[1], np.float32)
    for r in range(rows):
        total[:] = 0.0
        for y in range(COARSE_PX * r, COARSE_PX * (r + 1)):
            above, below, share = _between(y, rows)
            rest = np.float32(1.0) - share
            for x in range(len(total)):
                difference = np.float32(image[y, x]) - (rest * mean[above, x] + share * mean[below, x])
                off[y, x] = difference
                total[x] += difference * difference
        for c in range(columns):
            x = COARSE_PX * c
            variance[r, c] = (total[x] + total[x + 1] + total[x + 2] + total[x + 3]) / np.float32(16.0)


@kernel
def _divide(off: Floats, variance: Floats, faint: np.float32) -> None:
    """Divide ``off`` (H, W) by the local deviation."""
    for y in range(off.shape[0]):
        above, below, share = _between(y, len(variance))
        rest = np.float32(1.0) - share
        for x in range(off.shape[1]):
            off[y, x] /= np.sqrt(rest * variance[above, x] + share * variance[below, x] + faint)


@kernel
def _round(contrast: Floats, per_step: np.float32, steps: Image) -> None:
    """Fill ``steps`` (H, W) with ``contrast`` in 8 bits."""
    for y in range(contrast.shape[0]):
        for x in range(contrast.shape[1]):
            rounded = contrast[y, x] * per_step + np.float32(ZERO + 0.5)
            # By way of int32, as processors convert no vector of floats to bytes.
            steps[y, x] = np.uint8(np.int32(min(max(rounded, np.float32(0.0)), np.float32(255.0))))
