"""Images made worse by degrees: motion blur, little light, brightness that changes, noise, lost contrast.

Levels are in units that do not depend on the size of an image, so that those of photographs at 320 x 240 and of a
flight at 752 x 480 mean the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError
from vioframe.parts.options import did_you_mean
from vioframe.simulation.camera import digitise
from vioframe.types import Float, Image

_WHITE = 255.0
_SENSOR_NOISE = 1.0 / 255.0
"""Left over by a sensor when the contrast is gone: without it, less contrast is the same picture on a finer scale."""


@dataclass(frozen=True, slots=True)
class Circumstances:
    """What one image's degradation depends on beside its level.

    ``direction_rad`` is where the image moved during the exposure, from x towards y; ``phase`` in 0..1 how far the
    brightness has swung; ``rng`` what noise is drawn from.
    """

    rng: np.random.Generator
    direction_rad: float = 0.0
    phase: float = 1.0


@dataclass(frozen=True, slots=True)
class Kind:
    """A way to make images worse, the levels it is tried at, and what they mean."""

    apply: Callable[[Image, float, Circumstances], Image]
    levels: tuple[float, ...]
    unit: str


@dataclass(frozen=True, slots=True)
class Degradation:
    """A kind by name and a level; ``none`` leaves images as they are."""

    name: str = "none"
    level: float = 0.0

    @property
    def label(self) -> str:
        return self.name if self.name == "none" else f"{self.name} {KINDS[self.name].unit.format(self.level)}"

    @property
    def columns(self) -> dict[str, Any]:
        """What says in a table which it is."""
        return {"degradation": self.name, "level": self.level}

    def __call__(self, image: Image, circumstances: Circumstances) -> Image:
        """``image`` (H, W) made worse; it is left as it is."""
        return image if self.name == "none" else KINDS[self.name].apply(image, self.level, circumstances)


def choose(names: Sequence[str]) -> list[Degradation]:
    """None, and then all levels of the kinds of these ``names``, of every kind where there are no names.

    The name ``none`` adds nothing: alone, it stands for images as they are. Raises :class:`ConfigError` for others.
    """
    for name in names:
        if name != "none" and name not in KINDS:
            hint = did_you_mean(name, KINDS)
            raise ConfigError(f"no degradation is called {name!r}{hint}; there are none, {', '.join(KINDS)}")
    chosen = [name for name in KINDS if name in names or not names]
    return [Degradation(), *(Degradation(name, level) for name in chosen for level in KINDS[name].levels)]


def motion_blur(image: Image, level: float, circumstances: Circumstances) -> Image:
    """Smeared along a line of ``level`` times the image's width; its middle is where things were."""
    import cv2

    kernel = line_kernel(level * image.shape[1], circumstances.direction_rad)
    return np.asarray(cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REFLECT_101), np.uint8)


def line_kernel(length_px: float, direction_rad: float) -> Float:
    """(K, K) weights of a line of that length through the middle, K odd; they sum to one, their mean is the middle."""
    half = int(np.ceil(0.5 * length_px)) + 1
    along = length_px * ((np.arange(count := 8 * half) + 0.5) / count - 0.5)
    xy = half + along[:, None] * np.array([np.cos(direction_rad), np.sin(direction_rad)])
    low = np.floor(xy).astype(np.int64)
    part = xy - low
    kernel = np.zeros((2 * half + 2, 2 * half + 2))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            np.add.at(kernel, (low[:, 1] + dy, low[:, 0] + dx), weight / count)
    return kernel[:-1, :-1]


def low_light(image: Image, level: float, circumstances: Circumstances) -> Image:
    """As a camera sees it in ``level`` of full light, through the gain that makes up for it."""
    return digitise(_light(image), circumstances.rng, exposed=level)


def gamma(image: Image, level: float, circumstances: Circumstances) -> Image:
    """Darker mid-tones: light to the power of ``level`` at phase 1, as it was at phase 0."""
    return digitise(_light(image) ** np.float32(level**circumstances.phase), circumstances.rng)


def noise(image: Image, level: float, circumstances: Circumstances) -> Image:
    """Noise of deviation ``level``, white is 1, and the shot noise of a sensor."""
    return digitise(_light(image), circumstances.rng, noise_deviation=level)


def contrast(image: Image, level: float, circumstances: Circumstances) -> Image:
    """``level`` of what the image has around its mean, and a grey level of noise."""
    light = _light(image)
    mean = light.mean()
    return digitise(mean + np.float32(level) * (light - mean), circumstances.rng, noise_deviation=_SENSOR_NOISE)


def _light(image: Image) -> NDArray[np.float32]:
    return image * np.float32(1.0 / _WHITE)


KINDS = {
    "motion_blur": Kind(motion_blur, (0.01, 0.02, 0.04), "{:.0%} of the width"),
    "low_light": Kind(low_light, (0.2, 0.08, 0.03), "{:.0%} of the light"),
    "gamma": Kind(gamma, (1.5, 2.5, 4.0), "{:g}"),
    "noise": Kind(noise, (0.02, 0.05, 0.1), "{:.0%} of white"),
    "contrast": Kind(contrast, (0.5, 0.2, 0.1), "{:.0%} left"),
}
"""All there are, each from mild to hard."""
