"""Detector ``fast``: FAST corners (Rosten and Drummond, ECCV 2006), the strongest of each small cell."""

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl
from vioframe.types import Image, Keypoints


class Fast:
    """Whole-pixel corners, at most one in each cell of a grid."""

    def __init__(
        self,
        *,
        threshold: Annotated[int, "contrast of a corner to the ring around it, grey levels"] = 15,
        cell_px: Annotated[int, "side of the cells, of which each keeps its strongest corner"] = 12,
    ) -> None:
        import cv2

        self._fast = cv2.FastFeatureDetector.create(threshold)
        self._cell_px = cell_px

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` corners of ``image``, strongest first."""
        import cv2

        found = self._fast.detect(image)
        xy = np.reshape(cv2.KeyPoint.convert(found), (-1, 2)).astype(np.float32)
        score = np.array([k.response for k in found], np.float32)
        order = np.argsort(-score, kind="stable")
        column, row = (xy[order] // self._cell_px).astype(np.int64).T
        # unique() returns the first of each cell, which is its strongest.
        _, first = np.unique(row * image.shape[1] + column, return_index=True)
        best = order[np.sort(first)][:max_points]
        return Keypoints(xy[best], score[best])


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"fast": Fast}
