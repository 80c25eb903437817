"""Images to train on: folders of photographs, and recordings (bags, ASL folders) of which frames are taken."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vioframe.bench.detectors.images import frames_of
from vioframe.errors import ConfigError, DatasetError
from vioframe.interfaces import Dataset
from vioframe.io.images import decode_image, to_gray8
from vioframe.parts import registry

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp"})
_SMALLEST_PX = 64


@dataclass(frozen=True, slots=True)
class Picture:
    """One image, (H, W) or (H, W, 3) RGB uint8, and the file or recording that it is from."""

    name: str
    pixels: NDArray[np.uint8]


def gather(sources: Sequence[Path], channels: int, frames_per_recording: int) -> list[Picture]:
    """All images of ``sources`` in a settled order, with ``channels`` 1 (grey) or 3 (RGB).

    A source is a folder of photographs (searched to its depths) or a recording that a reader opens. Raises
    :class:`ConfigError` for one that holds no image of use.
    """
    pictures: list[Picture] = []
    for source in sources:
        if not source.exists():
            raise ConfigError(f"{source} does not exist; --images takes folders of photographs and recordings")
        try:
            dataset = registry.load().open_dataset(source)
        except DatasetError as error:
            found = _photographs(source, channels) if source.is_dir() else []
            if not found:
                raise ConfigError(f"{source} holds neither photographs nor a recording: {error}") from error
            pictures += found
        else:
            pictures += _frames(dataset, channels, frames_per_recording, str(source))
    return pictures


def split(pictures: Iterable[Picture], hold_out: Sequence[str]) -> tuple[list[Picture], list[Picture]]:
    """Those to train on and those held out: the ones whose name matches a pattern such as ``*/V1_*`` or contains it."""
    train: list[Picture] = []
    held: list[Picture] = []
    for picture in pictures:
        out = any(pattern in picture.name or fnmatch(picture.name, pattern) for pattern in hold_out)
        (held if out else train).append(picture)
    if not train:
        raise ConfigError("every image is held out; narrow --hold-out or name more --images")
    if hold_out and not held:
        raise ConfigError(f"no image is named like --hold-out {' '.join(hold_out)}; nothing would be held out")
    return train, held


def _photographs(folder: Path, channels: int) -> list[Picture]:
    out = []
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES):
        pixels = decode_image(path.read_bytes())
        if pixels is None:
            raise ConfigError(f"{path} is damaged or no image; repair or remove it")
        if min(pixels.shape[:2]) >= _SMALLEST_PX:
            out.append(Picture(str(path), _with_channels(pixels, channels, str(path))))
    return out


def _frames(dataset: Dataset, channels: int, count: int, where: str) -> list[Picture]:
    taken = frames_of(dataset, count)
    return [Picture(f"{where}#{k}", _with_channels(frame.image, channels, where)) for k, frame in taken]


def _with_channels(pixels: NDArray[np.generic], channels: int, where: str) -> NDArray[np.uint8]:
    """OpenCV's (H, W), BGR or BGRA -> grey or RGB."""
    if channels == 1 or pixels.ndim == 2:
        grey = to_gray8(pixels, 16, where)
        return grey if channels == 1 else np.repeat(grey[..., None], 3, axis=2)
    if pixels.dtype != np.uint8:
        return np.repeat(to_gray8(pixels, 16, where)[..., None], 3, axis=2)
    return np.ascontiguousarray(pixels[..., 2::-1], np.uint8)
