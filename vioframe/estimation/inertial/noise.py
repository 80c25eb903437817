"""How noisy inertial readings are, as they themselves show it."""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.errors import DivergedError
from vioframe.types import ImuNoise, ImuSegment

# What a body may do unseen while readings are missing, rad/s and m/s^2, and how long that can be bridged.
_UNSEEN_TURN, _UNSEEN_ACCELERATION, _MAX_IMU_GAP_S = 0.5, 2.0, 0.5
# Vibration is not white, and what shakes a sensor bends it, too: readings are off by more than they are rough by.
_BEYOND_ROUGHNESS = 2.0
# The few readings of a frame are rougher than the sensor's own noise by chance, but hardly by so much of its variance.
_BY_CHANCE = 2.0


def roughness(t_ns: Int, values: Float, order: int = 2) -> float:
    """The density of white noise that makes readings ``values`` (N, 3) at ``t_ns`` (N,) as rough as they are.

    By their differences of ``order`` n, in which the variance of white noise counts (2n)!/(n!)^2 times and a motion
    that is a polynomial of degree n - 1 not at all: 1 takes for noise what differs from one reading to the next, 2 only
    what lies off the middle of its neighbours. 0 where there are too few readings for that.
    """
    if len(t_ns) <= order:
        return 0.0
    between_ns, middle = np.sort(t_ns[1:] - t_ns[:-1]), len(t_ns) - 1
    dt_s = 0.5e-9 * float(between_ns[(middle - 1) // 2] + between_ns[middle // 2])  # np.median takes ten times as long
    for _ in range(order):
        values = values[1:] - values[:-1]
    return float(np.sqrt((values * values).mean() / comb(2 * order, order) * dt_s))


def noise_over(imu: ImuSegment, at_rest: ImuNoise, in_flight: ImuNoise) -> ImuNoise:
    """That of the readings ``imu``: the sensor's own, ``at_rest``, and what vibration adds, to ``in_flight`` at most.

    The sensor's own noise makes readings rough, too; what is rougher than that shakes. What shakes an accelerometer
    moves its bias as well: the walk of that grows as its white noise does.

    It is raised where readings are missing: the straight line drawn over a gap is only a guess. A rate that is off by w
    for a gap of T turns the body by w T, as white noise of density w sqrt(T) would. Raises :class:`DivergedError` where
    the gap is too long for that.
    """
    gap_s = imu.largest_gap_s
    if gap_s > _MAX_IMU_GAP_S:
        raise DivergedError(f"no inertial readings for {gap_s:.2f} s")
    gyro_times = _shaken(roughness(imu.t_ns, imu.gyro_B), at_rest.gyro_density)
    accel_times = _shaken(roughness(imu.t_ns, imu.accel_B), at_rest.accel_density)
    gyro = min(gyro_times * at_rest.gyro_density, in_flight.gyro_density)
    accel = min(accel_times * at_rest.accel_density, in_flight.accel_density)
    accel_walk = min(accel_times * at_rest.accel_walk, in_flight.accel_walk)
    if gap_s >= 5.0 / in_flight.rate_hz:
        gyro += _UNSEEN_TURN * gap_s**0.5
        accel += _UNSEEN_ACCELERATION * gap_s**0.5
    return replace(in_flight, gyro_density=gyro, accel_density=accel, accel_walk=accel_walk)


def _shaken(rough: float, own: float) -> float:
    """How many times its ``own`` noise a sensor is off by that is as ``rough`` as it is; once, if it is given none."""
    vibration = max((rough / own) ** 2 - _BY_CHANCE, 0.0) if own else 0.0
    return float(np.sqrt(1.0 + _BEYOND_ROUGHNESS**2 * vibration))
