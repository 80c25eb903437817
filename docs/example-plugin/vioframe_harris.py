"""A detector in one file: Harris corners (Harris and Stephens, 1988) at least a few pixels apart."""

from typing import Annotated

import numpy as np

from vioframe.parts.hooks import hookimpl
from vioframe.types import Image, Keypoints


class Harris:
    """Harris corners."""

    def __init__(
        self,
        *,
        k: Annotated[float, "weight of the trace in det - k trace^2"] = 0.04,
        quality: Annotated[float, "weakest corner kept, relative to the strongest"] = 0.01,
        min_distance_px: Annotated[float, "smallest distance between corners"] = 8.0,
    ) -> None:
        self._k, self._quality, self._min_distance_px = k, quality, min_distance_px

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` corners, strongest first."""
        import cv2

        xy, score = cv2.goodFeaturesToTrackWithQuality(
            image, max_points, self._quality, self._min_distance_px, None, useHarrisDetector=True, k=self._k
        )
        if xy is None:
            return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32))
        return Keypoints(xy.reshape(-1, 2), score.ravel())


@hookimpl
def vioframe_detectors():
    return {"harris": Harris}
