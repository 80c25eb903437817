"""The options of the detector ``keypointnet``; nothing heavy is imported to know them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import NonNegativeFloat, NonNegativeInt

Runtime = Literal["auto", "cuda", "openvino", "torch"]
Precision = Literal["auto", "float32", "float16", "int8"]


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointNetOptions:
    """How KeypointNet is run."""

    weights: str = "compact"
    """Name of weights that ship, or a .safetensors or official .ckpt file."""
    runtime: Runtime = "auto"
    """OpenVINO or torch on a CPU, or torch by CUDA; auto takes the fastest there is."""
    precision: Precision = "auto"
    """Auto: float16 by CUDA; by OpenVINO int8 where the weights know their ranges; else float32."""
    threads: NonNegativeInt = 0
    """Threads on a CPU; 0 leaves the library's choice."""
    nms_px: NonNegativeFloat = 4.0
    """A keypoint goes where a stronger one is nearer than this."""
    min_contrast: NonNegativeInt = 4
    """Grey levels by which the image must vary within 8 px of a keypoint; 0 admits those on blank surfaces."""
    descriptors: bool = False
    """Also compute descriptors, which tracking does not use and which take longer than detection."""
