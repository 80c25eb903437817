"""Detector ``orb``: oriented FAST over a scale pyramid, ranked by Harris (Rublee et al., ICCV 2011)."""

from collections.abc import Mapping

import numpy as np

from vioframe.hookspecs import hookimpl
from vioframe.interfaces import DetectorFactory
from vioframe.types import Image, Keypoints


class Orb:
    """``descriptors``: also compute the 32-byte BRIEF descriptors, which tracking does not use."""

    def __init__(
        self, *, fast_threshold: int = 20, levels: int = 8, scale_factor: float = 1.2, descriptors: bool = False
    ) -> None:
        import cv2

        self._orb = cv2.ORB.create(nlevels=levels, scaleFactor=scale_factor, fastThreshold=fast_threshold)
        self._descriptors = descriptors

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """Corners of all levels at full resolution; those of coarser levels are off the pixel grid."""
        import cv2

        self._orb.setMaxFeatures(max_points)
        found = self._orb.detect(image)
        # compute() may drop points at the border, but keeps the order of the others.
        found = sorted(found, key=lambda k: -k.response)[:max_points]
        descriptors = None
        if self._descriptors:
            found, descriptors = self._orb.compute(image, found)
        xy = np.reshape(cv2.KeyPoint.convert(found), (-1, 2)).astype(np.float32)
        return Keypoints(xy, np.array([k.response for k in found], np.float32), descriptors)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"orb": Orb}
