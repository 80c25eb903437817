"""A data set out of arrays: what a program has in memory, played like a recording.

    dataset = ArrayDataset(calibration, imu_t_ns, gyro_B, accel_B, frame_t_ns, images)
    for step in pipeline.run(dataset, ...):
        ...

With several cameras ``images`` says whose they are: ``{"cam0": left, "cam1": right}``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from heapq import merge

import numpy as np
from numpy.typing import ArrayLike

from vioframe.errors import DatasetError
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import Calibration, Float, FrameSet, Image, ImuSample, Int, Measurement


class ArrayDataset:
    """Inertial readings, images and, where it is known, the truth, checked once.

    ``imu_t_ns`` (N,) with ``gyro_B`` (N, 3) rad/s and ``accel_B`` (N, 3) m/s^2, the specific force; ``frame_t_ns`` (M,)
    with the images (H, W) uint8 of each camera, an array (M, H, W) or a sequence in which None stands where the camera
    took none. Stamps are integer nanoseconds of the sensors' own clocks (the calibration has their offset), strictly
    increasing. Nothing is copied. Raises :class:`~vioframe.errors.DatasetError` for whatever does not fit.
    """

    def __init__(
        self,
        calibration: Calibration,
        imu_t_ns: ArrayLike,
        gyro_B: ArrayLike,
        accel_B: ArrayLike,
        frame_t_ns: ArrayLike,
        images: Sequence[Image | None] | Image | Mapping[str, Sequence[Image | None] | Image],
        *,
        ground_truth: Trajectory | None = None,
        name: str = "arrays",
    ) -> None:
        self.name = name
        self.calibration = calibration
        self.ground_truth = ground_truth
        self._imu_t_ns = _stamps("imu_t_ns", imu_t_ns)
        self._gyro_B = _readings("gyro_B", gyro_B, len(self._imu_t_ns))
        self._accel_B = _readings("accel_B", accel_B, len(self._imu_t_ns))
        self._frame_t_ns = _stamps("frame_t_ns", frame_t_ns)
        names = [camera.name for camera in calibration.cameras]
        by_camera = images if isinstance(images, Mapping) else {names[0]: images}
        if set(by_camera) != set(names):
            raise DatasetError(f"images are given for {sorted(by_camera)}, but the cameras are {names}")
        self._images = [self._checked(camera, by_camera[name]) for camera, name in enumerate(names)]
        for i, t_ns in enumerate(self._frame_t_ns.tolist()):
            if all(of_camera[i] is None for of_camera in self._images):
                raise DatasetError(f"no camera has an image at {t_ns} ns (place {i} of frame_t_ns)")

    @property
    def frame_count(self) -> int:
        return len(self._frame_t_ns)

    def measurements(self) -> Iterator[Measurement]:
        """IMU samples and frames by their stamps; a sample comes before the frame of its instant."""
        imu = map(ImuSample, self._imu_t_ns.tolist(), self._gyro_B, self._accel_B)
        frames = map(FrameSet, self._frame_t_ns.tolist(), zip(*self._images, strict=True))
        return merge(imu, frames, key=lambda measurement: measurement.t_ns)

    def _checked(self, place: int, images: Sequence[Image | None] | Image) -> list[Image | None]:
        camera = self.calibration.cameras[place]
        where = f"images of {camera.name}"
        if len(images) != len(self._frame_t_ns):
            raise DatasetError(f"there are {len(images)} {where} for {len(self._frame_t_ns)} stamps in frame_t_ns")
        checked: list[Image | None] = []
        for image in images:
            if image is not None:
                image = np.asarray(image).view()
                if image.ndim != 2 or image.dtype != np.uint8:
                    raise DatasetError(f"{where} must be (H, W) uint8, got {image.shape} {image.dtype}")
                if image.shape[::-1] != camera.model.resolution:
                    size, calibrated = ("x".join(map(str, of)) for of in (image.shape[::-1], camera.model.resolution))
                    raise DatasetError(f"{where} must be of the calibrated size {calibrated}, got {size}")
                image.flags.writeable = False
            checked.append(image)
        return checked


def _stamps(name: str, values: ArrayLike) -> Int:
    t_ns = np.asarray(values)
    if t_ns.ndim != 1 or not t_ns.size or not np.issubdtype(t_ns.dtype, np.integer):
        raise DatasetError(f"{name} must be (N,) integer nanoseconds, got {t_ns.shape} {t_ns.dtype}")
    t_ns = t_ns.astype(np.int64, copy=False)
    if (backwards := np.flatnonzero(np.diff(t_ns) <= 0)).size:
        place = int(backwards[0]) + 1
        raise DatasetError(f"{name} must increase, but {t_ns[place]} (place {place}) follows {t_ns[place - 1]}")
    return t_ns


def _readings(name: str, values: ArrayLike, count: int) -> Float:
    readings = np.asarray(values, dtype=np.float64)
    if readings.shape != (count, 3):
        raise DatasetError(f"{name} must be ({count}, 3) to match imu_t_ns, got {readings.shape}")
    return readings
