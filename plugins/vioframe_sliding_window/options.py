"""The options of the sliding-window back-end, with the settings that serve EuRoC."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt


@dataclass(frozen=True, slots=True, kw_only=True)
class SlidingWindowOptions:
    """Defaults follow VINS-Mono's published settings for EuRoC where they serve."""

    window_size: Annotated[int, Field(ge=3)] = 10
    """Keyframes in the window beside the newest frame, of each camera where they take turns."""
    max_rate_hz: PositiveFloat = 10.0
    """Frames that are optimised a second, at most; those between are predicted from the readings."""
    keyframe_parallax_px: NonNegativeFloat = 20.0
    """Mean motion of the tracks since the last keyframe, rotation taken out, that makes a frame a keyframe ..."""
    keyframe_min_tracks: int = 20
    """... as do fewer tracks than this in common with it ..."""
    keyframe_interval_s: PositiveFloat = 0.5
    """... and this much time. Farther apart, they tell less of how slow motion speeds up, and so of its scale."""
    min_observations: Annotated[int, Field(ge=2)] = 3
    """Frames that must have seen a landmark before it is used."""
    residual: Literal["plane", "sphere"] = "plane"
    """Where reprojection errors are measured: on the normalised image plane, or on the unit sphere."""
    shared_every_s: NonNegativeFloat = 0.5
    """Of what a camera ahead of it in the rig sees, too, a camera counts once in so many seconds; 0: always."""
    pixel_sigma: PositiveFloat = 0.08
    """Standard deviation of a tracked feature's position, px, at least; more is found where tracks fit worse."""
    cauchy_sigmas: PositiveFloat = 1.0
    """Where Cauchy's robust loss begins to discount an observation, standard deviations."""
    outlier_px: PositiveFloat = 3.0
    """Tracks that are off by more than this on average are dropped."""
    max_iterations: PositiveInt = 8
    """Steps of the solver a frame, at most."""
    max_solve_ms: NonNegativeFloat = 0.0
    """Time after which the solver takes no further step, ms; 0 sets no bound, and makes runs repeatable."""
    first_estimate_jacobians: bool = True
    """Keep the linearisation point of states in the prior, so that yaw and position stay unobservable."""
    calibrate_extrinsics: bool = True
    """Estimate the camera's pose on the body."""
    calibrate_time_offset: bool = True
    """Estimate what is left of the time offset between camera and IMU."""
    calibrate_readout: bool = False
    """Estimate the readout time of a rolling shutter, as is done anyway where another than given was found."""
    calibrate_intrinsics: bool = True
    """Estimate focal lengths, principal point and distortion."""
    max_jump_m: PositiveFloat = 1.0
    """Most that images may move the newest position from where the readings put it."""
