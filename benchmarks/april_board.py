"""EuRoC's recording of an AprilGrid: real corners with perfect association, real IMU, and truth by PnP.

The board's metric geometry gives a pose from each image alone, so the truth owes nothing to the IMU that it judges;
only the vertical is taken from it, for an estimate is compared after alignment in position and yaw.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from position_clock import position_clock

from vioframe.errors import DatasetError
from vioframe.estimation.inertial.preintegration import join_segments, preintegrate
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.geometry.trajectory import Trajectory
from vioframe.geometry.two_view import rays
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import TrackSequence, cut_segments
from vioframe.simulation.scenario import interpolate_poses
from vioframe.types import Calibration, Float, FrameTracks, Int

CORNERS_PER_TAG = 4
# A lens is fitted to every so many views: neighbours are alike, but few see the board at the edge of the image.
_VIEWS_APART = 4
_FRAMES_TURNED = 4
_STEP_NS = 5_000_000


@dataclass(frozen=True, slots=True)
class BoardView:
    """The corners found in one image: ``corner`` (N,) identities, ``xy`` (N, 2) px, ``p_A`` (N, 3) m on the board A."""

    t_ns: int
    corner: Int
    xy: Float
    p_A: Float


def april_sequence(
    folder: Path, calibration: Calibration | None = None, truth_by: tuple[Camera, Float] | None = None
) -> TrackSequence:
    """The recording in ``folder``, which holds ``cam0_corners.csv.gz`` and ``imu0.csv.gz``.

    ``calibration`` is EuRoC's as published unless given, and is what an estimator is told. Truth is by the
    :func:`fitted_lens` or by another, ``truth_by``, with R_CF likewise. A corner that comes back into view gets a new
    id, as it would from any tracker; ids of one corner differ by multiples of :func:`corner_count`. Raises
    :class:`DatasetError` where a file is missing.
    """
    calibration = calibration or packaged_calibration("euroc", cameras=["cam0"])
    imu_ns, imu = _read(folder / "imu0.csv.gz", range(1, 7))
    gyro_B, accel_B = imu[:, :3], imu[:, 3:]
    views = read_board_views(folder)
    lens, R_CF = truth_by or fitted_lens(views, calibration.cameras[0].model)
    views = [v for v in views if imu_ns[0] <= v.t_ns <= imu_ns[-1]]
    frames_ns = np.array([view.t_ns for view in views], np.int64)
    segments = cut_segments(imu_ns, gyro_B, accel_B, frames_ns)
    tracks = _tracks(views, calibration.cameras[0].model)

    R_AF, p_AC = board_poses(views, lens)
    R_AB = R_AF @ R_CF.T @ calibration.cameras[0].R_BC.T
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


def fitted_lens(views: list[BoardView], camera: Camera) -> tuple[Camera, Float]:
    """The radtan lens F that explains the corners of some ``views`` best, from ``camera`` on, and R_CF (3, 3) to that.

    A lens that is off to one side and a camera that is turned to the other look nearly alike: R_CF is what brings the
    rays of both together. (Zhang, "A flexible new technique for camera calibration", PAMI 2000.)
    """
    import cv2

    some = views[1::_VIEWS_APART]  # the first is older than any reading
    points, pixels = (
        [np.asarray(a, np.float32) for a in seen] for seen in ([v.p_A for v in some], [v.xy for v in some])
    )
    k1_to_p2 = np.append(camera.distortion, 0.0)  # and k3, which stays zero
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    _, K, distortion, _, _ = cv2.calibrateCamera(points, pixels, camera.resolution, camera.K, k1_to_p2, flags=flags)
    fitted = camera.with_intrinsics(np.append(K[[0, 1, 0, 1], [0, 1, 2, 2]], distortion.ravel()[:4]))
    rays_C, rays_F = (rays(lens.undistort(np.concatenate([v.xy for v in some]))) for lens in (camera, fitted))
    rays_C, rays_F = (seen / np.linalg.norm(seen, axis=1, keepdims=True) for seen in (rays_C, rays_F))
    return fitted, so3.project(rays_C.T @ rays_F)


def board_poses(views: list[BoardView], camera: Camera) -> tuple[Float, Float]:
    """Poses on the board of a ``camera`` with a radtan lens, ``R_AC`` (N, 3, 3) and ``p_AC`` (N, 3) m.

    Infinitesimal plane-based pose estimation (Collins and Bartoli 2014) gives the two candidates that a plane allows;
    the one with the smaller reprojection error is refined by Levenberg-Marquardt, in pixels.
    """
    import cv2

    R_AC, p_AC, distortion = np.empty((len(views), 3, 3)), np.empty((len(views), 3)), np.array(camera.distortion)
    for k, view in enumerate(views):
        points = np.ascontiguousarray(view.p_A)
        undistorted = camera.undistort(view.xy)
        # Candidates come ordered by reprojection error.
        _, rvecs, tvecs, _ = cv2.solvePnPGeneric(points, undistorted, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        rvec, tvec = cv2.solvePnPRefineLM(points, view.xy, camera.K, distortion, rvecs[0], tvecs[0])
        R_AC[k] = so3.exp(rvec.ravel()).T
        p_AC[k] = -R_AC[k] @ tvec.ravel()
    return R_AC, p_AC


def reprojection_px(views: list[BoardView], camera: Camera, R_AC: Float, p_AC: Float) -> Float:
    """(N,) distances in px between all corners as seen and as projected from these poses."""
    errors = [camera.project((v.p_A - p) @ R) - v.xy for v, R, p in zip(views, R_AC, p_AC, strict=True)]
    return np.asarray(np.linalg.norm(np.concatenate(errors), axis=1))


def turned_otherwise(sequence: TrackSequence) -> float:
    """The median angle, rad, by which truth and gyroscope disagree over 0.2 s, the bias taken out as the mean.

    The gyroscope has no part in the truth, and an error of the lens none in the gyroscope.
    """
    R_WB, segments = sequence.ground_truth.R_WB, [imu for imu, _ in sequence.packets]
    off = []
    for k in range(0, len(R_WB) - _FRAMES_TURNED, _FRAMES_TURNED):
        readings = join_segments(segments[k + 1 : k + 1 + _FRAMES_TURNED])
        turn = preintegrate(readings, np.zeros(3), np.zeros(3), sequence.calibration.imu).dR
        off.append(so3.log(R_WB[k + _FRAMES_TURNED].T @ R_WB[k] @ turn))
    return float(np.median(np.linalg.norm(off - np.mean(off, axis=0), axis=1)))


def gravity_in_frame(poses: Trajectory, imu_ns: Int, accel_B: Float) -> Float:
    """Gravity (3,) m/s^2 in the frame A of ``poses`` (R_AB, p_AB), from the accelerometer's (N, 3) readings."""
    often_ns = np.arange(poses.t_ns[0], poses.t_ns[-1], _STEP_NS)
    often = Trajectory(often_ns, *interpolate_poses(poses.t_ns, poses.R_WB, poses.p_WB, often_ns))
    return position_clock(often, imu_ns, accel_B).g_W


def rotation_to_vertical(g_A: Float) -> Float:
    """The smallest rotation R_WA (3, 3) that brings gravity (3,) to W's -z."""
    down_A = g_A / np.linalg.norm(g_A)
    axis = np.cross(down_A, [0.0, 0.0, -1.0])
    sine, cosine = np.linalg.norm(axis), -down_A[2]
    unit = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    return so3.exp(unit * np.arctan2(sine, cosine))


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
