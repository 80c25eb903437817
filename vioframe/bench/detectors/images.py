"""Images to try detectors on, and views of them at the size wanted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TypeVar

import numpy as np

from vioframe.errors import DatasetError
from vioframe.interfaces import Dataset
from vioframe.io.images import decode_image, to_gray8
from vioframe.types import Float, FrameSet, Image

ItemT = TypeVar("ItemT")

_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")


def find_images(folder: Path) -> list[Path]:
    """The image files in ``folder`` and below, by name; raises :class:`DatasetError` where there is none."""
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder; name one that holds images (PNG, JPEG ...)")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    if not files:
        raise DatasetError(f"{folder} holds no images; name a folder of PNG, JPEG or PPM files")
    return files


def read_grey(path: Path) -> Image:
    """(H, W) uint8; raises :class:`DatasetError` where the file cannot be decoded."""
    image = decode_image(path.read_bytes())
    if image is None:
        raise DatasetError(f"{path} cannot be decoded; replace it or take it away")
    return to_gray8(image, 16, str(path))


def evenly(items: Sequence[ItemT], count: int | None) -> list[ItemT]:
    """``count`` of ``items`` at equal distances, from the first to the last; all where there are no more."""
    if count is None or count >= len(items):
        return list(items)
    return [items[i] for i in np.round(np.linspace(0, len(items) - 1, count)).astype(int)]


def frames_of(dataset: Dataset, count: int) -> Iterator[tuple[int, FrameSet]]:
    """At most ``count`` frames of a recording, evenly over it, each with its number."""
    every = max(1, (dataset.frame_count or count) // count)
    frames = (measurement for measurement in dataset.measurements() if isinstance(measurement, FrameSet))
    return islice(enumerate(frames), 0, every * count, every)


def fitting(shape: tuple[int, ...], resolution: tuple[int, int]) -> Float:
    """(3, 3) from px of an image of ``shape`` (H, W) to px of a view of ``resolution`` (width, height).

    The view is filled: what is too wide or too high is cut off evenly on both sides.
    """
    size, target = np.array(shape[1::-1], np.float64), np.array(resolution, np.float64)
    scale = float((target / size).max())
    # Integers are pixel centres: the corner of an image is at -0.5.
    shift = 0.5 * scale - 0.5 + 0.5 * (target - scale * size)
    return np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]], [0.0, 0.0, 1.0]])


def view(image: Image, H: Float, resolution: tuple[int, int], scale: float) -> Image:
    """``image`` through ``H`` (3, 3), from its px to those of a view of ``resolution`` (width, height).

    ``scale`` is by how much it shrinks (below 1), which has to be smoothed away first. Beyond its edges the image is
    mirrored, so that no edge is seen there that is none.
    """
    import cv2

    if scale < 1.0:
        image = cv2.GaussianBlur(image, (0, 0), 0.5 * np.sqrt(scale**-2 - 1.0)).astype(np.uint8, copy=False)
    warped = cv2.warpPerspective(image, H, resolution, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.asarray(warped, np.uint8)


def fit(image: Image, resolution: tuple[int, int]) -> Image:
    """``image`` at ``resolution`` (width, height), cut to its shape."""
    A = fitting(image.shape, resolution)
    return view(image, A, resolution, A[0, 0])


def procedural_images(count: int, resolution: tuple[int, int], seed: int) -> list[Image]:
    """``count`` drawn surfaces, as the simulator's: for where no folder of images is at hand."""
    from vioframe.simulation.textures import procedural_textures

    return [fit(texture, resolution) for texture in procedural_textures(np.random.default_rng(seed), count)]
