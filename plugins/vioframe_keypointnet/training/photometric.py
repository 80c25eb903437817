"""What light, lens and sensor do to an image, at random: training learns to find the same points all the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]
"""(H, W) or (H, W, 3) in [0, 1]."""


@dataclass(frozen=True, slots=True)
class PhotometricRange:
    """How far each effect may go; ``probability`` is that of each."""

    probability: float
    brightness: float
    """Largest shift."""
    contrast: tuple[float, float]
    gamma: tuple[float, float]
    exposure: tuple[float, float]
    """Factor, after which the image saturates."""
    blur_sigma_px: float
    motion_blur_px: float
    """Longest path during the exposure."""
    noise_sigma: float


def disturbed(picture: Picture, rng: np.random.Generator, limits: PhotometricRange) -> Picture:
    """A copy of ``picture`` in other light: exposure, gamma, contrast, brightness, blur and noise, in that order."""
    import cv2

    def happens() -> bool:
        return bool(rng.random() < limits.probability)

    out = picture.astype(np.float32)
    if happens():
        low, high = np.log(limits.exposure)
        out = np.minimum(out * np.float32(np.exp(rng.uniform(low, high))), 1.0)
    if happens():
        low, high = np.log(limits.gamma)
        out = out ** np.float32(np.exp(rng.uniform(low, high)))
    if happens():
        mean = out.mean()
        out = (out - mean) * np.float32(rng.uniform(*limits.contrast)) + mean
    if happens():
        out = out + np.float32(rng.uniform(-limits.brightness, limits.brightness))
    if limits.blur_sigma_px > 0.0 and happens():
        out = cv2.GaussianBlur(out, (0, 0), rng.uniform(0.1, limits.blur_sigma_px))
    if limits.motion_blur_px > 1 and happens():
        out = cv2.filter2D(out, -1, motion_kernel(rng.uniform(1.0, limits.motion_blur_px), rng.uniform(0.0, np.pi)))
    if happens():
        out = out + rng.normal(0.0, rng.uniform(0.0, limits.noise_sigma), out.shape).astype(np.float32)
    clipped: Picture = np.clip(out, 0.0, 1.0, dtype=np.float32)
    return clipped


def motion_kernel(length_px: float, angle_rad: float) -> Picture:
    """Point spread of a steady motion over ``length_px`` at ``angle_rad``; symmetric, so that points stay in place."""
    half = int(np.ceil(length_px / 2))
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    along = np.linspace(-length_px / 2, length_px / 2, 8 * half + 1)
    x, y = half + along * np.cos(angle_rad), half + along * np.sin(angle_rad)
    column, row = np.floor(x).astype(int), np.floor(y).astype(int)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dx - (x - column)) * np.abs(1 - dy - (y - row))
            inside = weight > 0.0
            np.add.at(kernel, (row[inside] + dy, column[inside] + dx), weight[inside])
    out: Picture = kernel / kernel.sum()
    return out
