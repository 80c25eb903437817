"""What is trained on: images of folders and recordings, and pairs of views of one image with their homography.

Each pair is drawn from its own number alone. How far views differ is as published for KP2D (Tang et al., ICLR 2020,
section 4), but for light and blur, which are those of a camera in flight.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import default_collate

from vioframe.bench.detectors.degradations import line_kernel
from vioframe.bench.detectors.images import find_images, frames_of, read_image
from vioframe.errors import ConfigError, DatasetError
from vioframe.io.images import to_gray8
from vioframe.parts import registry
from vioframe.simulation import config as simulation
from vioframe.simulation.seeds import SEEDS, purpose_of
from vioframe.types import Float
from vioframe_keypointnet.options import TrainingOptions
from vioframe_keypointnet.training.losses import corners, lesson

_SMALLEST_PX = 64
_LARGEST_SCALE = 1.2
"""The first view is taken of the image anywhere between shrunk to fit and this much of its own scale."""
_AFFINE_DEG = 15.0
"""Largest turn of the first view."""

_PERSPECTIVE = 0.2
"""Largest shift of its corners as a share of the view, two standard deviations; never beyond the view's edge."""
_ROTATION_DEG = 45.0
_SCALE = (0.9, 1.1)

_EXPOSURE = (0.3, 2.0)
"""Factor, after which the image saturates."""
_GAMMA = (0.5, 2.0)
_CONTRAST = (0.4, 1.4)
_BRIGHTNESS = 0.2
"""Largest shift, of a range of one."""
_BLUR_SIGMA_PX = 1.5
_MOTION_BLUR_PX = 9.0
"""Longest path during the exposure."""
_NOISE_SIGMA = 0.05
"""Largest standard deviation, of a range of one."""

Array = NDArray[np.float32]
View = Array
"""(H, W) in [0, 1]."""

ArrayT = TypeVar("ArrayT", Array, Tensor)


@dataclass(frozen=True, slots=True)
class Picture:
    """One grey image (H, W), as a detector is given them, and the file or recording that it is from."""

    name: str
    pixels: NDArray[np.uint8]


class Pair(NamedTuple, Generic[ArrayT]):
    """Two views of one image; of a batch, tensors with a row a pair."""

    source: ArrayT
    """(1, H, W) in [0, 1]."""
    target: ArrayT
    homography: ArrayT
    """(3, 3) from pixels of the source to those of the target."""
    source_lesson: ArrayT
    """(3, h, w): see :func:`vioframe_keypointnet.training.losses.lesson`."""
    target_lesson: ArrayT


def gather(sources: Sequence[Path], frames_per_recording: int) -> list[Picture]:
    """All images of ``sources`` in a settled order.

    A source is a folder of photographs (searched to its depths) or a recording that a reader opens. Raises
    :class:`ConfigError` for one that is neither, and :class:`DatasetError` for a damaged image.
    """
    pictures: list[Picture] = []
    for source in sources:
        try:
            dataset = registry.load().open_dataset(source)
        except DatasetError as error:
            try:
                files = find_images(source)
            except DatasetError:
                raise ConfigError(f"{source} holds neither photographs nor a recording: {error}") from error
            pictures += (Picture(str(path), to_gray8(read_image(path), 16, str(path))) for path in files)
        else:
            for number, frames in frames_of(dataset, frames_per_recording):
                image = next(image for image in frames.images if image is not None)
                pictures.append(Picture(f"{source}#{number}", to_gray8(image, 16, str(source))))
    return [picture for picture in pictures if min(picture.pixels.shape[:2]) >= _SMALLEST_PX]


def simulated_worlds(sources: Iterable[Path]) -> list[dict[str, Any]]:
    """The simulated worlds that ``sources`` show: ``seed``, ``flight`` and ``world`` of each, for the card.

    A source is a recording, or a folder in one or with some in it. Raises :class:`ConfigError` for a world that is kept
    for tuning or reporting.
    """
    worlds: list[dict[str, Any]] = []
    for source in map(Path.absolute, sources):
        own = simulation.simulation_folder(source) / simulation.MANIFEST
        beside = Path("simulation", simulation.MANIFEST)
        around = [folder / beside for folder in source.parents]
        for manifest in filter(Path.is_file, dict.fromkeys([own, *around, *sorted(source.rglob(str(beside)))])):
            made = simulation.read(manifest)
            if (purpose := purpose_of(made.seed)) in ("tuning", "reporting"):
                training = SEEDS["training"]
                raise ConfigError(
                    f"{source} was simulated with the seed {made.seed}, a world kept for {purpose}; simulate it with a "
                    f"--seed for training, {training[0]} to {training[-1]}"
                )
            along = made.recorded or made.trajectory
            flight = made.flight.name if along is None else along.name
            worlds.append({"seed": made.seed, "flight": flight, "world": made.world.name})
    return worlds


def split(pictures: Iterable[Picture], hold_out: Sequence[str]) -> tuple[list[Picture], list[Picture]]:
    """Those to train on and those held out: the ones whose name matches a pattern such as ``*/V1_*`` or contains it."""
    train: list[Picture] = []
    held: list[Picture] = []
    for picture in pictures:
        out = any(pattern in picture.name or fnmatch(picture.name, pattern) for pattern in hold_out)
        (held if out else train).append(picture)
    if not train:
        raise ConfigError("no image is left to train on; narrow --hold-out or name more --images, of 64 px or larger")
    if hold_out and not held:
        raise ConfigError(f"no image is named like --hold-out {' '.join(hold_out)}; nothing would be held out")
    return train, held


def batch(
    pictures: Sequence[Picture], options: TrainingOptions, step: int, *, corners_taught: bool = True
) -> Pair[Tensor]:
    """The pairs of a step, made of nothing but the arguments, so that a training resumed is one not interrupted.

    Unless ``corners_taught``, none are looked for, and the lessons name none.
    """
    first = step * options.batch
    pairs = [
        pair(pictures[_order(k, len(pictures), options.seed)], options, k, corners_taught=corners_taught)
        for k in range(first, first + options.batch)
    ]
    collated: Pair[Tensor] = default_collate(pairs)
    return collated


def pair(picture: Picture, options: TrainingOptions, number: int, *, corners_taught: bool = True) -> Pair[Array]:
    """The ``number``-th pair, of ``picture``."""
    import cv2

    rng = np.random.default_rng([options.seed, 1, number])
    width, height = options.size
    fit = max(width / picture.pixels.shape[1], height / picture.pixels.shape[0])
    scale = fit * (max(_LARGEST_SCALE, fit) / fit) ** rng.random()
    shrunk = np.asarray(cv2.resize(picture.pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    room = np.maximum(0, [shrunk.shape[1] - width, shrunk.shape[0] - height])
    crop = np.eye(3)
    crop[:2, 2] = -rng.uniform(0.0, 1.0, 2) * room
    first = _random_turn(rng, options.size) @ crop
    second = random_homography(rng, options.size, options.patch_ratio) @ first
    if rng.random() < 0.5:
        first, second = second, first
    between = second @ np.linalg.inv(first)
    points = corners(shrunk) if corners_taught else np.empty((0, 3))
    source, target = (
        disturbed(_view(shrunk, H, options.size), rng, options.photometric_probability) for H in (first, second)
    )
    return Pair(
        source[None],
        target[None],
        (between / between[2, 2]).astype(np.float32),
        lesson(points, first, options.size),
        lesson(points, second, options.size),
    )


def random_homography(rng: np.random.Generator, size: tuple[int, int], patch_ratio: tuple[float, float]) -> Float:
    """(3, 3) from pixels of an image of ``size`` (width, height) to pixels of a view of the same size.

    The view is of a part of the image, whose sides are ``patch_ratio`` of the image's: from the first to the second.
    """
    import cv2

    ratio = rng.uniform(*patch_ratio)
    patch = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * ratio
    # Symmetric along x, free along y: what a camera does that is turned away about its axes.
    most = min(_PERSPECTIVE, 0.5 * (1.0 - ratio))
    lean = np.clip(rng.normal(0.0, most / 2.0, 3), -most, most)
    patch += np.array([[lean[1], lean[0]], [lean[2], -lean[0]], [lean[2], lean[0]], [lean[1], -lean[0]]])
    patch *= rng.uniform(*_SCALE)
    aspect = np.array([size[0] / size[1], 1.0])
    patch = patch * aspect @ _rotation(rng, _ROTATION_DEG).T / aspect
    room = np.maximum(0.0, 0.5 - np.abs(patch).max(axis=0))
    patch += rng.uniform(-room, room)
    scale = np.asarray(size) - 1.0
    view = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * scale
    return np.asarray(cv2.getPerspectiveTransform(((patch + 0.5) * scale).astype(np.float32), view.astype(np.float32)))


def _random_turn(rng: np.random.Generator, size: tuple[int, int]) -> Float:
    """(3, 3) a turn about the middle of an image of ``size`` (width, height) and, every other time, its mirror."""
    A = _rotation(rng, _AFFINE_DEG) @ np.diag([-1.0 if rng.random() < 0.5 else 1.0, 1.0])
    middle = 0.5 * (np.asarray(size) - 1.0)
    out = np.eye(3)
    out[:2, :2], out[:2, 2] = A, middle - A @ middle
    return out


def _rotation(rng: np.random.Generator, most_deg: float) -> Float:
    angle = np.deg2rad(rng.uniform(-most_deg, most_deg))
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def disturbed(view: View, rng: np.random.Generator, probability: float) -> View:
    """A copy of ``view`` in other light: exposure, gamma, contrast, brightness, blur and noise, each at times."""
    import cv2

    def happens() -> bool:
        return bool(rng.random() < probability)

    out = view.astype(np.float32)
    if happens():
        out = np.minimum(out * np.float32(np.exp(rng.uniform(*np.log(_EXPOSURE)))), 1.0)
    if happens():
        out = out ** np.float32(np.exp(rng.uniform(*np.log(_GAMMA))))
    if happens():
        mean = out.mean()
        out = (out - mean) * np.float32(rng.uniform(*_CONTRAST)) + mean
    if happens():
        out = out + np.float32(rng.uniform(-_BRIGHTNESS, _BRIGHTNESS))
    if happens():
        out = np.asarray(cv2.GaussianBlur(out, (0, 0), rng.uniform(0.1, _BLUR_SIGMA_PX)), np.float32)
    if happens():
        blur = line_kernel(rng.uniform(1.0, _MOTION_BLUR_PX), rng.uniform(0.0, np.pi))
        out = np.asarray(cv2.filter2D(out, -1, blur), np.float32)
    if happens():
        out = out + rng.normal(0.0, rng.uniform(0.0, _NOISE_SIGMA), out.shape).astype(np.float32)
    clipped: View = np.clip(out, 0.0, 1.0, dtype=np.float32)
    return clipped


def _view(pixels: NDArray[np.uint8], H: Float, size: tuple[int, int]) -> View:
    import cv2

    # Reflected beyond its edges, the image is the same plane in every view.
    seen = cv2.warpPerspective(pixels, H, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
    return np.multiply(seen, 1.0 / 255.0, dtype=np.float32)


def _order(k: int, count: int, seed: int) -> int:
    """Which image comes ``k``-th: every epoch all of them, each time in another order."""
    epoch, place = divmod(k, count)
    return int(np.random.default_rng([seed, 0, epoch]).permutation(count)[place])
