"""Hard conditions, each with a level from 0 (none of it) to 1, and what a level means in physical units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import ConfigDict, Field

from vioframe.arrays import Float
from vioframe.geometry import so3
from vioframe.parts.config import Section, validate
from vioframe.types import Calibration, CameraOnBody

Level = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class Conditions(Section):
    """The level of each condition; properties say what that amounts to."""

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

    @classmethod
    def of(cls, levels: Mapping[str, float | str]) -> Conditions:
        """From levels by name; raises :class:`ConfigError` for what is no condition or no level."""
        return validate(cls, levels, "conditions")

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Conditions:
        """From texts such as ``fog=0.5``; a name alone is the condition at its full level."""
        pairs = (text.partition("=") for text in texts)
        return cls.of({name.strip(): level if equals else 1.0 for name, equals, level in pairs})

    @property
    def levels(self) -> dict[str, float]:
        """The conditions there are, by name: those above zero."""
        return {name: level for name, level in self.model_dump().items() if level > 0.0}

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

    def mislead(self, calibration: Calibration, rng: np.random.Generator) -> Calibration:
        """What the estimator is told of ``calibration``: each camera off by the amount asked for."""
        if not self.wrong_calibration:
            return calibration
        return replace(calibration, cameras=tuple(self._misplaced(camera, rng) for camera in calibration.cameras))

    def _misplaced(self, camera: CameraOnBody, rng: np.random.Generator) -> CameraOnBody:
        level, model = self.wrong_calibration, camera.model
        (d_fx, d_fy), (d_cx, d_cy) = ((level * 10.0 * _direction(rng, 2)).tolist() for _ in range(2))
        return replace(
            camera,
            model=replace(model, fx=model.fx + d_fx, fy=model.fy + d_fy, cx=model.cx + d_cx, cy=model.cy + d_cy),
            R_BC=camera.R_BC @ so3.exp(np.deg2rad(level * 1.0) * _direction(rng, 3)),
            p_BC=camera.p_BC + level * 0.02 * _direction(rng, 3),
        )


CONDITIONS = {name: " ".join((field.description or "").split()) for name, field in Conditions.model_fields.items()}
"""What each condition does, by name."""


def _direction(rng: np.random.Generator, size: int) -> Float:
    vector = rng.standard_normal(size)
    return np.asarray(vector / np.linalg.norm(vector))
