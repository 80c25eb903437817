"""Simulated landmarks along a real EuRoC flight, with the IMU readings that were really recorded on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation.poses import interpolate_poses
from vioframe.simulation.recorded_motion import RecordedMotion, load_recorded_motion
from vioframe.simulation.segments import cut_segments
from vioframe.simulation.sequence import TrackSequence
from vioframe.simulation.tracks import TrackOptions, TrackSimulator
from vioframe.types import Calibration, NavState

REAL_MOTION_SEQUENCES = ("MH_02_easy", "MH_03_medium", "MH_05_difficult", "V1_01_easy", "V1_02_medium")
"""The flights of ``euroc_imu_gt`` in the shared data."""


def real_motion_sequence(
    folder: Path,
    calibration: Calibration | None = None,
    *,
    pixel_sigma: float = 1.0,
    max_points: int = 150,
    seed: int = 0,
    start_s: float = 0.0,
    duration_s: float | None = None,
    remove_jumps: bool = False,
) -> TrackSequence:
    """Landmarks seen from the true poses of ``folder`` at its camera's stamps, and its recorded IMU.

    ``folder``, ``start_s`` and ``duration_s`` are those of
    :func:`~vioframe.simulation.recorded_motion.load_recorded_motion`. ``calibration`` is EuRoC's as published unless
    given; ``remove_jumps`` closes the jumps of the ground truth, in the truth that is returned too, which leaves a
    motion that the readings do agree with.
    """
    calibration = calibration or packaged_calibration("euroc")
    recorded = load_recorded_motion(folder, start_s=start_s, duration_s=duration_s)
    if remove_jumps:
        recorded = recorded.without_jumps()
    truth, frames_ns = recorded.truth, recorded.frames_ns
    R_WB, p_WB = interpolate_poses(truth.t_ns, truth.R_WB, truth.p_WB, frames_ns)
    simulator = TrackSimulator(
        calibration, TrackOptions(max_points=max_points, pixel_sigma=pixel_sigma), np.random.default_rng(seed)
    )
    tracks = [simulator.observe(int(t), R, p) for t, R, p in zip(frames_ns, R_WB, p_WB, strict=True)]
    segments = cut_segments(recorded.imu_ns, recorded.gyro_B, recorded.accel_B, frames_ns)
    motion = Trajectory(frames_ns, R_WB, p_WB)
    return TrackSequence(
        recorded.name,
        calibration,
        tuple(zip(segments, tracks, strict=True)),
        motion,
        _published_states(recorded, motion),
    )


def _published_states(recorded: RecordedMotion, motion: Trajectory) -> tuple[NavState, ...]:
    """The published velocity and biases at the frames, where there are both."""
    x = np.column_stack([recorded.v_WB, recorded.bias_gyro_B, recorded.bias_accel_B])
    if not np.isfinite(x).all():
        return ()
    seconds, frames_s = ((t - recorded.truth.t_ns[0]) * 1e-9 for t in (recorded.truth.t_ns, motion.t_ns))
    x = np.column_stack([np.interp(frames_s, seconds, column) for column in x.T])
    return tuple(
        NavState(int(t), R, p, s[:3], s[3:6], s[6:])
        for t, R, p, s in zip(motion.t_ns, motion.R_WB, motion.p_WB, x, strict=True)
    )
