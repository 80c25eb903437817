"""Hard conditions, each with a level from 0 (none of it) to 1, and what a level means in physical units."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.parts.options import did_you_mean, options_of
from vioframe.types import Calibration, Float

_EXPOSURE_S = 0.040
_STOPS = 2.0
_NOISE = 0.08
_DARKNESS = 0.97
_PLAINNESS = 0.97
_FOG_PER_M = 0.5
_OBJECTS = 16
_DROPPED = 0.5
_LATE_S = 0.050
_READOUT_S = 0.030
_ROTATION_DEG = 1.0
_TRANSLATION_M = 0.02
_INTRINSICS_PX = 10.0


@dataclass(frozen=True)
class Conditions:
    """The level of each condition; raises :class:`ConfigError` for one outside 0 to 1."""

    motion_blur: float = 0.0
    """exposure time: 1 is 40 ms, through which the camera moves"""
    exposure: float = 0.0
    """brightness that jumps and drifts: 1 is by 2 stops up and down, in a scene of twice the dynamic range; bright
    parts saturate"""
    noise: float = 0.0
    """sensor noise: at 1 its deviation is 8 % of white"""
    low_light: float = 0.0
    """light: 1 leaves 3 %; the gain that makes up for it raises the noise with it"""
    low_texture: float = 0.0
    """contrast of surfaces: 1 leaves 3 %"""
    fog: float = 0.0
    """haze: at 1 contrast falls by a factor e every 2 m"""
    moving_objects: float = 0.0
    """boxes that fly around: 1 is 16 of them"""
    dropped_frames: float = 0.0
    """frames that are missing: 1 is every other one, at random"""
    time_offset: float = 0.0
    """IMU stamps that are late and nobody says so: 1 is 50 ms"""
    vibration: float = 0.0
    """rotors felt by the IMU and not by the camera: 1 is 3 m/s^2 and 0.15 rad/s rms"""
    wrong_calibration: float = 0.0
    """calibration that is off, in random directions: 1 is 10 px in focal length and centre, 1 deg and 2 cm in the
    camera's pose"""
    rolling_shutter: float = 0.0
    """time from the first row to the last: 1 is 30 ms"""

    def __post_init__(self) -> None:
        for name, level in asdict(self).items():
            if not 0.0 <= level <= 1.0:
                raise ConfigError(f"the level of {name} must lie between 0 (none) and 1, not {level:g}")

    @classmethod
    def of(cls, levels: Mapping[str, float]) -> Conditions:
        """From levels by name; raises :class:`ConfigError` for a name that is not a condition."""
        for name in levels:
            if name not in CONDITIONS:
                hint = did_you_mean(name, CONDITIONS)
                raise ConfigError(f"no condition is called {name!r}{hint}; there are {', '.join(CONDITIONS)}")
        return cls(**levels)

    @classmethod
    def parse(cls, texts: Iterable[str]) -> Conditions:
        """From texts such as ``fog=0.5``; a name alone is the condition at its full level."""
        levels = {}
        for text in texts:
            name, equals, level = text.partition("=")
            try:
                levels[name.strip()] = float(level) if equals else 1.0
            except ValueError:
                raise ConfigError(f"{text!r}: the level must be a number from 0 to 1, as in fog=0.5") from None
        return cls.of(levels)

    @property
    def levels(self) -> dict[str, float]:
        """The conditions there are, by name: those above zero."""
        return {name: level for name, level in asdict(self).items() if level > 0.0}

    @property
    def exposure_s(self) -> float:
        return _EXPOSURE_S * self.motion_blur

    @property
    def readout_s(self) -> float:
        return _READOUT_S * self.rolling_shutter

    @property
    def stops(self) -> float:
        """How far the brightness strays, in powers of two."""
        return _STOPS * self.exposure

    @property
    def dynamic_range(self) -> float:
        """Exponent of the light around middle grey."""
        return 1.0 + self.exposure

    @property
    def light(self) -> float:
        return 1.0 - _DARKNESS * self.low_light

    @property
    def noise_deviation(self) -> float:
        """Of the read-out noise, where white is 1."""
        return _NOISE * self.noise

    @property
    def contrast(self) -> float:
        return 1.0 - _PLAINNESS * self.low_texture

    @property
    def fog_per_m(self) -> float:
        return _FOG_PER_M * self.fog

    @property
    def object_count(self) -> int:
        return round(_OBJECTS * self.moving_objects)

    @property
    def dropped_part(self) -> float:
        return _DROPPED * self.dropped_frames

    @property
    def late_ns(self) -> int:
        return round(_LATE_S * self.time_offset * 1e9)

    def mislead(self, calibration: Calibration, rng: np.random.Generator) -> Calibration:
        """What the estimator is told of ``calibration``: off by the amount asked for, in random directions."""
        level = self.wrong_calibration
        if not level:
            return calibration
        camera = calibration.camera
        d_focal, d_centre = (level * _INTRINSICS_PX * _direction(rng, 2) for _ in range(2))
        return replace(
            calibration,
            camera=replace(
                camera,
                fx=camera.fx + float(d_focal[0]),
                fy=camera.fy + float(d_focal[1]),
                cx=camera.cx + float(d_centre[0]),
                cy=camera.cy + float(d_centre[1]),
            ),
            R_BC=calibration.R_BC @ so3.exp(np.deg2rad(level * _ROTATION_DEG) * _direction(rng, 3)),
            p_BC=calibration.p_BC + level * _TRANSLATION_M * _direction(rng, 3),
        )


CONDITIONS: dict[str, str] = {option.name: option.doc for option in options_of(Conditions)}
"""What each condition does, by name."""


def _direction(rng: np.random.Generator, size: int) -> Float:
    vector = rng.standard_normal(size)
    return np.asarray(vector / np.linalg.norm(vector))
