"""The front-end in a process of its own, so that points are followed on one core while another one estimates.

Not in a thread: the two halves of the work are short compiled loops with Python between them, and threads would wait
for the interpreter's lock many times a frame. Images go through memory that both see, the rest through pipes; what
comes back is what :class:`~vioframe.frontend.Frontend` gives, to the last bit.
"""

from __future__ import annotations

import logging
import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from mmap import mmap
from queue import SimpleQueue
from tempfile import TemporaryFile
from threading import Thread
from traceback import format_exc
from typing import IO, Any
from weakref import finalize

import numpy as np

from vioframe.cores import limited_threads, usable_cores
from vioframe.errors import RunError, VioframeError
from vioframe.frontend import Frontend, FrontendOptions, warming
from vioframe.incidents import Incidents
from vioframe.parts import registry
from vioframe.types import Calibration, FrameSet, FrameTracks, Image, ImuSegment

# Frames whose images lie in memory at once: one that is being taken from there, one that waits, one that is being put.
_SLOTS = 3


@dataclass(frozen=True, slots=True)
class _Setup:
    origin: registry.Origin
    name: str
    detector_options: Mapping[str, Any]
    calibration: Calibration
    options: FrontendOptions
    warm: bool
    memory: int
    """The descriptor of a file that :class:`_Images` are in."""


@dataclass(frozen=True, slots=True)
class _Job:
    """A frame to follow points to; lenses are those of ``lenses``, the cameras' poses those of ``calibration``."""

    imu: ImuSegment
    t_ns: int
    places: tuple[Image | int | None, ...]
    calibration: Calibration
    lenses: Calibration


@dataclass(frozen=True, slots=True)
class _Done:
    tracks: FrameTracks
    stage_seconds: dict[str, float]
    incidents: list[tuple[str, int | None, str]]


@dataclass(frozen=True, slots=True)
class _Failed:
    """By an ``error`` that is told to users, or one that is a bug, with its ``trace``."""

    error: VioframeError | MemoryError | None
    trace: str


class _Images:
    """Images of a rig's cameras in memory that two processes see, a few frames in turn."""

    def __init__(self, memory: int, calibration: Calibration) -> None:
        self._shapes = [camera.model.resolution[::-1] for camera in calibration.cameras]
        sizes = [height * width for height, width in self._shapes]
        self._begins = np.cumsum([0, *sizes[:-1]])
        self._frame_bytes = sum(sizes)
        if os.fstat(memory).st_size == 0:
            os.truncate(memory, _SLOTS * self._frame_bytes)
        self._memory = np.frombuffer(mmap(memory, _SLOTS * self._frame_bytes), np.uint8)
        self._slot = 0

    def put(self, images: tuple[Image | None, ...]) -> tuple[Image | int | None, ...]:
        """Where each image now is; itself, if it is none or not as calibrated, which the front-end will refuse."""
        self._slot = (self._slot + 1) % _SLOTS
        places: list[Image | int | None] = []
        for image, shape, begin in zip(images, self._shapes, self._begins, strict=True):
            place = self._slot * self._frame_bytes + int(begin)
            if image is None or image.shape != shape or image.dtype != np.uint8:
                places.append(image)
            else:
                self._at(place, shape)[:] = image
                places.append(place)
        return tuple(places)

    def taken(self, places: tuple[Image | int | None, ...]) -> tuple[Image | None, ...]:
        """Copies of what was put: a detector, which is anybody's code, may keep them."""
        return tuple(
            self._at(place, shape).copy() if isinstance(place, int) else place
            for place, shape in zip(places, self._shapes, strict=True)
        )

    def _at(self, place: int, shape: tuple[int, int]) -> Image:
        return self._memory[place : place + shape[0] * shape[1]].reshape(shape)


class FrontendProcess:
    """Does what :class:`~vioframe.frontend.Frontend` does, with a detector made there of an installed part.

    It gets ready beside whoever made it. Between :meth:`begin` and :meth:`end` a frame is followed meanwhile.
    """

    def __init__(
        self,
        detector: registry.Part,
        detector_options: Mapping[str, Any],
        calibration: Calibration,
        options: FrontendOptions,
        incidents: Incidents,
        *,
        warm: bool = False,
    ) -> None:
        # The same modules are to be found there, whatever has been done to the path here.
        code = f"import sys; sys.path[:] = {sys.path!r}; from vioframe.frontend_process import serve; serve()"
        with TemporaryFile(prefix="vioframe-") as memory:  # which stays as long as it is mapped
            self._images = _Images(memory.fileno(), calibration)
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                pass_fds=[memory.fileno()],
            )
            self._end = finalize(self, _end, self._process)
            name = detector.name.partition("@")[0]
            setup = _Setup(detector.origin, name, detector_options, calibration, options, warm, memory.fileno())
        self._incidents = incidents
        self._lenses = calibration
        self.stage_seconds: Mapping[str, float] = {}
        """Seconds that the last frame took, by stage."""
        self._send(setup)
        self._is_ready = False

    def prepare(self, frames: FrameSet) -> None:
        """Nothing that it would be worth to send a frame twice for."""

    def recalibrate(self, calibration: Calibration) -> None:
        """Count with the lenses of ``calibration`` from the next frame that is begun."""
        self._lenses = calibration

    def track(self, imu: ImuSegment, frames: FrameSet, calibration: Calibration) -> FrameTracks:
        """As :meth:`vioframe.frontend.Frontend.track`."""
        self.begin(imu, frames, calibration)
        return self.end()

    def begin(self, imu: ImuSegment, frames: FrameSet, calibration: Calibration) -> None:
        """Have points followed to ``frames`` when those begun before are through, each of which has its :meth:`end`."""
        self._wait_until_ready()
        self._send(_Job(imu, frames.t_ns, self._images.put(frames.images), calibration, self._lenses))

    def end(self) -> FrameTracks:
        """The tracks of what was begun first of all that has not ended; raises what following them raised."""
        done: _Done = self._receive()
        self.stage_seconds = done.stage_seconds
        for incident in done.incidents:
            self._incidents.add(*incident)
        return done.tracks

    def close(self) -> None:
        """End the process, whatever it does."""
        self._end()

    def _wait_until_ready(self) -> None:
        if not self._is_ready:
            self._receive()
            self._is_ready = True

    def _send(self, message: _Setup | _Job) -> None:
        try:
            _put(message, self._process.stdin)
        except (OSError, ValueError) as error:  # it has gone, or was closed
            raise self._gone() from error

    def _receive(self) -> Any:
        try:
            answer = pickle.load(self._process.stdout)  # type: ignore[arg-type]
        except (EOFError, ValueError, pickle.UnpicklingError) as error:
            raise self._gone() from error
        if not isinstance(answer, _Failed):
            return answer
        self.close()
        if answer.error is not None:
            raise answer.error
        raise RuntimeError(f"in the front-end's process:\n{answer.trace}")

    def _gone(self) -> RunError:
        self.close()
        code = self._process.returncode
        return RunError(
            f"the process that follows points has ended (exit code {code}), perhaps for want of memory; "
            "--cores 1 does with one process"
        )


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    for pipe in (process.stdin, process.stdout):
        with suppress(OSError):
            pipe.close()  # type: ignore[union-attr]
    process.wait()


def _put(message: object, pipe: IO[bytes] | None) -> None:
    assert pipe is not None
    pickle.dump(message, pipe, pickle.HIGHEST_PROTOCOL)
    pipe.flush()


@dataclass
class _Noted(Incidents):
    """What is to be told of this frame."""

    new: list[tuple[str, int | None, str]] = field(default_factory=list)

    def add(self, kind: str, t_ns: int | None = None, detail: str = "") -> None:
        self.new.append((kind, t_ns, detail))

    def taken(self) -> list[tuple[str, int | None, str]]:
        new, self.new = self.new, []
        return new


def serve() -> None:
    """The process: one :class:`_Setup` comes in, then a :class:`_Job` a frame, until the pipe ends."""
    # Signals, and a plug-in that does not load, reach every process of a group; one that says so is enough.
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    logging.getLogger("vioframe").addHandler(logging.NullHandler())
    source, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a detector, which is anybody's code, may print
    with suppress(EOFError, BrokenPipeError):
        try:
            with limited_threads(opencv=usable_cores() - 1):
                _follow(pickle.load(source), source, answers)
        except EOFError:
            raise
        except Exception as error:
            told = error if isinstance(error, VioframeError | MemoryError) else None
            _put(_Failed(told, format_exc()), answers)


def _follow(setup: _Setup, source: IO[bytes], answers: IO[bytes]) -> None:
    # That one alone, under its own name: what others are called is no matter here.
    installed = registry.load(entry for entry in registry.entries() if registry.origin(entry) == setup.origin)
    incidents, images = _Noted(), _Images(setup.memory, setup.calibration)
    with installed.blaming():

        def frontend(told: Incidents) -> Frontend:
            detector = installed.create_detector(setup.name, setup.detector_options)
            return Frontend(detector, setup.calibration, setup.options, told)

        if setup.warm:
            warming.warm_up(frontend(Incidents()), setup.calibration)
        follower = frontend(incidents)
        _put(_Done(FrameTracks.none(0), {}, []), answers)
        for job in _ahead(source):
            follower.recalibrate(job.lenses)
            frames = FrameSet(job.t_ns, images.taken(job.places))
            tracks = follower.track(job.imu, frames, job.calibration)
            _put(_Done(tracks, follower.stage_seconds, incidents.taken()), answers)


def _ahead(source: IO[bytes]) -> Iterator[_Job]:
    """Jobs as they come, the next one read meanwhile: whoever sends it never waits for this process to take it."""
    jobs: SimpleQueue[_Job | None] = SimpleQueue()

    def read() -> None:
        with suppress(EOFError):
            while True:
                jobs.put(pickle.load(source))
        jobs.put(None)

    Thread(target=read, name="jobs", daemon=True).start()
    while (job := jobs.get()) is not None:
        yield job
