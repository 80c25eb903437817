"""What an IMU reads along a flight: exact, or with the errors that a calibration knows and those that it does not.

Among the latter is what rotors shake into it: tones at their speeds and harmonics, and noise over a band. Every part
is a sine in continuous time, so that the same generator gives the same vibration at any rate of sampling. A tone above
half that rate folds back, as it does in a sensor without a filter against it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from vioframe.arrays import Float
from vioframe.errors import ConfigError
from vioframe.types import ImuNoise, Motion, g_W

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]

_ZERO: Vector = (0.0, 0.0, 0.0)
_NO_MISALIGNMENT: Matrix = (_ZERO, _ZERO, _ZERO)

ACCEL_RMS, GYRO_RMS = 3.0, 0.15
"""Of vibration at level 1, m/s^2 and rad/s on each axis: three times what EuRoC's vehicle shows in flight."""

_ROTORS = 4
_ROTOR_HZ = (70.0, 90.0)
# Of the shaft, the two blades that pass, and the third harmonic.
_HARMONICS = np.array([1.0, 2.0, 3.0])
_HARMONIC_AMPLITUDES = np.array([1.0, 0.5, 0.25])
# The speed wanders about its mean, as the controller corrects it.
_WANDER = 0.02
_WANDER_HZ = (0.1, 0.5)
_BAND_HZ = (20.0, 250.0)
_LINES = 64
_NOISE_PART = 0.3  # of the power
_CHUNK = 8192


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

    def __post_init__(self) -> None:
        sensors: tuple[Literal["gyro", "accel"], ...] = ("gyro", "accel")
        for sensor in sensors:
            misalignment = np.asarray(getattr(self, f"{sensor}_misalignment"))
            if np.diag(misalignment).any():
                raise ConfigError(f"the diagonal of {sensor}_misalignment must be zero; it belongs in {sensor}_scale")
            if not np.abs(self.mixing(sensor) - np.eye(3)).max() < 0.5:
                raise ConfigError(f"{sensor}_scale and {sensor}_misalignment must be below 0.5; 0.01 is 1 %")
            if not np.isfinite(getattr(self, f"bias_{sensor}_B")).all():
                raise ConfigError(f"bias_{sensor}_B must be finite")

    def mixing(self, sensor: Literal["gyro", "accel"]) -> Float:
        """(3, 3), from the true angular rate or specific force to that which ``sensor`` reads."""
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
    gyro_B, accel_B = gyro_B @ errors.mixing("gyro").T, accel_B @ errors.mixing("accel").T
    if noise is not None:
        root_rate = np.sqrt(rate_hz)
        bias_gyro[1:] += np.cumsum(rng.normal(0.0, noise.gyro_walk / root_rate, (count - 1, 3)), axis=0)
        bias_accel[1:] += np.cumsum(rng.normal(0.0, noise.accel_walk / root_rate, (count - 1, 3)), axis=0)
        gyro_B = gyro_B + rng.normal(0.0, noise.gyro_density * root_rate, (count, 3))
        accel_B = accel_B + rng.normal(0.0, noise.accel_density * root_rate, (count, 3))
    return ImuReadings(gyro_B + bias_gyro, accel_B + bias_accel, bias_gyro, bias_accel)


def vibration(level: float, t_s: Float, rng: np.random.Generator) -> tuple[Float, Float]:
    """What it adds at times ``t_s`` (N,): angular rate (N, 3) rad/s and specific force (N, 3) m/s^2."""
    rotor_hz = rng.uniform(*_ROTOR_HZ, _ROTORS)
    wander_hz = rng.uniform(*_WANDER_HZ, _ROTORS)
    wander_phase = rng.uniform(0.0, 2.0 * np.pi, _ROTORS)
    line_hz = rng.uniform(*_BAND_HZ, _LINES)
    tones = rng.standard_normal((2, _ROTORS, len(_HARMONICS), 6)) * _HARMONIC_AMPLITUDES[:, None]
    sines = _powered(tones.reshape(2, -1, 6), 1.0 - _NOISE_PART)
    lines = _powered(rng.standard_normal((2, _LINES, 6)), _NOISE_PART)
    amplitudes = np.concatenate([sines, lines], axis=1)

    out = np.empty((len(t_s), 6))
    for begin in range(0, len(t_s), _CHUNK):
        t = t_s[begin : begin + _CHUNK, None]
        wandered = _WANDER / wander_hz * np.sin(2.0 * np.pi * wander_hz * t + wander_phase)
        turns = rotor_hz * (t + wandered / (2.0 * np.pi))
        harmonics = (turns[:, :, None] * _HARMONICS).reshape(len(t), -1)
        phase = 2.0 * np.pi * np.concatenate([harmonics, line_hz * t], axis=1)
        out[begin : begin + _CHUNK] = np.cos(phase) @ amplitudes[0] + np.sin(phase) @ amplitudes[1]
    out *= level
    return GYRO_RMS * out[:, 3:], ACCEL_RMS * out[:, :3]


def _powered(amplitudes: Float, power: float) -> Float:
    """Cosine and sine amplitudes (2, K, 6) scaled to the mean square ``power`` in each column."""
    return np.asarray(amplitudes * np.sqrt(2.0 * power / (amplitudes**2).sum(axis=(0, 1))))
