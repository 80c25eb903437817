"""Seconds by stage, for the timing columns of a run."""

from time import perf_counter


class Stopwatch:
    """Started when made; each :meth:`lap` books the time since the last one under a stage's name."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to ``stage``."""
        now = perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now
