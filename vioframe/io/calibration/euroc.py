"""EuRoC / ASL ``sensor.yaml`` files (Burri et al., IJRR 2016), read and written.

``T_BS`` maps sensor to body. The camera's optional ``timeshift_cam_imu`` (seconds, ``t_imu = t_cam + shift``, as Kalibr
defines it) is an addition of this project, so that a written calibration loses nothing.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vioframe.io.calibration.fields import Fields
from vioframe.io.calibration.parts import CameraPart, ImuPart, imu_noise, nanoseconds, pinhole_camera, rigid_transform
from vioframe.types import NS_PER_S, Calibration, Float


def camera_part(fields: Fields, name: str) -> CameraPart:
    """The camera of a file with ``sensor_type: camera``."""
    return CameraPart(
        name=name,
        camera=pinhole_camera(fields, "distortion_coefficients"),
        T_BC=rigid_transform(fields, "T_BS"),
        time_offset_ns=nanoseconds(fields.number("timeshift_cam_imu", 0.0)),
    )


def imu_part(fields: Fields) -> ImuPart:
    """The IMU of a file with ``sensor_type: imu``."""
    return ImuPart(imu_noise(fields, "rate_hz"), rigid_transform(fields, "T_BS"))


def write_calibration(calibration: Calibration, folder: Path) -> None:
    """Write ``cam0/sensor.yaml`` and ``imu0/sensor.yaml`` below ``folder``; reading them back gives equal values."""
    camera, noise = calibration.camera, calibration.imu
    T_BC = np.eye(4)
    T_BC[:3, :3], T_BC[:3, 3] = calibration.R_BC, calibration.p_BC
    _write(
        folder / "cam0" / "sensor.yaml",
        "sensor_type: camera",
        *_transform_lines(T_BC),
        f"resolution: {list(camera.resolution)}",
        "camera_model: pinhole",
        f"intrinsics: {_list([camera.fx, camera.fy, camera.cx, camera.cy])}  # fu, fv, cu, cv",
        f"distortion_model: {'radial-tangential' if camera.distortion_model == 'radtan' else camera.distortion_model}",
        f"distortion_coefficients: {_list(camera.distortion)}",
        f"timeshift_cam_imu: {calibration.time_offset_ns / NS_PER_S!r}  # [s] t_imu = t_cam + shift",
    )
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
