"""What happens in a simulated recording before any camera looks: the motion, what the IMU reads, the frames' stamps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vioframe.interfaces import Flight
from vioframe.simulation.imu import ImuErrors, read_imu
from vioframe.simulation.poses import interpolate_poses
from vioframe.simulation.recorded_motion import RecordedMotion
from vioframe.types import NS_PER_S, Calibration, Float, ImuNoise, ImuSample, Int, NavState

_START_NS = NS_PER_S  # Time zero is a trap for code that takes 0 for "none".
_SPARE_NS = 20_000_000

PoseSource = Callable[[Int], tuple[Float, Float]]
"""Stamps (N,) on the camera's clock to ``R_WB`` (N, 3, 3) and ``p_WB`` (N, 3) m."""


@dataclass(frozen=True)
class Scenario:
    """A motion, known by ``poses`` at any stamp from the first state of ``truth`` to the last.

    ``frames_ns`` (N,) and the truth are on the camera's clock, the stamps of ``imu`` on the IMU's. Velocity and biases
    of the truth are NaN where they are not known.
    """

    frames_ns: Int
    imu: tuple[ImuSample, ...]
    truth: tuple[NavState, ...]
    poses: PoseSource


def flown(
    flight: Flight,
    calibration: Calibration,
    rng: np.random.Generator,
    *,
    noise: ImuNoise | None,
    errors: ImuErrors,
    imu_rate_hz: float,
    frame_rate_hz: float,
) -> Scenario:
    """``flight`` from its beginning to its end; ``noise`` None reads it exactly."""
    frames_s = np.arange(int(flight.duration_s * frame_rate_hz + 1e-9) + 1) / frame_rate_hz
    # The reading after the last frame, where the flight lasts that long, so that no frame is left without its segment.
    imu_s = np.arange(int(flight.duration_s * imu_rate_hz + 1e-9) + 1) / imu_rate_hz
    frames_s = frames_s[frames_s <= imu_s[-1]]
    frames_ns, imu_ns = (_stamps(t_s) for t_s in (frames_s, imu_s))
    motion = flight.at(imu_s)
    readings = read_imu(motion, noise, rng, imu_rate_hz, errors)
    truth = zip(
        imu_ns.tolist(),
        motion.R_WB,
        motion.p_WB,
        motion.v_WB,
        readings.bias_gyro_B,
        readings.bias_accel_B,
        strict=True,
    )

    def poses(t_ns: Int) -> tuple[Float, Float]:
        at = flight.at((t_ns - _START_NS) / NS_PER_S)
        return at.R_WB, at.p_WB

    offset_ns = calibration.time_offset_ns
    samples = zip((imu_ns + offset_ns).tolist(), readings.gyro_B, readings.accel_B, strict=True)
    return Scenario(
        frames_ns, tuple(ImuSample(*sample) for sample in samples), tuple(NavState(*state) for state in truth), poses
    )


def replayed(recorded: RecordedMotion) -> Scenario:
    """The readings, camera stamps and true poses of a real sequence, from its first frame to its last."""
    truth, (begin_ns, end_ns) = recorded.truth, recorded.frames_ns[[0, -1]]

    def poses(t_ns: Int) -> tuple[Float, Float]:
        return interpolate_poses(truth.t_ns, truth.R_WB, truth.p_WB, t_ns)

    samples = zip(recorded.imu_ns.tolist(), recorded.gyro_B, recorded.accel_B, strict=True)
    velocity_and_biases = recorded.v_WB, recorded.bias_gyro_B, recorded.bias_accel_B
    states = zip(truth.t_ns.tolist(), truth.R_WB, truth.p_WB, *velocity_and_biases, strict=True)
    return Scenario(
        recorded.frames_ns,
        # A reading to spare on either side, so that no frame is left without its segment.
        tuple(ImuSample(*s) for s in samples if begin_ns - _SPARE_NS <= s[0] <= end_ns + _SPARE_NS),
        tuple(NavState(*s) for s in states if begin_ns - _SPARE_NS <= s[0] <= end_ns + _SPARE_NS),
        poses,
    )


def _stamps(t_s: Float) -> Int:
    return (_START_NS + np.round(t_s * NS_PER_S)).astype(np.int64)
