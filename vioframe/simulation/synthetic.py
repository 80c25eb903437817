"""Track sequences of simulated flights, whose every true state is known exactly."""

from __future__ import annotations

import numpy as np

from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Flight
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation.flights import flight as named_flight
from vioframe.simulation.imu import ImuErrors, Vector, read_imu
from vioframe.simulation.segments import cut_segments
from vioframe.simulation.sequence import TrackSequence
from vioframe.simulation.tracks import TrackOptions, TrackSimulator
from vioframe.types import NS_PER_S, Calibration, Float, ImuNoise, NavState

EUROC_NOISE = ImuNoise(
    gyro_density=1.6968e-4, accel_density=2.0e-3, gyro_walk=1.9393e-5, accel_walk=3.0e-3, rate_hz=200.0
)
"""That of the ADIS16448 in EuRoC's sensor, as published."""

_START_NS = NS_PER_S  # Time zero is a trap for code that takes 0 for "none".


def simulated_sequence(
    flight: str | Flight,
    noise: ImuNoise | None = EUROC_NOISE,
    pixel_sigma: float = 1.0,
    seed: int = 0,
    duration_s: float | None = None,
    *,
    outlier_ratio: float = 0.0,
    max_points: int = 150,
    calibration: Calibration | None = None,
    frame_rate_hz: float = 20.0,
    bias_gyro_B: Float | None = None,
    bias_accel_B: Float | None = None,
) -> TrackSequence:
    """Fly ``flight``, an installed one of that name or one's own, for ``duration_s`` seconds.

    Left out, that is 30 s, or as long as one's own flight lasts. ``noise`` None gives exact readings at the
    calibration's rate, and ``calibration`` None is EuRoC's. The first biases (3,) are zero unless given. The same
    arguments give the same sequence to the last bit. Readings at the frames' stamps are interpolated as those of a
    recording would be, unless the frame rate divides the IMU's.
    """
    calibration = calibration or packaged_calibration("euroc")
    imu_rng, track_rng = (np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(2))
    rate_hz = (noise or calibration.imu).rate_hz
    if isinstance(flight, str):
        duration_s = 30.0 if duration_s is None else duration_s
        path = named_flight(flight, duration_s, calibration.R_BC)
    else:
        duration_s = flight.duration_s if duration_s is None else min(duration_s, flight.duration_s)
        path = flight

    frames_s = np.arange(int(duration_s * frame_rate_hz) + 1) / frame_rate_hz
    imu_s = np.arange(int(np.ceil(frames_s[-1] * rate_hz)) + 1) / rate_hz
    frames_ns, imu_ns = ((_START_NS + np.round(t * NS_PER_S)).astype(np.int64) for t in (frames_s, imu_s))
    errors = ImuErrors(bias_gyro_B=_vector(bias_gyro_B), bias_accel_B=_vector(bias_accel_B))
    readings = read_imu(path.at(imu_s), noise, imu_rng, rate_hz, errors)
    segments = cut_segments(imu_ns, readings.gyro_B, readings.accel_B, frames_ns)

    motion = path.at(frames_s)
    options = TrackOptions(max_points=max_points, pixel_sigma=pixel_sigma, outlier_ratio=outlier_ratio)
    simulator = TrackSimulator(calibration, options, track_rng)
    tracks = [simulator.observe(int(t), R, p) for t, R, p in zip(frames_ns, motion.R_WB, motion.p_WB, strict=True)]
    biases = np.column_stack(
        [np.interp(frames_s, imu_s, b) for b in (*readings.bias_gyro_B.T, *readings.bias_accel_B.T)]
    )
    states = tuple(
        NavState(int(t), R, p, v, b[:3], b[3:])
        for t, R, p, v, b in zip(frames_ns, motion.R_WB, motion.p_WB, motion.v_WB, biases, strict=True)
    )
    truth = Trajectory(frames_ns, motion.R_WB, motion.p_WB)
    name = flight if isinstance(flight, str) else type(flight).__name__
    return TrackSequence(name, calibration, tuple(zip(segments, tracks, strict=True)), truth, states)


def _vector(bias_B: Float | None) -> Vector:
    x, y, z = (0.0, 0.0, 0.0) if bias_B is None else bias_B
    return float(x), float(y), float(z)
