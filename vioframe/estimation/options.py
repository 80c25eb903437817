"""What can be chosen about the estimation, whatever the back-end."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.errors import ConfigError
from vioframe.types import CameraSigma, ImuNoise

# How well a camera's calibration is known but for its pose: s, px and distortion, as published for OpenVINS on EuRoC.
_TIME_OFFSET_SIGMA_S, _INTRINSICS_SIGMA = 0.01, np.repeat([1.0, 0.005], 4)


@dataclass(frozen=True, slots=True, kw_only=True)
class EstimationOptions:
    """What every back-end's estimate has in common; raises :class:`ConfigError` on a value out of range."""

    gyro_noise_factor: float = 3.0
    """How many times the calibration's white noise of the gyroscope is assumed at most, where vibration adds to the
    sensor's own; how much it adds is told from the readings."""
    accel_noise_factor: float = 1.0
    """Likewise for the accelerometer."""
    accel_walk_factor: float = 2.5
    """Likewise for the walk of the accelerometer's bias, which vibration moves."""
    extrinsics_sigma_deg: float = 0.1
    """How well it is known how a camera is turned on the body, a standard deviation, where that is estimated on the
    way: what a calibration of both together is good to. Some degrees where it was measured by hand."""
    extrinsics_sigma_m: float = 0.003
    """Likewise for where the camera is on the body; some centimetres where it was measured by hand."""
    zero_velocity_update: bool = True
    """Recognise standstill and use it."""
    standstill_disparity_px: float = 0.7
    """Motion that the points of an image have in common in half a second; with less, a camera may be standing still."""
    max_blind_s: float = 4.0
    """Seconds in which nothing seen corrects the estimate, after which it is given up and begun anew."""

    def __post_init__(self) -> None:
        for name in (
            "gyro_noise_factor",
            "accel_noise_factor",
            "accel_walk_factor",
            "extrinsics_sigma_deg",
            "extrinsics_sigma_m",
            "max_blind_s",
        ):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"estimation option {name} must be more than zero, got {getattr(self, name)!r}")
        if not self.standstill_disparity_px >= 0.0:
            raise ConfigError(
                f"estimation option standstill_disparity_px must be zero or more, got {self.standstill_disparity_px!r}"
            )

    def in_flight(self, imu: ImuNoise) -> ImuNoise:
        """At most what the readings of ``imu`` are off by in flight, where vibration adds to the sensor's own."""
        return imu.times(self.gyro_noise_factor, self.accel_noise_factor, self.accel_walk_factor)

    @property
    def camera_sigma(self) -> CameraSigma:
        """How well a camera's calibration is known ahead of everything seen."""
        rotation = np.full(3, np.deg2rad(self.extrinsics_sigma_deg))
        return CameraSigma(rotation, np.full(3, self.extrinsics_sigma_m), _TIME_OFFSET_SIGMA_S, _INTRINSICS_SIGMA)
