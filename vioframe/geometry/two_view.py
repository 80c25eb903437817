"""Two views of one scene: epipolar geometry on undistorted points, and what is an outlier to it.

Points are ``xy_normalised``, (N, 2) on the z = 1 plane of an undistorted camera. View 1 is the earlier one:
``p_C2 = R_C2C1 @ p_C1 + p_C2C1`` and ``x_2^T E x_1 = 0`` with ``E = [p_C2C1]x R_C2C1``. Equation numbers are of
Hartley and Zisserman, "Multiple View Geometry" (2nd edition, 2003). Every function is deterministic: the same points
give the same answer, run after run.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Float
from vioframe.geometry import so3

Mask = NDArray[np.bool_]

_MAX_ITERATIONS = 1000
# Hypotheses of the 2-point method: with 50 % of outliers, 100 pairs miss every clean one with a chance of 3e-13.
_PAIRS = 100
_REFINEMENTS = 3
_SEED = 20110


def rays(xy_normalised: Float) -> Float:
    """(N, 2) -> (N, 3) with z = 1."""
    return np.column_stack([xy_normalised, np.ones(len(xy_normalised))])


def median_parallax(xy_1: Float, xy_2: Float, R_C1C2: Float) -> float:
    """Median motion of tracks (N, 2) on the first view's z = 1 plane, with the turn ``R_C1C2`` (3, 3) taken out."""
    turned = rays(xy_2) @ R_C1C2.T
    ahead = turned[:, 2] > 0.1
    if not ahead.any():
        return 0.0
    moved = turned[ahead, :2] / turned[ahead, 2:] - xy_1[ahead]
    return float(np.median(np.linalg.norm(moved, axis=1)))


def inverse_depths(xy_1: Float, xy_2: Float, R_C2C1: Float, p_C2C1: Float) -> Float:
    """(N,) 1/m in the first view, by least squares on the z = 1 plane of the second; zero or less beyond infinity."""
    turned = rays(xy_1) @ R_C2C1.T
    # x_2 (turned_z + rho p_z) = turned_xy + rho p_xy.
    a = p_C2C1[:2] - xy_2 * p_C2C1[2]
    b = xy_2 * turned[:, 2:] - turned[:, :2]
    return np.asarray((a * b).sum(axis=1) / np.maximum((a * a).sum(axis=1), 1e-12))


def essential_matrix(R_C2C1: Float, p_C2C1: Float) -> Float:
    """E = [p]x R (9.12), (3, 3)."""
    E: Float = so3.hat(p_C2C1) @ R_C2C1
    return E


def sampson_distance(E: Float, xy_1: Float, xy_2: Float) -> Float:
    """First-order distance to the epipolar geometry ``E`` (..., 3, 3) (11.9): signed, (..., N), in normalised units.

    Where ``E`` vanishes on a point (both epipoles on it) the distance is zero: such a point says nothing about ``E``.
    """
    ray_1, ray_2 = rays(xy_1), rays(xy_2)
    line_2 = ray_1 @ np.swapaxes(E, -1, -2)  # (..., N, 3), rows E x_1
    line_1 = ray_2 @ E  # rows E^T x_2
    algebraic = (line_2 * ray_2).sum(axis=-1)
    slope = np.sqrt((line_2[..., :2] ** 2).sum(axis=-1) + (line_1[..., :2] ** 2).sum(axis=-1))
    distance: Float = np.divide(algebraic, slope, out=np.zeros_like(algebraic), where=slope > 1e-12)
    return distance


def fundamental_inliers(xy_1: Float, xy_2: Float, threshold: float, confidence: float = 0.999) -> Mask:
    """(N,) inliers to a fundamental matrix by RANSAC over the 7-point solver (11.1.2); needs N >= 8.

    It asks less of the calibration than :func:`magsac_inliers`, and rejects less.
    """
    import cv2

    _, mask = cv2.findFundamentalMat(xy_1, xy_2, cv2.FM_RANSAC, threshold, confidence, _MAX_ITERATIONS)
    return _as_mask(mask, len(xy_1))


def magsac_inliers(xy_1: Float, xy_2: Float, threshold: float, confidence: float = 0.999) -> Mask:
    """(N,) inliers to the essential matrix by MAGSAC++ (Barath et al., CVPR 2020); needs N >= 6."""
    import cv2

    params: Any = cv2.UsacParams()
    params.score = cv2.SCORE_METHOD_MAGSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.loMethod = cv2.LOCAL_OPTIM_SIGMA
    params.confidence = confidence
    params.maxIterations = _MAX_ITERATIONS
    params.threshold = threshold
    params.randomGeneratorState = _SEED
    params.isParallel = False  # threads would make the answer depend on the machine
    K = np.eye(3)
    _, mask = cv2.findEssentialMat(xy_1, xy_2, K, K, np.zeros(4), np.zeros(4), params)
    return _as_mask(mask, len(xy_1))


def two_point_inliers(xy_1: Float, xy_2: Float, R_C2C1: Float, threshold: float) -> Mask:
    """(N,) inliers to the translation direction that agrees with most points, the rotation being known to a degree.

    With the rotation given, each match confines the translation to a plane, ``(x_2 x R x_1) . p_C2C1 = 0``, and two
    matches fix its direction (Troiani et al., ICRA 2014). A gyroscope's bias turns the given rotation by a few
    milliradians, more than a pixel, so the best hypothesis is refined over its own inliers (rotation and direction,
    Gauss-Newton on the Sampson distance) before it judges. Needs N >= 2.
    """
    ray_1, ray_2 = rays(xy_1) @ R_C2C1.T, rays(xy_2)
    normals = np.cross(ray_2, ray_1)
    rng = np.random.default_rng(_SEED)
    first = rng.integers(0, len(xy_1), _PAIRS)
    second = (first + rng.integers(1, len(xy_1), _PAIRS)) % len(xy_1)
    directions = np.cross(normals[first], normals[second])
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    directions = np.divide(directions, length, out=np.tile([0.0, 0.0, 1.0], (_PAIRS, 1)), where=length > 1e-15)
    # The truncated square (MSAC) tells good hypotheses apart where counts tie.
    distances = sampson_distance(so3.hat(directions) @ R_C2C1, xy_1, xy_2)
    best = int(np.argmin(np.minimum((distances / (3.0 * threshold)) ** 2, 1.0).sum(axis=1)))
    R, direction = R_C2C1, directions[best]
    for _ in range(_REFINEMENTS):
        near = np.abs(sampson_distance(essential_matrix(R, direction), xy_1, xy_2)) < 3.0 * threshold
        R, direction = _refine(R, direction, xy_1[near], xy_2[near], threshold)
    inliers: Mask = np.abs(sampson_distance(essential_matrix(R, direction), xy_1, xy_2)) < threshold
    return inliers


def _refine(R_C2C1: Float, direction: Float, xy_1: Float, xy_2: Float, sigma: float) -> tuple[Float, Float]:
    """One damped Gauss-Newton step of ``R <- R Exp(dtheta)`` and ``direction`` on the sphere, slopes held fixed.

    The damping is a prior of 1 degree on the rotation and 1 rad on the direction: without parallax the direction cannot
    be seen, and must not run away.
    """
    E = essential_matrix(R_C2C1, direction)
    ray_1, ray_2 = rays(xy_1), rays(xy_2)
    line_2, line_1 = ray_1 @ E.T, ray_2 @ E
    slope = np.sqrt((line_2[:, :2] ** 2).sum(axis=1) + (line_1[:, :2] ** 2).sum(axis=1)) + 1e-12
    turned = ray_1 @ R_C2C1.T
    tangent = np.linalg.svd(direction[None])[2][1:].T  # (3, 2), perpendicular to the direction
    # e = x_2 . (t x R x_1): de/dtheta = x_1 x E^T x_2 and de/dt = (R x_1) x x_2.
    J = np.column_stack([np.cross(ray_1, line_1), np.cross(turned, ray_2) @ tangent]) / slope[:, None] / sigma
    residual = (line_2 * ray_2).sum(axis=1) / slope / sigma
    prior = np.diag(1.0 / np.array([*[np.deg2rad(1.0)] * 3, 1.0, 1.0]) ** 2)
    step = -np.linalg.solve(J.T @ J + prior, J.T @ residual)
    moved = direction + tangent @ step[3:]
    R: Float = R_C2C1 @ so3.exp(step[:3])
    return R, moved / np.linalg.norm(moved)


def _as_mask(mask: Any, count: int) -> Mask:
    """OpenCV's (N, 1) uint8 mask as (N,) bool; no model found means no verdict, so nothing is rejected."""
    return np.ones(count, bool) if mask is None else mask.ravel().astype(bool)
