"""Descriptors of keypoints, sampled from the network's map of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def describe(descriptors: Array, xy: Array) -> Array:
    """(N, D) unit descriptors at ``xy`` (N, 2) px of the image of which ``descriptors`` (D, H/4, W/4) are.

    Bilinear, corners of the map on the centres of the image's corner pixels, as the network was trained with
    (:func:`vioframe_keypointnet.network.describe` does the same in torch).
    """
    h, w = descriptors.shape[1:]
    x = np.clip(xy[:, 0] * ((w - 1) / (4 * w - 1)), 0.0, w - 1.0)
    y = np.clip(xy[:, 1] * ((h - 1) / (4 * h - 1)), 0.0, h - 1.0)
    left, top = x.astype(np.intp), y.astype(np.intp)
    right, bottom = np.minimum(left + 1, w - 1), np.minimum(top + 1, h - 1)
    dx, dy = x - left, y - top
    upper = descriptors[:, top, left] * (1.0 - dx) + descriptors[:, top, right] * dx
    lower = descriptors[:, bottom, left] * (1.0 - dx) + descriptors[:, bottom, right] * dx
    sampled = (upper * (1.0 - dy) + lower * dy).T
    length = np.linalg.norm(sampled, axis=1, keepdims=True)
    unit: Array = (sampled / np.maximum(length, 1e-12)).astype(np.float32)
    return unit
