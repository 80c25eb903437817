"""The options of the detector and of the trainer ``keypointnet``; nothing heavy is imported to know them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from vioframe.errors import ConfigError
from vioframe_keypointnet.architecture import ARCHITECTURES, Architecture

Runtime = Literal["auto", "cuda", "openvino", "torch"]
Precision = Literal["auto", "float32", "float16", "int8"]
TrainingPrecision = Literal["float32", "bfloat16"]
_Share = Annotated[float, Field(gt=0.0, le=1.0)]
Target = Literal["repeatability", "life", "drift", "faithful", "information", "clean"]
"""Of a training; what each but the first says of a point is in :mod:`vioframe_keypointnet.training.followed`."""


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
    """Threads on a CPU; 0 leaves the library's choice, but for small networks by OpenVINO, which take one."""
    compiled: bool = False
    """By CUDA: have torch.compile fuse what lies between the convolutions; it needs a C compiler, and some seconds for
    the first image."""
    halvings: NonNegativeInt | None = None
    """How often the image is halved before the network sees it; null: a small network trained for repeatability sees
    none that is twice as large as the views in training: compact sees images of 480 rows or more at half their
    size, of 960 or more at a quarter."""
    nms_px: NonNegativeFloat = 4.0
    """A keypoint goes where a stronger one is nearer than this, in pixels of what the network sees."""
    min_contrast: NonNegativeInt = 4
    """Grey levels by which the image must vary within 8 px of a keypoint; 0 admits those on blank surfaces."""
    descriptors: bool = False
    """Also compute descriptors, which tracking does not use and which take longer than detection."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingOptions:
    """How KeypointNet is trained, by default on the published schedule (Tang et al., ICLR 2020).

    Raises :class:`ConfigError` where they do not fit together.
    """

    network: Literal["full", "compact", "far"] = "compact"
    """full (as published), compact, or far, which sees farther about a pixel."""
    width: PositiveFloat = 1.0
    """Factor on the channels of every layer."""
    target: Target = "repeatability"
    """repeatability (as published: points are found again in another view), or what becomes of a point that is followed
    in simulated flights, which --images then name: the share of 60 images in which it is followed (life), how near it
    stays to its landmark (drift), the share before it strays by more than 1 px (faithful), both as information
    (information), whether it never strays (clean); networks of peaks only."""
    dropout: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.2
    """Of whole channels, as published; the weights that ship were trained with 0: small networks have none to spare."""
    seed: NonNegativeInt = 0
    """Of the initial weights, the views and their order."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the views, px, multiples of 8."""
    batch: PositiveInt = 8
    """Pairs of views a step."""
    epochs: PositiveInt = 50
    """Epochs to train."""
    lesson_epochs: NonNegativeInt = 0
    """First epochs in which corners are taught instead; what makes hours of training out of days."""
    only: Literal["detector", "descriptors"] | None = None
    """detector: a third of the time, and descriptors come afterwards; descriptors: the detector stays as it is, with
    --finetune; null: both."""
    halve_at: tuple[int, ...] = (40,)
    """Epochs after which the learning rate is halved."""
    epoch_samples: int | None = None
    """Pairs an epoch; null: each image once."""
    learning_rate: PositiveFloat = 1e-3
    """Of Adam; 1e-4 is usual for fine-tuning."""
    patch_ratio: tuple[_Share, _Share] = (0.7, 0.7)
    """Side of the part of the first view that fills the second, of the view's: least and largest, as published. Where
    views may also be as large as the image, points are found again more often, and a little less exactly."""
    photometric_probability: Annotated[float, Field(ge=0.0, le=1.0)] = 0.5
    """Of each effect of light, lens and sensor on a view; the weights that ship were trained with 0.25."""
    frames_per_recording: PositiveInt = 200
    """Images taken, evenly, from each recording."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes CUDA where there is any."""
    precision: TrainingPrecision = "float32"
    """Of the convolutions; bfloat16 is faster where the processor has it."""
    threads: NonNegativeInt = 0
    """Threads on a CPU; 0 leaves torch's choice."""
    workers: NonNegativeInt = 0
    """Processes that make the next views meanwhile, as a GPU needs them; 0 makes them in between. The same views."""

    def __post_init__(self) -> None:
        if any(n < 32 or n % 8 for n in self.size):
            raise ConfigError(f"size must be two multiples of 8, each at least 32, not {self.size}")
        if self.target != "repeatability":
            if not self.architecture.peaks:
                raise ConfigError(
                    f"the network {self.network} says nothing of a pixel; target={self.target} needs compact or far"
                )
            if self.lesson_epochs or self.only == "descriptors":
                raise ConfigError(
                    "lessons and descriptors are of target=repeatability; train them apart, with --finetune"
                )
        if self.patch_ratio[0] > self.patch_ratio[1]:
            raise ConfigError(f"patch_ratio must be the least and the largest, not {self.patch_ratio}")
        if self.epoch_samples is not None and self.epoch_samples < self.batch:
            raise ConfigError(f"epoch_samples must be at least the batch, {self.batch}, not {self.epoch_samples}")

    @property
    def architecture(self) -> Architecture:
        base = ARCHITECTURES[self.network]
        return base if self.width == 1.0 else base.widened(self.width)
