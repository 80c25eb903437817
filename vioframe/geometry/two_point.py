"""What is an outlier between two views if a gyroscope tells the turn between them to a degree; compiled.

Derivation: ``docs/derivations/outliers.md``. Notation and equation numbers are those of
:mod:`vioframe.geometry.two_view`. Importing this module loads numba.
"""

from __future__ import annotations

from math import sqrt

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.geometry import two_view
from vioframe.geometry.kernels import cross, exp, hat, product, set_vector, turned, whiten
from vioframe.jit import kernel

# With 50 % of outliers, 50 pairs miss every clean one with a chance of 6e-7.
_PAIRS = 50
# Which they are, as shares of the number of points: drawn once, as the same matches are to give the same answer.
_FIRST, _SECOND = np.random.default_rng(20110).random((2, _PAIRS))
# Times the threshold: what may belong to a motion at first, for two refinements, and once it is nearly right, for six.
_NEAR_AT_FIRST, _NEAR = 6.0, 3.0
_REFINEMENTS_AT_FIRST, _REFINEMENTS = 2, 8
# Of the rotation, rad, and of the direction of motion, which without parallax nothing else holds: in each refinement.
_PRIOR_ROTATION, _PRIOR_DIRECTION = np.deg2rad(1.0), 1.0
# Share of points that is called few.
_FEW = 0.8
# Where the epipolar geometry vanishes on a point (both epipoles on it), it says nothing, and its distance is nought.
_NO_SLOPE = 1e-24


def two_point_inliers(xy_1: Float, xy_2: Float, R_C2C1: Float, threshold: float) -> Bool:
    """(N,) inliers to the translation direction that agrees with most points, the rotation being known to a degree.

    With the rotation given, each match confines the translation to a plane, ``(x_2 x R x_1) . p_C2C1 = 0``, and two
    matches fix its direction (Troiani et al., ICRA 2014). A gyroscope's bias turns the given rotation by a few
    milliradians, more than a pixel, so the best hypothesis is refined over its own inliers (rotation and direction,
    Gauss-Newton on the Sampson distance) before it judges. Where few agree it may be the rotation that is wrong, and
    :func:`vioframe.geometry.two_view.magsac_inliers` judges, which knows none. Needs N >= 6.
    """
    count = len(xy_1)
    first = (_FIRST * count).astype(np.int64)
    second = (first + 1 + (_SECOND * (count - 1)).astype(np.int64)) % count
    inliers = _inliers(xy_1.T.copy(), xy_2.T.copy(), R_C2C1, first, second, threshold)
    return inliers if inliers.mean() >= _FEW else two_view.magsac_inliers(xy_1, xy_2, threshold)


def warm_up() -> None:
    """Compile the kernel, or load it from the cache, so that no frame of a flight waits for it."""
    xy = np.zeros((6, 2))
    two_point_inliers(xy, xy, np.eye(3), 1.0)


@kernel
def _inliers(xy_1: Float, xy_2: Float, R_C2C1: Float, first: Int, second: Int, threshold: float) -> Bool:
    """(N,) of ``xy_1`` and ``xy_2`` (2, N); hypotheses come from the pairs ``first`` and ``second`` (P,)."""
    count = xy_1.shape[1]
    squared, near = np.empty(count), (_NEAR_AT_FIRST * threshold) ** 2
    least, direction = np.inf, np.array([0.0, 0.0, 1.0])
    for k in range(len(first)):
        hypothesis = _direction_of_two(xy_1, xy_2, R_C2C1, first[k], second[k])
        _squared_distances(_essential(R_C2C1, hypothesis), xy_1, xy_2, squared)
        # The truncated square (MSAC) tells good hypotheses apart where counts tie.
        cost = 0.0
        for i in range(count):
            cost += min(squared[i], near)
        if cost < least:
            least, direction = cost, hypothesis
    R = R_C2C1
    for k in range(_REFINEMENTS):
        if k == _REFINEMENTS_AT_FIRST:
            near = (_NEAR * threshold) ** 2
        _squared_distances(_essential(R, direction), xy_1, xy_2, squared)
        R, direction = _refined(R, direction, xy_1, xy_2, squared < near, threshold)
    _squared_distances(_essential(R, direction), xy_1, xy_2, squared)
    return squared < threshold**2


@kernel(inlined=True)
def _essential(R_C2C1: Float, direction: Float) -> Float:
    """[direction]x R (9.12), (3, 3)."""
    return product(hat(direction), R_C2C1)


@kernel
def _direction_of_two(xy_1: Float, xy_2: Float, R_C2C1: Float, i: int, j: int) -> Float:
    """(3,) of unit length, in the planes of the matches ``i`` and ``j``; straight ahead where these are one."""
    direction = cross(_normal(xy_1, xy_2, R_C2C1, i), _normal(xy_1, xy_2, R_C2C1, j))
    length = _length(direction)
    if length < 1e-15:
        return np.array([0.0, 0.0, 1.0])
    return direction / length


@kernel
def _normal(xy_1: Float, xy_2: Float, R_C2C1: Float, i: int) -> Float:
    """R x_1 x x_2 (3,), perpendicular to the translation."""
    return cross(turned(R_C2C1, np.array([xy_1[0, i], xy_1[1, i], 1.0])), np.array([xy_2[0, i], xy_2[1, i], 1.0]))


@kernel(inlined=True)
def _squared_distances(E: Float, xy_1: Float, xy_2: Float, squared: Float) -> None:
    """Fill ``squared`` (N,) with the squares of :func:`vioframe.geometry.two_view.sampson_distance`."""
    for i in range(len(squared)):
        x_1, y_1, x_2, y_2 = xy_1[0, i], xy_1[1, i], xy_2[0, i], xy_2[1, i]
        a, b, c, u, v, _ = _lines(E, x_1, y_1, x_2, y_2)
        squared[i] = (a * x_2 + b * y_2 + c) ** 2 / max(a * a + b * b + u * u + v * v, _NO_SLOPE)


@kernel(inlined=True)
def _lines(E: Float, x_1: float, y_1: float, x_2: float, y_2: float) -> tuple[float, float, float, float, float, float]:
    """E x_1 and E^T x_2, the epipolar lines in views 2 and 1."""
    a, b = E[0, 0] * x_1 + E[0, 1] * y_1 + E[0, 2], E[1, 0] * x_1 + E[1, 1] * y_1 + E[1, 2]
    u, v = E[0, 0] * x_2 + E[1, 0] * y_2 + E[2, 0], E[0, 1] * x_2 + E[1, 1] * y_2 + E[2, 1]
    c, w = E[2, 0] * x_1 + E[2, 1] * y_1 + E[2, 2], E[0, 2] * x_2 + E[1, 2] * y_2 + E[2, 2]
    return a, b, c, u, v, w


@kernel
def _refined(
    R_C2C1: Float, direction: Float, xy_1: Float, xy_2: Float, near: Bool, sigma: float
) -> tuple[Float, Float]:
    """One damped Gauss-Newton step of ``R <- R Exp(dtheta)`` and ``direction`` on the sphere, slopes held fixed.

    The damping is the prior: without parallax the direction cannot be seen, and must not run away.
    """
    E, R, across = _essential(R_C2C1, direction), R_C2C1, _across(direction)
    information, columns, J = np.zeros((5, 5)), np.zeros((5, 6)), np.empty(5)
    for k in range(5):
        information[k, k] = _PRIOR_ROTATION**-2 if k < 3 else _PRIOR_DIRECTION**-2
        columns[k, 1 + k] = 1.0
    for i in range(len(near)):
        if not near[i]:
            continue
        x_1, y_1, x_2, y_2 = xy_1[0, i], xy_1[1, i], xy_2[0, i], xy_2[1, i]
        a, b, c, u, v, w = _lines(E, x_1, y_1, x_2, y_2)
        weight = 1.0 / (sigma**2 * max(a * a + b * b + u * u + v * v, _NO_SLOPE))
        # e = x_2 . (t x R x_1): de/dtheta = x_1 x E^T x_2 and de/dt = R x_1 x x_2.
        J[0], J[1], J[2] = y_1 * w - v, u - x_1 * w, x_1 * v - y_1 * u
        q_x, q_y = R[0, 0] * x_1 + R[0, 1] * y_1 + R[0, 2], R[1, 0] * x_1 + R[1, 1] * y_1 + R[1, 2]
        q_z = R[2, 0] * x_1 + R[2, 1] * y_1 + R[2, 2]
        n_x, n_y, n_z = q_y - q_z * y_2, q_z * x_2 - q_x, q_x * y_2 - q_y * x_2
        for k in range(2):
            J[3 + k] = across[k, 0] * n_x + across[k, 1] * n_y + across[k, 2] * n_z
        error = a * x_2 + b * y_2 + c
        for k in range(5):
            weighed = weight * J[k]
            columns[k, 0] -= weighed * error
            for m in range(5):
                information[k, m] += weighed * J[m]
    # Whitened, [b I] is L^-1 [b I], and the step L^-T L^-1 b.
    whiten(information, columns)
    step = np.zeros(5)
    for k in range(5):
        for m in range(5):
            step[k] += columns[m, 1 + k] * columns[m, 0]
    moved = direction + step[3] * across[0] + step[4] * across[1]
    return product(R_C2C1, exp(step[:3])), moved / _length(moved)


@kernel
def _across(direction: Float) -> Float:
    """(2, 3), perpendicular to the unit vector ``direction`` and to each other."""
    out, axis = np.empty((2, 3)), np.zeros(3)
    least = 0
    for k in range(1, 3):
        if abs(direction[k]) < abs(direction[least]):
            least = k
    axis[least] = 1.0
    first = cross(direction, axis)
    set_vector(out[0], first / _length(first))
    set_vector(out[1], cross(direction, out[0]))
    return out


@kernel
def _length(v: Float) -> float:
    return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
