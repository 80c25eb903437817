"""A recording of what comes in, written by a thread of its own: that run again gives the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Queue
from threading import Thread

from vioframe.errors import DatasetError
from vioframe.io.convert import FORMATS, format_of, write_recording, write_sidecar
from vioframe.io.replace import appearing
from vioframe.types import Calibration, Measurement

# So many may wait for the disk; then the estimator does.
_MOST_WAITING = 1000


class Tape:
    """Takes measurements in the order in which they are to be read."""

    def __init__(self) -> None:
        self._waiting: Queue[Measurement | None] = Queue(_MOST_WAITING)
        self._error: Exception | None = None

    def add(self, measurement: Measurement) -> None:
        """Raises :class:`DatasetError` where the recording can no longer be written."""
        if self._error is not None:
            raise self._error
        self._waiting.put(measurement)

    def _measurements(self) -> Iterator[Measurement]:
        while (measurement := self._waiting.get()) is not None:
            yield measurement

    def _write(self, destination: Path, calibration: Calibration) -> None:
        try:
            with appearing(destination) as unfinished:
                names = [camera.name for camera in calibration.cameras]
                with FORMATS[format_of(destination)].open(unfinished, None, names) as writer:
                    write_recording(self._measurements(), None, [writer])
        except Exception as error:
            self._error = error
            for _ in self._measurements():  # nobody may wait for what is not written
                pass


@contextmanager
def taped(destination: Path, calibration: Calibration) -> Iterator[Tape]:
    """Write what the tape is given to ``destination``, complete by the end, however that comes.

    Raises :class:`DatasetError` where it exists, or tells no format.
    """
    if format_of(destination) == "asl":
        raise DatasetError(f"an ASL folder keeps no order of arrival; record to {destination}.mcap instead")
    if destination.exists():
        raise DatasetError(f"{destination} exists already; remove it or choose another name")
    write_sidecar(calibration, destination)
    tape = Tape()
    thread = Thread(target=tape._write, args=(destination, calibration), name="tape")
    thread.start()
    try:
        yield tape
    finally:
        tape._waiting.put(None)
        thread.join()
    if tape._error is not None:
        raise tape._error
