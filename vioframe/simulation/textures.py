"""Procedural textures with detail at every scale, as photographs have: walls, plates, machinery and clutter.

Each is a square uint8 image drawn from a random generator, so that a seed gives the same texture to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vioframe.errors import ConfigError
from vioframe.types import Float, Image

SIZE = 1024
"""Width and height of every texture, in texels; a power of two."""

_IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
_SHIFT = 4
_FIXED = 1 << _SHIFT


def procedural_textures(rng: np.random.Generator, count: int) -> tuple[Image, ...]:
    """``count`` textures (SIZE, SIZE), the styles in turn."""
    return tuple(_finish(_STYLES[i % len(_STYLES)](rng), rng) for i in range(count))


def cloud(rng: np.random.Generator, roughness: float = 1.0) -> Float:
    """(SIZE, SIZE) noise of mean 0 and deviation 1 whose amplitude falls with frequency as ``f ** -roughness``."""
    spectrum = np.fft.rfft2(rng.standard_normal((SIZE, SIZE)))
    spectrum *= _amplitudes(roughness)
    noise = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    noise /= noise.std()
    return np.asarray(noise, np.float64)


@cache
def _amplitudes(roughness: float) -> Float:
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE)[None, :])
    frequency[0, 0] = np.inf
    return np.asarray(frequency**-roughness)


def _finish(image: Float, rng: np.random.Generator) -> Image:
    """Stains, wear and grain over a drawing, as no real surface is without."""
    # Step by step in place: memory that is new takes longer than the arithmetic.
    worn = cloud(rng, 1.5)
    worn *= 0.13
    worn += 1.0
    worn *= image
    for weight, noise in ((9.0, cloud(rng, 0.8)), (4.0, rng.standard_normal(image.shape))):
        noise *= weight
        worn += noise
    return np.clip(worn, 0.0, 255.0, out=worn).astype(np.uint8)


def _bricks(rng: np.random.Generator) -> Float:
    mortar, height = rng.uniform(90.0, 200.0), int(rng.integers(36, 60))
    canvas = np.full((SIZE, SIZE), mortar)
    width, face = 2.3 * height, rng.uniform(60.0, 150.0)
    for row in range(SIZE // height + 1):
        for column in range(-1, int(SIZE / width) + 1):
            left, top = round((column + 0.5 * (row % 2)) * width), row * height
            corner = (left + round(width) - 4, top + height - 4)
            cv2.rectangle(canvas, (left, top), corner, face + rng.normal(0.0, 26.0), -1)
    _leaves(canvas, rng, 60, 8.0, 60.0)
    return canvas


def _concrete(rng: np.random.Generator) -> Float:
    canvas = np.full((SIZE, SIZE), rng.uniform(120.0, 190.0)) + 14.0 * cloud(rng, 1.3)
    step = SIZE // int(rng.integers(2, 5))
    for at in range(0, SIZE, step):
        cv2.line(canvas, (at, 0), (at, SIZE), 45.0, 5)
        cv2.line(canvas, (0, at), (SIZE, at), 45.0, 5)
        for other in range(0, SIZE, step):
            for dx, dy in ((30, 30), (step - 30, 30), (30, step - 30), (step - 30, step - 30)):
                cv2.circle(canvas, (at + dx, other + dy), 9, rng.uniform(20.0, 80.0), -1, cv2.LINE_AA)
    for _ in range(14):  # cracks: random walks
        steps = rng.normal(0.0, 9.0, (60, 2)) + rng.normal(0.0, 6.0, 2)
        points = rng.uniform(0, SIZE, 2) + np.cumsum(steps, axis=0)
        cv2.polylines(canvas, [np.round(points * _FIXED).astype(np.int32)], False, 40.0, 2, cv2.LINE_AA, _SHIFT)
    _leaves(canvas, rng, 150, 5.0, 50.0)
    return canvas


def _machinery(rng: np.random.Generator) -> Float:
    """Rectangles split again and again, with bolts, gauges and stripes in them."""
    canvas = np.full((SIZE, SIZE), 128.0)
    pending = [(0, 0, SIZE, SIZE)]
    while pending:
        x, y, w, h = pending.pop()
        if max(w, h) > 60 and (max(w, h) > 300 or rng.random() < 0.72):
            cut = rng.uniform(0.3, 0.7)
            if w >= h:
                pending += [(x, y, int(w * cut), h), (x + int(w * cut), y, w - int(w * cut), h)]
            else:
                pending += [(x, y, w, int(h * cut)), (x, y + int(h * cut), w, h - int(h * cut))]
            continue
        cv2.rectangle(canvas, (x + 2, y + 2), (x + w - 3, y + h - 3), rng.uniform(40.0, 215.0), -1)
        kind, tone = rng.integers(4), rng.uniform(10.0, 245.0)
        if kind == 0:
            cv2.circle(canvas, (x + w // 2, y + h // 2), max(3, min(w, h) // 3), tone, -1, cv2.LINE_AA)
        elif kind == 1:
            for at in range(y + 8, y + h - 8, 12):
                cv2.line(canvas, (x + 8, at), (x + w - 8, at), tone, 4)
        elif kind == 2:
            for dx, dy in ((9, 9), (w - 9, 9), (9, h - 9), (w - 9, h - 9)):
                cv2.circle(canvas, (x + dx, y + dy), 4, tone, -1, cv2.LINE_AA)
    _leaves(canvas, rng, 80, 4.0, 30.0)
    return canvas


def _clutter(rng: np.random.Generator) -> Float:
    canvas = np.full((SIZE, SIZE), 110.0)
    _leaves(canvas, rng, 1600, 6.0, 190.0)
    return canvas


def _leaves(canvas: Float, rng: np.random.Generator, count: int, smallest: float, largest: float) -> None:
    """Shapes that cover one another, radii px by a cubic power law: the dead-leaves model of natural images, whose
    statistics do not depend on the distance they are seen from (Lee, Mumford and Huang, IJCV 2001)."""
    radii = (smallest**-2 + rng.random(count) * (largest**-2 - smallest**-2)) ** -0.5
    for radius in np.sort(radii)[::-1]:
        corners = int(rng.choice([3, 4, 4, 4, 5, 16]))
        regular = 2.0 * np.pi * np.arange(corners) / corners
        angles = regular if corners == 16 else np.sort(rng.uniform(0.0, 2.0 * np.pi, corners))
        shape = radius * np.column_stack([np.cos(angles), np.sin(angles) * rng.uniform(0.5, 1.0)])
        points = np.round((rng.uniform(0, SIZE, 2) + shape) * _FIXED).astype(np.int32)
        cv2.fillPoly(canvas, [points], rng.uniform(15.0, 240.0), cv2.LINE_AA, _SHIFT)


_STYLES: tuple[Callable[[np.random.Generator], Float], ...] = (_bricks, _concrete, _machinery, _clutter)


def images_as_textures(folder: Path, rng: np.random.Generator, count: int) -> tuple[Image, ...]:
    """Up to ``count`` images of ``folder``, drawn at random, each mirrored so that it repeats without a seam.

    Raises :class:`ConfigError` where there is none that can be read.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder} is not a folder; name one that holds images (PNG, JPEG ...)")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _IMAGE_SUFFIXES)
    chosen = sorted(rng.permutation(len(files))[:count].tolist())
    read = (cv2.imread(str(files[i]), cv2.IMREAD_GRAYSCALE) for i in chosen)
    textures = tuple(_mirrored(image) for image in read if image is not None)
    if not textures:
        raise ConfigError(f"{folder} holds no image that can be read; name a folder of PNG or JPEG files")
    return textures


def _mirrored(image: NDArray[Any]) -> Image:
    quarter = cv2.resize(image, (SIZE // 2, SIZE // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.copyMakeBorder(quarter, 0, SIZE // 2, 0, SIZE // 2, cv2.BORDER_REFLECT), np.uint8)
