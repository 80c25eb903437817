"""Where the body is by now: the newest estimate, led on by the readings since, with its covariance."""

from __future__ import annotations

from collections import deque

import numpy as np

from vioframe.estimation.inertial.preintegration import preintegrate
from vioframe.types import NS_PER_S, Float, ImuNoise, ImuSample, ImuSegment, NavState

# Led on by readings alone for longer than this, s, a state says little, and readings are not kept for it.
_LONGEST_S = 1.0


class Ahead:
    """A state for every reading, ``rate_hz`` at most; the two methods may be called by two threads.

    Readings carry stamps of the IMU's clock, states those of the camera's: ``t_cam = t_imu - offset_ns``.
    """

    def __init__(self, noise: ImuNoise, rate_hz: float = 200.0) -> None:
        self._noise = noise
        # Readings come a little early and late.
        self._period_ns = round(0.75 * NS_PER_S / rate_hz)
        self._readings: deque[ImuSample] = deque()
        self._estimate: tuple[NavState | None, int] = None, 0
        self._from: NavState | None = None
        self._newest: NavState | None = None
        self._last_ns = 0

    def corrected(self, state: NavState | None, offset_ns: int) -> None:
        """Go on from an estimate, or from nothing while there is none."""
        self._estimate = state, offset_ns  # in one: the other thread reads both

    def read(self, sample: ImuSample) -> NavState | None:
        """Where the body is at this reading; None where none is due, or where no estimate is young enough."""
        estimate, offset_ns = self._estimate
        readings = self._readings
        if readings and sample.t_ns <= readings[-1].t_ns:
            return None
        readings.append(sample)
        kept_from_ns = sample.t_ns - _LONGEST_S * NS_PER_S
        while readings[0].t_ns < kept_from_ns:
            readings.popleft()
        if estimate is not self._from:
            self._from = self._newest = estimate
        if self._newest is None or estimate is None or estimate.t_ns + offset_ns < kept_from_ns:
            return None
        t_ns = sample.t_ns - offset_ns
        if t_ns - self._last_ns < self._period_ns or (since := self._since(self._newest.t_ns, offset_ns)) is None:
            return None
        self._newest = preintegrate(since, self._newest.bias_gyro_B, self._newest.bias_accel_B, self._noise).predict(
            self._newest
        )
        self._last_ns = t_ns
        return self._newest

    def _since(self, t_ns: int, offset_ns: int) -> ImuSegment | None:
        """The readings from ``t_ns`` on, the first interpolated; None where they do not reach back to it."""
        stamps = np.array([reading.t_ns for reading in self._readings], np.int64) - offset_ns
        first = int(np.searchsorted(stamps, t_ns, side="right"))
        if first == len(stamps) or (first == 0 and stamps[0] > t_ns):
            return None
        part = (t_ns - stamps[first - 1]) / (stamps[first] - stamps[first - 1])
        around = [self._readings[first - 1], *(self._readings[i] for i in range(first, len(stamps)))]

        def cut(values: list[Float]) -> Float:
            return np.array([values[0] + part * (values[1] - values[0]), *values[1:]])

        gyro, accel = cut([r.gyro_B for r in around]), cut([r.accel_B for r in around])
        return ImuSegment(np.array([t_ns, *stamps[first:]], np.int64), gyro, accel)
