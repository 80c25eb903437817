"""The detector ``keypointnet``: an image of any size in, the network's strongest keypoints out."""

from __future__ import annotations

import logging
from typing import cast

import cv2
import numpy as np

from vioframe.errors import ConfigError
from vioframe.types import Image, Keypoints
from vioframe_keypointnet import runtimes
from vioframe_keypointnet.options import KeypointNetOptions
from vioframe_keypointnet.selection import (
    CONTRAST_REACH_PX,
    Rules,
    describe,
    first_varied,
    padded_to_cells,
    peaks,
    select,
)
from vioframe_keypointnet.weights import Weights

_HALF = np.float32(0.5)
_LOG = logging.getLogger(__name__)


class KeypointNet:
    """The strongest keypoints of grey images, by the network of ``weights`` as ``options`` say.

    Raises :class:`ConfigError` where they ask for what does not go together, and :class:`PluginError` where a library
    is missing.
    """

    def __init__(self, weights: Weights, options: KeypointNetOptions) -> None:
        if options.descriptors and not weights.has_descriptors:
            raise ConfigError(
                f"the descriptors of weights={options.weights} are older than their detector; train them with "
                "`vioframe train keypointnet --finetune WEIGHTS -o only=descriptors`, or use weights=compact"
            )
        calibrated = weights.activation_ranges is not None
        self._runtime, self.precision = runtimes.choose(options.runtime, options.precision, calibrated)
        _LOG.info("KeypointNet %s runs by %s in %s", weights.architecture.name, self._runtime, self.precision)
        self._run = runtimes.start(self._runtime, self.precision, weights, options)
        of_cells = first_varied if self._runtime == "cuda" else select
        self._choose = peaks if weights.architecture.peaks else of_cells
        self._options = options
        self.best_first = weights.target != "repeatability"
        # The shorter side to which images are halved where nothing is said, if they are.
        self._least_side_px = weights.view_side_px if weights.architecture.peaks and not self.best_first else None

    @property
    def device(self) -> str:
        return "cuda" if self._runtime == "cuda" else "cpu"

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` keypoints of ``image`` (H, W), at sub-pixel places."""
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ConfigError(f"KeypointNet wants images (H, W) of uint8, not {image.shape} of {image.dtype}")
        side_px = 2 ** self._halvings(min(image.shape))
        image = _shrunk(image, side_px)
        padded = padded_to_cells(image)
        found, *described = self._run(padded)
        rules = Rules(self._options.nms_px, self._options.min_contrast, max(CONTRAST_REACH_PX // side_px, 1))
        xy, score = self._choose(found, padded, cast(tuple[int, int], image.shape), max_points, rules)
        places = (xy + _HALF) * np.float32(side_px) - _HALF
        return Keypoints(places, score, describe(described[0], xy) if described else None)

    def _halvings(self, side_px: int) -> int:
        """How often an image is halved whose shorter side has ``side_px``."""
        if self._options.halvings is not None:
            return self._options.halvings
        return max((side_px // self._least_side_px).bit_length() - 1, 0) if self._least_side_px else 0


def _shrunk(image: Image, side_px: int) -> Image:
    """The means of its squares of ``side_px``, as photographs are shrunk for training; what is left at the end of rows
    and columns goes, as there are no keypoints anyway."""
    if side_px == 1:
        return image
    rows, columns = (max(length // side_px, 1) for length in image.shape)
    whole = image[: rows * side_px, : columns * side_px]
    return np.asarray(cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
