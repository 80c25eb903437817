"""Following points from one image to the next."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.frontend.options import Equalisation
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.geometry.two_view import Mask, rays
from vioframe.types import Float, Image, ImuSegment

Pixels = NDArray[np.float32]

_ITERATIONS = 30
_EPSILON_PX = 0.01
# Smallest eigenvalue of a patch's gradient matrix, per pixel, below which it cannot be followed.
_MIN_EIGENVALUE = 1e-4


def equalise(image: Image, method: Equalisation) -> Image:
    """``image`` with its contrast spread: over 8 x 8 tiles (clahe, clip limit 3) or as a whole (histogram)."""
    import cv2

    if method == "clahe":
        return cv2.createCLAHE(3.0, (8, 8)).apply(image).astype(np.uint8, copy=False)
    if method == "histogram":
        return cv2.equalizeHist(image).astype(np.uint8, copy=False)
    return image


def camera_rotation(imu: ImuSegment, R_BC: Float) -> Float:
    """R_C2C1 (3, 3) from the segment's first stamp (C1) to its last (C2): gyroscope by the midpoint rule, bias ignored.

    An uncorrected bias of 0.1 rad/s is 5 mrad, two pixels, at 20 Hz: well within the reach of the tracker.
    """
    R_B1B2 = np.eye(3)
    for step in so3.exp(0.5 * (imu.gyro_B[1:] + imu.gyro_B[:-1]) * imu.dt[:, None]):
        R_B1B2 = R_B1B2 @ step
    R_C2C1: Float = R_BC.T @ R_B1B2.T @ R_BC
    return R_C2C1


def predict(camera: Camera, xy: Float, xy_normalised: Float, R_C2C1: Float) -> Float:
    """(N, 2) px where infinitely far points go when the camera turns; those that leave the view stay at ``xy``."""
    turned = rays(xy_normalised) @ R_C2C1.T
    ahead = turned[:, 2] > 0.1
    guess = xy.copy()
    guess[ahead] = camera.project(turned[ahead])
    seen = camera.contains(guess)
    guess[~seen] = xy[~seen]
    return guess


def follow(
    before: Image, after: Image, xy: Float, guess: Float, *, window_px: int, levels: int, tolerance_px: float
) -> tuple[Float, Mask]:
    """Pyramidal Lucas-Kanade from ``before`` to ``after``, checked by the way back.

    ``xy`` (N, 2) px in ``before``, ``guess`` (N, 2) px in ``after``. Returns (N, 2) px in ``after`` and (N,) whether
    the point was found and returned to within ``tolerance_px``. The way back starts as far from its answer as the way
    forth did, so that it is a test.
    """
    import cv2

    def search(image_1: Image, image_2: Image, start: Pixels, first: Pixels) -> tuple[Pixels, Mask]:
        # The Python binding takes images, not pyramids built before; building one costs 0.2 ms.
        found, status, _ = cv2.calcOpticalFlowPyrLK(
            image_1,
            image_2,
            start,
            first.copy(),
            winSize=(window_px, window_px),
            maxLevel=levels,
            criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ITERATIONS, _EPSILON_PX),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            minEigThreshold=_MIN_EIGENVALUE,
        )
        return np.asarray(found, np.float32), np.ravel(status) == 1

    start, first = xy.astype(np.float32), guess.astype(np.float32)
    found, forth = search(before, after, start, first)
    returned, back = search(after, before, found, np.asarray(found + (start - first), np.float32))
    ok: Mask = forth & back & (np.linalg.norm(returned - start, axis=1) < tolerance_px)
    return found.astype(np.float64), ok
