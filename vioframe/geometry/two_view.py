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
    """First-order distance to the epipolar geometry ``E`` (3, 3) (11.9): signed, (N,), in normalised units.

    Where ``E`` vanishes on a point (both epipoles on it) the distance is zero: such a point says nothing about ``E``.
    """
    ray_1, ray_2 = rays(xy_1), rays(xy_2)
    line_2 = ray_1 @ E.T  # (N, 3), rows E x_1
    line_1 = ray_2 @ E  # rows E^T x_2
    algebraic = (line_2 * ray_2).sum(axis=1)
    slope = np.sqrt((line_2[:, :2] ** 2).sum(axis=1) + (line_1[:, :2] ** 2).sum(axis=1))
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


def _as_mask(mask: Any, count: int) -> Mask:
    """OpenCV's (N, 1) uint8 mask as (N,) bool; no model found means no verdict, so nothing is rejected."""
    return np.ones(count, bool) if mask is None else mask.ravel().astype(bool)
