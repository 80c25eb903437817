"""Measurements -> packets: every frame with all inertial readings since the frame before it.

The stream may come in the order in which it was recorded, with samples repeated, late, missing or not finite. What
comes out is clean: strictly increasing stamps of the camera's clock, and segments that begin and end on frame stamps.
Everything that was dropped or repaired is counted.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from math import hypot, inf, isfinite, nan
from statistics import median
from typing import Generic, TypeVar

import numpy as np

from vioframe.errors import ConfigError
from vioframe.incidents import Incidents
from vioframe.types import GRAVITY_M_S2, NS_PER_S, FrameSet, ImuSample, ImuSegment, Measurement

Packet = tuple[ImuSegment, FrameSet]
T = TypeVar("T")

NS_PER_MS = 1_000_000
# Frames waiting for an IMU that has fallen silent; bounds the memory that they take.
_MAX_WAITING_FRAMES = 200
# Beyond the range of any IMU that flies or is worn (4000 deg/s, 200 g): a fault of the sensor or of its bus.
_MAX_RATE_RAD_S, _MAX_FORCE_M_S2 = 100.0, 2000.0
# What repeats to the last bit for so long, and so often, is no measurement: a reading has noise. Slow sensors are
# sometimes handed on at a higher rate than their own, so it must be longer than the period of one.
_STUCK_NS, _STUCK_READINGS = 20 * NS_PER_MS, 4
# An axis that is stuck beyond these is at the end of its range: ranges begin at 125 deg/s and 2 g. Where all axes are
# stuck the sensor or its bus has died, unless they read what a body at rest would.
_LEAST_RANGE_RAD_S, _LEAST_RANGE_M_S2 = 2.0, 19.0
_REST_RAD_S, _REST_M_S2 = 0.1, 0.5
_IMU_GAP_PERIODS = 5.0
_CAMERA_GAP_PERIODS = 2.5
_PERIOD_SAMPLES = 51
_READINGS_BEHIND_THE_END = 20
# Readings kept while no frame waits for them: the next may be late by as much.
_MOST_IDLE_READINGS = 4000
# Readings that were used and may be asked for again under another time offset.
_READINGS_KEPT = 1000


class Synchroniser:
    """Takes measurements one by one; gives each frame with the inertial readings since the previous one.

    IMU stamps move to the camera's clock (``t_cam = t_imu - time_offset_ns``). Both ends of a segment are interpolated
    linearly onto the frame stamps; the first packet's segment is a single reading.

    A frame waits until readings from ``wait_ms`` behind it are there: so much later may a reading arrive than one with
    a later stamp, and still find its place. One that leaps ahead of those before it is believed when the next has come,
    so that a single wild stamp does no harm. With 0 the first reading at or behind the frame lets it go: the least
    latency, for a stream in order.

    ``incidents`` counts ``imu_nan``, ``imu_out_of_range``, ``imu_saturated``, ``imu_frozen``, ``imu_duplicate``,
    ``imu_out_of_order``, ``imu_gap``, ``frame_duplicate``, ``frame_out_of_order``, ``frame_before_imu``,
    ``frame_after_imu``, ``frame_without_imu`` and ``camera_gap``.
    """

    def __init__(self, incidents: Incidents, *, time_offset_ns: int = 0, wait_ms: float = 50.0) -> None:
        if not wait_ms >= 0.0:
            raise ConfigError(f"wait_ms must be zero or more, got {wait_ms!r}")
        self._imu = _ImuBuffer(time_offset_ns, incidents)
        self._frames: _Ordered[FrameSet] = _Ordered("frame", incidents)
        self._last_packet_ns: int | None = None
        self._periods_ns: deque[int] = deque(maxlen=_PERIOD_SAMPLES)
        self._incidents = incidents
        self._wait_ns = round(wait_ms * NS_PER_MS)

    def retime(self, time_offset_ns: int) -> None:
        """Count with another time offset from the next packet on.

        Its segment holds all readings that those before do not reach to: it begins at the frame before, or earlier.
        """
        self._imu.retime(time_offset_ns, self._last_packet_ns)

    def add(self, measurement: Measurement) -> Iterator[Packet]:
        """Take one measurement; the packets that are complete by it."""
        imu, frames = self._imu, self._frames
        if isinstance(measurement, ImuSample):
            imu.add(measurement)
            if not frames.items:
                imu.forget()
        elif isinstance(measurement, FrameSet):
            frames.put(measurement.t_ns, measurement, frames.last_used_ns)
        else:
            self._incidents.add(measurement.kind, measurement.t_ns, measurement.detail)
        while frames.t_ns and self._is_covered(frames.t_ns[0]):
            yield from self._release()
        if len(frames.t_ns) > _MAX_WAITING_FRAMES:
            (dropped_ns,), _ = frames.take(1)
            self._incidents.add("frame_without_imu", dropped_ns, "dropped: the IMU has fallen silent")

    def finish(self) -> Iterator[Packet]:
        """The packets of the frames that still wait, as far as readings reach: nothing more will come."""
        while self._frames.t_ns and self._imu.reaches(self._frames.t_ns[0]):
            yield from self._release()
        for t_ns in self._frames.t_ns:
            self._incidents.add("frame_after_imu", t_ns, "dropped: no IMU sample at or after it")
        self._frames.take(len(self._frames.t_ns))

    def _is_covered(self, t_ns: int) -> bool:
        """Whether the readings reach far enough behind the frame at ``t_ns``."""
        if self._wait_ns == 0 or len(self._frames.t_ns) > _MAX_WAITING_FRAMES:
            return self._imu.reaches(t_ns)
        return self._imu.reaches(t_ns + self._wait_ns, surely=True)

    def _release(self) -> Iterator[Packet]:
        (t_ns,), (frame,) = self._frames.take(1)
        if self._imu.covers(t_ns):
            self._watch_gap(t_ns)
            yield self._imu.segment_until(t_ns), frame
        else:
            self._incidents.add("frame_before_imu", t_ns, "dropped: no IMU sample at or before it")

    def _watch_gap(self, t_ns: int) -> None:
        """Count a gap before the frame at ``t_ns`` if it is long against the usual period."""
        if self._last_packet_ns is not None:
            period_ns = t_ns - self._last_packet_ns
            if self._periods_ns and period_ns > _CAMERA_GAP_PERIODS * median(self._periods_ns):
                self._incidents.add("camera_gap", t_ns, f"{period_ns / NS_PER_S:.3f} s without a frame before this one")
            self._periods_ns.append(period_ns)
        self._last_packet_ns = t_ns


def synchronise(
    measurements: Iterable[Measurement],
    incidents: Incidents,
    *,
    time_offset_ns: int = 0,
    start_s: float = 0.0,
    duration_s: float | None = None,
) -> Iterator[Packet]:
    """The packets of a recording, or of the part of it that :func:`played` lets through."""
    synchroniser = Synchroniser(incidents, time_offset_ns=time_offset_ns)
    for measurement in played(measurements, start_s, duration_s):
        yield from synchroniser.add(measurement)
    yield from synchroniser.finish()


def played(
    measurements: Iterable[Measurement], start_s: float = 0.0, duration_s: float | None = None
) -> Iterator[Measurement]:
    """A recording without the frames of its first ``start_s`` seconds, nor those ``duration_s`` and more after that.

    Time counts from the first frame. The readings stay, up to some behind the last frame.
    """
    if start_s == 0.0 and duration_s is None:
        yield from measurements
        return
    begin_ns: int | None = None
    end_ns = inf
    behind = 0
    for measurement in measurements:
        if isinstance(measurement, FrameSet):
            if begin_ns is None:
                begin_ns = measurement.t_ns + round(start_s * NS_PER_S)
                end_ns = inf if duration_s is None else begin_ns + round(duration_s * NS_PER_S)
            if begin_ns <= measurement.t_ns <= end_ns:
                yield measurement
            continue
        yield measurement
        # One wild stamp is no reason to stop.
        behind = behind + 1 if measurement.t_ns > end_ns + NS_PER_S else 0
        if behind > _READINGS_BEHIND_THE_END:
            return


class _Ordered(Generic[T]):
    """What has come of one sensor, called ``kind`` in incidents, and was not used up yet: ordered by time."""

    def __init__(self, kind: str, incidents: Incidents) -> None:
        self.t_ns: list[int] = []
        self.items: list[T] = []
        self.last_used_ns: int | None = None
        self._kind, self._incidents = kind, incidents
        self._previous_arrival_ns: int | None = None

    def put(self, t_ns: int, item: T, end_ns: int | None) -> None:
        """Sort ``item`` in, unless its stamp came before or lies in what was processed, up to ``end_ns``."""
        previous_ns, self._previous_arrival_ns = self._previous_arrival_ns, t_ns
        place = bisect_left(self.t_ns, t_ns)
        if t_ns == self.last_used_ns or t_ns in self.t_ns[place : place + 1]:
            self._incidents.add(f"{self._kind}_duplicate", t_ns, "dropped: one with this stamp came before")
            return
        if end_ns is not None and t_ns <= end_ns:
            self._incidents.add(f"{self._kind}_out_of_order", t_ns, "dropped: a later frame was already processed")
            return
        if previous_ns is not None and t_ns < previous_ns:
            self._incidents.add(f"{self._kind}_out_of_order", t_ns, "sorted into place")
        self.t_ns.insert(place, t_ns)
        self.items.insert(place, item)

    def drop(self, begin_ns: int, end_ns: int) -> int:
        """Leave out what lies from ``begin_ns`` to ``end_ns``; how many they were."""
        places = slice(bisect_left(self.t_ns, begin_ns), bisect_right(self.t_ns, end_ns))
        count = len(self.t_ns[places])
        del self.t_ns[places], self.items[places]
        return count

    def take(self, count: int) -> tuple[list[int], list[T]]:
        """The ``count`` oldest, with their stamps, which are used up by that."""
        t_ns, items = self.t_ns[:count], self.items[:count]
        del self.t_ns[:count], self.items[:count]
        if t_ns:
            self.last_used_ns = t_ns[-1]
        return t_ns, items


class _Axes:
    """Watches each of the six axes of an IMU for readings that repeat to the last bit."""

    def __init__(self) -> None:
        self._last = [nan] * 6
        # Of each axis: when the value that it has now was read first, and how often it was since.
        self._since_ns, self._count = [0] * 6, [0] * 6

    def add(self, t_ns: int, gyro_B: list[float], accel_B: list[float]) -> tuple[str, int] | None:
        """Take in a reading; where the sensor is stuck the kind of incident, and since when."""
        values = [*gyro_B, *accel_B]
        if values != self._last:
            for axis, (value, last) in enumerate(zip(values, self._last, strict=True)):
                if value != last:
                    self._since_ns[axis], self._count[axis] = t_ns, 0
            self._last = values
        self._count = [count + 1 for count in self._count]
        if max(self._count) < _STUCK_READINGS:
            return None
        stuck = [
            axis
            for axis, (since_ns, count) in enumerate(zip(self._since_ns, self._count, strict=True))
            if count >= _STUCK_READINGS and t_ns - since_ns >= _STUCK_NS
        ]
        ends = [axis for axis in stuck if abs(values[axis]) > (_LEAST_RANGE_RAD_S if axis < 3 else _LEAST_RANGE_M_S2)]
        if ends:
            return "imu_saturated", min(self._since_ns[axis] for axis in ends)
        moves = max(map(abs, gyro_B)) > _REST_RAD_S or abs(hypot(*accel_B) - GRAVITY_M_S2) > _REST_M_S2
        if len(stuck) == 6 and moves:
            return "imu_frozen", max(self._since_ns)
        return None


class _ImuBuffer(_Ordered[ImuSample]):
    """IMU samples on the camera's clock that no segment has used yet."""

    def __init__(self, time_offset_ns: int, incidents: Incidents) -> None:
        super().__init__("imu", incidents)
        self._offset_ns = time_offset_ns
        # Where the last segment ended: its stamp with the reading there.
        self._end: ImuSample | None = None
        self._gap_limit_ns: float | None = None
        self._last_gap_ns: int | None = None
        self._used: deque[tuple[int, ImuSample]] = deque(maxlen=_READINGS_KEPT)
        self._axes = _Axes()

    def retime(self, offset_ns: int, frame_ns: int | None) -> None:
        """Move all stamps to the new offset; readings after the last frame's new time are there once more."""
        moved_ns = self._offset_ns - offset_ns
        if not moved_ns:
            return
        self._offset_ns = offset_ns
        self.t_ns = [t_ns + moved_ns for t_ns in self.t_ns]
        self._used = deque(((t_ns + moved_ns, sample) for t_ns, sample in self._used), maxlen=_READINGS_KEPT)
        self.last_used_ns = None if self.last_used_ns is None else self.last_used_ns + moved_ns
        self._previous_arrival_ns = None
        self._last_gap_ns = None
        if self._end is None or frame_ns is None:
            return
        self._end = replace(self._end, t_ns=self._end.t_ns + moved_ns)
        if self._end.t_ns > frame_ns:
            while self._used and self._used[-1][0] > frame_ns:
                t_ns, sample = self._used.pop()
                self.t_ns.insert(0, t_ns)
                self.items.insert(0, sample)
            times, samples = zip(*self._used, strict=True) if self._used else ((), ())
            self._end = self._reading_at(frame_ns, list(times), list(samples))
            self.last_used_ns = times[-1] if times else None

    def add(self, sample: ImuSample) -> None:
        t_ns = sample.t_ns - self._offset_ns
        gyro, accel = sample.gyro_B.tolist(), sample.accel_B.tolist()
        if not all(map(isfinite, (*gyro, *accel))):
            self._incidents.add("imu_nan", t_ns, "dropped: a reading is not finite")
        elif max(map(abs, gyro)) > _MAX_RATE_RAD_S or max(map(abs, accel)) > _MAX_FORCE_M_S2:
            self._incidents.add("imu_out_of_range", t_ns, "dropped: no IMU can measure such a reading")
        elif (stuck := self._axes.add(t_ns, gyro, accel)) is not None:
            kind, since_ns = stuck
            for _ in range(1 + self.drop(since_ns, t_ns)):
                self._incidents.add(kind, t_ns, "dropped: it reads the same to the last bit for 20 ms and more")
        else:
            self.put(t_ns, sample, None if self._end is None else self._end.t_ns)

    def forget(self) -> None:
        """Let go of the oldest readings where there are more than any frame may still ask for."""
        if len(self.t_ns) > 2 * _MOST_IDLE_READINGS:
            del self.t_ns[:_MOST_IDLE_READINGS], self.items[:_MOST_IDLE_READINGS]

    def reaches(self, t_ns: int, *, surely: bool = False) -> bool:
        """Whether samples are at or after ``t_ns``: many where all are far from it, as wild stamps are.

        ``surely``, two, or one that came in step with those before it.
        """
        first = bisect_left(self.t_ns, t_ns)
        behind = len(self.t_ns) - first
        if behind and self.t_ns[first] - t_ns >= NS_PER_S:
            return behind >= _READINGS_BEHIND_THE_END
        return behind > 1 or (behind == 1 and (not surely or self._is_in_step(first)))

    def _is_in_step(self, place: int) -> bool:
        """Whether the sample at ``place`` follows the one before it without a gap."""
        before_ns = self.t_ns[place - 1] if place else self.last_used_ns
        if before_ns is None or self._gap_limit_ns is None:
            return False
        return self.t_ns[place] - before_ns <= self._gap_limit_ns

    def covers(self, t_ns: int) -> bool:
        """Whether a reading at ``t_ns`` can be interpolated, given that there is a sample at or after it."""
        return self._end is not None or self.t_ns[0] <= t_ns

    def segment_until(self, t_ns: int) -> ImuSegment:
        """The readings from the end of the last segment to ``t_ns``; the samples up to there are used up."""
        last_used_ns, usual = self.last_used_ns, self.t_ns[:_PERIOD_SAMPLES]
        times, samples = self.take(bisect_right(self.t_ns, t_ns))
        self._used.extend(zip(times, samples, strict=True))
        recorded = times[-1:] if last_used_ns is None else [last_used_ns, *times]
        if recorded[-1] < t_ns:
            recorded = [*recorded, self.t_ns[0]]
        gap_s = self._largest_gap_s(recorded, usual)
        end = self._reading_at(t_ns, times, samples)
        if self._end is None:
            times, samples = [t_ns], [end]
        else:
            if times and times[-1] == t_ns:
                times.pop()
                samples.pop()
            times = [self._end.t_ns, *times, t_ns]
            samples = [self._end, *samples, end]
        self._end = end
        return ImuSegment(
            np.array(times, dtype=np.int64),
            np.array([sample.gyro_B for sample in samples], dtype=np.float64),
            np.array([sample.accel_B for sample in samples], dtype=np.float64),
            gap_s,
        )

    def _reading_at(self, t_ns: int, times: list[int], samples: list[ImuSample]) -> ImuSample:
        """Linear between the last of the readings up to ``t_ns`` and the first one after it."""
        if times:
            t_0, sample_0 = times[-1], samples[-1]
        else:
            assert self._end is not None  # covers() was true
            t_0, sample_0 = self._end.t_ns, self._end
        if t_0 == t_ns:
            return ImuSample(t_ns, sample_0.gyro_B, sample_0.accel_B)
        t_1, sample_1 = self.t_ns[0], self.items[0]
        fraction = (t_ns - t_0) / (t_1 - t_0)
        return ImuSample(
            t_ns,
            sample_0.gyro_B + fraction * (sample_1.gyro_B - sample_0.gyro_B),
            sample_0.accel_B + fraction * (sample_1.accel_B - sample_0.accel_B),
        )

    def _largest_gap_s(self, recorded: list[int], usual: list[int]) -> float:
        """Longest stretch between ``recorded`` stamps; those far beyond the usual period are counted, each once.

        The ``usual`` period is taken from the stamps that are there when the first segment is cut.
        """
        if self._gap_limit_ns is None:
            periods = [after - before for before, after in pairwise(usual)]
            self._gap_limit_ns = _IMU_GAP_PERIODS * median(periods) if periods else inf
        longest_ns = 0
        for before_ns, after_ns in pairwise(recorded):
            gap_ns = after_ns - before_ns
            longest_ns = max(longest_ns, gap_ns)
            # A long gap reaches over several segments.
            if gap_ns > self._gap_limit_ns and before_ns != self._last_gap_ns:
                self._last_gap_ns = before_ns
                self._incidents.add("imu_gap", before_ns, f"{gap_ns / NS_PER_S:.3f} s without an IMU sample")
        return longest_ns / NS_PER_S
