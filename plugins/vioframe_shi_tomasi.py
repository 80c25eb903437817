"""Detector ``shi_tomasi``: corners by the smaller eigenvalue of the gradient matrix (Shi and Tomasi, CVPR 1994)."""

from collections.abc import Mapping

import numpy as np

from vioframe.hookspecs import hookimpl
from vioframe.interfaces import DetectorFactory
from vioframe.types import Image, Keypoints


class ShiTomasi:
    """``quality_level``: weakest corner kept, relative to the strongest; ``block_size_px``: side of the window summed."""

    def __init__(self, *, quality_level: float = 0.005, min_distance_px: float = 10.0, block_size_px: int = 3) -> None:
        self._quality_level = quality_level
        self._min_distance_px = min_distance_px
        self._block_size_px = block_size_px

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """Whole-pixel corners, at least ``min_distance_px`` apart."""
        import cv2

        xy, score = cv2.goodFeaturesToTrackWithQuality(
            image, max_points, self._quality_level, self._min_distance_px, None, blockSize=self._block_size_px
        )
        if xy is None:
            return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32))
        return Keypoints(xy.reshape(-1, 2), score.ravel())


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"shi_tomasi": ShiTomasi}
