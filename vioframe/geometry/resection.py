"""Where a camera is, given the landmarks that it sees: robust least squares from a guess."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vioframe.arrays import Float
from vioframe.geometry import so3

_ITERATIONS = 12
_CONVERGED, _LARGEST_DAMPING = 1e-5, 1e4
# Of a landmark behind the camera, squared standard deviations: an outlier that no step should make.
_BEHIND = 1e6


class Resected(NamedTuple):
    """A pose, R_WC (3, 3) and p_WC (3,); the information (6, 6) on [turn, p_WC] given the landmarks, and (M,) squared
    residuals, in standard deviations."""

    R_WC: Float
    p_WC: Float
    information: Float
    squared: Float


def resect(
    R_WC: Float, p_WC: Float, p_WF: Float, xy: Float, sigma: float, width: float, prior: Float | None = None
) -> Resected:
    """The pose near the one given that sees the landmarks (M, 3) at ``xy`` (M, 2) on the z = 1 plane.

    Levenberg-Marquardt. ``sigma`` is the standard deviation of ``xy``. A landmark counts less the further it lies off:
    Cauchy's loss of ``width`` standard deviations. ``prior`` (6,) is what is known of the pose given, as information on
    [turn, p_WC], ``R_WC <- R_WC Exp(turn)``.
    """

    def normal_equations(R: Float, p: Float) -> tuple[float, Float, Float, Float]:
        """Robust cost, its Gauss-Newton matrix and gradient, and squared residuals."""
        r, J = reprojection(p_WF, xy, R, p)
        squared = np.where(np.isnan(r[:, 0]), _BEHIND, np.sum(r**2, axis=1) / sigma**2)
        ratio = squared / width**2
        r, J = np.nan_to_num(r / sigma).ravel(), np.nan_to_num(J / sigma).reshape(-1, 6)
        weighted_T = J.T / np.repeat(1.0 + ratio, 2)
        cost, N, g = 0.5 * float(width**2 * np.log1p(ratio).sum()), weighted_T @ J, weighted_T @ r
        if prior is not None:
            off = np.concatenate([so3.log(R_WC.T @ R), p - p_WC])
            cost, N, g = cost + 0.5 * float(prior @ off**2), N + np.diag(prior), g + prior * off
        return cost, N, g, squared

    R, p, damping = R_WC, p_WC, 1e-4
    cost, N, g, squared = normal_equations(R, p)
    for _ in range(_ITERATIONS):
        step = np.linalg.solve(N + np.diag(damping * np.diag(N) + 1e-9), g)
        moved = R @ so3.exp(-step[:3]), p - step[3:]
        trial = normal_equations(*moved)
        if trial[0] < cost:
            converged = cost - trial[0] < _CONVERGED * cost
            (R, p), (cost, N, g, squared) = moved, trial
            damping *= 0.1
            if converged:
                break
        else:
            damping *= 10.0
            if damping > _LARGEST_DAMPING:
                break
    return Resected(R, p, N, squared)


def reprojection(p_WF: Float, xy: Float, R_WC: Float, p_WC: Float) -> tuple[Float, Float]:
    """(M, 2) on the z = 1 plane, and (M, 2, 6) their derivatives by [turn, p_WC]; NaN for points behind the camera.

    The camera is perturbed as ``R_WC <- R_WC Exp(turn)``.
    """
    p_C = (p_WF - p_WC) @ R_WC
    there, J = projected(p_C, np.concatenate([so3.hat(p_C), np.broadcast_to(-R_WC.T, (len(p_C), 3, 3))], axis=2))
    return there - xy, J


def projected(p_C: Float, J_C: Float) -> tuple[Float, Float]:
    """Points (M, 3) on the z = 1 plane, (M, 2), and from the points' derivatives (M, 3, n) those there, (M, 2, n).

    NaN for points behind the camera.
    """
    z = np.where(p_C[:, 2] > 0.0, p_C[:, 2], np.nan)
    xy = p_C[:, :2] / z[:, None]
    return xy, (J_C[:, :2] - xy[:, :, None] * J_C[:, 2:]) / z[:, None, None]
