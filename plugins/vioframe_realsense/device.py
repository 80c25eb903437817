"""A device as librealsense has it: how it is found, which of its streams are used, and how they are started."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any

from vioframe.errors import CalibrationError, DatasetError, SourceError, needs, shortened
from vioframe.types import Calibration, CameraOnBody
from vioframe_realsense.calibration import imu_noise, lens, on_body

# Readings oftener than that, Hz, tell no more of the motion.
_FASTEST_HZ = 400
# What may wait in librealsense's queue: with two cameras some three seconds.
_MOST_WAITING = 2048

_CHECK_CABLE = "check the cable and that the port is USB 3"


@cache
def sdk() -> Any:
    """The module pyrealsense2, loaded when a device is asked for; it brings no types."""
    with needs("pyrealsense2", "realsense", user="source 'realsense'"):
        return import_module("pyrealsense2")


@cache
def _context() -> Any:
    return sdk().context()


def plugged_in(serial: str) -> Any:
    """The device of that serial number, of all the first where it is empty; raises :class:`SourceError`."""
    try:
        there = {info(device, "serial_number"): device for device in _context().query_devices()}
    except RuntimeError as error:
        raise SourceError(f"the RealSense camera cannot be asked: {shortened(error)}; unplug it, plug it in") from error
    if not there:
        raise SourceError(
            f"no RealSense camera is found; {_CHECK_CABLE}, and that librealsense's udev rules are installed "
            "(99-realsense-libusb.rules), which let others than root have it"
        )
    if serial and serial not in there:
        raise SourceError(
            f"no RealSense camera has the serial number {serial}; {_CHECK_CABLE}, or choose of those found: "
            f"{', '.join(there)}"
        )
    return there[serial] if serial else next(iter(there.values()))


def info(device: Any, name: str) -> str:
    """What ``camera_info`` calls ``name``; empty where the device does not say."""
    field = getattr(sdk().camera_info, name)
    return str(device.get_info(field)) if device.supports(field) else ""


def name_of(device: Any) -> str:
    """Model and serial number, such as ``D435I_0123``."""
    model = info(device, "name").split()[-1:] or ["RealSense"]
    return "_".join(filter(None, [*model, info(device, "serial_number")]))


@dataclass(frozen=True, slots=True)
class Wanted:
    """``resolution`` (width, height) px and rate of the images, and whether the pattern is projected."""

    resolution: tuple[int, int]
    frame_rate_hz: int
    emitter: bool = False


@dataclass(frozen=True, slots=True)
class Stream:
    """A stream that can be started: librealsense's profile of it, and the sensor it is of."""

    sensor: Any
    profile: Any

    @property
    def key(self) -> tuple[Any, int]:
        """By which its frames are known."""
        return self.profile.stream_type(), self.profile.stream_index()


@dataclass(frozen=True, slots=True)
class Streams:
    """What is used of one device: ``cameras`` by name, cam0 (left) and cam1 (right), gyroscope and accelerometer."""

    cameras: dict[str, Stream]
    gyro: Stream
    accel: Stream

    def only(self, names: Sequence[str]) -> Streams:
        """With these cameras alone, in this order."""
        return Streams({name: self.cameras[name] for name in names}, self.gyro, self.accel)

    def all(self) -> list[Stream]:
        return [self.gyro, self.accel, *self.cameras.values()]


def streams_of(device: Any, wanted: Wanted) -> Streams:
    """Its infrared cameras as ``wanted``, and its IMU at the highest rates up to 400 Hz.

    Raises :class:`DatasetError` for a device that lacks one of them.
    """
    rs, name = sdk(), name_of(device)
    try:
        every = [Stream(sensor, profile) for sensor in device.query_sensors() for profile in sensor.profiles]
    except RuntimeError as error:
        raise SourceError(f"{name} does not answer: {shortened(error)}; unplug it, plug it in") from error
    infrared = [
        Stream(each.sensor, each.profile.as_video_stream_profile())
        for each in every
        if each.profile.stream_type() == rs.stream.infrared and each.profile.format() == rs.format.y8
    ]
    gyro, accel = (_fastest(every, kind) for kind in (rs.stream.gyro, rs.stream.accel))
    if not infrared:
        raise DatasetError(f"{name} has no infrared camera; take one that has, such as a D435i or a D455")
    if gyro is None or accel is None:
        raise DatasetError(f"{name} has no IMU; take a camera that has one, such as a D435i or a D455")
    fitting = [each for each in infrared if _mode(each) == (wanted.resolution, wanted.frame_rate_hz)]
    if not fitting:
        raise DatasetError(_no_such_mode(device, infrared, wanted))
    fitting.sort(key=lambda each: each.key[1])
    return Streams({f"cam{i}": each for i, each in enumerate(fitting)}, gyro, accel)


def _fastest(streams: list[Stream], kind: Any) -> Stream | None:
    """Of gyroscope or accelerometer that of the highest rate, which is not beyond what is of use."""
    form = sdk().format.motion_xyz32f
    usable = [s for s in streams if s.profile.stream_type() == kind and s.profile.format() == form]
    usable = [stream for stream in usable if stream.profile.fps() <= _FASTEST_HZ]
    return max(usable, key=lambda stream: stream.profile.fps(), default=None)


def _mode(infrared: Stream) -> tuple[tuple[int, int], int]:
    profile = infrared.profile
    return (profile.width(), profile.height()), profile.fps()


def _no_such_mode(device: Any, infrared: list[Stream], wanted: Wanted) -> str:
    rates: dict[tuple[int, int], set[int]] = {}
    for size, rate_hz in map(_mode, infrared):
        rates.setdefault(size, set()).add(rate_hz)
    there = [f"{w}x{h} at {'/'.join(map(str, sorted(hz)))} Hz" for (w, h), hz in sorted(rates.items(), reverse=True)]
    width, height = wanted.resolution
    usb = info(device, "usb_type_descriptor")
    slow = f" by USB {usb}, which is slow: at a USB 3 port there are more" if usb.startswith("2") else ""
    return (
        f"{name_of(device)} has no infrared images of {width}x{height} at {wanted.frame_rate_hz} Hz{slow}; choose by "
        f"-o resolution and -o frame_rate_hz: {', '.join(there)}"
    )


def calibration_of(streams: Streams) -> Calibration:
    """The rig as the device has it in its memory; raises :class:`CalibrationError` where it has none that is of use."""
    gyro, accel = streams.gyro, streams.accel
    noise = imu_noise(_noise_variances(gyro), _noise_variances(accel), gyro.profile.fps(), accel.profile.fps())
    return Calibration(tuple(_camera(name, stream, gyro) for name, stream in streams.cameras.items()), noise)


def _camera(name: str, stream: Stream, gyro: Stream) -> CameraOnBody:
    try:
        intrinsics, extrinsics = stream.profile.get_intrinsics(), gyro.profile.get_extrinsics_to(stream.profile)
    except RuntimeError as error:
        raise CalibrationError(
            f"the device does not know {name}, or how its IMU sits to it ({shortened(error)}); calibrate it with "
            "Kalibr, and name the result by --calibration"
        ) from error
    return on_body(name, lens(name, intrinsics), extrinsics)


def _noise_variances(motion: Stream) -> list[float]:
    """(3,), zeros where the device does not know them."""
    try:
        return list(motion.profile.as_motion_stream_profile().get_motion_intrinsics().noise_variances)
    except RuntimeError:
        return [0.0, 0.0, 0.0]


@contextmanager
def streaming(streams: Streams, emitter: bool, name: str) -> Iterator[Any]:
    """Within it the frames of all ``streams`` come into the ``rs2::frame_queue`` that it yields.

    The queue fills in librealsense's own threads, which never wait for Python. Raises :class:`SourceError` where the
    device cannot be started.
    """
    queue = sdk().frame_queue(_MOST_WAITING, keep_frames=True)
    with ExitStack() as running:
        try:
            _set_options(streams, emitter, name)
            for sensor, profiles in _by_sensor(streams):
                sensor.open(profiles)
                running.callback(_quietly, sensor.close)
                sensor.start(queue)
                running.callback(_quietly, sensor.stop)
        except RuntimeError as error:
            raise SourceError(
                f"{name} cannot be started: {shortened(error)}; end other programs that use it, or unplug it and "
                "plug it in"
            ) from error
        yield queue


def _by_sensor(streams: Streams) -> list[tuple[Any, list[Any]]]:
    """Sensors, which are opened once, with the profiles that are theirs."""
    grouped: list[tuple[Any, list[Any]]] = []
    for stream in streams.all():
        for sensor, profiles in grouped:
            if sensor is stream.sensor:
                profiles.append(stream.profile)
                break
        else:
            grouped.append((stream.sensor, [stream.profile]))
    return grouped


def _set_options(streams: Streams, emitter: bool, name: str) -> None:
    """Stamps by the device's own clock, and the pattern on or off.

    librealsense's global time is that clock led over to the computer's, by a line that it fits anew all the time: the
    distance of two stamps would be as uncertain as the line.
    """
    option = sdk().option
    for stream in streams.all():
        if stream.sensor.supports(option.global_time_enabled):
            stream.sensor.set_option(option.global_time_enabled, 0.0)
    for stream in streams.cameras.values():
        if stream.sensor.supports(option.emitter_enabled):
            stream.sensor.set_option(option.emitter_enabled, float(emitter))
        elif emitter:
            raise DatasetError(f"{name} has no emitter; leave -o emitter out")


def _quietly(end: Callable[[], None]) -> None:
    """A device that is gone has ended already."""
    with suppress(RuntimeError):
        end()
