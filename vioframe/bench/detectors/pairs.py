"""Pairs of views whose homography is known: drawn from single photographs, or read from HPatches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from vioframe.bench.detectors.images import find_images, fitting, read_grey, view
from vioframe.errors import DatasetError
from vioframe.types import Float, Image

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


class Pair(Protocol):
    """Two views yet to be loaded."""

    @property
    def name(self) -> str:
        """To be told from the others."""
        ...

    def load(self, resolution: tuple[int, int]) -> Views:
        """At ``resolution`` (width, height); raises :class:`DatasetError` where that fails."""
        ...


@dataclass(frozen=True, slots=True)
class SyntheticPair:
    """A photograph, and the same through a homography drawn by ``seed``."""

    path: Path
    seed: tuple[int, ...]

    @property
    def name(self) -> str:
        return self.path.stem

    def load(self, resolution: tuple[int, int]) -> Views:
        image = read_grey(self.path)
        A = fitting(image.shape, resolution)
        H_21 = random_homography(np.random.default_rng(self.seed), resolution)
        # Both straight from the photograph: the second is no blurrier for having been warped.
        first, second = (view(image, H @ A, resolution, A[0, 0]) for H in (np.eye(3), H_21))
        return Views(first, second, H_21)


@dataclass(frozen=True, slots=True)
class HPatchesPair:
    """Images 1 and k of a sequence of HPatches (Balntas et al., CVPR 2017)."""

    folder: Path
    k: int

    @property
    def name(self) -> str:
        return f"{self.folder.name} 1-{self.k}"

    def load(self, resolution: tuple[int, int]) -> Views:
        images = [read_grey(_ppm(self.folder, k)) for k in (1, self.k)]
        A_1, A_2 = (fitting(image.shape, resolution) for image in images)
        H_21 = A_2 @ _read_homography(self.folder / f"H_1_{self.k}") @ np.linalg.inv(A_1)
        first, second = (view(i, A, resolution, A[0, 0]) for i, A in zip(images, (A_1, A_2), strict=True))
        return Views(first, second, H_21 / H_21[2, 2])


def synthetic_pairs(folder: Path, seed: int) -> list[Pair]:
    """A pair for every image in ``folder``; raises :class:`DatasetError` where there is none."""
    return [SyntheticPair(path, (seed, k)) for k, path in enumerate(find_images(folder))]


def hpatches_pairs(folder: Path) -> list[Pair]:
    """The five pairs of each sequence in ``folder``; raises :class:`DatasetError` where that is not HPatches."""
    sequences = sorted(path for kind in "iv" for path in folder.glob(f"{kind}_*") if path.is_dir())
    if not sequences:
        raise DatasetError(f"{folder} has no folders i_* and v_*; name that of HPatches (hpatches-sequences-release)")
    for sequence in sequences:
        needed = [_ppm(sequence, 1)]
        for k in _HPATCHES_VIEWS:
            needed += [_ppm(sequence, k), sequence / f"H_1_{k}"]
        for path in needed:
            if not path.is_file():
                raise DatasetError(f"{path} is missing; a sequence of HPatches has 1.ppm to 6.ppm and H_1_2 to H_1_6")
    return [HPatchesPair(sequence, k) for sequence in sequences for k in _HPATCHES_VIEWS]


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


def _ppm(folder: Path, k: int) -> Path:
    return folder / f"{k}.ppm"


def _read_homography(path: Path) -> Float:
    try:
        H = np.loadtxt(path)
    except ValueError as error:
        raise DatasetError(f"{path} is no homography: {error}") from error
    if H.shape != (3, 3) or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        raise DatasetError(f"{path} is no homography: it must hold three rows of three numbers, of full rank")
    return H
