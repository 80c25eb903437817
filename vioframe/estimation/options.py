"""What can be chosen about the estimation, whatever the back-end."""

from __future__ import annotations

from dataclasses import dataclass

from vioframe.errors import ConfigError
from vioframe.types import ImuNoise


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
    zero_velocity_update: bool = True
    """Recognise standstill and use it."""
    standstill_disparity_px: float = 0.7
    """Motion that the points of an image have in common in half a second; with less, a camera may be standing still."""
    max_blind_s: float = 4.0
    """Seconds in which nothing seen corrects the estimate, after which it is given up and begun anew."""

    def __post_init__(self) -> None:
        for name in ("gyro_noise_factor", "accel_noise_factor", "accel_walk_factor", "max_blind_s"):
            if not getattr(self, name) > 0.0:
                raise ConfigError(f"estimation option {name} must be more than zero, got {getattr(self, name)!r}")
        if not self.standstill_disparity_px >= 0.0:
            raise ConfigError(
                f"estimation option standstill_disparity_px must be zero or more, got {self.standstill_disparity_px!r}"
            )

    def in_flight(self, imu: ImuNoise) -> ImuNoise:
        """At most what the readings of ``imu`` are off by in flight, where vibration adds to the sensor's own."""
        return imu.times(self.gyro_noise_factor, self.accel_noise_factor, self.accel_walk_factor)
