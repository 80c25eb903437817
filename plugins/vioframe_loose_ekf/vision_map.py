"""The visual odometry's map: keyframes, and the points that they see.

*Local bundle adjustment*: the newest keyframes and all points brought to agree, the oldest keyframes held.

The keyframes held, and nothing else, keep the map's scale: what they leave open is the drift that the filter allows
for. Factors and solver are those of :mod:`vioframe.estimation.factors`, of whose states the poses alone have a part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.landmarks import in_hosts, positions
from vioframe.estimation.factors.problem import Prior, Problem, Variables, pose_columns
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, Calibrated, Sightings
from vioframe.estimation.factors.solver import solve
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


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A frame of the map: the camera's ``pose`` in V, and what it saw, ``ids`` (N,) ascending at ``xy`` (N, 2)."""

    pose: VisionPose
    ids: Int
    xy: Float

    @classmethod
    def of(cls, pose: VisionPose, tracks: FrameTracks) -> Keyframe:
        order = np.argsort(tracks.ids)
        return cls(pose, tracks.ids[order], tracks.xy_normalised[order])


class VisionMap:
    """``keyframes``, the oldest first; points ``ids`` (L,) ascending at ``p_VF`` (L, 3)."""

    def __init__(self, keyframes: list[Keyframe]) -> None:
        self.keyframes = keyframes
        self.ids: Int = np.empty(0, np.int64)
        self.p_VF: Float = np.empty((0, 3))

    def seen_in(self, tracks: FrameTracks) -> tuple[Int, Float, Float]:
        """The known points among ``tracks``: ids (M,), p_VF (M, 3), and where they are seen, (M, 2) normalised."""
        ids, known, seen = np.intersect1d(self.ids, tracks.ids, assume_unique=True, return_indices=True)
        return ids, self.p_VF[known], tracks.xy_normalised[seen]

    def add_keyframe(self, keyframe: Keyframe, most: int) -> None:
        """Append a keyframe; of more than ``most`` the oldest goes, and with it the points that no other one sees."""
        self.keyframes = [*self.keyframes, keyframe][-most:]
        self.keep(np.isin(self.ids, np.concatenate([k.ids for k in self.keyframes])))

    def keep(self, keep: np.ndarray) -> None:
        """Only the points ``keep`` (L,)."""
        self.ids, self.p_VF = self.ids[keep], self.p_VF[keep]

    def sightings(self, ids: Int) -> Float:
        """Where each keyframe saw the tracks ``ids`` (L,): (K, L, 2) on the z = 1 plane, NaN where it did not."""
        xy = np.full((len(self.keyframes), len(ids), 2), np.nan)
        for k, keyframe in enumerate(self.keyframes):
            _, column, row = np.intersect1d(ids, keyframe.ids, assume_unique=True, return_indices=True)
            xy[k, column] = keyframe.xy[row]
        return xy

    def poses(self) -> tuple[Float, Float]:
        """R_VC (K, 3, 3) and p_VC (K, 3) of the keyframes."""
        return np.stack([k.pose.R_VC for k in self.keyframes]), np.stack([k.pose.p_VC for k in self.keyframes])

    def triangulate(self, sigma: float) -> None:
        """Points of the tracks in the newest keyframe that have none yet and are seen with enough parallax."""
        tracks = np.setdiff1d(self.keyframes[-1].ids, self.ids, assume_unique=True)
        xy = self.sightings(tracks)
        R_VC, p_VC = self.poses()
        rays_V = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2) @ np.swapaxes(R_VC, 1, 2)
        rays_V /= np.linalg.norm(rays_V, axis=2, keepdims=True)
        apart = np.linalg.norm(rays_V - rays_V[-1], axis=2)
        wide = np.flatnonzero((apart > _LEAST_ANGLE_RAD).any(axis=0))  # NaN is never larger
        ids, points = [], []
        for column in wide:
            views = np.flatnonzero(~np.isnan(apart[:, column]))
            R, p, seen = R_VC[views], p_VC[views], xy[views, column]
            trusted, p_VF = triangulate(R, p, seen, sigma)
            if not trusted:
                continue
            q = (np.swapaxes(R, 1, 2) @ (p_VF - p)[..., None])[..., 0]
            if np.linalg.norm(q[:, :2] / q[:, 2:] - seen, axis=1).max() < _LARGEST_ERROR * sigma:
                ids.append(tracks[column])
                points.append(p_VF)
        if ids:
            self._merge(np.array(ids), np.array(points))

    def _merge(self, ids: Int, p_VF: Float) -> None:
        ids, p_VF = np.concatenate([self.ids, ids]), np.concatenate([self.p_VF, p_VF])
        order = np.argsort(ids)
        self.ids, self.p_VF = ids[order], p_VF[order]


def adjust(scene: VisionMap, sigma: float, held: int, iterations: int) -> None:
    """Improve the map ``scene`` in place, its ``held`` oldest keyframes fixed; points that do not fit are dropped.

    ``sigma`` is the noise on the z = 1 plane.
    """
    xy = np.ascontiguousarray(np.swapaxes(scene.sightings(scene.ids), 0, 1))
    seen = ~np.isnan(xy[..., 0])
    hosts = seen.argmax(axis=1)
    R_VC, p_VC = scene.poses()
    states = StateArrays(R_VC, p_VC, *np.zeros((3, len(p_VC), 3)))
    camera = Calibrated(np.eye(3), np.zeros(3))
    landmarks, in_front = in_hosts(states, camera, hosts, scene.p_VF)
    seen &= in_front[:, None]

    columns = pose_columns(len(states))[:-CALIBRATION_SIZE]
    n = 15 * len(states) + CALIBRATION_SIZE
    weak = Prior(_UNSEEING * np.eye(n), np.zeros(n), states, camera, np.ones(len(states), bool))
    to_plane = np.tile(np.eye(2), (*seen.shape, 1, 1))
    sightings = Sightings(seen, xy, np.zeros(xy.shape), to_plane, sigma, _WIDTH)
    problem = Problem(weak, ImuFactors.stack([]), {}, sightings, first_estimates=False)
    x = solve(problem, Variables(states, camera, landmarks), columns[6 * held :], iterations).variables

    poses = zip(scene.keyframes, x.states.R_WB, x.states.p_WB, strict=True)
    scene.keyframes = [replace(keyframe, pose=VisionPose(R, p)) for keyframe, R, p in poses]
    scene.p_VF = positions(x.states, camera, hosts, x.landmarks)
    errors = np.sqrt(2.0) * sightings.errors(x.poses, camera, x.landmarks)
    scene.keep(in_front & (errors < _LARGEST_ERROR) & (x.landmarks[:, 2] > 0.0))
