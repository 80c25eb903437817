"""Small recordings for tests of readers and the converter."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.io.trajectories import TrueTrajectory
from vioframe.types import Calibration, CameraOnBody, FrameSet, Image, ImuNoise, ImuSample, Measurement

T0_NS = 1_403_636_584_763_555_584
WIDTH, HEIGHT = 64, 48
CAMERA = CameraOnBody(
    "cam0",
    Camera(40.0, 41.0, 31.5, 23.5, (-0.28, 0.07, 2e-4, 2e-5), (WIDTH, HEIGHT)),
    np.eye(3),
    np.array([0.1, 0.2, 0.3]),
    time_offset_ns=-3_000_000,
)
CALIBRATION = Calibration((CAMERA,), ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3, 200.0))
# A camera of another size, turned, its rotation with all its digits.
SECOND = CameraOnBody(
    "cam1",
    Camera(20.0, 21.0, 15.5, 11.5, (0.1, -0.02, 1e-3, 2e-3), (32, 24), "equidistant"),
    so3.exp([0.3, -1.2, 0.4]),
    np.array([-0.1, 1 / 3, 0.05]),
    readout_s=1 / 47,
)
PAIR = Calibration((CAMERA, SECOND), CALIBRATION.imu)


def measurements(
    frame_count: int = 6, size: tuple[int, int] = (HEIGHT, WIDTH), seed: int = 0
) -> list[ImuSample | FrameSet]:
    """Random images at 20 Hz and readings at 200 Hz, in order of time; stamps need all their digits."""
    rng = np.random.default_rng(seed)
    out: list[ImuSample | FrameSet] = []
    for i in range(10 * frame_count + 11):
        t_ns = T0_NS + i * 5_000_064
        out.append(ImuSample(t_ns, rng.normal(size=3), rng.normal(size=3)))
        if i >= 10 and i % 10 == 0 and i <= 10 * frame_count:
            out.append(FrameSet(t_ns + 17, (_read_only(rng, size),)))
    return out


def pair_measurements(alone: Sequence[int] = (2, 4), silent_from: int = 5) -> list[ImuSample | FrameSet]:
    """The same of :data:`PAIR`: ``alone`` are frames at which each camera has a stamp of its own; from ``silent_from``
    on the second camera is silent."""
    out: list[ImuSample | FrameSet] = []
    rng, number = np.random.default_rng(1), -1
    for m in measurements():
        if isinstance(m, ImuSample):
            out.append(m)
            continue
        number += 1
        other = None if number >= silent_from else _read_only(rng, (24, 32))
        if number in alone and other is not None:
            out += [FrameSet(m.t_ns, (*m.images, None)), FrameSet(m.t_ns + 1000, (None, other))]
        else:
            out.append(FrameSet(m.t_ns, (*m.images, other)))
    return out


def _read_only(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    image = rng.integers(0, 256, size, dtype=np.uint8)
    image.flags.writeable = False
    return image


def true_trajectory(columns: int = 16) -> TrueTrajectory:
    """A truth with all its digits, quaternions off the unit by their rounding, before, during and after the images."""
    rng = np.random.default_rng(2)
    values = rng.normal(size=(40, 16))[:, :columns]
    values[:, 3:7] = np.round(values[:, 3:7] / np.linalg.norm(values[:, 3:7], axis=1, keepdims=True), 6)
    return TrueTrajectory.of(T0_NS - 7 + 10_000_128 * np.arange(40), values)


def assert_same_rig(actual: Calibration, expected: Calibration) -> None:
    """Equal to the last bit."""
    assert actual.imu == expected.imu
    assert len(actual.cameras) == len(expected.cameras)
    for one, other in zip(actual.cameras, expected.cameras, strict=True):
        for name in ("name", "model", "time_offset_ns", "rotation_known", "readout_s"):
            assert getattr(one, name) == getattr(other, name)
        np.testing.assert_array_equal(one.R_BC, other.R_BC)
        np.testing.assert_array_equal(one.p_BC, other.p_BC)


def assert_equal(actual: Iterable[Measurement], expected: Iterable[Measurement]) -> None:
    """Equal to the last bit, and in the same order."""
    actual, expected = list(actual), list(expected)
    assert [(type(m), m.t_ns) for m in actual] == [(type(m), m.t_ns) for m in expected]
    for one, other in zip(actual, expected, strict=True):
        if isinstance(one, FrameSet):
            assert [image is None for image in one.images] == [image is None for image in other.images]
            for image, expected_image in zip(one.images, other.images, strict=True):
                assert image is None or (image.dtype == np.uint8 and not image.flags.writeable)
                np.testing.assert_array_equal(image, expected_image)
        elif isinstance(one, ImuSample):
            np.testing.assert_array_equal(one.gyro_B, other.gyro_B)
            np.testing.assert_array_equal(one.accel_B, other.accel_B)


@dataclass(frozen=True)
class Message:
    """A message for :func:`write_bag`: ``fields`` without the header."""

    topic: str
    type: str
    t_ns: int
    fields: dict[str, Any]
    recorded_ns: int | None = None


def image_message(topic: str, t_ns: int, image: np.ndarray, encoding: str, padding: int = 0, **options: Any) -> Message:
    """A sensor_msgs/Image, its rows followed by ``padding`` bytes."""
    rows = np.ascontiguousarray(image).view(np.uint8).reshape(image.shape[0], -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
    fields = {"height": image.shape[0], "width": image.shape[1], "encoding": encoding, "is_bigendian": 0}
    fields |= {"step": rows.shape[1], "data": rows.ravel()}
    return Message(topic, "sensor_msgs/msg/Image", t_ns, fields, **options)


def compressed_message(topic: str, t_ns: int, data: bytes) -> Message:
    fields = {"format": "png", "data": np.frombuffer(data, np.uint8)}
    return Message(topic, "sensor_msgs/msg/CompressedImage", t_ns, fields)


def imu_message(topic: str, sample: ImuSample, **options: Any) -> Message:
    fields = {"gyro": sample.gyro_B, "accel": sample.accel_B}
    return Message(topic, "sensor_msgs/msg/Imu", sample.t_ns, fields, **options)


def write_bag(path: Path, messages: Iterable[Message]) -> Path:
    """A ROS 1 bag, message by message, at the times of recording that they state (else their stamps)."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types
    with Writer(path) as bag:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = bag.add_connection(message.topic, message.type, typestore=store)
            stamp = types["builtin_interfaces/msg/Time"](sec=message.t_ns // 10**9, nanosec=message.t_ns % 10**9)
            fields = dict(message.fields)
            if message.type == "sensor_msgs/msg/Imu":
                vector = types["geometry_msgs/msg/Vector3"]
                fields = {
                    "orientation": types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                    "angular_velocity": vector(*fields["gyro"].tolist()),
                    "linear_acceleration": vector(*fields["accel"].tolist()),
                }
                for name in ("orientation", "angular_velocity", "linear_acceleration"):
                    fields[f"{name}_covariance"] = np.zeros(9)
            header = types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id="")
            data = store.serialize_ros1(types[message.type](header=header, **fields), message.type)
            recorded_ns = message.t_ns if message.recorded_ns is None else message.recorded_ns
            bag.write(connections[message.topic], recorded_ns, data)
    return path
