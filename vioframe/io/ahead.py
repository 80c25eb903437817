"""Reading a recording, and decoding its images, ahead of their use."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

from vioframe.cores import usable_cores
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


def decoded_ahead(measurements: Iterable[Measurement | Callable[[], Measurement]]) -> Iterator[Measurement]:
    """The same in their order, of which some are still to be made: by a thread, where there is a core for it.

    Decoders work beside Python. What fails, be it making one or bringing them, fails in its turn.
    """
    if usable_cores() == 1:
        for each in measurements:
            yield each() if callable(each) else each
        return
    waiting: deque[Measurement | Future[Measurement]] = deque()
    with ThreadPoolExecutor(1, "decoder") as thread:
        in_work = 0
        try:
            for each in _failing_in_turn(measurements):
                waiting.append(thread.submit(each) if callable(each) else each)
                in_work += callable(each)
                while waiting and (in_work > _AHEAD or not isinstance(waiting[0], Future)):
                    in_work -= isinstance(waiting[0], Future)
                    yield _made(waiting.popleft())
            while waiting:
                yield _made(waiting.popleft())
        finally:
            thread.shutdown(wait=False, cancel_futures=True)


def _made(measurement: Measurement | Future[Measurement]) -> Measurement:
    return measurement.result() if isinstance(measurement, Future) else measurement


def _failing_in_turn(
    measurements: Iterable[Measurement | Callable[[], Measurement]],
) -> Iterator[Measurement | Callable[[], Measurement]]:
    """The same, and where they fail one that cannot be made."""

    def fail() -> Measurement:
        raise failure

    try:
        yield from measurements
    except Exception as error:
        failure = error
        yield fail


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
