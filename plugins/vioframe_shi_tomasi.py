"""Detector ``shi_tomasi``: corners by the smaller eigenvalue of the gradient matrix (Shi and Tomasi, CVPR 1994)."""

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl
from vioframe.types import Image, Keypoints

_WINDOW_PX = 3
"""Side of the window that the gradients are summed over: OpenCV's default."""


class ShiTomasi:
    """Whole-pixel corners, spread by a smallest distance."""

    def __init__(
        self,
        *,
        quality_level: Annotated[float, "score of the weakest corner kept, relative to the strongest"] = 0.01,
        min_distance_px: Annotated[float, "smallest distance between corners"] = 10.0,
    ) -> None:
        self._quality_level = quality_level
        self._min_distance_px = min_distance_px

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` corners of ``image``, strongest first."""
        import cv2

        xy, score = cv2.goodFeaturesToTrackWithQuality(
            image, max_points, self._quality_level, self._min_distance_px, None, blockSize=_WINDOW_PX
        )
        if xy is None:
            return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32))
        return Keypoints(xy.reshape(-1, 2), score.ravel())


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"shi_tomasi": ShiTomasi}
