"""The options of the loosely coupled back-end, with the settings that serve EuRoC."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class LooseEkfOptions:
    """Of the visual odometry, then of the filter that fuses its poses with the readings."""

    pixel_sigma: float = 1.0
    """Standard deviation of a tracked feature's position, px."""
    bootstrap_parallax_px: float = 20.0
    """Median motion of the tracks, rotation taken out, between the two frames that begin a map."""
    keyframe_parallax_px: float = 15.0
    """Median motion of the tracks since the last keyframe, rotation taken out, that makes a frame a keyframe."""
    keyframes: int = 10
    """Keyframes that the visual odometry remembers."""
    adjusted_keyframes: int = 5
    """The newest of them, which local bundle adjustment moves; the others, two at least, it leaves where they are."""
    adjustments: int = 4
    """Steps of the local bundle adjustment at a keyframe, at most; 0 leaves the map as it was triangulated."""
    vision_noise_factor: float = 2.0
    """Factor on the standard deviations of the visual odometry's poses, which count its points as exact."""
    drift_scale: float = 0.003
    """Drift of the visual scale from one keyframe to the next, standard deviation, relative."""
    drift_rotation_deg: float = 0.03
    """Drift of the vision frame's orientation from one keyframe to the next, standard deviation."""
    drift_position: float = 0.01
    """Drift of the vision frame's position from one keyframe to the next, part of the distance between them."""
    gate_quantile: float = 0.99
    """Quantile of the chi2 distribution below which a pose of the visual odometry is accepted."""

    def __post_init__(self) -> None:
        if self.keyframes < 3 or self.adjusted_keyframes < 1 or self.adjustments < 0:
            raise ValueError("needs keyframes >= 3, adjusted_keyframes >= 1 and adjustments >= 0")
        for name in (
            "pixel_sigma",
            "bootstrap_parallax_px",
            "keyframe_parallax_px",
            "vision_noise_factor",
        ):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"needs {name} > 0, got {getattr(self, name):g}")
        if not min(self.drift_scale, self.drift_rotation_deg, self.drift_position) >= 0.0:
            raise ValueError("needs drift_scale, drift_rotation_deg and drift_position >= 0")
        if not 0.0 < self.gate_quantile < 1.0:
            raise ValueError(f"needs 0 < gate_quantile < 1, got {self.gate_quantile:g}")
