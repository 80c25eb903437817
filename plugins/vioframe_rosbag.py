"""ROS recordings, read without ROS: ROS 1 ``.bag``, ROS 2 folders and ``.db3`` (sqlite3), and MCAP, compressed or not.

Topics are found by message type. Stamps are those of the message headers, not the times of recording.

The calibration is, in this order: the option ``calibration``; the folder ``<recording>.calib`` beside the recording, as
``vioframe convert`` writes it; EuRoC's published one, with a warning, where the recording looks like EuRoC's.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import DatasetError
from vioframe.interfaces import DatasetFactory
from vioframe.io.calibration import as_paths, load_calibration, packaged_calibration, sidecar_folder
from vioframe.io.images import check_bit_depth, check_size, decode_image, to_gray8
from vioframe.io.writers import GROUND_TRUTH_TOPIC
from vioframe.parts.hooks import hookimpl
from vioframe.types import NS_PER_S, Calibration, Frame, Image, ImuSample, Measurement, Unreadable

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

    from vioframe.geometry.trajectory import Trajectory

_log = logging.getLogger("vioframe.rosbag")

_RAW_IMAGE = "sensor_msgs/msg/Image"
_COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
_IMU = "sensor_msgs/msg/Imu"

_EUROC_CAMERA_TOPICS = ("/cam0/image_raw", "/cam1/image_raw")
_EUROC_IMU_TOPIC = "/imu0"
_EUROC_SHAPE = (480, 752)


class RosbagDataset:
    """One camera and one IMU of a ROS 1 or ROS 2 recording."""

    def __init__(
        self,
        path: Path,
        *,
        camera: Annotated[str | None, "camera to use, as in cam1: its topic and its calibration"] = None,
        camera_topic: Annotated[str | None, "image topic; by default that of the camera, or the first"] = None,
        imu_topic: Annotated[str | None, "IMU topic; by default the first"] = None,
        calibration: Annotated[list[Path] | Path | None, "calibration files or folder"] = None,
        bit_depth: Annotated[int | None, "bits in use in 16-bit images, 8 to 16"] = None,
    ) -> None:
        check_bit_depth(bit_depth)
        self._path = path
        self._bit_depth = bit_depth
        with _opened(path) as reader:
            self._camera_topic = _choose_camera(reader, path, camera_topic, camera)
            self._imu_topic = _choose_topic(reader, path, (_IMU,), imu_topic, "IMU")
            self.frame_count: int = reader.topics[self._camera_topic].msgcount
            first = next((m for m in self._messages(reader, self._camera_topic) if isinstance(m, Frame)), None)
        if first is None:
            raise DatasetError(f"{path}: no image of {self._camera_topic} can be read")
        self.calibration = self._find_calibration(calibration, camera or self._camera_topic, first.image)
        check_size(first.image, self.calibration.camera, self._where)

    @staticmethod
    def accepts(path: Path) -> bool:
        """Whether ``path`` is named like a recording, or is a folder that holds one of ROS 2."""
        if path.is_dir():
            return (path / "metadata.yaml").is_file() or any(path.glob("*.db3")) or any(path.glob("*.mcap"))
        return path.suffix in (".bag", ".db3", ".mcap")

    @property
    def name(self) -> str:
        path = self._path.resolve()
        return path.name if path.is_dir() else path.stem

    @property
    def ground_truth(self) -> Trajectory | None:
        """That of a simulated recording. Motion capture is not aligned in time: other truth comes from a file."""
        from vioframe.geometry.trajectory import Trajectory

        with _opened(self._path) as reader:
            connections = [connection for connection in reader.connections if connection.topic == GROUND_TRUTH_TOPIC]
            poses = [
                (_stamp_ns(message), astuple(message.pose.position), astuple(message.pose.orientation))
                for message in _deserialized(reader, connections, self._path)
            ]
        if not poses:
            return None
        t_ns, p_WB, quat_xyzw = (np.array(part) for part in zip(*poses, strict=True))
        return Trajectory.from_quat_xyzw(t_ns, p_WB[:, :3], quat_xyzw[:, :4])

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames in the order in which they were recorded."""
        with _opened(self._path) as reader:
            for measurement in self._messages(reader, self._camera_topic, self._imu_topic):
                if isinstance(measurement, Frame):
                    check_size(measurement.image, self.calibration.camera, self._where)
                yield measurement

    @property
    def _where(self) -> str:
        return f"{self._path} [{self._camera_topic}]"

    def _messages(self, reader: AnyReader, *topics: str) -> Iterator[Measurement]:
        connections = [connection for connection in reader.connections if connection.topic in topics]
        for message in _deserialized(reader, connections, self._path):
            yield _imu_sample(message) if hasattr(message, "angular_velocity") else self._frame(message)

    def _frame(self, message: Any) -> Frame | Unreadable:
        t_ns = _stamp_ns(message)
        image = _raw_image(message, self._where) if hasattr(message, "encoding") else decode_image(message.data)
        if image is None:
            return Unreadable(t_ns, "frame_unreadable", "the image's data are damaged or incomplete")
        return Frame(t_ns, to_gray8(image, self._bit_depth, self._where))

    def _find_calibration(self, files: list[Path] | Path | None, camera: str, image: Image) -> Calibration:
        if files:
            return load_calibration(*as_paths(files), camera=camera)
        sidecar = sidecar_folder(self._path)
        if sidecar.is_dir():
            return load_calibration(sidecar, camera=camera)
        topics_match = self._camera_topic in _EUROC_CAMERA_TOPICS and self._imu_topic == _EUROC_IMU_TOPIC
        if topics_match and image.shape == _EUROC_SHAPE:
            _log.warning(
                "%s brings no calibration and looks like EuRoC: using EuRoC's published calibration of %s",
                self._path.name,
                self._camera_topic.split("/")[1],
            )
            return packaged_calibration("euroc", camera=self._camera_topic)
        raise DatasetError(
            f"{self._path} brings no calibration; name its files with the option calibration, or put them in {sidecar}"
        )


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """The recording, open; raises :class:`DatasetError` where it cannot be."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not path.exists():
        raise DatasetError(f"{path} does not exist")
    try:
        for file in path.glob("*.db3") if path.is_dir() else [path]:
            _check_sqlite_size(file)
        # The type store serves older ROS 2 recordings, which bring no message definitions.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    # rosbags reports damage by whatever exception it stumbled on: AssertionError, struct.error, TypeError ...
    except Exception as err:
        raise _damaged(path, err) from err
    try:
        yield reader
    finally:
        reader.close()


def _deserialized(reader: AnyReader, connections: list[Any], path: Path) -> Iterator[Any]:
    """The messages of these connections in the order of recording; raises :class:`DatasetError` for damage."""
    if not connections:
        return  # rosbags takes no connections for all of them
    try:
        for connection, _, data in reader.messages(connections):
            yield reader.deserialize(data, connection.msgtype)
    except Exception as err:
        raise _damaged(path, err) from err


def _check_sqlite_size(file: Path) -> None:
    """Raise EOFError for a truncated sqlite file: sqlite itself reads what is missing of the last page as zeros."""
    with file.open("rb") as stream:
        header = stream.read(100)
    if header.startswith(b"SQLite format 3\0") and len(header) == 100:
        page_size = int.from_bytes(header[16:18], "big")
        page_size = 65536 if page_size == 1 else page_size
        if file.stat().st_size < page_size * int.from_bytes(header[28:32], "big"):
            raise EOFError(f"{file.name} is shorter than its header says")


def _damaged(path: Path, err: Exception) -> DatasetError:
    command = {".bag": "rosbag reindex", ".mcap": "mcap recover"}.get(path.suffix, "ros2 bag reindex")
    reason = " ".join(str(err).split()).rstrip(".") or type(err).__name__
    return DatasetError(
        f"cannot read {path}: {reason}; if it is truncated or was not closed, run `{command}` on it or copy it again"
    )


def _topics(reader: AnyReader, types: tuple[str, ...]) -> list[str]:
    """The topics of these types that have messages, in the order of the types, then by name."""
    found = {(types.index(c.msgtype), c.topic) for c in reader.connections if c.msgtype in types and c.msgcount}
    return [topic for _, topic in sorted(found)]


def _choose_camera(reader: AnyReader, path: Path, wanted: str | None, camera: str | None) -> str:
    types = (_RAW_IMAGE, _COMPRESSED_IMAGE)
    if wanted is None and camera is not None:
        # A camera that no topic is named after is one of the calibration's.
        wanted = next((topic for topic in _topics(reader, types) if camera in topic.split("/")), None)
    return _choose_topic(reader, path, types, wanted, "camera")


def _choose_topic(reader: AnyReader, path: Path, types: tuple[str, ...], wanted: str | None, sensor: str) -> str:
    topics = _topics(reader, types)
    if wanted is not None:
        if wanted not in topics:
            there = ", ".join(topics) or "none"
            raise DatasetError(f"{path} has no {sensor} messages on {wanted}; its {sensor} topics: {there}")
        return wanted
    if not topics:
        there = ", ".join(sorted({c.topic for c in reader.connections})) or "none"
        raise DatasetError(f"{path} has no {sensor} messages ({' or '.join(types)}); its topics: {there}")
    if len(topics) > 1:
        _log.info("%s: using %s of the %s topics %s", path.name, topics[0], sensor, ", ".join(topics))
    return topics[0]


def _stamp_ns(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def _imu_sample(message: Any) -> ImuSample:
    w, a = message.angular_velocity, message.linear_acceleration
    return ImuSample(_stamp_ns(message), np.array([w.x, w.y, w.z]), np.array([a.x, a.y, a.z]))


def _raw_image(message: Any, where: str) -> NDArray[Any] | None:
    """The pixels of a sensor_msgs/Image, mono8 without copying; None where there are fewer than its header says."""
    from rosbags.image import ImageError, message_to_cvimage
    from rosbags.image.image import to_cvtype

    try:
        bits, _, type_name, channels = to_cvtype(message.encoding)
        if bits > 16:
            raise ImageError(f"Format {message.encoding!r} is not supported")
        row_bytes = message.width * channels * np.dtype(type_name).itemsize
        if message.step < row_bytes or message.data.size < message.height * message.step:
            return None
        rows: NDArray[Any] = message.data[: message.height * message.step].reshape(message.height, message.step)[
            :, :row_bytes
        ]
        if message.encoding in ("mono8", "8UC1"):
            return rows
        # rosbags-image takes rows to be contiguous.
        packed = replace(message, data=np.ascontiguousarray(rows).ravel(), step=row_bytes)
        image: NDArray[Any] = message_to_cvimage(packed, "mono16" if bits == 16 else "mono8")
        return image
    except ImageError as err:
        raise DatasetError(f"{where}: {err}; convert the images to mono8, rgb8 or bgr8") from None


@hookimpl
def vioframe_datasets() -> Mapping[str, DatasetFactory]:
    return {"rosbag": RosbagDataset}
