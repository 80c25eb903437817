"""Calibration files in the formats people have, told apart by their content: EuRoC, Kalibr, OpenVINS, VINS, Basalt."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from vioframe.errors import CalibrationError, DatasetError, shown
from vioframe.io.calibration.formats import (
    CameraPart,
    Document,
    ImuPart,
    is_calibration,
    parts_of,
    read_yaml,
    write_calibration,
)
from vioframe.types import Calibration

__all__ = [
    "PACKAGED",
    "load_calibration",
    "match_cameras",
    "no_calibration",
    "packaged_calibration",
    "sidecar_folder",
    "write_calibration",
]

PACKAGED = Path(__file__).parent / "data"

_FORMATS = "EuRoC, Kalibr, OpenVINS, VINS-Mono, the main file of VINS-Fusion, Basalt"


def load_calibration(*paths: str | Path, cameras: Sequence[str] | None = None) -> Calibration:
    """A rig from calibration files, or from folders holding them.

    Understood are EuRoC's ``sensor.yaml`` (of each sensor, a sequence or its ``mav0``), Kalibr's camchain-imucam with
    its imu file, OpenVINS' ``estimator_config.yaml`` or the two chains it names, VINS-Mono's single file, VINS-Fusion's
    main file, which names those of the lenses, and Basalt's ``calibration.json``.

    ``cameras`` are names such as ``cam1`` or image topics such as ``/cam1/image_raw``, in the order wanted; without it
    there are all, in the order of their names. Raises :class:`~vioframe.errors.CalibrationError`.
    """
    where = ", ".join(map(str, paths))
    found, imu = _read(paths, where)
    chosen = found if cameras is None else [_select(found, wanted, where) for wanted in cameras]
    return _rig(chosen, imu)


def packaged_calibration(name: str, cameras: Sequence[str] | None = None) -> Calibration:
    """A calibration that ships with vioframe: ``euroc``, as published; it is the same in all eleven sequences."""
    return load_calibration(PACKAGED / name, cameras=cameras)


def match_cameras(
    paths: Sequence[Path], sources: Sequence[str], cameras: Sequence[str] | None
) -> tuple[Calibration, tuple[str, ...]]:
    """The rig whose images a recording holds, and the source of each of its cameras.

    ``sources`` are the image topics, or folders, of the recording. A camera's is the topic that its calibration names,
    or else the first that bears the camera's name, or else the only one there can be. ``cameras`` are those wanted,
    each by name, by source, or as ``NAME:SOURCE`` where neither tells the other; None is all that have images. Raises
    :class:`~vioframe.errors.CalibrationError`.
    """
    where = ", ".join(map(str, paths))
    found, imu = _read(paths, where)
    pairs = [(part, source) for part in found if (source := _source_of(part, sources))]
    lone = len(found) == 1 or (len(sources) == 1 and not pairs)
    if cameras is not None:
        pairs = []
        for wanted in cameras:
            name, _, source = wanted.partition(":")
            part = _select(found, name, where)
            source = source or (name if name in sources else _source_of(part, sources) or "")
            if not source and not lone:
                raise _no_images(part.name, sources)
            pairs.append((part, source or sources[0]))
    elif not pairs:
        if len(found) > 1:
            raise _no_images(found[0].name, sources)
        pairs = [(found[0], sources[0])]
    return _rig([part for part, _ in pairs], imu), tuple(source for _, source in pairs)


CALIBRATION_FILES = ("*/sensor.yaml",)
"""What :func:`write_calibration` writes, as patterns."""


def sidecar_folder(recording: Path) -> Path:
    """Where the calibration of a recording that cannot hold one is kept: ``flight.bag.calib`` beside ``flight.bag``."""
    recording = recording.absolute()
    return recording.with_name(f"{recording.name}.calib")


def no_calibration(recording: Path, sidecar: Path) -> DatasetError:
    """What to say of a recording that was given no calibration, and has none in its ``sidecar`` folder."""
    return DatasetError(
        f"{recording} brings no calibration: --calibration FILE names one, and {sidecar} is where it is looked for"
    )


def _rig(cameras: Iterable[CameraPart], imu: ImuPart) -> Calibration:
    return Calibration(tuple(part.on_body(imu.T_BI) for part in cameras), imu.noise)


def _read(paths: Iterable[str | Path], where: str) -> tuple[list[CameraPart], ImuPart]:
    """All cameras, in the order of their names, and the IMU."""
    cameras: list[CameraPart] = []
    imus: list[ImuPart] = []
    for document, path in _documents(map(Path, paths)):
        found_cameras, found_imus = parts_of(document, path)
        cameras += found_cameras
        imus += found_imus
    if not cameras:
        raise CalibrationError(f"no camera is described in {where}; name the camera's YAML file too")
    if not imus:
        raise CalibrationError(f"no IMU noise is given in {where}; name the IMU's YAML file too")
    if len({part.name for part in cameras}) < len(cameras) or len({part.noise for part in imus}) > 1:
        raise CalibrationError(f"{where} describes a camera or the IMU more than once; name the files to use")
    return sorted(cameras, key=lambda part: part.name), imus[0]


def _documents(paths: Iterable[Path]) -> Iterator[tuple[Document, Path]]:
    """The files behind ``paths``; in a folder those that are no calibration are passed over."""
    for path in paths:
        if path.is_dir():
            for file in _files_in(path):
                if is_calibration(document := read_yaml(file)):
                    yield document, file
            continue
        document = read_yaml(path)
        if "relative_config_imucam" in document:
            for key in ("relative_config_imucam", "relative_config_imu"):
                if key not in document:
                    raise CalibrationError(f"{path}: {key!r} is missing")
                if not isinstance(document[key], str):
                    raise CalibrationError(f"{path}: {key!r} should be a file's name, not {shown(document[key])}")
                file = path.parent / document[key]
                yield read_yaml(file), file
        elif is_calibration(document):
            yield document, path
        else:
            raise CalibrationError(f"{path}: not a calibration of a known format ({_FORMATS})")


def _files_in(folder: Path) -> list[Path]:
    for pattern in ("mav0/*/sensor.yaml", "*/sensor.yaml", "*.y*ml", "*.json"):
        # A pipe that nobody writes to would be waited for without end.
        if files := sorted(file for file in folder.glob(pattern) if file.is_file()):
            return files
    raise CalibrationError(f"there is no calibration file (sensor.yaml, *.yaml, *.json) in the folder {folder}")


def _select(cameras: list[CameraPart], wanted: str, where: str) -> CameraPart:
    """The camera of that name or topic; a lone camera answers to any topic."""
    for part in cameras:
        if wanted in (part.name, part.topic) or part.name in wanted.split("/"):
            return part
    if len(cameras) == 1 and wanted.startswith("/"):
        return cameras[0]
    names = ", ".join(part.name for part in cameras)
    raise CalibrationError(f"{where} describes no camera {wanted!r}; choose one of: {names}")


def _source_of(part: CameraPart, sources: Sequence[str]) -> str | None:
    if part.topic in sources:
        return part.topic
    return next((source for source in sources if part.name in source.split("/")), None)


def _no_images(camera: str, sources: Sequence[str]) -> CalibrationError:
    return CalibrationError(
        f"it is not clear which images are those of {camera}: there are {', '.join(sources)}; "
        f"say so, as in --cameras {camera}:{sources[0]}"
    )
