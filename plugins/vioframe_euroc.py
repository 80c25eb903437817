"""The ASL folder layout of EuRoC: ``mav0/cam0/data.csv`` and images, ``mav0/imu0/data.csv``, a ``sensor.yaml`` each.

A camera is a folder with a table ``data.csv`` and a folder ``data`` of images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from heapq import merge
from itertools import islice
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated

import numpy as np

from vioframe.errors import DatasetError, shortened, shown
from vioframe.interfaces import DatasetFactory
from vioframe.io.ahead import decoded_ahead
from vioframe.io.calibration import match_cameras
from vioframe.io.images import check_bit_depth, decode_image, frame_set, gathered
from vioframe.parts.hooks import hookimpl
from vioframe.types import FrameSet, ImuSample, Measurement, Unreadable

if TYPE_CHECKING:
    from vioframe.geometry.trajectory import Trajectory

_LARGEST_IMAGE = 1 << 28
"""Bytes of an image file."""
# An IMU row counts as due when one of it and the next few rows is: a single wild stamp must not hold up all the rest.
_ROWS_AHEAD = 5
# Half of what 64 bits hold: the time between any two stamps fits as well.
_LATEST_NS = 2**62


class EurocDataset:
    """A sequence in ASL layout: its cameras, one IMU, and the ground truth where there is one."""

    def __init__(
        self,
        path: Path,
        *,
        cameras: Annotated[list[str] | str | None, "folders of the cameras to use; by default all"] = None,
        imu: Annotated[str, "folder of the IMU to use"] = "imu0",
        calibration: Annotated[list[Path] | Path | None, "calibration files or folder, instead of sensor.yaml"] = None,
        bit_depth: Annotated[int | None, "bits in use in 16-bit images, 8 to 16"] = None,
    ) -> None:
        check_bit_depth(bit_depth)
        self._mav0 = _mav0(path)
        self._bit_depth = bit_depth
        wanted = [cameras] if isinstance(cameras, str) else cameras
        imu_file = self._table(imu)
        folders = self._camera_folders(wanted)
        if calibration:
            files = [calibration] if isinstance(calibration, Path) else calibration
        else:
            described = [name for name in folders if (self._mav0 / name / "sensor.yaml").is_file()]
            files = [self._mav0 / name / "sensor.yaml" for name in (*(described or folders), imu)]
        self.calibration, self._folders = match_cameras(files, list(folders), wanted)
        rows = [[(t_ns, place, file) for t_ns, file in folders[name]] for place, name in enumerate(self._folders)]
        self._images = list(merge(*rows, key=lambda row: row[0]))
        self._imu_name, self._imu_lines = imu_file.name, _csv_lines(imu_file)
        if not any(isinstance(row, ImuSample) for row in self._imu()):
            raise DatasetError(f"{imu_file} holds no sample; the recording has no IMU data")

    def _camera_folders(self, wanted: list[str] | None) -> dict[str, list[tuple[int, str]]]:
        """The stamp and file of each image in the folders wanted, or in all that list some."""
        if wanted is None:
            names = sorted(folder.parent.name for folder in self._mav0.glob("*/data") if folder.is_dir())
        else:
            names = [camera.rpartition(":")[2] for camera in wanted]
        rows = {name: list(_frame_rows(self._table(name))) for name in names or ["cam0"]}
        if empty := [name for name in rows if not rows[name] and (wanted or not any(rows.values()))]:
            raise DatasetError(f"{self._mav0 / empty[0] / 'data.csv'} lists no image; the recording has no camera data")
        return {name: images for name, images in rows.items() if images}

    def _table(self, sensor: str) -> Path:
        file = self._mav0 / sensor / "data.csv"
        if not file.is_file():
            there = ", ".join(sorted(file.parent.name for file in self._mav0.glob("*/data.csv")))
            choice = f"choose by --cameras NAME and -o imu=NAME among: {there}"
            remedy = choice if there else "no sensor is there; copy it again"
            raise DatasetError(f"{file} is {'no ordinary file' if file.exists() else 'missing'}; {remedy}")
        return file

    @staticmethod
    def accepts(path: Path) -> bool:
        """Whether ``path`` is a sequence with a ``mav0`` folder, or such a folder."""
        return path.is_dir() and ((path / "mav0").is_dir() or path.absolute().name == "mav0")

    @property
    def name(self) -> str:
        return self._mav0.parent.name

    @property
    def frame_count(self) -> int:
        stamps = [t_ns for t_ns, _, _ in self._images]
        return len(stamps) if len(self._folders) == 1 else len(set(stamps))

    @property
    def ground_truth(self) -> Trajectory | None:
        file = self._mav0 / "state_groundtruth_estimate0" / "data.csv"
        if not file.is_file():
            return None
        from vioframe.io.trajectories import load_trajectory

        return load_trajectory(file)

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames, each in the order of their file."""
        return gathered(decoded_ahead(self._read()))

    def _read(self) -> Iterator[Measurement | Callable[[], Measurement]]:
        imu = self._imu()
        taken = 0
        due = _rows_due(list(_imu_stamps(self._imu_lines)), [t_ns for t_ns, _, _ in self._images])
        for image, count in zip(self._images, due, strict=True):
            yield from islice(imu, max(0, count - taken))
            taken = max(taken, count)
            yield partial(self._frame, *image)
        yield from imu

    def _imu(self) -> Iterator[ImuSample | Unreadable]:
        return _imu_rows(self._imu_name, self._imu_lines)

    def _frame(self, t_ns: int, place: int, file: str) -> FrameSet | Unreadable:
        folder = self._mav0 / self._folders[place]
        path = folder / "data" / file
        # A recording from elsewhere may name any file of this machine, or a pipe that nobody writes to.
        named = PurePath(file)
        if named.is_absolute() or ".." in named.parts:
            return Unreadable(t_ns, "frame_unreadable", f"{shortened(file)} leads out of {folder.name}/data")
        try:
            if not path.is_file() and path.exists():
                return Unreadable(t_ns, "frame_unreadable", f"{path.name} is no ordinary file")
            if path.is_file() and path.stat().st_size > _LARGEST_IMAGE:
                return Unreadable(t_ns, "frame_unreadable", f"{path.name} is larger than {_LARGEST_IMAGE >> 20} MiB")
            image = decode_image(path.read_bytes(), str(path))
        except (OSError, ValueError) as err:  # no file can have a name with a zero byte in it
            reason = err.strerror if isinstance(err, OSError) else err
            return Unreadable(t_ns, "frame_unreadable", f"{shortened(path.name)}: {reason}")
        if image is None:
            return Unreadable(t_ns, "frame_unreadable", f"{path.name} is damaged")
        return frame_set(t_ns, image, place, self.calibration, self._bit_depth, str(folder))


def _mav0(path: Path) -> Path:
    """The ``mav0`` folder of a sequence, or ``path`` itself if it is one."""
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; an ASL data set is the folder that holds mav0/")
    path = path.resolve()
    if (path / "mav0").is_dir():
        return path / "mav0"
    if path.name == "mav0":
        return path
    raise DatasetError(f"{path} holds no mav0/; name the folder of one sequence in ASL layout")


def _csv_lines(file: Path) -> list[str]:
    """The rows of a csv file, without comments and a heading."""
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise DatasetError(f"cannot read {file}: {' '.join(str(err).split())}") from None
    if lines and not lines[0][:1].isdigit():
        del lines[0]
    return [line for line in lines if line.strip() and not line.startswith("#")]


def _frame_rows(file: Path) -> Iterator[tuple[int, str]]:
    """Stamp and image file of each frame."""
    for line in _csv_lines(file):
        row = line.split(",")
        try:
            t_ns = _stamp_ns(row[0])
        except ValueError:
            raise DatasetError(f"{file}: {shown(line)} does not begin with a stamp in integer nanoseconds") from None
        yield t_ns, row[1].strip() if len(row) > 1 else f"{t_ns}.png"


def _imu_rows(name: str, lines: Iterable[str]) -> Iterator[ImuSample | Unreadable]:
    """The samples of the file ``name``; a row that is none takes the place, and the stamp, of its predecessor's."""
    t_ns = 0
    for line in lines:
        row = line.split(",")
        try:
            wx, wy, wz, ax, ay, az = map(float, row[1:7])
            t_ns = _stamp_ns(row[0])
        except ValueError:
            yield Unreadable(t_ns, "imu_unreadable", f"{name}: {shown(line)} is no stamp with six readings")
        else:
            yield ImuSample(t_ns, np.array([wx, wy, wz]), np.array([ax, ay, az]))


def _imu_stamps(lines: Iterable[str]) -> Iterator[int]:
    """The stamp of each row, or where that is none its predecessor's; readings are read when their turn comes."""
    t_ns = 0
    for line in lines:
        with suppress(ValueError):
            t_ns = _stamp_ns(line.partition(",")[0])
        yield t_ns


def _stamp_ns(text: str) -> int:
    """Raises :class:`ValueError` where ``text`` is no integer, or none that a stamp can be."""
    t_ns = int(text)
    if abs(t_ns) > _LATEST_NS:
        raise ValueError("it is centuries away")
    return t_ns


def _rows_due(imu_t_ns: list[int], frame_t_ns: list[int]) -> list[int]:
    """For each frame, how many IMU rows come before it in time, wild stamps overlooked."""
    stamps = np.array(imu_t_ns, dtype=np.int64)
    due_ns = stamps.copy()
    for ahead in range(1, _ROWS_AHEAD + 1):
        np.minimum(due_ns[:-ahead], stamps[ahead:], out=due_ns[:-ahead])
    counts: list[int] = np.searchsorted(np.maximum.accumulate(due_ns), frame_t_ns, side="right").tolist()
    return counts


@hookimpl
def vioframe_datasets() -> Mapping[str, DatasetFactory]:
    return {"euroc": EurocDataset}
