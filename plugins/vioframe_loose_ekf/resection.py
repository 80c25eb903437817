"""The camera's pose from known points: robust least squares from a guess, or from nothing where the guess is bad."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry.kernels import exp
from vioframe.jit import kernel
from vioframe.types import Float
from vioframe_loose_ekf.state import VisionPose

Bool = NDArray[np.bool_]

OUTLIER_SIGMAS = 4.0
"""A point that is off by more is an outlier; at half of that Cauchy's loss has halved its weight."""
_ITERATIONS = 12
_RANSAC_ITERATIONS = 300
_MIN_POINTS = 6
_LARGEST_DAMPING = 1e4
# Of a point behind the camera, squared standard deviations: an outlier that no step should make.
_BEHIND = 1e6
# A point nearer than this to the plane of the camera's centre cannot be seen.
_LEAST_DEPTH = 1e-3


@dataclass(frozen=True, slots=True)
class Resection:
    """A pose, its covariance (6, 6) over [rotation in the camera, position in V] given the points, and inliers (N,)."""

    pose: VisionPose
    cov: Float
    inliers: Bool


def resect(guess: VisionPose, p_VF: Float, xy: Float, sigma: float) -> Resection | None:
    """The pose that sees ``p_VF`` (N, 3) at ``xy`` (N, 2) on the z = 1 plane, near ``guess``; ``sigma`` is their noise.

    None where most points cannot be brought to agree.
    """
    found = _refined(guess, p_VF, xy, sigma)
    if found is not None and found.inliers.sum() > 0.6 * len(xy):
        return found
    start = _ransac(p_VF, xy, sigma)
    again = None if start is None else _refined(start, p_VF, xy, sigma)
    if again is not None and (found is None or again.inliers.sum() > found.inliers.sum()):
        found = again
    return found


def _refined(guess: VisionPose, p_VF: Float, xy: Float, sigma: float) -> Resection | None:
    if len(xy) < _MIN_POINTS:
        return None
    R, p, N, squared = _refine(np.ascontiguousarray(guess.R_VC), guess.p_VC, p_VF, xy, sigma)
    inliers = squared < OUTLIER_SIGMAS**2
    if not np.isfinite(p).all() or inliers.sum() < _MIN_POINTS:
        return None
    try:
        cov = np.linalg.inv(N)
    except np.linalg.LinAlgError:
        return None
    return Resection(VisionPose(R, p), 0.5 * (cov + cov.T), inliers)


def _ransac(p_VF: Float, xy: Float, sigma: float) -> VisionPose | None:
    """By samples of three and a fourth point to choose among their solutions; the same input gives the same pose."""
    import cv2

    if len(xy) < _MIN_POINTS:
        return None
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        np.ascontiguousarray(p_VF),
        np.ascontiguousarray(xy),
        np.eye(3),
        np.empty(0),
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=OUTLIER_SIGMAS * sigma,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or not np.isfinite(translation).all():
        return None
    R_CV = cv2.Rodrigues(rotation)[0]
    return VisionPose(np.asarray(R_CV.T, np.float64), np.asarray(-R_CV.T @ translation[:, 0], np.float64))


@kernel
def _refine(R: Float, p: Float, p_VF: Float, xy: Float, sigma: float) -> tuple[Float, Float, Float, Float]:
    """Levenberg-Marquardt: rotation, position, information (6, 6) and squared residuals (N,) in sigma."""
    damping = 1e-4
    cost, N, g, squared = _normal_equations(R, p, p_VF, xy, sigma)
    for _ in range(_ITERATIONS):
        damped = N.copy()
        for k in range(6):
            damped[k, k] += damping * N[k, k] + 1e-9
        step: Float = np.asarray(np.linalg.solve(damped, g), np.float64)
        R_trial, p_trial = R @ exp(-step[:3]), p - step[3:]
        trial_cost, trial_N, trial_g, trial_squared = _normal_equations(R_trial, p_trial, p_VF, xy, sigma)
        if trial_cost < cost:
            converged = cost - trial_cost < 1e-5 * cost
            R, p, cost, N, g, squared = R_trial, p_trial, trial_cost, trial_N, trial_g, trial_squared
            damping *= 0.1
            if converged:
                break
        else:
            damping *= 10.0
            if damping > _LARGEST_DAMPING:
                break
    return R, p, N, squared


@kernel
def _normal_equations(R: Float, p: Float, p_VF: Float, xy: Float, sigma: float) -> tuple[float, Float, Float, Float]:
    """Robust cost, its Gauss-Newton matrix and gradient over [dtheta dp], and squared residuals (N,) in sigma."""
    N = np.zeros((6, 6))
    g = np.zeros(6)
    squared = np.full(len(xy), _BEHIND)
    e = np.empty(2)
    J = np.empty((2, 6))
    cost = 0.0
    for i in range(len(xy)):
        in_front = reproject(R, p, p_VF[i], xy[i], sigma, e, J)
        if in_front:
            squared[i] = e[0] * e[0] + e[1] * e[1]
        loss, weight = cauchy(squared[i], 0.5 * OUTLIER_SIGMAS)
        cost += loss
        if not in_front:
            continue
        for r in range(6):
            g[r] += weight * (J[0, r] * e[0] + J[1, r] * e[1])
            for c in range(6):
                N[r, c] += weight * (J[0, r] * J[0, c] + J[1, r] * J[1, c])
    return cost, N, g, squared


@kernel
def reproject(R_VC: Float, p_VC: Float, p_VF: Float, xy: Float, sigma: float, e: Float, J: Float) -> bool:
    """Residual ``e`` (2,) on the z = 1 plane and its Jacobian ``J`` (2, 6) by the pose [dtheta dp], in sigma.

    Both are written in place; the Jacobian by the point is ``-J[:, 3:]``. False, and nothing written, where the point
    is behind the camera.
    """
    d0, d1, d2 = p_VF[0] - p_VC[0], p_VF[1] - p_VC[1], p_VF[2] - p_VC[2]
    q0 = R_VC[0, 0] * d0 + R_VC[1, 0] * d1 + R_VC[2, 0] * d2
    q1 = R_VC[0, 1] * d0 + R_VC[1, 1] * d1 + R_VC[2, 1] * d2
    q2 = R_VC[0, 2] * d0 + R_VC[1, 2] * d1 + R_VC[2, 2] * d2
    if q2 < _LEAST_DEPTH:
        return False
    x, y = q0 / q2, q1 / q2
    e[0], e[1] = (x - xy[0]) / sigma, (y - xy[1]) / sigma
    # q moves by [q]x dtheta - R^T dp; what that does on the plane is the first two rows of (1, 0, -x; 0, 1, -y) / z.
    unit = 1.0 / (q2 * sigma)
    J[0, 0], J[0, 1], J[0, 2] = x * q1 * unit, (-q2 - x * q0) * unit, q1 * unit
    J[1, 0], J[1, 1], J[1, 2] = (q2 + y * q1) * unit, -y * q0 * unit, -q0 * unit
    for k in range(3):
        J[0, 3 + k] = (x * R_VC[k, 2] - R_VC[k, 0]) * unit
        J[1, 3 + k] = (y * R_VC[k, 2] - R_VC[k, 1]) * unit
    return True


@kernel
def cauchy(squared: float, width: float) -> tuple[float, float]:
    """Cauchy's loss of a squared residual, half of it where it is small, and the weight that goes with it."""
    ratio = squared / (width * width)
    return 0.5 * width * width * math.log1p(ratio), 1.0 / (1.0 + ratio)
