"""The filter as a recipe: :meth:`Msckf.process` and :meth:`Msckf._filter` read top to bottom, a named step a line.

Mourikis and Roumeliotis, "A multi-state constraint Kalman filter for vision-aided inertial navigation", ICRA 2007, with
first-estimate Jacobians (Li and Mourikis, IJRR 2013) and long-lived landmarks kept in the state.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.initialization import Starter
from vioframe.estimation.recovery import DivergedError, check_plausible, noise_over
from vioframe.estimation.standstill import StandstillDetector
from vioframe.stopwatch import Stopwatch
from vioframe.types import Calibration, Estimate, FrameTracks, ImuSegment, NavState, Status
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.standstill import hold_still
from vioframe_msckf.state import EXTRINSICS, FilterState
from vioframe_msckf.updates import promote_tracks, select_tracks, update_from_landmarks, update_from_tracks


class Msckf:
    """One frame at a time; settings in :class:`MsckfOptions`.

    ``initial_state``, with covariance, stands for the state at the first frame and spares the initialisation; it needs
    a camera whose rotation on the body is known.
    """

    def __init__(
        self, calibration: Calibration, options: MsckfOptions | None = None, initial_state: NavState | None = None
    ) -> None:
        self._options = options or MsckfOptions()
        if self._options.unknown_camera_rotation and initial_state is not None:
            raise ValueError("unknown_camera_rotation is found while initialising; leave out initial_state")
        self._starter = Starter(
            calibration,
            imu_noise_factor=self._options.imu_noise_factor,
            unknown_camera_rotation=self._options.unknown_camera_rotation,
        )
        self._noise_at_rest = calibration.imu
        self._noise = calibration.imu.in_flight(self._options.imu_noise_factor)
        dof = np.arange(1, 2 * self._options.max_clones + 3)
        self._gate = np.concatenate([[0.0], chi2.ppf(self._options.gate_quantile, dof)])
        self._state: FilterState | None = None
        self._observations = TrackTable()
        self._standstill = StandstillDetector(self._options.standstill_disparity_px)
        self._seeing_ns = 0
        if initial_state is not None:
            self._begin(initial_state)

    @property
    def state(self) -> FilterState | None:
        """The filter's mean and covariance; None before initialisation."""
        return self._state

    def process(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        """Initialise, or filter one frame; where the filter fails it says so and starts again from where it was."""
        tracks = tracks.finite()
        if self._state is None:
            return self._initialise(imu, tracks)
        try:
            estimate = self._filter(self._state, imu, tracks)
            self._check(self._state.nav_state(tracks.t_ns))
        except DivergedError as error:
            self._state = None
            return self._starter.lose(str(error))
        assert estimate.state is not None
        self._starter.follow(estimate.state)
        return estimate

    def _filter(self, state: FilterState, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        options, observations, watch = self._options, self._observations, Stopwatch()
        if self._stands_still(state, imu, tracks):
            self._seeing_ns = tracks.t_ns
            watch.lap("standstill")
            return Estimate(Status.TRACKING, state.nav_state(tracks.t_ns), stage_seconds=watch.seconds)
        watch.lap("standstill")

        state.propagate(imu, noise_over(imu, self._noise), options.first_estimate_jacobians)
        state.augment_clone(imu.gyro_B[-1] - state.bias_gyro_B)
        observations.add_frame(tracks.only(~np.isin(tracks.ids, state.landmark_ids)))
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
            observations.drop_frame(0)
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
        return hold_still(state, imu, self._noise_at_rest, options.first_estimate_jacobians)

    def _initialise(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        self._standstill.sees_standstill(tracks)
        estimate = self._starter.begin(imu, tracks)
        if estimate.state is not None:
            self._begin(estimate.state)
        return estimate

    def _begin(self, nav: NavState) -> None:
        options = self._options
        self._state = FilterState(
            nav,
            self._starter.calibration,
            extrinsics=options.calibrate_extrinsics,
            offset=options.calibrate_time_offset,
            intrinsics=options.calibrate_intrinsics,
        )
        found = self._starter.camera_rotation
        if found is not None and options.calibrate_extrinsics:
            rotation = slice(EXTRINSICS.start, EXTRINSICS.start + 3)
            self._state.cov[rotation, rotation] = found.cov
        self._observations = TrackTable()
        self._seeing_ns = nav.t_ns

    def _check(self, state: NavState) -> None:
        check_plausible(state)
        blind_s = (state.t_ns - self._seeing_ns) * 1e-9
        if blind_s > self._options.max_blind_s:
            raise DivergedError(f"nothing usable was seen for {blind_s:.1f} s")
