"""The filter as a recipe: :meth:`Msckf.process` and :meth:`Msckf._filter` read top to bottom, a named step a line.

Mourikis and Roumeliotis, "A multi-state constraint Kalman filter for vision-aided inertial navigation", ICRA 2007, with
first-estimate Jacobians (Li and Mourikis, IJRR 2013) and long-lived landmarks kept in the state.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vioframe.initialization import Initializer
from vioframe.stopwatch import Stopwatch
from vioframe.trajectory.alignment import rotation_z, yaw_of
from vioframe.types import Calibration, Estimate, FrameTracks, ImuNoise, ImuSegment, NavState, Status
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.standstill import StandstillDetector, hold_still
from vioframe_msckf.state import FilterDivergedError, FilterState
from vioframe_msckf.tracks import ObservationTable
from vioframe_msckf.updates import promote_tracks, select_tracks, update_from_landmarks, update_from_tracks

# What a body may do unseen while readings are missing, rad/s and m/s^2, and how long that can be bridged.
_UNSEEN_TURN, _UNSEEN_ACCELERATION, _MAX_IMU_GAP_S = 0.5, 2.0, 0.5
# Beyond these an estimate is not merely inaccurate but wrong, whatever the covariance says.
_MAX_SPEED_M_S, _MAX_BIAS_GYRO, _MAX_BIAS_ACCEL = 30.0, 1.0, 2.5


class Msckf:
    """One frame at a time; settings in :class:`MsckfOptions`.

    ``initial_state``, with covariance, stands for the state at the first frame and spares the initialisation.
    """

    def __init__(
        self, calibration: Calibration, options: MsckfOptions | None = None, initial_state: NavState | None = None
    ) -> None:
        self._calibration = calibration
        self._options = options or MsckfOptions()
        self._initializer = Initializer(calibration)
        dof = np.arange(1, 2 * self._options.max_clones + 3)
        self._gate = np.concatenate([[0.0], chi2.ppf(self._options.gate_quantile, dof)])
        self._state: FilterState | None = None
        self._observations = ObservationTable()
        self._standstill = StandstillDetector(self._options.standstill_disparity_px)
        self._last: NavState | None = None
        self._seeing_ns = 0
        if initial_state is not None:
            self._begin(initial_state)

    @property
    def state(self) -> FilterState | None:
        """The filter's mean and covariance; None before initialisation."""
        return self._state

    def process(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        """Initialise, or filter one frame; where the filter fails it says so and starts again from where it was."""
        if self._state is None:
            return self._initialise(imu, tracks)
        try:
            estimate = self._filter(self._state, imu, tracks)
            self._check(self._state, tracks.t_ns)
        except FilterDivergedError as error:
            return self._lose(str(error))
        self._last = estimate.state
        return estimate

    def _filter(self, state: FilterState, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        options, observations, watch = self._options, self._observations, Stopwatch()
        if self._stands_still(state, imu, tracks):
            self._seeing_ns = tracks.t_ns
            watch.lap("standstill")
            return Estimate(Status.TRACKING, state.nav_state(tracks.t_ns), stage_seconds=watch.seconds)
        watch.lap("standstill")

        state.propagate(imu, _noise_over(imu, self._calibration.imu), options.first_estimate_jacobians)
        state.augment_clone(imu.gyro_B[-1] - state.bias_gyro_B)
        observations.add_frame(_without(tracks, state.landmark_ids))
        watch.lap("propagate")

        selection = select_tracks(observations, state, options)
        ids, p_WF = update_from_tracks(state, observations, selection.finished, options, self._gate)
        watch.lap("msckf_update")
        used = update_from_landmarks(state, tracks, options, self._gate)
        watch.lap("landmark_update")
        promoted = promote_tracks(state, observations, selection.promoted, options, self._gate)
        watch.lap("delayed_init")

        observations.drop(np.concatenate([selection.finished, promoted]))
        if len(state.clones) >= options.max_clones:
            state.drop_oldest_clone()
            observations.drop_oldest_frame()
        watch.lap("marginalise")

        if len(ids) or used:
            self._seeing_ns = tracks.t_ns
        return Estimate(
            Status.TRACKING,
            state.nav_state(tracks.t_ns),
            np.concatenate([ids, state.landmark_ids]),
            np.concatenate([p_WF, state.p_WF]),
            is_keyframe=True,
            stage_seconds=watch.seconds,
        )

    def _stands_still(self, state: FilterState, imu: ImuSegment, tracks: FrameTracks) -> bool:
        """Hold the state where neither image nor IMU shows motion."""
        options = self._options
        if not (options.zero_velocity_update and self._standstill.sees_standstill(tracks)):
            return False
        return hold_still(state, imu, self._calibration.imu, options.first_estimate_jacobians)

    def _initialise(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        watch = Stopwatch()
        self._standstill.sees_standstill(tracks)
        initial = self._initializer.add(imu, tracks)
        watch.lap("initialise")
        if initial is None:
            refusal = self._initializer.refusal
            events = (f"initialisation refused: {refusal}",) if refusal else ()
            return Estimate(Status.INITIALISING, events=events, stage_seconds=watch.seconds)
        nav = initial.states[-1] if self._last is None else _moved_to(self._last, initial.states[-1])
        self._begin(nav)
        self._last = nav
        return Estimate(Status.TRACKING, nav, events=(f"initialised ({initial.method})",), stage_seconds=watch.seconds)

    def _begin(self, nav: NavState) -> None:
        options = self._options
        self._state = FilterState(
            nav,
            self._calibration,
            extrinsics=options.calibrate_extrinsics,
            offset=options.calibrate_time_offset,
            intrinsics=options.calibrate_intrinsics,
        )
        self._observations = ObservationTable()
        self._seeing_ns = nav.t_ns

    def _check(self, state: FilterState, t_ns: int) -> None:
        blind_s = (t_ns - self._seeing_ns) * 1e-9
        if blind_s > self._options.max_blind_s:
            raise FilterDivergedError(f"nothing usable was seen for {blind_s:.1f} s")
        if np.linalg.norm(state.v_WB) > _MAX_SPEED_M_S:
            raise FilterDivergedError(f"the speed exceeds {_MAX_SPEED_M_S:g} m/s")
        if np.linalg.norm(state.bias_gyro_B) > _MAX_BIAS_GYRO or np.linalg.norm(state.bias_accel_B) > _MAX_BIAS_ACCEL:
            raise FilterDivergedError("the IMU's biases became implausible")

    def _lose(self, why: str) -> Estimate:
        self._state = None
        self._initializer.reset()
        return Estimate(Status.LOST, events=(f"lost: {why}",))


def _noise_over(imu: ImuSegment, noise: ImuNoise) -> ImuNoise:
    """``noise``, raised where readings are missing: the straight line drawn over a gap is only a guess.

    A rate that is off by w for a gap of T turns the body by w T, as white noise of density w sqrt(T) would.
    """
    gap_s = imu.largest_gap_s
    if gap_s > _MAX_IMU_GAP_S:
        raise FilterDivergedError(f"no inertial readings for {gap_s:.2f} s")
    if gap_s < 5.0 / noise.rate_hz:
        return noise
    return replace(
        noise,
        gyro_density=noise.gyro_density + _UNSEEN_TURN * gap_s**0.5,
        accel_density=noise.accel_density + _UNSEEN_ACCELERATION * gap_s**0.5,
    )


def _moved_to(last: NavState, initial: NavState) -> NavState:
    """``initial``, which begins at a world origin of its own, placed at the position and yaw where ``last`` ended."""
    R = rotation_z(float(yaw_of(last.R_WB @ initial.R_WB.T)))
    cov = initial.cov
    if cov is not None:
        G = np.eye(15)
        G[3:6, 3:6] = G[6:9, 6:9] = R
        cov = G @ cov @ G.T
    return NavState(
        initial.t_ns,
        R @ initial.R_WB,
        last.p_WB,
        R @ initial.v_WB,
        initial.bias_gyro_B,
        initial.bias_accel_B,
        cov,
    )


def _without(tracks: FrameTracks, ids: NDArray[np.int64]) -> FrameTracks:
    keep = ~np.isin(tracks.ids, ids)
    return FrameTracks(tracks.t_ns, tracks.ids[keep], tracks.xy[keep], tracks.xy_normalised[keep])
