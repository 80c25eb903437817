"""Detector ``orb``: FAST over a scale pyramid, ranked by Harris' measure (Rublee et al., ICCV 2011)."""

from collections.abc import Mapping
from typing import Annotated

from vioframe.frontend.opencv_keypoints import OpenCvDetector
from vioframe.interfaces import DetectorFactory
from vioframe.parts.hooks import hookimpl
from vioframe.types import Image, Keypoints


class Orb(OpenCvDetector):
    """Corners of all levels at full resolution: whole pixels of their own level."""

    def __init__(
        self,
        *,
        fast_threshold: Annotated[int, "contrast of a corner to the ring around it, grey levels"] = 20,
        levels: Annotated[int, "pyramid levels, each a factor of 1.2 smaller than the one before"] = 8,
        descriptors: Annotated[bool, "also compute the 32-byte descriptors, which tracking does not use"] = False,
    ) -> None:
        import cv2

        self._orb = cv2.ORB.create(nlevels=levels, fastThreshold=fast_threshold)
        super().__init__(self._orb, descriptors)

    def detect(self, image: Image, max_points: int) -> Keypoints:
        """At most ``max_points`` corners of ``image``, strongest first."""
        self._orb.setMaxFeatures(max_points)
        return super().detect(image, max_points)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"orb": Orb}
