"""When an estimator must give up, and how it goes on: shared by all back-ends."""

from __future__ import annotations

import numpy as np

from vioframe.errors import DivergedError
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.types import NavState

# Beyond these an estimate is not merely inaccurate but wrong, whatever the covariance says.
_MAX_SPEED_M_S, _MAX_BIAS_GYRO, _MAX_BIAS_ACCEL = 30.0, 1.0, 2.5


def check_plausible(state: NavState) -> None:
    """Raise :class:`DivergedError` where speed or biases are beyond what any vehicle and any IMU have."""
    if not np.linalg.norm(state.v_WB) <= _MAX_SPEED_M_S:
        raise DivergedError(f"the speed exceeds {_MAX_SPEED_M_S:g} m/s")
    gyro, accel = np.linalg.norm(state.bias_gyro_B), np.linalg.norm(state.bias_accel_B)
    if not (gyro <= _MAX_BIAS_GYRO and accel <= _MAX_BIAS_ACCEL):
        raise DivergedError("the IMU's biases became implausible")


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
