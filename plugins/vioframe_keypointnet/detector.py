"""The detector ``keypointnet``: an image of any size in, the network's strongest keypoints out."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np

from vioframe.errors import ConfigError
from vioframe.types import Image, Keypoints
from vioframe_keypointnet import runtimes
from vioframe_keypointnet.architecture import Architecture
from vioframe_keypointnet.options import KeypointNetOptions
from vioframe_keypointnet.selection import Array, Rules, describe, padded_to_cells, peaks, select
from vioframe_keypointnet.weights import load

Choose = Callable[[Array, Image, tuple[int, int], int], tuple[Array, Array]]
"""From what the network found to the places and scores of keypoints; the arguments of :func:`select` but its rules."""

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class KeypointNet:
    """The strongest keypoints of grey images, by a network that any runtime runs."""

    run: runtimes.Run
    choose: Choose
    runtime: str
    precision: str

    @property
    def device(self) -> str:
        return "cuda" if self.runtime == "cuda" else "cpu"

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` keypoints of ``image`` (H, W), at sub-pixel places."""
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ConfigError(f"KeypointNet wants images (H, W) of uint8, not {image.shape} of {image.dtype}")
        padded = padded_to_cells(image)
        found, *described = self.run(padded)
        xy, score = self.choose(found, padded, cast(tuple[int, int], image.shape), max_points)
        return Keypoints(xy, score, describe(described[0], xy) if described else None)


def keypointnet(options: KeypointNetOptions) -> KeypointNet:
    """What ``options`` describe; raises :class:`ConfigError` where weights or libraries are missing."""
    weights = load(options.weights)
    architecture = weights.architecture
    runtime, precision = runtimes.choose(options.runtime, options.precision, weights.activation_ranges is not None)
    _LOG.info("KeypointNet %s runs by %s in %s", architecture.name, runtime, precision)
    run = runtimes.start(runtime, precision, weights, descriptors=options.descriptors, threads=options.threads)
    return KeypointNet(run, chooser(architecture, Rules(options.nms_px, options.min_contrast)), runtime, precision)


def chooser(architecture: Architecture, rules: Rules) -> Choose:
    """How keypoints are chosen among what a network of ``architecture`` finds."""
    return partial(peaks if architecture.peaks else select, rules=rules)
