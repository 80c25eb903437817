"""How the visual odometry begins: two frames with enough parallax, and all between them as witnesses.

The first frame is the reference, whose camera is the vision frame. The relative pose comes from the essential matrix
(Nistér, PAMI 2004) of the tracks common to both, the points from it, the frames between from the points; then all are
adjusted together. A scene that is one plane allows two poses, and a handful of wrong tracks any: what comes out must
explain nearly all tracks in all frames, and turn as the gyroscope says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.two_view import rays
from vioframe.types import Float, FrameTracks
from vioframe_loose_ekf.adjustment import adjust
from vioframe_loose_ekf.measurement import VisionPose
from vioframe_loose_ekf.resection import resect
from vioframe_loose_ekf.vision_map import Keyframe, VisionMap

# Tracks that the reference and the newest frame must share, and what part of the reference's; points that must come of
# them.
_MIN_COMMON, _LEAST_COMMON, _MIN_POINTS = 15, 0.3, 12
# Part of the tracks that must have become points, and of these that every frame must agree with.
_LEAST_EXPLAINED, _LEAST_INLIERS = 0.5, 0.7
_LARGEST_TURN_ERROR_RAD = 0.05
# Frames between reference and newest that serve as keyframes.
_BETWEEN = 3
MEDIAN_DEPTH = 5.0
"""What the unit of V is made such that it is; :func:`~vioframe.geometry.triangulation.triangulate` trusts 0.1 to 60."""
_ADJUSTMENTS = 10


class Bootstrap:
    """Collects frames from a reference on until they make a map."""

    def __init__(self, sigma: float, parallax: float) -> None:
        self._sigma, self._parallax = sigma, parallax
        self._frames: list[FrameTracks] = []
        self._R_RC: list[Float] = []  # turn of each since the reference R, as the gyroscope says

    def begin(self, tracks: FrameTracks) -> None:
        """Make ``tracks`` the reference."""
        self._frames, self._R_RC = [tracks], [np.eye(3)]

    def add(self, tracks: FrameTracks, R_CbC: Float) -> bool:
        """Take in a frame, turned by ``R_CbC`` (3, 3) from the one before; False where it has become the reference."""
        if self._frames and _enough_in_common(self._frames[0], tracks):
            self._frames.append(tracks)
            self._R_RC.append(self._R_RC[-1] @ R_CbC)
            return True
        self.begin(tracks)
        return False

    def attempt(self) -> VisionMap | None:
        """The map that the frames make; None where they do not make one yet."""
        reference, newest = self._frames[0], self._frames[-1]
        _, i, j = np.intersect1d(reference.ids, newest.ids, assume_unique=True, return_indices=True)
        xy_1, xy_2 = reference.xy_normalised[i], newest.xy_normalised[j]
        if median_parallax(xy_1, xy_2, self._R_RC[-1]) < self._parallax:
            return None
        pose = relative_pose(xy_1, xy_2, self._sigma, MEDIAN_DEPTH * self._parallax)
        if pose is None or np.linalg.norm(so3.log(pose.R_VC.T @ self._R_RC[-1])) > _LARGEST_TURN_ERROR_RAD:
            return None
        scene = VisionMap([Keyframe.of(VisionPose(np.eye(3), np.zeros(3)), reference), Keyframe.of(pose, newest)])
        scene.triangulate(self._sigma)
        if len(scene.ids) < max(_MIN_POINTS, _LEAST_EXPLAINED * len(i)):
            return None
        if not self._fill_in(scene, pose):
            return None
        _set_unit(scene)
        adjust(scene, self._sigma, 1, _ADJUSTMENTS)
        if len(scene.ids) < max(_MIN_POINTS, _LEAST_EXPLAINED * len(i)):
            return None
        _set_unit(scene)
        return scene

    def _fill_in(self, scene: VisionMap, newest: VisionPose) -> bool:
        """Put some of the frames between among the keyframes; False where one does not agree with the map."""
        count = len(self._frames)
        between = np.unique(np.linspace(0, count - 1, _BETWEEN + 2).round().astype(int))[1:-1]
        filled = [scene.keyframes[0]]
        for k in between:
            _, p_VF, xy = scene.seen_in(self._frames[k])
            guess = VisionPose(self._R_RC[k], newest.p_VC * (k / (count - 1)))
            found = resect(guess, p_VF, xy, self._sigma)
            if found is None or found.inliers.mean() < _LEAST_INLIERS:
                return False
            filled.append(Keyframe.of(found.pose, self._frames[k]))
        scene.keyframes = [*filled, scene.keyframes[-1]]
        return True


def _enough_in_common(reference: FrameTracks, tracks: FrameTracks) -> bool:
    common = np.isin(reference.ids, tracks.ids).sum()
    return bool(common >= max(_MIN_COMMON, _LEAST_COMMON * len(reference.ids)))


def median_parallax(xy_1: Float, xy_2: Float, R_C1C2: Float) -> float:
    """Median motion of tracks (N, 2) on the first view's z = 1 plane, with the turn ``R_C1C2`` (3, 3) taken out."""
    turned = rays(xy_2) @ R_C1C2.T
    ahead = turned[:, 2] > 0.1
    if not ahead.any():
        return 0.0
    moved = turned[ahead, :2] / turned[ahead, 2:] - xy_1[ahead]
    return float(np.median(np.linalg.norm(moved, axis=1)))


def relative_pose(xy_1: Float, xy_2: Float, sigma: float, baseline: float) -> VisionPose | None:
    """Pose of camera 2 in camera 1, ``baseline`` away, from matches (N, 2) of which some may be wrong."""
    import cv2

    cv2.setRNGSeed(0)
    E, mask = cv2.findEssentialMat(
        xy_1, xy_2, np.eye(3), method=cv2.RANSAC, prob=0.999, threshold=2.0 * sigma, maxIters=500
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R_C2C1, p_C2C1, _ = cv2.recoverPose(E, xy_1, xy_2, np.eye(3), mask=mask)
    return VisionPose(np.asarray(R_C2C1.T, np.float64), np.asarray(-baseline * R_C2C1.T @ p_C2C1[:, 0], np.float64))


def _set_unit(scene: VisionMap) -> None:
    """Stretch the map so that the median depth in the newest keyframe is ``MEDIAN_DEPTH``."""
    newest = scene.keyframes[-1].pose
    depth = (scene.p_VF - newest.p_VC) @ newest.R_VC[:, 2]
    stretch = MEDIAN_DEPTH / float(np.median(depth))
    scene.p_VF = stretch * scene.p_VF
    scene.keyframes = [replace(k, pose=VisionPose(k.pose.R_VC, stretch * k.pose.p_VC)) for k in scene.keyframes]
