"""What happens before any camera looks: how the body moves, what its IMU reads, and when frames are taken.

A :class:`Scenario` comes of a flight, whose readings are simulated, or of a real EuRoC sequence, whose are recorded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.errors import DatasetError, TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Flight
from vioframe.io.trajectories import TrueTrajectory, load_trajectory, true_values
from vioframe.simulation.imu import ImuErrors, read_imu
from vioframe.types import NS_PER_S, Calibration, ImuNoise, NavState

_START_NS = NS_PER_S  # Time zero is a trap for code that takes 0 for "none".
_SPARE_NS = 20_000_000

_IMU_FILES = ("imu0/data.csv", "imu0/data.csv.gz")
_STAMP_FILES = ("cam0/data.csv", "cam0/timestamps_ns.txt.gz")
# In the order they are preferred: V1_01 has the recomputed one too, and the orientation in its csv file is off.
_GROUND_TRUTH_FILES = (
    "groundtruth_pose_recomputed_tum.txt.gz",
    "groundtruth_pose_vel_merged.csv.gz",
    "state_groundtruth_estimate0/data.csv",
    "state_groundtruth_estimate0/data.csv.gz",
)
# Cubic interpolation needs two samples on either side.
_STENCIL = np.array([-1, 0, 1, 2])

PosesAt = Callable[[Int], tuple[Float, Float, Float]]
"""Any stamps (Q,) to ``R_WB`` (Q, 3, 3), ``p_WB`` (Q, 3) m and ``v_WB`` (Q, 3) m/s, NaN where it is not known."""


@dataclass(frozen=True)
class Scenario:
    """Readings ``gyro_B`` rad/s, ``accel_B`` m/s^2 (N, 3) at ``imu_ns`` (N,), and frames at ``frames_ns`` (M,).

    Stamps are those of the first camera's clock, but ``imu_ns`` is of the IMU's. The ``truth`` has K poses, velocity
    and biases too where they are known. ``motion`` gives, before its beginning and after its end, what is there.
    """

    name: str
    frames_ns: Int
    imu_ns: Int
    gyro_B: Float
    accel_B: Float
    truth: TrueTrajectory
    motion: PosesAt

    def states_at(self, t_ns: Int) -> tuple[NavState, ...]:
        """The states at stamps (M,), biases linear between two of the truth; none where that is not known."""
        if self.truth.values.shape[1] < 16:
            return ()
        biases = linear(self.truth.t_ns, self.truth.values[:, 10:], t_ns)
        columns = zip(t_ns.tolist(), *self.motion(t_ns), biases[:, :3], biases[:, 3:], strict=True)
        return tuple(NavState(*state) for state in columns)

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
    begin_ns: int = _START_NS,
) -> Scenario:
    """``flight`` with frames at ``frames_s`` (M,) and readings at ``imu_s`` (N,) after ``begin_ns``, both ascending.

    ``noise`` None reads it exactly.
    """
    frames_ns, imu_ns = (begin_ns + np.round(t_s * NS_PER_S).astype(np.int64) for t_s in (frames_s, imu_s))
    at_readings = flight.at(imu_s)
    readings = read_imu(at_readings, noise, rng, imu_rate_hz, errors)
    end_s = max(flight.duration_s, imu_s[-1])

    def motion(t_ns: Int) -> tuple[Float, Float, Float]:
        at = flight.at(np.clip((t_ns - begin_ns) / NS_PER_S, 0.0, end_s))
        return at.R_WB, at.p_WB, at.v_WB

    poses = Trajectory(imu_ns, at_readings.R_WB, at_readings.p_WB)
    values = np.hstack([true_values(poses), at_readings.v_WB, readings.bias_gyro_B, readings.bias_accel_B])
    truth = TrueTrajectory(imu_ns, poses.R_WB, poses.p_WB, values=values)
    return Scenario(name, frames_ns, imu_ns + time_offset_ns, readings.gyro_B, readings.accel_B, truth, motion)


def load_euroc(path: Path, *, start_s: float = 0.0, duration_s: float | None = None) -> Scenario:
    """The sequence at ``path``: an ASL folder, its ``mav0``, or the IMU's ``data.csv`` in one (gzip'd or not).

    Frames are those that the readings and the ground truth both cover; ``start_s`` and ``duration_s`` count from the
    first of them. The truth is as it was published, see :func:`~vioframe.simulation.felt.felt`. Raises
    :class:`DatasetError` where a file is missing or no frame is left.
    """
    readings_file, stamps_file, truth_file = motion_files(path)
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
    folder = readings_file.parent.parent
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
        TrueTrajectory(truth.t_ns[known], truth.R_WB[known], truth.p_WB[known], values=true_values(truth)[known]),
        motion_along(truth),
    )


def motion_along(truth: Trajectory) -> PosesAt:
    """The ``motion`` of a scenario between the poses of its truth."""
    values = true_values(truth)
    v_WB = values[:, 7:10] if values.shape[1] > 7 else np.full((len(truth), 3), np.nan)

    def motion(t_ns: Int) -> tuple[Float, Float, Float]:
        t_ns = np.clip(t_ns, truth.t_ns[0], truth.t_ns[-1])
        return *interpolate_poses(truth.t_ns, truth.R_WB, truth.p_WB, t_ns), linear(truth.t_ns, v_WB, t_ns)

    return motion


def motion_files(path: Path) -> tuple[Path, Path, Path]:
    """Readings, stamps of frames and ground truth of the sequence at ``path``, named as for :func:`load_euroc`.

    Raises :class:`DatasetError` where one is missing.
    """
    if not path.exists():
        raise DatasetError(f"{path} does not exist; name a EuRoC sequence or its imu0/data.csv")
    path = path.resolve()
    folder = path.parent.parent if path.is_file() else path
    folder = folder / "mav0" if (folder / "mav0").is_dir() else folder

    def first(names: tuple[str, ...]) -> Path:
        for name in names:
            if (folder / name).is_file():
                return folder / name
        raise DatasetError(f"{folder} has none of {', '.join(names)}; name a EuRoC sequence with IMU, stamps and truth")

    return first(_IMU_FILES), first(_STAMP_FILES), first(_GROUND_TRUTH_FILES)


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


def linear(t_ns: Int, values: Float, query_ns: Int) -> Float:
    """(Q, D) at ``query_ns`` (Q,) from ``values`` (K, D) at ``t_ns`` (K,)."""
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
