"""A sensor: light gathered, amplified, read out with noise and digitised."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Image

_FULL_WELL = 10_000.0
"""Electrons of a white pixel at a gain of one: their shot noise is what low light is noisy by."""
_READ_NOISE = 0.002
_WHITE = 255.0


def digitise(
    light: NDArray[np.float32],
    rng: np.random.Generator,
    *,
    gain: float = 1.0,
    exposed: float = 1.0,
    noise_deviation: float = 0.0,
) -> Image:
    """``light`` (H, W), 1 for white, times ``gain`` as (H, W) uint8.

    ``exposed`` is the part of full light there is, which an amplifier makes up for; ``noise_deviation`` is added to
    that of the sensor itself, 1 is white. In full light and without it there is no noise, and ``rng`` is left alone.
    """
    value = light * gain
    if exposed < 1.0 or noise_deviation > 0.0:
        # Shot noise is that of the electrons gathered; the gain amplifies it and the read-out noise alike.
        amplification = gain / exposed
        shot_variance = np.maximum(light, 0.0) * exposed / _FULL_WELL
        deviation = np.sqrt(amplification**2 * (shot_variance + _READ_NOISE**2) + noise_deviation**2)
        value = value + deviation * rng.standard_normal(light.shape, dtype=np.float32)
    image: Image = np.clip(np.round(_WHITE * value), 0.0, _WHITE).astype(np.uint8)
    return image
