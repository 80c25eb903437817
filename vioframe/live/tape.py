"""A recording of what comes in, written by a thread of its own: that run again gives the same bytes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from queue import Queue
from threading import Thread
from typing import Self

from vioframe.errors import DatasetError
from vioframe.io.convert import FORMATS, format_of, write_recording, write_sidecar
from vioframe.io.replace import appearing
from vioframe.types import Calibration, Measurement

# So many may wait for the disk; then the estimator does.
_MOST_WAITING = 1000


class Tape:
    """Takes measurements in the order in which they are to be read; a context manager.

    ``destination`` is complete in the end, however that comes. Raises :class:`DatasetError` where it exists, tells no
    format that keeps an order, or can no longer be written.
    """

    def __init__(self, destination: Path, calibration: Calibration) -> None:
        if format_of(destination) == "asl":
            raise DatasetError(f"an ASL folder keeps no order of arrival; record to {destination}.mcap instead")
        if destination.exists():
            raise DatasetError(f"{destination} exists already; remove it or choose another name")
        write_sidecar(calibration, destination)
        self._destination, self._calibration = destination, calibration
        self._waiting: Queue[Measurement | None] = Queue(_MOST_WAITING)
        self._error: Exception | None = None
        self._thread = Thread(target=self._write, name="tape")

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._waiting.put(None)
        self._thread.join()
        if kind is None and self._error is not None:
            raise self._error

    def add(self, measurement: Measurement) -> None:
        if self._error is not None:
            raise self._error
        self._waiting.put(measurement)

    def _measurements(self) -> Iterator[Measurement]:
        while (measurement := self._waiting.get()) is not None:
            yield measurement

    def _write(self) -> None:
        """The thread."""
        try:
            with appearing(self._destination) as unfinished:
                names = [camera.name for camera in self._calibration.cameras]
                with FORMATS[format_of(self._destination)].open(unfinished, None, names) as writer:
                    write_recording(self._measurements(), None, [writer])
        except Exception as error:
            self._error = error
            for _ in self._measurements():  # nobody may wait for what is not written
                pass
