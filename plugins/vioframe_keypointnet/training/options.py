"""What can be chosen about a training; the defaults are the published schedule."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from vioframe.errors import ConfigError
from vioframe_keypointnet.architecture import ARCHITECTURES, Architecture
from vioframe_keypointnet.training.homography import HomographyRange
from vioframe_keypointnet.training.photometric import PhotometricRange


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingOptions:
    """Options of the trainer ``keypointnet``; raises :class:`ConfigError` on a value out of range."""

    network: str = "compact"
    """full (as published), compact or quick."""
    width: float = 1.0
    """Factor on the channels of every layer."""
    dropout: float = 0.2
    """Of whole channels; small networks, which have none to spare, do better with 0."""
    seed: int = 0
    """Of the initial weights, the views and their order."""
    size: tuple[int, int] = (320, 240)
    """Width and height of the views, px, multiples of 8."""
    batch: int = 8
    """Pairs of views a step."""
    epochs: int = 50
    """Epochs to train."""
    lesson_epochs: int = 0
    """First epochs in which corners are taught instead; what makes hours of training out of days."""
    descriptors_only: bool = False
    """Leave the detector as it is and train what only descriptors need; with --finetune."""
    halve_at: tuple[int, ...] = (40,)
    """Epochs after which the learning rate is halved."""
    epoch_samples: int | None = None
    """Pairs an epoch; null: each image once."""
    learning_rate: float = 1e-3
    """Of Adam; 1e-4 is usual for fine-tuning."""
    location_weight: float = 1.0
    """Of the location loss."""
    descriptor_weight: float = 2.0
    """Of the descriptor loss."""
    score_weight: float = 1.0
    """Of the score loss; that of the inlier-outlier network has weight one."""
    top: int = 300
    """Strongest points of each image that the inlier-outlier network judges."""
    affine_deg: float = 15.0
    """Largest turn of the first view."""
    patch_ratio: float = 0.7
    """Side of the part of the first view that fills the second."""
    perspective: float = 0.2
    """Largest shift of its corners as a share of the view."""
    rotation_deg: float = 45.0
    """Largest turn between the views."""
    scale: tuple[float, float] = (0.9, 1.1)
    """Range of the factor on the patch."""
    photometric_probability: float = 0.5
    """Of each of the effects that follow."""
    brightness: float = 0.2
    """Largest shift, of a range of one."""
    contrast: tuple[float, float] = (0.4, 1.4)
    """Range of the factor about the mean."""
    gamma: tuple[float, float] = (0.5, 2.0)
    """Range of the exponent."""
    exposure: tuple[float, float] = (0.3, 2.0)
    """Range of the factor, after which the image saturates."""
    blur_sigma_px: float = 1.5
    """Largest Gaussian blur."""
    motion_blur_px: float = 9.0
    """Longest path during the exposure."""
    noise_sigma: float = 0.05
    """Largest standard deviation of noise, of a range of one."""
    frames_per_recording: int = 200
    """Images taken, evenly, from each recording."""
    validation_images: int = 50
    """At most so many of the images held out are looked at after each epoch."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to train; auto takes CUDA where there is any."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions; bfloat16 is faster where the processor has it."""
    threads: int = 0
    """Threads on a CPU; 0 leaves torch's choice."""

    def __post_init__(self) -> None:
        for name, valid, remedy in (
            ("network", self.network in ARCHITECTURES, " or ".join(ARCHITECTURES)),
            ("width", self.width > 0.0, "more than zero"),
            ("dropout", 0.0 <= self.dropout < 1.0, "in [0, 1)"),
            ("seed", self.seed >= 0, "zero or more"),
            ("size", all(n >= 32 and n % 8 == 0 for n in self.size), "two multiples of 8, each at least 32"),
            ("batch", self.batch >= 1, "at least 1"),
            ("epochs", self.epochs >= 1, "at least 1"),
            ("epoch_samples", self.epoch_samples is None or self.epoch_samples >= self.batch, "at least the batch"),
            ("learning_rate", self.learning_rate > 0.0, "more than zero"),
            ("top", self.top >= 2, "at least 2"),
            ("patch_ratio", 0.1 <= self.patch_ratio <= 1.0, "in [0.1, 1]"),
            ("perspective", self.perspective >= 0.0, "zero or more"),
            ("photometric_probability", 0.0 <= self.photometric_probability <= 1.0, "in [0, 1]"),
            *((name, _is_range(getattr(self, name)), "[low, high], 0 < low <= high") for name in _RANGES),
            *((name, getattr(self, name) >= 0.0, "zero or more") for name in _AMOUNTS),
            ("frames_per_recording", self.frames_per_recording >= 1, "at least 1"),
        ):
            if not valid:
                raise ConfigError(f"training option {name} must be {remedy}, got {getattr(self, name)!r}")

    @property
    def architecture(self) -> Architecture:
        base = ARCHITECTURES[self.network]
        return base if self.width == 1.0 else base.widened(self.width)

    @property
    def homography(self) -> HomographyRange:
        return HomographyRange(self.patch_ratio, self.perspective, self.rotation_deg, self.scale)

    @property
    def photometric(self) -> PhotometricRange:
        return PhotometricRange(
            self.photometric_probability,
            self.brightness,
            self.contrast,
            self.gamma,
            self.exposure,
            self.blur_sigma_px,
            self.motion_blur_px,
            self.noise_sigma,
        )


_RANGES = ("scale", "contrast", "gamma", "exposure")
_AMOUNTS = (
    *("location_weight", "descriptor_weight", "score_weight", "affine_deg", "rotation_deg", "lesson_epochs"),
    *("brightness", "blur_sigma_px", "motion_blur_px", "noise_sigma", "validation_images", "threads"),
)


def _is_range(pair: tuple[float, float]) -> bool:
    return 0.0 < pair[0] <= pair[1]
