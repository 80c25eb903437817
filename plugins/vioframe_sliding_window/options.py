"""The options of the sliding-window back-end, with the settings that serve EuRoC."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True, kw_only=True)
class SlidingWindowOptions:
    """Defaults follow VINS-Mono's published settings for EuRoC where they serve."""

    window_size: int = 10
    """Keyframes in the window beside the newest frame."""
    max_rate_hz: float = 10.0
    """Frames that are optimised a second, at most; those between are predicted from the readings."""
    keyframe_parallax_px: float = 20.0
    """Mean motion of the tracks since the last keyframe, rotation taken out, that makes a frame a keyframe ..."""
    keyframe_min_tracks: int = 20
    """... as do fewer tracks than this in common with it ..."""
    keyframe_interval_s: float = 1.0
    """... and this much time."""
    min_observations: int = 3
    """Frames that must have seen a landmark before it is used."""
    residual: Literal["plane", "sphere"] = "plane"
    """Where reprojection errors are measured: on the normalised image plane, or on the unit sphere."""
    pixel_sigma: float = 1.0
    """Standard deviation of a tracked feature's position, px."""
    cauchy_sigmas: float = 3.0
    """Where Cauchy's robust loss begins to discount an observation, standard deviations."""
    outlier_px: float = 3.0
    """Tracks that are off by more than this on average are dropped."""
    max_iterations: int = 8
    """Steps of the solver a frame, at most."""
    max_solve_ms: float = 0.0
    """Time after which the solver takes no further step, ms; 0 sets no bound, and makes runs repeatable."""
    first_estimate_jacobians: bool = True
    """Keep the linearisation point of states in the prior, so that yaw and position stay unobservable."""
    calibrate_extrinsics: bool = True
    """Estimate the camera's pose on the body."""
    calibrate_time_offset: bool = True
    """Estimate what is left of the time offset between camera and IMU."""
    max_jump_m: float = 1.0
    """Most that images may move the newest position from where the readings put it."""

    def __post_init__(self) -> None:
        if self.window_size < 3 or self.min_observations < 2 or self.max_iterations < 1:
            raise ValueError("needs window_size >= 3, min_observations >= 2 and max_iterations >= 1")
        positive = {
            "max_rate_hz": self.max_rate_hz,
            "keyframe_interval_s": self.keyframe_interval_s,
            "pixel_sigma": self.pixel_sigma,
            "cauchy_sigmas": self.cauchy_sigmas,
            "outlier_px": self.outlier_px,
            "max_jump_m": self.max_jump_m,
        }
        for name, value in positive.items():
            if not value > 0.0:
                raise ValueError(f"needs {name} > 0, got {value:g}")
        if self.residual not in ("plane", "sphere"):
            raise ValueError(f"needs residual plane or sphere, got {self.residual}")
        if not (self.keyframe_parallax_px >= 0.0 and self.max_solve_ms >= 0.0):
            raise ValueError("needs keyframe_parallax_px >= 0 and max_solve_ms >= 0")
