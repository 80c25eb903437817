"""The loosely coupled filter as a recipe: :meth:`LooseEkf.process` reads top to bottom, a named step a line.

The visual odometry knows nothing of the filter, the filter nothing of features: all that passes between them is a pose
a frame. After Weiss et al. (ICRA 2012) and Lynen et al. (IROS 2013); what differs is in ``docs/loose_ekf.md``.
"""

from __future__ import annotations

import numpy as np

from vioframe.estimation.inertial.noise import noise_over
from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.geometry import so3
from vioframe.quantiles import gate
from vioframe.stopwatch import Stopwatch
from vioframe.types import Estimate, Float, FrameTracks, ImuSegment, Start, Status
from vioframe_loose_ekf.fusion import Fusion
from vioframe_loose_ekf.odometry import MEDIAN_DEPTH, Event, Sighting, VisualOdometry
from vioframe_loose_ekf.options import LooseEkfOptions
from vioframe_loose_ekf.state import VisionPose

# A pose of the odometry beyond this quantile is left out.
_GATE_QUANTILE = 0.99
# Drift of the vision frame from one keyframe to the next: scale, relative; orientation, rad; position by the distance
# between them. Measured on EuRoC's flights and simulated ones.
_DRIFT_SCALE, _DRIFT_ROTATION, _DRIFT_POSITION = 0.003, float(np.deg2rad(0.03)), 0.01
# That of a map of two views: rotation in units of a pixel's angle, and direction of the first way in units of pixel
# noise by parallax. Measured over 120 starts on simulated flights.
_BIRTH_ROTATION, _BIRTH_DIRECTION = 1.2, 0.7
# A picture that creeps by less than this in this time passes for still.
_UNNOTICED_PX, _LOOK_BACK_S = 0.7, 0.5
# Poses that do not fit for this long say that the vision frame is wrong, not they.
_CONTRADICTED_S = 0.12
# A vision frame tied anew must fit for this long, and its scale may have changed by this much, relative.
_TRIAL_S = 0.5
_JUMPED_SCALE = 0.1


class LooseEkf:
    """One frame at a time; settings in :class:`LooseEkfOptions`."""

    takes_rigs = True

    def __init__(self, options: LooseEkfOptions | None = None) -> None:
        self._options = options or LooseEkfOptions()

    def begin(self, start: Start) -> None:
        """A filter with ``start``'s state, and a vision frame that begins at its camera."""
        calibration = start.calibration.calibration
        self._camera = calibration.cameras[0]
        self._noise, self._noise_at_rest = calibration.imu, start.noise_at_rest
        self.fusion = Fusion(start.state, self._camera)
        self._odometry = VisualOdometry(calibration, self._options)
        self._fitting_ns, self._tied_ns = start.state.t_ns, 0
        self._odometry.restart(start.tracks.of_camera(0))
        self._passed: list[ImuSegment] = []
        self.fusion.place_vision_frame()

    def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """Filter one frame."""
        fusion, watch, of_all, tracks = self.fusion, Stopwatch(), len(tracks.ids), tracks.of_camera(0)
        self._passed.append(imu)
        if len(tracks.ids) == 0 < of_all:
            # Another camera's alone.
            fusion.propagate(imu, noise_over(imu, self._noise_at_rest, self._noise))
            watch.lap("propagate")
            state = fusion.nav_state(tracks.t_ns)
            return Estimate(Status.TRACKING, state, corrected=False, stage_seconds=watch.seconds)
        sighting = self._odometry.track(tracks, self._turn(fusion, join_segments(self._passed)))
        self._passed.clear()
        watch.lap("odometry")
        if still and fusion.hold_still(imu, self._noise_at_rest):
            self._fitting_ns = tracks.t_ns
            if self._odometry.map is None or sighting.event is Event.BEGUN:
                # There is no parallax to wait for: the way to the next frame that moves begins here.
                self._odometry.restart(tracks)
                fusion.place_vision_frame()
            else:
                fusion.move_anchor(fusion.state.p_VA, self._drift_at_rest(imu.duration_s))
            watch.lap("standstill")
            return Estimate(Status.TRACKING, fusion.nav_state(tracks.t_ns), stage_seconds=watch.seconds)
        watch.lap("standstill")

        fusion.propagate(imu, noise_over(imu, self._noise_at_rest, self._noise))
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
            fusion.move_anchor(fusion.state.p_VA, self._drift_at_birth(pose))
        elif sighting.event is Event.KEYFRAME:
            fusion.move_anchor(pose.p_VC, _drift_over(pose.p_VC - fusion.state.p_VA))

        noise = self._options.vision_noise_factor**2 * sighting.placement.cov
        if fusion.update_pose(pose, noise, gate(_GATE_QUANTILE, 6)):
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

    def _drift_at_birth(self, first: VisionPose) -> tuple[float, float, float]:
        """Of a new vision frame whose first pose is ``first``: a map of two views bends as a whole."""
        o = self._options
        direction = _BIRTH_DIRECTION * o.pixel_sigma / o.bootstrap_parallax_px
        rotation = _BIRTH_ROTATION * o.pixel_sigma / self._camera.model.focal_px
        return 0.0, rotation, direction * float(np.linalg.norm(first.p_VC))

    def _drift_at_rest(self, duration_s: float) -> tuple[float, float, float]:
        """While the body passed for still: a picture that creeps less than is noticed is not followed."""
        unnoticed = _UNNOTICED_PX / self._camera.model.focal_px * (duration_s / _LOOK_BACK_S) ** 0.5
        return 0.0, unnoticed, unnoticed * MEDIAN_DEPTH

    def _turn(self, fusion: Fusion, imu: ImuSegment) -> Float:
        """R_CbC (3, 3), how the camera turned since the frame before, as the gyroscope says."""
        rate = imu.gyro_B - fusion.state.bias_gyro_B
        turn = np.eye(3)
        for phi in 0.5 * (rate[:-1] + rate[1:]) * imu.dt[:, None]:
            turn = turn @ so3.exp(phi)
        R_BC = self._camera.R_BC
        return R_BC.T @ turn @ R_BC


def _drift_over(way_V: Float) -> tuple[float, float, float]:
    """From one keyframe to the next, ``way_V`` (3,) away."""
    return _DRIFT_SCALE, _DRIFT_ROTATION, _DRIFT_POSITION * float(np.linalg.norm(way_V))
