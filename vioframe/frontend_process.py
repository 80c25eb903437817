"""The front-end in a process of its own, so that points are followed on one core while another one estimates.

Not in a thread: the two halves of the work are short compiled loops with Python between them, and threads would wait
for the interpreter's lock many times a frame. Images go through memory that both see, the rest through pipes; what
comes back is what :class:`~vioframe.frontend.Frontend` gives, to the last bit. This is the side of whoever estimates,
:mod:`vioframe.frontend_worker` the other one.

Next to nothing is imported here: the other process is to be begun before this one loads what it needs itself.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any, Self
from weakref import finalize

from vioframe.cores import ONE_BLAS_THREAD
from vioframe.errors import RunError, VioframeError

if TYPE_CHECKING:
    from vioframe.frontend import FrontendOptions
    from vioframe.incidents import Incidents
    from vioframe.parts.registry import Origin, Part
    from vioframe.types import Calibration, FrameSet, FrameTracks, Image, ImuSegment

FRAMES_AHEAD = 3
"""Frames whose points may be followed while one is estimated from."""
# Images come and go with every frame. glibc would give their memory back each time, and have it filled with zeros anew.
_KEPT_MEMORY = {"MALLOC_TOP_PAD_": str(64 << 20)}


@dataclass(frozen=True, slots=True)
class Setup:
    """What the other process needs to know ahead of the first frame; ``detector`` is called so by its plug-in."""

    origin: Origin
    detector: str
    detector_options: Mapping[str, Any]
    calibration: Calibration
    options: FrontendOptions
    warm: bool


@dataclass(frozen=True, slots=True)
class Job:
    """A frame to follow points to; lenses are those of ``lenses``, the cameras' poses those of ``calibration``."""

    imu: ImuSegment
    t_ns: int
    places: tuple[Image | int | None, ...]
    calibration: Calibration
    lenses: Calibration


Incident = tuple[str, int | None, str]
"""What :meth:`vioframe.incidents.Incidents.add` takes."""


@dataclass(frozen=True, slots=True)
class Done:
    """What has come of a frame, or of the set-up, of which there are no tracks."""

    tracks: FrameTracks
    stage_seconds: dict[str, float]
    incidents: list[Incident]


@dataclass(frozen=True, slots=True)
class Compiling:
    """That it takes longer, as ``kernel`` is being compiled."""

    kernel: str


@dataclass(frozen=True, slots=True)
class Failed:
    """By an ``error`` that is told to users, or one that is a bug, with its ``trace``."""

    error: VioframeError | MemoryError | None
    trace: str
    incidents: list[Incident]


class FrontendProcess:
    """Does what :class:`~vioframe.frontend.Frontend` does, with a detector made there of an installed part.

    It begins to load at once, and needs :meth:`set_up` ahead of the first frame. Between :meth:`begin` and :meth:`end`
    a frame is followed meanwhile.
    """

    def __init__(self) -> None:
        self._memory = _file_in_memory()
        descriptor = self._memory.fileno()
        # The same modules are to be found there, whatever has been done to the path here.
        begin = f"from vioframe.frontend_worker import serve; serve({descriptor})"
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {begin}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[descriptor],
            env={**os.environ, **_KEPT_MEMORY, **ONE_BLAS_THREAD},
        )
        self._end = finalize(self, _end, self._process)
        self._is_ready = False
        self.stage_seconds: Mapping[str, float] = {}
        """Seconds that the last frame took, by stage."""

    def set_up(
        self,
        detector: Part,
        detector_options: Mapping[str, Any],
        calibration: Calibration,
        options: FrontendOptions,
        incidents: Incidents,
        *,
        warm: bool,
    ) -> None:
        """Make the front-end there; what goes wrong in that is raised with the first frame.

        ``warm``, it has looked at some images before.
        """
        from vioframe.shared_images import SharedImages

        self._incidents, self._lenses = incidents, calibration
        try:
            self._images = SharedImages(self._memory.fileno(), calibration, FRAMES_AHEAD)
        except OSError as error:
            what = f"no memory for the images that two processes share: {error.strerror}"
            raise RunError(f"{what}; --cores 1 does with one process") from error
        self._send(Setup(detector.origin, detector.own_name, detector_options, calibration, options, warm))

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
        self._send(Job(imu, frames.t_ns, self._images.put(frames.images), calibration, self._lenses))

    def end(self) -> FrameTracks:
        """The tracks of what was begun first of all that has not ended; raises what following them raised."""
        done = self._receive()
        self.stage_seconds = done.stage_seconds
        return done.tracks

    def close(self) -> None:
        """End the process, whatever it does."""
        self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_until_ready(self) -> None:
        if not self._is_ready:
            self._receive()
            self._is_ready = True

    def _send(self, message: Setup | Job) -> None:
        try:
            put(message, self._process.stdin)
        except (OSError, ValueError) as error:  # it has gone, or was closed
            raise self._gone() from error

    def _receive(self) -> Done:
        try:
            while isinstance(answer := pickle.load(self._process.stdout), Compiling):  # type: ignore[arg-type]
                from vioframe.jit import tell_of

                tell_of(answer.kernel)
        except (EOFError, ValueError, pickle.UnpicklingError) as error:
            raise self._gone() from error
        for incident in answer.incidents:
            self._incidents.add(*incident)
        if isinstance(answer, Done):
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


def _file_in_memory() -> IO[bytes]:
    """One without a name; where the system has none, one on disk that has lost its name."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("vioframe-images"), "r+b")
    return TemporaryFile(prefix="vioframe-images-")


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    for pipe in (process.stdin, process.stdout):
        with suppress(OSError):
            pipe.close()  # type: ignore[union-attr]
    process.wait()


def put(message: object, pipe: IO[bytes] | None) -> None:
    """Send it at once."""
    assert pipe is not None
    pickle.dump(message, pipe, pickle.HIGHEST_PROTOCOL)
    pipe.flush()
