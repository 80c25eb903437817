"""What every detector that wraps one of OpenCV's has in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vioframe.types import Image, Keypoints

if TYPE_CHECKING:
    import cv2

_SMALLEST_PX = 16
"""Shortest side of an image worth a look: with less, OpenCV's detectors raise and AKAZE writes beyond its memory."""


def detect(feature: cv2.Feature2D, image: Image, max_points: int, *, descriptors: bool = False) -> Keypoints:
    """At most ``max_points`` keypoints of ``image`` by one of OpenCV's detectors, strongest first.

    With ``descriptors`` those near the border, which have none, are left out.
    """
    import cv2

    found: Sequence[cv2.KeyPoint] = ()
    if min(image.shape) >= _SMALLEST_PX:
        found = strongest(feature.detect(image), max_points)
    described = None
    if descriptors:
        dtype = np.uint8 if feature.descriptorType() == cv2.CV_8U else np.float32
        described = np.empty((0, feature.descriptorSize()), dtype)
        if found:
            found, described = feature.compute(image, found)
    xy = np.reshape(cv2.KeyPoint.convert(found), (-1, 2)).astype(np.float32)
    return Keypoints(xy, np.array([k.response for k in found], np.float32), described)


def strongest(found: Sequence[cv2.KeyPoint], max_points: int) -> list[cv2.KeyPoint]:
    """At most ``max_points`` of ``found``, strongest first and each place once.

    A place comes more than once where several orientations or scales were found there; its strongest stays.
    """
    distinct: dict[tuple[float, float], cv2.KeyPoint] = {}
    for keypoint in sorted(found, key=lambda k: -k.response):
        distinct.setdefault((keypoint.pt[0], keypoint.pt[1]), keypoint)
    return list(distinct.values())[:max_points]
