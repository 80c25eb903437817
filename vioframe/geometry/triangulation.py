"""Where a landmark is, given the cameras that saw it: a linear solution, then Levenberg-Marquardt in inverse depth."""

import math

import numpy as np

from vioframe.arrays import Float
from vioframe.geometry.kernels import inverse_cholesky, product, set_matrix, set_vector, turned
from vioframe.jit import kernel

MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 60.0
_ITERATIONS = 5


@kernel
def triangulate(R_WC: Float, p_WC: Float, xy: Float, sigma: float) -> tuple[bool, Float]:
    """(m, 3, 3), (m, 3) camera poses and (m, 2) points on their z = 1 planes -> (whether it can be trusted, (3,) p_WF).

    ``sigma`` is the standard deviation of the points. A position is trusted where the depth lies within 0.1-60 m and
    the inverse depth exceeds its own standard deviation, a test that holds whatever the scale. Inverse depth in the
    first camera: Montiel, Civera, Davison (2006).
    """
    m = len(xy)
    A = np.zeros((3, 3))
    b, ray = np.zeros(3), np.empty(3)
    for i in range(m):
        for r in range(3):
            ray[r] = xy[i, 0] * R_WC[i, r, 0] + xy[i, 1] * R_WC[i, r, 1] + R_WC[i, r, 2]
        length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
        for r in range(3):
            ray[r] /= length
        along = ray[0] * p_WC[i, 0] + ray[1] * p_WC[i, 1] + ray[2] * p_WC[i, 2]
        for r in range(3):
            b[r] += p_WC[i, r] - ray[r] * along
            for c in range(3):
                A[r, c] -= ray[r] * ray[c]
            A[r, r] += 1.0
    p: Float = np.zeros(3)
    # Of nearly parallel rays A has two equal eigenvalues and a small one, which its determinant tells.
    W = inverse_cholesky(A)
    larger = 0.5 * (A[0, 0] + A[1, 1] + A[2, 2])
    if not (W[0, 0] * W[1, 1] * W[2, 2]) ** 2 * larger**3 < 1e12:
        return False, p
    p = turned(W.T, turned(W, b))

    first = turned(R_WC[0].T, p - p_WC[0])
    if first[2] < MIN_DEPTH_M or first[2] > MAX_DEPTH_M:
        return False, p
    theta = np.array([first[0] / first[2], first[1] / first[2], 1.0 / first[2]])

    # Poses relative to the first camera: p_Ci = R_i p_C0 + t_i.
    R = np.empty((m, 3, 3))
    t = np.empty((m, 3))
    for i in range(m):
        set_matrix(R[i], product(R_WC[i].T, R_WC[0]))
        set_vector(t[i], turned(R_WC[i].T, p_WC[0] - p_WC[i]))
    damping = 1e-3
    cost, N, g = _normal_equations(R, t, xy, theta)
    if cost == np.inf:  # behind one of the cameras: nothing to start from
        return False, p
    for _ in range(_ITERATIONS):
        damped = N.copy()
        for k in range(3):
            damped[k, k] *= 1.0 + damping
        W = inverse_cholesky(damped)
        trial = theta - turned(W.T, turned(W, g))
        trial_cost, trial_N, trial_g = _normal_equations(R, t, xy, trial)
        if trial_cost < cost:
            converged = cost - trial_cost < 1e-6 * cost
            theta, cost, N, g = trial, trial_cost, trial_N, trial_g
            damping *= 0.1
            if converged:
                break
        else:
            damping *= 10.0

    if not (theta[2] > 1.0 / MAX_DEPTH_M and theta[2] < 1.0 / MIN_DEPTH_M):
        return False, p
    first = np.array([theta[0], theta[1], 1.0]) / theta[2]
    for i in range(1, m):
        if R[i, 2, 0] * first[0] + R[i, 2, 1] * first[1] + R[i, 2, 2] * first[2] + t[i, 2] < MIN_DEPTH_M:
            return False, p
    # The last of the inverse's diagonal is the square of that of its factor.
    if not theta[2] >= sigma * inverse_cholesky(N)[2, 2]:
        return False, p
    return True, turned(R_WC[0], first) + p_WC[0]


@kernel
def _normal_equations(R: Float, t: Float, xy: Float, theta: Float) -> tuple[float, Float, Float]:
    """Squared reprojection error on the z = 1 planes, its Gauss-Newton matrix and gradient over [a b rho]."""
    N = np.zeros((3, 3))
    g = np.zeros(3)
    cost = 0.0
    J, q = np.empty((2, 3)), np.empty(3)
    for i in range(len(xy)):
        # rho * p_Ci, so that the projection needs no division by the inverse depth.
        for k in range(3):
            q[k] = theta[0] * R[i, k, 0] + theta[1] * R[i, k, 1] + R[i, k, 2] + theta[2] * t[i, k]
        if q[2] < 1e-6:
            return np.inf, N, g
        x, y = q[0] / q[2], q[1] / q[2]
        for k in range(3):
            d0 = t[i, 0] if k == 2 else R[i, 0, k]
            d1 = t[i, 1] if k == 2 else R[i, 1, k]
            d2 = t[i, 2] if k == 2 else R[i, 2, k]
            J[0, k] = (d0 - x * d2) / q[2]
            J[1, k] = (d1 - y * d2) / q[2]
        e0, e1 = x - xy[i, 0], y - xy[i, 1]
        cost += e0 * e0 + e1 * e1
        for r in range(3):
            g[r] += J[0, r] * e0 + J[1, r] * e1
            for c in range(3):
                N[r, c] += J[0, r] * J[0, c] + J[1, r] * J[1, c]
    return cost, N, g
