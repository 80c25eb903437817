"""The converter: round trips are exact, and nothing half-written ever stands under the name asked for."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner, Result
from recordings import (
    CALIBRATION,
    PAIR,
    T0_NS,
    assert_equal,
    assert_same_rig,
    measurements,
    pair_measurements,
    true_trajectory,
)

from vioframe.cli import main
from vioframe.errors import DatasetError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Dataset
from vioframe.io.convert import Conversion, convert, format_of
from vioframe.io.trajectories import TrueTrajectory
from vioframe.types import FrameSet, ImuSample, Measurement, Unreadable
from vioframe_euroc import EurocDataset
from vioframe_rosbag import RosbagDataset


def read(path: Path) -> Dataset:
    return EurocDataset(path) if EurocDataset.accepts(path) else RosbagDataset(path)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["convert", *map(str, arguments)])


def visible(folder: Path) -> set[str]:
    """All that lies in ``folder``, hidden files included."""
    return {path.name for path in folder.iterdir()}


def again(source: Dataset, destination: Path) -> Dataset:
    """What is read of ``source`` converted."""
    convert(source.measurements(), source.calibration, destination, truth=source.ground_truth)
    return read(destination)


def assert_same_truth(actual: object, expected: object) -> None:
    """Equal to the last bit."""
    assert isinstance(actual, TrueTrajectory)
    assert isinstance(expected, TrueTrajectory)
    np.testing.assert_array_equal(actual.t_ns, expected.t_ns)
    np.testing.assert_array_equal(actual.values, expected.values)
    np.testing.assert_array_equal(actual.R_WB, expected.R_WB)


@pytest.mark.parametrize("end", ["end", "end.bag", "end.ros2", "end.mcap"])
@pytest.mark.parametrize("start", ["start", "start.bag", "start.ros2", "start.mcap"])
def test_round_trips_are_exact(tmp_path: Path, start: str, end: str) -> None:
    counts = convert(measurements(), CALIBRATION, tmp_path / start)
    assert counts == Conversion(frames=6, imu_samples=71, true_poses=0, unreadable=0)
    result = again(read(tmp_path / start), tmp_path / end)
    assert_equal(result.measurements(), measurements())
    assert_same_rig(result.calibration, CALIBRATION)
    assert result.ground_truth is None


@pytest.mark.parametrize("columns", [7, 10, 16])
def test_every_camera_and_the_truth_go_all_the_way_round(tmp_path: Path, columns: int) -> None:
    """ASL, ROS 1, ROS 2, MCAP and back: images together and apart, a camera that falls silent, velocity and biases."""
    source, truth = pair_measurements(), true_trajectory(columns)
    counts = convert(source, PAIR, tmp_path / "start", truth=truth)
    assert counts == Conversion(frames=8, imu_samples=71, true_poses=40, unreadable=0)
    result = read(tmp_path / "start")
    for name in ("a.bag", "a.ros2", "a.mcap", "end"):
        result = again(result, tmp_path / name)
        assert_equal(result.measurements(), source)
        assert_same_rig(result.calibration, PAIR)
        assert_same_truth(result.ground_truth, truth)
    truth_csv = "mav0/state_groundtruth_estimate0/data.csv"
    assert (tmp_path / "end" / truth_csv).read_text() == (tmp_path / "start" / truth_csv).read_text()
    assert len((tmp_path / "end" / truth_csv).read_text().splitlines()[0].split(",")) == 1 + columns


def test_a_truth_without_more_than_poses_is_written_too(tmp_path: Path) -> None:
    truth = Trajectory(T0_NS + np.arange(3), np.tile(so3.exp([0.1, 0.2, 0.3]), (3, 1, 1)), np.ones((3, 3)))
    for name in ("a", "a.bag"):
        convert(measurements(), CALIBRATION, tmp_path / name, truth=truth)
        back = read(tmp_path / name).ground_truth
        assert back is not None
        np.testing.assert_array_equal(back.t_ns, truth.t_ns)
        np.testing.assert_allclose(back.R_WB, truth.R_WB, rtol=0.0, atol=1e-15)


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
    frames = [m for m in source if isinstance(m, FrameSet)]
    assert_equal([m for m in result if isinstance(m, ImuSample)], imu)
    assert_equal([m for m in result if isinstance(m, FrameSet)], frames)


def test_the_layout_is_eurocs(tmp_path: Path) -> None:
    """Checked without our readers: by the bag's own topics and types, and by OpenCV."""
    from rosbags.highlevel import AnyReader

    convert(measurements(), CALIBRATION, tmp_path / "flight.bag")
    convert(measurements(), CALIBRATION, tmp_path / "flight")
    sample, frame = measurements()[0], next(m for m in measurements() if isinstance(m, FrameSet))
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
    np.testing.assert_array_equal(image.data.reshape(48, 64), frame.images[0])
    recorded_ns, imu = first["/imu0"]
    assert recorded_ns == T0_NS == imu.header.stamp.sec * 10**9 + imu.header.stamp.nanosec
    assert [imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z] == sample.gyro_B.tolist()
    assert [imu.linear_acceleration.x, imu.linear_acceleration.z] == sample.accel_B[[0, 2]].tolist()
    mav0 = tmp_path / "flight" / "mav0"
    png = cv2.imread(str(mav0 / "cam0" / "data" / f"{frame.t_ns}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(png, frame.images[0])
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


def flattened(frames: FrameSet) -> np.ndarray:
    (image,) = frames.images
    assert image is not None
    return image // 255


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_compression_makes_a_smaller_bag(tmp_path: Path, compression: str) -> None:
    flat = [FrameSet(m.t_ns, (flattened(m),)) if isinstance(m, FrameSet) else m for m in measurements()]
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
    for kind in (FrameSet, ImuSample):
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
    assert f"{bag}: ROS 1 bag, 5 frames, 71 IMU samples, no true poses" in result.output
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
        ((source, tmp_path / "a.bag", "-o", "kamera=cam1"), "-o kamera: no part has such an option"),
        ((source, tmp_path / "a.bag", "-o", "camera"), "-o takes key=value, got 'camera'"),
        ((source, tmp_path / "a.bag", "--compression", "zstd"), "ros1 offers no compression 'zstd'"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2
        (line,) = [line for line in result.output.splitlines() if line.startswith("vioframe: error:")]
        assert message in line
        assert "Traceback" not in result.output
    assert visible(tmp_path) == {"flight"}


def test_command_line_with_several_cameras(tmp_path: Path) -> None:
    convert(pair_measurements(), PAIR, tmp_path / "flight.bag", truth=true_trajectory())
    result = run(tmp_path / "flight.bag", tmp_path / "both")
    assert result.exit_code == 0, result.output
    assert "ASL folder, as EuRoC's, 8 frames of 2 cameras, 71 IMU samples, 40 true poses" in result.output
    assert_equal(read(tmp_path / "both").measurements(), pair_measurements())
    both = {"cam0", "cam1", "imu0", "state_groundtruth_estimate0"}
    for name, option, value, expected in (
        ("listed", "-o", "cameras=[cam0,cam1]", both),
        ("one", "-o", "cameras=cam1", both - {"cam0"}),
        ("named", "--cameras", "cam1,cam0", both),
        ("topics", "--cameras", "cam0:/cam0/image_raw,cam1", both),
        ("second", "--cameras", "cam1", both - {"cam0"}),
    ):
        assert run(tmp_path / "flight.bag", tmp_path / name, option, value).exit_code == 0
        assert visible(tmp_path / name / "mav0") == expected


@pytest.mark.parametrize("source", ["flight.bag", "flight"])
@pytest.mark.parametrize("command", ["run", "check", "convert"])
def test_a_camera_that_is_not_there_is_one_line_with_those_that_are(tmp_path: Path, source: str, command: str) -> None:
    convert(pair_measurements(), PAIR, tmp_path / source)
    more = [tmp_path / "copy"] if command == "convert" else []
    for wanted, problem in (("cam0,cam9", "cam9"), ("cam0,,cam1", "cam0,cam1, each once"), ("cam1,cam1", "each once")):
        words = [command, tmp_path / source, *more, "--cameras", wanted, "--quiet"]
        result = CliRunner().invoke(main, [str(word) for word in words])
        assert result.exit_code == 2
        line = next(line for line in result.output.splitlines() if "rror" in line)
        assert problem in line
        assert "cam0" in line
        assert "cam1" in line
        assert "Traceback" not in result.output
    assert visible(tmp_path) <= {source, f"{source}.calib"}


@pytest.mark.parametrize(("begun", "found"), [("", ["cam0", "cam1"]), ("cam1,", ["cam1,cam0"]), ("x", [])])
def test_the_shell_completes_the_cameras_of_the_recording(tmp_path: Path, begun: str, found: list[str]) -> None:
    convert(pair_measurements(), PAIR, tmp_path / "flight")
    words = f"vioframe run {tmp_path / 'flight'} --cameras {begun}"
    asked = {"COMP_WORDS": words, "COMP_CWORD": "4", "_VIOFRAME_COMPLETE": "bash_complete"}
    result = CliRunner().invoke(main, env=asked, prog_name="vioframe")
    assert [line.partition(",")[2] for line in result.output.split()] == found


def test_a_real_recording(shared_data: Path, tmp_path: Path) -> None:
    """Two cameras, of which the second ends after two thirds of the flight, and EuRoC's truth."""
    source = EurocDataset(shared_data / "euroc" / "MH_01_easy_15s")
    result: Dataset = source
    for name in ("flight.bag", "flight.ros2", "flight.mcap", "flight"):
        result = again(result, tmp_path / name)
    assert isinstance(result, EurocDataset)
    assert result.frame_count == source.frame_count == 300
    assert [camera.name for camera in result.calibration.cameras] == ["cam0", "cam1"]
    assert_same_rig(result.calibration, source.calibration)
    assert_same_truth(result.ground_truth, source.ground_truth)
    measured = list(result.measurements())
    assert_equal(measured, source.measurements())
    complete = [all(image is not None for image in m.images) for m in measured if isinstance(m, FrameSet)]
    assert complete == [True] * 200 + [False] * 100
    # Number for number as the files that it began with.
    for file in ("imu0/data.csv", "state_groundtruth_estimate0/data.csv"):
        first, last = (
            np.loadtxt(folder / "mav0" / file, delimiter=",")
            for folder in (shared_data / "euroc" / "MH_01_easy_15s", tmp_path / "flight")
        )
        np.testing.assert_array_equal(first, last)
