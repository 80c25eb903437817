"""Holding the filter where the body stands still: the zero-velocity update."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.standstill import STANDSTILL_GATE, standstill_measurement
from vioframe.types import ImuNoise, ImuSegment
from vioframe_msckf.state import IMU, FilterState


def hold_still(state: FilterState, imu: ImuSegment, noise: ImuNoise, first_estimates: bool) -> bool:
    """Zero-velocity update, if the readings of ``imu`` agree with standstill; else the state is left as it is.

    The readings serve as measurements here and so do not propagate the pose as well.
    """
    now = state.nav_state(int(imu.t_ns[-1]))
    residual, H, variance = standstill_measurement(now, imu, noise)
    if first_estimates:
        _, H, _ = standstill_measurement(replace(now, R_WB=state.first[0]), imu, noise)
    S = H @ state.cov[:IMU, :IMU] @ H.T + np.diag(variance)
    if residual @ np.linalg.solve(S, residual) > STANDSTILL_GATE:
        return False
    state.drift_biases(imu.duration_s, noise)
    state.update_joseph(H, residual, variance)
    return True
