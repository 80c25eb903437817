"""The options of the loosely coupled back-end, with the settings that serve EuRoC."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LooseEkfOptions:
    """Of the visual odometry, and of how far the filter trusts its poses."""

    pixel_sigma: float = 1.0
    """Standard deviation of a tracked feature's position, px."""
    bootstrap_parallax_px: float = 20.0
    """Median motion of the tracks, rotation taken out, between the two frames that begin a map."""
    keyframe_parallax_px: float = 15.0
    """Median motion of the tracks since the last keyframe, rotation taken out, that makes a frame a keyframe."""
    keyframes: int = 10
    """Keyframes that the visual odometry remembers."""
    vision_noise_factor: float = 2.0
    """Factor on the standard deviations of the visual odometry's poses, which count its points as exact."""

    def __post_init__(self) -> None:
        if self.keyframes < 3:
            raise ValueError(f"needs keyframes >= 3, got {self.keyframes}")
        for name in ("pixel_sigma", "bootstrap_parallax_px", "keyframe_parallax_px", "vision_noise_factor"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"needs {name} > 0, got {getattr(self, name):g}")
