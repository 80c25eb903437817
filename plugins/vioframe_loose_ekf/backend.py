"""The loosely coupled filter as a recipe: :meth:`LooseEkf.process` reads top to bottom, a named step a line.

The visual odometry knows nothing of the filter, the filter nothing of features: all that passes between them is a pose
a frame. After Weiss et al. (ICRA 2012) and Lynen et al. (IROS 2013); what differs is in ``docs/loose_ekf.md``.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from vioframe.estimation.recovery import noise_over
from vioframe.geometry import so3
from vioframe.stopwatch import Stopwatch
from vioframe.types import Estimate, Float, FrameTracks, ImuSegment, Start, Status
from vioframe_loose_ekf.fusion import Fusion
from vioframe_loose_ekf.odometry import Drifts, Event, Sighting, VisualOdometry
from vioframe_loose_ekf.options import LooseEkfOptions

# Poses that do not fit for this long say that the vision frame is wrong, not they.
_CONTRADICTED_S = 0.12
# A vision frame tied anew must fit for this long, and its scale may have changed by this much, relative.
_TRIAL_S = 0.5
_JUMPED_SCALE = 0.1


class LooseEkf:
    """One frame at a time; settings in :class:`LooseEkfOptions`."""

    def __init__(self, options: LooseEkfOptions | None = None) -> None:
        self._options = options or LooseEkfOptions()
        self._gate = float(chi2.ppf(self._options.gate_quantile, 6))

    def begin(self, start: Start) -> None:
        """A filter with ``start``'s state, and a vision frame that begins at its camera."""
        calibration = start.calibration.calibration
        self._camera = calibration.cameras[0]
        self._noise, self._noise_at_rest = calibration.imu, start.noise_at_rest
        self._drifts = Drifts(self._options, self._camera.model.focal_px)
        self.fusion = Fusion(start.state, calibration)
        self._odometry = VisualOdometry(calibration, self._options)
        self._fitting_ns, self._tied_ns = start.state.t_ns, 0
        self._odometry.restart(start.tracks)
        self.fusion.place_vision_frame()

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """Filter one frame."""
        fusion, watch = self.fusion, Stopwatch()
        sighting = self._odometry.track(tracks, self._turn(fusion, imu))
        watch.lap("odometry")
        if still and fusion.hold_still(imu, self._noise_at_rest):
            self._fitting_ns = tracks.t_ns
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
        fitted, events = self._fuse(fusion, sighting, tracks)
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
            corrected=fitted,
            events=events,
            stage_seconds=watch.seconds,
        )

    def _fuse(self, fusion: Fusion, sighting: Sighting, tracks: FrameTracks) -> tuple[bool, tuple[str, ...]]:
        """Bring what the odometry says into the filter; returns whether it fitted, and events worth telling."""
        if sighting.event is Event.REFERENCE:
            fusion.place_vision_frame()
        if sighting.placement is None:
            return False, ()
        pose = sighting.placement.pose
        if sighting.event is Event.BEGUN:
            if not fusion.begin_scale(pose.p_VC):
                return False, self._new_vision_frame(fusion, tracks, "the first way it saw is not that of the readings")
            self._fitting_ns = tracks.t_ns
            fusion.move_anchor(fusion.state.p_VA, self._drifts.at_birth(pose))
        elif sighting.event is Event.KEYFRAME:
            fusion.move_anchor(pose.p_VC, self._drifts.since(fusion.state.p_VA, pose))

        noise = self._options.vision_noise_factor**2 * sighting.placement.cov
        if fusion.update_pose(pose, noise, self._gate):
            self._fitting_ns = tracks.t_ns
            return True, ()
        if (tracks.t_ns - self._fitting_ns) * 1e-9 < _CONTRADICTED_S:
            return False, ()
        # Once it may have jumped, as an odometry does that takes some points for others; twice at once it is lost.
        if (tracks.t_ns - self._tied_ns) * 1e-9 < _TRIAL_S:
            return False, self._new_vision_frame(fusion, tracks, "its poses contradict the readings")
        fusion.tie_anew(pose, noise, _JUMPED_SCALE)
        self._tied_ns = self._fitting_ns = tracks.t_ns
        return False, ("vision frame tied anew: its poses jumped",)

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
        R_BC = self._camera.R_BC
        return R_BC.T @ turn @ R_BC
