"""EuRoC's recording of an AprilGrid: real corners with perfect association, real IMU, and truth by PnP.

The board's metric geometry gives a pose from each image alone, so the truth owes nothing to the IMU that it judges;
only the vertical is taken from it, for an estimate is compared after alignment in position and yaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vioframe.bench.gravity import gravity_in_frame, rotation_to_vertical
from vioframe.errors import DatasetError
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import TrackSequence
from vioframe.simulation.segments import cut_segments
from vioframe.types import Calibration, Float, FrameTracks, Int

CORNERS_PER_TAG = 4


@dataclass(frozen=True, slots=True)
class BoardView:
    """The corners found in one image: ``corner`` (N,) identities, ``xy`` (N, 2) px, ``p_A`` (N, 3) m on the board A."""

    t_ns: int
    corner: Int
    xy: Float
    p_A: Float


def april_sequence(folder: Path, calibration: Calibration | None = None) -> TrackSequence:
    """The recording in ``folder``, which holds ``cam0_corners.csv.gz`` and ``imu0.csv.gz``.

    ``calibration`` is EuRoC's as published unless given; it fits the corners to 0.4 px. A corner that comes back into
    view gets a new id, as it would from any tracker; ids of one corner differ by multiples of :func:`corner_count`.
    Raises :class:`DatasetError` where a file is missing.
    """
    calibration = calibration or packaged_calibration("euroc")
    imu_ns, imu = _read(folder / "imu0.csv.gz", range(1, 7))
    gyro_B, accel_B = imu[:, :3], imu[:, 3:]
    views = [v for v in read_board_views(folder) if imu_ns[0] <= v.t_ns <= imu_ns[-1]]
    frames_ns = np.array([view.t_ns for view in views], np.int64)
    segments = cut_segments(imu_ns, gyro_B, accel_B, frames_ns)
    tracks = _tracks(views, calibration.cameras[0].model)

    R_AC, p_AC = board_poses(views, calibration.cameras[0].model)
    R_AB = R_AC @ calibration.cameras[0].R_BC.T
    p_AB = p_AC - R_AB @ calibration.cameras[0].p_BC
    g_A = gravity_in_frame(Trajectory(frames_ns, R_AB, p_AB), imu_ns, accel_B)
    R_WA = rotation_to_vertical(g_A)
    truth = Trajectory(frames_ns, R_WA @ R_AB, p_AB @ R_WA.T)
    return TrackSequence("imu_april", calibration, tuple(zip(segments, tracks, strict=True)), truth)


def read_board_views(folder: Path) -> list[BoardView]:
    """What the camera saw, image by image."""
    t_ns, rows = _read(folder / "cam0_corners.csv.gz", range(5, 12))
    xy, p_A, tag_and_corner = rows[:, :2], rows[:, 2:5], rows[:, 5:].astype(np.int64)
    corner = tag_and_corner[:, 0] * CORNERS_PER_TAG + tag_and_corner[:, 1]
    stamps, first = np.unique(t_ns, return_index=True)
    slices = [slice(a, b) for a, b in zip(first, [*first[1:], len(t_ns)], strict=True)]
    return [BoardView(int(t), corner[s], xy[s], p_A[s]) for t, s in zip(stamps, slices, strict=True)]


def corner_count(views: list[BoardView]) -> int:
    """One more than the highest identity."""
    return 1 + max(int(view.corner.max()) for view in views)


def board_poses(views: list[BoardView], camera: Camera) -> tuple[Float, Float]:
    """Camera poses on the board, ``R_AC`` (N, 3, 3) and ``p_AC`` (N, 3) m.

    Infinitesimal plane-based pose estimation (Collins and Bartoli 2014) gives the two candidates that a plane allows;
    the one with the smaller reprojection error is refined by Levenberg-Marquardt.
    """
    import cv2

    R_AC, p_AC = np.empty((len(views), 3, 3)), np.empty((len(views), 3))
    for k, view in enumerate(views):
        points = np.ascontiguousarray(view.p_A)
        rays = camera.undistort(view.xy)
        # Candidates come ordered by reprojection error.
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        rvec, tvec = cv2.solvePnPRefineLM(points, rays, np.eye(3), np.zeros(4), rvecs[0], tvecs[0])
        R_AC[k] = so3.exp(rvec.ravel()).T
        p_AC[k] = -R_AC[k] @ tvec.ravel()
    return R_AC, p_AC


def reprojection_px(views: list[BoardView], camera: Camera, R_AC: Float, p_AC: Float) -> Float:
    """(N,) distances in px between all corners as seen and as projected from these poses."""
    errors = [camera.project((v.p_A - p) @ R) - v.xy for v, R, p in zip(views, R_AC, p_AC, strict=True)]
    return np.asarray(np.linalg.norm(np.concatenate(errors), axis=1))


def _tracks(views: list[BoardView], camera: Camera) -> list[FrameTracks]:
    count = corner_count(views)
    seen_before = np.zeros(count, dtype=bool)
    appearances = np.zeros(count, dtype=np.int64)
    tracks = []
    for view in views:
        seen = np.zeros(count, dtype=bool)
        seen[view.corner] = True
        appearances += seen & ~seen_before
        seen_before = seen
        ids = view.corner + count * (appearances[view.corner] - 1)
        tracks.append(FrameTracks(view.t_ns, ids, np.zeros_like(ids), view.xy, camera.undistort(view.xy)))
    return tracks


def _read(path: Path, columns: range) -> tuple[Int, Float]:
    """Stamps (N,) and columns (N, C); apart, for a float64 would round the stamps."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; the AprilGrid recording is cam0_corners.csv.gz and imu0.csv.gz")
    t_ns = np.loadtxt(path, delimiter=",", usecols=0, dtype=np.int64)
    return t_ns, np.loadtxt(path, delimiter=",", usecols=columns, ndmin=2)
