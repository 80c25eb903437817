"""The options of the MSCKF back-end, with the settings that serve EuRoC."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt


@dataclass(frozen=True, slots=True, kw_only=True)
class MsckfOptions:
    """Defaults follow the published settings of OpenVINS for EuRoC where they name one."""

    max_clones: Annotated[int, Field(ge=3)] = 11
    """Past poses kept in the state, of each camera where they take turns."""
    max_features: PositiveInt = 40
    """Features used at most in one update; the longest tracks go first."""
    min_track_length: Annotated[int, Field(ge=2)] = 4
    """Observations that a finished track must have to be used."""
    max_slam_features: NonNegativeInt = 50
    """Long-lived landmarks kept in the state; 0 makes this a pure MSCKF."""
    shared_every_s: NonNegativeFloat = 0.5
    """Of what a camera ahead of it in the rig sees, too, a camera counts once in so many seconds; 0: always."""
    landmark_drift: NonNegativeFloat = 0.1
    """How far a followed point slides off its landmark from one frame to the next, as a share of its noise that lasts;
    where noise is white none does."""
    pixel_sigma: PositiveFloat = 0.2
    """Standard deviation of a tracked feature's position, px, at least; more where tracks fit worse or errors last."""
    cauchy_sigmas: PositiveFloat = 1.0
    """Where Cauchy's robust loss begins to discount an observation, standard deviations."""
    gate_quantile: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.95
    """Quantile of the chi2 distribution below which a feature's residual is accepted."""
    first_estimate_jacobians: bool = True
    """Evaluate Jacobians at first estimates, so that yaw and position stay unobservable."""
    calibrate_extrinsics: bool = True
    """Estimate the camera's pose on the body."""
    calibrate_time_offset: bool = True
    """Estimate what is left of the time offset between camera and IMU."""
    calibrate_readout: bool = False
    """Estimate the readout time of a rolling shutter, as is done anyway where another than given was found."""
    calibrate_intrinsics: bool = True
    """Estimate focal lengths, principal point and distortion."""
