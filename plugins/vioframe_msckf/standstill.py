"""Holding the filter where the body stands still: the zero-velocity update."""

from __future__ import annotations

import numpy as np

from vioframe.estimation.standstill import STANDSTILL_GATE, Standstill
from vioframe.types import ImuNoise, ImuSegment
from vioframe_msckf.state import IMU, FilterState


def hold_still(state: FilterState, imu: ImuSegment, noise: ImuNoise, first_estimates: bool) -> bool:
    """Zero-velocity update, if the readings of ``imu`` agree with standstill; else the state is left as it is.

    The readings serve as measurements here and so do not propagate the pose as well.
    """
    still = Standstill.over(imu, noise)
    residual = still.residual(state.R_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B)
    H = still.jacobian(state.first[0] if first_estimates else state.R_WB)
    variance = still.sigma**2
    S = H @ state.cov[:IMU, :IMU] @ H.T + np.diag(variance)
    if residual @ np.linalg.solve(S, residual) > STANDSTILL_GATE:
        return False
    state.drift_biases(imu.duration_s, noise)
    state.update_joseph(H, residual, variance)
    return True
