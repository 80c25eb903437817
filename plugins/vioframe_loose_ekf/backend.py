"""The loosely coupled filter as a recipe: :meth:`LooseEkf._filter` reads top to bottom, a named step a line.

The visual odometry knows nothing of the filter, the filter nothing of features: all that passes between them is a pose
a frame. After Weiss et al. (ICRA 2012) and Lynen et al. (IROS 2013); what differs is in ``docs/loose_ekf.md``.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from vioframe.estimation.initialization import Starter
from vioframe.estimation.recovery import DivergedError, check_plausible, noise_over
from vioframe.estimation.standstill import StandstillDetector
from vioframe.geometry import so3
from vioframe.stopwatch import Stopwatch
from vioframe.types import Calibration, Estimate, Float, FrameTracks, ImuSegment, NavState, Status
from vioframe_loose_ekf.drifts import Drifts
from vioframe_loose_ekf.fusion import Fusion
from vioframe_loose_ekf.odometry import Event, Sighting, VisualOdometry
from vioframe_loose_ekf.options import LooseEkfOptions

# Poses that do not fit for this long say that the vision frame is wrong, not they.
_CONTRADICTED_S = 0.12
# A vision frame tied anew must fit for this long, and its scale may have changed by this much, relative.
_TRIAL_S = 0.5
_JUMPED_SCALE = 0.1


class LooseEkf:
    """One frame at a time; settings in :class:`LooseEkfOptions`.

    ``initial_state``, with covariance, stands for the state at the first frame and spares the initialisation; it needs
    a camera whose rotation on the body is known.
    """

    def __init__(
        self, calibration: Calibration, options: LooseEkfOptions | None = None, initial_state: NavState | None = None
    ) -> None:
        self._options = options or LooseEkfOptions()
        if self._options.unknown_camera_rotation and initial_state is not None:
            raise ValueError("unknown_camera_rotation is found while initialising; leave out initial_state")
        self._starter = Starter(
            calibration,
            imu_noise_factor=self._options.imu_noise_factor,
            unknown_camera_rotation=self._options.unknown_camera_rotation,
        )
        self._noise_at_rest = calibration.imu
        self._noise = calibration.imu.in_flight(self._options.imu_noise_factor)
        self._drifts = Drifts(self._options, calibration.camera.focal_px)
        self._gate = float(chi2.ppf(self._options.gate_quantile, 6))
        self._standstill = StandstillDetector(self._options.standstill_disparity_px)
        self._fusion: Fusion | None = None
        self._odometry = VisualOdometry(calibration, self._options)
        self._seeing_ns = self._fitting_ns = self._tied_ns = 0
        if initial_state is not None:
            self._begin(initial_state)

    @property
    def fusion(self) -> Fusion | None:
        """The filter's mean and covariance; None before initialisation."""
        return self._fusion

    def process(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        """Initialise, or filter one frame; where the filter fails it says so and starts again from where it was."""
        tracks = tracks.finite()
        if self._fusion is None:
            return self._initialise(imu, tracks)
        try:
            estimate = self._filter(self._fusion, imu, tracks)
            assert estimate.state is not None
            check_plausible(estimate.state)
            self._check_sight(tracks.t_ns)
        except (DivergedError, np.linalg.LinAlgError) as error:
            self._fusion = None
            return self._starter.lose(str(error))
        self._starter.follow(estimate.state)
        return estimate

    def _filter(self, fusion: Fusion, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        watch = Stopwatch()
        sighting = self._odometry.track(tracks, self._turn(fusion, imu))
        watch.lap("odometry")
        still = self._standstill.sees_standstill(tracks) and self._options.zero_velocity_update
        if still and fusion.hold_still(imu, self._noise_at_rest):
            self._seeing_ns = self._fitting_ns = tracks.t_ns
            if self._odometry.map is None or sighting.event is Event.BEGUN:
                # There is no parallax to wait for: the way to the next frame that moves begins here.
                self._odometry.restart(tracks)
                fusion.place_vision_frame()
            else:
                fusion.move_anchor(fusion.state.p_VA, self._drifts.at_rest(imu.duration_s))
            watch.lap("standstill")
            return Estimate(Status.TRACKING, fusion.nav_state(tracks.t_ns), stage_seconds=watch.seconds)
        watch.lap("standstill")

        fusion.propagate(imu, noise_over(imu, self._noise))
        watch.lap("propagate")
        events = self._fuse(fusion, sighting, tracks)
        watch.lap("update")
        ids, p_WF = np.empty(0, np.int64), np.empty((0, 3))
        if sighting.placement is not None and not events:
            ids, p_WF = sighting.placement.ids, fusion.state.in_world(sighting.placement.p_VF)
        return Estimate(
            Status.TRACKING,
            fusion.nav_state(tracks.t_ns),
            ids,
            p_WF,
            is_keyframe=sighting.event in (Event.KEYFRAME, Event.BEGUN),
            events=events,
            stage_seconds=watch.seconds,
        )

    def _fuse(self, fusion: Fusion, sighting: Sighting, tracks: FrameTracks) -> tuple[str, ...]:
        """Bring what the odometry says into the filter; returns events worth telling."""
        if sighting.event is Event.REFERENCE:
            fusion.place_vision_frame()
        if sighting.placement is None:
            return ()
        pose = sighting.placement.pose
        if sighting.event is Event.BEGUN:
            if not fusion.begin_scale(pose.p_VC):
                return self._new_vision_frame(fusion, tracks, "the first way it saw is not that of the readings")
            self._fitting_ns = tracks.t_ns
            fusion.move_anchor(fusion.state.p_VA, self._drifts.at_birth(pose))
        elif sighting.event is Event.KEYFRAME:
            fusion.move_anchor(pose.p_VC, self._drifts.since(fusion.state.p_VA, pose))

        noise = self._options.vision_noise_factor**2 * sighting.placement.cov
        if fusion.update_pose(pose, noise, self._gate):
            self._seeing_ns = self._fitting_ns = tracks.t_ns
            return ()
        if (tracks.t_ns - self._fitting_ns) * 1e-9 < _CONTRADICTED_S:
            return ()
        # Once it may have jumped, as an odometry does that takes some points for others; twice at once it is lost.
        if (tracks.t_ns - self._tied_ns) * 1e-9 < _TRIAL_S:
            return self._new_vision_frame(fusion, tracks, "its poses contradict the readings")
        fusion.tie_anew(pose, noise, _JUMPED_SCALE)
        self._tied_ns = self._fitting_ns = tracks.t_ns
        return ("vision frame tied anew: its poses jumped",)

    def _new_vision_frame(self, fusion: Fusion, tracks: FrameTracks, why: str) -> tuple[str, ...]:
        self._odometry.restart(tracks)
        fusion.place_vision_frame()
        return (f"new vision frame: {why}",)

    def _turn(self, fusion: Fusion, imu: ImuSegment) -> Float:
        """R_CbC (3, 3), how the camera turned since the frame before, as the gyroscope says."""
        rate = imu.gyro_B - fusion.state.bias_gyro_B
        turn = np.eye(3)
        for phi in 0.5 * (rate[:-1] + rate[1:]) * imu.dt[:, None]:
            turn = turn @ so3.exp(phi)
        R_BC = self._starter.calibration.R_BC
        return R_BC.T @ turn @ R_BC

    def _initialise(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        self._standstill.sees_standstill(tracks)
        estimate = self._starter.begin(imu, tracks)
        if estimate.state is not None:
            fusion = self._begin(estimate.state)
            self._odometry.restart(tracks)
            fusion.place_vision_frame()
        return estimate

    def _begin(self, nav: NavState) -> Fusion:
        self._fusion = Fusion(nav, self._starter.calibration)
        self._odometry = VisualOdometry(self._starter.calibration, self._options)
        self._seeing_ns = nav.t_ns
        return self._fusion

    def _check_sight(self, t_ns: int) -> None:
        blind_s = (t_ns - self._seeing_ns) * 1e-9
        if blind_s > self._options.max_blind_s:
            raise DivergedError(f"nothing usable was seen for {blind_s:.1f} s")
