"""The gyroscope's bias from images alone: the one that lets every pair of frames agree with *some* translation.

Rotations come from the gyroscope, so that all pairs share three unknowns (He et al., "A Rotation-Translation-Decoupled
Solution for Robust and Efficient Visual-Inertial Initialization", CVPR 2023). What a pair says about its rotation is
told in :mod:`vioframe.estimation.initialization.epipolar_pairs`. Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.estimation.initialization.epipolar_pairs import BearingPairs, relative_rotations
from vioframe.estimation.initialization.window import Window
from vioframe.types import Float, Int

_FEWEST_COMMON = 10
# Iterations, the longest pair used (s) and Cauchy's scale (standard deviations) of each stage. Short pairs lead near
# the minimum; long ones, which a wrong bias turns by tens of pixels, then determine it.
_STAGES = ((4, 0.5, 50.0), (4, 1.0, 20.0), (8, np.inf, 5.0), (8, np.inf, 2.0))
_CONVERGED = 1e-5  # rad/s


def estimate_gyro_bias(
    window: Window, imu: Sequence[Preintegrated], R_BC: Float, sigma: float, bias_sigma: float
) -> tuple[Float, Float]:
    """The bias (3,) rad/s, and each track's median distance to its epipolar lines (L,) in units of ``sigma``.

    ``imu`` holds the K - 1 measurements between the keyframes; ``sigma`` is the noise of an observation on the z = 1
    plane, ``bias_sigma`` the prior of the bias about zero, rad/s. A track in no pair has distance NaN.
    """
    bias = imu[0].bias_gyro_B
    for iterations, longest_s, cauchy in _STAGES:
        first, second, pairs = _pairs(window, longest_s)
        weight = pairs.common.astype(np.float64)
        for _ in range(iterations):
            R_B1B2, by_bias = relative_rotations(imu, bias, first, second)
            equations = pairs.linearise(R_BC.T @ R_B1B2 @ R_BC, weight, sigma, cauchy)
            # The camera's rotation by the body's: R_C1C2 Exp(R_CB dtheta_B) = R_CB R_B1B2 Exp(dtheta_B) R_BC.
            by_bias = R_BC.T @ by_bias
            transposed = np.swapaxes(by_bias, -1, -2)
            H = (transposed @ equations.H @ by_bias).sum(axis=0) + np.eye(3) / bias_sigma**2
            b = (transposed @ equations.b[..., None]).sum(axis=0)[:, 0] + bias / bias_sigma**2
            step = np.linalg.solve(H, -b)
            bias, weight = bias + step, equations.weight
            if np.linalg.norm(step) < _CONVERGED:
                break
    return bias, _median_over_pairs(np.where(pairs.common, equations.distance, np.nan))


def _pairs(window: Window, longest_s: float) -> tuple[Int, Int, BearingPairs]:
    """The pairs that share enough tracks and are at most ``longest_s`` apart, or neighbours; N is the window's L."""
    i, j = np.triu_indices(len(window.t_ns), 1)
    near = ((window.t_ns[j] - window.t_ns[i]) * 1e-9 <= longest_s) | (j == i + 1)
    use = near & ((window.seen[i] & window.seen[j]).sum(axis=1) >= _FEWEST_COMMON)
    i, j = i[use], j[use]
    return i, j, BearingPairs.of(window.xy[i], window.xy[j], window.seen[i] & window.seen[j])


def _median_over_pairs(distance: Float) -> Float:
    """(P, L) -> (L,); NaN where a track is in no pair."""
    out = np.full(distance.shape[1], np.nan)
    known = ~np.isnan(distance).all(axis=0) if len(distance) else np.zeros(distance.shape[1], bool)
    out[known] = np.nanmedian(distance[:, known], axis=0)
    return out
