"""Calibration files in the formats people have: EuRoC, Kalibr, OpenVINS and VINS-Mono, told apart by their content."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from vioframe.errors import CalibrationError
from vioframe.io.calibration import euroc, kalibr, vins_mono
from vioframe.io.calibration.euroc import write_calibration
from vioframe.io.calibration.fields import Fields, read_yaml
from vioframe.io.calibration.parts import CameraPart, ImuPart, inverse
from vioframe.types import Calibration

__all__ = ["as_paths", "load_calibration", "packaged_calibration", "sidecar_folder", "write_calibration"]

_PACKAGED = Path(__file__).parent / "data"


def load_calibration(*paths: str | Path, camera: str | None = None) -> Calibration:
    """One camera and one IMU from calibration files, or from folders holding them.

    Understood are EuRoC's ``sensor.yaml`` (both files, a sequence or its ``mav0``), Kalibr's camchain-imucam with its
    imu file, OpenVINS' ``estimator_config.yaml`` or the two chains it names, and VINS-Mono's single file.

    ``camera`` is a name such as ``cam1`` or an image topic such as ``/cam1/image_raw``; without it the first camera is
    taken. Raises :class:`~vioframe.errors.CalibrationError`.
    """
    where = ", ".join(map(str, paths))
    cameras: list[CameraPart] = []
    imus: list[ImuPart] = []
    for fields, path in _documents([Path(path) for path in paths]):
        found_cameras, found_imus = _parts(fields, path)
        cameras += found_cameras
        imus += found_imus
    if not cameras:
        raise CalibrationError(f"no camera is described in {where}; name the camera's YAML file too")
    if not imus:
        raise CalibrationError(f"no IMU noise is given in {where}; name the IMU's YAML file too")
    names = [part.name for part in cameras]
    if len(set(names)) < len(names) or len({part.noise for part in imus}) > 1:
        raise CalibrationError(f"{where} describes a camera or the IMU more than once; name the files to use")
    part = _select(sorted(cameras, key=lambda part: part.name or ""), camera, where)
    T_IC = inverse(imus[0].T_BI) @ part.T_BC
    return Calibration(part.camera, T_IC[:3, :3], T_IC[:3, 3], imus[0].noise, part.time_offset_ns)


def as_paths(files: Path | Iterable[Path]) -> list[Path]:
    """A reader's option that names one file or several, as a list."""
    return [files] if isinstance(files, Path) else list(files)


def packaged_calibration(name: str, camera: str | None = None) -> Calibration:
    """A calibration that ships with vioframe: ``euroc``, as published; it is the same in all eleven sequences."""
    return load_calibration(_PACKAGED / name, camera=camera)


def sidecar_folder(recording: Path) -> Path:
    """Where the calibration of a recording that cannot hold one is kept: ``flight.bag.calib`` beside ``flight.bag``."""
    recording = recording.absolute()
    return recording.with_name(f"{recording.name}.calib")


def _documents(paths: Iterable[Path]) -> Iterator[tuple[Fields, Path]]:
    """The YAML files behind ``paths``; in a folder those that are no calibration are passed over."""
    for path in paths:
        if path.is_dir():
            for file in _files_in(path):
                if _is_calibration(fields := read_yaml(file)):
                    yield fields, file
        else:
            fields = read_yaml(path)
            if "relative_config_imucam" in fields:
                for key in ("relative_config_imucam", "relative_config_imu"):
                    file = path.parent / fields.text(key)
                    yield read_yaml(file), file
            elif _is_calibration(fields):
                yield fields, path
            else:
                raise fields.fail("not a calibration of a known format (EuRoC, Kalibr, OpenVINS, VINS-Mono)")


def _files_in(folder: Path) -> list[Path]:
    for pattern in ("mav0/*/sensor.yaml", "*/sensor.yaml", "*.y*ml"):
        if files := sorted(folder.glob(pattern)):
            return files
    raise CalibrationError(f"there is no calibration file (sensor.yaml, *.yaml) in the folder {folder}")


def _is_calibration(fields: Fields) -> bool:
    known = ("gyroscope_noise_density", "imu0", "extrinsicRotation")
    is_sensor = "sensor_type" in fields and fields.text("sensor_type") in ("camera", "imu")
    return is_sensor or any(key in fields for key in known) or bool(kalibr.camera_keys(fields))


def _parts(fields: Fields, path: Path) -> tuple[list[CameraPart], list[ImuPart]]:
    """What one file describes. An EuRoC camera is named by its folder, or by its file where that is not sensor.yaml."""
    if "sensor_type" in fields:
        if fields.text("sensor_type") == "imu":
            return [], [euroc.imu_part(fields)]
        return [euroc.camera_part(fields, path.absolute().parent.name if path.stem == "sensor" else path.stem)], []
    if "extrinsicRotation" in fields:
        return [vins_mono.camera_part(fields)], [vins_mono.imu_part(fields)]
    cameras = [kalibr.camera_part(fields, key) for key in kalibr.camera_keys(fields)]
    return cameras, [] if cameras else [kalibr.imu_part(fields)]


def _select(cameras: list[CameraPart], wanted: str | None, where: str) -> CameraPart:
    if wanted is None:
        return cameras[0]
    for part in cameras:
        if wanted == part.name or wanted == part.topic or (part.name and part.name in wanted.split("/")):
            return part
    # A lone camera answers to any topic, and to any name if it has none of its own.
    if len(cameras) == 1 and (wanted.startswith("/") or cameras[0].name is None):
        return cameras[0]
    names = ", ".join(str(part.name) for part in cameras)
    raise CalibrationError(f"{where} describes no camera {wanted!r}; choose one of: {names}")
