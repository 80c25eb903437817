"""Detector ``brisk``: AGAST corners that are maxima over scale (Leutenegger, Chli and Siegwart, ICCV 2011)."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import NonNegativeInt, PositiveInt

from vioframe.frontend.opencv_keypoints import OpenCvDetector
from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl


class Brisk(OpenCvDetector):
    """Sub-pixel corners of several scales.

    OpenCV places those of the coarser scales about 0.2 px too far left; those of ``octaves=0`` are without bias.
    """

    def __init__(
        self,
        *,
        threshold: Annotated[PositiveInt, "contrast of a corner to the ring around it, grey levels"] = 30,
        octaves: Annotated[NonNegativeInt, "how often the resolution is halved; 0 uses the image as it is"] = 3,
        descriptors: Annotated[bool, "also compute the 64-byte descriptors, which tracking does not use"] = False,
    ) -> None:
        import cv2

        super().__init__(cv2.BRISK.create(threshold, octaves), descriptors)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"brisk": Brisk}
