"""Following points from one image to the next."""

from __future__ import annotations

import numpy as np

from vioframe.frontend.lucas_kanade import Pyramid, search
from vioframe.geometry import kernels
from vioframe.geometry.cameras import Camera
from vioframe.geometry.two_view import Mask, rays
from vioframe.types import Float, ImuSegment

# Above the full images, on the way back.
_LEVELS_BACK = 2


def body_rotation(imu: ImuSegment) -> Float:
    """R_B1B2 (3, 3) from the segment's last stamp (B2) to its first (B1): gyroscope by the midpoint rule, bias ignored.

    An uncorrected bias of 0.1 rad/s is 5 mrad, two pixels, at 20 Hz: well within the reach of the tracker.
    """
    R_B1B2 = np.eye(3)
    for step in 0.5 * (imu.gyro_B[1:] + imu.gyro_B[:-1]) * imu.dt[:, None]:
        R_B1B2 = R_B1B2 @ kernels.exp(step)
    return R_B1B2


def predict(camera: Camera, xy: Float, xy_normalised: Float, R_C2C1: Float) -> Float:
    """(N, 2) px where infinitely far points go when the camera turns; those that leave the view stay at ``xy``."""
    guess, in_view = projected(camera, rays(xy_normalised) @ R_C2C1.T)
    guess[~in_view] = xy[~in_view]
    return guess


def projected(camera: Camera, p_C: Float) -> tuple[Float, Mask]:
    """(N, 2) px of points (N, 3), whose distance does not matter, and which of them are in the image (N,)."""
    ahead = p_C[:, 2] > 0.1
    xy = camera.project(np.where(ahead[:, None], p_C, [0.0, 0.0, 1.0]))
    return xy, ahead & camera.contains(xy)


def follow(before: Pyramid, after: Pyramid, xy: Float, guess: Float) -> tuple[Float, Mask]:
    """Lucas-Kanade from ``before`` to ``after``: where ``xy`` (N, 2) px went, and which of them were found (N,).

    ``guess`` (N, 2) px is where in ``after`` to begin. What is found may be something else: see :func:`returns`.
    """
    found, ok = search(before, after, xy.astype(np.float32), guess.astype(np.float32))
    return found.astype(np.float64), ok


def returns(before: Pyramid, after: Pyramid, xy: Float, found: Float, tolerance_px: float) -> Mask:
    """Which of ``found`` (N, 2) px in ``after`` come back to within ``tolerance_px`` of ``xy`` (N, 2) px in ``before``.

    The way back starts at the answer, in images a quarter as fine: a patch that is another one does not stay there.
    """
    returned, back = search(after, before, found.astype(np.float32), xy.astype(np.float32), levels=_LEVELS_BACK)
    ok: Mask = back & (np.linalg.norm(returned - xy, axis=1) < tolerance_px)
    return ok
