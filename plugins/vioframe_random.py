"""Detector ``random``: places that are drawn, which any other detector has to be better than."""

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vioframe.frontend.distinct import distinct
from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl
from vioframe.types import Image, Keypoints

Share = Annotated[float, Field(gt=0.0, le=1.0)]


class Random:
    """Whole pixels drawn at random from the steepest ones, in random order: the floor of a comparison.

    The dice are the last bits of the pixels about a place, so that the same image gives the same places.
    """

    def __init__(
        self,
        *,
        steepest: Annotated[Share, "part of the pixels to draw from, those of the largest gradient"] = 0.2,
        min_distance_px: Annotated[float, "smallest distance between points"] = 10.0,
    ) -> None:
        self._steepest = steepest
        self._min_distance_px = min_distance_px

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` places in ``image``."""
        import cv2

        if min(image.shape) < 3:
            return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32))
        dx, dy = (np.asarray(d, np.float32) for d in cv2.spatialGradient(image))
        gradient = cv2.magnitude(dx, dy).ravel()
        steep = np.flatnonzero((gradient >= np.quantile(gradient, 1.0 - self._steepest)) & (gradient > 0.0))
        rows, columns = np.divmod(steep, image.shape[1])
        drawn = _scrambled(image)[rows, columns]
        order = np.argsort(-drawn, kind="stable")
        xy = np.column_stack([columns, rows]).astype(np.float32)[order]
        taken = distinct(xy, self._min_distance_px, max_points)
        return Keypoints(xy[taken], drawn[order[taken]])


def _scrambled(image: Image) -> NDArray[np.float32]:
    """(H, W) numbers from 0 to 1 in which nothing is left to be seen of the image (multiplicative hashing)."""
    around = np.pad(image, 1, mode="edge").astype(np.uint32)
    bits = around[1:-1, 1:-1] + (around[1:-1, 2:] << 8) + (around[2:, 1:-1] << 16) + (around[:-2, :-2] << 24)
    for factor in (0x9E3779B1, 0x85EBCA6B):
        bits = (bits ^ bits >> 15) * np.uint32(factor)
    numbers: NDArray[np.float32] = ((bits >> 8) / np.float32(1 << 24)).astype(np.float32)
    return numbers


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"random": Random}
