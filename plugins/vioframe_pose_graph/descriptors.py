"""What a keyframe looks like: 256-bit descriptors of its tracked features and of further corners.

The bit tests are ORB's (Rublee et al., ICCV 2011), but turned by the camera's attitude instead of by the patch's own
moments: the odometry knows which way is down, and better than a patch of 31 pixels does.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float, Image, Int

Words = NDArray[np.uint64]

_LEVELS, _SCALE_FACTOR, _FAST_THRESHOLD = 4, 1.3, 12
_PATCH_PX = 31
# Sine of the angle between the optical axis and the vertical below which the world's x axis says what is up.
_STEEP = 0.35


class Describer:
    """Finds up to ``max_corners`` corners and describes them together with those that are given."""

    def __init__(self, max_corners: int) -> None:
        self._orb = cv2.ORB.create(
            max_corners, _SCALE_FACTOR, _LEVELS, patchSize=_PATCH_PX, fastThreshold=_FAST_THRESHOLD
        )

    def describe(self, image: Image, xy: Float, R_WC: Float) -> tuple[Float, Words, Int]:
        """Points (K, 2) px, their descriptors (K, 4), and (K,) which of the given ``xy`` (N, 2) px each is, or -1.

        Points too near to the border to be described are left out. ``R_WC`` is the camera's attitude.
        """
        angle = image_angle_deg(R_WC)
        given = [cv2.KeyPoint(x, y, _PATCH_PX, angle, 0, 0, i) for i, (x, y) in enumerate(xy.tolist())]
        found = list(self._orb.detect(image))
        for corner in found:
            corner.angle = angle
            corner.class_id = -1
        kept, descriptors = self._orb.compute(image, given + found)
        if descriptors is None:
            return np.empty((0, 2)), np.empty((0, 4), np.uint64), np.empty(0, np.int64)
        places = np.array([corner.pt for corner in kept])
        return places, descriptors.view(np.uint64), np.array([corner.class_id for corner in kept], np.int64)


def image_angle_deg(R_WC: Float) -> float:
    """Direction in the image, degrees from its x axis towards its y axis, that stands for the same one in the world.

    It is that of gravity, and of the world's x axis where the camera looks steeply up or down.
    """
    direction_C = R_WC[2] if np.hypot(R_WC[2, 0], R_WC[2, 1]) > _STEEP else R_WC[0]
    return float(np.degrees(np.arctan2(-direction_C[1], -direction_C[0])))
