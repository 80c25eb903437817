"""Images to try detectors on: from folders, recordings or drawn, and pairs of views whose homography is known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import DatasetError
from vioframe.interfaces import Dataset
from vioframe.io.images import decode_image, to_gray8
from vioframe.types import Float, FrameSet, Image

ItemT = TypeVar("ItemT")

_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")

_ROTATION_DEG = 30.0
_SCALE = 1.25
_PERSPECTIVE = 0.08
_SHIFT = 0.1
_HPATCHES_VIEWS = range(2, 7)


@dataclass(frozen=True, slots=True)
class Views:
    """Two images of one size; ``H_21`` (3, 3) takes px of the first to px of the second."""

    first: Image
    second: Image
    H_21: Float


Pair = Callable[[tuple[int, int]], Views]
"""Two views yet to be loaded, at a resolution (width, height); raises :class:`DatasetError` where that fails."""


def find_images(folder: Path) -> list[Path]:
    """The image files in ``folder`` and below, by name; raises :class:`DatasetError` where there is none."""
    if not folder.is_dir():
        raise DatasetError(f"{folder} is not a folder; name one that holds images (PNG, JPEG ...)")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _SUFFIXES)
    if not files:
        raise DatasetError(f"{folder} holds no images; name a folder of PNG, JPEG or PPM files")
    return files


def read_image(path: Path) -> NDArray[Any]:
    """An image file as it is, channels in OpenCV's order; raises :class:`DatasetError` where it cannot be decoded."""
    image = decode_image(path.read_bytes(), str(path))
    if image is None:
        raise DatasetError(f"{path} cannot be decoded; replace it or take it away")
    return image


def read_grey(path: Path) -> Image:
    """(H, W) uint8; raises :class:`DatasetError` where the file cannot be decoded."""
    return to_gray8(read_image(path), 16, str(path))


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


def synthetic_pair(path: Path, seed: tuple[int, ...], resolution: tuple[int, int]) -> Views:
    """A photograph, and the same through a homography drawn by ``seed``."""
    image = read_grey(path)
    A = fitting(image.shape, resolution)
    H_21 = random_homography(np.random.default_rng(seed), resolution)
    # Both straight from the photograph: the second is no blurrier for having been warped.
    first, second = (view(image, H @ A, resolution, A[0, 0]) for H in (np.eye(3), H_21))
    return Views(first, second, H_21)


def hpatches_pair(folder: Path, k: int, resolution: tuple[int, int]) -> Views:
    """Images 1 and ``k`` of a sequence of HPatches (Balntas et al., CVPR 2017)."""
    images = [read_grey(folder / f"{n}.ppm") for n in (1, k)]
    A_1, A_2 = (fitting(image.shape, resolution) for image in images)
    H_21 = A_2 @ _read_homography(folder / f"H_1_{k}") @ np.linalg.inv(A_1)
    first, second = (view(i, A, resolution, A[0, 0]) for i, A in zip(images, (A_1, A_2), strict=True))
    return Views(first, second, H_21 / H_21[2, 2])


def synthetic_pairs(folder: Path, seed: int) -> list[Pair]:
    """A pair for every image in ``folder``; raises :class:`DatasetError` where there is none."""
    return [partial(synthetic_pair, path, (seed, k)) for k, path in enumerate(find_images(folder))]


def hpatches_pairs(folder: Path) -> list[Pair]:
    """The five pairs of each sequence in ``folder``; raises :class:`DatasetError` where that is not HPatches."""
    sequences = sorted(path for kind in "iv" for path in folder.glob(f"{kind}_*") if path.is_dir())
    if not sequences:
        raise DatasetError(f"{folder} has no folders i_* and v_*; name that of HPatches (hpatches-sequences-release)")
    for sequence in sequences:
        for name in ("1.ppm", *(f"{k}.ppm" for k in _HPATCHES_VIEWS), *(f"H_1_{k}" for k in _HPATCHES_VIEWS)):
            if not (sequence / name).is_file():
                raise DatasetError(
                    f"{sequence / name} is missing; a sequence of HPatches has 1.ppm to 6.ppm and H_1_2 to H_1_6"
                )
    return [partial(hpatches_pair, sequence, k) for sequence in sequences for k in _HPATCHES_VIEWS]


def random_homography(rng: np.random.Generator, resolution: tuple[int, int]) -> Float:
    """(3, 3), from px to px: rotation to 30 deg, scale 0.8 to 1.25, shift to 10 %, each corner by 8 % of the size."""
    import cv2

    size = np.array(resolution, np.float64)
    corners = corners_of(resolution)
    centre = 0.5 * (size - 1.0)
    angle = np.deg2rad(rng.uniform(-_ROTATION_DEG, _ROTATION_DEG))
    scale = np.exp(rng.uniform(-np.log(_SCALE), np.log(_SCALE)))
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    bent = corners + size * rng.uniform(-_PERSPECTIVE, _PERSPECTIVE, (4, 2))
    moved = scale * (bent - centre) @ R.T + centre + size * rng.uniform(-_SHIFT, _SHIFT, 2)
    return np.asarray(cv2.getPerspectiveTransform(corners.astype(np.float32), moved.astype(np.float32)))


def corners_of(resolution: tuple[int, int]) -> Float:
    """(4, 2) px of the outermost pixel centres."""
    width, height = resolution
    return np.array([[0.0, 0.0], [width - 1.0, 0.0], [width - 1.0, height - 1.0], [0.0, height - 1.0]])


def _read_homography(path: Path) -> Float:
    try:
        H = np.loadtxt(path)
    except ValueError as error:
        raise DatasetError(f"{path} is no homography: {error}") from error
    if H.shape != (3, 3) or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        raise DatasetError(f"{path} is no homography: it must hold three rows of three numbers, of full rank")
    return H
