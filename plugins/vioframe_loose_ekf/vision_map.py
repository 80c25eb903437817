"""The visual odometry's map: keyframes, and the points that they see.

*Local bundle adjustment*: the newest keyframes and all points brought to agree, the oldest keyframes held.

The keyframes held, and nothing else, keep the map's scale: what they leave open is the drift that the filter allows
for. Factors and solver are those of :mod:`vioframe.estimation.factors`, of whose states the poses alone have a part.
"""

from __future__ import annotations

import numpy as np

from vioframe.arrays import Bool
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.landmarks import in_hosts, positions
from vioframe.estimation.factors.problem import Prior, Problem, Variables, pose_columns
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, Calibrated, Sightings
from vioframe.estimation.factors.solver import solve
from vioframe.estimation.factors.tracks import TrackTable
from vioframe.geometry.triangulation import triangulate
from vioframe.types import Float, FrameTracks, Int
from vioframe_loose_ekf.state import VisionPose

# A track is triangulated from rays that are this far apart: less tells little of its depth.
_LEAST_ANGLE_RAD = 0.015
# ... and its point must be where it was seen, standard deviations; in all (root mean square) when the map is adjusted.
_LARGEST_ERROR = 3.0
_WIDTH = 2.0
"""Of Cauchy's loss, standard deviations."""
# Holds a keyframe that has lost all its points; far below what one point says, in units of V and rad.
_UNSEEING = 1e-6


class VisionMap(TrackTable):
    """The tracks of the keyframes, whose cameras' ``poses`` are in V, the oldest first.

    Tracks that are ``known`` (F,) have a point at ``p_VF`` (F, 3).
    """

    _by_track = ("ids", "known", "p_VF")

    def __init__(self) -> None:
        super().__init__()
        self.poses: list[VisionPose] = []
        self.known: Bool = np.empty(0, dtype=bool)
        self.p_VF: Float = np.empty((0, 3))

    def add_keyframe(self, pose: VisionPose, tracks: FrameTracks) -> None:
        """Append a keyframe; its tracks are known where they were before."""
        self.add_frame(tracks)
        self.poses.append(pose)

    def forget_oldest(self) -> None:
        """Drop the oldest keyframe, and with it the tracks that no other one sees."""
        self.drop_frame(0)
        del self.poses[0]

    def seen_in(self, tracks: FrameTracks) -> tuple[Int, Float, Float]:
        """The known points among ``tracks``: ids (M,), p_VF (M, 3), and where they are seen, (M, 2) normalised."""
        ids, known, seen = np.intersect1d(self.ids[self.known], tracks.ids, assume_unique=True, return_indices=True)
        return ids, self.p_VF[self.known][known], tracks.xy_normalised[seen]

    def triangulate(self, sigma: float) -> None:
        """Points of the tracks in the newest keyframe that have none yet and are seen with enough parallax."""
        tracks = np.flatnonzero(self.seen[:, -1] & ~self.known)
        seen, xy = self.seen[tracks], self.xy_normalised[tracks]
        R_VC, p_VC = _stacked(self.poses)
        rays_V = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2).swapaxes(0, 1) @ np.swapaxes(R_VC, 1, 2)
        rays_V /= np.linalg.norm(rays_V, axis=2, keepdims=True)
        apart = np.linalg.norm(rays_V - rays_V[-1], axis=2).T
        for row in np.flatnonzero((seen & (apart > _LEAST_ANGLE_RAD)).any(axis=1)):
            views = np.flatnonzero(seen[row])
            R, p, there = R_VC[views], p_VC[views], xy[row, views]
            trusted, p_VF = triangulate(R, p, there, sigma)
            if not trusted:
                continue
            q = (np.swapaxes(R, 1, 2) @ (p_VF - p)[..., None])[..., 0]
            if np.linalg.norm(q[:, :2] / q[:, 2:] - there, axis=1).max() < _LARGEST_ERROR * sigma:
                self.known[tracks[row]], self.p_VF[tracks[row]] = True, p_VF

    def stretch(self, factor: float) -> None:
        """Make it ``factor`` times as large."""
        self.p_VF = factor * self.p_VF
        self.poses = [VisionPose(pose.R_VC, factor * pose.p_VC) for pose in self.poses]


def adjust(scene: VisionMap, sigma: float, held: int, iterations: int) -> None:
    """Improve the map ``scene`` in place, its ``held`` oldest keyframes fixed; points that do not fit are dropped.

    ``sigma`` is the noise on the z = 1 plane.
    """
    rows = np.flatnonzero(scene.known)
    seen, xy = scene.seen[rows], scene.xy_normalised[rows]
    hosts = seen.argmax(axis=1)
    R_VC, p_VC = _stacked(scene.poses)
    states = StateArrays(R_VC, p_VC, *np.zeros((3, len(p_VC), 3)))
    camera = Calibrated(np.eye(3)[None], np.zeros((1, 3)), np.zeros(1), np.zeros(1), np.zeros((1, 8)))
    landmarks, in_front = in_hosts(states, camera, hosts, scene.p_VF[rows])
    seen &= in_front[:, None]

    columns = pose_columns(len(states), 1)[:-CALIBRATION_SIZE]
    n = 15 * len(states) + CALIBRATION_SIZE
    weak = Prior(_UNSEEING * np.eye(n), np.zeros(n), states, camera, np.ones(len(states), bool))
    to_plane = np.tile(np.eye(2), (*seen.shape, 1, 1))
    sightings = Sightings(seen, np.ones(seen.shape), xy, np.zeros(xy.shape), to_plane, sigma, _WIDTH)
    problem = Problem(weak, ImuFactors.stack([]), {}, sightings, first_estimates=False)
    solution = solve(problem, Variables(states, camera, landmarks), columns[6 * held :], iterations)
    x = solution.variables

    scene.poses = [VisionPose(R, p) for R, p in zip(x.states.R_WB, x.states.p_WB, strict=True)]
    scene.p_VF[rows] = positions(x.states, camera, hosts, x.landmarks)
    errors = np.sqrt(2.0) * solution.normal.errors
    scene.known[rows] = in_front & (errors < _LARGEST_ERROR) & (x.landmarks[:, 2] > 0.0)


def _stacked(poses: list[VisionPose]) -> tuple[Float, Float]:
    """R_VC (K, 3, 3) and p_VC (K, 3)."""
    return np.stack([pose.R_VC for pose in poses]), np.stack([pose.p_VC for pose in poses])
