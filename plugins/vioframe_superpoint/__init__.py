"""Detector ``superpoint``: a network trained on its own detections (DeTone, Malisiewicz and Rabinovich, CVPRW 2018)."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import NonNegativeInt

from vioframe.errors import needs
from vioframe.interfaces import Detector, DetectorFactory
from vioframe.parts.hooks import hookimpl


def superpoint(
    *,
    weights: Annotated[
        Path, "superpoint_v1.pth; github.com/magicleap/SuperPointPretrainedNetwork has it, under its own licence"
    ],
    threshold: Annotated[float, "smallest probability of a keypoint kept; lower finds more"] = 0.015,
    border_px: Annotated[NonNegativeInt, "width of the border without keypoints"] = 4,
    device: Annotated[Literal["auto", "cpu", "cuda"], "auto: a GPU where there is one"] = "auto",
    descriptors: Annotated[bool, "also compute the 256-vectors, which tracking does not use"] = False,
) -> Detector:
    """Whole-pixel keypoints by the SuperPoint network, whose weights its authors' licence forbids to pass on."""
    with needs("PyTorch", "superpoint", user="detector 'superpoint'"):
        from vioframe_superpoint.detector import SuperPoint
    return SuperPoint(weights, threshold=threshold, border_px=border_px, device=device, descriptors=descriptors)


@hookimpl
def vioframe_detectors() -> Mapping[str, DetectorFactory]:
    return {"superpoint": superpoint}
