"""One recording format into another: ASL folder, ROS 1 bag, ROS 2 bag, MCAP; stamps, pixels and readings stay exact.

A converted recording holds every camera under its name (a folder ``cam0``, a topic ``/cam0/image_raw``), the IMU
(``imu0``, ``/imu0``), the ground truth where its source brings one, and the calibration: as ``sensor.yaml`` in an ASL
folder, beside any other in the folder ``<name>.calib``. For the truth's topics see :mod:`vioframe.io.writers`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vioframe.errors import DatasetError
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import CALIBRATION_FILES, sidecar_folder, write_calibration
from vioframe.io.replace import appearing
from vioframe.io.writers import AslWriter, McapWriter, RecordingWriter, Ros1Writer, Ros2Writer
from vioframe.types import Calibration, FrameSet, ImuSample, Measurement, Unreadable


@dataclass(frozen=True, slots=True)
class Format:
    """A recording format that can be written: ``open(path, compression, camera_names)`` begins one.

    ``files`` are patterns of what is in it, where it is a folder.
    """

    description: str
    open: Callable[[Path, str | None, Sequence[str]], RecordingWriter]
    compressions: tuple[str, ...] = ()
    files: tuple[str, ...] = ()


FORMATS = {
    "asl": Format(
        "ASL folder, as EuRoC's",
        lambda path, _, camera_names: AslWriter(path, camera_names),
        files=("mav0/*/data.csv", "mav0/*/data/*.png", "mav0/*/sensor.yaml"),
    ),
    "ros1": Format("ROS 1 bag", Ros1Writer, ("bz2", "lz4")),
    "ros2": Format("ROS 2 bag, a folder with sqlite3 storage", Ros2Writer, ("zstd",), ("metadata.yaml", "*.db3*")),
    "mcap": Format("MCAP file with ROS 2 messages", McapWriter, ("zstd",)),
}


@dataclass(frozen=True, slots=True)
class Conversion:
    """How much was written, frame sets and true poses among it, and how much of the source could not be read."""

    frames: int
    imu_samples: int
    true_poses: int
    unreadable: int


def format_of(destination: Path) -> str:
    """The format a destination's name asks for: ``.bag`` is ROS 1, ``.mcap`` MCAP, ``.ros2`` or ``rosbag2...`` a ROS 2
    folder, and no extension an ASL folder. Raises :class:`~vioframe.errors.DatasetError` for any other."""
    if destination.suffix == ".ros2" or destination.name.startswith("rosbag2"):
        return "ros2"
    by_suffix = {".bag": "ros1", ".mcap": "mcap", "": "asl"}
    if destination.suffix not in by_suffix:
        raise DatasetError(
            f"the name {destination.name} tells no format; use NAME.bag (ROS 1), NAME.mcap, NAME.ros2 (ROS 2 folder) "
            "or NAME without extension (ASL folder), or state the format"
        )
    return by_suffix[destination.suffix]


def convert(
    measurements: Iterable[Measurement],
    calibration: Calibration,
    destination: Path,
    *,
    truth: Trajectory | None = None,
    format: str | None = None,
    compression: str | None = None,
) -> Conversion:
    """Write a data set's measurements, calibration and ground truth to ``destination``.

    It appears only once it is complete. Where the ``truth`` is a :class:`~vioframe.io.trajectories.TrueTrajectory`, as
    the built-in readers give it, its numbers are written as they are, velocity and biases included.

    ``format`` is a key of :data:`FORMATS`, by default told by the name (:func:`format_of`); ``compression`` is one that
    the format offers. Raises :class:`~vioframe.errors.DatasetError`, also where the destination exists.
    """
    format = format or format_of(destination)
    if format not in FORMATS:
        raise DatasetError(f"there is no format {format!r}; choose one of: {', '.join(FORMATS)}")
    offered = FORMATS[format].compressions
    if compression is not None and compression not in offered:
        raise DatasetError(f"{format} offers no compression {compression!r}; it has: {', '.join(offered) or 'none'}")
    with appearing(destination) as unfinished:
        camera_names = [camera.name for camera in calibration.cameras]
        with FORMATS[format].open(unfinished, compression, camera_names) as writer:
            counts = write_recording(measurements, truth, [writer])
        if not counts.frames or not counts.imu_samples:
            raise DatasetError(f"nothing to write to {destination}: the source has no readable frame or no IMU sample")
        if format == "asl":
            write_calibration(calibration, unfinished / "mav0")
        else:
            write_sidecar(calibration, destination)
    return counts


def write_recording(
    measurements: Iterable[Measurement], truth: Trajectory | None, writers: Sequence[RecordingWriter]
) -> Conversion:
    """Hand everything to each of ``writers``."""
    counts: Counter[type] = Counter()
    for writer in writers:
        if truth is not None:
            writer.write_truth(truth)
    for measurement in measurements:
        for writer in writers:
            if isinstance(measurement, FrameSet):
                writer.write_frame(measurement)
            elif isinstance(measurement, ImuSample):
                writer.write_imu(measurement)
        counts[type(measurement)] += 1
    return Conversion(counts[FrameSet], counts[ImuSample], 0 if truth is None else len(truth), counts[Unreadable])


def write_sidecar(calibration: Calibration, recording: Path) -> None:
    """Calibration files beside ``recording``, in place of those that were written there before.

    To be written before the recording appears, so that none ever stands without its calibration.
    """
    with appearing(sidecar_folder(recording), replace=CALIBRATION_FILES) as unfinished:
        write_calibration(calibration, unfinished)
