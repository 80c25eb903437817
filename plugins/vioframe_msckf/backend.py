"""The filter as a recipe: :meth:`Msckf.process` reads top to bottom, a named step a line.

Mourikis and Roumeliotis, "A multi-state constraint Kalman filter for vision-aided inertial navigation", ICRA 2007, with
first-estimate Jacobians (Li and Mourikis, IJRR 2013) and long-lived landmarks kept in the state.
"""

from __future__ import annotations

import numpy as np

from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.inertial.noise import noise_over
from vioframe.estimation.point_noise import PointNoise
from vioframe.estimation.repeats import Repeats
from vioframe.quantiles import chi2_quantile
from vioframe.stopwatch import Stopwatch
from vioframe.types import Estimate, FrameTracks, ImuSegment, Start, Status
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.state import FilterState
from vioframe_msckf.updates import (
    Turns,
    hold_still,
    select_tracks,
    update_from_landmarks,
    update_from_tracks,
)


class Msckf:
    """One frame at a time; settings in :class:`MsckfOptions`."""

    takes_rigs = True

    def __init__(self, options: MsckfOptions | None = None) -> None:
        self._options = options or MsckfOptions()

    def begin(self, start: Start) -> None:
        """A filter with ``start``'s state and no clones."""
        options = self._options
        self.state = FilterState(
            start.state,
            start.calibration,
            extrinsics=options.calibrate_extrinsics,
            offset=options.calibrate_time_offset,
            intrinsics=options.calibrate_intrinsics,
            readout=options.calibrate_readout,
        )
        self._imu_noise, self._noise_at_rest = start.calibration.calibration.imu, start.noise_at_rest
        self._stands = False
        self.point_noise = PointNoise(options.pixel_sigma)
        cameras = len(start.calibration.calibration.cameras)
        self._observations, self._turns = TrackTable(cameras), Turns(cameras)
        self._repeats = Repeats(cameras, options.shared_every_s)
        dof = np.arange(1, 2 * cameras * options.max_clones + 3)
        self._gate = np.concatenate([[0.0], chi2_quantile(options.gate_quantile, dof)])

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """Filter one frame."""
        options, state, observations, watch = self._options, self.state, self._observations, Stopwatch()
        point_noise, gate = self.point_noise, self._gate
        if still and hold_still(state, imu, self._noise_at_rest, options.first_estimate_jacobians):
            point_noise.begin()
            self._stands = True
            watch.lap("standstill")
            return Estimate(
                Status.TRACKING,
                state.nav_state(tracks.t_ns),
                calibration=state.calibration(),
                stage_seconds=watch.seconds,
            )
        if self._stands:
            state.set_off()
            self._stands = False
        watch.lap("standstill")

        state.propagate(imu, noise_over(imu, self._noise_at_rest, self._imu_noise), options.first_estimate_jacobians)
        state.augment_clone(imu.gyro_B[-1] - state.bias_gyro_B)
        counts, new = self._repeats.counting(tracks), ~np.isin(tracks.ids, state.landmark_ids)
        observations.add_frame(tracks.only(new), counts[new])
        self._turns.add_frame(tracks)
        full = self._turns.most >= options.max_clones
        watch.lap("propagate")

        # Ahead of the tracks: what these make landmarks of has been used with what the newest frame sees of it.
        landmarks = update_from_landmarks(state, tracks.only(counts), self._turns.in_sight, options, point_noise, gate)
        watch.lap("landmark_update")
        selection = select_tracks(observations, state, options, full)
        gone, ids, p_WF = update_from_tracks(state, observations, selection, options, point_noise, gate)
        watch.lap("msckf_update")

        observations.drop(gone)
        if full:
            state.drop_oldest_clone()
            observations.drop_frame(0)
            self._turns.drop_oldest()
        watch.lap("marginalise")

        return Estimate(
            Status.TRACKING,
            state.nav_state(tracks.t_ns),
            np.concatenate([ids, state.landmark_ids]),
            np.concatenate([p_WF, state.p_WF]),
            is_keyframe=True,
            corrected=bool(len(ids) or landmarks),
            calibration=state.calibration(),
            stage_seconds=watch.seconds,
        )
