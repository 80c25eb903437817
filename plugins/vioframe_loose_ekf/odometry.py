"""Visual odometry from tracks alone: where the camera is, up to a scale that nobody knows.

Keyframes and points in the manner of PTAM (Klein and Murray, ISMAR 2007) and of the odometry that Weiss et al. fuse:
each frame is placed against the map, some become keyframes, and the map is adjusted locally. The gyroscope only guesses
how far the camera turned between two frames, where the search for the pose starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from vioframe.types import Calibration, Float, FrameTracks, Int
from vioframe_loose_ekf.adjustment import adjust
from vioframe_loose_ekf.bootstrap import Bootstrap, median_parallax
from vioframe_loose_ekf.measurement import VisionPose
from vioframe_loose_ekf.options import LooseEkfOptions
from vioframe_loose_ekf.resection import Resection, resect
from vioframe_loose_ekf.vision_map import Keyframe, VisionMap

# Known points that must be in sight, and that must agree on where the camera is; and what part of those in sight.
_MIN_POINTS, _LEAST_INLIERS = 10, 0.3
# Part of the known points of the last keyframe below which a new one is due.
_FEW_LEFT = 0.6
_GIVE_UP_S = 0.5


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
class Sighting:
    """What the odometry says after a frame; ``pose`` and its covariance (6, 6) only where there is one.

    ``ids`` (M,) and ``p_VF`` (M, 3) are the points by which the camera was placed.
    """

    event: Event
    pose: VisionPose | None = None
    cov: Float | None = None
    ids: Int | None = None
    p_VF: Float | None = None


class VisualOdometry:
    """One frame at a time; lengths are in units of its own, which change with each new vision frame."""

    def __init__(self, calibration: Calibration, options: LooseEkfOptions) -> None:
        focal_px = calibration.camera.focal_px
        self._options = options
        self._sigma = options.pixel_sigma / focal_px
        self._parallax = options.keyframe_parallax_px / focal_px
        self._bootstrap = Bootstrap(self._sigma, options.bootstrap_parallax_px / focal_px)
        self._map: VisionMap | None = None
        self._last: VisionPose | None = None
        self._velocity_V = np.zeros(3)  # units a frame
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
        return self._place(self._map, tracks, R_CbC)

    def _begin(self, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        if not self._bootstrap.add(tracks, R_CbC):
            return Sighting(Event.REFERENCE)
        self._map = self._bootstrap.attempt()
        if self._map is None:
            return Sighting(Event.WAITING)
        ids, p_VF, xy = self._map.seen_in(tracks)
        self._last = self._map.keyframes[-1].pose
        found = resect(self._last, p_VF, xy, self._sigma)
        if found is None:
            return self.restart(tracks)
        self._velocity_V = np.zeros(3)
        self._placed_ns = tracks.t_ns
        self._known_at_keyframe = len(ids)
        return self._sighting(Event.BEGUN, found, ids, p_VF)

    def _place(self, scene: VisionMap, tracks: FrameTracks, R_CbC: Float) -> Sighting:
        assert self._last is not None
        ids, p_VF, xy = scene.seen_in(tracks)
        if len(ids) < _MIN_POINTS:
            return self.restart(tracks)
        guess = VisionPose(self._last.R_VC @ R_CbC, self._last.p_VC + self._velocity_V)
        found = resect(guess, p_VF, xy, self._sigma)
        if found is None or found.inliers.sum() < max(_MIN_POINTS, _LEAST_INLIERS * len(ids)):
            if (tracks.t_ns - self._placed_ns) * 1e-9 > _GIVE_UP_S:
                return self.restart(tracks)
            self._last = guess
            return Sighting(Event.WAITING)
        self._velocity_V = found.pose.p_VC - self._last.p_VC
        self._placed_ns = tracks.t_ns
        event = Event.TRACKED
        if self._keyframe_is_due(scene, tracks, found):
            event = Event.KEYFRAME
            scene.keep(~np.isin(scene.ids, ids[~found.inliers]))
            found, ids, p_VF = self._extend(scene, tracks, found)
        self._last = found.pose
        return self._sighting(event, found, ids, p_VF)

    def _keyframe_is_due(self, scene: VisionMap, tracks: FrameTracks, found: Resection) -> bool:
        last = scene.keyframes[-1]
        if found.inliers.sum() < _FEW_LEFT * self._known_at_keyframe:
            return True
        _, i, j = np.intersect1d(last.ids, tracks.ids, assume_unique=True, return_indices=True)
        moved = median_parallax(last.xy[i], tracks.xy_normalised[j], last.pose.R_VC.T @ found.pose.R_VC)
        return moved > self._parallax

    def _extend(self, scene: VisionMap, tracks: FrameTracks, found: Resection) -> tuple[Resection, Int, Float]:
        """Make a keyframe of the frame, triangulate what it shows anew, adjust; the frame's pose after that."""
        options = self._options
        scene.add_keyframe(Keyframe.of(found.pose, tracks), options.keyframes)
        scene.triangulate(self._sigma)
        adjust(scene, self._sigma, options.held_keyframes, options.adjustments)
        ids, p_VF, xy = scene.seen_in(tracks)
        self._known_at_keyframe = len(ids)
        after = resect(scene.keyframes[-1].pose, p_VF, xy, self._sigma)
        return after or found, ids, p_VF

    def _sighting(self, event: Event, found: Resection, ids: Int, p_VF: Float) -> Sighting:
        good = found.inliers if len(found.inliers) == len(ids) else np.ones(len(ids), bool)
        return Sighting(event, found.pose, found.cov, ids[good], p_VF[good])
