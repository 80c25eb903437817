"""Detector ``sift``: extrema of the difference of Gaussians (Lowe, IJCV 2004)."""

from collections.abc import Mapping

import numpy as np

from vioframe.hookspecs import hookimpl
from vioframe.interfaces import DetectorFactory
from vioframe.types import Image, Keypoints


class Sift:
    """``descriptors``: also compute the 128-vectors, which tracking does not use."""

    def __init__(
        self, *, contrast_threshold: float = 0.02, edge_threshold: float = 10.0, descriptors: bool = False
    ) -> None:
        import cv2

        # Without the precise upscale every point is 0.23 px off on both axes.
        self._sift = cv2.SIFT.create(
            contrastThreshold=contrast_threshold, edgeThreshold=edge_threshold, enable_precise_upscale=True
        )
        self._descriptors = descriptors

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """Sub-pixel blobs of all scales; where one has several orientations, only one stays."""
        import cv2

        found = sorted(self._sift.detect(image), key=lambda k: -k.response)
        at = {k.pt: k for k in reversed(found)}
        found = [k for k in found if at[k.pt] is k][:max_points]
        descriptors = None
        if self._descriptors:
            found, descriptors = self._sift.compute(image, found)
        xy = np.reshape(cv2.KeyPoint.convert(found), (-1, 2)).astype(np.float32)
        return Keypoints(xy, np.array([k.response for k in found], np.float32), descriptors)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"sift": Sift}
