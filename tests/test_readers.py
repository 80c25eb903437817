"""Readers: what is in a recording comes out exactly; what is wrong with one is said in a line, or counted."""

import logging
import os
import re
import shutil
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recordings import (
    CALIBRATION,
    CAMERA,
    HEIGHT,
    PAIR,
    T0_NS,
    WIDTH,
    Message,
    assert_equal,
    assert_same_rig,
    compressed_message,
    image_message,
    imu_message,
    measurements,
    pair_measurements,
    true_trajectory,
    write_bag,
)
from rosbags.rosbag2.storage_mcap import zstd
from test_calibration import write_basalt

from vioframe.errors import CalibrationError, DatasetError
from vioframe.incidents import Incidents
from vioframe.interfaces import Dataset
from vioframe.io.calibration import packaged_calibration, sidecar_folder, write_calibration
from vioframe.io.convert import convert
from vioframe.io.images import gathered
from vioframe.io.memory import ArrayDataset
from vioframe.io.synchronise import synchronise
from vioframe.testing import check_dataset
from vioframe.types import FrameSet, Image, ImuSample, Measurement, Unreadable
from vioframe_euroc import EurocDataset
from vioframe_rosbag import RosbagDataset


@pytest.fixture
def asl(tmp_path: Path) -> Path:
    convert(measurements(), CALIBRATION, tmp_path / "flight")
    return tmp_path / "flight"


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    convert(measurements(), CALIBRATION, tmp_path / "flight.bag")
    return tmp_path / "flight.bag"


def frames_of(dataset: Dataset) -> list[FrameSet]:
    return [m for m in dataset.measurements() if isinstance(m, FrameSet)]


def image_of(frames: FrameSet) -> Image:
    """That of a lone camera."""
    (image,) = frames.images
    assert image is not None
    return image


def incidents_of(dataset: Dataset) -> dict[str, int]:
    incidents = Incidents()
    for _ in synchronise(dataset.measurements(), incidents=incidents):
        pass
    return dict(incidents.counts)


def one_line(caught: pytest.ExceptionInfo[Exception]) -> str:
    text = str(caught.value)
    assert "\n" not in text
    return text


class TestAsl:
    @pytest.mark.parametrize("inner", [".", "mav0"])
    def test_everything_comes_out_exactly(self, asl: Path, inner: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(asl / inner)
        for path in (asl / inner, Path()):
            assert EurocDataset.accepts(path)
            dataset = EurocDataset(path)
            assert isinstance(dataset, Dataset)
            assert (dataset.name, dataset.frame_count, dataset.ground_truth) == ("flight", 6, None)
            assert_same_rig(dataset.calibration, CALIBRATION)
            assert_equal(dataset.measurements(), measurements())
            assert_equal(dataset.measurements(), measurements())

    def test_files_as_other_tools_write_them(self, asl: Path) -> None:
        """A heading without '#', carriage returns, blank lines, a byte-order mark, no names of image files."""
        for sensor in ("cam0", "imu0"):
            file = asl / "mav0" / sensor / "data.csv"
            rows = file.read_text().splitlines()[1:]
            if sensor == "cam0":
                rows = [row.split(",")[0] for row in rows]
            file.write_bytes("\ufefftimestamp,rest\r\n\r\n".encode() + "\r\n".join(rows).encode())
        assert_equal(EurocDataset(asl).measurements(), measurements())

    def test_images_that_cannot_be_read_are_counted(self, asl: Path) -> None:
        images = sorted((asl / "mav0" / "cam0" / "data").iterdir())
        images[1].write_bytes(images[1].read_bytes()[:1000])
        images[2].write_bytes(b"")
        images[3].unlink()
        dataset = EurocDataset(asl)
        lost = [m for m in dataset.measurements() if isinstance(m, Unreadable)]
        assert [m.t_ns for m in lost] == [int(image.stem) for image in images[1:4]]
        assert [frame.t_ns for frame in frames_of(dataset)] == [int(images[i].stem) for i in (0, 4, 5)]
        assert incidents_of(dataset)["frame_unreadable"] == 3

    def test_no_image_is_read_from_outside_of_its_folder(self, asl: Path, tmp_path: Path) -> None:
        """Nor from a pipe, which would wait for ever."""
        folder = asl / "mav0" / "cam0"
        images = sorted((folder / "data").iterdir())
        stamps = [image.stem for image in images]
        shutil.copy(images[0], folder / "secret.png")
        images[2].unlink()
        os.mkfifo(images[2])
        names = ["../secret.png", str(folder / "secret.png"), images[2].name, *(image.name for image in images[3:])]
        rows = [f"{stamp},{name}" for stamp, name in zip(stamps, names, strict=True)]
        (folder / "data.csv").write_text("\n".join(["#timestamp,filename", *rows]))
        dataset = EurocDataset(asl)
        lost = [m.detail for m in dataset.measurements() if isinstance(m, Unreadable)]
        assert [detail.partition(" ")[2] for detail in lost] == [
            *("leads out of cam0/data", "leads out of cam0/data", "is no ordinary file")
        ]
        assert [frame.t_ns for frame in frames_of(dataset)] == [int(stamp) for stamp in stamps[3:]]

    def test_imu_rows_that_cannot_be_read_are_counted(self, asl: Path) -> None:
        file = asl / "mav0" / "imu0" / "data.csv"
        lines = file.read_text().splitlines()
        stamps = [line.split(",")[0] for line in lines]
        lines[20] = f"{stamps[20]},0.1,0.2"
        lines[30] = f"{stamps[30]},0.1,0.2,zero,0.1,0.2,0.3"
        lines[40] = f"{stamps[40]},nan,0.2,0.3,0.1,0.2,0.3"
        lines[50] = "garbage"
        file.write_text("\n".join(lines))
        counts = incidents_of(EurocDataset(asl))
        assert counts == {"imu_unreadable": 3, "imu_nan": 1}

    def test_disorder_is_left_to_synchronisation(self, asl: Path) -> None:
        """Rows come in the order of the file, and one wild stamp does not hold up the rest."""
        file = asl / "mav0" / "imu0" / "data.csv"
        heading, *rows = file.read_text().splitlines()
        rows[20], rows[21] = rows[21], rows[20]
        rows.insert(30, rows[30])
        rows.insert(40, "4000000000000000000,9,9,9,9,9,9")
        rows.insert(50, "5,9,9,9,9,9,9")
        file.write_text("\n".join([heading, *rows]))
        dataset = EurocDataset(asl)
        read = [m.t_ns for m in dataset.measurements() if isinstance(m, ImuSample)]
        assert read == [int(row.split(",")[0]) for row in rows]
        incidents = Incidents()
        packets = list(synchronise(dataset.measurements(), incidents=incidents))
        clean = list(synchronise(measurements(), incidents=Incidents()))
        assert [frame.t_ns for _, frame in packets] == [frame.t_ns for _, frame in clean]
        for (imu, _), (imu_clean, _) in zip(packets, clean, strict=True):
            np.testing.assert_array_equal(imu.t_ns, imu_clean.t_ns)
            np.testing.assert_array_equal(imu.gyro_B, imu_clean.gyro_B)
        assert incidents.counts["imu_duplicate"] == 1
        assert incidents.counts["imu_out_of_order"] == 3

    def test_colour_images_become_gray(self, asl: Path) -> None:
        colour = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        for image in (asl / "mav0" / "cam0" / "data").iterdir():
            cv2.imwrite(str(image), colour)
        # ITU-R BT.601 weights, channels in OpenCV's order.
        expected = colour @ np.array([0.114, 0.587, 0.299])
        for frame in frames_of(EurocDataset(asl)):
            assert np.abs(image_of(frame) - expected).max() <= 0.51

    def test_16_bit_images_need_their_depth(self, asl: Path) -> None:
        deep = np.random.default_rng(1).integers(0, 4096, (HEIGHT, WIDTH), dtype=np.uint16)
        for image in (asl / "mav0" / "cam0" / "data").iterdir():
            cv2.imwrite(str(image), deep)
        with pytest.raises(DatasetError, match=r"cam0 has 16-bit images; say how many bits are in use, -o bit_depth"):
            frames_of(EurocDataset(asl))
        for frame in frames_of(EurocDataset(asl, bit_depth=12)):
            np.testing.assert_array_equal(image_of(frame), deep // 16)
        # Values above the stated depth saturate instead of wrapping round.
        np.testing.assert_array_equal(
            image_of(frames_of(EurocDataset(asl, bit_depth=10))[0]), np.minimum(deep // 4, 255)
        )
        with pytest.raises(DatasetError, match="bit_depth must lie between 8 and 16, not 7"):
            EurocDataset(asl, bit_depth=7)

    def test_as_tum_vi_is_given(self, tmp_path: Path) -> None:
        """Two cameras of 16 bits in EuRoC's layout, nothing but the tables beside them, and Basalt's calibration."""
        convert(pair_measurements(), PAIR, tmp_path / "room")
        for file in (tmp_path / "room").rglob("sensor.yaml"):
            file.unlink()
        for file in (tmp_path / "room").rglob("*.png"):
            cv2.imwrite(str(file), 257 * cv2.imread(str(file), cv2.IMREAD_UNCHANGED).astype(np.uint16))
        calibration = write_basalt(tmp_path, resolution=[camera.model.resolution for camera in PAIR.cameras])
        dataset = EurocDataset(tmp_path / "room", calibration=calibration, bit_depth=16)
        assert [camera.name for camera in dataset.calibration.cameras] == ["cam0", "cam1"]
        assert {lens.distortion_model for lens in dataset.calibration.lenses} == {"equidistant"}
        assert_equal(dataset.measurements(), pair_measurements())
        with pytest.raises(CalibrationError, match=r"sensor\.yaml: No such file"):
            EurocDataset(tmp_path / "room")

    def test_images_of_another_size_than_calibrated(self, asl: Path) -> None:
        for image in (asl / "mav0" / "cam0" / "data").iterdir():
            cv2.imwrite(str(image), np.zeros((10, 20), np.uint8))
        with pytest.raises(DatasetError, match=r"images of 20x10, but the calibration is for 64x48; name the right"):
            frames_of(EurocDataset(asl))

    def test_another_camera_and_calibration(self, asl: Path, tmp_path: Path) -> None:
        shutil.copytree(asl / "mav0" / "cam0", asl / "mav0" / "cam1")
        sensor = asl / "mav0" / "cam1" / "sensor.yaml"
        sensor.write_text(sensor.read_text().replace("40.0", "44.0"))
        assert EurocDataset(asl).calibration.cameras[0].model.fx == 40.0
        assert EurocDataset(asl, cameras="cam1").calibration.cameras[0].model.fx == 44.0
        write_calibration(CALIBRATION, tmp_path / "other")
        sensor = tmp_path / "other" / "cam0" / "sensor.yaml"
        sensor.write_text(sensor.read_text().replace("40.0", "55.0"))
        imu = tmp_path / "other" / "imu0" / "sensor.yaml"
        assert EurocDataset(asl, calibration=tmp_path / "other").calibration.cameras[0].model.fx == 55.0
        assert EurocDataset(asl, calibration=[sensor, imu]).calibration.cameras[0].model.fx == 55.0

    def test_ground_truth(self, asl: Path) -> None:
        folder = asl / "mav0" / "state_groundtruth_estimate0"
        folder.mkdir()
        heading = "#timestamp, p_RS_R_x [m], ..., b_a_RS_S_z [m s^-2]\n"
        row = ",".join(map(str, [1.5, 2.5, 3.5, 1.0, 0.0, 0.0, 0.0, *range(9)]))
        (folder / "data.csv").write_text(heading + f"{T0_NS},{row}\n{T0_NS + 5_000_064},{row}\n")
        truth = EurocDataset(asl).ground_truth
        assert truth is not None
        assert truth.t_ns.tolist() == [T0_NS, T0_NS + 5_000_064]

    def test_what_is_wrong_with_a_folder_is_said(self, asl: Path, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=r"is not a folder"):
            EurocDataset(tmp_path / "nowhere")
        (tmp_path / "empty").mkdir()
        assert not EurocDataset.accepts(tmp_path / "empty")
        with pytest.raises(DatasetError, match=r"empty holds no mav0/; name the folder of one sequence"):
            EurocDataset(tmp_path / "empty")
        with pytest.raises(DatasetError, match=r"cam1/data.csv is missing; choose by --cameras .* among: cam0, imu0"):
            EurocDataset(asl, cameras="cam1")
        mav0 = asl / "mav0"
        (mav0 / "imu0" / "sensor.yaml").rename(mav0 / "imu0" / "sensor.txt")
        with pytest.raises(CalibrationError, match=r"imu0/sensor.yaml: No such file"):
            EurocDataset(asl)
        (mav0 / "imu0" / "sensor.txt").rename(mav0 / "imu0" / "sensor.yaml")
        heading, *rows = (mav0 / "imu0" / "data.csv").read_text().splitlines()
        (mav0 / "imu0" / "data.csv").write_text(heading)
        with pytest.raises(DatasetError, match=r"imu0/data.csv holds no sample"):
            EurocDataset(asl)
        (mav0 / "imu0" / "data.csv").write_text("\n".join(rows))
        (mav0 / "cam0" / "data.csv").write_text("#heading\n")
        with pytest.raises(DatasetError, match=r"cam0/data.csv lists no image"):
            EurocDataset(asl)
        (mav0 / "cam0" / "data.csv").write_text("#heading\n1.4e18,a.png\n")
        with pytest.raises(DatasetError, match=r"'1.4e18,a.png' does not begin with a stamp in integer nanoseconds"):
            EurocDataset(asl)
        (mav0 / "imu0" / "data.csv").unlink()
        with pytest.raises(DatasetError, match=r"imu0/data.csv is missing; choose by --cameras .* among: cam0"):
            EurocDataset(asl)


ROS_FORMATS = pytest.mark.parametrize(
    ("name", "compression"),
    [
        ("flight.bag", None),
        ("flight.bag", "bz2"),
        ("flight.bag", "lz4"),
        ("flight.ros2", None),
        ("flight.ros2", "zstd"),
        ("flight.mcap", None),
        ("flight.mcap", "zstd"),
    ],
)

IMAGE = np.random.default_rng(2).integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
IMU = [imu_message("/imu0", ImuSample(T0_NS + i, np.ones(3), np.ones(3))) for i in range(3)]


def bag_with(folder: Path, *messages: Message, calibrated: bool = True) -> Path:
    """A bag of these messages and three of the IMU."""
    path = write_bag(folder / "test.bag", [*IMU, *messages])
    if calibrated:
        write_calibration(CALIBRATION, sidecar_folder(path))
    return path


class TestRosbag:
    @ROS_FORMATS
    def test_everything_comes_out_exactly(self, tmp_path: Path, name: str, compression: str | None) -> None:
        path = tmp_path / name
        convert(measurements(), CALIBRATION, path, compression=compression)
        assert RosbagDataset.accepts(path)
        assert not EurocDataset.accepts(path)
        dataset = RosbagDataset(path)
        assert isinstance(dataset, Dataset)
        assert (dataset.frame_count, dataset.ground_truth) == (6, None)
        assert dataset.name == ("flight.ros2" if path.is_dir() else "flight")
        assert_same_rig(dataset.calibration, CALIBRATION)
        assert_equal(dataset.measurements(), measurements())
        assert_equal(dataset.measurements(), measurements())

    def test_a_bare_sqlite_file(self, tmp_path: Path) -> None:
        convert(measurements(), CALIBRATION, tmp_path / "flight.ros2")
        file = tmp_path / "flight.ros2" / "flight.ros2.db3"
        assert RosbagDataset.accepts(file)
        assert_equal(RosbagDataset(file, calibration=tmp_path / "flight.ros2.calib").measurements(), measurements())

    @ROS_FORMATS
    @pytest.mark.parametrize("kept", [0.0, 0.001, 0.1, 0.5, 0.9, 0.9999])
    def test_a_truncated_recording(self, tmp_path: Path, name: str, compression: str | None, kept: float) -> None:
        path = tmp_path / name
        convert(measurements(), CALIBRATION, path, compression=compression)
        file = path / f"{name}.db3" if path.is_dir() else path
        data = file.read_bytes()
        file.write_bytes(data[: int(len(data) * kept)])
        with pytest.raises(DatasetError, match=r"cannot read .*flight.*; if it is truncated") as caught:
            list(RosbagDataset(path).measurements())
        command = {".bag": "`rosbag reindex`", ".mcap": "`mcap recover`", ".ros2": "`ros2 bag reindex`"}[path.suffix]
        assert command in one_line(caught)

    def test_a_bag_that_was_not_closed(self, bag: Path) -> None:
        data = bytearray(bag.read_bytes())
        at = data.index(b"index_pos=") + len(b"index_pos=")
        data[at : at + 8] = bytes(8)
        bag.write_bytes(data)
        with pytest.raises(DatasetError, match=r"not indexed.*; if .* run `rosbag reindex`") as caught:
            RosbagDataset(bag)
        one_line(caught)

    def test_damage_further_on_leaves_what_came_before(self, tmp_path: Path) -> None:
        path = tmp_path / "flight.bag"
        source = measurements(frame_count=40, size=(480, 640))
        calibration = CALIBRATION.with_camera(0, model=replace(CAMERA.model, resolution=(640, 480)))
        convert(source, calibration, path, compression="bz2")
        data = bytearray(path.read_bytes())
        # Ten chunks of four images: this is in the middle of the sixth.
        place = len(data) * 55 // 100
        data[place : place + 1000] = bytes(1000)
        path.write_bytes(data)
        read: list[Measurement] = []
        with pytest.raises(DatasetError, match="cannot read") as caught:
            read.extend(RosbagDataset(path).measurements())
        one_line(caught)
        assert 16 <= sum(isinstance(m, FrameSet) for m in read) <= 24
        assert_equal(read, source[: len(read)])

    @pytest.mark.parametrize("suffix", [".bag", ".db3", ".mcap"])
    def test_a_file_that_is_something_else(self, tmp_path: Path, suffix: str) -> None:
        path = tmp_path / f"song{suffix}"
        path.write_bytes(b"ID3 this is no recording" * 100)
        with pytest.raises(DatasetError, match="cannot read") as caught:
            RosbagDataset(path)
        one_line(caught)
        path.write_bytes(b"")
        with pytest.raises(DatasetError, match="cannot read"):
            RosbagDataset(path)

    def test_missing_files(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=r"nowhere.bag does not exist"):
            RosbagDataset(tmp_path / "nowhere.bag")
        convert(measurements(), CALIBRATION, tmp_path / "flight.ros2")
        (tmp_path / "flight.ros2" / "metadata.yaml").unlink()
        assert RosbagDataset.accepts(tmp_path / "flight.ros2")
        with pytest.raises(DatasetError, match=r"metadata.*`ros2 bag reindex`") as caught:
            RosbagDataset(tmp_path / "flight.ros2")
        one_line(caught)
        assert not RosbagDataset.accepts(tmp_path)

    def test_no_camera_or_no_imu(self, tmp_path: Path) -> None:
        with pytest.raises(DatasetError, match=r"has no camera messages .*; its topics: /imu0") as caught:
            RosbagDataset(bag_with(tmp_path))
        one_line(caught)
        path = write_bag(tmp_path / "blind.bag", [image_message("/cam0/image_raw", T0_NS, IMAGE, "mono8")])
        with pytest.raises(DatasetError, match=r"has no IMU messages .*; its topics: /cam0/image_raw") as caught:
            RosbagDataset(path)
        one_line(caught)

    def test_stamps_are_those_of_the_headers(self, tmp_path: Path) -> None:
        """Images reach the recorder 30 ms late; what counts is when they were taken."""
        source = measurements()
        messages = [
            imu_message("/imu0", m, recorded_ns=m.t_ns + 1_000_000)
            if isinstance(m, ImuSample)
            else image_message("/cam0/image_raw", m.t_ns, image_of(m), "mono8", recorded_ns=m.t_ns + 30_000_000)
            for m in source
            if not isinstance(m, Unreadable)
        ]
        path = write_bag(tmp_path / "late.bag", messages)
        write_calibration(CALIBRATION, sidecar_folder(path))
        read = list(RosbagDataset(path).measurements())
        assert [m.t_ns for m in read] != sorted(m.t_ns for m in read)
        assert_equal(sorted(read, key=lambda m: m.t_ns), source)
        packets = list(synchronise(read, incidents=(incidents := Incidents())))
        assert len(packets) == 6
        assert not incidents.counts
        for (imu, _), (expected, _) in zip(packets, synchronise(source, incidents=Incidents()), strict=True):
            np.testing.assert_array_equal(imu.t_ns, expected.t_ns)
            np.testing.assert_array_equal(imu.accel_B, expected.accel_B)

    @pytest.mark.parametrize("padding", [0, 16])
    @pytest.mark.parametrize("encoding", ["mono8", "8UC1"])
    def test_gray_images_with_and_without_padding(self, tmp_path: Path, encoding: str, padding: int) -> None:
        path = bag_with(tmp_path, image_message("/cam0/image_raw", T0_NS, IMAGE, encoding, padding))
        np.testing.assert_array_equal(image_of(frames_of(RosbagDataset(path))[0]), IMAGE)

    @pytest.mark.parametrize("padding", [0, 16])
    @pytest.mark.parametrize(("encoding", "channels"), [("bgr8", 3), ("rgb8", 3), ("bgra8", 4), ("rgba8", 4)])
    def test_colour_images(self, tmp_path: Path, encoding: str, channels: int, padding: int) -> None:
        colour = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)
        path = bag_with(tmp_path, image_message("/camera/color", T0_NS, colour, encoding, padding))
        weights = np.array([0.299, 0.587, 0.114] if encoding.startswith("r") else [0.114, 0.587, 0.299])
        image = image_of(frames_of(RosbagDataset(path))[0])
        assert np.abs(image - colour[:, :, :3] @ weights).max() <= 0.51

    @pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_bggr8", "bayer_gbrg8", "bayer_grbg8"])
    def test_bayer_images(self, tmp_path: Path, encoding: str) -> None:
        """A pure red scene is equally dark everywhere once demosaicked, wherever its red pixels lie."""
        place = encoding.removeprefix("bayer_").removesuffix("8").index("r")
        mosaic = np.zeros((HEIGHT, WIDTH), np.uint8)
        mosaic[place // 2 :: 2, place % 2 :: 2] = 200
        path = bag_with(tmp_path, image_message("/camera/raw", T0_NS, mosaic, encoding))
        image = image_of(frames_of(RosbagDataset(path))[0])
        assert np.abs(image[4:-4, 4:-4] - 0.299 * 200).max() <= 1.0

    def test_compressed_images(self, tmp_path: Path) -> None:
        gray = compressed_message("/cam0/compressed", T0_NS, cv2.imencode(".png", IMAGE)[1].tobytes())
        colour = np.random.default_rng(4).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        messages = [
            gray,
            compressed_message("/cam0/compressed", T0_NS + 1, cv2.imencode(".png", colour)[1].tobytes()),
            compressed_message("/cam0/compressed", T0_NS + 2, cv2.imencode(".jpg", IMAGE)[1].tobytes()),
            compressed_message("/cam0/compressed", T0_NS + 3, cv2.imencode(".png", IMAGE)[1].tobytes()[:500]),
        ]
        dataset = RosbagDataset(bag_with(tmp_path, *messages))
        first, second, third = frames_of(dataset)
        np.testing.assert_array_equal(image_of(first), IMAGE)
        assert np.abs(image_of(second) - colour @ np.array([0.114, 0.587, 0.299])).max() <= 0.51
        assert image_of(third).shape == IMAGE.shape
        assert [m.t_ns for m in dataset.measurements() if isinstance(m, Unreadable)] == [T0_NS + 3]

    def test_16_bit_images_need_their_depth(self, tmp_path: Path) -> None:
        deep = np.random.default_rng(5).integers(0, 4096, (HEIGHT, WIDTH), dtype=np.uint16)
        path = bag_with(tmp_path, image_message("/cam0/image_raw", T0_NS, deep, "mono16", padding=6))
        with pytest.raises(
            DatasetError, match=r"image_raw\] has 16-bit images; say how many bits are in use, -o bit_depth"
        ):
            RosbagDataset(path)
        np.testing.assert_array_equal(image_of(frames_of(RosbagDataset(path, bit_depth=12))[0]), deep // 16)

    @pytest.mark.parametrize("encoding", ["32FC1", "8UC3", "unheard of"])
    def test_other_encodings_are_refused(self, tmp_path: Path, encoding: str) -> None:
        pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
        path = bag_with(tmp_path, image_message("/cam0/image_raw", T0_NS, pixels, encoding))
        with pytest.raises(DatasetError, match=r"is not supported; convert the images to mono8") as caught:
            RosbagDataset(path)
        one_line(caught)

    def test_images_with_missing_pixels_are_counted(self, tmp_path: Path) -> None:
        whole = [image_message("/cam0/image_raw", T0_NS + i, IMAGE, "mono8") for i in range(3)]
        whole[1].fields["data"] = whole[1].fields["data"][:-1]
        dataset = RosbagDataset(bag_with(tmp_path, *whole))
        assert [frame.t_ns for frame in frames_of(dataset)] == [T0_NS, T0_NS + 2]
        whole[0].fields["step"] = 1
        whole[2].fields["step"] = 1
        (tmp_path / "test.bag").unlink()
        with pytest.raises(DatasetError, match=r"no image of /cam0/image_raw can be read"):
            RosbagDataset(bag_with(tmp_path, *whole))

    def test_images_of_another_size_than_calibrated(self, tmp_path: Path) -> None:
        other = np.zeros((10, 20), np.uint8)
        path = bag_with(tmp_path, image_message("/cam0/image_raw", T0_NS, other, "mono8"))
        with pytest.raises(DatasetError, match=r"image_raw\] has images of 20x10, but the calibration is for 64x48"):
            RosbagDataset(path)

    def test_a_size_that_changes_on_the_way(self, tmp_path: Path) -> None:
        other = image_message("/cam0/image_raw", T0_NS + 9, np.zeros((10, 20), np.uint8), "mono8")
        path = bag_with(tmp_path, image_message("/cam0/image_raw", T0_NS, IMAGE, "mono8"), other)
        with pytest.raises(DatasetError, match=r"has images of 20x10"):
            list(RosbagDataset(path).measurements())

    def test_choice_of_topics(self, tmp_path: Path) -> None:
        images = {
            "/cam1/image_raw": IMAGE + 1,
            "/cam0/image_raw": IMAGE,
            "/stereo/right": IMAGE + 2,
        }
        png = cv2.imencode(".png", IMAGE + 3)[1].tobytes()
        path = bag_with(
            tmp_path,
            *(image_message(topic, T0_NS, image, "mono8") for topic, image in images.items()),
            compressed_message("/cam0/a_compressed", T0_NS, png),
            imu_message("/other_imu", ImuSample(T0_NS, np.zeros(3), np.zeros(3))),
            Message("/leica/position", "geometry_msgs/msg/PointStamped", T0_NS, {"point": _point()}),
        )

        def image(**options: str) -> np.ndarray:
            return image_of(frames_of(RosbagDataset(path, **options))[0])

        np.testing.assert_array_equal(image(), IMAGE)
        np.testing.assert_array_equal(image(cameras="/stereo/right"), IMAGE + 2)
        np.testing.assert_array_equal(image(cameras="/cam0/a_compressed"), IMAGE + 3)
        calibration = sidecar_folder(path)
        shutil.copytree(calibration / "cam0", calibration / "cam1")
        np.testing.assert_array_equal(image(cameras="cam1"), IMAGE + 1)
        np.testing.assert_array_equal(image(cameras="cam1:/stereo/right"), IMAGE + 2)
        for cameras, images in ((None, (IMAGE, IMAGE + 1)), (["cam1", "cam0"], (IMAGE + 1, IMAGE))):
            (frames,) = frames_of(RosbagDataset(path, cameras=cameras))
            np.testing.assert_array_equal(frames.images, images)
        with pytest.raises(CalibrationError, match=r"describes no camera '/stereo/right'; choose one of: cam0, cam1"):
            image(cameras="/stereo/right")
        samples = [m for m in RosbagDataset(path, imu_topic="/other_imu").measurements() if isinstance(m, ImuSample)]
        assert [m.t_ns for m in samples] == [T0_NS]
        with pytest.raises(DatasetError, match=r"no IMU messages on /imu9; its IMU topics: /imu0, /other_imu"):
            image(imu_topic="/imu9")
        with pytest.raises(DatasetError, match=r"no camera messages on /cam9; its camera topics: /cam0/image_raw, "):
            image(cameras="/cam9")
        with pytest.raises(DatasetError, match=r"no camera messages on /cam9; its camera topics: /cam0/image_raw, "):
            image(cameras="cam1:/cam9")
        assert RosbagDataset(path).ground_truth is None


def _point() -> object:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC).types["geometry_msgs/msg/Point"](x=1.0, y=2.0, z=3.0)


class TestBombs:
    """A few bytes that would expand to gigabytes: refused by the size that they declare, or when a bound is passed."""

    @staticmethod
    def png_bomb(side: int = 30_000) -> bytes:
        header = struct.pack(">IIBBBBB", side, side, 1, 0, 0, 0, 0)
        rows = zlib.compress(bytes(side * (side // 8 + 1)))
        chunks = ((b"IHDR", header), (b"IDAT", rows), (b"IEND", b""))
        sealed = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
        return b"\x89PNG\r\n\x1a\n" + b"".join(sealed)

    @pytest.mark.parametrize("side", [9_000, 12_000, 30_000])
    def test_an_image_in_a_folder(self, tmp_path: Path, side: int) -> None:
        convert(measurements(), CALIBRATION, tmp_path / "flight")
        first = min((tmp_path / "flight" / "mav0" / "cam0" / "data").iterdir())
        first.write_bytes(self.png_bomb(side))
        with pytest.raises(DatasetError, match=r"png says that it has more than 64 million pix") as caught:
            list(EurocDataset(tmp_path / "flight").measurements())
        one_line(caught)

    def test_an_image_in_a_bag(self, tmp_path: Path) -> None:
        path = bag_with(tmp_path, compressed_message("/cam0/image_raw", T0_NS, self.png_bomb(9_000)))
        with pytest.raises(DatasetError, match=r"test.bag.*\[/cam0/image_raw\] says that it has more than 64 million"):
            list(RosbagDataset(path).measurements())

    def test_an_image_file_of_no_image_s_size(self, tmp_path: Path) -> None:
        convert(measurements(), CALIBRATION, tmp_path / "flight")
        first = min((tmp_path / "flight" / "mav0" / "cam0" / "data").iterdir())
        with first.open("r+b") as file:
            file.truncate(1 << 40)  # it has holes, and takes no place
        unread, *_ = [m for m in EurocDataset(tmp_path / "flight").measurements() if isinstance(m, Unreadable)]
        assert "is larger than 256 MiB" in unread.detail

    @pytest.mark.parametrize(
        ("name", "compression"), [("a.bag", "bz2"), ("a.bag", "lz4"), ("a.ros2", "zstd"), ("a.mcap", "zstd")]
    )
    def test_a_chunk(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, compression: str) -> None:
        convert(measurements(), CALIBRATION, tmp_path / name, compression=compression)
        assert_equal(RosbagDataset(tmp_path / name).measurements(), measurements())
        monkeypatch.setattr("vioframe_rosbag._LARGEST_CHUNK", 100)
        with pytest.raises(DatasetError, match=rf"{name}: a chunk of the recording expands to more than") as caught:
            list(RosbagDataset(tmp_path / name).measurements())
        one_line(caught)

    def test_a_recording_compressed_as_a_whole(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        convert(measurements(), CALIBRATION, tmp_path / "a.ros2")
        database = tmp_path / "a.ros2" / "a.ros2.db3"
        database.with_suffix(".db3.zstd").write_bytes(zstd.compress(database.read_bytes()))
        database.unlink()
        metadata = tmp_path / "a.ros2" / "metadata.yaml"
        text = metadata.read_text().replace("a.ros2.db3", "a.ros2.db3.zstd")
        text = re.sub("compression_format: .*", "compression_format: zstd", text)
        metadata.write_text(re.sub("compression_mode: .*", "compression_mode: file", text))
        assert_equal(RosbagDataset(tmp_path / "a.ros2").measurements(), measurements())
        monkeypatch.setattr("vioframe_rosbag._LARGEST_CHUNK", 0)
        monkeypatch.setattr("vioframe_rosbag._MOST_EXPANSION", 1)
        with pytest.raises(DatasetError, match=r"a.ros2: the compressed recording expands more than 1-fold"):
            RosbagDataset(tmp_path / "a.ros2")


class TestCalibrationOfABag:
    def euroc_like(self, folder: Path, topic: str = "/cam0/image_raw", width: int = 752) -> Path:
        image = image_message(topic, T0_NS, np.zeros((480, width), np.uint8), "mono8")
        return bag_with(folder, image, calibrated=False)

    @pytest.mark.parametrize("camera", ["cam0", "cam1"])
    def test_a_bag_like_eurocs_gets_the_packaged_one_with_a_notice(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture, camera: str
    ) -> None:
        dataset = RosbagDataset(self.euroc_like(tmp_path, f"/{camera}/image_raw"))
        assert_same_rig(dataset.calibration, packaged_calibration("euroc", [camera]))
        (record,) = caplog.records
        assert (record.name, record.levelno) == ("vioframe.rosbag", logging.WARNING)
        assert "using EuRoC's published calibration" in record.getMessage()

    def test_topics_left_aside_are_named(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        images = [image_message(topic, T0_NS, IMAGE, "mono8") for topic in ("/cam0/image_raw", "/thermal/image")]
        other_imu = imu_message("/imu1", ImuSample(T0_NS, np.ones(3), np.ones(3)))
        path = bag_with(tmp_path, *images, other_imu)
        RosbagDataset(path, cameras="cam0", imu_topic="/imu0")
        assert not caplog.records
        RosbagDataset(path)
        assert [record.getMessage() for record in caplog.records] == [
            "test.bag: /cam0/image_raw and /imu0 are read, /thermal/image, /imu1 left aside; to choose: "
            "--cameras /thermal/image -o imu_topic=/imu1"
        ]

    def test_a_bare_sqlite_file_has_the_calibration_beside_its_folder(self, tmp_path: Path) -> None:
        convert(measurements(), CALIBRATION, tmp_path / "flight.ros2")
        assert_same_rig(RosbagDataset(tmp_path / "flight.ros2" / "flight.ros2.db3").calibration, CALIBRATION)

    def test_any_other_bag_needs_one(self, tmp_path: Path) -> None:
        for options in ({"topic": "/camera/image_raw"}, {"width": 640}):
            path = self.euroc_like(tmp_path, **options)
            with pytest.raises(
                DatasetError, match=r"brings no calibration: --calibration FILE names one, .* is where it is looked for"
            ) as caught:
                RosbagDataset(path)
            one_line(caught)
            path.unlink()

    def test_the_sidecar_comes_before_the_packaged_one_and_the_option_before_both(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture
    ) -> None:
        path = self.euroc_like(tmp_path)
        for folder, fx in ((sidecar_folder(path), "500.0"), (tmp_path / "option", "600.0")):
            write_calibration(packaged_calibration("euroc"), folder)
            sensor = folder / "cam0" / "sensor.yaml"
            sensor.write_text(sensor.read_text().replace("458.654", fx))
        assert RosbagDataset(path).calibration.cameras[0].model.fx == 500.0
        assert RosbagDataset(path, calibration=tmp_path / "option").calibration.cameras[0].model.fx == 600.0
        files = [tmp_path / "option" / "cam0" / "sensor.yaml", tmp_path / "option" / "imu0" / "sensor.yaml"]
        assert RosbagDataset(path, calibration=files).calibration.cameras[0].model.fx == 600.0
        assert not caplog.records


class TestSeveralCameras:
    @pytest.fixture(params=["pair", "pair.bag"])
    def pair(self, request: pytest.FixtureRequest, tmp_path: Path) -> Path:
        convert(pair_measurements(), PAIR, tmp_path / request.param)
        return tmp_path / request.param

    def open(self, path: Path, **options: object) -> Dataset:
        return (EurocDataset if path.is_dir() else RosbagDataset)(path, **options)

    def test_all_come_by_default_in_the_order_of_their_names(self, pair: Path) -> None:
        """Together, apart, and while the second is silent."""
        dataset = self.open(pair)
        assert_same_rig(dataset.calibration, PAIR)
        assert_equal(dataset.measurements(), pair_measurements())
        assert dataset.frame_count == (8 if pair.is_dir() else None)

    def test_some_are_chosen_in_the_order_wanted(self, pair: Path) -> None:
        dataset = self.open(pair, cameras=["cam1", "cam0"])
        assert [camera.name for camera in dataset.calibration.cameras] == ["cam1", "cam0"]
        expected = [FrameSet(m.t_ns, m.images[::-1]) if isinstance(m, FrameSet) else m for m in pair_measurements()]
        assert_equal(dataset.measurements(), expected)
        alone = self.open(pair, cameras="cam0")
        assert alone.frame_count == 6
        assert_equal(alone.measurements(), measurements())

    def test_an_image_that_cannot_be_read_takes_none_of_the_others_with_it(self, tmp_path: Path) -> None:
        convert(pair_measurements(), PAIR, tmp_path / "pair")
        first = sorted((tmp_path / "pair" / "mav0" / "cam1" / "data").iterdir())[0]
        first.write_bytes(b"")
        read = list(EurocDataset(tmp_path / "pair").measurements())
        (lost,) = [m for m in read if isinstance(m, Unreadable)]
        frames = next(m for m in read if isinstance(m, FrameSet))
        assert (lost.t_ns, lost.kind, frames.t_ns) == (int(first.stem), "frame_unreadable", lost.t_ns)
        assert frames.images[0] is not None
        assert frames.images[1] is None

    def test_a_camera_without_images_or_calibration_is_left_out_unless_asked_for(self, tmp_path: Path) -> None:
        convert(pair_measurements(), PAIR, tmp_path / "pair")
        mav0 = tmp_path / "pair" / "mav0"
        shutil.copytree(mav0 / "cam1", mav0 / "cam2")
        (mav0 / "cam2" / "sensor.yaml").unlink()
        (mav0 / "cam1" / "data.csv").write_text("#timestamp [ns],filename\n")
        assert [camera.name for camera in EurocDataset(tmp_path / "pair").calibration.cameras] == ["cam0"]
        with pytest.raises(DatasetError, match=r"cam1/data.csv lists no image"):
            EurocDataset(tmp_path / "pair", cameras=["cam0", "cam1"])
        with pytest.raises(CalibrationError, match=r"cam2/sensor.yaml: No such file"):
            EurocDataset(tmp_path / "pair", cameras="cam2")

    def test_messages_of_one_stamp_are_gathered_in_whatever_order_they_come(self, tmp_path: Path) -> None:
        """Readings between them, the second camera first or two frames late; and what is repeated stays apart."""
        second = IMAGE[:24, :32]

        def left(stamp: int, at: int) -> Message:
            return image_message("/cam0/image_raw", T0_NS + stamp, IMAGE, "mono8", recorded_ns=T0_NS + at)

        def right(stamp: int, at: int) -> Message:
            return image_message("/cam1/image_raw", T0_NS + stamp, second, "mono8", recorded_ns=T0_NS + at)

        def imu(stamp: int) -> Message:
            return imu_message("/imu0", ImuSample(T0_NS + stamp, np.ones(3), np.ones(3)))

        messages = [
            left(1, 1),
            imu(2),
            right(1, 3),
            imu(4),
            right(5, 5),
            left(5, 6),
            left(7, 7),
            left(8, 8),
            left(9, 9),
        ]
        messages += [imu(10), right(7, 11), right(8, 12), right(9, 13), right(9, 14), imu(15)]
        path = write_bag(tmp_path / "test.bag", messages)
        write_calibration(PAIR, sidecar_folder(path))
        read = [
            (m.t_ns - T0_NS, *(image is not None for image in m.images)) if isinstance(m, FrameSet) else m.t_ns - T0_NS
            for m in RosbagDataset(path).measurements()
        ]
        both = (True, True)
        sets = [(1, *both), 2, 4, (5, *both), (7, *both), (8, *both), (9, *both), 10, (9, False, True), 15]
        assert read == sets

    def test_a_silent_camera_holds_up_a_bounded_number_of_measurements(self) -> None:
        """What comes long after the first image of its stamp is a set of its own."""
        taken = 0

        def endless() -> Iterator[Measurement]:
            nonlocal taken
            for taken in count():
                images = (IMAGE, None) if taken % 5 == 0 else None
                yield FrameSet(taken, images) if images else ImuSample(taken, np.zeros(3), np.zeros(3))

        read = gathered(endless())
        for expected in range(1000):
            assert next(read).t_ns == expected
            assert taken - expected < 200
        late = [FrameSet(0, (IMAGE, None)), *(ImuSample(1 + i, np.zeros(3), np.zeros(3)) for i in range(200))]
        assert [m.t_ns for m in gathered([*late, FrameSet(0, (None, IMAGE))])] == [*range(201), 0]


class TestArrays:
    def arrays(self) -> dict[str, object]:
        source = measurements()
        imu = [m for m in source if isinstance(m, ImuSample)]
        frames = [m for m in source if isinstance(m, FrameSet)]
        return {
            "imu_t_ns": np.array([m.t_ns for m in imu]),
            "gyro_B": np.array([m.gyro_B for m in imu]),
            "accel_B": np.array([m.accel_B for m in imu]),
            "frame_t_ns": np.array([m.t_ns for m in frames]),
            "images": np.array([image_of(m) for m in frames]),
        }

    def test_what_goes_in_comes_out(self) -> None:
        arrays = self.arrays()
        for images in (arrays["images"], list(arrays["images"]), {"cam0": arrays["images"]}):
            dataset = ArrayDataset(CALIBRATION, **(arrays | {"images": images}), name="mine")
            assert isinstance(dataset, Dataset)
            assert (dataset.name, dataset.frame_count, dataset.ground_truth) == ("mine", 6, None)
            assert_equal(dataset.measurements(), measurements())
            assert_equal(dataset.measurements(), measurements())
        assert arrays["images"].flags.writeable  # the caller's own is left as it is

    def test_several_cameras_and_conversion_with_the_truth(self, tmp_path: Path) -> None:
        source = [m for m in pair_measurements() if isinstance(m, FrameSet)]
        frames = {
            "frame_t_ns": [m.t_ns for m in source],
            "images": {name: [m.images[place] for m in source] for place, name in enumerate(("cam0", "cam1"))},
        }
        dataset = ArrayDataset(PAIR, **(self.arrays() | frames), ground_truth=true_trajectory())
        assert_equal(dataset.measurements(), pair_measurements())
        convert(dataset.measurements(), dataset.calibration, tmp_path / "a.bag", truth=dataset.ground_truth)
        assert_equal(RosbagDataset(tmp_path / "a.bag").measurements(), pair_measurements())

    def test_the_example_of_the_documentation(self) -> None:
        page = Path(__file__).parents[1] / "docs" / "data.md"
        examples = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
        (example,) = (each for each in examples if "ArrayDataset" in each)
        defined: dict[str, Any] = {}
        exec(example, defined)
        assert len(list(synchronise(defined["dataset"].measurements(), incidents=Incidents()))) == 198

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("imu_t_ns", lambda t: t * 1e-9, r"imu_t_ns must be \(N,\) integer nanoseconds, got \(71,\) float64"),
            ("imu_t_ns", lambda t: t[::-1], r"imu_t_ns must increase, but \d+ \(place 1\) follows"),
            ("imu_t_ns", lambda t: t[:0], r"imu_t_ns must be \(N,\)"),
            ("frame_t_ns", lambda t: t // 10**9, r"frame_t_ns must increase"),
            ("frame_t_ns", lambda t: t[1:], r"there are 6 images of cam0 for 5 stamps"),
            ("gyro_B", lambda w: w.T, r"gyro_B must be \(71, 3\) to match imu_t_ns, got \(3, 71\)"),
            ("accel_B", lambda a: a[:-1], r"accel_B must be \(71, 3\)"),
            ("images", lambda i: i.astype(float), r"images of cam0 must be \(H, W\) uint8, got \(48, 64\) float64"),
            ("images", lambda i: i[..., None], r"images of cam0 must be \(H, W\) uint8"),
            ("images", lambda i: i[:, ::2], r"images of cam0 must be of the calibrated size 64x48, got 64x24"),
            ("images", lambda i: {"cam1": i}, r"images are given for \['cam1'\], but the cameras are \['cam0'\]"),
            ("images", lambda i: [None, *i[1:]], r"no camera has an image at \d+ ns \(place 0 of frame_t_ns\)"),
        ],
    )
    def test_what_does_not_fit_is_said(self, name: str, change: Callable[[Any], Any], message: str) -> None:
        arrays = self.arrays()
        with pytest.raises(DatasetError, match=message) as caught:
            ArrayDataset(CALIBRATION, **(arrays | {name: change(arrays[name])}))
        one_line(caught)


class TestConformance:
    @pytest.mark.parametrize(("reader", "name"), [(EurocDataset, "pair"), (RosbagDataset, "pair.mcap")])
    def test_the_built_in_readers_conform(self, tmp_path: Path, reader: type[Dataset], name: str) -> None:
        convert(pair_measurements(), PAIR, tmp_path / name, truth=true_trajectory())
        check_dataset(reader, tmp_path / name)
        check_dataset(reader, tmp_path / name, cameras=["cam1"])

    @pytest.mark.parametrize(
        ("spoil", "message"),
        [
            (lambda images: images[:1], "a frame set has 1 places, the calibration 2 cameras"),
            (lambda images: list(images), "the images of a frame set are a list, not a tuple"),
            (lambda images: (None, None), "a frame set holds no image"),
            (lambda images: (images[0], images[0]), r"an image of cam1 is \(64, 48\), the calibration for \(32, 24\)"),
            (lambda images: (images[0].copy(), images[1]), "an image of cam0 is writeable"),
            (lambda images: (images[0], images[1] * 1.0), r"an image of cam1 is \(24, 32\) float64"),
        ],
    )
    def test_a_reader_that_breaks_a_promise_is_found_out(
        self, tmp_path: Path, spoil: Callable[[Any], Any], message: str
    ) -> None:
        class Spoilt(EurocDataset):
            def measurements(self) -> Iterator[Measurement]:
                for m in super().measurements():
                    yield FrameSet(m.t_ns, spoil(m.images)) if isinstance(m, FrameSet) else m

        convert(pair_measurements(alone=()), PAIR, tmp_path / "pair")
        with pytest.raises(AssertionError, match=message):
            check_dataset(Spoilt, tmp_path / "pair")


def test_the_real_recordings(shared_data: Path) -> None:
    moving = EurocDataset(shared_data / "euroc" / "MH_01_easy_15s", cameras="cam0")
    assert (moving.name, moving.frame_count) == ("MH_01_easy_15s", 300)
    assert incidents_of(moving) == {}
    truth = moving.ground_truth
    assert truth is not None
    assert len(truth.t_ns) == 3111
    resting = EurocDataset(shared_data / "euroc" / "V1_01_easy_rest" / "mav0")
    packets = list(synchronise(resting.measurements(), incidents=Incidents()))
    assert len(packets) == resting.frame_count == 95
    imu, frame = packets[-1]
    assert image_of(frame).shape == (480, 752)
    # Every frame of EuRoC falls on an IMU sample: eleven stamps, both ends included.
    assert len(imu.t_ns) == 11
    assert np.linalg.norm(imu.accel_B.mean(axis=0)) == pytest.approx(9.81, abs=0.2)
