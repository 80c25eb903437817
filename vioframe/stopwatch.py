"""Seconds by stage, for the timing columns of a run."""

from collections.abc import Callable, Mapping
from time import perf_counter

from vioframe.jit import waited_s


def working_s(clock: Callable[[], float] = perf_counter) -> float:
    """A clock of this thread, s, that stands still while a kernel is compiled or loaded: that happens once.

    With ``thread_time`` it also does while others have the processor.
    """
    return clock() - waited_s(clock)


class Stopwatch:
    """Started when made; each :meth:`lap` adds the working time since the last one to ``seconds`` of a stage."""

    def __init__(self, seconds: Mapping[str, float] | None = None) -> None:
        self.seconds = dict(seconds or {})
        self._last = working_s()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to ``stage``."""
        now = working_s()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
