"""What happens before any camera looks: how the body moves, what its IMU reads, and when frames are taken.

A :class:`Scenario` comes of a flight, whose readings are simulated, or of a real EuRoC sequence, whose are recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.errors import DatasetError, TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Flight
from vioframe.io.trajectories import load_trajectory
from vioframe.simulation.imu import ImuErrors, read_imu
from vioframe.types import NS_PER_S, Calibration, ImuNoise, NavState

_START_NS = NS_PER_S  # Time zero is a trap for code that takes 0 for "none".
_SPARE_NS = 20_000_000

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
# Cubic interpolation needs two samples on either side.
_STENCIL = np.array([-1, 0, 1, 2])


@dataclass(frozen=True)
class Scenario:
    """Readings ``gyro_B`` rad/s, ``accel_B`` m/s^2 (N, 3) at ``imu_ns`` (N,), stamps (M,) of frames, a truth of K poses.

    Stamps are those of the first camera's clock, but ``imu_ns`` is of the IMU's. ``v_WB`` (K, 3) m/s and the biases
    (K, 3) belong to the truth, and are NaN where nobody knows them. ``motion`` gives ``R_WB`` (Q, 3, 3), ``p_WB`` and
    ``v_WB`` (Q, 3) at any stamps (Q,), from before its beginning and after its end those there.
    """

    name: str
    frames_ns: Int
    imu_ns: Int
    gyro_B: Float
    accel_B: Float
    truth: Trajectory
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float
    motion: Callable[[Int], tuple[Float, Float, Float]]

    def states(self) -> tuple[NavState, ...]:
        """The states of the truth."""
        truth = self.truth
        return _states(truth.t_ns, truth.R_WB, truth.p_WB, self.v_WB, self.bias_gyro_B, self.bias_accel_B)

    def states_at(self, t_ns: Int) -> tuple[NavState, ...]:
        """The states at stamps ``t_ns`` (M,), with the biases between two states of the truth taken as linear."""
        biases = (_linear(self.truth.t_ns, bias, t_ns) for bias in (self.bias_gyro_B, self.bias_accel_B))
        return _states(t_ns, *self.motion(t_ns), *biases)

    def body_poses(self, calibration: Calibration, camera: int, t_ns: Int) -> tuple[Float, Float]:
        """``R_WB`` (M, 3, 3) and ``p_WB`` (M, 3) m at the instants at which a rig's camera stamps frames ``t_ns`` (M,).

        A camera whose time offset is not the first one's has a clock of its own.
        """
        offset_ns = calibration.cameras[camera].time_offset_ns - calibration.cameras[0].time_offset_ns
        return self.motion(t_ns + offset_ns)[:2]


def fly(
    flight: Flight,
    name: str,
    rng: np.random.Generator,
    *,
    frames_s: Float,
    imu_s: Float,
    imu_rate_hz: float,
    noise: ImuNoise | None,
    errors: ImuErrors | None = None,
    time_offset_ns: int = 0,
) -> Scenario:
    """``flight`` with frames at ``frames_s`` (M,) and readings at ``imu_s`` (N,) after its beginning, both ascending.

    ``noise`` None reads it exactly.
    """
    frames_ns, imu_ns = ((_START_NS + np.round(t_s * NS_PER_S)).astype(np.int64) for t_s in (frames_s, imu_s))
    at_readings = flight.at(imu_s)
    readings = read_imu(at_readings, noise, rng, imu_rate_hz, errors)
    end_s = max(flight.duration_s, imu_s[-1])

    def motion(t_ns: Int) -> tuple[Float, Float, Float]:
        at = flight.at(np.clip((t_ns - _START_NS) / NS_PER_S, 0.0, end_s))
        return at.R_WB, at.p_WB, at.v_WB

    return Scenario(
        name,
        frames_ns,
        imu_ns + time_offset_ns,
        readings.gyro_B,
        readings.accel_B,
        Trajectory(imu_ns, at_readings.R_WB, at_readings.p_WB),
        at_readings.v_WB,
        readings.bias_gyro_B,
        readings.bias_accel_B,
        motion,
    )


def load_euroc(
    path: Path, *, start_s: float = 0.0, duration_s: float | None = None, remove_jumps: bool = False
) -> Scenario:
    """The sequence at ``path``: an ASL folder, its ``mav0``, or the IMU's ``data.csv`` in one (gzip'd or not).

    Frames are those that the readings and the ground truth both cover; ``start_s`` and ``duration_s`` count from the
    first of them. ``remove_jumps`` takes every step in position that the published velocity does not explain out of
    the truth: that of the machine hall jumps, by up to 8 cm from one sample to the next, where its batch solution
    corrects itself, and no IMU feels that. Raises :class:`DatasetError` where a file is missing or no frame is left.
    """
    folder = sensor_folder(path)
    readings_file, stamps_file, truth_file = motion_files(folder)
    imu_ns, imu = _read_csv(readings_file, range(1, 7))
    frames_ns, _ = _read_csv(stamps_file)
    truth = load_trajectory(truth_file)
    covered = (frames_ns >= max(truth.t_ns[0], imu_ns[0])) & (frames_ns <= min(truth.t_ns[-1], imu_ns[-1]))
    frames_ns = frames_ns[covered]
    elapsed_s = (frames_ns - frames_ns[:1]) * 1e-9
    end_s = np.inf if duration_s is None else start_s + duration_s
    frames_ns = frames_ns[(elapsed_s >= start_s) & (elapsed_s <= end_s)]
    if not len(frames_ns):
        raise DatasetError(f"{path}: no frame lies in the time asked for; start earlier or take longer")
    published = np.full((len(truth), 9), np.nan)
    if ".csv" in truth_file.suffixes:
        values = np.loadtxt(truth_file, delimiter=",", ndmin=2)[:, 8:]
        published[:, : values.shape[1]] = values
    v_WB, bias_gyro_B, bias_accel_B = published[:, :3], published[:, 3:6], published[:, 6:]
    if remove_jumps:
        truth = _without_jumps(truth, v_WB)

    def motion(t_ns: Int) -> tuple[Float, Float, Float]:
        t_ns = np.clip(t_ns, truth.t_ns[0], truth.t_ns[-1])
        return *interpolate_poses(truth.t_ns, truth.R_WB, truth.p_WB, t_ns), _linear(truth.t_ns, v_WB, t_ns)

    # A reading to spare on either side, so that no frame is left without its segment.
    near, known = (
        (t_ns >= frames_ns[0] - _SPARE_NS) & (t_ns <= frames_ns[-1] + _SPARE_NS) for t_ns in (imu_ns, truth.t_ns)
    )
    return Scenario(
        folder.parent.name if folder.name == "mav0" else folder.name,
        frames_ns,
        imu_ns[near],
        imu[near, :3],
        imu[near, 3:],
        truth.select(known),
        v_WB[known],
        bias_gyro_B[known],
        bias_accel_B[known],
        motion,
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


def interpolate_poses(t_ns: Int, R_WB: Float, p_WB: Float, query_ns: Int) -> tuple[Float, Float]:
    """Poses at ``query_ns`` (M,) from samples at ``t_ns`` (N,): ``R_WB`` (M, 3, 3), ``p_WB`` (M, 3) m.

    Cubic Lagrange interpolation through the four nearest samples; rotations in the tangent space of the sample before
    the query, so that the error is of fourth order in the sampling interval for both (a geodesic's would be of second
    order: 0.1 px of image motion at the angular accelerations of a fast flight sampled at 200 Hz).

    Raises :class:`TrajectoryError` where a query lies outside the samples.
    """
    if len(t_ns) < len(_STENCIL):
        raise TrajectoryError(f"cannot interpolate {len(t_ns)} poses; at least {len(_STENCIL)} are needed")
    if len(query_ns) and (query_ns.min() < t_ns[0] or query_ns.max() > t_ns[-1]):
        raise TrajectoryError("a pose was asked for outside the ground truth; limit the frames to the stamps it covers")
    before = np.searchsorted(t_ns, query_ns, side="right") - 1
    stencil = np.clip(before, 1, len(t_ns) - 3)[:, None] + _STENCIL  # (M, 4)
    nodes = (t_ns[stencil] - query_ns[:, None]) * 1e-9
    weights = np.ones_like(nodes)
    for k in range(len(_STENCIL)):
        for j in range(len(_STENCIL)):
            if j != k:
                weights[:, k] *= nodes[:, j] / (nodes[:, j] - nodes[:, k])
    R_anchor = R_WB[stencil[:, 1]]
    phi = so3.log(np.swapaxes(R_anchor, -1, -2)[:, None] @ R_WB[stencil])
    R = R_anchor @ so3.exp(np.einsum("mk,mki->mi", weights, phi))
    return R, np.einsum("mk,mki->mi", weights, p_WB[stencil])


def _without_jumps(truth: Trajectory, v_WB: Float) -> Trajectory:
    """Without published velocities there is nothing to tell a jump by, and none is found."""
    dt = np.diff(truth.t_ns)[:, None] * 1e-9
    jump = np.diff(truth.p_WB, axis=0) - 0.5 * (v_WB[1:] + v_WB[:-1]) * dt
    jump[~(np.linalg.norm(jump, axis=1) >= _JUMP_M)] = 0.0
    return replace(truth, p_WB=truth.p_WB - np.vstack([np.zeros(3), np.cumsum(jump, axis=0)]))


def _states(t_ns: Int, *columns: Float) -> tuple[NavState, ...]:
    return tuple(NavState(*state) for state in zip(t_ns.tolist(), *columns, strict=True))


def _linear(t_ns: Int, values: Float, query_ns: Int) -> Float:
    """(Q, 3) at ``query_ns`` (Q,) from ``values`` (K, 3) at ``t_ns`` (K,)."""
    at_s, query_s = (t_ns - t_ns[0]) * 1e-9, (query_ns - t_ns[0]) * 1e-9
    return np.column_stack([np.interp(query_s, at_s, column) for column in values.T])


def _read_csv(path: Path, columns: range | None = None) -> tuple[Int, Float]:
    """Stamps (N,) and ``columns``: apart, for a float64 would round the stamps."""
    try:
        t_ns = np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64, ndmin=1)
        if columns is None:
            return t_ns, np.empty((len(t_ns), 0))
        return t_ns, np.loadtxt(path, delimiter=",", usecols=columns, ndmin=2)
    except (OSError, EOFError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {' '.join(str(error).split())}; copy it again") from None
