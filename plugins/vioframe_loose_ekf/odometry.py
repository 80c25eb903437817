"""Visual odometry from tracks alone: where the camera is, up to a scale that nobody knows.

Keyframes and points in the manner of PTAM (Klein and Murray, ISMAR 2007) and of the odometry that Weiss et al. fuse:
each frame is placed against the map, some become keyframes, and the map is adjusted locally. The gyroscope only guesses
how far the camera turned between two frames, where the search for the pose starts.

*How it begins*: two frames with enough parallax, and all between them as witnesses.

The first frame is the reference, whose camera is the vision frame. The relative pose comes from the essential matrix
(Nistér, PAMI 2004) of the tracks common to both, the points from it, the frames between from the points; then all are
adjusted together. A scene that is one plane allows two poses, and a handful of wrong tracks any: what comes out must
explain nearly all tracks in all frames, and turn as the gyroscope says.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.two_view import median_parallax
from vioframe.types import Calibration, Float, FrameTracks, Int
from vioframe_loose_ekf.options import LooseEkfOptions
from vioframe_loose_ekf.resection import resect
from vioframe_loose_ekf.state import VisionPose
from vioframe_loose_ekf.vision_map import VisionMap, adjust

# Known points that must be in sight, and that must agree on where the camera is; and what part of those in sight.
_MIN_POINTS, _LEAST_INLIERS = 10, 0.3
# Part of the known points of the last keyframe below which a new one is due.
_FEW_LEFT = 0.6
_GIVE_UP_S = 0.5
# Local bundle adjustment: it moves the newest keyframes, in a few steps at most, and leaves the others alone; fewer
# than two do not hold the scale.
_ADJUSTED, _STEPS, _LEAST_HELD = 5, 4, 2
# Tracks that the reference and the newest frame must share, and what part of the reference's; points that must come of
# them.
_MIN_COMMON, _LEAST_COMMON, _FEWEST_MADE = 15, 0.3, 12
# Part of the tracks that must have become points, and of these that every frame must agree with.
_LEAST_EXPLAINED, _LEAST_AGREEING = 0.5, 0.7
_LARGEST_TURN_ERROR_RAD = 0.05
# Frames between reference and newest that serve as keyframes.
_BETWEEN = 3
MEDIAN_DEPTH = 5.0
"""What the unit of V is made such that it is; :func:`~vioframe.geometry.triangulation.triangulate` trusts 0.1 to 60."""
_BOOTSTRAP_STEPS = 10


class Event(Enum):
    """What a frame was to the odometry."""

    REFERENCE = auto()
    """A new vision frame begins at this frame's camera; its map has still to be made."""
    WAITING = auto()
    """Not enough parallax since the reference yet, or no pose of this frame."""
    BEGUN = auto()
    """The map is made; this is the first pose."""
    TRACKED = auto()
    KEYFRAME = auto()


@dataclass(frozen=True, slots=True)
class Placement:
    """A frame placed against the map: its ``pose`` with covariance (6, 6) given the points, and the points that agree.

    The covariance is that of [rotation in the camera, position in V]. ``ids`` (M,), ``p_VF`` (M, 3).
    """

    pose: VisionPose
    cov: Float
    ids: Int
    p_VF: Float


@dataclass(frozen=True, slots=True)
class Sighting:
    """What the odometry says after a frame; ``placement`` is None where it cannot say where the camera is."""

    event: Event
    placement: Placement | None = None


class VisualOdometry:
    """One frame at a time; lengths are in units of its own, which change with each new vision frame."""

    def __init__(self, calibration: Calibration, options: LooseEkfOptions) -> None:
        focal_px = calibration.cameras[0].model.focal_px
        self._options = options
        self._sigma = options.pixel_sigma / focal_px
        self._parallax = options.keyframe_parallax_px / focal_px
        self._bootstrap = Bootstrap(self._sigma, options.bootstrap_parallax_px / focal_px)
        self.map: VisionMap | None = None
        """Keyframes and points; None while there are none."""
        self._motion = _Motion(VisionPose(np.eye(3), np.zeros(3)), 0)
        self._placed_ns = 0
        self._known_at_keyframe = 0

    def restart(self, tracks: FrameTracks) -> Sighting:
        """Forget the map; a new vision frame begins with ``tracks``."""
        self.map = None
        self._bootstrap.begin(tracks)
        return Sighting(Event.REFERENCE)

    def track(self, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        """Take in a frame, turned by ``R_CbC`` (3, 3) from the one before as far as anybody knows."""
        if self.map is None:
            return self._begin(tracks, R_CbC)
        return self._follow(self.map, tracks, R_CbC)

    def _begin(self, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        if not self._bootstrap.add(tracks, R_CbC):
            return Sighting(Event.REFERENCE)
        scene = self._bootstrap.attempt()
        if scene is None:
            return Sighting(Event.WAITING)
        first = self._place(scene, tracks, scene.poses[-1])
        if first is None:
            return Sighting(Event.WAITING)
        self.map = scene
        self._motion = _Motion(first.pose, tracks.t_ns)
        self._placed_ns = tracks.t_ns
        self._known_at_keyframe = len(first.ids)
        return Sighting(Event.BEGUN, first)

    def _follow(self, scene: VisionMap, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        if np.isin(scene.ids[scene.known], tracks.ids).sum() < _MIN_POINTS:
            return self.restart(tracks)  # tracks that ended never come back
        guess = self._motion.predicted(tracks.t_ns, R_CbC)
        placement = self._place(scene, tracks, guess)
        if placement is None:
            if (tracks.t_ns - self._placed_ns) * 1e-9 > _GIVE_UP_S:
                return self.restart(tracks)
            self._motion = self._motion.through(guess, tracks.t_ns)
            return Sighting(Event.WAITING)
        event = Event.TRACKED
        if self._keyframe_is_due(scene, tracks, placement):
            event = Event.KEYFRAME
            placement = self._extend(scene, tracks, placement)
        self._motion = self._motion.through(placement.pose, tracks.t_ns)
        self._placed_ns = tracks.t_ns
        return Sighting(event, placement)

    def _place(self, scene: VisionMap, tracks: FrameTracks, guess: VisionPose) -> Placement | None:
        ids, p_VF, xy = scene.seen_in(tracks)
        found = resect(guess, p_VF, xy, self._sigma)
        if found is None or found.inliers.sum() < max(_MIN_POINTS, _LEAST_INLIERS * len(ids)):
            return None
        return Placement(found.pose, found.cov, ids[found.inliers], p_VF[found.inliers])

    def _keyframe_is_due(self, scene: VisionMap, tracks: FrameTracks, placement: Placement) -> bool:
        if len(placement.ids) < _FEW_LEFT * self._known_at_keyframe:
            return True
        last = scene.seen[:, -1]
        _, i, j = np.intersect1d(scene.ids[last], tracks.ids, assume_unique=True, return_indices=True)
        turn = scene.poses[-1].R_VC.T @ placement.pose.R_VC
        return median_parallax(scene.xy_normalised[last, -1][i], tracks.xy_normalised[j], turn) > self._parallax

    def _extend(self, scene: VisionMap, tracks: FrameTracks, placement: Placement) -> Placement:
        """Make a keyframe of the frame, triangulate what it shows anew, adjust; where the frame is after that."""
        scene.known &= ~np.isin(scene.ids, np.setdiff1d(tracks.ids, placement.ids))
        scene.add_keyframe(placement.pose, tracks)
        if len(scene.poses) > self._options.keyframes:
            scene.forget_oldest()
        scene.triangulate(self._sigma)
        held = max(len(scene.poses) - _ADJUSTED, _LEAST_HELD)
        adjust(scene, self._sigma, held, _STEPS)
        placement = self._place(scene, tracks, scene.poses[-1]) or placement
        self._known_at_keyframe = len(placement.ids)
        return placement


@dataclass(frozen=True, slots=True)
class _Motion:
    """Where the camera was last, and how fast it went (units of V a second)."""

    pose: VisionPose
    t_ns: int
    velocity_V: Float = field(default_factory=lambda: np.zeros(3))

    def predicted(self, t_ns: int, R_CbC: Float) -> VisionPose:
        """Gone on like that, and turned by ``R_CbC`` (3, 3)."""
        dt = (t_ns - self.t_ns) * 1e-9
        return VisionPose(self.pose.R_VC @ R_CbC, self.pose.p_VC + dt * self.velocity_V)

    def through(self, pose: VisionPose, t_ns: int) -> _Motion:
        dt = (t_ns - self.t_ns) * 1e-9
        return _Motion(pose, t_ns, (pose.p_VC - self.pose.p_VC) / dt)


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
        scene = VisionMap()
        scene.add_keyframe(VisionPose(np.eye(3), np.zeros(3)), reference)
        scene.add_keyframe(pose, newest)
        scene.triangulate(self._sigma)
        enough = max(_FEWEST_MADE, _LEAST_EXPLAINED * len(i))
        if scene.known.sum() < enough:
            return None
        whole = self._filled_in(scene)
        if whole is None:
            return None
        _set_unit(whole)
        adjust(whole, self._sigma, 1, _BOOTSTRAP_STEPS)
        if whole.known.sum() < enough:
            return None
        _set_unit(whole)
        return whole

    def _filled_in(self, scene: VisionMap) -> VisionMap | None:
        """``scene`` with some of the frames between its two keyframes; None where one does not agree with it."""
        last = len(self._frames) - 1
        first_pose, last_pose = scene.poses
        whole = VisionMap()
        whole.add_keyframe(first_pose, self._frames[0])
        for k in np.unique(np.linspace(0, last, _BETWEEN + 2).round().astype(int))[1:-1]:
            _, p_VF, xy = scene.seen_in(self._frames[k])
            found = resect(VisionPose(self._R_RC[k], last_pose.p_VC * (k / last)), p_VF, xy, self._sigma)
            if found is None or found.inliers.mean() < _LEAST_AGREEING:
                return None
            whole.add_keyframe(found.pose, self._frames[k])
        whole.add_keyframe(last_pose, self._frames[-1])
        whole.known = np.isin(whole.ids, scene.ids[scene.known])
        whole.p_VF[whole.known] = scene.p_VF[scene.known]
        return whole


def _enough_in_common(reference: FrameTracks, tracks: FrameTracks) -> bool:
    common = np.isin(reference.ids, tracks.ids).sum()
    return bool(common >= max(_MIN_COMMON, _LEAST_COMMON * len(reference.ids)))


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
    newest = scene.poses[-1]
    depth = (scene.p_VF[scene.known] - newest.p_VC) @ newest.R_VC[:, 2]
    scene.stretch(MEDIAN_DEPTH / float(np.median(depth)))
