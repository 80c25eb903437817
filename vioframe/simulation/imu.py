"""What an IMU reads along a flight: exact, or with white noise and wandering biases."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.simulation.flights import Motion
from vioframe.types import Float, ImuNoise, g_W


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
    bias_gyro_B: Float | None = None,
    bias_accel_B: Float | None = None,
) -> ImuReadings:
    """Readings at ``noise.rate_hz`` along ``motion``; ``noise`` None reads exactly.

    A white noise of density ``s`` sampled at ``rate`` has the standard deviation ``s sqrt(rate)``; a bias of diffusion
    ``w`` takes a step of ``w / sqrt(rate)`` a sample (Crassidis 2006). The biases (3,) are those of the first reading,
    zero if left out.
    """
    count = len(motion.p_WB)
    gyro_B = motion.omega_B.copy()
    accel_B = np.einsum("nji,nj->ni", motion.R_WB, motion.a_WB - g_W)
    bias_gyro = np.tile(np.zeros(3) if bias_gyro_B is None else bias_gyro_B, (count, 1))
    bias_accel = np.tile(np.zeros(3) if bias_accel_B is None else bias_accel_B, (count, 1))
    if noise is not None:
        root_rate = np.sqrt(noise.rate_hz)
        bias_gyro[1:] += np.cumsum(rng.normal(0.0, noise.gyro_walk / root_rate, (count - 1, 3)), axis=0)
        bias_accel[1:] += np.cumsum(rng.normal(0.0, noise.accel_walk / root_rate, (count - 1, 3)), axis=0)
        gyro_B += rng.normal(0.0, noise.gyro_density * root_rate, (count, 3))
        accel_B += rng.normal(0.0, noise.accel_density * root_rate, (count, 3))
    return ImuReadings(gyro_B + bias_gyro, accel_B + bias_accel, bias_gyro, bias_accel)
