"""Visual-inertial odometry: push what the sensors bring, get what is known after each frame.

    measurements -> packets -> tracks -> estimate -> files -> report

:class:`Odometry` is the main loop. A recording is pushed through it by :mod:`vioframe.pipeline`, a live camera by
anybody; a recorder and a progress bar are consumers of the :class:`~vioframe.types.Step` objects it gives. So is a loop
closer, the first of them: what it knows by then goes along with the step.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from vioframe.cores import limited_threads, usable_cores
from vioframe.errors import ConfigError, DatasetError, PluginError
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.options import EstimationOptions
from vioframe.estimation.soundness import defect_of_correction
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.frontend import warming as frontend_warming
from vioframe.frontend_process import FRAMES_AHEAD, FrontendProcess
from vioframe.incidents import Incidents
from vioframe.interfaces import Backend, Detector, LoopCloser
from vioframe.io.ahead import read_ahead
from vioframe.io.synchronise import Packet, Synchroniser
from vioframe.parts import registry
from vioframe.parts.registry import Registry
from vioframe.stopwatch import working_s
from vioframe.types import (
    Calibration,
    FrameSet,
    FrameTracks,
    Image,
    ImuSample,
    ImuSegment,
    LoopClosure,
    Measurement,
    NavState,
    Step,
)
from vioframe.warming import loading_meanwhile, warm_up


@dataclass(frozen=True, slots=True)
class _Seen:
    """A frame's points, and the seconds that they took by stage; ``by`` has cut the readings, and undistorted them."""

    imu: ImuSegment
    frames: FrameSet
    tracks: FrameTracks
    by: Calibration
    stage_seconds: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class _Known:
    """The calibration as the newest estimate has it, and that by which a flight is followed, which starts find."""

    rig: Calibration
    following: Calibration


class Odometry:
    """Estimates motion from a camera and an IMU as their measurements come in; the same input gives the same bytes.

    ``detector`` and ``backend`` are names of installed parts, with their options beside them, or the parts themselves.
    ``initial_state``, with covariance, stands for the state at the first frame and spares the initialisation.

    A frame waits until readings from ``wait_ms`` behind it are there, so that a reading may come that much later than
    its turn. In a stream in order 0 gives the least latency: the first reading at or behind a frame lets it go.

    ``loop_closer``, named or a part likewise, recognises places beside the loop. The estimate is the same with it and
    without: ``Step.correction`` says where in the map it is, and :meth:`close_loops` corrects the whole flight.

    A back-end named is ``warm`` before the first frame, and a detector named with it: their code is compiled, half a
    minute once after installation, or loaded. A recording, whose frames wait for it, begins sooner without.

    ``pipelined``, the front-end has a process of its own, so that :meth:`follow` has the points of a frame followed
    while the one before it is estimated from: the same bytes, sooner where there are two cores. Its detector is named.
    One that is given has begun to load already.

    ``incidents`` counts what was handled on the way: dropped samples, unusable images, failing detectors.
    """

    def __init__(
        self,
        calibration: Calibration,
        detector: str | Detector = "shi_tomasi",
        backend: str | Backend = "msckf",
        *,
        detector_options: Mapping[str, Any] | None = None,
        backend_options: Mapping[str, Any] | None = None,
        loop_closer: str | LoopCloser | None = None,
        loop_closer_options: Mapping[str, Any] | None = None,
        frontend: FrontendOptions | None = None,
        estimation: EstimationOptions | None = None,
        initial_state: NavState | None = None,
        wait_ms: float = 50.0,
        warm: bool = True,
        pipelined: FrontendProcess | bool = False,
        incidents: Incidents | None = None,
        installed: Registry | None = None,
    ) -> None:
        self._registry = registry.load() if installed is None else installed
        self.incidents = Incidents() if incidents is None else incidents
        options, warm_detector = frontend or FrontendOptions(), None
        self._frontend: Frontend | FrontendProcess
        if pipelined:
            if not isinstance(detector, str):
                raise ConfigError("pipelined, the front-end has a process of its own: name an installed detector")
            part = self._registry.find(registry.DETECTOR, detector)
            complete = part.validate(detector_options or {})
            self._frontend = FrontendProcess() if pipelined is True else pipelined
            self._frontend.set_up(part, complete, calibration, options, self.incidents, warm=warm)
        else:
            if isinstance(detector, str):
                detector = self._registry.create_detector(detector, detector_options)
                warm_detector = detector if warm else None
            self._frontend = Frontend(detector, calibration, options, self.incidents)
        name, warm_backend = None, None
        if isinstance(backend, str):
            name = str(self._registry.find(registry.BACKEND, backend))
            warm_backend = self._registry.create_backend(backend, backend_options) if warm else None
            backend = self._registry.create_backend(backend, backend_options)
        self._is_warm = warm_backend is not None
        self._loop_closer_name = f"the loop closer {type(loop_closer).__name__}"
        if isinstance(loop_closer, str):
            self._loop_closer_name = str(self._registry.find(registry.LOOP_CLOSER, loop_closer))
            loop_closer = self._registry.create_loop_closer(loop_closer, calibration, loop_closer_options)
        self._loop_closer = loop_closer
        self._life = LifeCycle(backend, calibration, estimation, initial_state, name)
        with self._registry.blaming(), limited_threads():
            if warm_backend is not None:
                warm_up(warm_backend, calibration)
            if warm_detector is not None:
                frontend_warming.warm_up(warm_detector, calibration, options)
        self._synchroniser = Synchroniser(
            self.incidents, time_offset_ns=calibration.cameras[0].time_offset_ns, wait_ms=wait_ms
        )
        self._waiting_tracks: dict[int, FrameTracks] = {}
        self._given = calibration.lenses
        self.calibration = calibration
        """What is known of the rig by now: as given at first, then as the back-end has learned it."""
        known = _Known(calibration, self._life.calibration)
        # After the newest estimate, and those before it.
        self._known = deque([known] * (FRAMES_AHEAD + 1), maxlen=FRAMES_AHEAD + 1)
        self._using = known

    def add(self, measurement: Measurement) -> list[Step]:
        """Take one measurement; the steps of the frames that are complete by it."""
        self._prepare(measurement)
        return [self._step(imu, frames) for imu, frames in self._synchroniser.add(measurement)]

    def add_imu(self, t_ns: ArrayLike, gyro_B: ArrayLike, accel_B: ArrayLike) -> list[Step]:
        """Take readings at ``t_ns`` (N,) of the IMU's clock: (N, 3) rad/s and (N, 3) m/s^2; or a single one.

        They are copied: the arrays may be filled anew.
        """
        stamps = np.atleast_1d(np.asarray(t_ns, np.int64))
        gyro, accel = (np.array(a, np.float64).reshape(-1, 3) for a in (gyro_B, accel_B))
        if not len(stamps) == len(gyro) == len(accel):
            raise DatasetError(f"{len(stamps)} stamps came with {len(gyro)} and {len(accel)} readings; give one each")
        samples = (ImuSample(*reading) for reading in zip(stamps.tolist(), gyro, accel, strict=True))
        return [step for sample in samples for step in self.add(sample)]

    def add_images(self, t_ns: int, *images: Image | None) -> list[Step]:
        """Take the images of one exposure at ``t_ns`` of the camera's clock, (H, W) uint8, in the order of the rig.

        They are copied: a camera may fill its buffer anew while its frame waits for readings.
        """
        if len(images) != len(self.calibration.cameras) or all(image is None for image in images):
            raise DatasetError(f"{len(images)} images came for a rig of {len(self.calibration.cameras)} cameras")
        return self.add(FrameSet(int(t_ns), tuple(None if image is None else _own(image) for image in images)))

    def add_tracks(self, tracks: FrameTracks, images: tuple[Image | None, ...] = ()) -> list[Step]:
        """Take a frame whose points somebody else has tracked, in the place of its images; detector and tracker rest.

        ``images`` are passed on to the consumers of the step, such as a loop closer.
        """
        self._waiting_tracks.setdefault(tracks.t_ns, tracks)  # of two frames of one stamp the first counts
        return self.add(FrameSet(tracks.t_ns, images))

    def finish(self) -> list[Step]:
        """The steps of the frames that still wait for readings: nothing more will come."""
        return [self._step(imu, frames) for imu, frames in self._synchroniser.finish()]

    def close_loops(self) -> LoopClosure | None:
        """What the loop closer, if any, made of all steps; to be called once, after the last of them."""
        if self._loop_closer is None:
            return None
        with limited_threads(), self._registry.blaming():
            closure = self._loop_closer.finish()
        if not isinstance(closure, LoopClosure):
            what = f"{self._loop_closer_name} returned a {type(closure).__name__}, not a LoopClosure"
            raise PluginError(f"{what}; repair the plug-in")
        return closure

    def follow(self, measurements: Iterable[Measurement]) -> Iterator[Step]:
        """The steps of a whole stream, to its end; ``pipelined``, a thread reads ahead where a core is left for it."""
        if isinstance(self._frontend, FrontendProcess):
            cores = usable_cores()
            try:
                with limited_threads(opencv=cores - 1):
                    packets = self._packets(read_ahead(measurements) if cores > 2 else measurements)
                    if not self._is_warm:
                        packets = loading_meanwhile(packets, self.calibration)
                    yield from self._follow_ahead(packets, self._frontend)
            finally:
                self._frontend.close()
        else:
            for imu, frames in self._packets(measurements, prepared=True):
                yield self._step(imu, frames)

    def _prepare(self, measurement: Measurement) -> None:
        """Use the time for which a frame waits for readings."""
        if isinstance(measurement, FrameSet) and measurement.t_ns not in self._waiting_tracks:
            with limited_threads():
                self._frontend.prepare(measurement)

    def _packets(self, measurements: Iterable[Measurement], *, prepared: bool = False) -> Iterator[Packet]:
        for measurement in measurements:
            if prepared:
                self._prepare(measurement)
            yield from self._synchroniser.add(measurement)
        yield from self._synchroniser.finish()

    def _follow_ahead(self, packets: Iterator[Packet], frontend: FrontendProcess) -> Iterator[Step]:
        """Each step when the points of the next frames are already being followed."""
        ahead: deque[tuple[ImuSegment, FrameSet, Calibration]] = deque()
        failure: Exception | None = None
        while True:
            self._use(len(ahead))
            try:
                packet = next(packets)
            except StopIteration:
                break
            except Exception as error:  # of whoever brings the measurements: what came before it still counts
                failure = error
                break
            frontend.begin(*packet, self._using.rig)
            ahead.append((*packet, self._using.following))
            if len(ahead) > FRAMES_AHEAD:
                yield self._estimate(self._seen(*ahead.popleft(), frontend.end()))
        while ahead:
            yield self._estimate(self._seen(*ahead.popleft(), frontend.end()))
        if failure is not None:
            raise failure

    def _step(self, imu: ImuSegment, frames: FrameSet) -> Step:
        step = self._estimate(self._see(imu, frames))
        self._use(0)
        return step

    def _see(self, imu: ImuSegment, frames: FrameSet) -> _Seen:
        """Follow the points of one frame."""
        with limited_threads(), self._registry.blaming():
            tracks = self._waiting_tracks.pop(frames.t_ns, None)
            # Those before it belong to frames that were dropped.
            self._waiting_tracks = {t_ns: kept for t_ns, kept in self._waiting_tracks.items() if t_ns > frames.t_ns}
            by = self._using.following
            if tracks is None:
                return self._seen(imu, frames, by, self._frontend.track(imu, frames, self._using.rig))
            return _Seen(imu, frames, tracks.undistorted(*by.lenses, by=self._given), by, {})

    def _seen(self, imu: ImuSegment, frames: FrameSet, by: Calibration, tracks: FrameTracks) -> _Seen:
        """What the front-end has just given for a frame."""
        return _Seen(imu, frames, tracks, by, self._frontend.stage_seconds)

    def _estimate(self, seen: _Seen) -> Step:
        """Estimate from one frame that was seen."""
        with limited_threads(), self._registry.blaming():
            begin_s = working_s()
            estimate = self._life.process(seen.imu, seen.tracks, seen.by)
            backend_s = working_s() - begin_s
        if estimate.calibration is not None:
            self.calibration = estimate.calibration.calibration
        self._known.append(_Known(self.calibration, self._life.calibration))
        within = {f"backend.{stage}": seconds for stage, seconds in estimate.stage_seconds.items()}
        step = Step(seen.frames, seen.tracks, estimate, {**seen.stage_seconds, "backend": backend_s, **within})
        return step if self._loop_closer is None else self._corrected(step, self._loop_closer)

    def _corrected(self, step: Step, loop_closer: LoopCloser) -> Step:
        """The step with what the loop closer knows by it."""
        with limited_threads(), self._registry.blaming():
            begin_s = working_s()
            correction = loop_closer.add(step)
            seconds = {**step.stage_seconds, "loop_closure": working_s() - begin_s}
        if (defect := defect_of_correction(correction)) is not None:
            raise PluginError(f"{self._loop_closer_name} at {step.frames.t_ns} ns: {defect}; repair the plug-in")
        return replace(step, stage_seconds=seconds, correction=correction)

    def _use(self, ahead: int) -> None:
        """Cut the next frame, and follow its points, by what was known ``FRAMES_AHEAD`` + 1 frames before it.

        That is so with any number ``ahead`` of frames that were begun and are still to be estimated from, so that two
        processes give what one does.
        """
        using, self._using = self._using, self._known[ahead]
        if self._using is not using:
            self._synchroniser.retime(self._using.following.cameras[0].time_offset_ns)
            self._frontend.recalibrate(self._using.following)


def _own(image: Image) -> Image:
    copy = np.array(image)
    copy.flags.writeable = False
    return copy
