"""What librealsense knows of lenses, mounting and noise, as a rig: its structures in, vioframe's types out."""

from __future__ import annotations

from collections.abc import Sequence
from math import radians, sqrt
from typing import Any

import numpy as np

from vioframe.errors import CalibrationError
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.types import CameraOnBody, ImuNoise

# Of the IMUs in these cameras, the Bosch BMI055 and BMI085, by their data sheets: 0.014 deg/s/sqrt(Hz), and 150 and
# 120 ug/sqrt(Hz), of which the larger is taken.
GYRO_DENSITY = radians(0.014)
"""rad/s/sqrt(Hz)"""
ACCEL_DENSITY = 150e-6 * 9.80665
"""m/s^2/sqrt(Hz)"""
# No data sheet has these: they are of the order that Allan variances of such sensors show.
GYRO_WALK = 2e-5
"""rad/s^2/sqrt(Hz)"""
ACCEL_WALK = 5e-4
"""m/s^3/sqrt(Hz)"""

# A rotation that comes in single precision is off by less.
_ROTATION_OFF = 1e-3


def lens(name: str, intrinsics: Any) -> Camera:
    """That of ``rs2_intrinsics``: ``width, height, fx, fy, ppx, ppy, model, coeffs``; integers are pixel centres.

    ``inverse_brown_conrady`` takes distortion away with the polynomial that ``brown_conrady`` puts it on with, and
    ``modified_brown_conrady`` bends twice: they can be told here only where there is none, as of rectified infrared
    images. Raises :class:`CalibrationError` for what can not be told.
    """
    model, coefficients = intrinsics.model.name, [float(c) for c in intrinsics.coeffs]
    pinhole = intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy
    size = intrinsics.width, intrinsics.height
    k1, k2, k3, k4, last = coefficients
    if model == "kannala_brandt4":
        return Camera(*pinhole, (k1, k2, k3, k4), size, "equidistant")
    if model == "none" or (model.endswith("brown_conrady") and not any(coefficients)):
        return Camera(*pinhole, (0.0, 0.0, 0.0, 0.0), size)
    if model == "brown_conrady" and last == 0.0:
        return Camera(*pinhole, (k1, k2, k3, k4), size)
    raise CalibrationError(
        f"the lens of {name} is told as {model!r} with {coefficients}, which is neither radtan nor equidistant of four "
        "coefficients; calibrate it with Kalibr, and name the result by --calibration"
    )


def on_body(name: str, model: Camera, extrinsics: Any) -> CameraOnBody:
    """The camera on the IMU, by ``rs2_extrinsics`` from the IMU to the camera: ``p_C = R_CB @ p_B + translation``.

    ``rotation`` has the nine numbers of R_CB column after column; ``translation`` is in metres.
    """
    R_CB = np.array(extrinsics.rotation, np.float64).reshape(3, 3).T
    if not np.abs(R_CB @ R_CB.T - np.eye(3)).max() < _ROTATION_OFF or np.linalg.det(R_CB) < 0.0:
        raise CalibrationError(
            f"the device's transform from its IMU to {name} holds no rotation; calibrate it anew with librealsense's "
            "rs-imu-calibration, or name a calibration by --calibration"
        )
    R_BC = so3.project(R_CB.T)
    return CameraOnBody(name, model, R_BC, -R_BC @ np.array(extrinsics.translation, np.float64))


def imu_noise(
    gyro_variances: Sequence[float], accel_variances: Sequence[float], gyro_rate_hz: float, accel_rate_hz: float
) -> ImuNoise:
    """From the ``noise_variances`` (3,) of ``rs2_motion_device_intrinsic``; zeros are variances nobody has measured.

    They are of single readings, (rad/s)^2 and (m/s^2)^2: spread over the rate, those known come out as the data sheets
    have it. The ``bias_variances`` say how large a bias is, not how fast it moves, and are not used.
    """
    return ImuNoise(
        _density(gyro_variances, gyro_rate_hz, GYRO_DENSITY),
        _density(accel_variances, accel_rate_hz, ACCEL_DENSITY),
        GYRO_WALK,
        ACCEL_WALK,
        float(gyro_rate_hz),
    )


def _density(variances: Sequence[float], rate_hz: float, default: float) -> float:
    mean = float(np.mean(variances))
    return sqrt(mean / rate_hz) if np.isfinite(mean) and min(variances) > 0.0 else default
