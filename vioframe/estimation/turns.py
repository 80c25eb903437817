"""How a camera turned between frames, from its tracks alone, whatever it did beside: a gyroscope's independent twin.

For bearings f, g of one landmark in two cameras with rotation R, the normals n = f x R g of all epipolar planes are
perpendicular to the translation, whichever it is (Kneip, Lynen, "Direct Optimization of Frame-to-Frame Rotation", ICCV
2013). Works without parallax, where an essential matrix does not. Two views of a plane allow of two turns (Faugeras,
Lustman, "Motion and structure from motion in a piecewise planar environment", IJPRAI 1988); both are told then.
Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.geometry import kernels, so3
from vioframe.geometry.two_view import rays
from vioframe.jit import kernel
from vioframe.types import FrameTracks

FEWEST_TRACKS = 15
_MOST_TRACKS = 80
# Iterations and Cauchy's scale (standard deviations) of each stage.
_STAGES = np.array([[6, 20.0], [6, 5.0], [6, 2.0]])
_AS_IT_IS = np.array([[0, 2.0]])
_PRIOR, _LARGEST_STEP, _SETTLED = 0.5, 0.2, 1e-6  # rad
# Tracks are on a plane where its homography explains them to this, in standard deviations; outliers are beyond, and
# after so many samples of four tracks there is none.
_ON_PLANE, _OFF_PLANE, _SAMPLES = 0.6, 3.0, 100
# Less than this apart two turns are one, rad.
_TWO = 0.01


@dataclass(frozen=True, slots=True)
class Turn:
    """R_C1C2 (3, 3) between frames at ``t_ns`` (2,), and what tracks say of changes to it and to the focal length.

    Half the sum of squares is d' H d / 2 + b' d, about d = [dtheta, dlog f] = 0: ``H`` (4, 4) and ``b`` (4,) in terms
    of pixels of noise, R <- R Exp(dtheta). ``misfit`` is the typical distance of a track from its epipolar line, in
    standard deviations. ``other`` is the second turn that explains the tracks as well, where they lie on a plane.
    """

    t_ns: tuple[int, int]
    R_C1C2: Float
    H: Float
    b: Float
    misfit: float
    other: Turn | None = None


def turn_between(before: FrameTracks, now: FrameTracks, sigma: float, may_be_plane: bool = True) -> Turn | None:
    """From the tracks that both frames share, with noise ``sigma`` on the z = 1 plane; None where they are too few."""
    i, j = common_tracks(before, now, _MOST_TRACKS)
    if len(i) < FEWEST_TRACKS:
        return None
    f, g = rays(before.xy_normalised[i]), rays(now.xy_normalised[j])
    t_ns = before.t_ns, now.t_ns
    if may_be_plane and (on_plane := turns_before_plane(f, g, sigma)):
        first, second = (Turn(t_ns, R, *_turn(f, g, R, sigma, _AS_IT_IS)[1:]) for R in on_plane)
        return replace(first, other=second)
    # To begin with, the rotation that explains it best without moving.
    u, v = (seen / np.linalg.norm(seen, axis=1, keepdims=True) for seen in (f, g))
    R, H, b, misfit = _turn(f, g, so3.project(u.T @ v), sigma, _STAGES)
    return Turn(t_ns, R, H, b, misfit)


def turns_before_plane(f: Float, g: Float, sigma: float) -> list[Float]:
    """The two R_C1C2 by which bearings f, g (N, 3) with z = 1 are those of points on a plane; none where they are not.

    None either where both are the same, as without parallax.
    """
    import cv2

    H, _ = cv2.findHomography(g[:, :2], f[:, :2], cv2.USAC_FAST, _OFF_PLANE * sigma, None, _SAMPLES)
    if H is None:
        return []
    seen = g @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(seen[:, :2] / seen[:, 2:] - f[:, :2], axis=1)
    if not np.median(off) < _ON_PLANE * sigma:
        return []
    turns = [np.asarray(R, dtype=np.float64) for R in cv2.decomposeHomographyMat(H, np.eye(3))[1]]
    first = turns[0]
    second = max(turns, key=lambda R: np.linalg.norm(R - first))
    return [first, second] if np.linalg.norm(so3.log(first.T @ second)) > _TWO else []


def common_tracks(a: FrameTracks, b: FrameTracks, most: int) -> tuple[Int, Int]:
    """Where the tracks of both frames are in each; at most so many, spread over the age of the tracks."""
    _, i, j = np.intersect1d(a.ids, b.ids, assume_unique=True, return_indices=True)
    some = np.linspace(0, len(i) - 1, min(len(i), most)).astype(np.int64)
    return i[some], j[some]


@kernel
def _turn(f: Float, g: Float, R: Float, sigma: float, stages: Float) -> tuple[Float, Float, Float, float]:
    """From ``R`` to R_C1C2, equations of [dtheta, dlog f] there, and the typical misfit; f, g (N, 3) with z = 1."""
    weight, common = np.ones(len(f)), np.ones(len(f), dtype=np.bool_)
    H, b, distance = np.zeros((4, 4)), np.zeros(4), np.zeros(len(f))
    for s in range(len(stages)):
        for _ in range(int(stages[s, 0])):
            linearise_pair(f, g, common, R, weight, sigma, stages[s, 1], H, b, distance)
            A = H[:3, :3].copy()
            for a in range(3):
                A[a, a] += 1.0 / (_PRIOR * _PRIOR)
            L = kernels.inverse_cholesky(A)
            step = -kernels.turned(L.T, kernels.turned(L, b[:3]))
            length = _length(step)
            if length > _LARGEST_STEP:
                step *= _LARGEST_STEP / length
            R = kernels.product(R, kernels.exp(step))
            if length < _SETTLED:
                break
    linearise_pair(f, g, common, R, weight, sigma, stages[-1, 1], H, b, distance)
    return R, H, b, np.median(distance)


@kernel
def linearise_pairs(
    f: Float, g: Float, common: Bool, R_C1C2: Float, weight: Float, sigma: float, cauchy: float, distance: Float
) -> tuple[Float, Float]:
    """:func:`linearise_pair` of P pairs, (P, N, 3) and (P, 3, 3), with the tracks ``common`` (P, N): H, b of each.

    ``weight`` (P, N) and ``distance`` are filled in where there is a track.
    """
    H, b = np.zeros((len(f), 4, 4)), np.zeros((len(f), 4))
    for p in range(len(f)):
        linearise_pair(f[p], g[p], common[p], R_C1C2[p], weight[p], sigma, cauchy, H[p], b[p], distance[p])
    return H, b


@kernel
def linearise_pair(
    f: Float,
    g: Float,
    common: Bool,
    R: Float,
    weight: Float,
    sigma: float,
    cauchy: float,
    H: Float,
    b: Float,
    distance: Float,
) -> None:
    """Gauss-Newton equations ``H`` (4, 4), ``b`` (4,) of [dtheta, dlog f] for the rotation ``R`` = R_C1C2 of a pair.

    The translation is the direction that the normals, weighed by ``weight`` (N,), are most perpendicular to, and is
    eliminated. Of the bearings (N, 3) those count that are ``common`` (N,). ``weight`` becomes that of the next call,
    ``distance`` (N,) each track's from its epipolar line, in standard deviations, in which ``cauchy``, the scale of the
    robust loss, is too.
    """
    y = np.empty((len(f), 3))
    for k in range(len(f)):
        if common[k]:
            for a in range(3):
                y[k, a] = R[a, 0] * g[k, 0] + R[a, 1] * g[k, 1] + R[a, 2] * g[k, 2]
    t = _translation(f, y, R, weight, common)

    # Two directions across t.
    u = np.zeros(3)
    a = 0
    for k in range(1, 3):
        if abs(t[k]) < abs(t[a]):
            a = k
    u[a] = 1.0
    u -= t[a] * t
    u /= _length(u)
    v = kernels.cross(t, u)

    E = np.zeros((6, 6))
    e = np.zeros(6)
    J = np.empty(6)
    for k in range(len(f)):
        if not common[k]:
            continue
        g0, g1, g2 = g[k, 0], g[k, 1], g[k, 2]
        y0, y1, y2 = y[k, 0], y[k, 1], y[k, 2]
        f0, f1, f2 = f[k, 0], f[k, 1], f[k, 2]
        n0, n1, n2 = f1 * y2 - f2 * y1, f2 * y0 - f0 * y2, f0 * y1 - f1 * y0
        # d (n . t) by f: y x t; by g: R' (t x f).
        p0, p1 = y1 * t[2] - y2 * t[1], y2 * t[0] - y0 * t[2]
        c0, c1, c2 = t[1] * f2 - t[2] * f1, t[2] * f0 - t[0] * f2, t[0] * f1 - t[1] * f0
        q0 = R[0, 0] * c0 + R[1, 0] * c1 + R[2, 0] * c2
        q1 = R[0, 1] * c0 + R[1, 1] * c1 + R[2, 1] * c2
        q2 = R[0, 2] * c0 + R[1, 2] * c1 + R[2, 2] * c2
        # Sampson's distance: the residual n . t over the deviation that the noise of both points gives it.
        scale = sigma * math.sqrt(p0 * p0 + p1 * p1 + q0 * q0 + q1 * q1) + 1e-12
        r = (n0 * t[0] + n1 * t[1] + n2 * t[2]) / scale
        robust = 1.0 / (1.0 + (r / cauchy) ** 2)
        J[0], J[1], J[2] = g1 * q2 - g2 * q1, g2 * q0 - g0 * q2, g0 * q1 - g1 * q0
        J[3] = -(f0 * p0 + f1 * p1 + g0 * q0 + g1 * q1)  # a longer focal length draws bearings together
        J[4] = n0 * u[0] + n1 * u[1] + n2 * u[2]
        J[5] = n0 * v[0] + n1 * v[1] + n2 * v[2]
        for i in range(6):
            J[i] /= scale
        for i in range(6):
            e[i] += robust * J[i] * r
            for j in range(i, 6):
                E[i, j] += robust * J[i] * J[j]
        weight[k] = robust / (scale * scale)
        distance[k] = abs(r)
    # The translation is at its own minimum; its two angles, with a prior of 1 rad, are eliminated.
    d00, d01, d11 = E[4, 4] + 1.0, E[4, 5], E[5, 5] + 1.0
    det = d00 * d11 - d01 * d01
    for i in range(4):
        b[i] = e[i]
        x = (d11 * E[i, 4] - d01 * E[i, 5]) / det
        y = (d00 * E[i, 5] - d01 * E[i, 4]) / det
        for j in range(i, 4):
            H[i, j] = E[i, j] - x * E[j, 4] - y * E[j, 5]
            H[j, i] = H[i, j]


@kernel
def _add_outer(M: Float, v0: float, v1: float, v2: float, w: float) -> None:
    M[0, 0] += w * v0 * v0
    M[0, 1] += w * v0 * v1
    M[0, 2] += w * v0 * v2
    M[1, 1] += w * v1 * v1
    M[1, 2] += w * v1 * v2
    M[2, 2] += w * v2 * v2


@kernel
def likeliest_translations(f: Float, y: Float, R_C1C2: Float, weight: Float, common: Bool) -> Float:
    """(P, 3) of P pairs, see :func:`_translation`: f, y (P, N, 3), R_C1C2 (P, 3, 3), weight and common (P, N).

    Where no track counts it is along the optical axis.
    """
    t = np.zeros((len(f), 3))
    for p in range(len(f)):
        if (common[p] & (weight[p] > 0.0)).any():
            kernels.set_vector(t[p], _translation(f[p], y[p], R_C1C2[p], weight[p], common[p]))
        else:
            t[p, 2] = 1.0
    return t


@kernel
def _translation(f: Float, y: Float, R: Float, weight: Float, common: Bool) -> Float:
    """The direction that the normals of the bearings f and ``y`` = R g are most perpendicular to, as they are weighed.

    Of the tracks (N,) those count that are ``common``.
    """
    N = np.zeros((3, 3))
    S_y, S_f = np.zeros((3, 3)), np.zeros((3, 3))
    for k in range(len(f)):
        if not common[k]:
            continue
        w = weight[k]
        y0, y1, y2 = y[k, 0], y[k, 1], y[k, 2]
        f0, f1, f2 = f[k, 0], f[k, 1], f[k, 2]
        n0, n1, n2 = f1 * y2 - f2 * y1, f2 * y0 - f0 * y2, f0 * y1 - f1 * y0
        _add_outer(N, n0, n1, n2, w)
        _add_outer(S_y, y0, y1, y2, w)
        _add_outer(S_f, f0, f1, f2, w)
    for M in (N, S_y, S_f):
        M[1, 0], M[2, 0], M[2, 1] = M[0, 1], M[0, 2], M[1, 2]
    return _likeliest(N, S_y, S_f, R)


@kernel(inlined=True)
def _likeliest(N: Float, S_y: Float, S_f: Float, R: Float) -> Float:
    """The unit t that minimises t' N t over t' noise t (Kanatani 2005), N the moments of the normals n = f x y.

    Noise e across the optical axis z moves a normal by e x y, and the average of (e x y)(e x y)' over the plane is
    |y|^2 I - y y' - (z x y)(z x y)'. That of the second point lies across its own axis, R z. Plain eigenvectors are
    drawn to where noise hurts least, and the more so the smaller the parallax.
    """
    noise = np.zeros((3, 3))
    for second in range(2):
        S = S_f if second else S_y
        z = R[:, 2].copy() if second else np.array([0.0, 0.0, 1.0])
        Z = kernels.hat(z)
        Z_S_Z = kernels.product(kernels.product(Z, S), Z.T)
        for i in range(3):
            noise[i, i] += S[0, 0] + S[1, 1] + S[2, 2]
            for j in range(3):
                noise[i, j] -= S[i, j] + Z_S_Z[i, j]
    trace = noise[0, 0] + noise[1, 1] + noise[2, 2]
    for k in range(3):
        noise[k, k] += 1e-6 * trace
    W = kernels.inverse_cholesky(noise)
    t = kernels.turned(W.T, _least_eigenvector(kernels.product(kernels.product(W, N), W.T)))
    out: Float = t / _length(t)
    return out


@kernel(inlined=True)
def _length(v: Float) -> float:
    return math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])


@kernel(inlined=True)
def _least_eigenvector(A: Float) -> Float:
    """(3,) of the least eigenvalue of a symmetric A (3, 3), by Jacobi's rotations (Golub, Van Loan, 8.5)."""
    A, V = A.copy(), np.eye(3)
    for _ in range(6):
        for p, q in ((0, 1), (0, 2), (1, 2)):
            if A[p, q] == 0.0:
                continue
            tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
            t = (1.0 if tau >= 0.0 else -1.0) / (abs(tau) + math.sqrt(1.0 + tau * tau))
            c = 1.0 / math.sqrt(1.0 + t * t)
            s = t * c
            for k in range(3):
                A[k, p], A[k, q] = c * A[k, p] - s * A[k, q], s * A[k, p] + c * A[k, q]
            for k in range(3):
                A[p, k], A[q, k] = c * A[p, k] - s * A[q, k], s * A[p, k] + c * A[q, k]
            for k in range(3):
                V[k, p], V[k, q] = c * V[k, p] - s * V[k, q], s * V[k, p] + c * V[k, q]
    best = 0
    for k in range(1, 3):
        if A[k, k] < A[best, best]:
            best = k
    return V[:, best].copy()
