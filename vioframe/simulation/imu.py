"""What an IMU reads along a flight: exact, or with the errors that a calibration knows and those that it does not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.errors import ConfigError
from vioframe.simulation.vibration import ACCEL_RMS, GYRO_RMS, vibration
from vioframe.types import Float, ImuNoise, Motion, g_W

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]

_ZERO: Vector = (0.0, 0.0, 0.0)
_NO_MISALIGNMENT: Matrix = (_ZERO, _ZERO, _ZERO)


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuErrors:
    """Deterministic errors of an IMU; raises :class:`ConfigError` for what no IMU has.

    A sensor reads ``(I + diag(scale) + misalignment) x + bias`` where ``x`` is true: the scale and misalignment model
    of Rehder, Nikolic, Schneider, Hinzmann and Siegwart, "Extending kalibr" (ICRA 2016), without its effect of the
    acceleration on the gyroscope.
    """

    gyro_scale: Vector = _ZERO
    """scale errors of the gyroscope's axes: 0.01 reads 1 % too much"""
    gyro_misalignment: Matrix = _NO_MISALIGNMENT
    """how much of axis j the gyroscope's axis i reads, row i, column j, rad; the diagonal is zero"""
    accel_scale: Vector = _ZERO
    """scale errors of the accelerometer's axes"""
    accel_misalignment: Matrix = _NO_MISALIGNMENT
    """how much of axis j the accelerometer's axis i reads, row i, column j, rad; the diagonal is zero"""
    bias_gyro_B: Vector = _ZERO
    """bias of the gyroscope at the first reading, rad/s"""
    bias_accel_B: Vector = _ZERO
    """bias of the accelerometer at the first reading, m/s^2"""
    vibration: float = 0.0
    """rotors felt by the IMU and not by the camera, 0 to 1: 1 is 3 m/s^2 and 0.15 rad/s rms on each axis"""

    def __post_init__(self) -> None:
        if not 0.0 <= self.vibration <= 1.0:
            raise ConfigError(f"vibration must lie between 0 (none) and 1, not {self.vibration:g}")
        for sensor in ("gyro", "accel"):
            misalignment = np.asarray(getattr(self, f"{sensor}_misalignment"))
            if np.diag(misalignment).any():
                raise ConfigError(f"the diagonal of {sensor}_misalignment must be zero; it belongs in {sensor}_scale")
            if not np.abs(self._mixing(sensor) - np.eye(3)).max() < 0.5:
                raise ConfigError(f"{sensor}_scale and {sensor}_misalignment must be below 0.5; 0.01 is 1 %")
            if not np.isfinite(getattr(self, f"bias_{sensor}_B")).all():
                raise ConfigError(f"bias_{sensor}_B must be finite")

    @property
    def gyro_mixing(self) -> Float:
        """(3, 3), from the true angular rate to that which is read."""
        return self._mixing("gyro")

    @property
    def accel_mixing(self) -> Float:
        """(3, 3), from the true specific force to that which is read."""
        return self._mixing("accel")

    def _mixing(self, sensor: str) -> Float:
        scale, misalignment = getattr(self, f"{sensor}_scale"), getattr(self, f"{sensor}_misalignment")
        return np.asarray(np.diag(1.0 + np.asarray(scale)) + np.asarray(misalignment))


@dataclass(frozen=True, slots=True)
class ImuReadings:
    """``gyro_B`` (N, 3) rad/s and ``accel_B`` (N, 3) m/s^2 as read, with the true biases in them (N, 3)."""

    gyro_B: Float
    accel_B: Float
    bias_gyro_B: Float
    bias_accel_B: Float


def read_imu(
    motion: Motion,
    noise: ImuNoise | None,
    rng: np.random.Generator,
    rate_hz: float,
    errors: ImuErrors | None = None,
) -> ImuReadings:
    """Readings along ``motion``, sampled ``rate_hz`` times a second; without ``noise`` and ``errors`` they are exact.

    A white noise of density ``s`` sampled at ``rate`` has the standard deviation ``s sqrt(rate)``; a bias of diffusion
    ``w`` takes a step of ``w / sqrt(rate)`` a sample (Crassidis 2006). The rate of ``noise`` itself plays no part.
    """
    errors = errors or ImuErrors()
    count = len(motion.p_WB)
    gyro_B = motion.omega_B
    accel_B = np.einsum("nji,nj->ni", motion.R_WB, motion.a_WB - g_W)
    bias_gyro = np.tile(np.asarray(errors.bias_gyro_B), (count, 1))
    bias_accel = np.tile(np.asarray(errors.bias_accel_B), (count, 1))
    if errors.vibration:
        # From a generator of its own: the noise is the same with and without it.
        shaken = errors.vibration * vibration(np.arange(count) / rate_hz, rng.spawn(1)[0])
        accel_B, gyro_B = accel_B + ACCEL_RMS * shaken[:, :3], gyro_B + GYRO_RMS * shaken[:, 3:]
    gyro_B, accel_B = gyro_B @ errors.gyro_mixing.T, accel_B @ errors.accel_mixing.T
    if noise is not None:
        root_rate = np.sqrt(rate_hz)
        bias_gyro[1:] += np.cumsum(rng.normal(0.0, noise.gyro_walk / root_rate, (count - 1, 3)), axis=0)
        bias_accel[1:] += np.cumsum(rng.normal(0.0, noise.accel_walk / root_rate, (count - 1, 3)), axis=0)
        gyro_B = gyro_B + rng.normal(0.0, noise.gyro_density * root_rate, (count, 3))
        accel_B = accel_B + rng.normal(0.0, noise.accel_density * root_rate, (count, 3))
    return ImuReadings(gyro_B + bias_gyro, accel_B + bias_accel, bias_gyro, bias_accel)
