"""OpenCV's features as detectors: a plug-in creates the feature it wants and states its options."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vioframe.types import Image, Keypoints

if TYPE_CHECKING:
    import cv2

_SMALLEST_PX = 16
"""Shortest side of an image worth a look: with less, OpenCV's detectors raise and AKAZE writes beyond its memory."""


class OpenCvDetector:
    """Finds the keypoints of ``feature``; with ``descriptors`` those near the border, which have none, are left out."""

    def __init__(self, feature: cv2.Feature2D, descriptors: bool) -> None:
        self._feature = feature
        self._descriptors = descriptors

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` keypoints of ``image``, strongest first and each place once.

        A place comes more than once where several orientations or scales were found there; its strongest stays.
        """
        import cv2

        distinct: dict[Sequence[float], cv2.KeyPoint] = {}
        if min(image.shape) >= _SMALLEST_PX:
            for keypoint in sorted(self._feature.detect(image), key=lambda k: -k.response):
                distinct.setdefault(keypoint.pt, keypoint)
        found: Sequence[cv2.KeyPoint] = list(distinct.values())[:max_points]
        descriptors = None
        if self._descriptors:
            dtype = np.uint8 if self._feature.descriptorType() == cv2.CV_8U else np.float32
            descriptors = np.empty((0, self._feature.descriptorSize()), dtype)
            if found:
                found, descriptors = self._feature.compute(image, found)
        xy = np.reshape(cv2.KeyPoint.convert(found), (-1, 2)).astype(np.float32)
        return Keypoints(xy, np.array([k.response for k in found], np.float32), descriptors)
