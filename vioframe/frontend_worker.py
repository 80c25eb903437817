"""The process that follows points for another one, which has a :class:`~vioframe.frontend_process.FrontendProcess`."""

from __future__ import annotations

import logging
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from queue import SimpleQueue
from threading import Thread
from traceback import format_exc
from typing import IO

from vioframe.cores import limited_threads, usable_cores
from vioframe.errors import VioframeError
from vioframe.frontend import Frontend, lucas_kanade, warming
from vioframe.frontend_process import FRAMES_AHEAD, Compiling, Done, Failed, Incident, Job, Setup, put
from vioframe.incidents import Incidents
from vioframe.jit import have_been_compiled, heard
from vioframe.parts import registry
from vioframe.shared_images import SharedImages
from vioframe.types import FrameSet, FrameTracks


def serve(memory: int) -> None:
    """Take one :class:`Setup`, then a :class:`Job` a frame, until there are no more; answer each.

    ``memory`` is the descriptor of the file that images lie in.
    """
    # Signals, and a plug-in that does not load, reach every process of a group; one that says so is enough.
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    logging.getLogger("vioframe").addHandler(logging.NullHandler())
    source, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # a detector, which is anybody's code, may print
    incidents = _Noted()

    def compiling(kernel: str) -> None:
        put(Compiling(kernel), answers)

    with suppress(EOFError, BrokenPipeError), limited_threads(opencv=usable_cores() - 1), heard(compiling):
        try:
            if have_been_compiled(lucas_kanade):  # else the first frame needs but some of them
                warming.load_kernels()  # while the other process is busy with itself
            setup = pickle.load(source)
            _follow(setup, SharedImages(memory, setup.calibration, FRAMES_AHEAD), incidents, source, answers)
        except EOFError:
            raise
        except Exception as error:
            told = error if isinstance(error, VioframeError | MemoryError) else None
            put(Failed(told, format_exc(), incidents.taken()), answers)


@dataclass
class _Noted(Incidents):
    """What is to be told of this frame."""

    new: list[Incident] = field(default_factory=list)

    def add(self, kind: str, t_ns: int | None = None, detail: str = "") -> None:
        self.new.append((kind, t_ns, detail))

    def taken(self) -> list[Incident]:
        new, self.new = self.new, []
        return new


def _follow(setup: Setup, images: SharedImages, incidents: _Noted, source: IO[bytes], answers: IO[bytes]) -> None:
    installed = registry.load_alone(setup.origin)
    with installed.blaming():
        detector = installed.create_detector(setup.detector, setup.detector_options)
        if setup.warm:
            warming.warm_up(detector, setup.calibration, setup.options)
        follower = Frontend(detector, setup.calibration, setup.options, incidents)
        put(Done(FrameTracks.none(0), {}, []), answers)
        for job in _ahead(source):
            follower.recalibrate(job.lenses)
            frames = FrameSet(job.t_ns, images.taken(job.places))
            tracks = follower.track(job.imu, frames, job.calibration)
            put(Done(tracks, follower.stage_seconds, incidents.taken()), answers)


def _ahead(source: IO[bytes]) -> Iterator[Job]:
    """Jobs as they come, the next one read meanwhile: whoever sends it never waits for this process to take it."""
    jobs: SimpleQueue[Job | None] = SimpleQueue()

    def read() -> None:
        with suppress(EOFError):
            while True:
                jobs.put(pickle.load(source))
        jobs.put(None)

    Thread(target=read, name="jobs", daemon=True).start()
    while (job := jobs.get()) is not None:
        yield job
