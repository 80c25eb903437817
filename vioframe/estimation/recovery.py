"""When an estimator must give up, and how it goes on: shared by all back-ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.errors import DivergedError
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.types import ImuNoise, ImuSegment, NavState

# What a body may do unseen while readings are missing, rad/s and m/s^2, and how long that can be bridged.
_UNSEEN_TURN, _UNSEEN_ACCELERATION, _MAX_IMU_GAP_S = 0.5, 2.0, 0.5
# Beyond these an estimate is not merely inaccurate but wrong, whatever the covariance says.
_MAX_SPEED_M_S, _MAX_BIAS_GYRO, _MAX_BIAS_ACCEL = 30.0, 1.0, 2.5


def check_plausible(state: NavState) -> None:
    """Raise :class:`DivergedError` where speed or biases are beyond what any vehicle and any IMU have."""
    if not np.linalg.norm(state.v_WB) <= _MAX_SPEED_M_S:
        raise DivergedError(f"the speed exceeds {_MAX_SPEED_M_S:g} m/s")
    gyro, accel = np.linalg.norm(state.bias_gyro_B), np.linalg.norm(state.bias_accel_B)
    if not (gyro <= _MAX_BIAS_GYRO and accel <= _MAX_BIAS_ACCEL):
        raise DivergedError("the IMU's biases became implausible")


def noise_over(imu: ImuSegment, noise: ImuNoise) -> ImuNoise:
    """``noise``, raised where readings are missing: the straight line drawn over a gap is only a guess.

    A rate that is off by w for a gap of T turns the body by w T, as white noise of density w sqrt(T) would. Raises
    :class:`DivergedError` where the gap is too long for that.
    """
    gap_s = imu.largest_gap_s
    if gap_s > _MAX_IMU_GAP_S:
        raise DivergedError(f"no inertial readings for {gap_s:.2f} s")
    if gap_s < 5.0 / noise.rate_hz:
        return noise
    return replace(
        noise,
        gyro_density=noise.gyro_density + _UNSEEN_TURN * gap_s**0.5,
        accel_density=noise.accel_density + _UNSEEN_ACCELERATION * gap_s**0.5,
    )


def continued_from(last: NavState, initial: NavState) -> NavState:
    """``initial``, which begins at a world origin of its own, placed at the position and yaw where ``last`` ended."""
    R = rotation_z(float(yaw_of(last.R_WB @ initial.R_WB.T)))
    cov = initial.cov
    if cov is not None:
        G = np.eye(15)
        G[3:6, 3:6] = G[6:9, 6:9] = R
        cov = G @ cov @ G.T
    return NavState(
        initial.t_ns,
        R @ initial.R_WB,
        last.p_WB,
        R @ initial.v_WB,
        initial.bias_gyro_B,
        initial.bias_accel_B,
        cov,
    )
