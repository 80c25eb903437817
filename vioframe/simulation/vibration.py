"""What rotors shake into an IMU: tones at the rotors' speeds and their harmonics, and noise over a band.

Every part is a sine in continuous time, so that the same generator gives the same vibration at any rate of sampling. A
tone above half that rate folds back, as it does in a sensor without a filter against it.
"""

from __future__ import annotations

import numpy as np

from vioframe.types import Float

ACCEL_RMS = 3.0
"""At level 1, m/s^2 on each axis: three times what EuRoC's vehicle shows in flight, about its smooth motion."""
GYRO_RMS = 0.15
"""At level 1, rad/s on each axis, likewise."""

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


def vibration(t_s: Float, rng: np.random.Generator) -> Float:
    """(N, 6) at times (N,) s, with a root mean square of 1 in each column: acceleration, then angular rate."""
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
    return out


def _powered(amplitudes: Float, power: float) -> Float:
    """Cosine and sine amplitudes (2, K, 6) scaled to the mean square ``power`` in each column."""
    return np.asarray(amplitudes * np.sqrt(2.0 * power / (amplitudes**2).sum(axis=(0, 1))))
