"""The visual odometry's map: keyframes, and the points that they see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.geometry.triangulation import triangulate
from vioframe.types import Float, FrameTracks, Int
from vioframe_loose_ekf.measurement import VisionPose

# A track is triangulated from rays that are this far apart: less tells little of its depth.
_LEAST_ANGLE_RAD = 0.015
# ... and its point must be where it was seen, standard deviations.
_LARGEST_ERROR = 3.0


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
