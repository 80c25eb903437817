"""The converter: round trips are exact, and nothing half-written ever stands under the name asked for."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from recordings import CALIBRATION, T0_NS, assert_equal, measurements

from vioframe.cli import main
from vioframe.errors import DatasetError
from vioframe.interfaces import Dataset
from vioframe.io.convert import Conversion, convert, format_of
from vioframe.types import Frame, ImuSample, Measurement, Unreadable
from vioframe_euroc import EurocDataset
from vioframe_rosbag import RosbagDataset


def read(path: Path) -> Dataset:
    return EurocDataset(path) if EurocDataset.accepts(path) else RosbagDataset(path)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["convert", *map(str, arguments)])


def visible(folder: Path) -> set[str]:
    """All that lies in ``folder``, hidden files included."""
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("end", ["end", "end.bag", "end.ros2", "end.mcap"])
@pytest.mark.parametrize("start", ["start", "start.bag", "start.ros2", "start.mcap"])
def test_round_trips_are_exact(tmp_path: Path, start: str, end: str) -> None:
    counts = convert(measurements(), CALIBRATION, tmp_path / start)
    assert counts == Conversion(frames=6, imu_samples=71, unreadable=0)
    source = read(tmp_path / start)
    assert convert(source.measurements(), source.calibration, tmp_path / end) == counts
    result = read(tmp_path / end)
    assert_equal(result.measurements(), measurements())
    assert result.calibration.camera == CALIBRATION.camera
    assert result.calibration.imu == CALIBRATION.imu
    assert result.calibration.time_offset_ns == CALIBRATION.time_offset_ns
    np.testing.assert_array_equal(result.calibration.R_BC, CALIBRATION.R_BC)
    np.testing.assert_array_equal(result.calibration.p_BC, CALIBRATION.p_BC)


@pytest.mark.parametrize("name", ["odd", "odd.bag", "odd.ros2", "odd.mcap"])
def test_what_is_irregular_is_kept_as_it_is(tmp_path: Path, name: str) -> None:
    """Order, repetitions and readings that are not finite are for synchronisation to judge, not for the converter."""
    source = measurements()
    source[20], source[21] = source[21], source[20]
    source.insert(30, source[30])
    source.insert(40, ImuSample(source[40].t_ns, np.array([np.nan, np.inf, -np.inf]), np.array([0.1, 1e300, 5e-324])))
    convert(source, CALIBRATION, tmp_path / name)
    result = list(read(tmp_path / name).measurements())
    imu = [m for m in source if isinstance(m, ImuSample)]
    frames = [m for m in source if isinstance(m, Frame)]
    assert_equal([m for m in result if isinstance(m, ImuSample)], imu)
    assert_equal([m for m in result if isinstance(m, Frame)], frames)


def test_the_layout_is_eurocs(tmp_path: Path) -> None:
    """Checked without our readers: by the bag's own topics and types, and by OpenCV."""
    from rosbags.highlevel import AnyReader

    convert(measurements(), CALIBRATION, tmp_path / "flight.bag")
    convert(measurements(), CALIBRATION, tmp_path / "flight")
    sample, frame = measurements()[0], next(m for m in measurements() if isinstance(m, Frame))
    assert isinstance(sample, ImuSample)
    with AnyReader([tmp_path / "flight.bag"]) as reader:
        assert {topic: info.msgtype for topic, info in reader.topics.items()} == {
            "/cam0/image_raw": "sensor_msgs/msg/Image",
            "/imu0": "sensor_msgs/msg/Imu",
        }
        first = {}
        for connection, recorded_ns, data in reader.messages():
            first.setdefault(connection.topic, (recorded_ns, reader.deserialize(data, connection.msgtype)))
    recorded_ns, image = first["/cam0/image_raw"]
    assert recorded_ns == frame.t_ns == image.header.stamp.sec * 10**9 + image.header.stamp.nanosec
    assert (image.encoding, image.height, image.width, image.step) == ("mono8", 48, 64, 64)
    np.testing.assert_array_equal(image.data.reshape(48, 64), frame.image)
    recorded_ns, imu = first["/imu0"]
    assert recorded_ns == T0_NS == imu.header.stamp.sec * 10**9 + imu.header.stamp.nanosec
    assert [imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z] == sample.gyro_B.tolist()
    assert [imu.linear_acceleration.x, imu.linear_acceleration.z] == sample.accel_B[[0, 2]].tolist()
    mav0 = tmp_path / "flight" / "mav0"
    png = cv2.imread(str(mav0 / "cam0" / "data" / f"{frame.t_ns}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(png, frame.image)
    assert (mav0 / "cam0" / "data.csv").read_text().splitlines()[1] == f"{frame.t_ns},{frame.t_ns}.png"
    row = (mav0 / "imu0" / "data.csv").read_text().splitlines()[1].split(",")
    assert int(row[0]) == T0_NS
    assert [float(value) for value in row[1:]] == [*sample.gyro_B.tolist(), *sample.accel_B.tolist()]


@pytest.mark.parametrize(
    ("name", "format"),
    [("a.bag", "ros1"), ("a.mcap", "mcap"), ("a.ros2", "ros2"), ("rosbag2_2024_01_02", "ros2"), ("MH_01_easy", "asl")],
)
def test_the_name_tells_the_format(name: str, format: str) -> None:
    assert format_of(Path("some.where") / name) == format


@pytest.mark.parametrize("name", ["a.zip", "a.db3", "MH.01"])
def test_a_name_that_tells_no_format_is_an_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(DatasetError, match=rf"the name {name} tells no format; use NAME.bag .*, or state the format"):
        convert(measurements(), CALIBRATION, tmp_path / name)
    convert(measurements(), CALIBRATION, tmp_path / name, format="asl")
    assert_equal(EurocDataset(tmp_path / name).measurements(), measurements())


def test_compression_must_be_one_of_the_format(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"ros1 offers no compression 'zstd'; it has: bz2, lz4"):
        convert(measurements(), CALIBRATION, tmp_path / "a.bag", compression="zstd")
    with pytest.raises(DatasetError, match=r"asl offers no compression 'lz4'; it has: none"):
        convert(measurements(), CALIBRATION, tmp_path / "a", compression="lz4")
    with pytest.raises(DatasetError, match=r"no format 'tar'; choose one of: asl, ros1, ros2, mcap"):
        convert(measurements(), CALIBRATION, tmp_path / "a", format="tar")
    assert visible(tmp_path) == set()


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_compression_makes_a_smaller_bag(tmp_path: Path, compression: str) -> None:
    flat = [Frame(m.t_ns, m.image // 255) if isinstance(m, Frame) else m for m in measurements()]
    convert(flat, CALIBRATION, tmp_path / "plain.bag")
    convert(flat, CALIBRATION, tmp_path / "small.bag", compression=compression)
    assert (tmp_path / "small.bag").stat().st_size < 0.8 * (tmp_path / "plain.bag").stat().st_size
    assert_equal(RosbagDataset(tmp_path / "small.bag").measurements(), flat)


@pytest.mark.parametrize("name", ["half", "half.bag", "half.ros2", "half.mcap"])
@pytest.mark.parametrize("error", [DatasetError("the source is damaged"), KeyboardInterrupt()])
def test_a_conversion_that_fails_leaves_nothing(tmp_path: Path, name: str, error: BaseException) -> None:
    def failing() -> Iterator[Measurement]:
        for measurement in measurements()[:50]:
            # What there is so far has another name.
            assert not (tmp_path / name).exists()
            yield measurement
        raise error

    with pytest.raises(type(error)):
        convert(failing(), CALIBRATION, tmp_path / name)
    assert visible(tmp_path) == set()


def test_remains_of_a_killed_conversion_do_not_matter(tmp_path: Path) -> None:
    remains = tmp_path / ".a.bag.unfinished"
    remains.mkdir()
    (remains / "a.bag").write_text("half of something")
    convert(measurements(), CALIBRATION, tmp_path / "a.bag")
    assert visible(tmp_path) == {"a.bag", "a.bag.calib"}
    assert_equal(RosbagDataset(tmp_path / "a.bag").measurements(), measurements())


@pytest.mark.parametrize("name", ["there", "there.bag"])
def test_what_exists_is_not_overwritten(tmp_path: Path, name: str) -> None:
    convert(measurements(), CALIBRATION, tmp_path / name)
    before = visible(tmp_path)
    with pytest.raises(DatasetError, match=rf"{name} exists already; remove it or choose another name"):
        convert(measurements(seed=1), CALIBRATION, tmp_path / name)
    assert_equal(read(tmp_path / name).measurements(), measurements())
    assert visible(tmp_path) == before


def test_a_stale_calibration_beside_the_destination_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.bag.calib" / "cam3").mkdir(parents=True)
    (tmp_path / "a.bag.calib" / "cam3" / "sensor.yaml").write_text("sensor_type: camera")
    convert(measurements(), CALIBRATION, tmp_path / "a.bag")
    assert visible(tmp_path / "a.bag.calib") == {"cam0", "imu0"}


def test_a_source_without_frames_or_imu_is_an_error(tmp_path: Path) -> None:
    for kind in (Frame, ImuSample):
        with pytest.raises(DatasetError, match="no readable frame or no IMU sample"):
            convert([m for m in measurements() if isinstance(m, kind)], CALIBRATION, tmp_path / "a.bag")
    assert visible(tmp_path) == set()


@pytest.mark.parametrize("t_ns", [-1, 2**31 * 10**9])
@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_stamps_that_no_ros_message_can_hold(tmp_path: Path, name: str, t_ns: int) -> None:
    source = [*measurements(), ImuSample(t_ns, np.zeros(3), np.zeros(3))]
    with pytest.raises(DatasetError, match=rf"the stamp {t_ns} ns does not fit a ROS message"):
        convert(source, CALIBRATION, tmp_path / name)
    assert visible(tmp_path) == set()


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match=r"cannot write .*a.bag: Not a directory"):
        convert(measurements(), CALIBRATION, tmp_path / "file" / "a.bag")


def test_command_line(tmp_path: Path) -> None:
    convert(measurements(), CALIBRATION, tmp_path / "flight")
    damaged = next((tmp_path / "flight" / "mav0" / "cam0" / "data").iterdir())
    damaged.write_bytes(damaged.read_bytes()[:100])
    bag = tmp_path / "deep" / "down" / "flight.bag"
    result = run(tmp_path / "flight", bag, "--compression", "lz4")
    assert result.exit_code == 0, result.output
    assert f"{bag}: ROS 1 bag, 5 frames, 71 IMU samples" in result.output
    assert "left out: 1 frames or samples" in result.output
    expected = [m for m in EurocDataset(tmp_path / "flight").measurements() if not isinstance(m, Unreadable)]
    assert_equal(RosbagDataset(bag).measurements(), expected)
    # A bag whose calibration is elsewhere, and a reader's option.
    (bag.with_name("flight.bag.calib")).rename(tmp_path / "calib")
    assert "brings no calibration" in run(bag, tmp_path / "again").output
    result = run(bag, tmp_path / "again", "--calibration", tmp_path / "calib", "-o", "imu_topic=/imu0")
    assert result.exit_code == 0, result.output
    assert_equal(EurocDataset(tmp_path / "again").measurements(), expected)


def test_command_line_mistakes_are_one_line_with_exit_code_2(tmp_path: Path) -> None:
    convert(measurements(), CALIBRATION, tmp_path / "flight")
    source = tmp_path / "flight"
    for arguments, message in (
        ((tmp_path / "nowhere", tmp_path / "a.bag"), "nowhere does not exist"),
        ((source, tmp_path / "a.zip"), "tells no format"),
        ((source, source), "exists already"),
        ((source, tmp_path / "a.bag", "-o", "kamera=cam1"), "no option 'kamera'"),
        ((source, tmp_path / "a.bag", "-o", "camera"), "-o takes key=value, got 'camera'"),
        ((source, tmp_path / "a.bag", "--compression", "zstd"), "ros1 offers no compression 'zstd'"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2
        (line,) = [line for line in result.output.splitlines() if line.startswith("vioframe: error:")]
        assert message in line
        assert "Traceback" not in result.output
    assert visible(tmp_path) == {"flight"}


def test_a_real_recording(shared_data: Path, tmp_path: Path) -> None:
    source = EurocDataset(shared_data / "euroc" / "V1_01_easy_rest")
    counts = convert(source.measurements(), source.calibration, tmp_path / "rest.bag")
    assert counts == Conversion(frames=95, imu_samples=29120, unreadable=0)
    bag = RosbagDataset(tmp_path / "rest.bag")
    assert_equal(bag.measurements(), source.measurements())
    assert bag.calibration.camera == source.calibration.camera
    np.testing.assert_allclose(bag.calibration.R_BC, source.calibration.R_BC, rtol=0.0, atol=1e-15)
