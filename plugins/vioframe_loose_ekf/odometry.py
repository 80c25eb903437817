"""Visual odometry from tracks alone: where the camera is, up to a scale that nobody knows.

Keyframes and points in the manner of PTAM (Klein and Murray, ISMAR 2007) and of the odometry that Weiss et al. fuse:
each frame is placed against the map, some become keyframes, and the map is adjusted locally. The gyroscope only guesses
how far the camera turned between two frames, where the search for the pose starts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np

from vioframe.types import Calibration, Float, FrameTracks, Int
from vioframe_loose_ekf.adjustment import adjust
from vioframe_loose_ekf.bootstrap import Bootstrap, median_parallax
from vioframe_loose_ekf.measurement import VisionPose
from vioframe_loose_ekf.options import LooseEkfOptions
from vioframe_loose_ekf.resection import resect
from vioframe_loose_ekf.vision_map import Keyframe, VisionMap

# Known points that must be in sight, and that must agree on where the camera is; and what part of those in sight.
_MIN_POINTS, _LEAST_INLIERS = 10, 0.3
# Part of the known points of the last keyframe below which a new one is due.
_FEW_LEFT = 0.6
_GIVE_UP_S = 0.5
# Keyframes that bundle adjustment must leave alone: fewer do not hold the scale.
_LEAST_HELD = 2


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
        self._map: VisionMap | None = None
        self._motion = _Motion(VisionPose(np.eye(3), np.zeros(3)), 0)
        self._placed_ns = 0
        self._known_at_keyframe = 0

    @property
    def map(self) -> VisionMap | None:
        """Keyframes and points; None while there are none."""
        return self._map

    def restart(self, tracks: FrameTracks) -> Sighting:
        """Forget the map; a new vision frame begins with ``tracks``."""
        self._map = None
        self._bootstrap.begin(tracks)
        return Sighting(Event.REFERENCE)

    def track(self, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        """Take in a frame, turned by ``R_CbC`` (3, 3) from the one before as far as anybody knows."""
        if self._map is None:
            return self._begin(tracks, R_CbC)
        return self._follow(self._map, tracks, R_CbC)

    def _begin(self, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        if not self._bootstrap.add(tracks, R_CbC):
            return Sighting(Event.REFERENCE)
        scene = self._bootstrap.attempt()
        if scene is None:
            return Sighting(Event.WAITING)
        first = self._place(scene, tracks, scene.keyframes[-1].pose)
        if first is None:
            return Sighting(Event.WAITING)
        self._map = scene
        self._motion = _Motion(first.pose, tracks.t_ns)
        self._placed_ns = tracks.t_ns
        self._known_at_keyframe = len(first.ids)
        return Sighting(Event.BEGUN, first)

    def _follow(self, scene: VisionMap, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        if np.isin(scene.ids, tracks.ids).sum() < _MIN_POINTS:
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
        last = scene.keyframes[-1]
        if len(placement.ids) < _FEW_LEFT * self._known_at_keyframe:
            return True
        _, i, j = np.intersect1d(last.ids, tracks.ids, assume_unique=True, return_indices=True)
        moved = median_parallax(last.xy[i], tracks.xy_normalised[j], last.pose.R_VC.T @ placement.pose.R_VC)
        return moved > self._parallax

    def _extend(self, scene: VisionMap, tracks: FrameTracks, placement: Placement) -> Placement:
        """Make a keyframe of the frame, triangulate what it shows anew, adjust; where the frame is after that."""
        options = self._options
        outliers = np.setdiff1d(tracks.ids, placement.ids)
        scene.keep(~np.isin(scene.ids, outliers))
        scene.add_keyframe(Keyframe.of(placement.pose, tracks), options.keyframes)
        scene.triangulate(self._sigma)
        held = max(len(scene.keyframes) - options.adjusted_keyframes, _LEAST_HELD)
        adjust(scene, self._sigma, held, options.adjustments)
        placement = self._place(scene, tracks, scene.keyframes[-1].pose) or placement
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
