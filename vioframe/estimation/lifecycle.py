"""The life of an estimate, the same for every back-end: it begins, follows, stands still, is lost and begins again.

A back-end is its mathematics and nothing else: how it begins from a state, and what it does with a frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.errors import ConfigError, DivergedError, PluginError
from vioframe.estimation.inertial.preintegration import join_segments, preintegrate
from vioframe.estimation.initialization import Initializer
from vioframe.estimation.options import EstimationOptions
from vioframe.estimation.recovery import check_plausible, continued_from
from vioframe.estimation.soundness import defect_of
from vioframe.estimation.standstill import SETTLED_NS, StandstillDetector
from vioframe.interfaces import Backend
from vioframe.stopwatch import Stopwatch
from vioframe.types import (
    Calibration,
    CalibrationEstimate,
    Estimate,
    FrameTracks,
    ImuSegment,
    NavState,
    Start,
    Status,
)


class LifeCycle:
    """Takes ``backend``, called ``name`` in errors, through a flight, one frame at a time.

    ``initial_state``, with covariance, stands for the state at the first frame and spares the initialisation; the
    camera's rotation on the body must be known then.
    """

    def __init__(
        self,
        backend: Backend,
        calibration: Calibration,
        options: EstimationOptions | None = None,
        initial_state: NavState | None = None,
        name: str | None = None,
    ) -> None:
        known = all(camera.rotation_known for camera in calibration.cameras)
        if initial_state is not None and (initial_state.cov is None or not known):
            raise ConfigError("an initial state needs a covariance, and cameras whose rotation on the body is known")
        self._options = options or EstimationOptions()
        self._backend, self._name = backend, name or f"the back-end {type(backend).__name__}"
        if not getattr(backend, "takes_rigs", False):
            calibration.single(self._name)
        if len(calibration.cameras) > 1 and not known:
            unknown = next(camera.name for camera in calibration.cameras if not camera.rotation_known)
            raise ConfigError(f"of a rig every camera's rotation on the body must be known, that of {unknown} is not")
        self._given = calibration
        self._initializer = Initializer(calibration, self._options.camera_sigma)
        self._standstills = [StandstillDetector(self._options.standstill_disparity_px) for _ in calibration.cameras]
        self._initial_state = initial_state
        self._following = False
        self._stands = False
        # Frames in which it seems to stand still, which the back-end has yet to be given.
        self._waiting: list[tuple[ImuSegment, FrameTracks]] = []
        self._settled = Estimate(Status.INITIALISING)  # the newest that is the back-end's own
        self._last: NavState | None = None
        self._corrected_ns = 0
        self._known = CalibrationEstimate(calibration, (self._options.camera_sigma,) * len(calibration.cameras))

    @property
    def calibration(self) -> Calibration:
        """That which frames are to come with: other than given, where something else was found while starting."""
        return self._initializer.calibration

    def process(self, imu: ImuSegment, tracks: FrameTracks, by: Calibration | None = None) -> Estimate:
        """Begin, or follow one frame; where that fails it says so, and begins anew from where it was.

        The readings count with the time offset of the first camera of ``by``, and reach back to where those of the
        frame before ended; its cameras have undistorted the points. It is the :attr:`calibration`, or that of a while
        ago where the frame has been waiting since.
        """
        known = self.calibration
        by = by or known
        tracks = tracks.undistorted(*known.lenses, by=by.lenses).finite()
        camera = int(tracks.camera.min()) if len(tracks.ids) else 0  # each by its own images, where they take turns
        still = self._standstills[camera].sees_standstill(tracks.of_camera(camera))
        still &= self._options.zero_velocity_update
        if not self._following:
            return self._begin(imu, tracks, by.cameras[0].time_offset_ns)
        if self._initializer.in_doubt and self._initializer.follow(imu, tracks, still):
            self._following = False
            return Estimate(
                Status.LOST, events=(f"lost: the camera is mounted differently; {self._initializer.found}",)
            )
        # The first frame of a standstill says that the body has come to rest, those after it that it has not set off.
        stood, self._stands = self._stands, still
        if stood and self._stands:
            return self._wait(imu, tracks)
        imu, self._waiting = join_segments([*(readings for readings, _ in self._waiting), imu]), []
        return self._follow(imu, tracks, still)

    def _wait(self, imu: ImuSegment, tracks: FrameTracks) -> Estimate:
        """A frame that shows the picture of half a second before: the body stood still, and may be about to set off.

        That is seen too late, so the back-end is given the frame of a while ago, in which the body surely stood still,
        and the readings lead from there to this one. Once the body is seen to move, the back-end has them, too.
        """
        self._waiting.append((imu, tracks))
        estimate = Estimate(Status.TRACKING, corrected=False, calibration=self._settled.calibration)
        while tracks.t_ns - self._waiting[0][1].t_ns >= SETTLED_NS:
            estimate = self._follow(*self._waiting.pop(0), still=True)
            if estimate.status is not Status.TRACKING:
                return estimate
        state, noise = self._settled.state, self._options.in_flight(self.calibration.imu)
        assert state is not None
        since = join_segments([readings for readings, _ in self._waiting])
        self._last = preintegrate(since, state.bias_gyro_B, state.bias_accel_B, noise).predict(state)
        return replace(estimate, state=self._last)

    def _follow(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
        """What the back-end makes of a frame."""
        try:
            estimate = self._backend.process(imu, tracks, still)
            if (defect := defect_of(estimate, tracks.t_ns)) is not None:
                raise PluginError(f"{self._name} at {tracks.t_ns} ns: {defect}; repair the plug-in")
            self._check(estimate, tracks.t_ns)
        except (DivergedError, np.linalg.LinAlgError) as error:
            return self._lose(str(error))
        if estimate.status is Status.LOST:
            self._begin_anew()
        estimate = replace(estimate, calibration=self._learned(estimate.calibration or self._known))
        if estimate.state is not None:
            self._last, self._settled = estimate.state, estimate
        return estimate

    def _begin(self, imu: ImuSegment, tracks: FrameTracks, time_offset_ns: int) -> Estimate:
        if self._initial_state is not None:
            state, self._initial_state = self._initial_state, None
            if state.t_ns != tracks.t_ns:
                raise ConfigError(f"the initial state is of {state.t_ns} ns, the first frame of {tracks.t_ns} ns")
            return self._begun(self._start(state, imu, tracks), Stopwatch(), "state given")
        watch = Stopwatch()
        initial = self._initializer.add(imu, tracks, time_offset_ns)
        watch.lap("initialise")
        if initial is None:
            refusal = self._initializer.refusal
            refused = (f"initialisation refused: {refusal}",) if refusal else ()
            return Estimate(Status.INITIALISING, events=refused, stage_seconds=watch.seconds)
        state = initial.states[-1]
        if self._last is not None:
            state = continued_from(self._last, state)
        return self._begun(self._start(state, imu, tracks), watch, initial.method)

    def _begun(self, start: Start, watch: Stopwatch, method: str) -> Estimate:
        self._backend.begin(start)
        self._stands, self._waiting = False, []
        self._following, self._last, self._known = True, start.state, start.calibration
        self._corrected_ns = start.state.t_ns
        events = [f"initialised ({method})"]
        if (found := self._initializer.found) is not None:
            events.append(str(found))
        self._settled = Estimate(
            Status.TRACKING,
            start.state,
            calibration=self._learned(start.calibration),
            events=tuple(events),
            stage_seconds=watch.seconds,
        )
        return self._settled

    def _start(self, state: NavState, imu: ImuSegment, tracks: FrameTracks) -> Start:
        """From ``state``, with what was found of the calibration while starting."""
        calibration = self.calibration
        # It may have been found at this very frame.
        tracks = tracks.undistorted(*calibration.lenses).finite()
        flying = replace(calibration, imu=self._options.in_flight(calibration.imu))
        sigma = (self._initializer.camera_sigma, *(self._options.camera_sigma for _ in calibration.cameras[1:]))
        prior = CalibrationEstimate(flying, sigma)
        return Start(state, prior, calibration.imu, imu, tracks)

    def _check(self, estimate: Estimate, t_ns: int) -> None:
        """Raise :class:`DivergedError` where the estimate can no longer be believed."""
        if estimate.state is not None:
            check_plausible(estimate.state)
        if estimate.corrected:
            self._corrected_ns = t_ns
        blind_s = (t_ns - self._corrected_ns) * 1e-9
        if blind_s > self._options.max_blind_s:
            raise DivergedError(f"nothing usable was seen for {blind_s:.1f} s")

    def _learned(self, estimate: CalibrationEstimate) -> CalibrationEstimate:
        """``estimate`` with the IMU's noise as it was given: what is assumed in flight was not learned."""
        return replace(estimate, calibration=replace(estimate.calibration, imu=self._given.imu))

    def _lose(self, why: str) -> Estimate:
        self._begin_anew()
        return Estimate(Status.LOST, events=(f"lost: {why}",))

    def _begin_anew(self) -> None:
        self._following = False
        self._initializer.reset()
