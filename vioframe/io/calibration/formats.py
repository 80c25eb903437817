"""What each calibration format says, and EuRoC's written.

EuRoC / ASL (Burri et al., IJRR 2016): a ``sensor.yaml`` for each sensor, ``T_BS`` mapping sensor to body.

Kalibr's camchain-imucam and imu files, and OpenVINS' variants: ``T_cam_imu`` maps IMU to camera, OpenVINS'
``T_imu_cam`` is its inverse; ``timeshift_cam_imu`` has ``t_imu = t_cam + shift``.

VINS-Mono's single file (Qin, Li, Shen, T-RO 2018): ``extrinsicRotation`` and ``extrinsicTranslation`` map camera to
IMU, ``td`` is ``t_imu - t_cam``. Its ``acc_n, gyr_n, acc_w, gyr_w`` are *not* densities: the covariance is propagated
with ``(G dt) Q (G dt)^T`` (section IV-B), Q holding their squares, which a density sigma would enter as ``sigma^2 dt``.
So ``density = value * sqrt(dt)``.

Two keys are additions of this project. ``timeshift_cam_imu`` in EuRoC's files keeps a written calibration whole.
``camera_rotation: unknown``, in EuRoC's and Kalibr's, says that nobody knows how the camera is turned on the body, as
VINS-Mono's ``estimate_extrinsic: 2`` does: of the transform beside it, if there is one, only the position counts.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from math import sqrt
from pathlib import Path

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, DistortionModel
from vioframe.io.calibration.fields import Fields
from vioframe.types import NS_PER_S, Calibration, CameraOnBody, Float, ImuNoise

_log = logging.getLogger("vioframe.io.calibration")

_DISTORTION: dict[str, DistortionModel] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "none": "radtan",
    "equidistant": "equidistant",
    "equi": "equidistant",
}
# Projection moves the last bits of any rotation: one that is exact but for these is kept, so as to read back equal.
_ROUNDING = 1e-14
_CHAIN_CAMERA = re.compile(r"cam\d+")
# OpenVINS' IMU intrinsics: scale and misalignment matrices, identity where they were not calibrated.
_IMU_INTRINSICS = ("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC")
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

    def on_body(self, T_BI: Float) -> CameraOnBody:
        """The camera as seen from the IMU, which ``T_BI`` (4, 4) maps into the same frame as ``T_BC``."""
        T_IC = inverse(T_BI) @ self.T_BC
        R_IC = T_IC[:3, :3] if self.rotation_known else np.eye(3)
        return CameraOnBody(self.name, self.model, R_IC, T_IC[:3, 3], self.time_offset_ns, self.rotation_known)


@dataclass(frozen=True, slots=True)
class ImuPart:
    """One IMU: its noise, and ``T_BI`` (4, 4), which maps it into the frame that the cameras refer to."""

    noise: ImuNoise
    T_BI: Float


def is_calibration(fields: Fields) -> bool:
    """Whether a file is of one of the formats."""
    is_sensor = "sensor_type" in fields and fields.text("sensor_type") in ("camera", "imu")
    known = ("gyroscope_noise_density", "imu0", "projection_parameters")
    return is_sensor or any(key in fields for key in known) or bool(_chain_cameras(fields))


def parts_of(fields: Fields, path: Path) -> tuple[list[CameraPart], list[ImuPart]]:
    """What one file describes. An EuRoC camera is named by its folder, or by its file where that is not sensor.yaml."""
    if "sensor_type" in fields:
        if fields.text("sensor_type") == "imu":
            return [], [ImuPart(_imu_noise(fields, "rate_hz"), _rigid_transform(fields, "T_BS"))]
        return [_euroc_camera(fields, path.absolute().parent.name if path.stem == "sensor" else path.stem)], []
    if "projection_parameters" in fields:
        return [_vins_mono_camera(fields)], [_vins_mono_imu(fields)]
    cameras = [_kalibr_camera(fields.section(key), key) for key in _chain_cameras(fields)]
    return cameras, [] if cameras else [_kalibr_imu(fields)]


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


def _euroc_camera(fields: Fields, name: str) -> CameraPart:
    known = _is_rotation_known(fields)
    if known:
        T_BC = _rigid_transform(fields, "T_BS")
    else:
        T_BC = _translation(fields.matrix("T_BS", 4, 4)[:3, 3] if "T_BS" in fields else np.zeros(3))
    model = _pinhole(fields, "distortion_coefficients")
    return CameraPart(name, model, T_BC, _nanoseconds(fields, "timeshift_cam_imu"), known)


def _chain_cameras(fields: Fields) -> list[str]:
    """``cam0``, ``cam1`` ...: the cameras of Kalibr's chain; empty where the file is none."""
    return [key for key in fields if _CHAIN_CAMERA.fullmatch(key)]


def _kalibr_camera(fields: Fields, name: str) -> CameraPart:
    known = _is_rotation_known(fields)
    if not known and "T_cam_imu" in fields:
        raise fields.fail("T_cam_imu tells no position where the rotation is unknown; give T_imu_cam, or neither")
    if not known:
        T_BC = _translation(fields.matrix("T_imu_cam", 4, 4)[:3, 3] if "T_imu_cam" in fields else np.zeros(3))
    elif "T_imu_cam" in fields:
        T_BC = _rigid_transform(fields, "T_imu_cam")
    elif "T_cam_imu" in fields:
        T_BC = inverse(_rigid_transform(fields, "T_cam_imu"))
    else:
        raise fields.fail("T_cam_imu (or T_imu_cam) is missing; use the result of kalibr_calibrate_imu_camera")
    model, offset_ns = _pinhole(fields, "distortion_coeffs"), _nanoseconds(fields, "timeshift_cam_imu")
    return CameraPart(name, model, T_BC, offset_ns, known, fields.text("rostopic", "") or None)


def _kalibr_imu(fields: Fields) -> ImuPart:
    """The IMU of a file in which the noise lies at the top level (Kalibr's input) or under ``imu0`` (its result)."""
    if "imu0" in fields:
        fields = fields.section("imu0")
    for key in _IMU_INTRINSICS:
        if key in fields and not np.allclose(fields.matrix(key, 3, 3), np.eye(3), atol=1e-9):
            _log.warning("%s: %s is not the identity and is not applied", fields.where, key)
    return ImuPart(_imu_noise(fields, "update_rate"), np.eye(4))


def _vins_mono_camera(fields: Fields) -> CameraPart:
    known = fields.number("estimate_extrinsic", 0.0) != 2.0
    has_position = known or "extrinsicTranslation" in fields
    T_BC = _translation(fields.matrix("extrinsicTranslation", 3, 1)[:, 0] if has_position else np.zeros(3))
    if known:
        T_BC[:3, :3] = _rotation(fields, "extrinsicRotation", fields.matrix("extrinsicRotation", 3, 3))
    topic = fields.text("image_topic", "") or None
    return CameraPart("cam0", _vins_mono_model(fields), T_BC, _nanoseconds(fields, "td"), known, topic)


def _vins_mono_model(fields: Fields) -> Camera:
    model = fields.text("model_type")
    projection = fields.section("projection_parameters")
    resolution = (int(fields.number("image_width")), int(fields.number("image_height")))
    if model == "PINHOLE":
        fx, fy, cx, cy = (projection.number(key) for key in ("fx", "fy", "cx", "cy"))
        distortion = fields.section("distortion_parameters")
        k1, k2, p1, p2 = (distortion.number(key) for key in ("k1", "k2", "p1", "p2"))
        return Camera(fx, fy, cx, cy, (k1, k2, p1, p2), resolution, "radtan")
    if model == "KANNALA_BRANDT":
        fx, fy, cx, cy = (projection.number(key) for key in ("mu", "mv", "u0", "v0"))
        k1, k2, k3, k4 = (projection.number(key) for key in ("k2", "k3", "k4", "k5"))
        return Camera(fx, fy, cx, cy, (k1, k2, k3, k4), resolution, "equidistant")
    raise fields.fail(f"model_type {model!r} is not supported; recalibrate with PINHOLE or KANNALA_BRANDT")


def _vins_mono_imu(fields: Fields) -> ImuPart:
    scale = 1.0 / sqrt(_VINS_MONO_RATE_HZ)
    noise = ImuNoise(
        gyro_density=fields.number("gyr_n") * scale,
        accel_density=fields.number("acc_n") * scale,
        gyro_walk=fields.number("gyr_w") * scale,
        accel_walk=fields.number("acc_w") * scale,
        rate_hz=_VINS_MONO_RATE_HZ,
    )
    return ImuPart(_checked(fields, noise), np.eye(4))


def _pinhole(fields: Fields, distortion_key: str) -> Camera:
    """The camera from the keys that EuRoC's and Kalibr's files have in common."""
    if (projection := fields.text("camera_model")) != "pinhole":
        raise fields.fail(f"camera model {projection!r} is not supported; recalibrate with a pinhole model")
    name = fields.text("distortion_model")
    if name not in _DISTORTION:
        raise fields.fail(f"distortion model {name!r} is not supported; recalibrate with radtan or equidistant")
    distortion = np.zeros(4) if name == "none" else fields.numbers(distortion_key, 4, 5)
    if distortion[4:].any():
        raise fields.fail(f"{distortion_key!r} has a fifth coefficient (k3); recalibrate with four")
    k1, k2, k3, k4 = distortion[:4].tolist()
    fx, fy, cx, cy = fields.numbers("intrinsics", 4).tolist()
    width, height = fields.numbers("resolution", 2).tolist()
    return Camera(fx, fy, cx, cy, (k1, k2, k3, k4), (int(width), int(height)), _DISTORTION[name])


def _imu_noise(fields: Fields, rate_key: str) -> ImuNoise:
    """The noise from the keys that EuRoC's and Kalibr's files have in common: continuous-time densities, SI units."""
    return _checked(
        fields,
        ImuNoise(
            gyro_density=fields.number("gyroscope_noise_density"),
            accel_density=fields.number("accelerometer_noise_density"),
            gyro_walk=fields.number("gyroscope_random_walk"),
            accel_walk=fields.number("accelerometer_random_walk"),
            rate_hz=fields.number(rate_key),
        ),
    )


def _checked(fields: Fields, noise: ImuNoise) -> ImuNoise:
    if min(noise.gyro_density, noise.accel_density, noise.gyro_walk, noise.accel_walk, noise.rate_hz) <= 0.0:
        raise fields.fail("IMU noise densities, random walks and rate must all be positive")
    return noise


def _is_rotation_known(fields: Fields) -> bool:
    said = fields.text("camera_rotation", "known")
    if said not in ("known", "unknown"):
        raise fields.fail(f"'camera_rotation' should be known or unknown, not {said!r}")
    return said == "known"


def _rigid_transform(fields: Fields, key: str) -> Float:
    """(4, 4) from ``key``, its rotation made exactly orthonormal."""
    T = fields.matrix(key, 4, 4)
    R = _rotation(fields, key, T[:3, :3])
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise fields.fail(f"the last row of {key!r} should be 0 0 0 1")
    out = T.copy()
    out[:3, :3] = R
    return out


def _rotation(fields: Fields, key: str, R: Float) -> Float:
    """The rotation nearest to ``R`` (3, 3), which must be close to one; ``R`` itself where it is one already."""
    off = np.abs(R @ R.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(R) < 0.0:
        raise fields.fail(f"{key!r} holds no rotation: its rows are not orthonormal and right-handed")
    return R if off < _ROUNDING else so3.project(R)


def _translation(p_BC: Float) -> Float:
    T_BC = np.eye(4)
    T_BC[:3, 3] = p_BC
    return T_BC


def _nanoseconds(fields: Fields, key: str) -> int:
    """A time offset in seconds, zero where there is none, as integer nanoseconds."""
    return round(fields.number(key, 0.0) * NS_PER_S)
