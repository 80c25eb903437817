"""How repeatable the points of a network are on images it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from vioframe.bench.detectors.metrics import lands_inside, repeated
from vioframe.bench.detectors.thinning import distinct
from vioframe.types import Float
from vioframe_keypointnet.network import KeypointNet
from vioframe_keypointnet.peaks import Peaks
from vioframe_keypointnet.selection import Rules
from vioframe_keypointnet.training.homography import HomographyRange, random_homography
from vioframe_keypointnet.training.images import Picture

_SIZE = (320, 240)
_TOP = 300
_MOST = 4 * _TOP  # some of them the other view does not show
_NMS_PX = 4.0


@dataclass(frozen=True, slots=True)
class Validation:
    """Means over the held-out images."""

    repeatability: float
    """Share of the 300 strongest points of one view that have one of the other's within 3 px, either way."""
    localisation_px: float
    """Mean distance of those."""


def validate(network: KeypointNet, pictures: Sequence[Picture], seed: int) -> Validation:
    """Under one synthetic homography an image, at 320 x 240; the network is left in its training mode."""
    import cv2

    was_training = network.training
    network.eval()
    found = []
    for k, picture in enumerate(pictures):
        image = cv2.resize(picture.pixels, _SIZE, interpolation=cv2.INTER_AREA)
        H = random_homography(np.random.default_rng([seed, 2, k]), _SIZE, HomographyRange(rotation_deg=30.0))
        target = cv2.warpPerspective(image, H, _SIZE, flags=cv2.INTER_LINEAR)
        found.append(_repeatability(_strongest(network, image), _strongest(network, target), H))
    network.train(was_training)
    # Where nothing was found again there is no distance.
    shares, distances = (np.array(column, np.float64) for column in zip(*found, strict=True))
    return Validation(float(shares.mean()), float(np.nanmean(distances)))


def _strongest(network: KeypointNet, image: NDArray[np.uint8]) -> Float:
    """(N, 2) px after suppression of near neighbours, strongest first."""
    device = next(network.parameters()).device
    pixels = torch.from_numpy(np.atleast_3d(image)).to(device).permute(2, 0, 1)[None].float() / 255.0
    with torch.no_grad():
        seen = network(pixels)
    if seen.response is not None:
        response = np.ascontiguousarray(seen.response[0].permute(1, 2, 0).cpu().numpy())
        grey = image if image.ndim == 2 else image[..., 1]
        return Peaks(Rules(_NMS_PX, 0))(response, grey, grey.shape, _MOST)[0].astype(np.float64)
    order = seen.score.flatten().argsort(descending=True)
    xy: Float = seen.xy[0].flatten(1).T[order].cpu().double().numpy()
    return xy[distinct(xy, _NMS_PX, _MOST)]


def _repeatability(a: Float, b: Float, H: Float) -> tuple[float, float | None]:
    """Of the strongest points that both views could see: the share found in both, and their mean distance, px."""
    a = a[lands_inside(a, H, _SIZE)][:_TOP]
    b = b[lands_inside(b, np.linalg.inv(H), _SIZE)][:_TOP]
    return repeated(a, b, H)
