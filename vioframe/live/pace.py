"""Recordings at the pace at which they happened."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from threading import Event
from time import monotonic

from vioframe.types import NS_PER_S, Measurement, Unreadable


def paced(
    measurements: Iterable[Measurement], closed: Event | None = None, *, speed: float = 1.0
) -> Iterator[Measurement]:
    """Each when it is due by its stamp, the first at once, ``speed`` times as fast as it was; until ``closed``."""
    closed = Event() if closed is None else closed
    first_ns: int | None = None
    begin_s = monotonic()
    for measurement in measurements:
        if not isinstance(measurement, Unreadable):
            if first_ns is None:
                first_ns, begin_s = measurement.t_ns, monotonic()
            due_s = begin_s + (measurement.t_ns - first_ns) / NS_PER_S / speed
            closed.wait(max(due_s - monotonic(), 0.0))
        if closed.is_set():
            return
        yield measurement
