"""Synchronisation: whatever order, repetition or damage comes in, complete and increasing segments come out."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vioframe.incidents import Incidents
from vioframe.io.synchronise import Packet, Synchroniser, synchronise
from vioframe.types import FrameSet, ImuSample, Measurement, Unreadable

IMU_PERIOD_NS = 5_000_000
CAMERA_PERIOD_NS = 50_000_000
IMAGES = (np.zeros((2, 2), np.uint8),)
SLOPE = np.array([1.0, -2.0, 3.0])


def reading(t_ns: int) -> ImuSample:
    """A sample of readings that are linear in time, so that interpolation must be exact."""
    return ImuSample(t_ns, SLOPE * t_ns * 1e-9, SLOPE * t_ns * 1e-9 + 10.0)


def recording(imu_count: int = 200, frame_count: int = 18, first_frame_ns: int = 12_345_678) -> list[Measurement]:
    """A flawless recording in order of time; frames fall between IMU samples."""
    imu: list[Measurement] = [reading(i * IMU_PERIOD_NS) for i in range(imu_count)]
    frames: list[Measurement] = [FrameSet(first_frame_ns + i * CAMERA_PERIOD_NS, IMAGES) for i in range(frame_count)]
    return sorted(imu + frames, key=lambda measurement: measurement.t_ns)


def play(measurements: list[Measurement], **options: float) -> tuple[list[Packet], dict[str, int]]:
    incidents = Incidents()
    packets = list(synchronise(iter(measurements), incidents=incidents, **options))
    return packets, dict(incidents.counts)


def assert_clean(packets: list[Packet]) -> None:
    """What every back-end relies on."""
    if packets:
        imu, frame = packets[0]
        assert imu.t_ns.tolist() == [frame.t_ns]
    for (_, previous), (imu, frame) in pairwise(packets):
        assert imu.t_ns[0] == previous.t_ns
        assert imu.t_ns[-1] == frame.t_ns
        assert (np.diff(imu.t_ns) > 0).all()
        assert imu.gyro_B.shape == imu.accel_B.shape == (len(imu.t_ns), 3)
        assert np.isfinite(imu.gyro_B).all()
        assert np.isfinite(imu.accel_B).all()


def assert_same(packets: list[Packet], expected: list[Packet]) -> None:
    assert [frame.t_ns for _, frame in packets] == [frame.t_ns for _, frame in expected]
    for (imu, _), (imu_expected, _) in zip(packets, expected, strict=True):
        np.testing.assert_array_equal(imu.t_ns, imu_expected.t_ns)
        np.testing.assert_array_equal(imu.gyro_B, imu_expected.gyro_B)
        np.testing.assert_array_equal(imu.accel_B, imu_expected.accel_B)


@pytest.mark.parametrize("wait_ms", [0.0, 50.0])
def test_readings_with_stamps_from_the_future_are_waited_out(wait_ms: float) -> None:
    hour_ns = 3_600_000_000_000
    wild = {reading(k * IMU_PERIOD_NS).t_ns for k in (100, 101)}
    measurements: list[Measurement] = [
        replace(m, t_ns=m.t_ns + hour_ns) if isinstance(m, ImuSample) and m.t_ns in wild else m for m in recording()
    ]
    incidents, packets = Incidents(), []
    synchroniser = Synchroniser(incidents, wait_ms=wait_ms)
    for measurement in measurements:
        packets += synchroniser.add(measurement)
    packets += synchroniser.finish()
    assert_clean(packets)
    assert max(imu.largest_gap_s for imu, _ in packets) == pytest.approx(0.015)
    assert set(incidents.counts) == {"imu_out_of_order"}


def test_frames_that_still_wait_at_the_end_come_out_behind_a_gap_too() -> None:
    begin_ns, end_ns = 300_000_000, 1_500_000_000
    measurements = [m for m in recording(400, 36) if not (isinstance(m, ImuSample) and begin_ns < m.t_ns < end_ns)]
    incidents, packets = Incidents(), []
    synchroniser = Synchroniser(incidents, wait_ms=5000.0)
    for measurement in measurements:
        packets += synchroniser.add(measurement)
    assert not packets
    packets += synchroniser.finish()
    assert len(packets) == 36
    assert dict(incidents.counts) == {"imu_gap": 1}


def test_flawless_recording() -> None:
    packets, counts = play(recording())
    assert counts == {}
    assert len(packets) == 18
    assert_clean(packets)
    for imu, _ in packets:
        np.testing.assert_allclose(imu.gyro_B, np.outer(imu.t_ns * 1e-9, SLOPE), rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(imu.accel_B, np.outer(imu.t_ns * 1e-9, SLOPE) + 10.0, rtol=0.0, atol=1e-12)
        assert imu.largest_gap_s == pytest.approx(IMU_PERIOD_NS * 1e-9, abs=1e-12)
    # Ten samples lie strictly between two frames.
    assert {len(imu.t_ns) for imu, _ in packets[1:]} == {12}


def test_frames_on_imu_stamps_use_those_samples_once() -> None:
    packets, counts = play(recording(first_frame_ns=0))
    assert counts == {}
    assert_clean(packets)
    assert {len(imu.t_ns) for imu, _ in packets[1:]} == {11}
    assert packets[1][0].t_ns.tolist() == list(range(0, CAMERA_PERIOD_NS + 1, IMU_PERIOD_NS))


def test_camera_faster_than_imu() -> None:
    imu: list[Measurement] = [reading(i * 10_000_000) for i in range(30)]
    frames: list[Measurement] = [FrameSet(1_000_000 + i * 3_000_000, IMAGES) for i in range(80)]
    packets, counts = play(sorted(imu + frames, key=lambda measurement: measurement.t_ns))
    assert counts == {}
    assert len(packets) == 80
    assert_clean(packets)
    for segment, _ in packets:
        np.testing.assert_allclose(segment.gyro_B, np.outer(segment.t_ns * 1e-9, SLOPE), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("offset_ns", [7_000_000, -7_000_000])
def test_imu_stamps_move_to_the_camera_clock(offset_ns: int) -> None:
    packets, _ = play(recording(), time_offset_ns=offset_ns)
    for imu, _ in packets:
        # t_imu = t_cam + offset, and the readings are linear in t_imu.
        np.testing.assert_allclose(imu.gyro_B, np.outer((imu.t_ns + offset_ns) * 1e-9, SLOPE), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("wait_ms", [0.0, 50.0])
@pytest.mark.parametrize("offset_ms", [-137, -3, 3, 137])
def test_another_time_offset_counts_from_the_next_frame_on(offset_ms: int, wait_ms: float) -> None:
    """What comes then is what would have come with that offset all along, and no reading is lost on the way."""
    offset_ns = offset_ms * 1_000_000
    expected = {frame.t_ns: imu for imu, frame in play(recording(), time_offset_ns=offset_ns)[0]}
    incidents = Incidents()
    synchroniser = Synchroniser(incidents, wait_ms=wait_ms)
    packets: list[Packet] = []
    retimed_after = None
    for measurement in recording():
        for packet in synchroniser.add(measurement):
            packets.append(packet)
            if len(packets) == 8:
                retimed_after = packet[1].t_ns
                synchroniser.retime(offset_ns)
    packets += synchroniser.finish()
    assert retimed_after is not None
    (first, frame), *others = packets[8:]
    assert first.t_ns[0] == min(retimed_after, retimed_after - offset_ns)
    assert first.t_ns[-1] == frame.t_ns
    np.testing.assert_allclose(first.gyro_B, SLOPE * (first.t_ns[:, None] + offset_ns) * 1e-9, atol=1e-12)
    assert np.diff(first.t_ns).max() <= IMU_PERIOD_NS
    assert others
    for imu, frame in others:
        np.testing.assert_array_equal(imu.t_ns, expected[frame.t_ns].t_ns)
        np.testing.assert_allclose(imu.gyro_B, expected[frame.t_ns].gyro_B, atol=1e-12)
    assert not set(incidents.counts) & {"imu_out_of_order", "imu_duplicate", "imu_gap"}


def test_start_and_duration_count_from_the_first_frame() -> None:
    first_ns = recording()[3].t_ns
    packets, counts = play(recording(), start_s=0.2, duration_s=0.3)
    assert counts == {}
    assert [frame.t_ns - first_ns for _, frame in packets] == [i * CAMERA_PERIOD_NS for i in range(4, 11)]
    assert_clean(packets)


def test_frames_outside_the_imu_are_dropped_and_counted() -> None:
    imu = [reading(i * IMU_PERIOD_NS) for i in range(20, 100)]
    frames = [FrameSet(1_000_000 + i * CAMERA_PERIOD_NS, IMAGES) for i in range(12)]
    packets, counts = play(sorted([*imu, *frames], key=lambda measurement: measurement.t_ns))
    # The IMU runs from 100 ms to 495 ms; frames come at 1, 51, ..., 551 ms.
    assert [frame.t_ns for _, frame in packets] == [1_000_000 + i * CAMERA_PERIOD_NS for i in range(2, 10)]
    assert counts == {"frame_before_imu": 2, "frame_after_imu": 2}
    assert_clean(packets)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_readings_that_are_not_finite_are_dropped(bad: float) -> None:
    measurements = recording()
    measurements.insert(60, ImuSample(measurements[60].t_ns - 1, np.array([0.0, bad, 0.0]), np.zeros(3)))
    measurements.insert(90, ImuSample(measurements[90].t_ns - 1, np.zeros(3), np.array([bad, 0.0, -bad])))
    packets, counts = play(measurements)
    assert counts == {"imu_nan": 2}
    assert_same(packets, play(recording())[0])


@pytest.mark.parametrize(
    ("gyro_B", "accel_B"), [([0.0, -101.0, 0.0], [0.0, 0.0, 9.81]), ([0.0, 0.0, 0.0], [1e200, 0.0, 0.0])]
)
def test_readings_that_no_imu_can_measure_are_dropped(gyro_B: list[float], accel_B: list[float]) -> None:
    measurements = recording()
    measurements.insert(60, ImuSample(measurements[60].t_ns - 1, np.array(gyro_B), np.array(accel_B)))
    packets, counts = play(measurements)
    assert counts == {"imu_out_of_range": 1}
    assert_same(packets, play(recording())[0])


def test_the_strongest_readings_that_an_imu_can_measure_are_kept() -> None:
    measurements = recording()
    t_ns = measurements[60].t_ns - 1
    measurements.insert(60, ImuSample(t_ns, np.full(3, 70.0), np.full(3, -1960.0)))
    packets, counts = play(measurements)
    assert counts == {}
    assert t_ns in np.concatenate([imu.t_ns for imu, _ in packets])


def test_a_late_sample_is_dropped_once_its_frame_is_gone() -> None:
    measurements = recording()
    late = next(i for i, m in enumerate(measurements) if m.t_ns == 20 * IMU_PERIOD_NS)
    measurements.insert(late + 60, measurements.pop(late))
    packets, counts = play(measurements)
    assert counts == {"imu_out_of_order": 1}
    assert len(packets) == 18
    assert 20 * IMU_PERIOD_NS not in np.concatenate([imu.t_ns for imu, _ in packets])
    assert_clean(packets)


@pytest.mark.parametrize("stamp_ns", [0, -(10**18), 4 * 10**18])
def test_one_wild_imu_stamp_harms_nothing_else(stamp_ns: int) -> None:
    measurements = recording()
    measurements.insert(80, ImuSample(stamp_ns, np.full(3, 99.0), np.full(3, 99.0)))
    packets, counts = play(measurements)
    assert sum(counts.values()) == 1
    assert_same(packets, play(recording())[0])


def test_one_wild_frame_stamp_harms_nothing_else() -> None:
    measurements = recording()
    measurements.insert(80, FrameSet(4 * 10**18, IMAGES))
    measurements.insert(90, FrameSet(0, IMAGES))
    packets, counts = play(measurements)
    assert counts == {"frame_after_imu": 1, "frame_out_of_order": 2}
    assert_same(packets, play(recording())[0])


def test_an_imu_gap_is_counted_once_and_shown_in_each_segment() -> None:
    gap = range(60 * IMU_PERIOD_NS, 90 * IMU_PERIOD_NS)
    measurements = [m for m in recording() if isinstance(m, FrameSet) or m.t_ns not in gap]
    packets, counts = play(measurements)
    assert counts == {"imu_gap": 1}
    assert len(packets) == 18
    assert_clean(packets)
    gaps = [imu.largest_gap_s for imu, _ in packets]
    # Samples at 295 ms and 450 ms; the segments that end at 312, 362, 412 and 462 ms touch the gap.
    assert gaps[6:10] == pytest.approx([0.155] * 4, abs=1e-12)
    assert max(gaps[:6] + gaps[10:]) == pytest.approx(0.005, abs=1e-12)


def test_a_camera_gap_is_counted_and_its_segment_is_complete() -> None:
    frames = [m for m in recording() if isinstance(m, FrameSet)]
    packets, counts = play([m for m in recording() if m not in frames[8:12]])
    assert counts == {"camera_gap": 1}
    assert len(packets) == 14
    assert packets[8][0].duration_s == pytest.approx(0.25, abs=1e-12)
    assert_clean(packets)


def test_frames_do_not_pile_up_behind_a_silent_imu() -> None:
    imu = [reading(i * IMU_PERIOD_NS) for i in range(20)]
    frames = [FrameSet(1_000_000 + i * CAMERA_PERIOD_NS, IMAGES) for i in range(302)]
    packets, counts = play(sorted([*imu, *frames], key=lambda measurement: measurement.t_ns))
    assert len(packets) == 2
    assert counts == {"frame_without_imu": 100, "frame_after_imu": 200}


def test_what_the_reader_could_not_read_is_counted() -> None:
    measurements = recording()
    measurements.insert(50, Unreadable(measurements[50].t_ns, "frame_unreadable", "truncated"))
    packets, counts = play(measurements)
    assert counts == {"frame_unreadable": 1}
    assert len(packets) == 18


def test_it_streams() -> None:
    """A frame is released by readings from 50 ms behind it, not when the recording ends."""
    measurements = recording()
    taken = 0

    def source():
        nonlocal taken
        for taken, measurement in enumerate(measurements, start=1):  # noqa: B007
            yield measurement

    next(synchronise(source(), incidents=Incidents()))
    # The second from 62.3 ms on, as there is no period yet that the first could be in step with.
    assert measurements[taken - 1].t_ns == 14 * IMU_PERIOD_NS


def arriving_late(late_ns: int) -> list[Measurement]:
    """The recording with every third reading ``late_ns`` behind its turn."""
    measurements = recording()
    turn = {
        id(m): m.t_ns + (late_ns if isinstance(m, ImuSample) and m.t_ns // IMU_PERIOD_NS % 3 == 1 else 0)
        for m in measurements
    }
    return sorted(measurements, key=lambda m: turn[id(m)])


def push(measurements: list[Measurement], wait_ms: float) -> tuple[list[Packet], dict[str, int]]:
    incidents = Incidents()
    synchroniser = Synchroniser(incidents, wait_ms=wait_ms)
    packets = [packet for measurement in measurements for packet in synchroniser.add(measurement)]
    return packets + list(synchroniser.finish()), dict(incidents.counts)


@pytest.mark.parametrize("wait_ms", [20.0, 50.0, 200.0])
def test_readings_as_late_as_a_frame_waits_find_their_place(wait_ms: float) -> None:
    expected = play(recording())[0]
    packets, counts = push(arriving_late(round(wait_ms * 1e6)), wait_ms)
    assert_same(packets, expected)
    assert set(counts) == {"imu_out_of_order"}
    # One that comes later still is counted, and is no part of a segment that was cut before.
    packets, _ = push(arriving_late(round((wait_ms + 50.0) * 1e6)), wait_ms)
    assert_clean(packets)
    assert len(packets) == len(expected)
    assert sum(len(imu.t_ns) for imu, _ in packets) < sum(len(imu.t_ns) for imu, _ in expected)


def test_without_a_wait_a_frame_comes_out_at_the_first_reading_at_or_behind_it() -> None:
    for first_frame_ns in (12_345_678, 0):
        synchroniser = Synchroniser(Incidents(), wait_ms=0.0)
        waiting: list[int] = []
        for measurement in recording(first_frame_ns=first_frame_ns):
            released = [frame.t_ns for _, frame in synchroniser.add(measurement)]
            if isinstance(measurement, FrameSet):
                waiting.append(measurement.t_ns)
            due = [t_ns for t_ns in waiting if isinstance(measurement, ImuSample) or t_ns % IMU_PERIOD_NS == 0]
            assert released == [t_ns for t_ns in due if t_ns <= measurement.t_ns]
            waiting = [t_ns for t_ns in waiting if t_ns not in released]
        assert not waiting
    packets, counts = push(recording(), 0.0)
    assert counts == {}
    assert_same(packets, play(recording())[0])


@pytest.mark.parametrize("wait_ms", [5.0, 50.0, 150.0])
def test_one_wild_stamp_harms_nothing_however_long_frames_wait(wait_ms: float) -> None:
    measurements = recording()
    measurements.insert(80, ImuSample(4 * 10**18, np.full(3, 99.0), np.full(3, 99.0)))
    measurements.insert(90, FrameSet(5 * 10**18, IMAGES))
    packets, counts = push(measurements, wait_ms)
    assert_same(packets, play(recording())[0])
    assert counts["imu_out_of_order"] == counts["frame_out_of_order"] == 1


def test_a_frame_waits_for_one_reading_or_for_two_where_the_first_leaps_ahead() -> None:
    synchroniser = Synchroniser(Incidents(), wait_ms=50.0)
    by_then: dict[int, int] = {}
    measurements = recording()
    # One stamp leaps ahead by 0.3 s, while the frame before it waits.
    leaping = next(i for i, m in enumerate(measurements) if m.t_ns == 100 * IMU_PERIOD_NS)
    measurements[leaping] = reading(160 * IMU_PERIOD_NS)
    for measurement in measurements:
        by_then |= {frame.t_ns: measurement.t_ns for _, frame in synchroniser.add(measurement)}
    late_ns = [come_ns - t_ns - 50_000_000 for t_ns, come_ns in by_then.items()]
    assert len(late_ns) == 18
    # To begin with nobody knows the period.
    assert IMU_PERIOD_NS < late_ns.pop(0) < 2 * IMU_PERIOD_NS
    assert all(0 <= late < IMU_PERIOD_NS for late in late_ns)


@st.composite
def shuffled(draw: st.DrawFn) -> list[Measurement]:
    """The flawless recording with measurements moved by a few places (each sensor's by at most nine) and repeated."""
    measurements = recording(imu_count=100, frame_count=9)
    jitter = draw(st.lists(st.integers(0, 9), min_size=len(measurements), max_size=len(measurements)))
    order = sorted(range(len(measurements)), key=lambda i: (i + jitter[i], i))
    out = [measurements[i] for i in order]
    for place in draw(st.lists(st.integers(0, len(out) - 1), max_size=20)):
        out.insert(place + 1, out[place])
    return out


@given(shuffled())
def test_modest_disorder_and_repetition_change_nothing(measurements: list[Measurement]) -> None:
    packets, counts = play(measurements)
    assert_same(packets, play(recording(imu_count=100, frame_count=9))[0])
    repeated = len(measurements) - len(recording(imu_count=100, frame_count=9))
    assert counts.get("imu_duplicate", 0) + counts.get("frame_duplicate", 0) == repeated


@given(
    st.lists(
        st.tuples(st.integers(0, 3000), st.sampled_from(["imu"] * 3 + ["frame", "nan"])),
        min_size=1,
        max_size=200,
    )
)
def test_any_input_gives_clean_segments_and_every_frame_is_accounted_for(stream: list[tuple[int, str]]) -> None:
    measurements: list[Measurement] = []
    for t_ms, kind in stream:
        t_ns = t_ms * 1_000_000
        if kind == "frame":
            measurements.append(FrameSet(t_ns, IMAGES))
        else:
            measurements.append(ImuSample(t_ns, np.full(3, np.nan), np.zeros(3)) if kind == "nan" else reading(t_ns))
    packets, counts = play(measurements)
    assert_clean(packets)
    dropped = sum(counts.get(kind, 0) for kind in ("frame_duplicate", "frame_before_imu", "frame_after_imu"))
    frames = sum(kind == "frame" for _, kind in stream)
    assert len(packets) + dropped <= frames <= len(packets) + dropped + counts.get("frame_out_of_order", 0)
    for imu, _ in packets:
        np.testing.assert_allclose(imu.gyro_B, np.outer(imu.t_ns * 1e-9, SLOPE), rtol=0.0, atol=1e-9)
