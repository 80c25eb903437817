"""Which frames become keyframes of the graph, and what is known of the features they saw."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.geometry.two_view import median_parallax
from vioframe.types import NS_PER_S, Calibration, Float, FrameTracks, Image, NavState, Status, Step

# A feature may get its position later than the frame that sees it: from the frames that follow.
_WAIT_NS = NS_PER_S
_MIN_COMMON = 0.5
# From one frame to the next a body turns steadily, if they are no farther apart.
_STEADY_S = 0.2
_UNKNOWN = np.full(3, np.nan)
# Features of which so many are remembered are looked through for those that nobody asks for any more.
_MANY = 5000


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame of the graph, in the world of the odometry.

    ``segment`` numbers the stretches of tracking between resets. ``R_WC`` and ``p_WC`` are the pose of the camera
    ``model`` when the image was taken, by the calibration that the back-end had learned by then. ``p_WF`` (N, 3) m is
    what is known of the tracked features a second later, NaN where nothing is, and ``parallax`` (N,) rad the angle
    between the rays to each from where it was seen first and from where it was seen last by then; inf where that is
    one place.
    """

    state: NavState
    segment: int
    image: Image
    tracks: FrameTracks
    model: Camera
    R_WC: Float
    p_WC: Float
    p_WF: Float
    parallax: Float


class KeyframeSelector:
    """Thins the frames of any back-end by how much the picture has moved, turning left out.

    Of a rig the first camera's alone: what it has seen before it finds again by itself.
    """

    def __init__(self, calibration: Calibration, parallax_px: float) -> None:
        self._camera = calibration.cameras[0]
        self._p_BC = [camera.p_BC for camera in calibration.cameras]
        self._offset_ns = self._camera.time_offset_ns
        self._parallax = parallax_px / self._camera.model.focal_px
        self._previous: NavState | None = None
        self._pending: deque[Keyframe] = deque()
        self._last: Keyframe | None = None
        self._p_WF: dict[int, Float] = {}
        # From where each feature was seen first, and last.
        self._seen_from: dict[int, tuple[Float, Float]] = {}
        self._tracking = False
        self.segment = -1

    def add(self, step: Step) -> list[Keyframe]:
        """Take in a frame; the keyframes, of a second ago, about which everything is known by now."""
        estimate, state = step.estimate, step.estimate.state
        if estimate.status is not Status.TRACKING or state is None:
            self._tracking = False
            return self.flush()
        ready = []
        if estimate.calibration is not None:
            self._camera = estimate.calibration.calibration.cameras[0]
        if not self._tracking:
            ready = self.flush()
            self._tracking, self._last, self._previous = True, None, None
            self.segment += 1
            # What a start has found, the readings count with.
            self._offset_ns = self._camera.time_offset_ns
        self._p_WF.update(zip(estimate.landmark_ids.tolist(), estimate.p_WF, strict=True))
        R_WC, p_WC = self._camera_pose(state)
        self._previous = state
        image, tracks = next(iter(step.frames.images), None), step.tracks.of_camera(0)
        self._see(step.tracks, state)
        due = self._last is None or self._moved_on(self._last, tracks, R_WC)
        if due and image is not None and len(tracks.ids):
            pose, known = (R_WC, p_WC), (_UNKNOWN, _UNKNOWN)
            self._last = Keyframe(state, self.segment, image, tracks, self._camera.model, *pose, *known)
            self._pending.append(self._last)
        if len(self._seen_from) > _MANY:
            self._forget(step.tracks)
        while self._pending and step.frames.t_ns - self._pending[0].state.t_ns >= _WAIT_NS:
            ready.append(self._complete(self._pending.popleft()))
        return ready

    def flush(self) -> list[Keyframe]:
        """The keyframes that still wait, with what is known of them: nothing more will come."""
        ready = [self._complete(pending) for pending in self._pending]
        self._pending.clear()
        self._p_WF.clear()
        self._seen_from.clear()
        return ready

    def _camera_pose(self, state: NavState) -> tuple[Float, Float]:
        """R_WC (3, 3) and p_WC (3,) when the image was taken, which by what is learned is not when it was stamped."""
        R_WB, p_WB, before, dt = state.R_WB, state.p_WB, self._previous, 0.0
        late_s = (self._camera.time_offset_ns - self._offset_ns) * 1e-9
        if before is not None:
            dt = (state.t_ns - before.t_ns) * 1e-9
        if before is not None and 0.0 < dt < _STEADY_S:
            rate_B = so3.log(before.R_WB.T @ R_WB) / dt
            R_WB, p_WB = R_WB @ so3.exp(rate_B * late_s), p_WB + state.v_WB * late_s
        return self._camera.pose(R_WB, p_WB)

    def _see(self, tracks: FrameTracks, state: NavState) -> None:
        """Remember from where features were seen, by every camera: two see what is far though the body stands still."""
        for number, p_BC in enumerate(self._p_BC):
            p_WC = state.p_WB + state.R_WB @ p_BC
            for i in tracks.of_camera(number).ids.tolist():
                self._seen_from[i] = self._seen_from.get(i, (p_WC,))[0], p_WC

    def _moved_on(self, last: Keyframe, tracks: FrameTracks, R_WC: Float) -> bool:
        _, i, j = np.intersect1d(last.tracks.ids, tracks.ids, assume_unique=True, return_indices=True)
        if len(i) < _MIN_COMMON * len(last.tracks.ids):
            return True
        before, now = last.tracks.xy_normalised[i], tracks.xy_normalised[j]
        return median_parallax(now, before, R_WC.T @ last.R_WC) > self._parallax

    def _forget(self, tracks: FrameTracks) -> None:
        """Drop what no keyframe in waiting and no track of now asks for."""
        needed = set(tracks.ids.tolist()).union(*(pending.tracks.ids.tolist() for pending in self._pending))
        self._p_WF = {i: p for i, p in self._p_WF.items() if i in needed}
        self._seen_from = {i: seen for i, seen in self._seen_from.items() if i in needed}

    def _complete(self, pending: Keyframe) -> Keyframe:
        ids = pending.tracks.ids.tolist()
        p_WF = np.array([self._p_WF.get(i, _UNKNOWN) for i in ids]).reshape(-1, 3)
        first, last = (p_WF - np.array([self._seen_from[i][end] for i in ids]).reshape(-1, 3) for end in (0, 1))
        parallax = np.arctan2(np.linalg.norm(np.cross(first, last), axis=1), np.sum(first * last, axis=1))
        parallax[(first == last).all(axis=1)] = np.inf  # seen but once: who knows where it is knows it by other means
        return replace(pending, p_WF=p_WF, parallax=parallax)
