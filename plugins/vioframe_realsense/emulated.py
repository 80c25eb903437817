"""A device of librealsense's own making that plays measurements, for where no camera is plugged in."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from itertools import count
from typing import Any

import numpy as np

from vioframe.geometry.cameras import Camera
from vioframe.live.pace import paced
from vioframe.types import Calibration, Float, FrameSet, Image, ImuSample, Measurement
from vioframe_realsense.device import sdk
from vioframe_realsense.timing import HARDWARE_CLOCK

_NS_PER_MS = 1_000_000


class Emulated:
    """A device of librealsense's own making, with the sensors of a D435i; :meth:`play` has it measure."""

    def __init__(
        self,
        rig: Calibration,
        *,
        serial: str = "0123",
        rate_hz: int = 30,
        accel_rate_hz: int = 100,
        cameras: int | None = None,
        imu: bool = True,
        emitter: bool = True,
        placed: bool = True,
        domain: str = HARDWARE_CLOCK,
        domain_of_images: str | None = None,
    ) -> None:
        rs = sdk()
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.device.register_info(rs.camera_info.name, "Intel RealSense D435I")
        self.device.register_info(rs.camera_info.usb_type_descriptor, "2.1")
        self.stereo = self.device.add_sensor("Stereo Module")
        self.motion = self.device.add_sensor("Motion Module")
        on = rs.option_range(0.0, 1.0, 1.0, 1.0)
        if emitter:
            self.stereo.add_option(rs.option.emitter_enabled, on, True)
        for sensor in (self.stereo, self.motion):
            sensor.add_option(rs.option.global_time_enabled, on, True)
        self._domain, self._domain_of_images = domain, domain_of_images or domain
        self._uids, self._numbers = count(1), Counter[int]()
        self.injected: list[int] = []
        """Stamps of the gyroscope's readings."""
        self._accel_ns: list[int] = []
        there = rig.cameras[:cameras]
        self.cameras = [self._infrared(i, camera.model, rate_hz) for i, camera in enumerate(there)]
        for i, camera in enumerate(there):
            self._infrared(i, camera.model.zoomed(0.5), rate_hz // 2)  # another mode
        if not imu:
            return
        noise = rig.imu
        self.gyro = self._motion_stream(rs.stream.gyro, 200, noise.gyro_density**2 * 200)
        self._motion_stream(rs.stream.gyro, 100, 0.0)
        self._motion_stream(rs.stream.gyro, 1600, 0.0)
        self.accel = self._motion_stream(rs.stream.accel, accel_rate_hz, noise.accel_density**2 * accel_rate_hz)
        self._gyro_per_accel = 200 // accel_rate_hz
        for stream, camera in zip(self.cameras if placed else (), rig.cameras, strict=False):
            extrinsics = rs.extrinsics()
            extrinsics.rotation = camera.R_BC.ravel().tolist()  # R_CB column after column
            extrinsics.translation = (-camera.R_BC.T @ camera.p_BC).tolist()
            self.gyro.register_extrinsics_to(stream, extrinsics)

    def _infrared(self, place: int, lens: Camera, rate_hz: int) -> Any:
        rs = sdk()
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid = rs.stream.infrared, place + 1, next(self._uids)
        (stream.width, stream.height), stream.fps, stream.bpp, stream.fmt = lens.resolution, rate_hz, 1, rs.format.y8
        stream.intrinsics = librealsense_lens(lens)
        return self.stereo.add_video_stream(stream)

    def _motion_stream(self, kind: Any, rate_hz: int, variance: float) -> Any:
        rs = sdk()
        stream = rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, next(self._uids), rate_hz
        intrinsics = rs.motion_device_intrinsic()
        intrinsics.noise_variances = [variance] * 3
        stream.fmt, stream.intrinsics = rs.format.motion_xyz32f, intrinsics
        return self.motion.add_motion_stream(stream)

    def image(self, place: int, t_ns: int, image: Image) -> None:
        """The camera at ``place`` takes an image."""
        rs = sdk()
        frame = rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = np.ascontiguousarray(image), image.shape[1], 1
        frame.timestamp, frame.domain = t_ns / _NS_PER_MS, getattr(rs.timestamp_domain, self._domain_of_images)
        frame.frame_number, frame.profile = self._number(place), self.cameras[place].as_video_stream_profile()
        self.stereo.on_video_frame(frame)

    def reads(self, stream: Any, t_ns: int, values: Float) -> None:
        """``stream``, :attr:`gyro` or :attr:`accel`, reads ``values`` (3,)."""
        rs = sdk()
        vector, frame = rs.vector(), rs.software_motion_frame()
        vector.x, vector.y, vector.z = values.tolist()
        frame.data, frame.timestamp = vector, t_ns / _NS_PER_MS
        frame.domain = getattr(rs.timestamp_domain, self._domain)
        number = self._number(10 + int(stream is self.gyro))
        frame.frame_number, frame.profile = number, stream.as_motion_stream_profile()
        self.motion.on_motion_frame(frame)
        (self.injected if stream is self.gyro else self._accel_ns).append(t_ns)

    def wait_until_started(self) -> None:
        """By a source, which opens it; where it has refused it this is given up."""
        give_up_s = time.monotonic() + 5.0
        while not self.stereo.get_active_streams() and time.monotonic() < give_up_s:
            time.sleep(0.01)
        time.sleep(0.1)

    @property
    def usable(self) -> int:
        """How many of the gyroscope's readings have the accelerometer's on either side."""
        return sum(self._accel_ns[0] <= t_ns <= self._accel_ns[-1] for t_ns in self.injected)

    def _number(self, key: int) -> int:
        self._numbers[key] += 1
        return self._numbers[key]

    def play(self, measurements: Iterable[Measurement], *, at_once: bool = False) -> None:
        """At their own pace; readings at 200 Hz, where those of the accelerometer are means, in between."""
        before: list[ImuSample] = []
        for m in measurements if at_once else paced(measurements):
            if isinstance(m, FrameSet):
                for place, image in enumerate(m.images):
                    if image is not None:
                        self.image(place, m.t_ns, image)
            elif isinstance(m, ImuSample):
                self.reads(self.gyro, m.t_ns, m.gyro_B)
                before.append(m)
                if len(before) == 2:
                    one, other = before
                    self.reads(self.accel, (one.t_ns + other.t_ns) // 2, 0.5 * (one.accel_B + other.accel_B))
                    del before[: self._gyro_per_accel]


def librealsense_lens(lens: Camera, model: str = "brown_conrady") -> Any:
    """``lens`` as librealsense has it."""
    rs = sdk()
    intrinsics = rs.intrinsics()
    intrinsics.width, intrinsics.height = lens.resolution
    intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = lens.fx, lens.fy, lens.cx, lens.cy
    intrinsics.model, intrinsics.coeffs = getattr(rs.distortion, model), [*lens.distortion, 0.0]
    return intrinsics
