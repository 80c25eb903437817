"""Detector ``akaze``: blobs in a scale space that keeps edges sharp (Alcantarilla, Nuevo and Bartoli, BMVC 2013)."""

from collections.abc import Mapping
from typing import Annotated

from pydantic import NonNegativeFloat

from vioframe.frontend.opencv_keypoints import OpenCvDetector
from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl


class Akaze(OpenCvDetector):
    """Sub-pixel maxima of the determinant of the Hessian over a non-linear scale space."""

    def __init__(
        self,
        *,
        threshold: Annotated[NonNegativeFloat, "weakest determinant kept; lower finds more"] = 0.001,
        descriptors: Annotated[bool, "also compute the 61-byte descriptors, which tracking does not use"] = False,
    ) -> None:
        import cv2

        super().__init__(cv2.AKAZE.create(threshold=threshold), descriptors)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"akaze": Akaze}
