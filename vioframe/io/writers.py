"""Writers of recordings, one a format, all with the same methods; see :mod:`vioframe.io.convert`."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self, TextIO

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import true_values, write_euroc
from vioframe.types import NS_PER_S, Float, FrameSet, ImuSample

IMU_TOPIC = "/imu0"
GROUND_TRUTH_TOPIC = "/vioframe/ground_truth"
"""Poses of the body in W, on the camera's clock: of recordings whose source knows the truth in the body frame."""
TRUE_VECTOR_TOPICS = tuple(f"{GROUND_TRUTH_TOPIC}/{name}" for name in ("velocity", "bias_gyro", "bias_accel"))
"""``v_WB`` m/s, ``bias_gyro_B`` rad/s, ``bias_accel_B`` m/s^2 at the stamps of the poses, where they are known."""

# ROS 2 keeps seconds in 32 bits with a sign.
_ROS_STAMP_LIMIT_NS = 2**31 * NS_PER_S

_IMAGE = "sensor_msgs/msg/Image"
_IMU = "sensor_msgs/msg/Imu"
_POSE = "geometry_msgs/msg/PoseStamped"
_VECTOR = "geometry_msgs/msg/Vector3Stamped"
_FRAME_HEADING = "#timestamp [ns],filename\n"
_IMU_HEADING = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)


class RecordingWriter(ABC):
    """A recording being written; leaving its context completes it."""

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(self, *error: object) -> None: ...

    @abstractmethod
    def write_truth(self, truth: Trajectory) -> None:
        """All of the ground truth, with velocity and biases where it is a ``TrueTrajectory``."""

    @abstractmethod
    def write_frame(self, frames: FrameSet) -> None:
        """The images there are, of the cameras in the order that the writer was told."""

    @abstractmethod
    def write_imu(self, sample: ImuSample) -> None: ...


class AslWriter(RecordingWriter):
    """An ASL folder: in ``mav0`` a folder of lossless images for each camera, ``imu0``, and
    ``state_groundtruth_estimate0`` where the truth is known; numbers are written so as to read back equal."""

    def __init__(self, folder: Path, camera_names: Sequence[str]) -> None:
        self._mav0 = folder / "mav0"
        self._cameras: list[tuple[Path, TextIO]] = []
        for name in camera_names:
            (self._mav0 / name / "data").mkdir(parents=True)
            self._cameras.append((self._mav0 / name / "data", self._begin(name, _FRAME_HEADING)))
        (self._mav0 / "imu0").mkdir()
        self._imu = self._begin("imu0", _IMU_HEADING)

    def _begin(self, sensor: str, heading: str) -> TextIO:
        file = (self._mav0 / sensor / "data.csv").open("w", encoding="utf-8")
        file.write(heading)
        return file

    def __exit__(self, *error: object) -> None:
        for _, file in self._cameras:
            file.close()
        self._imu.close()

    def write_frame(self, frames: FrameSet) -> None:
        import cv2

        for (folder, file), image in zip(self._cameras, frames.images, strict=True):
            if image is not None:
                # The fastest level: these files are a few per cent larger than at the default one.
                _, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                (folder / f"{frames.t_ns}.png").write_bytes(png.tobytes())
                file.write(f"{frames.t_ns},{frames.t_ns}.png\n")

    def write_imu(self, sample: ImuSample) -> None:
        readings = [*sample.gyro_B.tolist(), *sample.accel_B.tolist()]
        self._imu.write(",".join([str(sample.t_ns), *map(repr, readings)]) + "\n")

    def write_truth(self, truth: Trajectory) -> None:
        folder = self._mav0 / "state_groundtruth_estimate0"
        folder.mkdir()
        write_euroc(truth, folder / "data.csv")


class _RosWriter(RecordingWriter):
    """What ROS 1 and ROS 2 have in common: messages, and a time of recording that keeps them in the order they came."""

    def __init__(
        self, bag: Any, camera_names: Sequence[str], store: Any, serialize: Any, header_extra: dict[str, int]
    ) -> None:
        self._bag = bag
        self._camera_names = camera_names
        self._store = store
        self._types = store.types
        self._serialize = serialize
        self._header_extra = header_extra
        self._recorded_ns = 0
        self._connections: dict[str, Any] = {}
        bag.open()
        # rosbags reads messages of the same time in the order of their topics: the IMU first, as from an ASL folder.
        self._connect(IMU_TOPIC, _IMU)
        for name in camera_names:
            self._connect(_image_topic(name), _IMAGE)

    def __exit__(self, *error: object) -> None:
        self._bag.__exit__(*error)

    def write_frame(self, frames: FrameSet) -> None:
        for name, image in zip(self._camera_names, frames.images, strict=True):
            if image is not None:
                height, width = image.shape
                message = self._types[_IMAGE](
                    header=self._header(frames.t_ns, name),
                    height=height,
                    width=width,
                    encoding="mono8",
                    is_bigendian=0,
                    step=width,
                    data=np.ascontiguousarray(image).ravel(),
                )
                self._write_in_order(_image_topic(name), frames.t_ns, message)

    def write_imu(self, sample: ImuSample) -> None:
        # A first covariance of -1 says that there is no orientation; zeros say that a covariance is not known.
        no_orientation = np.zeros(9)
        no_orientation[0] = -1.0
        message = self._types[_IMU](
            header=self._header(sample.t_ns, "imu0"),
            orientation=self._types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=no_orientation,
            angular_velocity=self._vector(sample.gyro_B),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(sample.accel_B),
            linear_acceleration_covariance=np.zeros(9),
        )
        self._write_in_order(IMU_TOPIC, sample.t_ns, message)

    def write_truth(self, truth: Trajectory) -> None:
        point, quaternion = self._types["geometry_msgs/msg/Point"], self._types["geometry_msgs/msg/Quaternion"]
        for t_ns, values in zip(truth.t_ns.tolist(), true_values(truth), strict=True):
            x, y, z, qw, qx, qy, qz = values[:7].tolist()
            pose = self._types["geometry_msgs/msg/Pose"](
                position=point(x=x, y=y, z=z), orientation=quaternion(x=qx, y=qy, z=qz, w=qw)
            )
            message = self._types[_POSE](header=self._header(t_ns, "world"), pose=pose)
            self._write(GROUND_TRUTH_TOPIC, t_ns, message)
            vectors = values[7:].reshape(-1, 3) if len(values) > 7 else ()
            for topic, frame_id, vector in zip(TRUE_VECTOR_TOPICS, ("world", "imu0", "imu0"), vectors, strict=False):
                message = self._types[_VECTOR](header=self._header(t_ns, frame_id), vector=self._vector(vector))
                self._write(topic, t_ns, message)

    def _write_in_order(self, topic: str, t_ns: int, message: Any) -> None:
        """As recorded later than what was written before: readers go by that order."""
        self._recorded_ns = max(self._recorded_ns + 1, t_ns)
        self._write(topic, self._recorded_ns, message)

    def _write(self, topic: str, recorded_ns: int, message: Any) -> None:
        self._connect(topic, message.__msgtype__)
        self._bag.write(self._connections[topic], recorded_ns, self._serialize(message, message.__msgtype__))

    def _connect(self, topic: str, message_type: str) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._bag.add_connection(topic, message_type, typestore=self._store)

    def _header(self, t_ns: int, frame_id: str) -> Any:
        if not 0 <= t_ns < _ROS_STAMP_LIMIT_NS:
            raise DatasetError(f"the stamp {t_ns} ns does not fit a ROS message; write an ASL folder instead")
        stamp = self._types["builtin_interfaces/msg/Time"](sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
        return self._types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id, **self._header_extra)

    def _vector(self, xyz: Float) -> Any:
        x, y, z = xyz.tolist()
        return self._types["geometry_msgs/msg/Vector3"](x=x, y=y, z=z)


class Ros1Writer(_RosWriter):
    """A ROS 1 bag, chunks compressed with ``bz2``, ``lz4`` or not at all."""

    def __init__(self, path: Path, compression: str | None, camera_names: Sequence[str]) -> None:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore

        bag = Writer(path)
        if compression is not None:
            bag.set_compression(Writer.CompressionFormat[compression.upper()])
        store = get_typestore(Stores.ROS1_NOETIC)
        super().__init__(bag, camera_names, store, store.serialize_ros1, {"seq": 0})


class Ros2Writer(_RosWriter):
    """A ROS 2 bag: a folder with ``metadata.yaml`` and sqlite3 storage, messages compressed with ``zstd`` or not."""

    _storage, _compressed = "SQLITE3", "MESSAGE"

    def __init__(self, path: Path, compression: str | None, camera_names: Sequence[str]) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        bag = Writer(path, version=9, storage_plugin=StoragePlugin[self._storage])
        if compression is not None:
            bag.set_compression(CompressionMode[self._compressed], CompressionFormat[compression.upper()])
        store = get_typestore(Stores.ROS2_HUMBLE)
        super().__init__(bag, camera_names, store, store.serialize_cdr, {})


class McapWriter(Ros2Writer):
    """A single MCAP file of ROS 2 messages, chunks compressed with ``zstd`` or not."""

    _storage, _compressed = "MCAP", "STORAGE"

    def __init__(self, path: Path, compression: str | None, camera_names: Sequence[str]) -> None:
        self._path = path
        # rosbags writes a folder around the file.
        self._folder = path.with_name(f"{path.stem}.folder")
        super().__init__(self._folder, compression, camera_names)

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        if error[0] is None:
            next(self._folder.glob("*.mcap")).rename(self._path)
        shutil.rmtree(self._folder)


def _image_topic(camera_name: str) -> str:
    return f"/{camera_name}/image_raw"
