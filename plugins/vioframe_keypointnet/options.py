"""The options of the detector ``keypointnet``; nothing heavy is imported to know them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Runtime = Literal["auto", "openvino", "onnxruntime", "torch"]
Precision = Literal["auto", "float32", "bfloat16", "float16", "int8"]
Device = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True, slots=True, kw_only=True)
class KeypointNetOptions:
    """How KeypointNet is run."""

    weights: str = "compact"
    """Name of weights that ship, or a .safetensors or official .ckpt file."""
    runtime: Runtime = "auto"
    """Library that runs the network; auto takes the fastest that is installed."""
    precision: Precision = "auto"
    """Auto: float16 on CUDA; on a CPU int8 where runtime and weights have it, else float32."""
    device: Device = "auto"
    """Auto takes CUDA where there is any."""
    threads: int = 0
    """Threads on a CPU; 0 leaves the library's choice."""
    nms_px: float = 4.0
    """A keypoint goes where a stronger one is nearer than this."""
    min_contrast: int = 4
    """Grey levels by which the image must vary within 8 px of a keypoint; 0 admits those on blank surfaces."""
    descriptors: bool = False
    """Also compute descriptors, which tracking does not use and which take longer than detection."""

    def __post_init__(self) -> None:
        if self.threads < 0 or self.nms_px < 0.0:
            raise ValueError("threads and nms_px must not be negative")
