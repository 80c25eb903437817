"""How noisy inertial readings are, as they themselves show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.errors import DivergedError
from vioframe.types import ImuNoise, ImuSegment

# What a body may do unseen while readings are missing, rad/s and m/s^2, and how long that can be bridged.
_UNSEEN_TURN, _UNSEEN_ACCELERATION, _MAX_IMU_GAP_S = 0.5, 2.0, 0.5
# What readings are off by over what they jump by: vibration is not white, and alignment and scale are off, too.
_BEYOND_JUMPS = 2.0


def jumps(t_ns: Int, values: Float) -> float:
    """The density of white noise that makes readings ``values`` (N, 3) at ``t_ns`` (N,) jump as they do.

    Half the squared difference of two neighbours is that of the noise where the body's motion is smooth.
    """
    dt_s = float(np.median(np.diff(t_ns))) * 1e-9
    return float(np.sqrt(0.5 * (np.diff(values, axis=0) ** 2).mean() * dt_s))


def noise_over(imu: ImuSegment, at_rest: ImuNoise, in_flight: ImuNoise) -> ImuNoise:
    """That of the readings ``imu``: by how they jump, no less than ``at_rest`` and no more than ``in_flight``.

    It is raised where readings are missing: the straight line drawn over a gap is only a guess. A rate that is off by w
    for a gap of T turns the body by w T, as white noise of density w sqrt(T) would. Raises :class:`DivergedError` where
    the gap is too long for that.
    """
    gap_s = imu.largest_gap_s
    if gap_s > _MAX_IMU_GAP_S:
        raise DivergedError(f"no inertial readings for {gap_s:.2f} s")
    gyro = _within(_BEYOND_JUMPS * jumps(imu.t_ns, imu.gyro_B), at_rest.gyro_density, in_flight.gyro_density)
    accel = _within(_BEYOND_JUMPS * jumps(imu.t_ns, imu.accel_B), at_rest.accel_density, in_flight.accel_density)
    if gap_s >= 5.0 / in_flight.rate_hz:
        gyro += _UNSEEN_TURN * gap_s**0.5
        accel += _UNSEEN_ACCELERATION * gap_s**0.5
    return replace(in_flight, gyro_density=gyro, accel_density=accel)


def _within(value: float, least: float, most: float) -> float:
    return min(max(value, least), most)
