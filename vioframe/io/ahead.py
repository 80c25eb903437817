"""Reading a recording ahead of its use."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

from vioframe.types import FrameSet, Measurement

# Frames that may wait, decoded.
_AHEAD = 4


def read_ahead(measurements: Iterable[Measurement]) -> Iterator[Measurement]:
    """The same, read and decoded by a thread of its own some frames before they are asked for.

    An error of whoever brings them comes when those before it are used up.
    """
    batches = _to_a_frame(measurements)
    with ThreadPoolExecutor(1, "reader") as thread:
        waiting = deque(thread.submit(next, batches, None) for _ in range(_AHEAD))
        try:
            while (batch := waiting.popleft().result()) is not None:
                waiting.append(thread.submit(next, batches, None))
                yield from batch
        finally:
            for future in waiting:
                future.cancel()
            with suppress(RuntimeError):  # where the interpreter is about to end
                thread.submit(batches.close)  # by who opened it: a data base insists on that


def _to_a_frame(measurements: Iterable[Measurement]) -> Generator[list[Measurement]]:
    """Cut behind every frame, and where it ends or fails."""
    batch: list[Measurement] = []
    failure: Exception | None = None
    try:
        for measurement in measurements:
            batch.append(measurement)
            if isinstance(measurement, FrameSet):
                yield batch
                batch = []
    except Exception as error:
        failure = error
    yield batch
    if failure is not None:
        raise failure
