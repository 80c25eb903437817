"""Measurements -> packets: every frame with all inertial readings since the frame before it.

The stream may come in the order in which it was recorded, with samples repeated, late, missing or not finite. What
comes out is clean: strictly increasing stamps of the camera's clock, and segments that begin and end on frame stamps.
Everything that was dropped or repaired is counted.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from itertools import pairwise
from math import inf, isfinite
from statistics import median

import numpy as np

from vioframe.errors import ConfigError
from vioframe.incidents import Incidents
from vioframe.types import NS_PER_S, FrameSet, ImuSample, ImuSegment, Measurement

Packet = tuple[ImuSegment, FrameSet]

NS_PER_MS = 1_000_000
# Frames waiting for an IMU that has fallen silent; bounds the memory that they take.
_MAX_WAITING_FRAMES = 200
# Beyond the range of any IMU that flies or is worn (4000 deg/s, 200 g): a fault of the sensor or of its bus.
_MAX_RATE_RAD_S, _MAX_FORCE_M_S2 = 100.0, 2000.0
_IMU_GAP_PERIODS = 5.0
_CAMERA_GAP_PERIODS = 2.5
_PERIOD_SAMPLES = 51
_READINGS_BEHIND_THE_END = 20
# Readings kept while no frame waits for them: the next may be late by as much.
_MOST_IDLE_READINGS = 4000


class Synchroniser:
    """Takes measurements one by one; gives each frame with the inertial readings since the previous one.

    IMU stamps move to the camera's clock (``t_cam = t_imu - time_offset_ns``). Both ends of a segment are interpolated
    linearly onto the frame stamps; the first packet's segment is a single reading.

    A frame waits until readings from ``wait_ms`` behind it are there: so much later may a reading arrive than one with
    a later stamp, and still find its place. Of those two must have come, so that a single stamp from the far future
    does no harm. With 0 the first reading at or behind the frame lets it go: the least latency, for a stream in order.

    ``incidents`` counts ``imu_nan``, ``imu_out_of_range``, ``imu_duplicate``, ``imu_out_of_order``, ``imu_gap``,
    ``frame_duplicate``, ``frame_out_of_order``, ``frame_before_imu``, ``frame_after_imu``, ``frame_without_imu`` and
    ``camera_gap``.
    """

    def __init__(self, incidents: Incidents, *, time_offset_ns: int = 0, wait_ms: float = 50.0) -> None:
        if not wait_ms >= 0.0:
            raise ConfigError(f"wait_ms must be zero or more, got {wait_ms!r}")
        self._imu = _ImuBuffer(time_offset_ns, incidents)
        self._frames = _FrameBuffer(incidents)
        self._incidents = incidents
        self._wait_ns = round(wait_ms * NS_PER_MS)

    def add(self, measurement: Measurement) -> Iterator[Packet]:
        """Take one measurement; the packets that are complete by it."""
        imu, frames = self._imu, self._frames
        if isinstance(measurement, ImuSample):
            imu.add(measurement)
            if not frames.waiting:
                imu.forget()
        elif isinstance(measurement, FrameSet):
            frames.add(measurement)
        else:
            self._incidents.add(measurement.kind, measurement.t_ns, measurement.detail)
        while frames.waiting and self._is_covered(frames.waiting[0]):
            yield from self._release()
        if frames.full:
            dropped = frames.pop()
            self._incidents.add("frame_without_imu", dropped.t_ns, "dropped: the IMU has fallen silent")

    def finish(self) -> Iterator[Packet]:
        """The packets of the frames that still wait, as far as readings reach: nothing more will come."""
        while self._frames.waiting and self._imu.count_from(self._frames.waiting[0].t_ns):
            yield from self._release()
        for frame in self._frames.waiting:
            self._incidents.add("frame_after_imu", frame.t_ns, "dropped: no IMU sample at or after it")
        self._frames.waiting.clear()

    def _is_covered(self, frame: FrameSet) -> bool:
        """Whether the readings reach far enough behind ``frame``."""
        if self._wait_ns == 0 or self._frames.full:
            return self._imu.count_from(frame.t_ns) >= 1
        return self._imu.count_from(frame.t_ns + self._wait_ns) >= 2

    def _release(self) -> Iterator[Packet]:
        frame = self._frames.pop()
        if self._imu.covers(frame.t_ns):
            self._frames.watch_gap(frame.t_ns)
            yield self._imu.segment_until(frame.t_ns), frame
        else:
            self._incidents.add("frame_before_imu", frame.t_ns, "dropped: no IMU sample at or before it")


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


class _FrameBuffer:
    """Frames that wait for their IMU samples, ordered by time."""

    def __init__(self, incidents: Incidents) -> None:
        self.waiting: list[FrameSet] = []
        self._incidents = incidents
        self._last_released_ns: int | None = None
        self._previous_arrival_ns: int | None = None
        self._last_watched_ns: int | None = None
        self._periods_ns: deque[int] = deque(maxlen=_PERIOD_SAMPLES)

    @property
    def full(self) -> bool:
        return len(self.waiting) > _MAX_WAITING_FRAMES

    def add(self, frame: FrameSet) -> None:
        last_ns = self._last_released_ns
        previous_ns, self._previous_arrival_ns = self._previous_arrival_ns, frame.t_ns
        place = bisect_left(self.waiting, frame.t_ns, key=lambda other: other.t_ns)
        if frame.t_ns == last_ns or (place < len(self.waiting) and self.waiting[place].t_ns == frame.t_ns):
            self._incidents.add("frame_duplicate", frame.t_ns, "dropped: a frame with this stamp came before")
            return
        if last_ns is not None and frame.t_ns < last_ns:
            self._incidents.add("frame_out_of_order", frame.t_ns, "dropped: a later frame was already processed")
            return
        if previous_ns is not None and frame.t_ns < previous_ns:
            self._incidents.add("frame_out_of_order", frame.t_ns, "sorted into place")
        self.waiting.insert(place, frame)

    def pop(self) -> FrameSet:
        frame = self.waiting.pop(0)
        self._last_released_ns = frame.t_ns
        return frame

    def watch_gap(self, t_ns: int) -> None:
        """Count a gap before the frame at ``t_ns`` if it is long against the usual period."""
        if self._last_watched_ns is not None:
            period_ns = t_ns - self._last_watched_ns
            if self._periods_ns and period_ns > _CAMERA_GAP_PERIODS * median(self._periods_ns):
                self._incidents.add("camera_gap", t_ns, f"{period_ns / NS_PER_S:.3f} s without a frame before this one")
            self._periods_ns.append(period_ns)
        self._last_watched_ns = t_ns


class _ImuBuffer:
    """IMU samples on the camera's clock that no segment has used yet, ordered by time."""

    def __init__(self, time_offset_ns: int, incidents: Incidents) -> None:
        self._offset_ns = time_offset_ns
        self._incidents = incidents
        self._times: list[int] = []
        self._samples: list[ImuSample] = []
        self._previous_arrival_ns: int | None = None
        # Where the last segment ended: its stamp with the reading there, and the last sample that went into it.
        self._end: ImuSample | None = None
        self._last_used_ns: int | None = None
        self._gap_limit_ns: float | None = None
        self._last_gap_ns: int | None = None

    def add(self, sample: ImuSample) -> None:
        t_ns = sample.t_ns - self._offset_ns
        gyro, accel = sample.gyro_B.tolist(), sample.accel_B.tolist()
        if not all(map(isfinite, (*gyro, *accel))):
            self._incidents.add("imu_nan", t_ns, "dropped: a reading is not finite")
            return
        if max(map(abs, gyro)) > _MAX_RATE_RAD_S or max(map(abs, accel)) > _MAX_FORCE_M_S2:
            self._incidents.add("imu_out_of_range", t_ns, "dropped: no IMU can measure such a reading")
            return
        previous_ns, self._previous_arrival_ns = self._previous_arrival_ns, t_ns
        place = bisect_left(self._times, t_ns)
        if t_ns == self._last_used_ns or (place < len(self._times) and self._times[place] == t_ns):
            self._incidents.add("imu_duplicate", t_ns, "dropped: a sample with this stamp came before")
            return
        if self._end is not None and t_ns <= self._end.t_ns:
            self._incidents.add("imu_out_of_order", t_ns, "dropped: its frame was already processed")
            return
        if previous_ns is not None and t_ns < previous_ns:
            self._incidents.add("imu_out_of_order", t_ns, "sorted into place")
        self._times.insert(place, t_ns)
        self._samples.insert(place, sample)

    def forget(self) -> None:
        """Let go of the oldest readings where there are more than any frame may still ask for."""
        if len(self._times) > 2 * _MOST_IDLE_READINGS:
            del self._times[:_MOST_IDLE_READINGS], self._samples[:_MOST_IDLE_READINGS]

    def count_from(self, t_ns: int) -> int:
        """Number of samples at or after ``t_ns``."""
        return len(self._times) - bisect_left(self._times, t_ns)

    def covers(self, t_ns: int) -> bool:
        """Whether a reading at ``t_ns`` can be interpolated, given that there is a sample at or after it."""
        return self._end is not None or self._times[0] <= t_ns

    def segment_until(self, t_ns: int) -> ImuSegment:
        """The readings from the end of the last segment to ``t_ns``; the samples up to there are used up."""
        used = bisect_right(self._times, t_ns)
        times, samples = self._times[:used], self._samples[:used]
        recorded = times[-1:] if self._last_used_ns is None else [self._last_used_ns, *times]
        if recorded[-1] < t_ns:
            recorded = [*recorded, self._times[used]]
        gap_s = self._largest_gap_s(recorded)
        before = (times[-1], samples[-1]) if times else None
        end = self._reading_at(t_ns, before, used)
        if self._end is None:
            times, samples = [t_ns], [end]
        else:
            if times and times[-1] == t_ns:
                times.pop()
                samples.pop()
            times = [self._end.t_ns, *times, t_ns]
            samples = [self._end, *samples, end]
        if before is not None:
            self._last_used_ns = before[0]
        self._end = end
        del self._times[:used], self._samples[:used]
        return ImuSegment(
            np.array(times, dtype=np.int64),
            np.array([sample.gyro_B for sample in samples], dtype=np.float64),
            np.array([sample.accel_B for sample in samples], dtype=np.float64),
            gap_s,
        )

    def _reading_at(self, t_ns: int, before: tuple[int, ImuSample] | None, after: int) -> ImuSample:
        """Linear between the last reading up to ``t_ns`` and the first sample after it, at place ``after``."""
        if before is None:
            assert self._end is not None  # covers() was true
            before = (self._end.t_ns, self._end)
        t_0, sample_0 = before
        if t_0 == t_ns:
            return ImuSample(t_ns, sample_0.gyro_B, sample_0.accel_B)
        t_1, sample_1 = self._times[after], self._samples[after]
        fraction = (t_ns - t_0) / (t_1 - t_0)
        return ImuSample(
            t_ns,
            sample_0.gyro_B + fraction * (sample_1.gyro_B - sample_0.gyro_B),
            sample_0.accel_B + fraction * (sample_1.accel_B - sample_0.accel_B),
        )

    def _largest_gap_s(self, recorded: list[int]) -> float:
        """Longest stretch between ``recorded`` stamps; those far beyond the usual period are counted, each once."""
        if self._gap_limit_ns is None:
            # The usual period is taken from what is there when the first segment is cut.
            periods = [after - before for before, after in pairwise(self._times[:_PERIOD_SAMPLES])]
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
