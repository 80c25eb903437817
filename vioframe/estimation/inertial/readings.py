"""The readings of the last seconds, of which any stretch can be had."""

from __future__ import annotations

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.types import ImuSegment


class Readings:
    """``t_ns`` (N,) ascending, ``gyro_B`` (N, 3) rad/s, ``accel_B`` (N, 3) m/s^2; linear between two."""

    def __init__(self) -> None:
        self.t_ns: Int = np.empty(0, np.int64)
        self.gyro_B: Float = np.empty((0, 3))
        self.accel_B: Float = np.empty((0, 3))

    def add(self, imu: ImuSegment) -> None:
        """Those of ``imu`` that are newer than all so far."""
        new = slice(int(np.searchsorted(imu.t_ns, self.t_ns[-1], side="right")) if len(self.t_ns) else 0, None)
        self.t_ns = np.concatenate([self.t_ns, imu.t_ns[new]])
        self.gyro_B = np.concatenate([self.gyro_B, imu.gyro_B[new]])
        self.accel_B = np.concatenate([self.accel_B, imu.accel_B[new]])

    def forget_before(self, t_ns: int) -> None:
        old = max(int(np.searchsorted(self.t_ns, t_ns)) - 1, 0)
        self.t_ns, self.gyro_B, self.accel_B = self.t_ns[old:], self.gyro_B[old:], self.accel_B[old:]

    def move(self, offset_ns: int) -> None:
        """The time offset has grown by so much: ``t_cam = t_imu - offset``."""
        self.t_ns = self.t_ns - offset_ns

    def cover(self, begin_ns: int, end_ns: int) -> bool:
        return bool(len(self.t_ns)) and bool(self.t_ns[0] <= begin_ns) and bool(end_ns <= self.t_ns[-1])

    def gyro_at(self, t_ns: int) -> Float:
        """(3,) rad/s; beyond the readings that of the nearest."""
        rate_B: Float = self._at(self.gyro_B, min(max(t_ns, int(self.t_ns[0])), int(self.t_ns[-1])))[0]
        return rate_B

    def between(self, begin_ns: int, end_ns: int) -> ImuSegment:
        """The readings from ``begin_ns`` to ``end_ns``, which they must :meth:`cover`: a single one for an instant."""
        if begin_ns == end_ns:
            return ImuSegment(np.array([end_ns]), self._at(self.gyro_B, end_ns), self._at(self.accel_B, end_ns))
        inner = slice(*np.searchsorted(self.t_ns, [begin_ns + 1, end_ns]))
        t_ns = np.concatenate([[begin_ns], self.t_ns[inner], [end_ns]])
        gyro_B = np.concatenate([self._at(self.gyro_B, begin_ns), self.gyro_B[inner], self._at(self.gyro_B, end_ns)])
        accel_B = np.concatenate(
            [self._at(self.accel_B, begin_ns), self.accel_B[inner], self._at(self.accel_B, end_ns)]
        )
        return ImuSegment(t_ns, gyro_B, accel_B, float(np.diff(t_ns).max()) * 1e-9)

    def _at(self, values: Float, t_ns: int) -> Float:
        """(1, 3); the very reading where there is one."""
        k = int(np.searchsorted(self.t_ns, t_ns))
        if self.t_ns[k] == t_ns:
            return values[k : k + 1]
        part = (t_ns - self.t_ns[k - 1]) / (self.t_ns[k] - self.t_ns[k - 1])
        value: Float = values[k - 1 : k] + part * (values[k : k + 1] - values[k - 1 : k])
        return value
