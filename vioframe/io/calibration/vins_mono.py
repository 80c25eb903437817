"""VINS-Mono's single YAML file (Qin, Li, Shen, T-RO 2018).

``extrinsicRotation`` and ``extrinsicTranslation`` map camera to IMU; ``td`` is ``t_imu - t_cam``.

Its ``acc_n, gyr_n, acc_w, gyr_w`` are *not* densities: the covariance is propagated with ``(G dt) Q (G dt)^T`` (section
IV-B), Q holding their squares, which a density sigma would enter as ``sigma^2 dt``. So ``density = value * sqrt(dt)``.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from vioframe.geometry.cameras import Camera
from vioframe.io.calibration.fields import Fields
from vioframe.io.calibration.parts import CameraPart, ImuPart, assemble_transform, checked_noise, nanoseconds
from vioframe.types import ImuNoise

# The file does not state the rate its noise parameters belong to; this is the one they were tuned for.
_IMU_RATE_HZ = 200.0


def camera_part(fields: Fields) -> CameraPart:
    """The camera with its extrinsics, for ``model_type`` PINHOLE and KANNALA_BRANDT."""
    return CameraPart(
        name=None,
        camera=_camera(fields),
        T_BC=assemble_transform(fields, "extrinsicRotation", "extrinsicTranslation"),
        time_offset_ns=nanoseconds(fields.number("td", 0.0)),
        topic=fields.text("image_topic", "") or None,
    )


def imu_part(fields: Fields) -> ImuPart:
    """The IMU's noise, as continuous-time densities."""
    scale = 1.0 / sqrt(_IMU_RATE_HZ)
    noise = ImuNoise(
        gyro_density=fields.number("gyr_n") * scale,
        accel_density=fields.number("acc_n") * scale,
        gyro_walk=fields.number("gyr_w") * scale,
        accel_walk=fields.number("acc_w") * scale,
        rate_hz=_IMU_RATE_HZ,
    )
    return ImuPart(checked_noise(fields, noise), np.eye(4))


def _camera(fields: Fields) -> Camera:
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
