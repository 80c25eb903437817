"""What each calibration format says, and EuRoC's written.

EuRoC / ASL (Burri et al., IJRR 2016): a ``sensor.yaml`` for each sensor, ``T_BS`` mapping sensor to body.

Kalibr's camchain-imucam and imu files, and OpenVINS' variants: ``T_cam_imu`` maps IMU to camera, OpenVINS'
``T_imu_cam`` is its inverse; ``timeshift_cam_imu`` has ``t_imu = t_cam + shift``.

VINS-Mono's single file (Qin, Li, Shen, T-RO 2018): ``extrinsicRotation`` and ``extrinsicTranslation`` map camera to
IMU, ``td`` is ``t_imu - t_cam``. Its ``acc_n, gyr_n, acc_w, gyr_w`` are *not* densities: the covariance is propagated
with ``(G dt) Q (G dt)^T`` (section IV-B), Q holding their squares, which a density sigma would enter as ``sigma^2 dt``.
So ``density = value * sqrt(dt)``.

VINS-Fusion's main file has the IMU's noise and ``td`` as VINS-Mono's, one for all cameras; ``body_T_cam0`` and
``body_T_cam1``, which map camera to IMU; and the names of the files in which the lenses are.

Basalt's ``calibration.json`` (Usenko et al., RA-L 2020): ``T_imu_cam`` maps camera to IMU, quaternions with the scalar
last; the noise is of continuous time, a figure an axis; ``cam_time_offset_ns`` is added to the stamps of all cameras.
Its ``kb4`` is the equidistant model (Kannala and Brandt 2006). Its double sphere (``ds``: Usenko, Demmel, Cremers, 3DV
2018) and unified models (``ucm``, ``eucm``), Kalibr's too, are told by the equidistant one: a lens that is the same all
round is a radius as a function of the angle from its axis, and up to 90 degrees from there five odd powers meet these
to a hundredth of a pixel. Rays farther out, which have no point on the z = 1 plane, no model here knows.

VINS-Mono's ``rolling_shutter_tr`` is the readout time, its stamps are those of the middle row. Kalibr's calibration of
a rolling shutter writes no file: it prints the time of one line.

Three keys are additions of this project. ``timeshift_cam_imu`` in EuRoC's files keeps a written calibration whole.
``readout_time``, in EuRoC's and Kalibr's, is that of a rolling shutter: rows times the time of one, the stamp being
that of the middle row. ``camera_rotation: unknown``, in both, says that nobody knows how the camera is turned on the
body, as VINS-Mono's ``estimate_extrinsic: 2`` does: of the transform beside it, if there is one, only the position
counts.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import AliasChoices, BaseModel, ConfigDict, Field, FiniteFloat, PlainValidator, PositiveInt
from pydantic import ValidationError as InvalidError

from vioframe.errors import CalibrationError, shown
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, DistortionModel
from vioframe.io.yaml import parse_yaml, read_yaml_text
from vioframe.types import NS_PER_S, Calibration, CameraOnBody, Float, ImuNoise

_log = logging.getLogger("vioframe.io.calibration")

ModelT = TypeVar("ModelT", bound=BaseModel)
Document = Mapping[str, Any]
"""A YAML file's top level, or a section of it."""

# OpenCV's dialect: a "%YAML:1.0" directive and "!!opencv-matrix" tags, neither of which is YAML.
_OPENCV_DIALECT = re.compile(r"^%YAML.*$|!!opencv-[\w-]+", re.MULTILINE)
# Projection moves the last bits of any rotation: one that is exact but for these is kept, so as to read back equal.
_ROUNDING = 1e-14
_CHAIN_CAMERA = re.compile(r"cam\d+")
# Beyond any number in these files: what is larger is damage, and would overflow on the way.
_LARGEST = 1e30
_LONGEST_SHIFT_S = 9e9  # an integer of nanoseconds holds no more
_Positive = Annotated[float, Field(gt=0.0, lt=_LARGEST)]
_Finite = Annotated[float, Field(gt=-_LARGEST, lt=_LARGEST)]
_Shift = Annotated[float, Field(gt=-_LONGEST_SHIFT_S, lt=_LONGEST_SHIFT_S)]
# No shutter takes a second; who writes milliseconds is told.
_Readout = Annotated[float, Field(gt=-1.0, lt=1.0)]
# A lens told by another model: as near as corners are found in the images it was calibrated with.
_NEAR_PX = 0.05
# VINS-Mono's file does not state the rate its noise parameters belong to; this is the one they were tuned for.
_VINS_MONO_RATE_HZ = 200.0


@dataclass(frozen=True, slots=True)
class CameraPart:
    """One camera of a calibration: ``T_BC`` (4, 4) maps camera points into the frame that the file refers to.

    ``topic`` is the image topic it was made from, where the file names one.
    """

    name: str
    model: Camera
    T_BC: Float
    time_offset_ns: int = 0
    rotation_known: bool = True
    topic: str | None = None
    readout_s: float = 0.0

    def on_body(self, T_BI: Float) -> CameraOnBody:
        """The camera as seen from the IMU, which ``T_BI`` (4, 4) maps into the same frame as ``T_BC``."""
        T_IC = inverse(T_BI) @ self.T_BC
        R_IC = T_IC[:3, :3] if self.rotation_known else np.eye(3)
        return CameraOnBody(
            self.name, self.model, R_IC, T_IC[:3, 3], self.time_offset_ns, self.rotation_known, self.readout_s
        )


@dataclass(frozen=True, slots=True)
class ImuPart:
    """One IMU: its noise, and ``T_BI`` (4, 4), which maps it into the frame that the cameras refer to."""

    noise: ImuNoise
    T_BI: Float


def read_yaml(path: Path) -> Document:
    """The top level of a YAML file, OpenCV's dialect and JSON included."""
    try:
        text = read_yaml_text(path)
    except (OSError, ValueError) as err:
        reason = err.strerror if isinstance(err, OSError) else err
        raise CalibrationError(f"cannot read the calibration {path}: {reason}") from None
    try:
        values = parse_yaml(_OPENCV_DIALECT.sub("", text))
    except ValueError as err:
        raise CalibrationError(f"{path} is not valid YAML: {err}") from None
    if not isinstance(values, Mapping):
        raise CalibrationError(f"{path} holds no calibration: expected 'key: value' lines")
    return {str(key): value for key, value in values.items()}


def is_calibration(document: Document) -> bool:
    """Whether a file is of one of the formats."""
    known = ("gyroscope_noise_density", "imu0", "cam0_calib")
    is_sensor = document.get("sensor_type") in ("camera", "imu")
    # A lens of VINS-Fusion's, which another file names, looks like VINS-Mono's without the IMU.
    is_vins_mono = "projection_parameters" in document and any(key in document for key in _VinsMono.OF_THE_IMU)
    is_basalt = isinstance(document.get("value0"), Mapping) and "T_imu_cam" in document["value0"]
    others = is_sensor or is_vins_mono or is_basalt or bool(_chain_cameras(document))
    return others or any(key in document for key in known)


def parts_of(document: Document, path: Path) -> tuple[list[CameraPart], list[ImuPart]]:
    """What one file describes. An EuRoC camera is named by its folder, or by its file where that is not sensor.yaml."""
    where = str(path)
    if "sensor_type" in document:
        if document["sensor_type"] == "imu":
            return [], [_imu(document, where, placed=True)]
        return [_camera(document, where, path.absolute().parent.name if path.stem == "sensor" else path.stem)], []
    if "projection_parameters" in document:
        camera, imu = _vins_mono(document, where)
        return [camera], [imu]
    if "cam0_calib" in document:
        return _vins_fusion(document, path)
    if "value0" in document:
        return _basalt(document["value0"], where)
    if cameras := _chain_cameras(document):
        return [_camera(document[key], f"{where} [{key}]", key) for key in cameras], []
    # The noise lies at the top level (Kalibr's input) or under imu0 (its result).
    nested = "imu0" in document
    return [], [_imu(document["imu0"], f"{where} [imu0]") if nested else _imu(document, where)]


def _chain_cameras(document: Document) -> list[str]:
    """``cam0``, ``cam1`` ...: the cameras of Kalibr's chain; empty where the file is none."""
    return [key for key in document if _CHAIN_CAMERA.fullmatch(key)]


def inverse(T_AB: Float) -> Float:
    """T_BA, (4, 4)."""
    T_BA = np.eye(4)
    T_BA[:3, :3] = T_AB[:3, :3].T
    T_BA[:3, 3] = -T_AB[:3, :3].T @ T_AB[:3, 3]
    return T_BA


def write_calibration(calibration: Calibration, folder: Path) -> None:
    """Write a ``sensor.yaml`` for each camera and for ``imu0`` below ``folder``; reading back gives equal values."""
    for camera in calibration.cameras:
        model, T_BC = camera.model, np.eye(4)
        T_BC[:3, 3] = camera.p_BC
        if camera.rotation_known:
            T_BC[:3, :3] = camera.R_BC
        distortion_model = "radial-tangential" if model.distortion_model == "radtan" else model.distortion_model
        _write(
            folder / camera.name / "sensor.yaml",
            "sensor_type: camera",
            *_transform_lines(T_BC),
            *([] if camera.rotation_known else ["camera_rotation: unknown  # the one in T_BS means nothing"]),
            f"resolution: {list(model.resolution)}",
            "camera_model: pinhole",
            f"intrinsics: {_list([model.fx, model.fy, model.cx, model.cy])}  # fu, fv, cu, cv",
            f"distortion_model: {distortion_model}",
            f"distortion_coefficients: {_list(model.distortion)}",
            f"timeshift_cam_imu: {camera.time_offset_ns / NS_PER_S!r}  # [s] t_imu = t_cam + shift",
            *([f"readout_time: {float(camera.readout_s)!r}  # [s] rolling shutter"] if camera.readout_s else []),
        )
    noise = calibration.imu
    _write(
        folder / "imu0" / "sensor.yaml",
        "sensor_type: imu",
        *_transform_lines(np.eye(4)),
        f"rate_hz: {float(noise.rate_hz)!r}",
        f"gyroscope_noise_density: {float(noise.gyro_density)!r}  # [rad/s/sqrt(Hz)]",
        f"gyroscope_random_walk: {float(noise.gyro_walk)!r}  # [rad/s^2/sqrt(Hz)]",
        f"accelerometer_noise_density: {float(noise.accel_density)!r}  # [m/s^2/sqrt(Hz)]",
        f"accelerometer_random_walk: {float(noise.accel_walk)!r}  # [m/s^3/sqrt(Hz)]",
    )


def _transform_lines(T_BS: Float) -> list[str]:
    rows = ",\n         ".join(_list(row)[1:-1] for row in T_BS)
    return ["T_BS:", "  cols: 4", "  rows: 4", f"  data: [{rows}]"]


def _list(values: object) -> str:
    return repr(np.asarray(values, dtype=np.float64).tolist())


def _write(path: Path, *lines: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _numbers(*counts: int) -> PlainValidator:
    """(N,) numbers with N one of ``counts``, from a list, a list of rows, or OpenCV's and EuRoC's rows, cols, data."""
    expected = " or ".join(map(str, counts))

    def read(value: Any) -> Float:
        try:
            array = np.asarray(value["data"] if isinstance(value, Mapping) else value, dtype=np.float64).ravel()
        except (TypeError, ValueError, KeyError, OverflowError):
            raise ValueError(f"should be {expected} numbers") from None
        if array.size not in counts or not (np.abs(array) < _LARGEST).all():
            raise ValueError(f"should be {expected} finite numbers")
        return array

    return PlainValidator(read)


class _Section(BaseModel):
    """Checked by code that is made when the first of it is read: of all these formats a run meets one."""

    model_config = ConfigDict(defer_build=True)


class _Camera(_Section):
    """A camera of EuRoC's (``T_BS``), of Kalibr's or of OpenVINS' (``T_cam_imu``, ``T_imu_cam``)."""

    camera_model: Literal["pinhole", "ds", "eucm"]
    intrinsics: Annotated[Float, _numbers(4, 6)]
    distortion_model: Literal["radtan", "radial-tangential", "plumb_bob", "none", "equidistant", "equi"]
    distortion: Annotated[Float, _numbers(0, 4, 5)] = Field(
        np.zeros(0), validation_alias=AliasChoices("distortion_coefficients", "distortion_coeffs")
    )
    resolution: Annotated[Float, _numbers(2)]
    timeshift_cam_imu: _Shift = 0.0
    readout_time: _Readout = 0.0
    camera_rotation: Literal["known", "unknown"] = "known"
    rostopic: str | None = None
    T_BS: Annotated[Float | None, _numbers(16)] = None
    T_imu_cam: Annotated[Float | None, _numbers(16)] = None
    T_cam_imu: Annotated[Float | None, _numbers(16)] = None


class _Imu(_Section):
    """EuRoC's or Kalibr's IMU: continuous-time densities, SI units; and OpenVINS' scale and misalignment matrices."""

    gyroscope_noise_density: _Positive
    accelerometer_noise_density: _Positive
    gyroscope_random_walk: _Positive
    accelerometer_random_walk: _Positive
    rate_hz: _Positive = Field(validation_alias=AliasChoices("rate_hz", "update_rate"))
    T_BS: Annotated[Float | None, _numbers(16)] = None
    Tw: Annotated[Float | None, _numbers(9)] = None
    Ta: Annotated[Float | None, _numbers(9)] = None
    R_IMUtoGYRO: Annotated[Float | None, _numbers(9)] = None
    R_IMUtoACC: Annotated[Float | None, _numbers(9)] = None


class _VinsLens(_Section):
    """How VINS-Mono and VINS-Fusion describe a lens."""

    model_type: Literal["PINHOLE", "KANNALA_BRANDT"]
    image_width: PositiveInt
    image_height: PositiveInt
    projection_parameters: dict[str, FiniteFloat]
    distortion_parameters: dict[str, FiniteFloat] = {}


class _VinsImu(_Section):
    """What the two say of the IMU and of its time, which is that of all cameras."""

    OF_THE_IMU: ClassVar = ("gyr_n", "acc_n", "gyr_w", "acc_w")

    estimate_extrinsic: int = 0
    td: _Shift = 0.0
    gyr_n: _Positive
    acc_n: _Positive
    gyr_w: _Positive
    acc_w: _Positive

    @property
    def imu(self) -> ImuPart:
        scale, rate_hz = 1.0 / sqrt(_VINS_MONO_RATE_HZ), _VINS_MONO_RATE_HZ
        noise = ImuNoise(scale * self.gyr_n, scale * self.acc_n, scale * self.gyr_w, scale * self.acc_w, rate_hz)
        return ImuPart(noise, np.eye(4))


class _VinsMono(_VinsLens, _VinsImu):
    """VINS-Mono's file: one camera and the IMU."""

    extrinsicRotation: Annotated[Float | None, _numbers(9)] = None
    extrinsicTranslation: Annotated[Float | None, _numbers(3)] = None
    rolling_shutter: int = 0
    rolling_shutter_tr: _Readout = 0.0
    image_topic: str | None = None


class _VinsFusion(_VinsImu):
    """VINS-Fusion's main file: the IMU, and where each camera is and in which file its lens."""

    num_of_cam: Literal[1, 2]
    cam0_calib: str
    cam1_calib: str | None = None
    body_T_cam0: Annotated[Float | None, _numbers(16)] = None
    body_T_cam1: Annotated[Float | None, _numbers(16)] = None
    image0_topic: str | None = None
    image1_topic: str | None = None


class _BasaltPose(_Section):
    px: _Finite
    py: _Finite
    pz: _Finite
    qx: _Finite
    qy: _Finite
    qz: _Finite
    qw: _Finite


class _BasaltLens(_Section):
    camera_type: Literal["pinhole", "pinhole-radtan8", "kb4", "ds", "ucm", "eucm"]
    intrinsics: dict[str, _Finite]


class _Basalt(_Section):
    """Basalt's calibration: all cameras and the IMU."""

    T_imu_cam: list[_BasaltPose]
    intrinsics: list[_BasaltLens]
    resolution: list[Annotated[Float, _numbers(2)]]
    calib_accel_bias: Annotated[Float, _numbers(9)] = Field(np.zeros(9))
    calib_gyro_bias: Annotated[Float, _numbers(12)] = Field(np.zeros(12))
    imu_update_rate: _Positive
    gyro_noise_std: Annotated[Float, _numbers(1, 3)]
    accel_noise_std: Annotated[Float, _numbers(1, 3)]
    gyro_bias_std: Annotated[Float, _numbers(1, 3)]
    accel_bias_std: Annotated[Float, _numbers(1, 3)]
    cam_time_offset_ns: Annotated[int, Field(gt=-_LONGEST_SHIFT_S * NS_PER_S, lt=_LONGEST_SHIFT_S * NS_PER_S)] = 0


def _parsed(model: type[ModelT], document: object, where: str) -> ModelT:
    """The document as ``model``; raises :class:`CalibrationError` naming the file and the first key that is wrong."""
    try:
        return model.model_validate(document)
    except InvalidError as invalid:
        error = invalid.errors()[0]
    if not error["loc"]:
        raise CalibrationError(f"{where} holds no calibration: expected 'key: value' lines")
    key = str(error["loc"][-1])
    if error["type"] == "missing":
        aliases = [field.validation_alias for field in model.model_fields.values()]
        names = next((a.choices for a in aliases if isinstance(a, AliasChoices) and key in a.choices), [key])
        raise CalibrationError(f"{where}: {' or '.join(map(repr, names))} is missing")
    problem = error["msg"].removeprefix("Value error, ").replace("Input should", "should")
    raise CalibrationError(f"{where}: {key!r} {problem}, not {shown(error['input'])}")


def _camera(document: object, where: str, name: str) -> CameraPart:
    said = _parsed(_Camera, document, where)
    width, height = said.resolution.tolist()
    resolution = int(width), int(height)
    if said.camera_model == "pinhole":
        model = _pinhole(said, resolution, where)
    else:
        if len(said.intrinsics) != 6 or said.distortion_model != "none":
            raise CalibrationError(f"{where}: {said.camera_model!r} has six intrinsics, and distortion_model: none")
        first, second, *pinhole = said.intrinsics.tolist()
        model = _radial(said.camera_model, first, second, pinhole, resolution, where)
    known, offset_ns = said.camera_rotation == "known", _nanoseconds(said.timeshift_cam_imu)
    return CameraPart(name, model, _T_BC(said, known, where), offset_ns, known, said.rostopic, said.readout_time)


def _pinhole(said: _Camera, resolution: tuple[int, int], where: str) -> Camera:
    if len(said.intrinsics) != 4:
        raise CalibrationError(f"{where}: 'intrinsics' of a pinhole camera should be four, fx fy cx cy")
    distortion = np.zeros(4) if said.distortion_model == "none" else said.distortion
    if len(distortion) < 4 or distortion[4:].any():
        raise CalibrationError(f"{where}: distortion needs four coefficients, and no fifth (k3); recalibrate with four")
    fx, fy, cx, cy = said.intrinsics.tolist()
    k1, k2, k3, k4 = distortion[:4].tolist()
    is_fisheye = said.distortion_model in ("equidistant", "equi")
    return _model((fx, fy, cx, cy, k1, k2, k3, k4), resolution, "equidistant" if is_fisheye else "radtan", where)


def _model(numbers: Sequence[float], resolution: tuple[int, int], kind: DistortionModel, where: str) -> Camera:
    """From fx fy cx cy and the four coefficients of distortion."""
    fx, fy, cx, cy, d1, d2, d3, d4 = numbers
    try:
        return Camera(fx, fy, cx, cy, (d1, d2, d3, d4), resolution, kind)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None


def _radial(
    kind: str, first: float, second: float, pinhole: Sequence[float], resolution: tuple[int, int], where: str
) -> Camera:
    """The equidistant camera nearest to a double sphere ``ds`` of xi and alpha, or an ``eucm`` of alpha and beta.

    ``pinhole`` has fx fy cx cy. It is fitted to the angles that the image shows, 90 degrees from the axis at most.
    """
    f, c = np.split(np.array(pinhole), 2)
    angle = np.linspace(0.0, 0.5 * np.pi, 1001)[1:]
    sin, cos = np.sin(angle), np.cos(angle)
    with np.errstate(all="ignore"):
        corner = np.hypot(*(np.maximum(c, resolution - c) / f))
        if kind == "ds":
            radius = sin / (second * np.sqrt(sin**2 + (first + cos) ** 2) + (1.0 - second) * (first + cos))
        else:
            radius = sin / (first * np.sqrt(second * sin**2 + cos**2) + (1.0 - first) * cos)
    shown = np.logical_and.accumulate((np.diff(radius, prepend=0.0) > 0.0) & (radius <= corner))
    powers = angle[shown, None] ** np.arange(1, 10, 2)
    if np.count_nonzero(shown) > 2 * powers.shape[1]:
        scale, *higher = np.linalg.lstsq(powers, radius[shown])[0].tolist()
        off_px = f.max() * np.abs(powers @ [scale, *higher] - radius[shown]).max()
        if scale > 0.0 and off_px < _NEAR_PX:
            numbers = [*(scale * f), *c, *(power / scale for power in higher)]
            return _model(numbers, resolution, "equidistant", where)
    raise CalibrationError(
        f"{where}: no lens of four coefficients is like this {kind!r} to within {_NEAR_PX:g} px; calibrate again with "
        "Basalt's 'kb4' or Kalibr's 'pinhole-equi'"
    )


def _T_BC(said: _Camera, known: bool, where: str) -> Float:
    """(4, 4), without rotation where that is not ``known``."""
    key, T = ("T_BS", said.T_BS) if said.T_BS is not None else ("T_imu_cam", said.T_imu_cam)
    if T is not None:
        return _rigid_transform(T, key, where) if known else _transform(np.eye(3), T.reshape(4, 4)[:3, 3])
    if said.T_cam_imu is None and not known:
        return np.eye(4)
    if said.T_cam_imu is None:
        raise CalibrationError(
            f"{where}: T_cam_imu (or T_imu_cam, or T_BS) is missing; use the result of kalibr_calibrate_imu_camera"
        )
    if not known:
        raise CalibrationError(
            f"{where}: T_cam_imu tells no position where the rotation is unknown; give T_imu_cam, or neither"
        )
    return inverse(_rigid_transform(said.T_cam_imu, "T_cam_imu", where))


def _imu(document: object, where: str, *, placed: bool = False) -> ImuPart:
    """``placed`` where it has a ``T_BS``; else it is the frame that the cameras refer to."""
    said = _parsed(_Imu, document, where)
    for key in ("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC"):
        matrix = getattr(said, key)
        if matrix is not None and not np.allclose(matrix.reshape(3, 3), np.eye(3), atol=1e-9):
            _log.warning("%s: %s is not the identity and is not applied", where, key)
    if placed and said.T_BS is None:
        raise CalibrationError(f"{where}: 'T_BS' is missing")
    noise = ImuNoise(
        gyro_density=said.gyroscope_noise_density,
        accel_density=said.accelerometer_noise_density,
        gyro_walk=said.gyroscope_random_walk,
        accel_walk=said.accelerometer_random_walk,
        rate_hz=said.rate_hz,
    )
    return ImuPart(noise, np.eye(4) if said.T_BS is None else _rigid_transform(said.T_BS, "T_BS", where))


def _vins_mono(document: Document, where: str) -> tuple[CameraPart, ImuPart]:
    said = _parsed(_VinsMono, document, where)
    known, R_BC, p_BC = said.estimate_extrinsic != 2, np.eye(3), said.extrinsicTranslation
    if known and (said.extrinsicRotation is None or p_BC is None):
        raise CalibrationError(f"{where}: 'extrinsicRotation' or 'extrinsicTranslation' is missing")
    if known and said.extrinsicRotation is not None:
        R_BC = _rotation(said.extrinsicRotation.reshape(3, 3), "extrinsicRotation", where)
    T_BC = _transform(R_BC, np.zeros(3) if p_BC is None else p_BC)
    readout_s = said.rolling_shutter_tr if said.rolling_shutter else 0.0
    model = _vins_lens(said, where)
    return CameraPart("cam0", model, T_BC, _nanoseconds(said.td), known, said.image_topic, readout_s), said.imu


def _vins_fusion(document: Document, path: Path) -> tuple[list[CameraPart], list[ImuPart]]:
    said = _parsed(_VinsFusion, document, str(path))
    cameras = []
    for name in ("cam0", "cam1")[: said.num_of_cam]:
        if (file := getattr(said, f"{name}_calib")) is None:
            raise CalibrationError(f"{path}: '{name}_calib' is missing")
        lens = _parsed(_VinsLens, read_yaml(path.parent / file), str(path.parent / file))
        known, T, key = said.estimate_extrinsic != 2, getattr(said, f"body_T_{name}"), f"body_T_{name}"
        if T is None and known:
            raise CalibrationError(f"{path}: {key!r} is missing")
        T_BC = np.eye(4)
        if T is not None:
            T_BC = _rigid_transform(T, key, str(path)) if known else _transform(np.eye(3), T.reshape(4, 4)[:3, 3])
        topic = said.image0_topic if name == "cam0" else said.image1_topic
        model = _vins_lens(lens, str(path.parent / file))
        cameras.append(CameraPart(name, model, T_BC, _nanoseconds(said.td), known, topic))
    return cameras, [said.imu]


def _vins_lens(said: _VinsLens, where: str) -> Camera:
    is_pinhole = said.model_type == "PINHOLE"
    keys = "fx fy cx cy k1 k2 p1 p2" if is_pinhole else "mu mv u0 v0 k2 k3 k4 k5"
    parameters = said.distortion_parameters | said.projection_parameters
    if missing := [key for key in keys.split() if key not in parameters]:
        raise CalibrationError(f"{where}: {missing[0]!r} is missing")
    resolution = said.image_width, said.image_height
    numbers = [parameters[key] for key in keys.split()]
    return _model(numbers, resolution, "radtan" if is_pinhole else "equidistant", where)


def _basalt(document: object, where: str) -> tuple[list[CameraPart], list[ImuPart]]:
    said = _parsed(_Basalt, document, where)
    if not len(said.T_imu_cam) == len(said.intrinsics) == len(said.resolution):
        raise CalibrationError(f"{where}: 'T_imu_cam', 'intrinsics' and 'resolution' should be of as many cameras")
    cameras = []
    for number, (pose, lens, size) in enumerate(zip(said.T_imu_cam, said.intrinsics, said.resolution, strict=True)):
        name = f"cam{number}"
        quat_xyzw = np.array([pose.qx, pose.qy, pose.qz, pose.qw])
        if not np.isclose(np.linalg.norm(quat_xyzw), 1.0, atol=1e-3):
            raise CalibrationError(f"{where} [{name}]: 'qx', 'qy', 'qz', 'qw' are no rotation: their norm is not 1")
        T_BC = _transform(so3.from_quat_xyzw(quat_xyzw), np.array([pose.px, pose.py, pose.pz]))
        width, height = size.tolist()
        model = _basalt_lens(lens, (int(width), int(height)), f"{where} [{name}]")
        cameras.append(CameraPart(name, model, T_BC, said.cam_time_offset_ns))
    for key, values in (("calib_accel_bias", said.calib_accel_bias), ("calib_gyro_bias", said.calib_gyro_bias)):
        if not np.allclose(values[3:], 0.0, atol=1e-9):
            _log.warning("%s: %s has scale and misalignment, which are not applied", where, key)
    keys = ("gyro_noise_std", "accel_noise_std", "gyro_bias_std", "accel_bias_std")
    # One figure for all axes: the largest.
    gyro_density, accel_density, gyro_walk, accel_walk = (float(getattr(said, key).max()) for key in keys)
    for key, value in zip(keys, (gyro_density, accel_density, gyro_walk, accel_walk), strict=True):
        if value <= 0.0:
            raise CalibrationError(f"{where}: {key!r} should be greater than 0, not {value:g}")
    noise = ImuNoise(gyro_density, accel_density, gyro_walk, accel_walk, said.imu_update_rate)
    return cameras, [ImuPart(noise, np.eye(4))]


def _basalt_lens(said: _BasaltLens, resolution: tuple[int, int], where: str) -> Camera:
    kind = said.camera_type
    of_model = {"kb4": "k1 k2 k3 k4", "pinhole-radtan8": "k1 k2 p1 p2", "ds": "xi alpha", "ucm": "alpha"}
    of_model |= {"eucm": "alpha beta", "pinhole": ""}
    keys = ["fx", "fy", "cx", "cy", *of_model[kind].split()]
    if missing := [key for key in keys if key not in said.intrinsics]:
        raise CalibrationError(f"{where}: {missing[0]!r} is missing")
    numbers = [said.intrinsics[key] for key in keys]
    if kind == "pinhole-radtan8" and any(said.intrinsics.get(key) for key in ("k3", "k4", "k5", "k6")):
        raise CalibrationError(f"{where}: distortion needs k1 k2 p1 p2, and no k3 to k6; calibrate again with 'kb4'")
    if kind in ("ds", "ucm", "eucm"):
        # The unified model is the extended one with beta = 1.
        first, second = numbers[4:] if kind != "ucm" else (numbers[4], 1.0)
        return _radial("ds" if kind == "ds" else "eucm", first, second, numbers[:4], resolution, where)
    numbers += [0.0] * (8 - len(numbers))
    return _model(numbers, resolution, "equidistant" if kind == "kb4" else "radtan", where)


def _rigid_transform(values: Float, key: str, where: str) -> Float:
    """(4, 4) from the ``values`` (16,) of ``key``, its rotation made exactly orthonormal."""
    T = values.reshape(4, 4)
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise CalibrationError(f"{where}: the last row of {key!r} should be 0 0 0 1")
    return _transform(_rotation(T[:3, :3], key, where), T[:3, 3])


def _rotation(R: Float, key: str, where: str) -> Float:
    """The rotation nearest to ``R`` (3, 3), which must be close to one; ``R`` itself where it is one already."""
    off = np.abs(R @ R.T - np.eye(3)).max()
    if not off <= 1e-3 or np.linalg.det(R) < 0.0:
        raise CalibrationError(f"{where}: {key!r} holds no rotation: its rows are not orthonormal and right-handed")
    return R if off < _ROUNDING else so3.project(R)


def _transform(R_BC: Float, p_BC: Float) -> Float:
    """T_BC, (4, 4)."""
    T_BC = np.eye(4)
    T_BC[:3, :3], T_BC[:3, 3] = R_BC, p_BC
    return T_BC


def _nanoseconds(seconds: float) -> int:
    return round(seconds * NS_PER_S)
