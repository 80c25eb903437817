"""How long after its exposure a frame's estimate is there, though a device's clock is not the computer's."""

from __future__ import annotations

from array import array

import numpy as np

from vioframe.types import NS_PER_S

# A crystal strays by some 50 us in one second: the clocks are compared anew so often.
_SPAN_NS = 5 * NS_PER_S


class HostClock:
    """The computer's clock by a device's stamps: whatever comes in came at least as late as the quickest of late.

    What even the quickest takes on its way is not seen, some milliseconds over USB.
    """

    def __init__(self) -> None:
        self._begin_ns: int | None = None
        self._quickest_ns: int | None = None
        self._before_ns: int | None = None

    def heard(self, t_ns: int, now_ns: int) -> None:
        """That of ``t_ns`` of the device came in at ``now_ns`` of the computer."""
        late_ns = now_ns - t_ns
        if self._begin_ns is None or not 0 <= now_ns - self._begin_ns < _SPAN_NS:
            self._begin_ns, self._before_ns, self._quickest_ns = now_ns, self._quickest_ns, late_ns
        assert self._quickest_ns is not None
        self._quickest_ns = min(self._quickest_ns, late_ns)

    def since_s(self, t_ns: int, now_ns: int) -> float:
        """Seconds from ``t_ns`` of the device to ``now_ns`` of the computer."""
        quickest_ns = min(late for late in (self._quickest_ns, self._before_ns) if late is not None)
        return (now_ns - t_ns - quickest_ns) / NS_PER_S


class Latencies:
    """Of all frames with an estimate by now, s."""

    def __init__(self) -> None:
        self._seconds = array("d")

    def add(self, seconds: float) -> None:
        self._seconds.append(seconds)

    @property
    def last_s(self) -> float | None:
        return self._seconds[-1] if self._seconds else None

    def figures_ms(self) -> dict[str, float] | None:
        """Median, 99 % quantile and the longest, ms; None before the first estimate."""
        if not self._seconds:
            return None
        seconds = np.array(self._seconds)
        names = ("median", "p99", "longest")
        return dict(zip(names, (1e3 * np.quantile(seconds, [0.5, 0.99, 1.0])).tolist(), strict=True))
