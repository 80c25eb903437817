"""Hard conditions, each with a level from 0 (none of it) to 1, and what a level means in physical units.

``fog=0.5`` is a condition for all cameras of a rig, ``cam1.fog=0.5`` for one of them in its place.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field

from vioframe.arrays import Float
from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.parts.config import Section, validate
from vioframe.types import Calibration, CameraOnBody

Level = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Conditions(Section):
    """The level of each condition, as one camera meets it; properties say what that amounts to."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    motion_blur: Level = 0.0
    """exposure time: 1 is 40 ms, through which the camera moves"""
    exposure: Level = 0.0
    """brightness that jumps and drifts: 1 is by 2 stops up and down, in a scene of twice the dynamic range; bright
    parts saturate"""
    noise: Level = 0.0
    """sensor noise: at 1 its deviation is 8 % of white"""
    low_light: Level = 0.0
    """light: 1 leaves 3 %; the gain that makes up for it raises the noise with it"""
    low_texture: Level = 0.0
    """contrast of surfaces: 1 leaves 3 %"""
    fog: Level = 0.0
    """haze: at 1 contrast falls by a factor e every 2 m"""
    moving_objects: Level = 0.0
    """boxes that fly around: 1 is 16 of them"""
    dropped_frames: Level = 0.0
    """frames that are missing: 1 is every other one, at random"""
    time_offset: Level = 0.0
    """IMU stamps that are late and nobody says so: 1 is 50 ms"""
    vibration: Level = 0.0
    """rotors felt by the IMU and not by the camera: 1 is 3 m/s^2 and 0.15 rad/s rms"""
    wrong_calibration: Level = 0.0
    """calibration that is off, in random directions: 1 is 10 px in focal length and centre, 1 deg and 2 cm in the
    camera's pose"""
    rolling_shutter: Level = 0.0
    """readout of a rolling shutter that nobody is told of: 1 is 30 ms from the first row to the last"""
    blackout: Level = 0.0
    """black images in the middle of the recording, as behind a cover: 1 is 10 s of them"""

    @classmethod
    def of(cls, levels: Mapping[str, float | str]) -> Conditions:
        """From levels by name; raises :class:`ConfigError` for what is no condition or no level."""
        return validate(cls, levels, "conditions")

    @property
    def exposure_s(self) -> float:
        return 0.040 * self.motion_blur

    @property
    def readout_s(self) -> float:
        return 0.030 * self.rolling_shutter

    @property
    def stops(self) -> float:
        """How far the brightness strays, in powers of two."""
        return 2.0 * self.exposure

    @property
    def dynamic_range(self) -> float:
        """Exponent of the light around middle grey."""
        return 1.0 + self.exposure

    @property
    def light(self) -> float:
        """The part of full light there is, which the gain makes up for."""
        return 1.0 - 0.97 * self.low_light

    @property
    def noise_deviation(self) -> float:
        """Of noise beside that of the sensor itself, where white is 1."""
        return 0.08 * self.noise

    @property
    def contrast(self) -> float:
        return 1.0 - 0.97 * self.low_texture

    @property
    def fog_per_m(self) -> float:
        return 0.5 * self.fog

    @property
    def object_count(self) -> int:
        return round(16 * self.moving_objects)

    @property
    def dropped_part(self) -> float:
        return 0.5 * self.dropped_frames

    @property
    def late_ns(self) -> int:
        return round(0.050 * self.time_offset * 1e9)

    @property
    def black_s(self) -> float:
        return 10.0 * self.blackout


CONDITIONS = {name: " ".join((field.description or "").split()) for name, field in Conditions.model_fields.items()}
"""What each condition does, by name."""

OF_THE_FLIGHT = ("moving_objects", "vibration")
"""Those of the world and of the IMU, which are the same for all cameras."""


def parse_levels(texts: Iterable[str]) -> dict[str, float]:
    """Levels by name from texts such as ``fog=0.5`` or ``cam1.fog=0.5``; a name alone is the condition at full level.

    Raises :class:`ConfigError` for what is no condition or no level.
    """
    pairs = (text.partition("=") for text in texts)
    return check_levels({name.strip(): level if equals else 1.0 for name, equals, level in pairs})


def check_levels(levels: Mapping[str, float | str]) -> dict[str, float]:
    """The ``levels`` as numbers; raises :class:`ConfigError` for what is no condition, or none of one camera's own."""
    checked = {}
    for name, level in levels.items():
        camera, _, condition = name.rpartition(".")
        checked[name] = float(getattr(Conditions.of({condition: level}), condition))
        if camera and condition in OF_THE_FLIGHT:
            raise ConfigError(f"conditions: {condition} is the same for all cameras; leave {camera!r} out")
    return checked


def of_cameras(levels: Mapping[str, float], cameras: Sequence[str]) -> tuple[Conditions, ...]:
    """What each of the ``cameras``, given by name, meets; raises :class:`ConfigError` for one that is not there."""
    check_known("conditions", [name.rpartition(".")[0] for name in levels if "." in name], cameras)
    shared = {name: level for name, level in levels.items() if "." not in name}
    own = [{key: levels[f"{camera}.{key}"] for key in CONDITIONS if f"{camera}.{key}" in levels} for camera in cameras]
    return tuple(Conditions.of(shared | mine) for mine in own)


def check_known(what: str, wanted: Iterable[str], cameras: Sequence[str]) -> None:
    """Raise :class:`ConfigError` where ``what`` speaks of a camera that is none of the rig's."""
    for name in wanted:
        if name not in cameras:
            raise ConfigError(f"{what}: the rig has no camera {name!r}; its cameras: {', '.join(cameras)}")


def misled(calibration: Calibration, conditions: Sequence[Conditions], rng: np.random.Generator) -> Calibration:
    """What the estimator is told of ``calibration``: each camera off by the amount that its ``conditions`` ask for."""
    levels = [each.wrong_calibration for each in conditions]
    if not any(levels):
        return calibration
    cameras = zip(calibration.cameras, levels, strict=True)
    return replace(calibration, cameras=tuple(_misplaced(camera, level, rng) for camera, level in cameras))


def _misplaced(camera: CameraOnBody, level: float, rng: np.random.Generator) -> CameraOnBody:
    model = camera.model
    (d_fx, d_fy), (d_cx, d_cy) = ((level * 10.0 * _direction(rng, 2)).tolist() for _ in range(2))
    return replace(
        camera,
        model=replace(model, fx=model.fx + d_fx, fy=model.fy + d_fy, cx=model.cx + d_cx, cy=model.cy + d_cy),
        R_BC=camera.R_BC @ so3.exp(np.deg2rad(level * 1.0) * _direction(rng, 3)),
        p_BC=camera.p_BC + level * 0.02 * _direction(rng, 3),
    )


def _direction(rng: np.random.Generator, size: int) -> Float:
    vector = rng.standard_normal(size)
    return np.asarray(vector / np.linalg.norm(vector))
