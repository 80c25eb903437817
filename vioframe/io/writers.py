"""Writers of recordings, one a format, all with the same methods; see :mod:`vioframe.io.convert`."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry import so3
from vioframe.types import NS_PER_S, Float, Frame, ImuSample, NavState

CAMERA_TOPIC = "/cam0/image_raw"
IMU_TOPIC = "/imu0"
GROUND_TRUTH_TOPIC = "/vioframe/ground_truth"
"""Poses of the body in W, exact and on the camera's clock: of simulated recordings only."""

# ROS 2 keeps seconds in 32 bits with a sign.
_ROS_STAMP_LIMIT_NS = 2**31 * NS_PER_S

_IMAGE = "sensor_msgs/msg/Image"
_IMU = "sensor_msgs/msg/Imu"
_POSE = "geometry_msgs/msg/PoseStamped"
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

    def write_frame(self, frame: Frame) -> None: ...

    def write_imu(self, sample: ImuSample) -> None: ...

    def write_truth(self, state: NavState) -> None: ...


class TruthFile:
    """A ground-truth file of EuRoC's: pose, and velocity and biases as far as the states know them (are not NaN)."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("w", encoding="utf-8")
        self._columns = 0

    def write(self, state: NavState) -> None:
        x, y, z, w = so3.to_quat_xyzw(state.R_WB).tolist()
        known = np.concatenate([state.v_WB, state.bias_gyro_B, state.bias_accel_B])
        if not self._columns:
            self._columns = 8 + int(np.isfinite(known).sum())
            self._file.write(",".join(_TRUTH_HEADING[: self._columns]) + "\n")
        values = [*state.p_WB.tolist(), w, x, y, z, *known.tolist()][: self._columns - 1]
        self._file.write(",".join([str(state.t_ns), *map(repr, values)]) + "\n")

    def close(self) -> None:
        self._file.close()


class AslWriter:
    """An ASL folder: ``mav0/cam0`` with lossless images, ``mav0/imu0``, and ``mav0/state_groundtruth_estimate0`` where
    the truth is known; numbers are written so as to read back equal."""

    def __init__(self, folder: Path) -> None:
        self._truth_folder = folder / "mav0" / "state_groundtruth_estimate0"
        self._truth: TruthFile | None = None
        self._images = folder / "mav0" / "cam0" / "data"
        self._images.mkdir(parents=True)
        (folder / "mav0" / "imu0").mkdir()
        self._frames = (folder / "mav0" / "cam0" / "data.csv").open("w", encoding="utf-8")
        self._imu = (folder / "mav0" / "imu0" / "data.csv").open("w", encoding="utf-8")
        self._frames.write(_FRAME_HEADING)
        self._imu.write(_IMU_HEADING)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._frames.close()
        self._imu.close()
        if self._truth is not None:
            self._truth.close()

    def write_frame(self, frame: Frame) -> None:
        import cv2

        # The fastest level: these files are a few per cent larger than at the default one.
        _, png = cv2.imencode(".png", frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        (self._images / f"{frame.t_ns}.png").write_bytes(png.tobytes())
        self._frames.write(f"{frame.t_ns},{frame.t_ns}.png\n")

    def write_imu(self, sample: ImuSample) -> None:
        readings = [*sample.gyro_B.tolist(), *sample.accel_B.tolist()]
        self._imu.write(",".join([str(sample.t_ns), *map(repr, readings)]) + "\n")

    def write_truth(self, state: NavState) -> None:
        if self._truth is None:
            self._truth_folder.mkdir()
            self._truth = TruthFile(self._truth_folder / "data.csv")
        self._truth.write(state)


class _RosWriter:
    """What ROS 1 and ROS 2 have in common: messages, and a time of recording that keeps them in the order they came."""

    def __init__(self, bag: Any, store: Any, serialize: Any, header_extra: dict[str, int]) -> None:
        self._bag = bag
        self._store = store
        self._types = store.types
        self._serialize = serialize
        self._header_extra = header_extra
        self._recorded_ns = 0
        bag.open()
        # rosbags reads messages of the same time in the order of their topics: the IMU first, as from an ASL folder.
        self._imu = bag.add_connection(IMU_TOPIC, _IMU, typestore=store)
        self._camera = bag.add_connection(CAMERA_TOPIC, _IMAGE, typestore=store)
        self._truth: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bag.__exit__(kind, error, trace)

    def write_frame(self, frame: Frame) -> None:
        height, width = frame.image.shape
        message = self._types[_IMAGE](
            header=self._header(frame.t_ns, "cam0"),
            height=height,
            width=width,
            encoding="mono8",
            is_bigendian=0,
            step=width,
            data=np.ascontiguousarray(frame.image).ravel(),
        )
        self._write(self._camera, _IMAGE, frame.t_ns, message)

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
        self._write(self._imu, _IMU, sample.t_ns, message)

    def write_truth(self, state: NavState) -> None:
        if self._truth is None:
            self._truth = self._bag.add_connection(GROUND_TRUTH_TOPIC, _POSE, typestore=self._store)
        position, quat = state.p_WB.tolist(), so3.to_quat_xyzw(state.R_WB).tolist()
        pose = self._types["geometry_msgs/msg/Pose"](
            position=self._types["geometry_msgs/msg/Point"](**dict(zip("xyz", position, strict=True))),
            orientation=self._types["geometry_msgs/msg/Quaternion"](**dict(zip("xyzw", quat, strict=True))),
        )
        message = self._types[_POSE](header=self._header(state.t_ns, "world"), pose=pose)
        self._write(self._truth, _POSE, state.t_ns, message)

    def _write(self, connection: Any, message_type: str, t_ns: int, message: Any) -> None:
        self._recorded_ns = max(self._recorded_ns, t_ns)
        self._bag.write(connection, self._recorded_ns, self._serialize(message, message_type))

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

    def __init__(self, path: Path, compression: str | None) -> None:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore

        bag = Writer(path)
        if compression is not None:
            bag.set_compression(Writer.CompressionFormat[compression.upper()])
        store = get_typestore(Stores.ROS1_NOETIC)
        super().__init__(bag, store, store.serialize_ros1, {"seq": 0})


class Ros2Writer(_RosWriter):
    """A ROS 2 bag: a folder with ``metadata.yaml`` and sqlite3 storage, messages compressed with ``zstd`` or not."""

    def __init__(self, path: Path, compression: str | None) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        bag = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
        if compression is not None:
            bag.set_compression(CompressionMode.MESSAGE, CompressionFormat[compression.upper()])
        super().__init__(bag, *_ros2_types())


class McapWriter(_RosWriter):
    """A single MCAP file of ROS 2 messages, chunks compressed with ``zstd`` or not."""

    def __init__(self, path: Path, compression: str | None) -> None:
        from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

        self._path = path
        # rosbags writes a folder around the file.
        self._folder = path.with_name(f"{path.stem}.folder")
        bag = Writer(self._folder, version=9, storage_plugin=StoragePlugin.MCAP)
        if compression is not None:
            bag.set_compression(CompressionMode.STORAGE, CompressionFormat[compression.upper()])
        super().__init__(bag, *_ros2_types())

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
