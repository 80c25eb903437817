"""Recognising standstill, and holding the filter there: the zero-velocity update."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DTHETA, DV, Float, FrameTracks, ImuNoise, ImuSegment, g_W
from vioframe_msckf.state import IMU, FilterState

_MIN_COMMON_TRACKS = 10
_GATE = float(chi2.ppf(0.95, 9))
_VELOCITY_SIGMA_M_S = 0.01
# A motor or a hand shakes a body that stands still: readings may scatter this many times more than the sensor's noise.
_SHAKING = 3.0


def median_disparity_px(before: FrameTracks, now: FrameTracks) -> float:
    """Median motion of the tracks common to both frames, px; infinite where there are too few to tell."""
    _, i, j = np.intersect1d(before.ids, now.ids, assume_unique=True, return_indices=True)
    if len(i) < _MIN_COMMON_TRACKS:
        return float("inf")
    return float(np.median(np.linalg.norm(now.xy[j] - before.xy[i], axis=1)))


def hold_still(state: FilterState, imu: ImuSegment, noise: ImuNoise, first_estimates: bool) -> bool:
    """Zero-velocity update, if the readings of ``imu`` agree with standstill; else the state is left as it is.

    Standing still says: mean gyro = bias, mean accelerometer = -R_WB^T g + bias, velocity = 0. The readings serve as
    measurements here and so do not propagate the pose as well.
    """
    H, residual, variance = standstill_measurement(state, imu, noise, first_estimates)
    S = H @ state.cov[:IMU, :IMU] @ H.T + np.diag(variance)
    if residual @ np.linalg.solve(S, residual) > _GATE:
        return False
    state.drift_biases(imu.duration_s, noise)
    state.update(H, residual, slice(0, IMU), variance)
    return True


def standstill_measurement(
    state: FilterState, imu: ImuSegment, noise: ImuNoise, first_estimates: bool
) -> tuple[Float, Float, Float]:
    """What standing still says: mean gyro = bias, mean accelerometer = -g + bias, velocity = 0.

    Returns H (9, 15) over the body's error state, the residual (9,) and its variances (9,). The readings serve as
    measurements here and so must not also propagate the pose.
    """
    R = state.first[0] if first_estimates else state.R_WB
    duration = max(imu.duration_s, 1.0 / noise.rate_hz)
    H = np.zeros((9, IMU))
    H[0:3, DBG] = np.eye(3)
    H[3:6, DTHETA], H[3:6, DBA] = so3.hat(-R.T @ g_W), np.eye(3)
    H[6:9, DV] = np.eye(3)
    residual = np.concatenate(
        [
            imu.gyro_B.mean(axis=0) - state.bias_gyro_B,
            imu.accel_B.mean(axis=0) - state.bias_accel_B + state.R_WB.T @ g_W,
            -state.v_WB,
        ]
    )
    variance = np.repeat(
        [
            (_SHAKING * noise.gyro_density) ** 2 / duration,
            (_SHAKING * noise.accel_density) ** 2 / duration,
            _VELOCITY_SIGMA_M_S**2,
        ],
        3,
    )
    return H, residual, variance
