"""Images to detect something in."""

import cv2
import numpy as np


def textured(seed=0, size=(320, 240)):
    """Smooth blobs of noise; ``size`` is (width, height)."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=size[::-1]), (0, 0), 2.0)
    return np.clip(128 + 40 * noise / noise.std(), 0, 255).astype(np.uint8)
