"""A live source as a data set: the same odometry flies it, fed by what comes in while it works."""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Iterator
from threading import Event, Thread
from time import monotonic_ns
from typing import Any

from vioframe.errors import SourceError
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Source
from vioframe.live.ahead import Ahead
from vioframe.live.inbox import Inbox
from vioframe.live.latency import HostClock, Latencies
from vioframe.types import NS_PER_S, Calibration, FrameSet, ImuSample, Measurement, NavState, Step, Unreadable

_log = logging.getLogger("vioframe.live")

# While one frame is estimated from another one waits; more would only make the estimate older.
_MOST_WAITING_FRAMES = 2
# How long a device that is gone is looked for again, s, and how often.
_LOOKED_FOR_S, _LOOK_EVERY_S = 60.0, 0.5
# A source that was closed ends within this, s.
_ENDS_WITHIN_S = 5.0


class Live:
    """Takes what ``source`` brings, in a thread of its own, so that no reading is lost while a frame is estimated from.

    Frames that come faster than they are used give way to newer ones and are counted as ``frame_dropped``. A source
    that is gone (:class:`SourceError`) is looked for again for a minute, counted as ``source_lost``. :meth:`stop` ends
    it.
    """

    def __init__(self, source: Source, ahead: Ahead) -> None:
        self._source = source
        self._inbox = Inbox(_MOST_WAITING_FRAMES)
        self._offset_ns = source.calibration.cameras[0].time_offset_ns
        self._clock, self._latencies = HostClock(), Latencies()
        self._ahead, self._predicted = ahead, deque[NavState]()
        self._stopped = Event()
        self._readings = self._frames = self._lost = 0
        self._last_ns: int | None = None

    @property
    def name(self) -> str:
        return self._source.name

    @property
    def calibration(self) -> Calibration:
        return self._source.calibration

    @property
    def frame_count(self) -> int | None:
        return self._source.frame_count

    @property
    def ground_truth(self) -> Trajectory | None:
        return self._source.ground_truth

    def measurements(self) -> Iterator[Measurement]:
        """What comes in from now on, until the source ends or :meth:`stop`."""
        reader = Thread(target=self._read, name="source", daemon=True)
        reader.start()
        try:
            yield from self._inbox
        finally:
            self.stop()
            reader.join(_ENDS_WITHIN_S)

    def stop(self) -> None:
        """End it: what has come by now is still used."""
        self._stopped.set()
        self._inbox.end()
        self._source.close()

    def estimated(self, step: Step) -> list[NavState]:
        """Take note of a frame's estimate; the states at the rate of the IMU since the one before."""
        # While a start is sought there is none, and the last frame waits for readings until the end.
        if step.estimate.state is not None and not self._stopped.is_set():
            self._latencies.add(self._clock.since_s(step.frames.t_ns, monotonic_ns()))
        calibration = step.estimate.calibration
        if calibration is not None:
            self._offset_ns = calibration.calibration.cameras[0].time_offset_ns
        self._ahead.corrected(step.estimate.state, self._offset_ns)
        return [self._predicted.popleft() for _ in range(len(self._predicted))]

    @property
    def latency_ms(self) -> float | None:
        """From the exposure of the last frame that has an estimate to that; None before the first."""
        return None if self._latencies.last_s is None else 1e3 * self._latencies.last_s

    @property
    def dropped(self) -> int:
        """Frames that gave way to newer ones."""
        return self._inbox.dropped

    def figures(self) -> dict[str, Any]:
        """How it went, for the summary of a run."""
        return {
            "readings": self._readings,
            "frames": self._frames,
            "frames_dropped": self.dropped,
            "source_lost": self._lost,
            "latency_ms": self._latencies.figures_ms(),
        }

    def _read(self) -> None:
        """The thread: from the source into the inbox, until there is nothing more to come."""
        lost_ns: int | None = None
        try:
            while not self._stopped.is_set():
                try:
                    for measurement in self._source.measurements():
                        lost_ns = None
                        self._take(measurement)
                    break
                except SourceError as error:
                    if self._last_ns is None:  # it never was there
                        raise
                    if lost_ns is None:
                        lost_ns = monotonic_ns()
                        self._lost += 1
                        self._inbox.put(Unreadable(self._last_ns, "source_lost", str(error)))
                        _log.warning("%s; it is looked for again for %.0f s", error, _LOOKED_FOR_S)
                    if monotonic_ns() - lost_ns > _LOOKED_FOR_S * NS_PER_S:
                        raise
                    self._stopped.wait(_LOOK_EVERY_S)
        except BaseException as error:
            self._inbox.end(error)
        self._inbox.end()

    def _take(self, measurement: Measurement) -> None:
        now_ns = monotonic_ns()
        if isinstance(measurement, ImuSample):
            self._readings += 1
            self._clock.heard(measurement.t_ns - self._offset_ns, now_ns)
            if (state := self._ahead.read(measurement)) is not None:
                self._predicted.append(state)
                self._source.tell(state)
        elif isinstance(measurement, FrameSet):
            self._frames += 1
            self._clock.heard(measurement.t_ns, now_ns)
        self._last_ns = measurement.t_ns
        self._inbox.put(measurement)
