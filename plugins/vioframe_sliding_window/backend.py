"""The optimiser as a recipe: :meth:`SlidingWindow.process` reads top to bottom.

Qin, Li, Shen, "VINS-Mono: A Robust and Versatile Monocular Visual-Inertial State Estimator", T-RO 2018, with first
estimates kept in the prior and landmarks of three degrees of freedom. See ``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

import numpy as np

from vioframe.errors import DivergedError
from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.estimation.standstill import Standstill
from vioframe.stopwatch import Stopwatch
from vioframe.types import Estimate, FrameTracks, ImuSegment, NavState, Start, Status
from vioframe_sliding_window.options import SlidingWindowOptions
from vioframe_sliding_window.window import Window

# Landmarks without which a frame counts as blind.
_MIN_LANDMARKS = 5
# A body that turns no faster than this, rad/s, does not lose sight of this many tracks from one frame to the next.
_SLOW_TURN, _MANY_TRACKS = 1.0, 20
# Part of the landmarks in sight that do not fit, beyond which the estimate is what does not.
_MOST = 0.8


class SlidingWindow:
    """One frame at a time; settings in :class:`SlidingWindowOptions`."""

    takes_rigs = True

    def __init__(self, options: SlidingWindowOptions | None = None) -> None:
        self._options = options or SlidingWindowOptions()

    def begin(self, start: Start) -> None:
        """A window of one state, ``start``'s."""
        self._noise = start.calibration.calibration.imu
        self.window = Window(start, self._options)
        self._before = start.tracks
        self._pending: list[ImuSegment] = []
        # When something that each camera saw was last in it.
        self._used_ns = np.full(len(start.calibration.calibration.cameras), start.state.t_ns)

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """Estimate one frame: predicted from the readings, or optimised where it is due."""
        options, window, watch = self._options, self.window, Stopwatch()
        before, self._before = self._before, tracks
        _check_continuity(before, tracks, imu)
        self._pending.append(imu)
        since = join_segments(self._pending)
        predicted = window.predict(since)
        still = still and self._stands_still(predicted, since)
        of = np.unique(tracks.camera) if len(tracks.ids) else np.arange(len(self._used_ns))
        waited_s = 1e-9 * (tracks.t_ns - self._used_ns[of].min())
        due = waited_s > 1.0 / options.max_rate_hz - 0.5 * imu.duration_s
        watch.lap("propagate")
        if not due:
            return Estimate(
                Status.TRACKING,
                predicted,
                corrected=False,
                calibration=window.calibration(),
                stage_seconds=watch.seconds,
            )

        self._used_ns[of] = tracks.t_ns
        self._pending.clear()
        if still:
            window.hold_still(tracks.t_ns, Standstill.over(since, self._noise))
        else:
            window.add_frame(since, predicted, tracks)
        window.repropagate()
        window.triangulate()
        watch.lap("triangulate")
        _check_agreement(*window.optimise())
        watch.lap("optimise")
        ids, p_WF = window.landmarks()
        newest = window.newest
        self._check_jump(predicted, newest)
        is_keyframe = not still and window.choose_keyframe()
        corrected = window.in_sight >= _MIN_LANDMARKS or still
        while window.is_full:
            window.marginalise_oldest()
        watch.lap("marginalise")
        return Estimate(
            Status.TRACKING,
            newest,
            ids,
            p_WF,
            is_keyframe=is_keyframe,
            corrected=corrected,
            calibration=window.calibration(),
            stage_seconds=watch.seconds,
        )

    def _stands_still(self, predicted: NavState, imu: ImuSegment) -> bool:
        """Whether the readings, too, show no motion."""
        assert predicted.cov is not None
        still = Standstill.over(imu, self._noise)
        residual = still.residual(predicted.R_WB, predicted.v_WB, predicted.bias_gyro_B, predicted.bias_accel_B)
        return still.agrees(residual, still.jacobian(predicted.R_WB, predicted.v_WB), predicted.cov)

    def _check_jump(self, predicted: NavState, newest: NavState) -> None:
        jump = float(np.linalg.norm(newest.p_WB - predicted.p_WB))
        if not jump < self._options.max_jump_m:
            raise DivergedError(f"images moved the position by {jump:.1f} m from where the readings put it")


def _check_continuity(before: FrameTracks, tracks: FrameTracks, imu: ImuSegment) -> None:
    """Raise :class:`DivergedError` where nothing is seen of what was seen just before, though the body hardly turned.

    The camera is then somewhere else, or sees something else: what images and readings say no longer belongs together.
    """
    if min(len(before.ids), len(tracks.ids)) < _MANY_TRACKS:
        return
    if np.isin(tracks.ids, before.ids).any() or not np.isin(tracks.camera, before.camera).any():
        return
    if np.linalg.norm(imu.gyro_B, axis=1).max() < _SLOW_TURN:
        raise DivergedError("everything in sight changed at once, though the body hardly turned")


def _check_agreement(rejected: int, seen: int) -> None:
    """Raise :class:`DivergedError` where ``rejected`` of the landmarks ``seen`` are most of many, all at once.

    The landmarks agreed with one another and with the readings until now: not they are wrong, but where the body is.
    """
    if seen >= _MANY_TRACKS and rejected > _MOST * seen:
        raise DivergedError(f"images and readings contradict each other: {rejected} of {seen} landmarks do not fit")
