"""Recognising standstill: what images and readings say when a body does not move.

The image decides, over half a second: a body that drifts slowly shows it in that time, while one that stands still but
shakes (motors, a hand nearby) does not, although its IMU reads far more than noise. The IMU must only not object.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from scipy.stats import chi2

from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DTHETA, DV, NS_PER_S, Float, FrameTracks, ImuNoise, ImuSegment, NavState, g_W

STANDSTILL_GATE = float(chi2.ppf(0.95, 9))
"""Squared Mahalanobis distance below which the readings agree with standstill."""
_MIN_COMMON_TRACKS = 10
_LOOK_BACK_NS = NS_PER_S // 2
_VELOCITY_SIGMA_M_S = 0.01
# A body that stands still may yet shake, so its readings scatter this many times more than the sensor's noise.
_SHAKING = 10.0


class StandstillDetector:
    """Tells from the tracks of the last half second whether the camera may be standing still."""

    def __init__(self, max_disparity_px: float) -> None:
        self._max_disparity_px = max_disparity_px
        self._recent: deque[FrameTracks] = deque()

    def sees_standstill(self, tracks: FrameTracks) -> bool:
        """Take in a frame's tracks; whether it shows the same picture as the frame half a second before it."""
        recent = self._recent
        recent.append(tracks)
        while len(recent) > 1 and tracks.t_ns - recent[1].t_ns >= _LOOK_BACK_NS:
            recent.popleft()
        if tracks.t_ns - recent[0].t_ns < _LOOK_BACK_NS:
            return False
        return median_disparity_px(recent[0], tracks) <= self._max_disparity_px


def median_disparity_px(before: FrameTracks, now: FrameTracks) -> float:
    """Median motion of the tracks common to both frames, px; infinite where there are too few to tell."""
    _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    if len(i) < _MIN_COMMON_TRACKS:
        return float("inf")
    return float(np.median(np.linalg.norm(now.xy[j] - before.xy[i], axis=1)))


def standstill_measurement(state: NavState, imu: ImuSegment, noise: ImuNoise) -> tuple[Float, Float, Float]:
    """Residual (9,), Jacobian (9, 15) at ``state``, and variances (9,) of: the body stood still over ``imu``.

    Standing still says: mean gyro = bias, mean accelerometer = -R_WB^T g + bias, velocity = 0.
    """
    up_B = -state.R_WB.T @ g_W
    H = np.zeros((9, 15))
    H[0:3, DBG] = np.eye(3)
    H[3:6, DTHETA], H[3:6, DBA] = so3.hat(up_B), np.eye(3)
    H[6:9, DV] = np.eye(3)
    residual = np.concatenate(
        [
            imu.gyro_B.mean(axis=0) - state.bias_gyro_B,
            imu.accel_B.mean(axis=0) - state.bias_accel_B - up_B,
            -state.v_WB,
        ]
    )
    density = _SHAKING * np.array([noise.gyro_density, noise.accel_density])
    sigma = np.append(density / np.sqrt(imu.duration_s), _VELOCITY_SIGMA_M_S)
    return residual, H, np.repeat(sigma**2, 3)
