"""Detector ``shi_tomasi``: corners by the smaller eigenvalue of the gradient matrix (Shi and Tomasi, CVPR 1994).

OpenCV's goodFeaturesToTrack finds the same; it takes most of its time for the eigenvalues, which go by several at once
here.
"""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from vioframe.frontend.distinct import distinct
from vioframe.interfaces import DetectorFactory
from vioframe.jit import kernel
from vioframe.parts.hooks import hookimpl
from vioframe.types import Image, Keypoints

# Gradients as Sobel's filter sums them, over the 3 x 3 pixels about each, in terms of grey levels from 0 to 1.
_SCALE = np.float32((1.0 / (4.0 * 3.0 * 255.0)) ** 2)
# Among the strongest peaks, so many times the points asked for, there nearly always are as many that keep their
# distance: then the order of the others is of no use.
_PEAKS_PER_POINT = 6
_HALF, _LOWER_HALF = np.uint64(32), np.uint64(0xFFFFFFFF)


class ShiTomasi:
    """Whole-pixel corners, spread by a smallest distance."""

    def __init__(
        self,
        *,
        quality_level: Annotated[float, "score of the weakest corner kept, relative to the strongest"] = 0.001,
        min_distance_px: Annotated[float, "smallest distance between corners"] = 10.0,
    ) -> None:
        self._quality_level = quality_level
        self._min_distance_px = min_distance_px

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` corners of ``image``, strongest first."""
        import cv2

        if min(image.shape) < 3:
            return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32))
        eigenvalue = _least_eigenvalue(*(np.asarray(d, np.int16) for d in cv2.spatialGradient(image)))
        peaks = _peaks(eigenvalue, eigenvalue.max() * np.float32(self._quality_level))
        score = eigenvalue.ravel()[peaks]
        # Strongest first, of equal ones the first: positive floats are in the order of their bits.
        keys = (~score.view(np.uint32)).astype(np.uint64) << _HALF | np.arange(len(peaks), dtype=np.uint64)
        for most in (_PEAKS_PER_POINT * max_points, len(keys)):
            strongest = np.sort(np.partition(keys, most)[:most] if most < len(keys) else keys)
            order = strongest & _LOWER_HALF
            rows, columns = np.divmod(peaks[order], image.shape[1])
            xy = np.column_stack([columns, rows]).astype(np.float32)
            taken = distinct(xy, self._min_distance_px, max_points)
            if len(taken) == max_points or most >= len(keys):
                break
        return Keypoints(xy[taken], score[order[taken]])


@kernel
def _least_eigenvalue(dx: NDArray[np.int16], dy: NDArray[np.int16]) -> NDArray[np.float32]:
    """(H, W) the smaller eigenvalue at each pixel; zero at the edge, where gradients would be those of reflections."""
    height, width = np.uint64(dx.shape[0]), np.uint64(dx.shape[1])
    one, two = np.uint64(1), np.uint64(2)
    out = np.zeros(dx.shape, np.float32)
    xx, xy, yy = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    for r in range(one, height - one):
        above, below = r - one, r + one
        for c in range(width):
            x0, x1, x2 = np.float32(dx[above, c]), np.float32(dx[r, c]), np.float32(dx[below, c])
            y0, y1, y2 = np.float32(dy[above, c]), np.float32(dy[r, c]), np.float32(dy[below, c])
            xx[c] = x0 * x0 + x1 * x1 + x2 * x2
            xy[c] = x0 * y0 + x1 * y1 + x2 * y2
            yy[c] = y0 * y0 + y1 * y1 + y2 * y2
        for k in range(width - two):
            m, n = k + one, k + two
            a = np.float32(0.5) * (xx[k] + xx[m] + xx[n])
            b = xy[k] + xy[m] + xy[n]
            c = np.float32(0.5) * (yy[k] + yy[m] + yy[n])
            out[r, m] = _SCALE * (a + c - np.sqrt((a - c) * (a - c) + b * b))
    return out


@kernel
def _peaks(eigenvalue: NDArray[np.float32], least: float) -> NDArray[np.int64]:
    """Places in the flattened image that are higher than ``least``, and than none of the eight about them is."""
    height, width = np.uint64(eigenvalue.shape[0]), np.uint64(eigenvalue.shape[1])
    one, two = np.uint64(1), np.uint64(2)
    # As many as there are pixels: where a pattern repeats itself, neighbours are equally high.
    out, n = np.empty(eigenvalue.size, np.int64), np.uint64(0)
    highest, is_peak = np.empty(width, np.float32), np.zeros(width, np.uint8)
    # Loops without branches: several pixels at once, and none guessed wrong.
    for r in range(one, height - one):
        above, here, below = eigenvalue[r - one], eigenvalue[r], eigenvalue[r + one]
        for c in range(width):
            of_two = above[c] if above[c] > below[c] else below[c]
            highest[c] = of_two if of_two > here[c] else here[c]
        for c in range(width - two):
            of_two = highest[c] if highest[c] > highest[c + two] else highest[c + two]
            v = here[c + one]
            is_peak[c + one] = (v >= of_two) & (v >= highest[c + one]) & (v > least)
        for c in range(one, width - one):
            out[n] = r * width + c
            n += np.uint64(is_peak[c])
    return out[:n]


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"shi_tomasi": ShiTomasi}
