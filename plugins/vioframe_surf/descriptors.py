"""SURF's descriptor (Bay, Ess, Tuytelaars and Van Gool, CVIU 2008, section 4) of all keypoints at once.

mahotas has one, but what it takes for the orientation of a keypoint does not turn with the image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float, Image

_WINDOWS = 72
"""Places that the window over the orientations takes, 60 degrees wide each."""


def describe(image: Image, xy: Float, scale: Float) -> NDArray[np.float32]:
    """(N, 64) unit vectors of the keypoints at ``xy`` (N, 2) px, whose ``scale`` (N,) px is the filter's sigma.

    What lies outside of the image is taken to be as its border.
    """
    reach = int(np.ceil(16.0 * scale.max(initial=1.0)))
    integral = np.pad(np.pad(image, reach, mode="edge").astype(np.float64), ((1, 0), (1, 0)))
    integral = integral.cumsum(axis=0).cumsum(axis=1)
    centre = xy + reach + 0.5  # of the pixel, where 0 is the outer edge of the first
    angle = _orientation(integral, centre, scale)
    return _window(integral, centre, scale, np.cos(angle), np.sin(angle))


def _orientation(integral: Float, centre: Float, scale: Float) -> Float:
    """(N,) rad: the longest sum of gradients within 60 degrees of one another, around each keypoint (section 4.1)."""
    u, v = (grid.ravel() for grid in np.mgrid[-5:6, -5:6])
    u, v = u[u**2 + v**2 < 36], v[u**2 + v**2 < 36]
    x, y = centre[:, :1] + scale[:, None] * u, centre[:, 1:] + scale[:, None] * v
    gradient = _haar(integral, x, y, 2.0 * scale) * np.exp(-(u**2 + v**2) / (2.0 * 2.0**2))
    direction = np.arctan2(gradient[1], gradient[0])
    starts = np.linspace(0.0, 2.0 * np.pi, _WINDOWS, endpoint=False)
    inside = (direction[:, None] - starts[:, None]) % (2.0 * np.pi) < np.pi / 3.0
    total = np.einsum("nws,gns->gnw", inside, gradient)
    longest = np.argmax((total**2).sum(axis=0), axis=1)
    best = np.take_along_axis(total, longest[None, :, None], axis=2)[..., 0]
    angle: Float = np.arctan2(best[1], best[0])
    return angle


def _window(integral: Float, centre: Float, scale: Float, c: Float, s: Float) -> NDArray[np.float32]:
    """(N, 64): sums of the turned gradients and of their magnitudes over 4 x 4 parts of a window (section 4.2)."""
    steps = np.arange(20) - 9.5
    v, u = np.meshgrid(steps, steps, indexing="ij")
    c, s, size = (value[:, None, None] for value in (c, s, scale))
    x = centre[:, 0, None, None] + size * (c * u - s * v)
    y = centre[:, 1, None, None] + size * (s * u + c * v)
    gradient_x, gradient_y = _haar(integral, x, y, scale) * np.exp(-(u**2 + v**2) / (2.0 * 3.3**2))
    turned = np.stack([c * gradient_x + s * gradient_y, c * gradient_y - s * gradient_x])
    both = np.concatenate([turned, np.abs(turned)]).reshape(4, -1, 4, 5, 4, 5)
    sums: Float = np.moveaxis(both.sum(axis=(3, 5)), 0, -1).reshape(-1, 64)
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    return sums.astype(np.float32)


def _haar(integral: Float, x: Float, y: Float, half: Float) -> Float:
    """(2, N, ...) right minus left and lower minus upper half of the squares around ``x`` and ``y`` (N, ...).

    ``half`` (N,) is half of their side; all in pixels.
    """
    column, row = (np.rint(value).astype(np.int64) for value in (x, y))
    reach = np.maximum(np.rint(half).astype(np.int64), 1).reshape(-1, *[1] * (x.ndim - 1))
    left, right, top, bottom = column - reach, column + reach, row - reach, row + reach

    def total(x0: NDArray[np.int64], x1: NDArray[np.int64], y0: NDArray[np.int64], y1: NDArray[np.int64]) -> Float:
        box: Float = integral[y1, x1] - integral[y0, x1] - integral[y1, x0] + integral[y0, x0]
        return box

    across = total(column, right, top, bottom) - total(left, column, top, bottom)
    down = total(left, right, row, bottom) - total(left, right, top, row)
    return np.stack([across, down])
