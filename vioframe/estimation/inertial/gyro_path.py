"""How a body turns along the readings of its gyroscope."""

from __future__ import annotations

import math

import numpy as np

from vioframe.arrays import Float
from vioframe.geometry import kernels
from vioframe.jit import kernel


class GyroPath:
    """The rotation along readings free of bias, ``t_s`` (N,) ascending and ``rate_B`` (N, 3) rad/s, by midpoint rule.

    Between two readings the rate is linear; beyond the ends it goes on as within the first or last pair.
    """

    def __init__(self, t_s: Float, rate_B: Float) -> None:
        self._t_s, self._rate_B = t_s, rate_B
        self._R_B0B = _along(t_s, rate_B)

    def at(self, t_s: Float) -> tuple[Float, Float]:
        """R_B0B (..., 3, 3), from B at the first reading, and the rate (..., 3) rad/s at times of any shape."""
        R_B0B, rate_B = _between(self._t_s, self._rate_B, self._R_B0B, np.ravel(t_s))
        return R_B0B.reshape(*t_s.shape, 3, 3), rate_B.reshape(*t_s.shape, 3)


@kernel
def _between(at_s: Float, rate_B: Float, R_B0B: Float, t_s: Float) -> tuple[Float, Float]:
    """The rotation (T, 3, 3) and the rate (T, 3) at ``t_s``, along readings ``rate_B`` at ``at_s``."""
    R, rates = np.empty((len(t_s), 3, 3)), np.empty((len(t_s), 3))
    for j in range(len(t_s)):
        k = min(max(np.searchsorted(at_s, t_s[j], side="right") - 1, 0), len(at_s) - 2)
        after = t_s[j] - at_s[k]
        share = after / (at_s[k + 1] - at_s[k])
        for m in range(3):
            rates[j, m] = rate_B[k, m] + (rate_B[k + 1, m] - rate_B[k, m]) * share
        turn = kernels.exp((rate_B[k] + rates[j]) * (0.5 * after))
        kernels.set_matrix(R[j], kernels.product(R_B0B[k], turn))
    return R, rates


@kernel
def _along(t_s: Float, rate_B: Float) -> Float:
    """R_B0B (N, 3, 3) at the readings, by unit quaternions."""
    R = np.empty((len(t_s), 3, 3))
    w, x, y, z = 1.0, 0.0, 0.0, 0.0
    for k in range(len(t_s)):
        if k:
            half = 0.25 * (t_s[k] - t_s[k - 1])
            a = half * (rate_B[k, 0] + rate_B[k - 1, 0])
            b = half * (rate_B[k, 1] + rate_B[k - 1, 1])
            c = half * (rate_B[k, 2] + rate_B[k - 1, 2])
            angle = math.sqrt(a * a + b * b + c * c)
            s = math.sin(angle) / angle if angle > 1e-8 else 1.0
            a, b, c, d = s * a, s * b, s * c, math.cos(angle)
            w, x, y, z = (
                w * d - x * a - y * b - z * c,
                w * a + x * d + y * c - z * b,
                w * b - x * c + y * d + z * a,
                w * c + x * b - y * a + z * d,
            )
        R[k, 0, 0], R[k, 0, 1], R[k, 0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)
        R[k, 1, 0], R[k, 1, 1], R[k, 1, 2] = 2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)
        R[k, 2, 0], R[k, 2, 1], R[k, 2, 2] = 2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)
    return R
