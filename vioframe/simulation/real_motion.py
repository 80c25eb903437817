"""Simulated landmarks along a real EuRoC flight, with the IMU readings that were really recorded on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry import so3
from vioframe.simulation.euroc import EUROC_CALIBRATION
from vioframe.simulation.poses import interpolate_poses
from vioframe.simulation.segments import cut_segments
from vioframe.simulation.sequence import TrackSequence, Trajectory
from vioframe.simulation.tracks import TrackOptions, TrackSimulator
from vioframe.types import Calibration, Float, Int, NavState

REAL_MOTION_SEQUENCES = ("MH_02_easy", "MH_03_medium", "MH_05_difficult", "V1_01_easy", "V1_02_medium")
"""The flights of ``euroc_imu_gt`` in the shared data."""

# In the order they are preferred: V1_01 has both of the last two, and the orientation in its csv file is off.
_GROUND_TRUTH_FILES = (
    "groundtruth_pose_recomputed_tum.txt.gz",
    "groundtruth_pose_vel_merged.csv.gz",
    "state_groundtruth_estimate0/data.csv.gz",
)


def real_motion_sequence(
    folder: Path,
    calibration: Calibration = EUROC_CALIBRATION,
    *,
    pixel_sigma: float = 1.0,
    max_points: int = 150,
    seed: int = 0,
    start_s: float = 0.0,
    duration_s: float | None = None,
) -> TrackSequence:
    """Landmarks seen from the true poses of ``folder`` at its camera's stamps, and its recorded IMU.

    ``folder`` holds ``imu0/data.csv.gz``, ``cam0/timestamps_ns.txt.gz`` and a ground-truth file, which together decide
    the frames: those that both the readings and the ground truth cover. ``start_s`` and ``duration_s`` count from the
    first of these. Raises :class:`DatasetError` where a file is missing or nothing is left.
    """
    options = TrackOptions(max_points=max_points, pixel_sigma=pixel_sigma)
    truth_t_ns, truth = _read_ground_truth(folder)
    imu = _load(folder / "imu0/data.csv.gz", delimiter=",", columns=range(1, 7))
    imu_t_ns = _load_stamps(folder / "imu0/data.csv.gz")
    frames_ns = _load_stamps(folder / "cam0/timestamps_ns.txt.gz")
    begin = max(truth_t_ns[0], imu_t_ns[0])
    end = min(truth_t_ns[-1], imu_t_ns[-1])
    frames_ns = frames_ns[(frames_ns >= begin) & (frames_ns <= end)]
    if len(frames_ns):
        elapsed_s = (frames_ns - frames_ns[0]) * 1e-9
        frames_ns = frames_ns[(elapsed_s >= start_s) & (elapsed_s <= start_s + (duration_s or np.inf))]
    if not len(frames_ns):
        raise DatasetError(f"{folder}: no frame is left after start_s; start earlier")

    R_WB, p_WB = interpolate_poses(truth_t_ns, so3.from_quat_xyzw(truth[:, 3:7]), truth[:, :3], frames_ns)
    simulator = TrackSimulator(calibration, options, np.random.default_rng(seed))
    tracks = [simulator.observe(int(t), R, p) for t, R, p in zip(frames_ns, R_WB, p_WB, strict=True)]
    segments = cut_segments(imu_t_ns, imu[:, :3], imu[:, 3:], frames_ns)
    return TrackSequence(
        folder.name,
        calibration,
        tuple(zip(segments, tracks, strict=True)),
        Trajectory(frames_ns, R_WB, p_WB),
        _published_states(truth_t_ns, truth, frames_ns, R_WB, p_WB),
    )


def _read_ground_truth(folder: Path) -> tuple[Int, Float]:
    """Stamps (N,) and rows (N, 7, 10 or 16): position, quaternion xyzw, then velocity and biases where they are known."""
    for name in _GROUND_TRUTH_FILES:
        path = folder / name
        if not path.is_file():
            continue
        if "tum" in name:
            # Decimal seconds: floats hold these stamps to about 0.2 us, and the file to 10 us.
            rows = _load(path)
            return np.round(rows[:, 0] * 1e9).astype(np.int64), rows[:, 1:]
        rows = _load(path, delimiter=",")[:, 1:]
        rows[:, 3:7] = rows[:, [4, 5, 6, 3]]  # wxyz -> xyzw
        return _load_stamps(path), rows
    raise DatasetError(f"{folder}: no ground truth here; expected one of {', '.join(_GROUND_TRUTH_FILES)}")


def _published_states(t_ns: Int, rows: Float, frames_ns: Int, R_WB: Float, p_WB: Float) -> tuple[NavState, ...]:
    """The published velocity and biases at the frames, where the file has both."""
    if rows.shape[1] < 16:
        return ()
    seconds = (t_ns - t_ns[0]) * 1e-9
    rest = np.column_stack([np.interp((frames_ns - t_ns[0]) * 1e-9, seconds, column) for column in rows[:, 7:16].T])
    return tuple(
        NavState(int(t), R, p, x[:3], x[3:6], x[6:9]) for t, R, p, x in zip(frames_ns, R_WB, p_WB, rest, strict=True)
    )


def _load(path: Path, delimiter: str | None = None, columns: range | None = None) -> Float:
    if not path.is_file():
        raise DatasetError(f"{path} is missing; a real-motion folder needs imu0, cam0 and ground truth")
    return np.loadtxt(path, delimiter=delimiter, usecols=columns, ndmin=2)


def _load_stamps(path: Path) -> Int:
    """First column as integers: float64 would round nanosecond stamps by a hundred."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; a real-motion folder needs imu0, cam0 and ground truth")
    return np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64)
