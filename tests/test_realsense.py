"""RealSense cameras: their calibration, clocks and pairs, and a whole device emulated by librealsense itself."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from threading import Thread
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from simulation_helpers import small_calibration, small_simulation

from vioframe.errors import CalibrationError, DatasetError, PluginError, SourceError
from vioframe.evaluation import evaluate
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.interfaces import Source
from vioframe.io.calibration import write_calibration
from vioframe.parts import registry
from vioframe.parts.config import parse
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder
from vioframe.types import Calibration, CameraOnBody, FrameSet, ImuNoise, ImuSample, Measurement, Unreadable
from vioframe_realsense import calibration as conversion
from vioframe_realsense import device as devices
from vioframe_realsense import source as sources
from vioframe_realsense.device import Wanted
from vioframe_realsense.emulated import Emulated, librealsense_lens
from vioframe_realsense.source import RealSense
from vioframe_realsense.timing import HARDWARE_CLOCK, Clock, Pairs, Readings

# It needs libraries of the system, too.
rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)

MS = 1_000_000
NS_PER_S = 1_000_000_000
WRAP_MS = 2**32 / 1000
INSTALLED = registry.load()

SMALL = (64, 48)
LENS = Camera(40.0, 41.0, 31.5, 23.5, (-0.28, 0.07, 2e-4, 2e-5), SMALL)
RIG = Calibration(
    (
        CameraOnBody("cam0", LENS, so3.exp([0.3, -1.2, 0.4]), np.array([0.005, -0.012, 0.01])),
        CameraOnBody("cam1", replace(LENS, cx=30.0), so3.exp([0.3, -1.21, 0.4]), np.array([0.055, -0.012, 0.01])),
    ),
    ImuNoise(1.6e-4, 1e-3, conversion.GYRO_WALK, conversion.ACCEL_WALK, 200.0),
)


def opened(emulated: Emulated, **options: Any) -> RealSense:
    options = {"frame_rate_hz": 30, "resolution": SMALL, "emitter": False, **options}
    wanted = Wanted(*(options.pop(name) for name in ("resolution", "frame_rate_hz", "emitter")))
    return RealSense(lambda serial: emulated.device, "", wanted, **options)


def collected(emulated: Emulated, source: RealSense, inject: Callable[[], None]) -> list[Measurement]:
    """What the source brings while ``inject`` has the device measure: once it is started, and until no more comes."""
    brought: list[Measurement] = []

    def play() -> None:
        emulated.wait_until_started()
        inject()
        count = -1
        while count < len(brought):
            count = len(brought)
            time.sleep(0.3)
        source.close()

    player = Thread(target=play)
    player.start()
    try:
        brought.extend(source.measurements())
    finally:
        player.join()
    return brought


def flight(seconds: float = 1.0, cameras: int = 2, t0_ns: int = 5_000 * MS) -> list[Measurement]:
    """Readings at 200 Hz and images at 30 Hz, random."""
    rng = np.random.default_rng(0)
    out: list[Measurement] = [
        ImuSample(t0_ns + k * 5 * MS, *np.float32(rng.normal(size=(2, 3))).astype(np.float64))
        for k in range(round(200 * seconds))
    ]
    for k in range(round(30 * seconds)):
        images = tuple(rng.integers(0, 256, SMALL[::-1], dtype=np.uint8) for _ in range(cameras))
        out.append(FrameSet(t0_ns + k * 33_333_000, images))
    return sorted(out, key=lambda m: m.t_ns)


def samples(measurements: Iterable[Measurement]) -> list[ImuSample]:
    return [m for m in measurements if isinstance(m, ImuSample)]


def frames(measurements: Iterable[Measurement]) -> list[FrameSet]:
    return [m for m in measurements if isinstance(m, FrameSet)]


class TestCalibration:
    @pytest.mark.parametrize("model", ["brown_conrady", "kannala_brandt4"])
    def test_a_lens_projects_as_librealsense_does(self, model):
        told = librealsense_lens(LENS, model)
        p_C = np.random.default_rng(0).uniform([-0.6, -0.5, 1.0], [0.6, 0.5, 2.0], (50, 3))
        theirs = [rs.rs2_project_point_to_pixel(told, point) for point in p_C.tolist()]
        np.testing.assert_allclose(conversion.lens("cam0", told).project(p_C), theirs, atol=1e-4)

    @pytest.mark.parametrize("model", ["none", "brown_conrady", "inverse_brown_conrady", "modified_brown_conrady"])
    def test_a_rectified_lens_is_a_pinhole_by_any_name(self, model):
        pinhole = replace(LENS, distortion=(0.0, 0.0, 0.0, 0.0))
        assert conversion.lens("cam0", librealsense_lens(pinhole, model)) == pinhole

    @pytest.mark.parametrize("model", ["inverse_brown_conrady", "modified_brown_conrady", "ftheta"])
    def test_a_lens_that_cannot_be_told_is_refused(self, model):
        with pytest.raises(CalibrationError, match=rf"cam0 is told as '{model}'.*--calibration"):
            conversion.lens("cam0", librealsense_lens(LENS, model))

    def test_a_fifth_coefficient_is_refused(self):
        told = librealsense_lens(LENS)
        told.coeffs = [*LENS.distortion, 0.01]
        with pytest.raises(CalibrationError, match="four coefficients"):
            conversion.lens("cam0", told)

    def test_a_camera_sits_where_librealsense_has_it(self):
        R_CB, t_CB = so3.exp([0.4, -0.9, 1.3]), np.array([0.01, -0.02, 0.03])
        extrinsics = rs.extrinsics()
        extrinsics.rotation, extrinsics.translation = R_CB.T.ravel().tolist(), t_CB.tolist()
        camera = conversion.on_body("cam0", LENS, extrinsics)
        p_B = np.array([0.3, -0.7, 1.9])
        p_C = np.array(rs.rs2_transform_point_to_point(extrinsics, p_B.tolist()))
        np.testing.assert_allclose(camera.R_BC @ p_C + camera.p_BC, p_B, atol=1e-6)
        np.testing.assert_allclose(camera.R_BC @ camera.R_BC.T, np.eye(3), atol=1e-15)

    @pytest.mark.parametrize("rotation", [np.zeros((3, 3)), np.diag([1.0, 1.0, -1.0]), np.full((3, 3), np.nan)])
    def test_what_is_no_rotation_is_refused(self, rotation):
        with pytest.raises(CalibrationError, match="no rotation"):
            conversion.on_body("cam0", LENS, SimpleNamespace(rotation=rotation.ravel(), translation=[0.0] * 3))

    def test_noise_nobody_has_measured_is_that_of_the_data_sheets(self):
        noise = conversion.imu_noise([0.0] * 3, [0.0] * 3, 200, 63)
        assert noise == ImuNoise(
            conversion.GYRO_DENSITY, conversion.ACCEL_DENSITY, conversion.GYRO_WALK, conversion.ACCEL_WALK, 200.0
        )
        assert np.degrees(noise.gyro_density) == pytest.approx(0.014)

    def test_noise_measured_is_spread_over_the_rate(self):
        noise = conversion.imu_noise([4e-6, 5e-6, 6e-6], [7e-5] * 3, 200, 62)
        assert noise.gyro_density == pytest.approx(np.sqrt(5e-6 / 200))
        assert noise.accel_density == pytest.approx(np.sqrt(7e-5 / 62))


class TestClock:
    def test_stamps_are_the_devices_to_the_nanosecond(self):
        clock = Clock("D435I")
        for t_us in (4_000_000_001, 4_000_002_501, 4_294_967_294):
            assert clock.t_ns(t_us / 1000, HARDWARE_CLOCK, 7, of_reading=True) == 1000 * t_us
        clock = Clock("D435I")
        t_ms = 1_758_000_000_123.456
        assert clock.t_ns(t_ms, "global_time", 7, of_reading=True) == pytest.approx(t_ms * 1e6, abs=300)

    def test_time_goes_on_where_the_counter_begins_anew(self):
        """Streams come across it one after the other, and once an hour."""
        clock = Clock("D435I")
        stamps_ms = np.concatenate([np.arange(WRAP_MS - 50, WRAP_MS + 50, 5.0), [1.3 * WRAP_MS, 1.7 * WRAP_MS]])
        stamps_ms = np.concatenate([stamps_ms, np.arange(2 * WRAP_MS - 20, 2 * WRAP_MS + 20, 5.0)])
        for t_ms in stamps_ms:
            for late_ms in (0.0, 30.0):
                t_ns = clock.t_ns((t_ms - late_ms) % WRAP_MS, HARDWARE_CLOCK, 7, of_reading=True)
                assert t_ns == pytest.approx((t_ms - late_ms) * MS, abs=1)

    def test_time_goes_on_where_the_device_was_without_power(self):
        clock = Clock("D435I")
        clock.begin()
        assert clock.t_ns(600_000.0, HARDWARE_CLOCK, 10 * NS_PER_S, of_reading=True) == 600 * NS_PER_S
        clock.begin()
        now_ns = 13 * NS_PER_S
        assert clock.t_ns(2_000.0, HARDWARE_CLOCK, now_ns, of_reading=True) == 603 * NS_PER_S
        assert clock.t_ns(2_005.0, HARDWARE_CLOCK, now_ns, of_reading=True) == 603 * NS_PER_S + 5 * MS
        assert clock.t_ns(1_990.0, HARDWARE_CLOCK, now_ns, of_reading=False) == 603 * NS_PER_S - 10 * MS

    def test_the_computers_time_needs_no_help(self):
        clock = Clock("D435I")
        for begin_ms in (600_000.0, 2_000.0, 3 * WRAP_MS):
            clock.begin()
            assert clock.t_ns(begin_ms, "system_time", 7, of_reading=True) == pytest.approx(begin_ms * MS, abs=1)

    def test_the_first_reading_tells_the_clock(self):
        clock = Clock("D435I")
        assert clock.t_ns(1.0, "system_time", 7, of_reading=False) is None
        assert clock.t_ns(1.0, HARDWARE_CLOCK, 7, of_reading=True) == MS
        assert clock.t_ns(1.0, "system_time", 7, of_reading=False) is None
        assert clock.t_ns(2.0, HARDWARE_CLOCK, 7, of_reading=False) == 2 * MS

    def test_two_clocks_are_refused_for_good_but_a_stray_stamp_is_not(self):
        clock = Clock("D435I")
        clock.t_ns(0.0, HARDWARE_CLOCK, 7, of_reading=True)
        for k in range(100):
            assert clock.t_ns(float(k), HARDWARE_CLOCK, 7, of_reading=False) is not None
            assert clock.t_ns(float(k), "system_time", 7, of_reading=False) is None

        def mixed() -> None:
            for k in range(20):
                clock.t_ns(float(k), HARDWARE_CLOCK, 7, of_reading=True)
                clock.t_ns(float(k), "system_time", 7, of_reading=False)

        with pytest.raises(DatasetError, match=r"D435I stamps .* by different clocks.*librealsense2-dkms") as refused:
            mixed()
        assert not isinstance(refused.value, SourceError)  # it would be looked for again


class TestReadings:
    @pytest.mark.parametrize("seed", range(5))
    def test_every_reading_comes_once_however_the_two_streams_are_mixed(self, seed):
        rng = np.random.default_rng(seed)
        gyro_ns = np.cumsum(rng.integers(2, 4, 400)) * MS
        accel_ns = np.cumsum(rng.integers(3, 17, 90)) * MS
        slope = np.array([1e-6, -2e-6, 3e-7])
        readings, out, g, a = Readings(), [], 0, 0
        while g < len(gyro_ns) or a < len(accel_ns):
            # Either stream is ahead of the other by up to half a second.
            ahead_ns = rng.integers(-500, 500) * MS
            if a == len(accel_ns) or (g < len(gyro_ns) and gyro_ns[g] < accel_ns[a] + ahead_ns):
                out += readings.gyro(int(gyro_ns[g]), np.full(3, float(g)))
                g += 1
            else:
                out += readings.accel(int(accel_ns[a]), slope * accel_ns[a])
                a += 1
        expected = gyro_ns[(gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])]
        assert len(expected) > 200
        assert [sample.t_ns for sample in out] == expected.tolist()
        for sample in out:
            np.testing.assert_allclose(sample.accel_B, slope * sample.t_ns, rtol=1e-9)
            assert gyro_ns[int(sample.gyro_B[0])] == sample.t_ns

    def test_a_reading_waits_for_the_accelerometer(self):
        readings = Readings()
        assert readings.gyro(1, np.zeros(3)) == []
        assert readings.accel(2, np.ones(3)) == []  # what was ahead of it is gone
        assert readings.gyro(4, np.zeros(3)) == []
        assert readings.gyro(6, np.zeros(3)) == []
        assert [s.t_ns for s in readings.accel(6, 5 * np.ones(3))] == [4, 6]
        assert readings.accel(6, 9 * np.ones(3)) == []  # the same stamp twice
        (last,) = readings.gyro(5, np.zeros(3))
        np.testing.assert_array_equal(last.accel_B, np.full(3, 4.0))

    def test_what_is_kept_is_little(self):
        readings = Readings()
        for k in range(5000):
            readings.accel(k * 4 * MS, np.zeros(3))
            assert len(readings.gyro(k * 4 * MS, np.zeros(3))) == 1
        assert len(readings._accel) < 300


IMAGE = np.zeros((2, 2), np.uint8)


def seen(sets: Iterable[FrameSet]) -> list[tuple[int, tuple[bool, ...]]]:
    return [(frames.t_ns, tuple(image is not None for image in frames.images)) for frames in sets]


class TestPairs:
    def test_images_of_one_stamp_come_in_one_set(self):
        pairs = Pairs(2, 33 * MS)
        assert pairs.add(1, 10 * MS, IMAGE) == []
        left = IMAGE + 1
        (both,) = pairs.add(0, 10 * MS + 1000, left)
        assert both.t_ns == 10 * MS
        assert both.images[0] is left
        assert both.images[1] is IMAGE

    def test_a_single_camera_waits_for_nobody(self):
        assert seen(Pairs(1, 33 * MS).add(0, 5, IMAGE)) == [(5, (True,))]

    def test_an_image_without_a_partner_goes_when_the_next_pair_is_there(self):
        pairs = Pairs(2, 33 * MS)
        assert pairs.add(0, 33 * MS, IMAGE) == []
        assert pairs.add(0, 66 * MS, IMAGE) == []
        alone = [(33 * MS, (True, False)), (66 * MS, (True, True))]
        assert seen(pairs.add(1, 66 * MS, IMAGE)) == alone

    def test_a_camera_that_is_silent_holds_the_other_up_for_two_images(self):
        pairs = Pairs(2, 33 * MS)
        gone = [[t_ns // (33 * MS) for t_ns, _ in seen(pairs.add(1, k * 33 * MS, IMAGE))] for k in range(6)]
        assert gone == [[], [], [0], [1], [2], [3]]

    @pytest.mark.parametrize("seed", range(5))
    def test_no_image_is_lost_or_paired_wrongly(self, seed):
        """One camera is up to a period behind the other, and each loses some."""
        rng = np.random.default_rng(seed)
        shots = [(k, place) for k in range(200) for place in (0, 1) if rng.random() < 0.8]
        shots.sort(key=lambda shot: shot[0] + (0.9 if shot[1] == seed % 2 else 0.0))
        pairs, sets = Pairs(2, 33 * MS), []
        for k, place in shots:
            sets += pairs.add(place, k * 33 * MS, np.full((2, 2), k, np.uint8))
        sets += pairs.add(0, 300 * 33 * MS, IMAGE)  # and the rest
        images = [(image[0, 0], place) for s in sets for place, image in enumerate(s.images) if image is not None]
        assert sorted(images) == sorted(shots)
        assert all(image is None or image[0, 0] == s.t_ns // (33 * MS) for s in sets for image in s.images)
        both = {k for k, _ in shots if (k, 0) in shots and (k, 1) in shots}
        assert {s.t_ns // (33 * MS) for s in sets if None not in [i if i is None else 0 for i in s.images]} == both


class TestSource:
    def test_all_that_is_measured_comes(self):
        emulated, measured = Emulated(RIG), flight()
        brought = collected(emulated, opened(emulated), lambda: emulated.play(measured))
        given, readings = samples(measured), samples(brought)
        # The first reading is ahead of the accelerometer's, the last one behind.
        assert [s.t_ns for s in readings] == [s.t_ns for s in given[1:-1]]
        np.testing.assert_array_equal([s.gyro_B for s in readings], [s.gyro_B for s in given[1:-1]])
        between = np.array(
            [0.5 * (one.accel_B + other.accel_B) for one, other in zip(given[::2], given[1::2], strict=True)]
        )
        between_ns = np.array([s.t_ns for s in given[::2]]) + 2.5 * MS
        for axis in range(3):
            expected = np.interp([s.t_ns for s in readings], between_ns, between[:, axis])
            np.testing.assert_allclose([s.accel_B[axis] for s in readings], expected, atol=1e-6)
        assert [f.t_ns for f in frames(brought)] == [f.t_ns for f in frames(measured)]
        for one, other in zip(frames(brought), frames(measured), strict=True):
            for image, expected_image in zip(one.images, other.images, strict=True):
                assert image is not None
                assert image.dtype == np.uint8
                assert not image.flags.writeable
                assert image.flags.owndata
                np.testing.assert_array_equal(image, expected_image)
        assert all(type(m.t_ns) is int for m in brought)
        assert len(brought) == len(readings) + len(frames(brought))

    def test_nothing_is_lost_while_nobody_reads(self):
        emulated, measured = Emulated(RIG), flight(2.0)
        brought = iter(opened(emulated).measurements())
        Thread(target=lambda: (emulated.wait_until_started(), emulated.play(measured, at_once=True))).start()
        first = next(brought)
        time.sleep(1.0)
        expected = len(samples(measured)) - 2 + len(frames(measured))
        rest = [next(brought) for _ in range(expected - 1)]
        assert len(samples([first, *rest])) == len(samples(measured)) - 2
        brought.close()

    def test_the_rig_is_read_from_the_device(self):
        source = opened(Emulated(RIG))
        assert isinstance(source, Source)
        assert source.name == "D435I_0123"
        assert (source.frame_count, source.ground_truth) == (None, None)
        assert source.calibration.imu.rate_hz == 200.0
        for name in ("gyro_density", "accel_density", "gyro_walk", "accel_walk"):
            assert getattr(source.calibration.imu, name) == pytest.approx(getattr(RIG.imu, name), rel=1e-6)
        for camera, expected in zip(source.calibration.cameras, RIG.cameras, strict=True):
            assert camera.name == expected.name
            assert camera.model.resolution == SMALL
            np.testing.assert_allclose(camera.model.distortion, expected.model.distortion, rtol=1e-6)
            np.testing.assert_allclose(camera.model.K, expected.model.K)
            np.testing.assert_allclose(camera.R_BC, expected.R_BC, atol=1e-6)
            np.testing.assert_allclose(camera.p_BC, expected.p_BC, atol=1e-6)

    @pytest.mark.parametrize("name", ["cam0", "cam1"])
    def test_one_camera_of_two(self, name):
        emulated = Emulated(RIG)
        source = opened(emulated, cameras=name)
        assert [camera.name for camera in source.calibration.cameras] == [name]
        measured = flight(0.3)
        place = int(name[-1])
        brought = frames(collected(emulated, source, lambda: emulated.play(measured)))
        assert len(brought) == len(frames(measured))
        for one, other in zip(brought, frames(measured), strict=True):
            np.testing.assert_array_equal(one.images, [other.images[place]])

    def test_a_device_with_one_camera(self):
        emulated = Emulated(RIG, cameras=1)
        source, measured = opened(emulated), flight(0.3, cameras=1)
        assert [camera.name for camera in source.calibration.cameras] == ["cam0"]
        assert len(frames(collected(emulated, source, lambda: emulated.play(measured)))) == len(frames(measured))

    @pytest.mark.parametrize("wanted", [False, True])
    def test_emitter_and_clock_are_set(self, wanted):
        emulated = Emulated(RIG)
        collected(emulated, opened(emulated, emitter=wanted), lambda: None)
        assert emulated.stereo.get_option(rs.option.emitter_enabled) == float(wanted)
        for sensor in (emulated.stereo, emulated.motion):
            assert sensor.get_option(rs.option.global_time_enabled) == 0.0

    def test_an_emitter_that_is_not_there_is_refused(self):
        emulated = Emulated(RIG, emitter=False)
        with pytest.raises(DatasetError, match="D435I_0123 has no emitter"):
            next(opened(emulated, emitter=True).measurements())
        assert collected(emulated, opened(emulated), lambda: emulated.play(flight(0.1)))

    def test_a_calibration_that_is_named_comes_before_the_devices(self, tmp_path):
        own = RIG.with_camera(0, p_BC=np.array([1.0, 2.0, 3.0]), time_offset_ns=4 * MS)
        write_calibration(own, tmp_path)
        source = opened(Emulated(RIG, placed=False), calibration=tmp_path)
        np.testing.assert_array_equal(source.calibration.cameras[0].p_BC, [1.0, 2.0, 3.0])
        assert source.calibration.cameras[0].time_offset_ns == 4 * MS
        second = opened(Emulated(RIG), calibration=[tmp_path], cameras=["cam1"])
        assert [camera.name for camera in second.calibration.cameras] == ["cam1"]

    def test_a_calibration_for_another_size_is_refused(self, tmp_path):
        write_calibration(RIG.with_camera(0, model=replace(LENS, resolution=(848, 480))), tmp_path)
        with pytest.raises(DatasetError, match="images of 64x48, but cam0 is calibrated for 848x480"):
            opened(Emulated(RIG), calibration=tmp_path)

    @pytest.mark.parametrize(
        ("device", "options", "message"),
        [
            ({"imu": False}, {}, "D435I_0123 has no IMU; take a camera that has one"),
            ({"cameras": 0}, {}, "D435I_0123 has no infrared camera"),
            ({}, {"cameras": "cam2"}, "no camera 'cam2'; choose by --cameras among: cam0, cam1"),
            ({}, {"resolution": (1, 2)}, r"no infrared images of 1x2 at 30 Hz by USB 2.1.*: 64x48 at 15/30 Hz"),
            ({}, {"frame_rate_hz": 60}, "no infrared images of 64x48 at 60 Hz"),
            ({"placed": False}, {}, "does not know cam0, or how its IMU sits to it.*--calibration"),
        ],
    )
    def test_what_cannot_be_used_is_refused(self, device, options, message):
        with pytest.raises((DatasetError, CalibrationError), match=message) as refused:
            opened(Emulated(RIG, **device), **options)
        assert "\n" not in str(refused.value)

    def test_images_are_stamped_in_the_middle_of_their_exposure(self):
        emulated = Emulated(RIG, cameras=1)
        known = rs.frame_metadata_value

        def inject() -> None:
            for sensor_us in (991_000, 995_000, 2_000_000):  # 9 ms and 5 ms ahead of the stamp, and nonsense
                emulated.stereo.set_metadata(known.frame_timestamp, 1_000_000)
                emulated.stereo.set_metadata(known.sensor_timestamp, sensor_us)
                emulated.reads(emulated.gyro, 5000 * MS, np.zeros(3))
                time.sleep(0.05)
                emulated.image(0, 5000 * MS, np.zeros(SMALL[::-1], np.uint8))

        brought = frames(collected(emulated, opened(emulated), inject))
        assert [f.t_ns / MS for f in brought] == [4991.0, 4995.0, 5000.0]

    def test_two_clocks_are_refused(self):
        emulated = Emulated(RIG, domain_of_images="system_time")
        source = opened(emulated)
        with pytest.raises(DatasetError, match=r"different clocks \(hardware_clock, system_time\)"):
            collected(emulated, source, lambda: emulated.play(flight()))

    def test_a_stray_stamp_is_counted(self):
        emulated = Emulated(RIG, cameras=1)

        def inject() -> None:
            emulated.play(flight(0.2, cameras=1))
            emulated._domain_of_images = "system_time"
            emulated.image(0, 5 * NS_PER_S, np.zeros(SMALL[::-1], np.uint8))

        *_, last = collected(emulated, opened(emulated), inject)
        assert isinstance(last, Unreadable)
        assert (last.kind, last.t_ns) == ("frame_unreadable", emulated.injected[-1] - 2_500_000)

    def test_a_device_that_is_unplugged_is_lost_and_goes_on_when_it_is_back(self):
        emulated = Emulated(RIG)
        there = True

        def find(serial: str) -> Any:
            if not there:
                raise SourceError(f"no {serial}")
            return emulated.device

        source = RealSense(find, "", Wanted(SMALL, 30))
        begin_s, gone_s = time.monotonic(), 0.0

        def inject() -> None:
            nonlocal there, gone_s
            emulated.wait_until_started()
            emulated.play(flight(0.2))
            there, gone_s = False, time.monotonic()

        player = Thread(target=inject)
        player.start()
        brought: list[Measurement] = []
        with pytest.raises(SourceError, match="no 0123"):
            brought.extend(source.measurements())
        assert time.monotonic() - gone_s < sources._SILENT_S
        with pytest.raises(SourceError, match="no 0123"):
            next(source.measurements())
        there = True
        # Its clock has begun anew.
        again = samples(collected(emulated, source, lambda: emulated.play(flight(0.2, t0_ns=1_000 * MS))))
        apart_s = (again[0].t_ns - samples(brought)[-1].t_ns) / NS_PER_S
        assert 0.0 < apart_s < time.monotonic() - begin_s
        assert len(again) == len(samples(brought))

    @pytest.mark.parametrize("silent", ["gyroscope", "accelerometer", "cam1"])
    def test_a_stream_that_falls_silent_is_told(self, monkeypatch, silent):
        monkeypatch.setattr(sources, "_SILENT_S", 0.5)
        emulated = Emulated(RIG)
        measured = flight(1.5)
        if silent == "cam1":
            measured = [m if isinstance(m, ImuSample) else FrameSet(m.t_ns, (m.images[0], None)) for m in measured]
        else:
            stream = emulated.gyro if silent == "gyroscope" else emulated.accel
            reads = emulated.reads
            emulated.reads = lambda which, *rest: None if which is stream else reads(which, *rest)
        with pytest.raises(SourceError, match=f"D435I_0123 has sent nothing of its {silent} for 0.5 s"):
            collected(emulated, opened(emulated), lambda: emulated.play(measured))

    def test_a_device_in_use_is_told(self):
        emulated = Emulated(RIG)
        emulated.stereo.open(emulated.cameras[:1])
        with pytest.raises(SourceError, match=r"D435I_0123 cannot be started: .*; end other programs that use it"):
            next(opened(emulated).measurements())
        emulated.stereo.close()
        assert samples(collected(emulated, opened(emulated), lambda: emulated.play(flight(0.1))))  # all was let go

    def test_it_ends_within_a_second(self):
        source = opened(Emulated(RIG))
        closed_s = 0.0

        def close() -> None:
            nonlocal closed_s
            time.sleep(0.5)
            closed_s = time.monotonic()
            source.close()

        Thread(target=close).start()
        assert list(source.measurements()) == []
        assert time.monotonic() - closed_s < 1.0
        assert list(source.measurements()) == []


class TestFinding:
    @pytest.fixture
    def found(self, monkeypatch) -> Iterator[list[Any]]:
        """What librealsense finds, to be filled."""
        there: list[Any] = []
        monkeypatch.setattr(devices, "_context", lambda: SimpleNamespace(query_devices=lambda: there))
        return there

    def test_none_is_told_with_what_may_be_the_cause(self):
        if rs.context().query_devices().size():
            pytest.skip("a RealSense camera is plugged in")
        with pytest.raises(SourceError, match=r"no RealSense camera is found; .*cable.*USB 3.*udev rules") as none:
            INSTALLED.open_dataset("realsense:")
        assert "\n" not in str(none.value)

    def test_the_first_or_that_of_the_serial_number(self, found):
        found += [Emulated(RIG, serial="11").device, Emulated(RIG, serial="22").device]
        options = {"resolution": "64x48"}
        assert INSTALLED.open_dataset("realsense:", options=options).name == "D435I_11"
        assert INSTALLED.open_dataset("realsense:22", options=options).name == "D435I_22"
        with pytest.raises(SourceError, match=r"serial number 33; .*those found: 11, 22"):
            INSTALLED.open_dataset("realsense:33")

    def test_the_one_that_was_found_is_looked_for_again(self, found):
        found += [Emulated(RIG, serial="11").device]
        source = INSTALLED.open_dataset("realsense:", options={"resolution": "64x48"})
        found[:] = [Emulated(RIG, serial="22").device]
        with pytest.raises(SourceError, match="serial number 11"):
            next(source.measurements())

    def test_what_librealsense_raises_is_told(self, monkeypatch):
        def fails() -> Any:
            raise RuntimeError("failed to set\npower state")

        monkeypatch.setattr(devices, "_context", lambda: SimpleNamespace(query_devices=fails))
        with pytest.raises(SourceError, match="cannot be asked: failed to set power state; unplug it"):
            devices.plugged_in("")

    def test_without_the_library_it_is_told_how_to_get_it(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "pyrealsense2", None)
        devices.sdk.cache_clear()
        devices._context.cache_clear()
        try:
            with pytest.raises(PluginError, match=r"source 'realsense' needs pyrealsense2.*'vioframe\[realsense\]'"):
                INSTALLED.open_dataset("realsense:")
        finally:
            devices.sdk.cache_clear()


@pytest.mark.slow
def test_a_flight_by_an_emulated_device_is_the_same_again_from_its_recording(tmp_path, monkeypatch):
    rig = small_calibration(2, ("cam0", "cam1"))
    (tmp_path / "rig").mkdir()
    # It rests at first: that is enough to begin on a computer that is busy otherwise.
    settings = {"flight": {"name": "stop_and_go"}, "duration_s": 9.0, "frame_rate_hz": 10.0}
    simulated = small_simulation(tmp_path / "rig", rig=rig, **settings)
    measured = list(simulated.measurements())
    emulated = Emulated(rig, rate_hz=10)
    monkeypatch.setattr(devices, "_context", lambda: SimpleNamespace(query_devices=lambda: [emulated.device]))
    options = {"resolution": "376x240", "frame_rate_hz": 10}
    config = parse({"dataset": {"path": "realsense:0123", "options": options}}, "test")
    flying = prepare(config, INSTALLED, tape=tmp_path / "flight.mcap")
    live = flying.live
    assert live is not None

    def fly() -> None:
        emulated.wait_until_started()
        emulated.play(measured)
        give_up_s = time.monotonic() + 10.0
        everything = {"readings": emulated.usable, "frames": len(frames(measured))}
        while not everything.items() <= live.figures().items() and time.monotonic() < give_up_s:
            time.sleep(0.05)
        live.stop()

    pilot = Thread(target=fly)
    pilot.start()
    summary = record(flying, tmp_path / "live")
    pilot.join()
    again = prepare(parse({"dataset": {"path": str(tmp_path / "flight.mcap")}}, "test"), INSTALLED)
    record(again, tmp_path / "again")

    figures = summary["live"]
    assert len(emulated.injected) == len(samples(measured)) > 1700
    assert figures["readings"] == emulated.usable >= len(emulated.injected) - 3
    assert figures["frames"] == len(frames(measured))
    first, second = ((tmp_path / run / "trajectory.tum").read_bytes() for run in ("live", "again"))
    assert first == second
    estimate = RunFolder.open(tmp_path / "live").trajectory()
    assert estimate is not None
    assert evaluate(estimate, simulated.ground_truth).ate_m.rmse < 0.15
