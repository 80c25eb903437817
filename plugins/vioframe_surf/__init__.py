"""Detector ``surf``: maxima of the Hessian's determinant by box filters (Bay, Ess, Tuytelaars and Van Gool, CVIU 2008).

OpenCV's wheels come without SURF, so that of mahotas is used, with two corrections:

- its octaves leave 64 px, then 248 px free at the border; an octave here is the finest one on a halved image, which is
  the same filter at less cost and leaves 36 px, then 72 px;
- it refines a maximum by Newton's step with the wrong sign, so that points lie on the wrong side of their pixel. As the
  step is less than half a pixel, the pixel is known and the point is put on the other side.
"""

from collections.abc import Iterator, Mapping
from typing import Annotated

import numpy as np
from pydantic import NonNegativeFloat, PositiveInt

from vioframe.errors import needs
from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl
from vioframe.types import Float, Image, Keypoints
from vioframe_surf.descriptors import describe

_FILTERS = 4
"""Filter sizes an octave, 9, 15, 21 and 27 px: maxima are those of the middle two, which meet the next octave's."""

_SMALLEST_PX = 37
"""The margin is 18 px: in smaller images nothing can be found."""

# Columns of what mahotas returns.
_PLACE = slice(1, None, -1)
_SCALE = 2
_SCORE = 3


class Surf:
    """Sub-pixel blobs of several scales, at least 18 px from the border."""

    def __init__(
        self,
        *,
        threshold: Annotated[NonNegativeFloat, "weakest determinant kept, grey levels squared; lower finds more"] = 1.0,
        octaves: Annotated[PositiveInt, "how often the resolution is halved, plus one; more finds larger blobs"] = 2,
        descriptors: Annotated[bool, "also compute the 64-vectors, which tracking does not use"] = False,
    ) -> None:
        with needs("mahotas", "surf", user="detector 'surf'"):
            from mahotas.features import surf
        self._surf = surf
        self._threshold = threshold
        self._octaves = octaves
        self._descriptors = descriptors

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` blobs of ``image``, strongest first."""
        found = [np.empty((0, 5))]
        for size_px, octave in self._pyramid(image):
            points = self._finest(octave, max_points)
            points[:, :2] = (points[:, :2] + 0.5) * size_px - 0.5
            points[:, _SCALE] *= size_px
            found.append(points)
        every = np.concatenate(found)
        best = every[np.argsort(-every[:, _SCORE], kind="stable")[:max_points]]
        xy = best[:, _PLACE]
        descriptors = describe(image, xy, best[:, _SCALE]) if self._descriptors else None
        return Keypoints(xy.astype(np.float32), best[:, _SCORE].astype(np.float32), descriptors)

    def _pyramid(self, image: Image) -> Iterator[tuple[int, Float]]:
        """Each octave's image with the size of its pixels."""
        octave: Float = image.astype(np.float64)
        for number in range(self._octaves):
            if min(octave.shape) < _SMALLEST_PX:
                return
            yield 2**number, octave
            height, width = octave.shape[0] // 2, octave.shape[1] // 2
            octave = octave[: 2 * height, : 2 * width].reshape(height, 2, width, 2).mean(axis=(1, 3))

    def _finest(self, octave: Float, max_points: int) -> Float:
        """(N, 5) of one octave, in its own pixels: y, x, scale, score, sign of the Laplacian."""
        integral = self._surf.integral(octave)
        points: Float = self._surf.interest_points(
            integral, 1, _FILTERS, 1, self._threshold, max_points, is_integral=True
        )
        points[:, :2] = 2.0 * np.round(points[:, :2]) - points[:, :2]
        return points


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"surf": Surf}
