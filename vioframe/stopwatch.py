"""Seconds by stage, for the timing columns of a run."""

from time import perf_counter

from vioframe.jit import waited_s


def working_s() -> float:
    """A clock of this thread, s, that stands still while a kernel is compiled or loaded: that happens once."""
    return perf_counter() - waited_s()


class Stopwatch:
    """Started when made; each :meth:`lap` books the working time since the last one under a stage's name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = working_s()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to ``stage``."""
        now = working_s()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
