"""Kalibr's camchain-imucam and imu YAML, and OpenVINS' variants of them.

Kalibr's ``T_cam_imu`` maps IMU to camera; OpenVINS' ``T_imu_cam`` is its inverse. Both state ``timeshift_cam_imu`` with
``t_imu = t_cam + shift``.
"""

from __future__ import annotations

import logging
import re

import numpy as np

from vioframe.io.calibration.fields import Fields
from vioframe.io.calibration.parts import (
    CameraPart,
    ImuPart,
    imu_noise,
    inverse,
    nanoseconds,
    pinhole_camera,
    rigid_transform,
)

_log = logging.getLogger("vioframe.io.calibration")
_CAMERA_KEY = re.compile(r"cam\d+")
# OpenVINS' IMU intrinsics: scale and misalignment matrices, identity where they were not calibrated.
_IMU_INTRINSICS = ("Tw", "Ta", "R_IMUtoGYRO", "R_IMUtoACC")


def camera_keys(fields: Fields) -> list[str]:
    """``cam0``, ``cam1`` ...: the cameras of a chain; empty where the file is none."""
    return [key for key in fields if _CAMERA_KEY.fullmatch(key)]


def camera_part(chain: Fields, key: str) -> CameraPart:
    """The camera ``key`` of a camchain-imucam."""
    fields = chain.section(key)
    if "T_imu_cam" in fields:
        T_BC = rigid_transform(fields, "T_imu_cam")
    elif "T_cam_imu" in fields:
        T_BC = inverse(rigid_transform(fields, "T_cam_imu"))
    else:
        raise fields.fail("T_cam_imu (or T_imu_cam) is missing; use the result of kalibr_calibrate_imu_camera")
    return CameraPart(
        name=key,
        camera=pinhole_camera(fields, "distortion_coeffs"),
        T_BC=T_BC,
        time_offset_ns=nanoseconds(fields.number("timeshift_cam_imu", 0.0)),
        topic=fields.text("rostopic", "") or None,
    )


def imu_part(fields: Fields) -> ImuPart:
    """The IMU of a file in which the noise lies at the top level (Kalibr's input) or under ``imu0`` (its result)."""
    if "imu0" in fields:
        fields = fields.section("imu0")
    for key in _IMU_INTRINSICS:
        if key in fields and not np.allclose(fields.matrix(key, 3, 3), np.eye(3), atol=1e-9):
            _log.warning("%s: %s is not the identity and is not applied", fields.where, key)
    return ImuPart(imu_noise(fields, "update_rate"), np.eye(4))
