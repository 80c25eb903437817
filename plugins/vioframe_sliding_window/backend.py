"""The optimiser as a recipe: :meth:`SlidingWindow.process` and :meth:`SlidingWindow._estimate` read top to bottom.

Qin, Li, Shen, "VINS-Mono: A Robust and Versatile Monocular Visual-Inertial State Estimator", T-RO 2018, with first
estimates kept in the prior and landmarks of three degrees of freedom. See ``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.estimation.inertial.preintegration import join_segments, preintegrate
from vioframe.estimation.initialization import Starter
from vioframe.estimation.recovery import DivergedError, check_plausible, noise_over
from vioframe.estimation.standstill import STANDSTILL_GATE, Standstill, StandstillDetector
from vioframe.stopwatch import Stopwatch
from vioframe.types import Calibration, Estimate, Float, FrameTracks, ImuSegment, NavState, Status
from vioframe_sliding_window.options import SlidingWindowOptions
from vioframe_sliding_window.window import Window

# Landmarks without which a frame counts as blind.
_MIN_LANDMARKS = 5
# A body that turns no faster than this, rad/s, does not lose sight of this many tracks from one frame to the next.
_SLOW_TURN, _MANY_TRACKS = 1.0, 20
# Part of the landmarks in sight that do not fit, beyond which the estimate is what does not.
_MOST = 0.8


class SlidingWindow:
    """One frame at a time; settings in :class:`SlidingWindowOptions`.

    ``initial_state``, with covariance, stands for the state at the first frame and spares the initialisation; it needs
    a camera whose rotation on the body is known.
    """

    def __init__(
        self,
        calibration: Calibration,
        options: SlidingWindowOptions | None = None,
        initial_state: NavState | None = None,
    ) -> None:
        self._options = options or SlidingWindowOptions()
        if self._options.unknown_camera_rotation and initial_state is not None:
            raise ValueError("unknown_camera_rotation is found while initialising; leave out initial_state")
        self._starter = Starter(
            calibration,
            imu_noise_factor=self._options.imu_noise_factor,
            unknown_camera_rotation=self._options.unknown_camera_rotation,
        )
        self._noise = calibration.imu.in_flight(self._options.imu_noise_factor)
        self._standstill = StandstillDetector(self._options.standstill_disparity_px)
        self._window: Window | None = None
        self._before: FrameTracks | None = None
        self._pending: list[ImuSegment] = []
        self._seeing_ns = 0
        if initial_state is not None:
            nothing = FrameTracks(initial_state.t_ns, np.empty(0, np.int64), *np.empty((2, 0, 2)))
            self._begin(initial_state, nothing, np.zeros(3))

    @property
    def window(self) -> Window | None:
        """The window; None before initialisation."""
        return self._window

    def process(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        """Initialise, or estimate one frame; where that fails it says so and starts again from where it was."""
        tracks = tracks.finite()
        before, self._before = self._before, tracks
        if self._window is None:
            return self._initialise(imu, tracks)
        try:
            _check_continuity(before, tracks, imu)
            estimate = self._estimate(self._window, imu, tracks)
            assert estimate.state is not None
            check_plausible(estimate.state)
            self._check_sight(tracks.t_ns)
        except (DivergedError, np.linalg.LinAlgError) as error:
            self._window = None
            return self._starter.lose(str(error))
        self._starter.follow(estimate.state)
        return estimate

    def _estimate(self, window: Window, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        options, watch = self._options, Stopwatch()
        self._pending.append(imu)
        since = join_segments(self._pending)
        predicted = _predict(window.newest, since, self._calibration)
        still = self._stands_still(predicted, since, tracks)
        due = since.duration_s > 1.0 / options.max_rate_hz - 0.5 * imu.duration_s
        watch.lap("propagate")
        if not due:
            return Estimate(Status.TRACKING, predicted, stage_seconds=watch.seconds)

        self._pending.clear()
        if still:
            window.hold_still(tracks.t_ns, Standstill.over(since, self._calibration.imu))
        else:
            window.add_frame(since, tracks)
        window.repropagate()
        window.triangulate()
        watch.lap("triangulate")
        window.optimise()
        _check_agreement(*window.reject_outliers())
        watch.lap("optimise")
        ids, p_WF = window.landmarks()
        newest = window.newest
        self._check_jump(predicted, newest)
        if window.in_sight >= _MIN_LANDMARKS or still:
            self._seeing_ns = tracks.t_ns
        is_keyframe = not still and window.choose_keyframe()
        if window.is_full:
            window.marginalise_oldest()
        watch.lap("marginalise")
        return Estimate(Status.TRACKING, newest, ids, p_WF, is_keyframe, stage_seconds=watch.seconds)

    def _stands_still(self, predicted: NavState, imu: ImuSegment, tracks: FrameTracks) -> bool:
        """Whether neither the images nor the readings show motion."""
        if not (self._standstill.sees_standstill(tracks) and self._options.zero_velocity_update):
            return False
        assert predicted.cov is not None
        still = Standstill.over(imu, self._noise)
        residual = still.residual(predicted.R_WB, predicted.v_WB, predicted.bias_gyro_B, predicted.bias_accel_B)
        H = still.jacobian(predicted.R_WB)
        S = H @ predicted.cov @ H.T + np.diag(still.sigma**2)
        return bool(residual @ np.linalg.solve(S, residual) < STANDSTILL_GATE)

    def _initialise(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        self._standstill.sees_standstill(tracks)
        estimate = self._starter.begin(imu, tracks)
        if estimate.state is not None:
            self._begin(estimate.state, tracks, imu.gyro_B[-1])
        return estimate

    def _begin(self, state: NavState, tracks: FrameTracks, gyro_B: Float) -> None:
        calibration, found = self._starter.calibration, self._starter.camera_rotation
        self._calibration = replace(calibration, imu=self._noise)
        self._window = Window(state, tracks, gyro_B, self._calibration, self._options, found)
        self._pending.clear()
        self._seeing_ns = state.t_ns

    def _check_sight(self, t_ns: int) -> None:
        blind_s = (t_ns - self._seeing_ns) * 1e-9
        if blind_s > self._options.max_blind_s:
            raise DivergedError(f"nothing usable was seen for {blind_s:.1f} s")

    def _check_jump(self, predicted: NavState, newest: NavState) -> None:
        jump = float(np.linalg.norm(newest.p_WB - predicted.p_WB))
        if not jump < self._options.max_jump_m:
            raise DivergedError(f"images moved the position by {jump:.1f} m from where the readings put it")


def _check_continuity(before: FrameTracks | None, tracks: FrameTracks, imu: ImuSegment) -> None:
    """Raise :class:`DivergedError` where nothing is seen of what was seen just before, though the body hardly turned.

    The camera is then somewhere else, or sees something else: what images and readings say no longer belongs together.
    """
    if before is None or min(len(before.ids), len(tracks.ids)) < _MANY_TRACKS:
        return
    if np.isin(tracks.ids, before.ids, assume_unique=True).any():
        return
    if np.linalg.norm(imu.gyro_B, axis=1).max() < _SLOW_TURN:
        raise DivergedError("everything in sight changed at once, though the body hardly turned")


def _check_agreement(rejected: int, seen: int) -> None:
    """Raise :class:`DivergedError` where ``rejected`` of the landmarks ``seen`` are most of many, all at once.

    The landmarks agreed with one another and with the readings until now: not they are wrong, but where the body is.
    """
    if seen >= _MANY_TRACKS and rejected > _MOST * seen:
        raise DivergedError(f"images and readings contradict each other: {rejected} of {seen} landmarks do not fit")


def _predict(state: NavState, imu: ImuSegment, calibration: Calibration) -> NavState:
    """Where the readings lead from ``state``, with covariance."""
    noise = noise_over(imu, calibration.imu)
    return preintegrate(imu, state.bias_gyro_B, state.bias_accel_B, noise).predict(state)
