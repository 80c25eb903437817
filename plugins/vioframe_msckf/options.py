"""The options of the MSCKF back-end, with the settings that serve EuRoC."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class MsckfOptions:
    """Defaults follow the published settings of OpenVINS for EuRoC where they name one."""

    max_clones: int = 11
    """Past poses kept in the state."""
    max_features: int = 40
    """Features used at most in one update; the longest tracks go first."""
    min_track_length: int = 4
    """Observations that a finished track must have to be used."""
    max_slam_features: int = 50
    """Long-lived landmarks kept in the state; 0 makes this a pure MSCKF."""
    pixel_sigma: float = 1.0
    """Standard deviation of a tracked feature's position, px."""
    gate_quantile: float = 0.95
    """Quantile of the chi2 distribution below which a feature's residual is accepted."""
    first_estimate_jacobians: bool = True
    """Evaluate Jacobians at first estimates, so that yaw and position stay unobservable."""
    calibrate_extrinsics: bool = True
    """Estimate the camera's pose on the body."""
    calibrate_time_offset: bool = True
    """Estimate what is left of the time offset between camera and IMU."""
    calibrate_intrinsics: bool = True
    """Estimate focal lengths, principal point and distortion."""

    def __post_init__(self) -> None:
        if self.max_clones < 3 or self.max_features < 1 or self.min_track_length < 2 or self.max_slam_features < 0:
            raise ValueError("needs max_clones >= 3, max_features >= 1, min_track_length >= 2, max_slam_features >= 0")
        if not (self.pixel_sigma > 0.0 and 0.0 < self.gate_quantile < 1.0):
            raise ValueError("needs pixel_sigma > 0 and 0 < gate_quantile < 1")
