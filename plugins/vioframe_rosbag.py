"""ROS recordings, read without ROS: ROS 1 ``.bag``, ROS 2 folders and ``.db3`` (sqlite3), and MCAP, compressed or not.

Topics are found by message type, and told apart by the names of the calibrated cameras or the topics that these were
calibrated from. Stamps are those of the message headers, not the times of recording.

The calibration is, in this order: the option ``calibration``; the folder ``<recording>.calib`` beside the recording, as
``vioframe convert`` writes it; EuRoC's published one, with a warning, where the recording looks like EuRoC's.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import chain, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, BinaryIO

import numpy as np

from vioframe.errors import DatasetError
from vioframe.interfaces import DatasetFactory
from vioframe.io.ahead import decoded_ahead
from vioframe.io.calibration import PACKAGED, match_cameras, no_calibration, sidecar_folder
from vioframe.io.images import check_bit_depth, frame_set, gathered
from vioframe.io.ros import imu_sample, is_compressed, pixels, stamp_ns
from vioframe.io.writers import GROUND_TRUTH_TOPIC, TRUE_VECTOR_TOPICS
from vioframe.parts.hooks import hookimpl
from vioframe.types import FrameSet, Measurement, Unreadable

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

    from vioframe.geometry.trajectory import Trajectory

_log = logging.getLogger("vioframe.rosbag")

_RAW_IMAGE = "sensor_msgs/msg/Image"
_COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
_IMU = "sensor_msgs/msg/Imu"

_LARGEST_CHUNK = 1 << 29
"""Bytes that a chunk, or a message that is compressed alone, may expand to."""
_MOST_EXPANSION = 100
"""Of a file that is compressed as a whole, which may be large."""

_EUROC_CAMERA_TOPICS = ("/cam0/image_raw", "/cam1/image_raw")
_EUROC_IMU_TOPIC = "/imu0"
_EUROC_SHAPE = (480, 752)


class RosbagDataset:
    """Cameras and one IMU of a ROS 1 or ROS 2 recording."""

    def __init__(
        self,
        path: Path,
        *,
        cameras: Annotated[
            list[str] | str | None, "cameras to use, by name, by topic or as NAME:TOPIC; by default all calibrated ones"
        ] = None,
        imu_topic: Annotated[str | None, "IMU topic; by default the first"] = None,
        calibration: Annotated[list[Path] | Path | None, "calibration files or folder"] = None,
        bit_depth: Annotated[int | None, "bits in use in 16-bit images, 8 to 16"] = None,
    ) -> None:
        check_bit_depth(bit_depth)
        self._path = path
        self._bit_depth = bit_depth
        wanted = [cameras] if isinstance(cameras, str) else cameras
        with _opened(path) as reader:
            topics = _topics(reader, path, (_RAW_IMAGE, _COMPRESSED_IMAGE), "camera")
            for topic in [camera[camera.index("/") :] for camera in wanted or () if "/" in camera]:
                _check_topic(path, topic, topics, "camera")
            imu_topics = _topics(reader, path, (_IMU,), "IMU")
            self._imu_topic = imu_topic or imu_topics[0]
            _check_topic(path, self._imu_topic, imu_topics, "IMU")
            files = self._calibration_files(calibration, reader, topics)
            self.calibration, self._topics = match_cameras(files, topics, wanted)
            self._tell_choice(
                [t for t in topics if t not in self._topics] if wanted is None else [],
                [t for t in imu_topics if t != self._imu_topic] if imu_topic is None else [],
            )
            for topic in self._topics:
                if not any(isinstance(m, FrameSet) for m in self._messages(reader, topic)):
                    raise DatasetError(f"{path}: no image of {topic} can be read")
            counts = [reader.topics[topic].msgcount for topic in self._topics]
        # Which images of several cameras belong together is told by their stamps: to count these is to read them all.
        self.frame_count: int | None = counts[0] if len(counts) == 1 else None

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
        """That of a recording of vioframe's. Motion capture is not aligned in time: other truth comes from a file."""
        from vioframe.io.trajectories import TrueTrajectory

        poses: dict[int, list[float]] = {}
        vectors: dict[str, dict[int, list[float]]] = {topic: {} for topic in TRUE_VECTOR_TOPICS}
        with _opened(self._path) as reader:
            for topic, message in self._deserialized(reader, GROUND_TRUTH_TOPIC, *TRUE_VECTOR_TOPICS):
                t_ns = stamp_ns(message)
                if topic == GROUND_TRUTH_TOPIC:
                    p, q = message.pose.position, message.pose.orientation
                    poses[t_ns] = [p.x, p.y, p.z, q.w, q.x, q.y, q.z]
                else:
                    vectors[topic][t_ns] = [message.vector.x, message.vector.y, message.vector.z]
        if not poses:
            return None
        known = list(takewhile(lambda of_stamp: of_stamp.keys() == poses.keys(), vectors.values()))
        rows = [[*pose, *chain.from_iterable(of_stamp[t_ns] for of_stamp in known)] for t_ns, pose in poses.items()]
        return TrueTrajectory.of(np.array(list(poses)), np.array(rows))

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames in the order in which they were recorded."""
        with _opened(self._path) as reader:
            yield from gathered(self._messages(reader, *self._topics, self._imu_topic))

    def _tell_choice(self, cameras: list[str], imus: list[str]) -> None:
        """Which topics are read, where there are others that nobody has decided against."""
        if others := [*cameras, *imus]:
            hints = [f"--cameras {topic}" for topic in cameras[:1]] + [f"-o imu_topic={topic}" for topic in imus[:1]]
            _log.warning(
                *("%s: %s and %s are read, %s left aside; to choose: %s", self._path.name, ", ".join(self._topics)),
                *(self._imu_topic, ", ".join(others), " ".join(hints)),
            )

    def _messages(self, reader: AnyReader, *topics: str) -> Iterator[Measurement]:
        return decoded_ahead(self._undecoded(reader, *topics))

    def _undecoded(self, reader: AnyReader, *topics: str) -> Iterator[Measurement | Callable[[], Measurement]]:
        for topic, message in self._deserialized(reader, *topics):
            if topic == self._imu_topic:
                yield imu_sample(message)
            else:
                yield partial(self._frame, topic, message) if is_compressed(message) else self._frame(topic, message)

    def _frame(self, topic: str, message: Any) -> FrameSet | Unreadable:
        t_ns, where = stamp_ns(message), f"{self._path} [{topic}]"
        image = pixels(message, where)
        if image is None:
            return Unreadable(t_ns, "frame_unreadable", f"the image's data on {topic} are damaged or incomplete")
        return frame_set(t_ns, image, self._topics.index(topic), self.calibration, self._bit_depth, where)

    def _deserialized(self, reader: AnyReader, *topics: str) -> Iterator[tuple[str, Any]]:
        """Topic and message, in the order of recording; raises :class:`DatasetError` for damage."""
        connections = [connection for connection in reader.connections if connection.topic in topics]
        if not connections:
            return  # rosbags takes no connections for all of them
        try:
            for connection, _, data in reader.messages(connections):
                yield connection.topic, reader.deserialize(data, connection.msgtype)
        except Exception as err:
            raise _damaged(self._path, err) from err

    def _calibration_files(self, given: list[Path] | Path | None, reader: AnyReader, topics: list[str]) -> list[Path]:
        if given:
            return [given] if isinstance(given, Path) else given
        within = (self._path.parent / "metadata.yaml").is_file()  # a file of a ROS 2 recording
        sidecars = [sidecar_folder(path) for path in (self._path, *[self._path.parent] * within)]
        if there := [sidecar for sidecar in sidecars if sidecar.is_dir()]:
            return there[:1]
        as_eurocs = [topic for topic in topics if topic in _EUROC_CAMERA_TOPICS and self._imu_topic == _EUROC_IMU_TOPIC]
        _, first = next(self._deserialized(reader, *as_eurocs), (None, None))
        if first is not None and hasattr(first, "height") and (first.height, first.width) == _EUROC_SHAPE:
            _log.warning(
                "%s brings no calibration and looks like EuRoC: using EuRoC's published calibration", self._path.name
            )
            return [PACKAGED / "euroc"]
        raise no_calibration(self._path, sidecars[-1])


@contextmanager
def _opened(path: Path) -> Iterator[AnyReader]:
    """The recording, open; raises :class:`DatasetError` where it cannot be."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not path.exists():
        raise DatasetError(f"{path} does not exist")
    if not (path.is_file() or path.is_dir()):
        raise DatasetError(f"{path} is no ordinary file: a recording is read more than once")
    _bound_decompression()
    try:
        for file in path.glob("*.db3") if path.is_dir() else [path]:
            _check_sqlite_size(file)
        # It serves older recordings of ROS 2, which bring no definitions of messages, and takes a tenth of a second.
        types = None if path.suffix == ".bag" else get_typestore(Stores.LATEST)
        reader = AnyReader([path], default_typestore=types)
        reader.open()
    # rosbags reports damage by whatever exception it stumbled on: AssertionError, struct.error, TypeError ...
    except Exception as err:
        raise _damaged(path, err) from err
    try:
        yield reader
    finally:
        reader.close()


def _bound_decompression() -> None:
    """Have rosbags decompress no chunk, message or file beyond its bound: a few bytes can expand to any size.

    It has no setting for that, but tables of what decompresses.
    """
    import bz2
    from types import SimpleNamespace

    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap as mcap

    def bounded(decompressor: Callable[[], Any]) -> Callable[..., bytes]:
        def decompress(data: bytes, _: object = None) -> bytes:
            under_way = decompressor()
            out: bytes = under_way.decompress(data, max_length=_LARGEST_CHUNK + 1)
            if len(out) > _LARGEST_CHUNK:
                raise DatasetError(f"a chunk of the recording expands to more than {_LARGEST_CHUNK >> 20} MiB")
            if not under_way.eof:
                raise EOFError("a compressed chunk is incomplete")
            return out

        return decompress

    zstd = vars(mcap)["zstd"]

    @contextmanager
    def bounded_file(stream: BinaryIO, mode: str) -> Iterator[_Bounded]:
        with zstd.open(stream, mode) as expanded:
            yield _Bounded(expanded, _LARGEST_CHUNK + _MOST_EXPANSION * os.fstat(stream.fileno()).st_size)

    by_lz4, by_zstd = bounded(LZ4FrameDecompressor), bounded(zstd.ZstdDecompressor)
    ros1.decompressors |= {"bz2": bounded(bz2.BZ2Decompressor), "lz4": by_lz4}
    mcap.DECOMPRESSORS |= {"lz4": by_lz4, "zstd": by_zstd}
    vars(ros2)["zstd"] = SimpleNamespace(decompress=by_zstd, open=bounded_file)


class _Bounded:
    """A stream of which no more than ``limit`` bytes can be read."""

    def __init__(self, stream: BinaryIO, limit: int) -> None:
        self._stream, self._left = stream, limit

    def read(self, count: int) -> bytes:
        out = self._stream.read(count)
        self._left -= len(out)
        if self._left < 0:
            raise DatasetError(f"the compressed recording expands more than {_MOST_EXPANSION}-fold")
        return out


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
    if isinstance(err, DatasetError):
        return err if str(path) in str(err) else DatasetError(f"{path}: {err}")
    command = {".bag": "rosbag reindex", ".mcap": "mcap recover"}.get(path.suffix, "ros2 bag reindex")
    reason = " ".join(str(err).split()).rstrip(".") or type(err).__name__
    return DatasetError(
        f"cannot read {path}: {reason}; if it is truncated or was not closed, run `{command}` on it or copy it again"
    )


def _topics(reader: AnyReader, path: Path, types: tuple[str, ...], sensor: str) -> list[str]:
    """The topics of these types that have messages, in the order of the types, then by name; at least one."""
    found = {(types.index(c.msgtype), c.topic) for c in reader.connections if c.msgtype in types and c.msgcount}
    if not found:
        there = ", ".join(sorted({c.topic for c in reader.connections})) or "none"
        raise DatasetError(f"{path} has no {sensor} messages ({' or '.join(types)}); its topics: {there}")
    return [topic for _, topic in sorted(found)]


def _check_topic(path: Path, wanted: str, topics: list[str], sensor: str) -> None:
    if wanted not in topics:
        there = ", ".join(topics)
        raise DatasetError(f"{path} has no {sensor} messages on {wanted}; its {sensor} topics: {there}")


@hookimpl
def vioframe_datasets() -> Mapping[str, DatasetFactory]:
    return {"rosbag": RosbagDataset}
