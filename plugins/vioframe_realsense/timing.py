"""Streams with stamps of their own made one: one clock, readings of gyroscope and accelerometer in one, images in sets.

Nothing here knows of librealsense.
"""

from __future__ import annotations

from collections import deque

from vioframe.errors import DatasetError
from vioframe.types import Float, FrameSet, Image, ImuSample

HARDWARE_CLOCK = "hardware_clock"
"""librealsense's name for stamps by the device's own clock."""

_NS_PER_MS = 1_000_000
# The device counts microseconds with 32 bits: after 71.6 minutes it begins anew.
_WRAP_NS = (1 << 32) * 1000
# An image whose metadata got lost is stamped by another clock, now and then; if so many in a row are, all will be.
_MOST_STRAY = 10
# The accelerometer's readings are kept so long for those of the gyroscope, ns, which may come late.
_KEPT_NS = 1_000_000_000
# Images that are triggered together are stamped alike, within this, ns.
_TOGETHER_NS = 1_000_000
# How long an image waits for its partner, in periods.
_PATIENCE = 1.25


class Clock:
    """Stamps of all streams of one device as nanoseconds of one clock, that goes on where the device's begins anew."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._domain: str | None = None
        # Of readings and of images, how many in a row.
        self._stray = {True: 0, False: 0}
        # Added to the device's time since it was started last; None while nothing has come.
        self._shift_ns: int | None = None
        # A stamp, and when it came by the computer's clock.
        self._last: tuple[int, int] | None = None

    def begin(self) -> None:
        """The device is started, perhaps not for the first time: without power its clock has lost the time."""
        self._domain, self._shift_ns = None, None
        self._stray = {True: 0, False: 0}

    def t_ns(self, t_ms: float, domain: str, now_ns: int, *, of_reading: bool) -> int | None:
        """The stamp of what came at ``now_ns`` of the computer, with ``t_ms`` in a ``domain`` of librealsense's.

        The domain is that of the first reading; None for what has another, or comes ahead of that. Raises
        :class:`DatasetError` where readings and images go on having different ones.
        """
        if self._domain is None:
            if not of_reading:
                return None
            self._domain = domain
        if domain != self._domain:
            self._stray[of_reading] += 1
            if self._stray[of_reading] > _MOST_STRAY:
                raise DatasetError(
                    f"{self._device} stamps images and readings by different clocks ({self._domain}, {domain}), as "
                    "Linux keeps the metadata to itself; install librealsense's kernel modules (librealsense2-dkms), "
                    "or a pyrealsense2 that is built with FORCE_RSUSB_BACKEND"
                )
            return None
        self._stray[of_reading] = 0
        t_ns = round(t_ms * _NS_PER_MS)
        if domain == HARDWARE_CLOCK:
            t_ns = self._going_on(t_ns, now_ns)
        self._last = t_ns, now_ns
        return t_ns

    def _going_on(self, t_ns: int, now_ns: int) -> int:
        if self._shift_ns is None:
            self._shift_ns = 0 if self._last is None else self._last[0] + now_ns - self._last[1] - t_ns
        t_ns += self._shift_ns
        if self._last is not None:
            t_ns += (self._last[0] - t_ns + _WRAP_NS // 2) // _WRAP_NS * _WRAP_NS
        return t_ns


class Readings:
    """Pairs each reading of the gyroscope with what the accelerometer reads at its stamp, by linear interpolation.

    A reading waits until the accelerometer has one at or behind it. Those ahead of its first are left out.
    """

    def __init__(self) -> None:
        self._gyro: deque[tuple[int, Float]] = deque()
        self._accel: deque[tuple[int, Float]] = deque()

    def gyro(self, t_ns: int, gyro_B: Float) -> list[ImuSample]:
        """Take ``gyro_B`` (3,) rad/s; what is complete by it."""
        self._gyro.append((t_ns, gyro_B))
        return self._complete()

    def accel(self, t_ns: int, accel_B: Float) -> list[ImuSample]:
        """Take ``accel_B`` (3,) m/s^2; what is complete by it."""
        if not self._accel or t_ns > self._accel[-1][0]:
            self._accel.append((t_ns, accel_B))
        return self._complete()

    def _complete(self) -> list[ImuSample]:
        complete = []
        while self._gyro and self._accel and self._gyro[0][0] <= self._accel[-1][0]:
            t_ns, gyro_B = self._gyro.popleft()
            if t_ns >= self._accel[0][0]:
                complete.append(ImuSample(t_ns, gyro_B, self._accel_at(t_ns)))
            while len(self._accel) > 1 and self._accel[1][0] < t_ns - _KEPT_NS:
                self._accel.popleft()
        return complete

    def _accel_at(self, t_ns: int) -> Float:
        """(3,) between the readings around ``t_ns``, which are among the newest."""
        after_ns, after = self._accel[-1]
        for before_ns, before in reversed(self._accel):
            if before_ns <= t_ns:
                break
            after_ns, after = before_ns, before
        if before_ns == after_ns:
            return after
        return before + (t_ns - before_ns) / (after_ns - before_ns) * (after - before)


class Pairs:
    """Gathers the images of ``cameras``, each in the order of its stamps, in the sets that they were triggered in.

    ``period_ns`` is the time from one set to the next. An image whose partners do not come within it goes without.
    """

    def __init__(self, cameras: int, period_ns: int) -> None:
        self._cameras = cameras
        self._patience_ns = round(_PATIENCE * period_ns)
        self._waiting: list[FrameSet] = []

    def add(self, place: int, t_ns: int, image: Image) -> list[FrameSet]:
        """Take the image of the camera at ``place`` in the rig; the sets that go by it."""
        waiting = self._waiting
        waiting.append(FrameSet(t_ns, tuple(image if i == place else None for i in range(self._cameras))))
        for i, other in enumerate(waiting[:-1]):
            if abs(other.t_ns - t_ns) <= _TOGETHER_NS and other.images[place] is None:
                images = tuple(image if at == place else there for at, there in enumerate(other.images))
                waiting[i] = FrameSet(other.t_ns, images)
                waiting.pop()
                break
        # What is older than a complete set stays incomplete: each camera keeps to its order.
        done = [_complete(frames) or frames.t_ns < t_ns - self._patience_ns for frames in waiting]
        count = max((i + 1 for i, go in enumerate(done) if go), default=0)
        ready = waiting[:count]
        del waiting[:count]
        return ready


def _complete(frames: FrameSet) -> bool:
    return all(image is not None for image in frames.images)
