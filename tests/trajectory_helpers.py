"""Flights made up for the tests of trajectories, metrics and plots."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vioframe.bench import BackendRun
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.io.trajectories import write_tum
from vioframe.runs.recorder import Recorder, new_run_folder
from vioframe.simulation import TrackSequence
from vioframe.types import Estimate, FrameSet, FrameTracks, NavState, Status, Step

BEGIN_NS = 1_403_636_579_763_555_584
PERIOD_NS = 50_000_000

PEERS = {
    "MH_03_rpg_vio_mono": "MH_03_medium/groundtruth_pose_vel_merged.csv.gz",
    "MH_05_rpg_vio_mono": "MH_05_difficult/state_groundtruth_estimate0/data.csv.gz",
    "MH_05_rpg_vio_stereo": "MH_05_difficult/state_groundtruth_estimate0/data.csv.gz",
    "MH_05_rpg_vislam": "MH_05_difficult/state_groundtruth_estimate0/data.csv.gz",
    "MH_05_vins_course": "MH_05_difficult/state_groundtruth_estimate0/data.csv.gz",
    "V1_01_openvins": "V1_01_easy/groundtruth_pose_recomputed_tum.txt.gz",
    "V1_02_evo_example": "V1_02_medium/state_groundtruth_estimate0/data.csv.gz",
    "V1_02_rpg_vislam": "V1_02_medium/state_groundtruth_estimate0/data.csv.gz",
}
"""What other systems estimated, and the ground truth of the same flight below ``euroc_imu_gt``."""


def flight(n: int = 400, seed: int = 0) -> Trajectory:
    """A smooth three-dimensional flight of about 50 m in 20 s with the body turning about all axes."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0.0, 2.0 * np.pi, n)
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)
    p_WB = np.column_stack([6.0 * np.sin(s + phase[0]), 5.0 * np.sin(2.0 * s + phase[1]), np.sin(3.0 * s + phase[2])])
    phi = np.column_stack([0.4 * np.sin(2.0 * s), 0.3 * np.cos(3.0 * s), s])
    return Trajectory(BEGIN_NS + PERIOD_NS * np.arange(n), so3.exp(phi), p_WB)


def disturbed(truth: Trajectory, sigma_m: float, sigma_rad: float, seed: int = 1) -> Trajectory:
    """``truth`` with white noise on position and rotation."""
    rng = np.random.default_rng(seed)
    R_WB = truth.R_WB @ so3.exp(rng.normal(0.0, sigma_rad, (len(truth), 3)))
    return Trajectory(truth.t_ns, R_WB, truth.p_WB + rng.normal(0.0, sigma_m, (len(truth), 3)))


def moved(trajectory: Trajectory, R: np.ndarray, p: np.ndarray, scale: float = 1.0) -> Trajectory:
    """The same flight in a world that is turned, shifted and scaled."""
    return Trajectory(trajectory.t_ns, R @ trajectory.R_WB, scale * trajectory.p_WB @ R.T + p, trajectory.cov_pose)


def write_run(folder: Path, estimate: Trajectory, truth: Trajectory | None = None, *, waiting: int = 10) -> None:
    """A run folder as ``vioframe run`` leaves it, whose back-end needs ``waiting`` frames before its first state."""
    new_run_folder(folder)
    if truth is not None:
        write_tum(truth, folder / "ground_truth.tum")
    about = {"name": folder.name, "dataset": "made up", "detector": "shi_tomasi", "backend": "msckf", "start_s": 0.0}
    rng = np.random.default_rng(2)
    with Recorder(folder, about, Incidents(), 0.0) as recorder:
        for k, t_ns in enumerate(estimate.t_ns.tolist()):
            state = _state(estimate, k) if k >= waiting else None
            status = Status.TRACKING if state else Status.INITIALISING
            ids = np.arange(3 * k, 3 * k + 120)
            camera, xy = np.zeros(120, np.int64), rng.uniform(0.0, 480.0, (120, 2))
            tracks = FrameTracks(t_ns, ids, camera, xy, np.zeros((120, 2)))
            seconds = dict(zip(("equalise", "klt", "reject", "detect"), rng.uniform(1e-3, 4e-3, 4), strict=True))
            backend = (
                {"backend": 5e-3, "backend.propagate": 5e-4, "backend.update": 3.5e-3} if state else {"backend": 1e-3}
            )
            frames = FrameSet(t_ns, (np.zeros((1, 1), np.uint8),))
            recorder.add(Step(frames, tracks, Estimate(status, state), {**seconds, **backend}))


def _state(estimate: Trajectory, k: int) -> NavState:
    cov = None
    if estimate.cov_pose is not None:
        cov = np.eye(15)
        cov[:6, :6] = estimate.cov_pose[k]
    zero = np.zeros(3)
    return NavState(int(estimate.t_ns[k]), estimate.R_WB[k], estimate.p_WB[k], zero, zero, zero, cov)


def run_of(sequence: TrackSequence, estimates: Sequence[Estimate]) -> BackendRun:
    """The run of a back-end that says ``estimates``, one a packet, and takes a second for each."""
    t_ns = tuple(tracks.t_ns for _, tracks in sequence.packets[: len(estimates)])
    return BackendRun(t_ns, tuple(estimates), np.ones(len(t_ns)), np.ones(len(t_ns)))
