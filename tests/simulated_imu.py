"""Dead reckoning along flights, for tests of those."""

import numpy as np
from scipy.interpolate import CubicSpline

from vioframe.estimation.inertial.propagation import propagate
from vioframe.interfaces import Flight
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation.imu import read_imu
from vioframe.types import ImuSegment

RATE_HZ = 200.0
_NOISE = packaged_calibration("euroc", cameras=["cam0"]).imu


def dead_reckoning_error_m(flight: Flight, duration_s: float = 10.0, between: int = 5) -> float:
    """How far exact readings at 200 Hz lead away from ``flight``.

    Propagation takes readings as linear from one to the next, which costs some millimetres in 10 s of fast flight at
    this rate; so it is given ``between`` times as many, from the cubic spline through the 200 a second.
    """
    t_s = np.arange(int(duration_s * RATE_HZ) + 1) / RATE_HZ
    motion = flight.at(t_s)
    readings = read_imu(motion, None, np.random.default_rng(0), RATE_HZ)
    fine_s = np.arange((len(t_s) - 1) * between + 1) / (RATE_HZ * between)
    fine_ns = np.round(fine_s * 1e9).astype(np.int64)
    gyro_B, accel_B = (CubicSpline(t_s, x)(fine_s) for x in (readings.gyro_B, readings.accel_B))
    R, p, v = motion.R_WB[0], motion.p_WB[0], motion.v_WB[0]
    worst = 0.0
    for k in range(len(t_s) - 1):
        part = slice(k * between, (k + 1) * between + 1)
        segment = ImuSegment(fine_ns[part], gyro_B[part], accel_B[part])
        there = propagate(segment, R, p, v, np.zeros(3), np.zeros(3), _NOISE)
        R, p, v = there.R_WB, there.p_WB, there.v_WB
        worst = max(worst, float(np.linalg.norm(p - motion.p_WB[k + 1])))
    return worst
