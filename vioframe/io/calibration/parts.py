"""What every calibration format is taken apart into, and the checks they share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, DistortionModel
from vioframe.io.calibration.fields import Fields
from vioframe.types import NS_PER_S, Float, ImuNoise

_DISTORTION: dict[str, DistortionModel] = {
    "radtan": "radtan",
    "radial-tangential": "radtan",
    "plumb_bob": "radtan",
    "none": "radtan",
    "equidistant": "equidistant",
    "equi": "equidistant",
}


@dataclass(frozen=True, slots=True)
class CameraPart:
    """One camera of a calibration: ``T_BC`` (4, 4) maps camera points into the IMU frame.

    ``name`` is None where the format holds a single camera without one; ``topic`` is the image topic it was made from.
    """

    name: str | None
    camera: Camera
    T_BC: Float
    time_offset_ns: int = 0
    topic: str | None = None


@dataclass(frozen=True, slots=True)
class ImuPart:
    """One IMU: its noise, and ``T_BI`` (4, 4), which maps it into the frame that the cameras refer to."""

    noise: ImuNoise
    T_BI: Float


def rigid_transform(fields: Fields, key: str) -> Float:
    """(4, 4) from ``key``, its rotation made exactly orthonormal."""
    return _checked(fields, key, fields.matrix(key, 4, 4))


def assemble_transform(fields: Fields, rotation_key: str, translation_key: str) -> Float:
    """(4, 4) from a (3, 3) rotation and a (3,) translation under two keys."""
    T = np.eye(4)
    T[:3, :3] = fields.matrix(rotation_key, 3, 3)
    T[:3, 3] = fields.matrix(translation_key, 3, 1)[:, 0]
    return _checked(fields, rotation_key, T)


def _checked(fields: Fields, key: str, T: Float) -> Float:
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0.0:
        raise fields.fail(f"{key!r} holds no rotation: its rows are not orthonormal and right-handed")
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise fields.fail(f"the last row of {key!r} should be 0 0 0 1")
    out = T.copy()
    out[:3, :3] = so3.project(R)
    return out


def inverse(T_AB: Float) -> Float:
    """T_BA, (4, 4)."""
    T_BA = np.eye(4)
    T_BA[:3, :3] = T_AB[:3, :3].T
    T_BA[:3, 3] = -T_AB[:3, :3].T @ T_AB[:3, 3]
    return T_BA


def pinhole_camera(fields: Fields, distortion_key: str) -> Camera:
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


def imu_noise(fields: Fields, rate_key: str) -> ImuNoise:
    """The noise from the keys that EuRoC's and Kalibr's files have in common: continuous-time densities, SI units."""
    return checked_noise(
        fields,
        ImuNoise(
            gyro_density=fields.number("gyroscope_noise_density"),
            accel_density=fields.number("accelerometer_noise_density"),
            gyro_walk=fields.number("gyroscope_random_walk"),
            accel_walk=fields.number("accelerometer_random_walk"),
            rate_hz=fields.number(rate_key),
        ),
    )


def checked_noise(fields: Fields, noise: ImuNoise) -> ImuNoise:
    """``noise`` itself; an error where a density or the rate is not positive."""
    if min(noise.gyro_density, noise.accel_density, noise.gyro_walk, noise.accel_walk, noise.rate_hz) <= 0.0:
        raise fields.fail("IMU noise densities, random walks and rate must all be positive")
    return noise


def nanoseconds(seconds: float) -> int:
    """A time offset in seconds as integer nanoseconds."""
    return round(seconds * NS_PER_S)
