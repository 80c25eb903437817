"""Topics of ROS 2 by way of Zenoh: keys, messages and calibration, and a flight that another process publishes."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from recordings import CALIBRATION, CAMERA, PAIR, assert_same_rig
from rendered_flight import rendered_flight
from simulation_helpers import small_simulation

from vioframe.errors import CalibrationError, DatasetError, PluginError, SourceError
from vioframe.geometry import so3
from vioframe.io import ros
from vioframe.io.calibration import write_calibration
from vioframe.io.convert import convert
from vioframe.parts import registry
from vioframe.parts.config import Config
from vioframe.pipeline import Experiment, prepare, record
from vioframe.testing import check_source
from vioframe.types import (
    NS_PER_S,
    CameraOnBody,
    FrameSet,
    ImuNoise,
    ImuSample,
    Measurement,
    NavState,
    Status,
    Step,
    Unreadable,
)

zenoh = pytest.importorskip("zenoh")

import ros2_publisher as rig  # noqa: E402

from vioframe_ros2 import calibration as ros_calibration  # noqa: E402
from vioframe_ros2 import discovery, keys, messages, ros2, source  # noqa: E402
from vioframe_ros2.odometry import odometry, pose_covariance, twist_covariance  # noqa: E402
from vioframe_ros2.pairing import Pairing  # noqa: E402

INSTALLED = registry.load()
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4, 200.0)


class TestKeys:
    def test_those_of_the_design_document(self):
        chatter = keys.topic(0, "/robot1/chatter", "std_msgs/msg/String", HASH)
        assert chatter.key == "0/robot1/chatter/std_msgs::msg::dds_::String_/*"
        assert keys.exactly(chatter) == f"0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}"
        assert messages.type_hash("std_msgs/msg/String") == HASH
        assert keys.of_data(keys.exactly(chatter)) == chatter
        about = f"%chatter/std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
        token = f"@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/{about}"
        spoken_of = keys.topic(2, "/chatter", "std_msgs/msg/String", HASH)
        assert keys.of_token(token) == spoken_of
        assert keys.token(2, "8b20917502ee955ac4476e0266340d5c", 10, "MP", "talker", spoken_of, "::,7:,:,:,,") == token
        assert keys.token(2, "aac3", 0, "NN", "listener") == "@ros2_lv/2/aac3/0/0/NN/%/%/listener"

    def test_that_of_a_bridge(self):
        token = "@/8b20/@ros2_lv/MP/robot1§imu0/sensor_msgs§msg§Imu/::1,10"
        assert keys.of_token(token) == keys.Topic("/robot1/imu0", "sensor_msgs/msg/Imu", "robot1/imu0")

    @pytest.mark.parametrize(
        "token",
        [
            f"@ros2_lv/0/1/0/10/MS/%/%/n/%imu0/sensor_msgs::msg::dds_::Imu_/{HASH}/::,10:,:,:,,",
            "@ros2_lv/0/1/0/0/NN/%/%/n",
            f"@ros2_lv/0/1/0/10/MP/%/%/n/%add/example::srv/{HASH}/::,10:,:,:,,",
            "@/8b20/@ros2_lv/MS/imu0/sensor_msgs§msg§Imu/::1,10",
            "@/8b20/@ros2_lv",
        ],
    )
    def test_of_others_nothing_is_read(self, token: str):
        assert keys.of_token(token) is None

    @pytest.mark.parametrize("key", ["0/imu0", "imu0/sensor_msgs::msg::dds_::Imu_/x", "a/b/c/d", "0/@adv/pub/1/2"])
    def test_what_is_no_message_is_none(self, key: str):
        assert keys.of_data(key) is None

    def test_an_attachment_is_of_33_bytes(self):
        """Two integers of 8 bytes, the length of what follows, and that."""
        data = keys.attachment(3, 5, bytes(range(16)))
        assert data == b"\3" + bytes(7) + b"\5" + bytes(7) + b"\x10" + bytes(range(16))


class TestMessages:
    @pytest.mark.parametrize("encoding", ["mono8", "8UC1", "bgr8", "rgb8", "bgra8", "mono16"])
    def test_pixels(self, encoding: str):
        rng = np.random.default_rng(0)
        channels = {"bgr8": 3, "rgb8": 3, "bgra8": 4}.get(encoding, 1)
        shape = (5, 7) if channels == 1 else (5, 7, channels)
        given = rng.integers(0, 256, shape).astype(np.uint16 if encoding == "mono16" else np.uint8)
        image = rig.image_message(7, "cam0", np.zeros((5, 7), np.uint8))
        step = given.itemsize * 7 * channels
        image = replace(image, encoding=encoding, step=step, data=given.view(np.uint8).ravel())
        read = messages.decoded(messages.encoded(image), messages.IMAGE)
        assert ros.stamp_ns(read) == 7
        expected = given
        if encoding == "rgb8":
            expected = cv2.cvtColor(given, cv2.COLOR_RGB2GRAY)
        elif channels == 3:
            expected = cv2.cvtColor(given, cv2.COLOR_BGR2GRAY)
        elif channels == 4:
            expected = cv2.cvtColor(given, cv2.COLOR_BGRA2GRAY)
        assert_array_equal(ros.pixels(read, "here"), expected)

    def test_pixels_of_a_file(self):
        given = np.random.default_rng(0).integers(0, 256, (5, 7), dtype=np.uint8)
        data = cv2.imencode(".png", given)[1].ravel()
        message = messages.new(messages.COMPRESSED, header=messages.header(1, "c"), format="png", data=data)
        read = messages.decoded(messages.encoded(message), messages.COMPRESSED)
        assert_array_equal(ros.pixels(read, "here"), given)
        assert ros.pixels(replace(read, data=data[:20]), "here") is None

    def test_damage_is_told(self):
        data = messages.encoded(rig.image_message(7, "cam0", np.zeros((5, 7), np.uint8)))
        with pytest.raises(DatasetError, match="sensor_msgs/msg/Image is damaged"):
            messages.decoded(data[:40], messages.IMAGE)


def state(seed: int = 0, t_ns: int = 1_700_000_000_123_456_789) -> NavState:
    """Some state in motion, all its errors correlated."""
    rng = np.random.default_rng(seed)
    L = rng.normal(size=(15, 15)) * np.repeat([0.02, 0.1, 0.05, 1e-3, 1e-2], 3)[:, None]
    return NavState(t_ns, so3.exp(rng.normal(size=3)), *rng.normal(size=(4, 3)), L @ L.T)


def disturbed(at: NavState, error: np.ndarray) -> NavState:
    """The state that has this ``error`` (15,), in the convention of :class:`NavState`."""
    return replace(
        at,
        R_WB=at.R_WB @ so3.exp(error[:3]),
        p_WB=at.p_WB + error[3:6],
        v_WB=at.v_WB + error[6:9],
        bias_gyro_B=at.bias_gyro_B + error[9:12],
    )


class TestOdometry:
    GYRO = np.array([0.3, -0.2, 0.1])

    def test_covariances_by_disturbing_each_error(self):
        """As who receives them takes them: rotations about the axes of the parent, velocities along the child's."""
        at = state()
        step = 1e-6

        def errors(of: NavState) -> tuple[np.ndarray, np.ndarray]:
            pose = np.r_[of.p_WB - at.p_WB, so3.log(of.R_WB @ at.R_WB.T)]
            v_B, omega_B = of.R_WB.T @ of.v_WB, self.GYRO - of.bias_gyro_B
            return pose, np.r_[v_B - at.R_WB.T @ at.v_WB, omega_B - (self.GYRO - at.bias_gyro_B)]

        ahead = [errors(disturbed(at, +step * e)) for e in np.eye(15)]
        behind = [errors(disturbed(at, -step * e)) for e in np.eye(15)]
        J_pose, J_twist = (
            np.array([(a[i] - b[i]) / (2 * step) for a, b in zip(ahead, behind, strict=True)]).T for i in (0, 1)
        )
        assert at.cov is not None
        assert_allclose(pose_covariance(at.R_WB, at.cov), J_pose @ at.cov @ J_pose.T, rtol=1e-6, atol=1e-10)
        twist = J_twist @ at.cov @ J_twist.T
        twist[3:, 3:] += 1e-3**2 * 200.0 * np.eye(3)
        assert_allclose(twist_covariance(at, at.cov, NOISE), twist, rtol=1e-6, atol=1e-10)

    def test_there_and_back(self):
        at = state()
        sent = odometry(at, self.GYRO, NOISE, "odom", "imu_link")
        got = messages.decoded(messages.encoded(sent), messages.ODOMETRY)
        assert (got.header.frame_id, got.child_frame_id, ros.stamp_ns(got)) == ("odom", "imu_link", at.t_ns)
        p, q = got.pose.pose.position, got.pose.pose.orientation
        assert_array_equal([p.x, p.y, p.z], at.p_WB)
        assert_allclose(so3.from_quat_xyzw([q.x, q.y, q.z, q.w]), at.R_WB, atol=1e-15)
        v, omega = got.twist.twist.linear, got.twist.twist.angular
        assert_allclose(at.R_WB @ [v.x, v.y, v.z], at.v_WB, atol=1e-15)
        assert_array_equal([omega.x, omega.y, omega.z], self.GYRO - at.bias_gyro_B)
        assert at.cov is not None
        for received, block in ((got.pose, at.cov[3:6, 3:6]), (got.twist, None)):
            covariance = received.covariance.reshape(6, 6)
            assert_array_equal(covariance, covariance.T)
            assert np.linalg.eigvalsh(covariance).min() > 0.0
            assert block is None or np.allclose(covariance[:3, :3], block)

    @pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.1, -0.2, 0.3], [-0.6, 0.5, 0.4]])
    @pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi])
    def test_rotations_of_any_angle(self, axis: list[float], angle: float):
        R = so3.exp(angle * np.array(axis) / np.linalg.norm(axis))
        q = odometry(replace(state(), R_WB=R), self.GYRO, NOISE, "odom", "imu_link").pose.pose.orientation
        assert np.hypot(np.hypot(q.x, q.y), np.hypot(q.z, q.w)) == pytest.approx(1.0, abs=1e-15)
        assert_allclose(so3.from_quat_xyzw([q.x, q.y, q.z, q.w]), R, atol=1e-14)

    def test_without_a_covariance_it_is_not_known(self):
        sent = odometry(replace(state(), cov=None), self.GYRO, NOISE, "odom", "imu_link")
        assert not sent.pose.covariance.any()
        assert not sent.twist.covariance.any()


class TestCalibration:
    @staticmethod
    def info(**changes: Any) -> Any:
        return replace(rig.camera_info(0, CAMERA), **changes)

    @pytest.mark.parametrize(
        ("name", "given", "kind", "read"),
        [
            ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.0], "radtan", (0.1, 0.2, 0.3, 0.4)),
            ("plumb_bob", [], "radtan", (0.0, 0.0, 0.0, 0.0)),
            ("rational_polynomial", [0.1, 0.2, 0.3, 0.4, 0, 0, 0, 0], "radtan", (0.1, 0.2, 0.3, 0.4)),
            ("equidistant", [0.1, 0.2, 0.3, 0.4], "equidistant", (0.1, 0.2, 0.3, 0.4)),
            ("fisheye", [0.1, 0.2, 0.3, 0.4], "equidistant", (0.1, 0.2, 0.3, 0.4)),
        ],
    )
    def test_lenses(self, name: str, given: list[float], kind: str, read: tuple[float, ...]):
        info = self.info(distortion_model=name, d=np.array(given, np.float64))
        model, R_OC = ros_calibration.camera_of(info, False, "here")
        assert model == replace(CAMERA.model, distortion=read, distortion_model=kind)
        assert_array_equal(R_OC, np.eye(3))

    @pytest.mark.parametrize(
        ("changes", "why"),
        [
            ({"d": np.array([0.1, 0.2, 0.3, 0.4, 0.5])}, "'plumb_bob' of 5 coefficients"),
            (
                {"distortion_model": "rational_polynomial", "d": np.array([0.1, 0.2, 0, 0, 0, 0, 0, 0.1])},
                "'rational_polynomial' of 8 coefficients; .* or give --calibration FILE",
            ),
            ({"distortion_model": "equidistant"}, "'equidistant' of 5"),
            ({"distortion_model": "unheard_of"}, "'unheard_of'"),
            ({"k": np.zeros(9)}, "here tells no calibration .* --calibration FILE"),
            ({"width": 0}, "here: camera needs a resolution"),
        ],
    )
    def test_lenses_that_are_refused(self, changes: dict[str, Any], why: str):
        with pytest.raises(CalibrationError, match=why):
            ros_calibration.camera_of(self.info(**changes), False, "here")

    def test_rectified_images_have_another_lens_and_may_be_turned(self):
        R, P = so3.exp([0.01, 0.02, 0.03]), np.array([[50.0, 0, 30, -5], [0, 51, 20, 0], [0, 0, 1, 0]])
        model, R_OC = ros_calibration.camera_of(self.info(r=R.ravel(), p=P.ravel()), True, "here")
        assert (model.fx, model.fy, model.cx, model.cy, model.distortion) == (50.0, 51.0, 30.0, 20.0, (0, 0, 0, 0))
        assert_array_equal(R_OC, R.T)  # "aligning the camera coordinate system to the ideal stereo image plane"

    @staticmethod
    def transforms(*edges: tuple[str, str, np.ndarray, np.ndarray]) -> ros_calibration.Transforms:
        transforms = ros_calibration.Transforms()
        for edge in edges:
            transforms.add(rig.new("tf2_msgs/TFMessage", transforms=[rig.transform(*edge)]))
        return transforms

    def test_a_chain_of_transforms(self):
        """The IMU sits in the base, the camera in a mount of it: up one and down two."""
        rng = np.random.default_rng(0)
        R, p = so3.exp(rng.normal(size=(3, 3))), rng.normal(size=(3, 3))
        edges = [("base", "imu", R[0], p[0]), ("/base", "mount", R[1], p[1]), ("mount", "/camera", R[2], p[2])]
        transforms = self.transforms(*edges)
        way = transforms.between("imu", "camera")
        assert way is not None
        point_C = rng.normal(size=3)
        in_base = R[1] @ (R[2] @ point_C + p[2]) + p[1]
        assert_allclose(way[0] @ point_C + way[1], R[0].T @ (in_base - p[0]), atol=1e-14)
        assert transforms.between("imu", "elsewhere") is None
        assert transforms.root("camera") == "base" == transforms.root("base")
        # A circle, which nobody should publish, does no harm.
        transforms = self.transforms(*edges, ("camera", "base", R[0], p[0]))
        assert transforms.root("imu") in ("base", "mount", "camera")

    def test_a_rig(self):
        transforms, topics = ros_calibration.Transforms(), {"cam0": "/cam0/image_raw"}
        transforms.add(rig.static_transforms(CALIBRATION.cameras))
        read = ros_calibration.published(topics, {"cam0": self.info()}, rig.IMU_FRAME, transforms, CALIBRATION.imu)
        (camera,) = read.cameras
        assert camera.model == CAMERA.model
        assert_allclose(camera.R_BC, CAMERA.R_BC, atol=1e-14)
        assert_allclose(camera.p_BC, CAMERA.p_BC, atol=1e-14)

    def test_how_a_camera_sits_must_be_told(self):
        infos = {"cam0": self.info()}
        args = {"cam0": "/cam0/image_raw"}, infos, "imu_link", ros_calibration.Transforms(), NOISE
        with pytest.raises(CalibrationError, match=r"no transforms on /tf_static .* or give --calibration FILE$"):
            ros_calibration.published(*args)

    def test_two_cameras_in_one_frame_are_one_too_many(self):
        transforms = ros_calibration.Transforms()
        transforms.add(rig.static_transforms(CALIBRATION.cameras))
        infos = {"left": self.info(), "right": self.info()}
        with pytest.raises(CalibrationError, match="share a frame, 'cam0_optical'"):
            ros_calibration.published({"left": "/l/i", "right": "/r/i"}, infos, rig.IMU_FRAME, transforms, NOISE)

    def test_a_file_of_the_imu_alone(self, tmp_path: Path):
        write_calibration(CALIBRATION, tmp_path)
        assert ros_calibration.noise_alone([tmp_path / "imu0" / "sensor.yaml"]) == CALIBRATION.imu
        assert ros_calibration.noise_alone([tmp_path / "cam0" / "sensor.yaml"]) is None
        assert ros_calibration.noise_alone([tmp_path]) is None
        assert ros_calibration.noise_alone([]) is None

    @pytest.mark.parametrize(
        ("topic", "name"),
        [
            ("/cam0/image_raw", "cam0"),
            ("/camera/infra1/image_rect_raw", "camera_infra1"),
            ("/cam0/image_raw/compressed", "cam0"),
            ("/image", "image"),
        ],
    )
    def test_names(self, topic: str, name: str):
        assert discovery.camera_name(topic) == name


class TestTopics:
    @staticmethod
    def images(*topics: str, named: Sequence[str] = ()) -> list[str]:
        known = discovery._Topics()
        for name in topics:
            message_type = messages.IMAGE if "ompressed" not in name else messages.COMPRESSED
            known.add(keys.topic(0, name, message_type, HASH))
        return [topic.name for topic in known.images(named)]

    def test_compressed_images_are_taken_where_there_are_no_others(self):
        both = "/b/image_raw", "/b/image_raw/compressed"
        assert self.images("/a/image_raw/compressed", *both) == ["/a/image_raw/compressed", "/b/image_raw"]
        assert self.images(*both, named=both[1:]) == [*both]

    def test_images_of_depth_are_no_pictures(self):
        depth = "/camera/depth/image_rect_raw", "/camera/aligned_depth_to_color/image_raw/compressedDepth"
        assert self.images("/camera/color/image_raw", *depth) == ["/camera/color/image_raw"]
        assert self.images(*depth, named=depth[:1]) == [depth[0]]


class TestPairing:
    @staticmethod
    def image(t_ns: int, camera: int, count: int = 2) -> FrameSet:
        return FrameSet(t_ns, tuple(np.full((2, 2), camera) if i == camera else None for i in range(count)))

    def paired(self, *came: tuple[int, int]) -> list[tuple[int, tuple[bool, ...]]]:
        """Stamps and who is in each set, of images that come as (stamp, camera)."""
        pairing = Pairing(2)
        out = [frames for t_ns, camera in came for frames in pairing.add(self.image(t_ns, camera))]
        for frames in out:
            for camera, image in enumerate(frames.images):
                assert image is None or np.all(image == camera)
        return [(frames.t_ns, tuple(image is not None for image in frames.images)) for frames in out]

    def test_one_camera_waits_for_nobody(self):
        pairing = Pairing(1)
        assert [f.t_ns for t_ns in (1, 2, 3) for f in pairing.add(self.image(t_ns, 0, 1))] == [1, 2, 3]

    def test_in_either_order(self):
        assert self.paired((1, 0), (1, 1), (2, 1), (2, 0)) == [(1, (True, True)), (2, (True, True))]

    def test_one_that_lags_by_less_than_a_period_is_waited_for(self):
        assert self.paired((10, 0), (10, 1), (20, 0), (20, 1)) == [(10, (True, True)), (20, (True, True))]

    def test_an_image_that_was_lost_is_waited_for_by_one_period_at_most(self):
        lost = self.paired((1, 0), (1, 1), (2, 0), (3, 0), (3, 1))
        assert lost == [(1, (True, True)), (2, (True, False)), (3, (True, True))]
        silent = self.paired((1, 0), (2, 0), (3, 0))
        assert silent == [(1, (True, False)), (2, (True, False))]

    def test_cameras_that_take_turns(self):
        turns = self.paired((0, 0), (5, 1), (10, 0), (15, 1))
        assert turns == [(0, (True, False)), (5, (False, True)), (10, (True, False))]

    def test_stamps_that_begin_anew(self):
        assert self.paired((100, 0), (5, 0), (5, 1)) == [(100, (True, False)), (5, (True, True))]

    def test_what_waits_comes_in_the_end(self):
        pairing = Pairing(2)
        assert list(pairing.add(self.image(1, 0))) == []
        assert [frames.t_ns for frames in pairing.rest()] == [1]
        assert list(pairing.rest()) == []


def endpoint() -> str:
    """A port of this computer that nobody uses."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


ROUTER = """
import sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", f'["{sys.argv[1]}"]')
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("listens", flush=True)
    sys.stdin.read()
"""


@contextmanager
def router(where: str) -> Iterator[None]:
    """What ``rmw_zenohd`` is; in a process of its own, as sessions of one share threads and may block each other."""
    command = [sys.executable, "-c", ROUTER, where]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "listens\n"
        try:
            yield
        finally:
            process.kill()


@contextmanager
def broadcast(
    where: str,
    *,
    cameras: Sequence[CameraOnBody] = CALIBRATION.cameras,
    listens: bool = True,
    tells_how: bool = True,
    **way: Any,
) -> Iterator[rig.Node]:
    """A small rig at 20 and 200 Hz, by a thread; ``tells_how`` the cameras sit on the body."""
    node, done = rig.Node(where, listens=listens), Event()
    node.advertise("/imu0", "sensor_msgs/Imu", **way)
    for camera in cameras:
        node.advertise(f"/{camera.name}/image_raw", "sensor_msgs/Image", **way)
        node.advertise(f"/{camera.name}/camera_info", "sensor_msgs/CameraInfo", **way)
    if tells_how:
        node.advertise("/tf_static", "tf2_msgs/TFMessage", latched=True, **way)
        node.publish("/tf_static", rig.static_transforms(cameras))
    rng = np.random.default_rng(0)

    def publish() -> None:
        t_ns = time.time_ns()
        for k in range(10_000):
            t_ns += 5_000_000
            done.wait(max(t_ns - time.time_ns(), 0) / NS_PER_S)
            if done.is_set():
                return
            sample = ImuSample(t_ns, rng.normal(size=3), rng.normal(size=3))
            node.publish("/imu0", rig.imu_message(t_ns, sample))
            for camera in cameras if k % 10 == 0 else ():
                image = rng.integers(0, 256, camera.model.resolution[::-1], dtype=np.uint8)
                node.publish(f"/{camera.name}/image_raw", rig.image_message(t_ns, camera.name, image))
                node.publish(f"/{camera.name}/camera_info", rig.camera_info(t_ns, camera))

    thread = Thread(target=publish)
    thread.start()
    try:
        yield node
    finally:
        done.set()
        thread.join()
        node.session.close()


def some_of(measurements: Iterator[Measurement], count: int = 100) -> Counter[str]:
    """How many of each kind the first ``count`` are."""
    return Counter(type(next(measurements)).__name__ for _ in range(count))


class TestSource:
    def test_it_keeps_its_promises(self):
        with broadcast(where := endpoint()):
            check_source(ros2, where)

    @pytest.mark.parametrize("way", [{}, {"says_so": False}, {"bridged": True}], ids=["rmw_zenoh", "silent", "bridge"])
    def test_what_is_published_is_found_and_read(self, way: dict[str, bool]):
        with broadcast(where := endpoint(), **way):
            found = ros2(where)
            (camera,) = found.calibration.cameras
            assert (camera.name, camera.model) == ("cam0", CAMERA.model)
            assert_allclose(camera.p_BC, CAMERA.p_BC, atol=1e-12)
            assert found.calibration.imu == ros_calibration.usual_noise(found.calibration.imu.rate_hz)
            assert found.calibration.imu.rate_hz == pytest.approx(200.0)
            came = found.measurements()
            kinds = some_of(came)
            assert kinds["FrameSet"] in range(5, 15)
            assert kinds["ImuSample"] == 100 - kinds["FrameSet"]
            found.close()
            assert all(isinstance(m, FrameSet) for m in came)

    def test_two_cameras(self):
        with broadcast(where := endpoint(), cameras=PAIR.cameras):
            found = ros2(where)
            for camera, expected in zip(found.calibration.cameras, PAIR.cameras, strict=True):
                assert (camera.name, camera.model) == (expected.name, expected.model)
                assert_allclose(camera.R_BC, expected.R_BC, atol=1e-12)
                assert_allclose(camera.p_BC, expected.p_BC, atol=1e-12)
            sets = [m for m, _ in zip(found.measurements(), range(200), strict=False) if isinstance(m, FrameSet)]
            together = [frames for frames in sets if all(image is not None for image in frames.images)]
            assert len(together) > 5
            assert len(sets) - len(together) <= 2  # the first may come ahead of what the other camera brings
            found.close()

    def test_a_calibration_comes_before_what_is_published(self, tmp_path: Path):
        write_calibration(CALIBRATION, tmp_path)
        with broadcast(where := endpoint(), tells_how=False):
            assert_same_rig(ros2(where, calibration=tmp_path, cameras="cam0").calibration, CALIBRATION)
            with pytest.raises(CalibrationError, match=r"no transforms on /tf_static lead from 'imu_link'"):
                ros2(where, wait_s=1.0).calibration  # noqa: B018

    def test_cameras_are_chosen_by_name_by_topic_or_called_otherwise(self, tmp_path: Path):
        write_calibration(CALIBRATION, tmp_path)
        with broadcast(where := endpoint()):
            for chosen, name in (("cam0", "cam0"), ("/cam0/image_raw", "cam0"), ("left:/cam0/image_raw", "left")):
                assert ros2(where, cameras=chosen).calibration.cameras[0].name == name
            noise = tmp_path / "imu0" / "sensor.yaml"
            assert ros2(where, calibration=noise).calibration.imu == CALIBRATION.imu
            with pytest.raises(DatasetError, match=r"no camera 'cam7'; choose of: cam0 \(/cam0/image_raw\)"):
                ros2(where, cameras="cam7").calibration  # noqa: B018
            with pytest.raises(DatasetError, match=r"/imu0 carries sensor_msgs/msg/Imu"):
                ros2(where, calibration=tmp_path, cameras="cam0:/imu0").calibration  # noqa: B018
            with pytest.raises(
                DatasetError, match=r"/cam0/image_raw carries sensor_msgs/msg/Image, not sensor_msgs/msg/I"
            ):
                ros2(where, imu_topic="/cam0/image_raw").calibration  # noqa: B018

    def test_what_is_missing_is_told(self):
        with broadcast(where := endpoint()):
            with pytest.raises(SourceError, match=r"nobody publishes /gyro; its topics: /cam0/camera_info, .*/imu0"):
                ros2(where, imu_topic="/gyro", wait_s=0.5).calibration  # noqa: B018
            with pytest.raises(SourceError, match=r"domain 7: nobody publishes images .*; its topics: none"):
                ros2(where, domain=7, wait_s=0.5).calibration  # noqa: B018

    def test_no_router(self):
        with pytest.raises(SourceError, match=r"no Zenoh router answers at .*; start it by `ros2 run rmw_zenoh_cpp"):
            ros2(endpoint(), wait_s=0.1).calibration  # noqa: B018

    def test_zenoh_is_optional(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setitem(sys.modules, "zenoh", None)
        with pytest.raises(PluginError, match=r"source 'ros2' needs eclipse-zenoh, .* pip install 'vioframe\[ros2\]'"):
            INSTALLED.open_dataset("ros2:")

    def test_the_domain_is_that_of_the_environment(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setenv("ROS_DOMAIN_ID", "41")
        with pytest.raises(SourceError, match="domain 41"), broadcast(where := endpoint()):
            ros2(where, wait_s=0.1).calibration  # noqa: B018
        monkeypatch.setenv("ROS_DOMAIN_ID", "x")
        with pytest.raises(DatasetError, match="ROS_DOMAIN_ID is 'x'"):
            ros2("")

    def test_damaged_messages_are_counted(self):
        with broadcast(where := endpoint()) as node:
            found = ros2(where)
            came = found.measurements()
            assert some_of(came)["FrameSet"] > 0
            for topic in ("/imu0", "/cam0/image_raw"):
                node._publishers[topic].put(b"\0\1\0\0damage", attachment=b"")
            image = rig.image_message(1, "cam0", np.zeros((4, 4), np.uint8))
            node.publish("/cam0/image_raw", replace(image, height=400))
            kinds = Counter(m.kind for m, _ in zip(came, range(100), strict=False) if isinstance(m, Unreadable))
            assert kinds == {"imu_unreadable": 1, "frame_unreadable": 2}
            found.close()

    @pytest.mark.parametrize("with_router", [True, False])
    def test_who_publishes_goes_and_comes_back(self, with_router: bool, monkeypatch: pytest.MonkeyPatch):
        """Behind a router, or listened to directly: then there is nobody left to be connected to."""
        monkeypatch.setattr(source, "_SILENT_S", 0.8)
        where = endpoint()
        with router(where) if with_router else nullcontext():
            with broadcast(where, listens=not with_router):
                found = ros2(where)
                came = found.measurements()
                some_of(came)
            with pytest.raises(SourceError, match=r"nothing came on /imu0, /cam0/image_raw at .* for 0.8 s"):
                list(came)
            if not with_router:
                with pytest.raises(SourceError, match="no Zenoh router answers"):
                    next(found.measurements())
            back: Counter[str] = Counter()

            def is_back() -> bool:
                with suppress(SourceError):  # as it is asked anew while flying
                    back.update(some_of(found.measurements()))
                return back.total() > 0

            with broadcast(where, listens=not with_router):
                until(is_back)
            assert back["FrameSet"] > 0
            found.close()
            assert not list(found.measurements())

    @pytest.mark.parametrize("tf", [True, False])
    def test_the_pose_is_published(self, tf: bool):
        with broadcast(where := endpoint()) as node:
            heard, moved = node.hear("/vioframe/odometry", "nav_msgs/Odometry"), node.hear("/tf", "tf2_msgs/TFMessage")
            found = ros2(where, tf=tf)
            came = found.measurements()
            some_of(came, 20)
            told = [replace(state(seed), t_ns=seed + 1) for seed in range(3)]
            for each in told:
                found.tell(each)
            until(lambda: len(heard) == 3 and len(moved) == 3 * tf)
            said = node.tokens("/vioframe/odometry")
            assert any("/MP/%/%/vioframe/" in token for token in said)
            found.close()
            found.tell(told[0])
        received = [messages.decoded(data, messages.ODOMETRY) for data, _ in heard]
        assert [ros.stamp_ns(message) for message in received] == [1, 2, 3]
        assert {message.child_frame_id for message in received} == {rig.IMU_FRAME}
        assert [int.from_bytes(attachment[:8], "little") for _, attachment in heard] == [1, 2, 3]
        assert len({attachment[17:] for _, attachment in heard}) == 1
        # A frame has one parent: base_link, in which the IMU's frame is, is what moves.
        for (data, _), each in zip(moved, told, strict=False):
            (transform,) = messages.decoded(data, messages.TRANSFORMS).transforms
            assert (transform.header.frame_id, transform.child_frame_id) == ("odom", rig.BASE_FRAME)
            p, q = transform.transform.translation, transform.transform.rotation
            R_WL = so3.from_quat_xyzw([q.x, q.y, q.z, q.w])
            assert_allclose(R_WL @ rig.R_LB, each.R_WB, atol=1e-12)
            assert_allclose(R_WL @ rig.p_LB + [p.x, p.y, p.z], each.p_WB, atol=1e-12)


def until(happened: Callable[[], bool], wait_s: float = 30.0) -> None:
    begin_s = time.monotonic()
    while not happened():
        assert time.monotonic() - begin_s < wait_s
        time.sleep(0.01)


@contextmanager
def published(recording: Path, out: Path, *way: str) -> Iterator[subprocess.Popen[str]]:
    """``ros2_publisher.py`` at work, and gone by the end."""
    command = [sys.executable, str(Path(__file__).with_name("ros2_publisher.py")), str(recording), str(out), *way]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def prepared(where: str, tape: Path) -> Experiment:
    config = Config.model_validate({"dataset": {"path": f"ros2:{where}"}})
    return prepare(config, INSTALLED, tape=tape)


def flown(
    experiment: Experiment,
    folder: Path,
    conduct: Callable[[], object],
    on_step: Callable[[Step], None] = lambda step: None,
) -> dict[str, Any]:
    """Fly until ``conduct``, which is called in a thread of its own, is through."""
    failed: list[BaseException] = []

    def end() -> None:
        try:
            conduct()
        except BaseException as error:
            failed.append(error)
        finally:
            assert experiment.live is not None
            experiment.live.stop()

    thread = Thread(target=end)
    thread.start()
    summary = record(experiment, folder, on_step=on_step)
    thread.join()
    assert not failed
    return summary


def readings(recording: Path) -> list[int]:
    return [m.t_ns for m in INSTALLED.open_dataset(recording).measurements() if isinstance(m, ImuSample)]


def begins(process: subprocess.Popen[str]) -> int:
    assert process.stdout is not None
    return int(process.stdout.readline())


class TestFlight:
    @pytest.fixture(scope="class")
    @staticmethod
    def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
        """Six seconds of the simulator: two at rest and four in flight."""
        folder = tmp_path_factory.mktemp("ros2")
        rng = np.random.default_rng(0)
        (folder / "textures").mkdir()
        for k in range(4):
            noise = rng.integers(0, 256, (64, 64), dtype=np.uint8)
            cv2.imwrite(
                str(folder / "textures" / f"{k}.png"), cv2.resize(noise, (512, 512), interpolation=cv2.INTER_CUBIC)
            )
        flight = {"name": "stop_and_go", "options": {"speed": 2.0}}
        world = {"name": "hall", "options": {"images": folder / "textures"}}
        simulated = small_simulation(folder, divisor=2, duration_s=6.0, flight=flight, world=world)
        convert(simulated.measurements(), simulated.calibration, folder / "flight.mcap")
        return folder / "flight.mcap"

    def test_a_flight_over_the_loopback(self, recording: Path, tmp_path: Path):
        where, tape = endpoint(), tmp_path / "tape.mcap"
        with published(recording, tmp_path / "heard.npz", "--listen", where) as process:
            experiment = prepared(where, tape)
            summary = flown(experiment, tmp_path / "live", lambda: process.wait(60.0))
            assert process.returncode == 0
        assert summary["initialised_t_ns"] is not None
        assert summary["completion"] > 0.9

        # No reading was lost: all that were published from the first that came to the last one.
        heard = np.load(tmp_path / "heard.npz")
        taken = readings(tape)
        assert taken == heard["readings_ns"].tolist()[-len(taken) :]
        assert len(taken) == summary["live"]["readings"] > 1200
        assert summary["live"]["source_lost"] == 0

        # Run again, the tape gives the same.
        again = prepare(Config.model_validate({"dataset": {"path": tape}}), INSTALLED)
        record(again, tmp_path / "again")
        trajectory = (tmp_path / "live" / "trajectory.tum").read_bytes()
        assert trajectory.count(b"\n") > 30
        assert (tmp_path / "again" / "trajectory.tum").read_bytes() == trajectory

        # What the other process heard is what was told, and as sure of it.
        told = np.loadtxt(tmp_path / "live" / "imu_rate.csv", delimiter=",", skiprows=1)
        stamps = np.loadtxt(tmp_path / "live" / "imu_rate.csv", delimiter=",", skiprows=1, usecols=0, dtype=np.int64)
        rows = dict(zip(stamps.tolist(), told, strict=True))
        odometry = [messages.decoded(data.tobytes(), messages.ODOMETRY) for data in heard["odometry"]]
        assert len(odometry) == len(heard["tf"]) >= len(told) > 200
        compared = 0
        for message in odometry:
            if (row := rows.get(ros.stamp_ns(message))) is None:
                continue  # told after the last frame
            compared += 1
            R_WB, cov = so3.from_quat_xyzw(row[4:8]), np.zeros((6, 6))
            cov[np.triu_indices(6)] = row[11:]
            cov = np.triu(cov) + np.triu(cov, 1).T
            p, covariance = message.pose.pose.position, message.pose.covariance.reshape(6, 6)
            assert_allclose([p.x, p.y, p.z], row[1:4], atol=1e-6)
            assert_allclose(covariance, covariance.T, atol=0.0)
            assert np.linalg.eigvalsh(covariance).min() > 0.0
            assert_allclose(covariance[:3, :3], cov[3:, 3:], rtol=1e-4, atol=1e-12)
            assert_allclose(covariance[3:, 3:], R_WB @ cov[:3, :3] @ R_WB.T, rtol=1e-3, atol=1e-10)
            assert np.linalg.eigvalsh(message.twist.covariance.reshape(6, 6)).min() > 0.0
        assert compared == len(told)
        tokens = heard["tokens"].tolist()
        assert any("/MP/%/%/vioframe/%vioframe%odometry/" in token for token in tokens)
        assert any("/MS/%/%/vioframe/%imu0/" in token for token in tokens)

    def test_who_publishes_is_killed_and_started_again(self, tmp_path: Path):
        """Both behind a router, as under ROS 2: the gap is counted, and it tracks again."""
        recording = rendered_flight().write(tmp_path / "flight.mcap")
        where, heard = endpoint(), tmp_path / "heard.npz"
        tracked_ns: list[int] = []
        killed_ns = again_ns = 0

        def on_step(step: Step) -> None:
            if step.estimate.status is Status.TRACKING:
                tracked_ns.append(step.frames.t_ns)

        def conduct() -> None:
            nonlocal killed_ns, again_ns
            begins(first)
            until(lambda: len(tracked_ns) > 5)
            first.kill()
            killed_ns = time.time_ns()
            again_ns = killed_ns + round(2.6 * NS_PER_S)
            with published(recording, heard, "--connect", where, "--zero", str(again_ns)):
                until(lambda: tracked_ns[-1] > again_ns)

        with router(where), published(recording, heard, "--connect", where) as first:
            experiment = prepared(where, tmp_path / "tape.mcap")
            summary = flown(experiment, tmp_path / "live", conduct, on_step)
        assert summary["live"]["source_lost"] == 1
        incidents = summary["incidents"]
        assert incidents["source_lost"] == incidents["imu_gap"] == 1
        assert incidents["camera_gap"] >= 1
        assert not any(killed_ns < t_ns < again_ns for t_ns in tracked_ns)
