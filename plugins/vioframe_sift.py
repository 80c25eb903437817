"""Detector ``sift``: extrema of the difference of Gaussians (Lowe, IJCV 2004)."""

from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from vioframe.hookspecs import hookimpl
from vioframe.interfaces import DetectorFactory
from vioframe.types import Image, Keypoints


class Sift:
    """Sub-pixel blobs of all scales, each place once."""

    def __init__(
        self,
        *,
        contrast_threshold: Annotated[float, "weakest blob kept; lower finds more"] = 0.02,
        edge_threshold: Annotated[float, "largest ratio of the two curvatures; higher admits edges"] = 10.0,
        descriptors: Annotated[bool, "also compute the 128-vectors, which tracking does not use"] = False,
    ) -> None:
        import cv2

        # Without the precise upscale every point is 0.23 px off on both axes.
        self._sift = cv2.SIFT.create(
            contrastThreshold=contrast_threshold, edgeThreshold=edge_threshold, enable_precise_upscale=True
        )
        self._descriptors = descriptors

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` blobs of ``image``, strongest first."""
        import cv2

        ordered = sorted(self._sift.detect(image), key=lambda k: -k.response)
        # A blob with several orientations comes once for each; the strongest stays.
        distinct: dict[tuple[float, float], cv2.KeyPoint] = {}
        for keypoint in ordered:
            distinct.setdefault((keypoint.pt[0], keypoint.pt[1]), keypoint)
        found: Sequence[cv2.KeyPoint] = list(distinct.values())[:max_points]
        descriptors = None
        if self._descriptors:
            found, descriptors = self._sift.compute(image, found)  # drops what it cannot describe
        xy = np.reshape(cv2.KeyPoint.convert(found), (-1, 2)).astype(np.float32)
        return Keypoints(xy, np.array([k.response for k in found], np.float32), descriptors)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"sift": Sift}
