"""Writers of recordings, one a format, all with the same methods; see :mod:`vioframe.io.convert`."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self, TextIO

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry import so3
from vioframe.types import NS_PER_S, Float, FrameSet, Image, ImuSample, NavState

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
_TRUTH_HEADING = (
    "#timestamp",
    *(f" p_RS_R_{axis} [m]" for axis in "xyz"),
    *(f" q_RS_{part} []" for part in "wxyz"),
    *(f" v_RS_R_{axis} [m s^-1]" for axis in "xyz"),
    *(f" b_w_RS_S_{axis} [rad s^-1]" for axis in "xyz"),
    *(f" b_a_RS_S_{axis} [m s^-2]" for axis in "xyz"),
)


class RecordingWriter(Protocol):
    """A recording being written; leaving its context completes it."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def write_frame(self, frames: FrameSet) -> None:
        """The images there are, of the cameras in the order that the writer was told."""
        ...

    def write_imu(self, sample: ImuSample) -> None: ...

    def write_truth(self, state: NavState) -> None:
        """A true state: velocity and biases as far as it knows them (they are not NaN)."""
        ...

    def write_true_values(self, t_ns: int, values: Sequence[float]) -> None:
        """The same as a row of :attr:`vioframe.io.trajectories.TrueTrajectory.values`."""
        ...


class _TruthWriter(ABC):
    """True states to rows."""

    def write_truth(self, state: NavState) -> None:
        x, y, z, w = so3.to_quat_xyzw(state.R_WB).tolist()
        known = np.concatenate([state.v_WB, state.bias_gyro_B, state.bias_accel_B])
        self.write_true_values(state.t_ns, [*state.p_WB.tolist(), w, x, y, z, *known[np.isfinite(known)].tolist()])

    @abstractmethod
    def write_true_values(self, t_ns: int, values: Sequence[float]) -> None: ...


class TruthFile(_TruthWriter):
    """A ground-truth file of EuRoC's, with as many columns as its first row has."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")
        self._columns = 0

    def write_true_values(self, t_ns: int, values: Sequence[float]) -> None:
        if not self._columns:
            self._columns = 1 + len(values)
            heading = ",".join(_TRUTH_HEADING[: self._columns])
            # Poses alone under EuRoC's names are its raw motion capture, which no reader takes for the truth.
            self._file.write((heading.replace("RS_R", "WB") if self._columns == 8 else heading) + "\n")
        self._file.write(_row(t_ns, values[: self._columns - 1]))

    def close(self) -> None:
        self._file.close()


class AslWriter(_TruthWriter):
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
        self._truth: TruthFile | None = None

    def _begin(self, sensor: str, heading: str) -> TextIO:
        file = (self._mav0 / sensor / "data.csv").open("w", encoding="utf-8")
        file.write(heading)
        return file

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for _, file in self._cameras:
            file.close()
        self._imu.close()
        if self._truth is not None:
            self._truth.close()

    def write_frame(self, frames: FrameSet) -> None:
        import cv2

        for (folder, file), image in zip(self._cameras, frames.images, strict=True):
            if image is not None:
                # The fastest level: these files are a few per cent larger than at the default one.
                _, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
                (folder / f"{frames.t_ns}.png").write_bytes(png.tobytes())
                file.write(f"{frames.t_ns},{frames.t_ns}.png\n")

    def write_imu(self, sample: ImuSample) -> None:
        self._imu.write(_row(sample.t_ns, [*sample.gyro_B.tolist(), *sample.accel_B.tolist()]))

    def write_true_values(self, t_ns: int, values: Sequence[float]) -> None:
        if self._truth is None:
            folder = self._mav0 / "state_groundtruth_estimate0"
            folder.mkdir()
            self._truth = TruthFile(folder / "data.csv")
        self._truth.write_true_values(t_ns, values)


class _RosWriter(_TruthWriter):
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bag.__exit__(kind, error, trace)

    def write_frame(self, frames: FrameSet) -> None:
        for name, image in zip(self._camera_names, frames.images, strict=True):
            if image is not None:
                self._write_image(frames.t_ns, name, image)

    def _write_image(self, t_ns: int, camera_name: str, image: Image) -> None:
        height, width = image.shape
        message = self._types[_IMAGE](
            header=self._header(t_ns, camera_name),
            height=height,
            width=width,
            encoding="mono8",
            is_bigendian=0,
            step=width,
            data=np.ascontiguousarray(image).ravel(),
        )
        self._write(_image_topic(camera_name), t_ns, message)

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
        self._write(IMU_TOPIC, sample.t_ns, message)

    def write_true_values(self, t_ns: int, values: Sequence[float]) -> None:
        x, y, z, qw, qx, qy, qz = map(float, values[:7])
        pose = self._types["geometry_msgs/msg/Pose"](
            position=self._types["geometry_msgs/msg/Point"](x=x, y=y, z=z),
            orientation=self._types["geometry_msgs/msg/Quaternion"](x=qx, y=qy, z=qz, w=qw),
        )
        message = self._types[_POSE](header=self._header(t_ns, "world"), pose=pose)
        self._write(GROUND_TRUTH_TOPIC, t_ns, message)
        vectors = np.reshape(values[7:], ((len(values) - 7) // 3, 3))
        for topic, frame_id, vector in zip(TRUE_VECTOR_TOPICS, ("world", "imu0", "imu0"), vectors, strict=False):
            message = self._types[_VECTOR](header=self._header(t_ns, frame_id), vector=self._vector(vector))
            self._write(topic, t_ns, message)

    def _write(self, topic: str, t_ns: int, message: Any) -> None:
        self._recorded_ns = max(self._recorded_ns, t_ns)
        self._connect(topic, message.__msgtype__)
        self._bag.write(self._connections[topic], self._recorded_ns, self._serialize(message, message.__msgtype__))

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

    def __init__(self, path: Path, compression: str | None, camera_names: Sequence[str]) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        bag = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        if compression is not None:
            bag.set_compression(CompressionMode.MESSAGE, CompressionFormat[compression.upper()])
        super().__init__(bag, camera_names, *_ros2_types())


class McapWriter(_RosWriter):
    """A single MCAP file of ROS 2 messages, chunks compressed with ``zstd`` or not."""

    def __init__(self, path: Path, compression: str | None, camera_names: Sequence[str]) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        self._path = path
        # rosbags writes a folder around the file.
        self._folder = path.with_name(f"{path.stem}.folder")
        bag = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compression is not None:
            bag.set_compression(CompressionMode.STORAGE, CompressionFormat[compression.upper()])
        super().__init__(bag, camera_names, *_ros2_types())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        if kind is None:
            next(self._folder.glob("*.mcap")).rename(self._path)
        shutil.rmtree(self._folder)


def _ros2_types() -> tuple[Any, Any, dict[str, int]]:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    return store, store.serialize_cdr, {}


def _image_topic(camera_name: str) -> str:
    return f"/{camera_name}/image_raw"


def _row(t_ns: int, values: Sequence[float]) -> str:
    """A line of comma-separated values; ``repr`` is the shortest text that reads back equal."""
    return ",".join([str(t_ns), *(repr(float(value)) for value in values)]) + "\n"
