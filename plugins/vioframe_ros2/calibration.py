"""The rig's calibration from what ROS 2 publishes: ``camera_info`` and ``/tf_static``."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.errors import CalibrationError
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, DistortionModel
from vioframe.io.calibration.formats import is_calibration, parts_of, read_yaml
from vioframe.types import Calibration, CameraOnBody, Float, ImuNoise

REMEDY = "or give --calibration FILE"

# Of an IMU as phones and small cameras have them, a little above what the data sheets of the BMI055, BMI088 and
# ICM-20602 state: these go to 2.4e-4 rad/s/sqrt(Hz) and 1.8e-3 m/s^2/sqrt(Hz).
GYRO_DENSITY = 3e-4
"""rad/s/sqrt(Hz)"""
ACCEL_DENSITY = 3e-3
"""m/s^2/sqrt(Hz)"""
# How biases wander is in no data sheet; calibrations of such IMUs find some 1e-5 and 1e-4 to 1e-3.
GYRO_WALK = 2e-5
"""rad/s^2/sqrt(Hz)"""
ACCEL_WALK = 1e-3
"""m/s^3/sqrt(Hz)"""

# Names of distortion models in sensor_msgs/distortion_models.hpp, and others that drivers use.
_RADTAN = ("plumb_bob", "rational_polynomial", "none", "")
_EQUIDISTANT = ("equidistant", "fisheye")


def camera_of(info: Any, rectified: bool, where: str) -> tuple[Camera, Float]:
    """The camera of a sensor_msgs/CameraInfo, and R_OC (3, 3) from its axes to those of the optical frame.

    Where its images are ``rectified`` they are without distortion and may be turned. Raises :class:`CalibrationError`,
    beginning with ``where``, for a lens that is not told by four coefficients, or not calibrated.
    """
    K = np.reshape(info.p, (3, 4))[:, :3] if rectified else np.reshape(info.k, (3, 3))
    if K[0, 0] == 0.0:
        raise CalibrationError(f"{where} tells no calibration (its focal length is 0); calibrate the camera, {REMEDY}")
    kind, distortion = ("radtan", np.zeros(4)) if rectified else _distortion(info, where)
    fx, fy, cx, cy = K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    k1, k2, k3, k4 = distortion.tolist()
    try:
        model = Camera(fx, fy, cx, cy, (k1, k2, k3, k4), (int(info.width), int(info.height)), kind)
    except CalibrationError as error:
        raise CalibrationError(f"{where}: {error}") from None
    return model, np.reshape(info.r, (3, 3)).T if rectified and info.r.any() else np.eye(3)


def _distortion(info: Any, where: str) -> tuple[DistortionModel, Float]:
    """The model and its four coefficients."""
    name, coefficients = info.distortion_model, np.asarray(info.d, np.float64)
    if name in _EQUIDISTANT and len(coefficients) == 4:
        return "equidistant", coefficients
    if name in _RADTAN and (len(coefficients) >= 4 or not coefficients.any()) and not coefficients[4:].any():
        return "radtan", np.pad(coefficients, (0, 4))[:4]
    raise CalibrationError(
        f"{where} tells a distortion {name!r} of {len(coefficients)} coefficients; read are plumb_bob and "
        f"rational_polynomial with none but the first four, and equidistant with four: calibrate it so, {REMEDY}"
    )


class Transforms:
    """How frames sit in each other, by what came on ``/tf_static``."""

    def __init__(self) -> None:
        self._T_PC: dict[str, tuple[str, Float, Float]] = {}  # by child: its parent, R_PC and p_PC

    def add(self, message: Any) -> None:
        """Take in a tf2_msgs/TFMessage; one that turns nothing into nothing is passed over."""
        for each in message.transforms:
            p, q = each.transform.translation, each.transform.rotation
            quat, p_PC = np.array([q.x, q.y, q.z, q.w]), np.array([p.x, p.y, p.z])
            if np.linalg.norm(quat) > 0.0 and np.isfinite([*quat, *p_PC]).all():
                parent, child = _bare(each.header.frame_id), _bare(each.child_frame_id)
                self._T_PC[child] = parent, so3.from_quat_xyzw(quat), p_PC

    def between(self, a: str, b: str) -> tuple[Float, Float] | None:
        """R_AB (3, 3) and p_AB (3,) m, by way of as many frames as it takes; None where no way leads there."""
        a, b = _bare(a), _bare(b)
        reached = {a: (np.eye(3), np.zeros(3))}
        waiting = deque([a])
        while waiting and b not in reached:
            frame = waiting.popleft()
            R_AF, p_AF = reached[frame]
            for other, R_FO, p_FO in self._beside(frame):
                if other not in reached:
                    reached[other] = R_AF @ R_FO, R_AF @ p_FO + p_AF
                    waiting.append(other)
        return reached.get(b)

    def root(self, frame: str) -> str:
        """The frame that has ``frame`` in it, or in one that is in it, and is itself in none."""
        frame = _bare(frame)
        passed = {frame}
        while frame in self._T_PC and (parent := self._T_PC[frame][0]) not in passed:
            passed.add(parent)
            frame = parent
        return frame

    def _beside(self, frame: str) -> Iterator[tuple[str, Float, Float]]:
        """The frames next to it, each with R and p from there."""
        for child, (parent, R_PC, p_PC) in self._T_PC.items():
            if parent == frame:
                yield child, R_PC, p_PC
            if child == frame:
                yield parent, R_PC.T, -R_PC.T @ p_PC


def _bare(frame: str) -> str:
    """Without the slash that some still put before the name of a frame."""
    return frame.removeprefix("/")


def missing_way(infos: Mapping[str, Any], imu_frame: str, transforms: Transforms) -> str | None:
    """What is not known of how the cameras sit on the IMU; None where everything is. ``infos`` are by camera."""
    for name, info in infos.items():
        frame = info.header.frame_id
        if transforms.between(imu_frame, frame) is None:
            return f"no transforms on /tf_static lead from {imu_frame!r}, the IMU's frame, to {frame!r}, that of {name}"
    return None


def published(
    topics: Mapping[str, str], infos: Mapping[str, Any], imu_frame: str, transforms: Transforms, noise: ImuNoise
) -> Calibration:
    """The rig of the cameras with these image ``topics``, by their names as ``infos`` are, each a CameraInfo.

    Raises :class:`CalibrationError` for what is not published, or is no calibration.
    """
    if (missing := missing_way(infos, imu_frame, transforms)) is not None:
        raise CalibrationError(f"{missing}; publish them, as by a static_transform_publisher, {REMEDY}")
    frames = [info.header.frame_id for info in infos.values()]
    if len(set(frames)) < len(frames):
        raise CalibrationError(f"cameras {', '.join(infos)} share a frame, {frames[0]!r}; publish one each, {REMEDY}")
    return Calibration(
        tuple(_on_body(name, topic, infos[name], imu_frame, transforms) for name, topic in topics.items()), noise
    )


def _on_body(name: str, topic: str, info: Any, imu_frame: str, transforms: Transforms) -> CameraOnBody:
    rectified = topic.rpartition("/")[2].startswith("image_rect")
    model, R_OC = camera_of(info, rectified, f"the camera_info of {topic}")
    way = transforms.between(imu_frame, info.header.frame_id)
    assert way is not None
    R_BO, p_BO = way
    return CameraOnBody(name, model, R_BO @ R_OC, p_BO)


def usual_noise(rate_hz: float) -> ImuNoise:
    """What is taken where nobody says more than what comes."""
    return ImuNoise(GYRO_DENSITY, ACCEL_DENSITY, GYRO_WALK, ACCEL_WALK, rate_hz)


def noise_alone(files: Sequence[Path]) -> ImuNoise | None:
    """What a single file says that describes an IMU and no camera; None where these are others, or none."""
    if len(files) != 1 or files[0].is_dir():
        return None
    document = read_yaml(files[0])
    cameras, imus = parts_of(document, files[0]) if is_calibration(document) else ([], [])
    return imus[0].noise if imus and not cameras else None
