"""Simulated landmarks along a real EuRoC flight, with the IMU readings that were really recorded on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vioframe.calibration import packaged_calibration
from vioframe.errors import DatasetError
from vioframe.simulation.poses import interpolate_poses
from vioframe.simulation.segments import cut_segments
from vioframe.simulation.sequence import TrackSequence
from vioframe.simulation.tracks import TrackOptions, TrackSimulator
from vioframe.trajectory import Trajectory, load_trajectory
from vioframe.types import Calibration, Float, Int, NavState

REAL_MOTION_SEQUENCES = ("MH_02_easy", "MH_03_medium", "MH_05_difficult", "V1_01_easy", "V1_02_medium")
"""The flights of ``euroc_imu_gt`` in the shared data."""

# In the order they are preferred: V1_01 has the first and the last, and the orientation in its csv file is off.
_GROUND_TRUTH_FILES = (
    "groundtruth_pose_recomputed_tum.txt.gz",
    "groundtruth_pose_vel_merged.csv.gz",
    "state_groundtruth_estimate0/data.csv.gz",
)
_VELOCITY, _BIASES = slice(0, 3), slice(3, 9)
# The published positions follow their own velocity to within a micrometre, but for the jumps.
_JUMP_M = 0.3e-3


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

    ``folder`` holds ``imu0/data.csv.gz``, ``cam0/timestamps_ns.txt.gz`` and a ground-truth file; frames are those that
    the readings and the ground truth both cover, and ``start_s`` and ``duration_s`` count from the first of them.
    ``calibration`` is EuRoC's as published unless given.

    The ground truth of the machine hall jumps, by up to 8 cm from one sample to the next, where its batch solution
    corrects itself; no IMU feels that. ``remove_jumps`` closes these steps in position (in the truth that is returned
    too), which leaves a motion that the readings do agree with. Raises :class:`DatasetError` where a file is missing or
    no frame is left.
    """
    calibration = calibration or packaged_calibration("euroc")
    truth, velocity_and_biases = _read_ground_truth(folder)
    p_WB = _without_jumps(truth, velocity_and_biases[:, _VELOCITY]) if remove_jumps else truth.p_WB
    imu_ns, imu = _read_csv(folder / "imu0/data.csv.gz", columns=6)
    frames_ns, _ = _read_csv(folder / "cam0/timestamps_ns.txt.gz", columns=0)
    covered = (frames_ns >= max(truth.t_ns[0], imu_ns[0])) & (frames_ns <= min(truth.t_ns[-1], imu_ns[-1]))
    frames_ns = _window(frames_ns[covered], start_s, duration_s)
    if not len(frames_ns):
        raise DatasetError(f"{folder}: no frame lies in the time asked for; start earlier")

    R_WB, p_WB = interpolate_poses(truth.t_ns, truth.R_WB, p_WB, frames_ns)
    simulator = TrackSimulator(
        calibration, TrackOptions(max_points=max_points, pixel_sigma=pixel_sigma), np.random.default_rng(seed)
    )
    tracks = [simulator.observe(int(t), R, p) for t, R, p in zip(frames_ns, R_WB, p_WB, strict=True)]
    segments = cut_segments(imu_ns, imu[:, :3], imu[:, 3:], frames_ns)
    motion = Trajectory(frames_ns, R_WB, p_WB)
    return TrackSequence(
        folder.name,
        calibration,
        tuple(zip(segments, tracks, strict=True)),
        motion,
        _published_states(truth.t_ns, velocity_and_biases, motion),
    )


def _window(frames_ns: Int, start_s: float, duration_s: float | None) -> Int:
    elapsed_s = (frames_ns - frames_ns[:1]) * 1e-9
    end_s = np.inf if duration_s is None else start_s + duration_s
    return frames_ns[(elapsed_s >= start_s) & (elapsed_s <= end_s)]


def _without_jumps(truth: Trajectory, v_WB: Float) -> Float:
    """Positions (N, 3) m with every step that the published velocity does not explain taken out."""
    if not v_WB.shape[1]:
        # Without velocities there is nothing to tell a jump by; the one such file (V1_01) has none.
        return truth.p_WB
    dt = np.diff(truth.t_ns)[:, None] * 1e-9
    jump = np.diff(truth.p_WB, axis=0) - 0.5 * (v_WB[1:] + v_WB[:-1]) * dt
    jump[np.linalg.norm(jump, axis=1) < _JUMP_M] = 0.0
    return truth.p_WB - np.vstack([np.zeros(3), np.cumsum(jump, axis=0)])


def _read_ground_truth(folder: Path) -> tuple[Trajectory, Float]:
    """Poses, and (N, 0, 3 or 9) velocity in W and biases of gyroscope and accelerometer as far as they are given."""
    for name in _GROUND_TRUTH_FILES:
        if not (folder / name).is_file():
            continue
        truth = load_trajectory(folder / name)
        if name.endswith(".csv.gz"):
            return truth, _read_csv(folder / name)[1][:, 7:]
        return truth, np.empty((len(truth), 0))
    raise DatasetError(f"{folder}: no ground truth here; expected one of {', '.join(_GROUND_TRUTH_FILES)}")


def _published_states(t_ns: Int, velocity_and_biases: Float, motion: Trajectory) -> tuple[NavState, ...]:
    """The published velocity and biases at the frames, where the file has both."""
    if velocity_and_biases.shape[1] < 9:
        return ()
    seconds, frames_s = ((t - t_ns[0]) * 1e-9 for t in (t_ns, motion.t_ns))
    x = np.column_stack([np.interp(frames_s, seconds, column) for column in velocity_and_biases.T])
    v_WB, biases = x[:, _VELOCITY], x[:, _BIASES]
    return tuple(
        NavState(int(t), R, p, v, b[:3], b[3:])
        for t, R, p, v, b in zip(motion.t_ns, motion.R_WB, motion.p_WB, v_WB, biases, strict=True)
    )


def _read_csv(path: Path, columns: int | None = None) -> tuple[Int, Float]:
    """Stamps (N,) and the ``columns`` after them (all if None): apart, for a float64 would round the stamps."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; a real-motion folder needs imu0, cam0 and ground truth")
    t_ns = np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64)
    if columns == 0:
        return t_ns, np.empty((len(t_ns), 0))
    used = None if columns is None else range(1, columns + 1)
    values = np.loadtxt(path, delimiter=",", usecols=used, ndmin=2)
    return t_ns, values if used is not None else values[:, 1:]
