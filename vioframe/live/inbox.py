"""What waits for the estimator: every reading, and the newest images."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from threading import Condition

from vioframe.types import FrameSet, Measurement, Unreadable

# A waiting consumer looks up so often, s, for the sake of signals.
_LOOK_UP_S = 0.1


class Inbox:
    """Measurements from one thread for another, in order; of frames at most ``most_frames`` wait.

    When one more comes the oldest gives way: a note that it was dropped (``frame_dropped``) takes its place. Readings
    are never dropped; they are few bytes, and an estimate without them is worth nothing.
    """

    def __init__(self, most_frames: int) -> None:
        self._most_frames = most_frames
        self._waiting: deque[Measurement] = deque()
        self._frames = 0
        self._changed = Condition()
        self._ended = False
        self._error: BaseException | None = None
        self.dropped = 0
        """How many frames gave way."""

    def put(self, measurement: Measurement) -> None:
        with self._changed:
            if self._ended:
                return
            if isinstance(measurement, FrameSet):
                if self._frames == self._most_frames:
                    self._drop_oldest()
                self._frames += 1
            self._waiting.append(measurement)
            self._changed.notify()

    def end(self, error: BaseException | None = None) -> None:
        """Nothing more comes: the consumer gets what waits, and then ``error``."""
        with self._changed:
            if not self._ended:
                self._ended, self._error = True, error
                self._changed.notify()

    def __iter__(self) -> Iterator[Measurement]:
        while True:
            with self._changed:
                while not self._waiting:
                    if self._error is not None:
                        raise self._error
                    if self._ended:
                        return
                    self._changed.wait(_LOOK_UP_S)
                measurement = self._waiting.popleft()
                self._frames -= isinstance(measurement, FrameSet)
            yield measurement

    def _drop_oldest(self) -> None:
        place, frame = next((i, m) for i, m in enumerate(self._waiting) if isinstance(m, FrameSet))
        self._waiting[place] = Unreadable(frame.t_ns, "frame_dropped", "dropped: the estimator could not keep up")
        self._frames -= 1
        self.dropped += 1
