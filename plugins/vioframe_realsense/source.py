"""A RealSense camera as a live source: frames from librealsense's queue in, readings and sets of images out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from threading import Event
from time import monotonic_ns
from typing import Any

import numpy as np

from vioframe.errors import DatasetError, SourceError, shown
from vioframe.io.calibration import match_cameras
from vioframe.types import NS_PER_S, Calibration, Float, Image, Measurement, NavState, Unreadable
from vioframe_realsense.device import Streams, Wanted, calibration_of, info, name_of, sdk, streaming, streams_of
from vioframe_realsense.timing import Clock, Pairs, Readings

# Some hundred frames come in a second: where none came for so long, ms, the device is looked for.
_WAIT_MS = 250
# A stream that has been silent for so long, s, will stay so; to start takes a second or two.
_SILENT_S = 5.0
# Beyond it a figure in the metadata is wrong; automatic exposure stays far below.
_LONGEST_EXPOSURE_US = 200_000


class RealSense:
    """The infrared cameras and the IMU of one device; B is the IMU as its gyroscope's stream has it.

    ``find`` gives the device of a serial number, or any one where that is empty, and raises :class:`SourceError` where
    it is not there. It is asked again where the device has fallen silent, and each time that it is started.
    """

    def __init__(
        self,
        find: Callable[[str], Any],
        serial: str,
        wanted: Wanted,
        *,
        cameras: list[str] | str | None = None,
        calibration: list[Path] | Path | None = None,
    ) -> None:
        device = find(serial)
        self._find, self._wanted = find, wanted
        self._serial = info(device, "serial_number") or serial
        self.name = name_of(device)
        names = [cameras] if isinstance(cameras, str) else cameras
        streams = streams_of(device, wanted)
        self.calibration, self._cameras = _rig(self.name, streams, wanted, names, calibration)
        self._clock = Clock(self.name)
        self._closed = Event()

    @property
    def frame_count(self) -> None:
        """Nobody knows."""

    @property
    def ground_truth(self) -> None:
        """Nobody knows."""

    def measurements(self) -> Iterator[Measurement]:
        """What comes from the device, which is started, until :meth:`close`.

        Raises :class:`SourceError` where it is not there, or no longer sends all of its streams.
        """
        streams = streams_of(self._find(self._serial), self._wanted).only(self._cameras)
        self._clock.begin()
        intake = _Intake(streams, self._clock, NS_PER_S // self._wanted.frame_rate_hz)
        with streaming(streams, self._wanted.emitter, self.name) as queue:
            begin_ns = monotonic_ns()
            heard_ns = dict.fromkeys(intake.streams, begin_ns)
            while not self._closed.is_set():
                came, frame = queue.try_wait_for_frame(_WAIT_MS)
                now_ns = monotonic_ns()
                if came and (key := _key(frame.get_profile())) in heard_ns:
                    heard_ns[key] = now_ns
                    yield from intake.take(key, frame, now_ns)
                elif not came and max(heard_ns.values()) > begin_ns:
                    self._find(self._serial)
                # What waits is heard of when its turn comes.
                if now_ns - min(heard_ns.values()) > _SILENT_S * NS_PER_S and queue.size() == 0:
                    silent = min(heard_ns, key=lambda key: heard_ns[key])
                    raise SourceError(
                        f"{self.name} has sent nothing of its {intake.streams[silent]} for {_SILENT_S:g} s; unplug "
                        "it and plug it in, at a USB 3 port, or ask for fewer images, as by -o frame_rate_hz=15"
                    )

    def tell(self, state: NavState) -> None:
        """A camera does not listen."""

    def close(self) -> None:
        self._closed.set()


class _Intake:
    """Takes librealsense's frames of ``streams`` and gives measurements; ``period_ns`` is the time between images."""

    def __init__(self, streams: Streams, clock: Clock, period_ns: int) -> None:
        self._gyro, self._accel = streams.gyro.key, streams.accel.key
        self._places = {stream.key: place for place, stream in enumerate(streams.cameras.values())}
        self.streams = {self._gyro: "gyroscope", self._accel: "accelerometer"}
        """What to call each, by its key."""
        self.streams |= {stream.key: name for name, stream in streams.cameras.items()}
        self._clock, self._readings, self._pairs = clock, Readings(), Pairs(len(self._places), period_ns)
        self._last_ns: int | None = None

    def take(self, key: tuple[Any, int], frame: Any, now_ns: int) -> Sequence[Measurement]:
        """What is complete by this frame of one of the ``streams``, which came at ``now_ns``."""
        domain = frame.get_frame_timestamp_domain().name
        t_ns = self._clock.t_ns(frame.get_timestamp(), domain, now_ns, of_reading=key not in self._places)
        if t_ns is None:
            if self._last_ns is None:
                return ()
            kind = "frame_unreadable" if key in self._places else "imu_unreadable"
            return (Unreadable(self._last_ns, kind, f"{self.streams[key]}: stamped by another clock, the {domain}"),)
        self._last_ns = t_ns
        if key == self._gyro:
            return self._readings.gyro(t_ns, _vector(frame))
        if key == self._accel:
            return self._readings.accel(t_ns, _vector(frame))
        return self._pairs.add(self._places[key], t_ns - _since_exposure_ns(frame), _image(frame))


def _key(profile: Any) -> tuple[Any, int]:
    return profile.stream_type(), profile.stream_index()


def _vector(frame: Any) -> Float:
    """(3,) of a reading: rad/s or m/s^2."""
    v = frame.as_motion_frame().get_motion_data()
    return np.array([v.x, v.y, v.z], np.float64)


def _image(frame: Any) -> Image:
    """(H, W) uint8, copied: librealsense fills the same memory anew."""
    image = np.array(frame.get_data(), np.uint8)
    image.flags.writeable = False
    return image


def _since_exposure_ns(frame: Any) -> int:
    """From the middle of the exposure to the stamp, that of the readout, where the metadata tell it; else 0."""
    known = sdk().frame_metadata_value
    if not all(map(frame.supports_frame_metadata, (known.frame_timestamp, known.sensor_timestamp))):
        return 0
    late_us = frame.get_frame_metadata(known.frame_timestamp) - frame.get_frame_metadata(known.sensor_timestamp)
    return 1000 * late_us if 0 < late_us < _LONGEST_EXPOSURE_US else 0


def _rig(
    device: str, streams: Streams, wanted: Wanted, names: list[str] | None, files: list[Path] | Path | None
) -> tuple[Calibration, tuple[str, ...]]:
    """The cameras that are used, calibrated by ``files`` or else by the device, and what its streams call them."""
    there = list(streams.cameras)
    rig, chosen = None, tuple(names or there)
    if files is not None:
        rig, chosen = match_cameras([files] if isinstance(files, Path) else files, there, names)
    if others := [name for name in chosen if name not in there]:
        raise DatasetError(f"{device} has no camera {shown(others[0])}; choose by --cameras among: {', '.join(there)}")
    if rig is None:
        return calibration_of(streams.only(chosen)), chosen
    for camera in rig.cameras:
        if camera.model.resolution != wanted.resolution:
            got, calibrated = ("x".join(map(str, size)) for size in (wanted.resolution, camera.model.resolution))
            raise DatasetError(
                f"{device} is to send images of {got}, but {camera.name} is calibrated for {calibrated}; "
                f"pass -o resolution={calibrated}, or the right --calibration"
            )
    return rig, chosen
