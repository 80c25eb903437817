"""The motion of a real EuRoC sequence: its IMU readings, its camera's stamps and its ground truth, without images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory
from vioframe.types import Float, Int

_IMU_FILES = ("imu0/data.csv", "imu0/data.csv.gz")
_STAMP_FILES = ("cam0/data.csv", "cam0/timestamps_ns.txt.gz")
# In the order they are preferred: V1_01 has the recomputed one too, and the orientation in its csv file is off.
GROUND_TRUTH_FILES = (
    "groundtruth_pose_recomputed_tum.txt.gz",
    "groundtruth_pose_vel_merged.csv.gz",
    "state_groundtruth_estimate0/data.csv",
    "state_groundtruth_estimate0/data.csv.gz",
)
# The published positions follow their own velocity to within a micrometre, but for the jumps.
_JUMP_M = 0.3e-3


@dataclass(frozen=True)
class RecordedMotion:
    """Readings ``gyro_B``, ``accel_B`` (N, 3) at ``imu_ns`` (N,), frames' stamps (M,), and the ``truth`` of K poses.

    ``v_WB`` (K, 3) m/s and the biases (K, 3) are as published with the truth, NaN where they are not.
    """

    name: str
    imu_ns: Int
    gyro_B: Float
    accel_B: Float
    frames_ns: Int
    truth: Trajectory
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float

    def without_jumps(self) -> RecordedMotion:
        """With every step in position that the published velocity does not explain taken out of the truth.

        The ground truth of the machine hall jumps, by up to 8 cm from one sample to the next, where its batch solution
        corrects itself; no IMU feels that. Without published velocities there is nothing to tell a jump by.
        """
        dt = np.diff(self.truth.t_ns)[:, None] * 1e-9
        jump = np.diff(self.truth.p_WB, axis=0) - 0.5 * (self.v_WB[1:] + self.v_WB[:-1]) * dt
        jump[~(np.linalg.norm(jump, axis=1) >= _JUMP_M)] = 0.0
        p_WB = self.truth.p_WB - np.vstack([np.zeros(3), np.cumsum(jump, axis=0)])
        return replace(self, truth=Trajectory(self.truth.t_ns, self.truth.R_WB, p_WB))


def load_recorded_motion(path: Path, *, start_s: float = 0.0, duration_s: float | None = None) -> RecordedMotion:
    """Read the sequence at ``path``: an ASL folder, its ``mav0``, or the IMU's ``data.csv`` in one (gzip'd or not).

    Frames are those that the readings and the ground truth both cover; ``start_s`` and ``duration_s`` count from the
    first of them. Raises :class:`DatasetError` where a file is missing or no frame is left.
    """
    folder = sensor_folder(path)
    readings, stamps, file = motion_files(folder)
    imu_ns, imu = _read_csv(readings, range(1, 7))
    frames_ns, _ = _read_csv(stamps)
    truth = load_trajectory(file)
    covered = (frames_ns >= max(truth.t_ns[0], imu_ns[0])) & (frames_ns <= min(truth.t_ns[-1], imu_ns[-1]))
    frames_ns = _window(frames_ns[covered], start_s, duration_s)
    if not len(frames_ns):
        raise DatasetError(f"{path}: no frame lies in the time asked for; start earlier or take longer")
    state = _published_state(file, len(truth))
    name = folder.parent.name if folder.name == "mav0" else folder.name
    return RecordedMotion(
        name, imu_ns, imu[:, :3], imu[:, 3:], frames_ns, truth, state[:, :3], state[:, 3:6], state[:, 6:]
    )


def sensor_folder(path: Path) -> Path:
    """The folder that holds ``imu0``."""
    if not path.exists():
        raise DatasetError(f"{path} does not exist; name a EuRoC sequence or its imu0/data.csv")
    path = path.resolve()
    folder = path.parent.parent if path.is_file() else path
    return folder / "mav0" if (folder / "mav0").is_dir() else folder


def motion_files(folder: Path) -> tuple[Path, Path, Path]:
    """Readings, stamps and ground truth in a folder of sensors; raises :class:`DatasetError` where one is missing."""
    readings, stamps, truth = (find_file(folder, names) for names in (_IMU_FILES, _STAMP_FILES, GROUND_TRUTH_FILES))
    return readings, stamps, truth


def find_file(folder: Path, names: tuple[str, ...]) -> Path:
    """The first of ``names`` that ``folder`` holds; raises :class:`DatasetError` where it holds none."""
    for name in names:
        if (folder / name).is_file():
            return folder / name
    raise DatasetError(f"{folder} holds none of {', '.join(names)}; name a EuRoC sequence with IMU, stamps and truth")


def _window(frames_ns: Int, start_s: float, duration_s: float | None) -> Int:
    elapsed_s = (frames_ns - frames_ns[:1]) * 1e-9
    end_s = np.inf if duration_s is None else start_s + duration_s
    return frames_ns[(elapsed_s >= start_s) & (elapsed_s <= end_s)]


def _published_state(file: Path, count: int) -> Float:
    """(K, 9) velocity in W and biases of gyroscope and accelerometer, NaN as far as the file does not hold them."""
    state = np.full((count, 9), np.nan)
    if ".csv" in file.suffixes:
        values = np.loadtxt(file, delimiter=",", ndmin=2)[:, 8:]
        state[:, : values.shape[1]] = values
    return state


def _read_csv(path: Path, columns: range | None = None) -> tuple[Int, Float]:
    """Stamps (N,) and ``columns``: apart, for a float64 would round the stamps."""
    try:
        t_ns = np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64, ndmin=1)
        if columns is None:
            return t_ns, np.empty((len(t_ns), 0))
        return t_ns, np.loadtxt(path, delimiter=",", usecols=columns, ndmin=2)
    except (OSError, EOFError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {' '.join(str(error).split())}; copy it again") from None
