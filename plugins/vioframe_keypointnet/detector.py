"""The detector ``keypointnet``: an image of any size in, the network's strongest keypoints out."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol, cast

import numpy as np

from vioframe.errors import ConfigError
from vioframe.interfaces import Detector
from vioframe.types import Image, Keypoints
from vioframe_keypointnet import runtimes
from vioframe_keypointnet.description import describe
from vioframe_keypointnet.folding import fold
from vioframe_keypointnet.options import KeypointNetOptions
from vioframe_keypointnet.peaks import Peaks
from vioframe_keypointnet.selection import Array, Rules, padded_to_cells, select
from vioframe_keypointnet.weights import load

Choose = Callable[[Array, Image, tuple[int, int], int], tuple[Array, Array]]
"""From what the network found to the places and scores of keypoints; the arguments of :func:`select` but its rules."""

_LOG = logging.getLogger(__name__)


class Engine(Protocol):
    """Keypoints of an image whose sides are multiples of 8 but of which only ``shape`` (H, W) is no padding."""

    def __call__(self, padded: Image, shape: tuple[int, int], max_points: int) -> Keypoints: ...


@dataclass(frozen=True, slots=True)
class OnCpu:
    """A network run by any library, its keypoints selected here."""

    run: runtimes.Run
    choose: Choose

    def __call__(self, padded: Image, shape: tuple[int, int], max_points: int) -> Keypoints:
        found, *described = self.run(padded)
        xy, score = self.choose(found, padded, shape, max_points)
        return Keypoints(xy, score, describe(described[0], xy) if described else None)


@dataclass(frozen=True, slots=True)
class KeypointNet:
    """The strongest keypoints of grey images, by an engine that was made for the network."""

    engine: Engine
    runtime: str
    precision: str
    device: str

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` keypoints of ``image`` (H, W), at sub-pixel places."""
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ConfigError(f"KeypointNet wants images (H, W) of uint8, not {image.shape} of {image.dtype}")
        return self.engine(padded_to_cells(image), cast(tuple[int, int], image.shape), max_points)


def keypointnet(options: KeypointNetOptions) -> Detector:
    """What ``options`` describe; raises :class:`ConfigError` where weights or libraries are missing."""
    weights = load(options.weights)
    calibrated = weights.activation_ranges is not None
    runtime, precision, device = runtimes.choose(options.runtime, options.precision, options.device, calibrated)
    _LOG.info("KeypointNet %s runs with %s in %s on %s", weights.architecture.name, runtime, precision, device)
    network, rules = fold(weights, options.descriptors), Rules(options.nms_px, options.min_contrast)
    engine: Engine
    if device == "cuda":
        from vioframe_keypointnet.runtimes.cuda import OnCuda

        engine = OnCuda(network, rules, precision)
    else:
        run = runtimes.on_cpu(runtime, precision, network, weights.activation_ranges, options.threads)
        engine = OnCpu(run, Peaks(rules) if network.architecture.peaks else partial(select, rules=rules))
    return KeypointNet(engine, runtime, precision, device)
