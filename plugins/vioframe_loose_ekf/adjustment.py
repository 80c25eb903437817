"""Local bundle adjustment: the newest keyframes and all points brought to agree, the oldest keyframes held.

Levenberg-Marquardt with Cauchy's loss, the points eliminated by the Schur complement (Triggs et al., "Bundle
Adjustment: A Modern Synthesis", 2000, section 6.1). The keyframes held, and nothing else, keep the map's scale: what
they leave open is the drift that the filter allows for.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.geometry.kernels import exp
from vioframe.jit import kernel
from vioframe.types import Float
from vioframe_loose_ekf.measurement import VisionPose
from vioframe_loose_ekf.reprojection import cauchy, reproject
from vioframe_loose_ekf.vision_map import VisionMap

_WIDTH = 2.0
"""Of Cauchy's loss, standard deviations."""
_RELATIVE_DECREASE = 1e-3
_LARGEST_DAMPING = 1e4
# A point that is off by more than this on average is no point, standard deviations.
_LARGEST_ERROR = 3.0
# Cost of a point behind a camera, squared standard deviations.
_BEHIND = 1e6


def adjust(scene: VisionMap, sigma: float, held: int, iterations: int) -> None:
    """Improve the map ``scene`` in place, its ``held`` oldest keyframes fixed; points that do not fit are dropped.

    ``sigma`` is the noise on the z = 1 plane.
    """
    xy = scene.sightings(scene.ids)
    R_VC, p_VC = scene.poses()
    R_VC, p_VC, p_VF, error = _adjust(R_VC, p_VC, scene.p_VF, xy, sigma, held, iterations)
    scene.keyframes = [
        replace(keyframe, pose=VisionPose(R, p)) for keyframe, R, p in zip(scene.keyframes, R_VC, p_VC, strict=True)
    ]
    scene.p_VF = p_VF
    scene.keep(error < _LARGEST_ERROR)


@kernel
def _adjust(
    R: Float, p: Float, points: Float, xy: Float, sigma: float, held: int, iterations: int
) -> tuple[Float, Float, Float, Float]:
    """Rotations (K, 3, 3), positions (K, 3) and points (L, 3) that fit ``xy`` (K, L, 2); mean errors (L,) in sigma."""
    damping = 1e-4
    cost = _cost(R, p, points, xy, sigma)
    for _ in range(iterations):
        step, point_step = _solve(R, p, points, xy, sigma, held, damping)
        R_trial = R.copy()
        p_trial = p.copy()
        for k in range(len(step)):
            R_trial[held + k] = R[held + k] @ exp(step[k, :3])
            p_trial[held + k] = p[held + k] + step[k, 3:]
        trial = points + point_step
        trial_cost = _cost(R_trial, p_trial, trial, xy, sigma)
        if trial_cost < cost:
            decrease = 1.0 - trial_cost / cost
            R, p, points, cost = R_trial, p_trial, trial, trial_cost
            damping *= 0.1
            if decrease < _RELATIVE_DECREASE:
                break
        else:
            damping *= 100.0
            if damping > _LARGEST_DAMPING:
                break
    return R, p, points, _mean_errors(R, p, points, xy, sigma)


@kernel
def _solve(
    R: Float, p: Float, points: Float, xy: Float, sigma: float, held: int, damping: float
) -> tuple[Float, Float]:
    """The damped Gauss-Newton step of the free poses (K - held, 6) and of the points (L, 3)."""
    K, L = xy.shape[0], xy.shape[1]
    free = K - held
    S = np.zeros((6 * free, 6 * free))
    b = np.zeros(6 * free)
    W = np.zeros((L, free, 6, 3))
    V_inverse = np.zeros((L, 3, 3))
    c = np.zeros((L, 3))
    e = np.empty(2)
    J = np.empty((2, 6))
    for i in range(L):
        V = np.zeros((3, 3))
        for k in range(K):
            if np.isnan(xy[k, i, 0]) or not reproject(R[k], p[k], points[i], xy[k, i], sigma, e, J):
                continue
            _, weight = cauchy(e[0] * e[0] + e[1] * e[1], _WIDTH)
            A = J[:, 3:]
            for r in range(3):
                c[i, r] -= weight * (A[0, r] * e[0] + A[1, r] * e[1])
                for s in range(3):
                    V[r, s] += weight * (A[0, r] * A[0, s] + A[1, r] * A[1, s])
            if k < held:
                continue
            at = 6 * (k - held)
            for r in range(6):
                b[at + r] += weight * (J[0, r] * e[0] + J[1, r] * e[1])
                for s in range(6):
                    S[at + r, at + s] += weight * (J[0, r] * J[0, s] + J[1, r] * J[1, s])
                for s in range(3):
                    W[i, k - held, r, s] = -weight * (J[0, r] * A[0, s] + J[1, r] * A[1, s])
        for r in range(3):
            V[r, r] = (1.0 + damping) * V[r, r] + 1e-9
        V_inverse[i] = np.linalg.inv(V)
    for r in range(6 * free):
        S[r, r] = (1.0 + damping) * S[r, r] + 1e-9
    for i in range(L):
        for k in range(free):
            if W[i, k, 3, 0] == 0.0 and W[i, k, 3, 1] == 0.0:
                continue  # not seen there
            Y = W[i, k] @ V_inverse[i]
            b[6 * k : 6 * k + 6] -= Y @ c[i]
            for m in range(k, free):
                S[6 * k : 6 * k + 6, 6 * m : 6 * m + 6] -= Y @ W[i, m].T
    for r in range(6 * free):
        for s in range(r):
            S[r, s] = S[s, r]
    step = -np.linalg.solve(S, b).reshape(free, 6)
    point_step = np.empty((L, 3))
    for i in range(L):
        g = c[i].copy()
        for k in range(free):
            g += W[i, k].T @ step[k]
        point_step[i] = -V_inverse[i] @ g
    return step, point_step


@kernel
def _cost(R: Float, p: Float, points: Float, xy: Float, sigma: float) -> float:
    e = np.empty(2)
    J = np.empty((2, 6))
    total = 0.0
    for k in range(xy.shape[0]):
        for i in range(xy.shape[1]):
            if np.isnan(xy[k, i, 0]):
                continue
            squared = _BEHIND
            if reproject(R[k], p[k], points[i], xy[k, i], sigma, e, J):
                squared = e[0] * e[0] + e[1] * e[1]
            loss, _ = cauchy(squared, _WIDTH)
            total += loss
    return total


@kernel
def _mean_errors(R: Float, p: Float, points: Float, xy: Float, sigma: float) -> Float:
    """(L,) mean distance of each point's projections from where it was seen, in sigma; infinite where it cannot be."""
    e = np.empty(2)
    J = np.empty((2, 6))
    out = np.empty(xy.shape[1])
    for i in range(xy.shape[1]):
        total, views = 0.0, 0
        for k in range(xy.shape[0]):
            if np.isnan(xy[k, i, 0]):
                continue
            if not reproject(R[k], p[k], points[i], xy[k, i], sigma, e, J):
                total = np.inf
                break
            total += np.sqrt(e[0] * e[0] + e[1] * e[1])
            views += 1
        out[i] = total / max(views, 1)
    return out
