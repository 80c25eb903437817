"""Detector ``sift``: extrema of the difference of Gaussians (Lowe, IJCV 2004)."""

from collections.abc import Mapping
from typing import Annotated

from vioframe.frontend.opencv_keypoints import OpenCvDetector
from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl


class Sift(OpenCvDetector):
    """Sub-pixel blobs of all scales, each place once."""

    def __init__(
        self,
        *,
        contrast_threshold: Annotated[float, "weakest blob kept; lower finds more"] = 0.02,
        descriptors: Annotated[bool, "also compute the 128-vectors, which tracking does not use"] = False,
    ) -> None:
        import cv2

        # Without the precise upscale every point is 0.23 px off on both axes.
        super().__init__(
            cv2.SIFT.create(contrastThreshold=contrast_threshold, enable_precise_upscale=True), descriptors
        )


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"sift": Sift}
