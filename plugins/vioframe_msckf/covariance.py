"""The covariance's algebra: symmetric products once, and only where something is.

``P`` (n, n) is symmetric throughout, and stored whole, row by row.
"""

from __future__ import annotations

import numpy as np

from vioframe import lapack
from vioframe.errors import DivergedError
from vioframe.jit import kernel
from vioframe.types import Float, Int


def reduce(P: Float, HP: Float, S: Float, residual: Float) -> Float:
    """Take from ``P`` in place what a measurement tells, and return the correction (n,).

    ``HP`` (m, n) is its Jacobian times ``P``, and ``S`` (m, m) the covariance of the innovation ``residual`` (m,); all
    three are used up. In square-root form, P -= W^T W with W = L^-1 H P and S = L L^T, which keeps ``P`` symmetric.
    Raises :class:`DivergedError` where S is not positive.
    """
    L, bad = lapack.dpotrf(S, lower=1, overwrite_a=1)
    if bad or not np.isfinite(residual).all():
        raise DivergedError("the innovation covariance is not positive definite")
    # BLAS counts by columns: what is transposed here, it sees as it is.
    W_T = lapack.dtrsm(1.0, L, HP.T, side=1, lower=1, trans_a=1, overwrite_b=1)
    white = lapack.dtrsm(1.0, L, residual[:, None], lower=1)[:, 0]
    lapack.dsyrk(-1.0, W_T, beta=1.0, c=P.T, lower=1, overwrite_c=1)
    _mirror(P)
    return np.asarray(W_T @ white)


@kernel
def _mirror(P: Float) -> None:
    """The upper triangle, by rows, to the lower one."""
    n, block = len(P), 32
    for first_row in range(0, n, block):
        for first_column in range(first_row, n, block):
            for i in range(first_row, min(first_row + block, n)):
                for j in range(max(first_column, i + 1), min(first_column + block, n)):
                    P[j, i] = P[i, j]


@kernel
def inserted(P: Float, at: int, cross: Float, block: Float) -> Float:
    """``P`` with rows and columns ``cross`` (k, n) and ``block`` (k, k) inserted before index ``at``."""
    n, k = len(P), len(block)
    out = np.empty((n + k, n + k))
    for i in range(n):
        row = out[i if i < at else i + k]
        for j in range(at):
            row[j] = P[i, j]
        for j in range(k):
            row[at + j] = cross[j, i]
        for j in range(at, n):
            row[j + k] = P[i, j]
    for i in range(k):
        row = out[at + i]
        for j in range(at):
            row[j] = cross[i, j]
        for j in range(k):
            row[at + j] = 0.5 * (block[i, j] + block[j, i])
        for j in range(at, n):
            row[j + k] = cross[i, j]
    return out


@kernel
def only(P: Float, keep: Int) -> Float:
    """The rows and columns ``keep`` of ``P``."""
    m = len(keep)
    out = np.empty((m, m))
    for i in range(m):
        for j in range(m):
            out[i, j] = P[keep[i], keep[j]]
    return out


@kernel(inlined=True)
def add(out: Float, factor: float, row: Float) -> None:
    """Add ``factor`` times ``row`` to ``out``."""
    for j in range(len(out)):
        out[j] += factor * row[j]


@kernel
def landmark_innovation(
    P: Float, blocks: Float, cameras: Int, of_camera: int, clone: int, landmarks: Int, variance: float
) -> tuple[Float, Float]:
    """H P (2 M, n) and S (2 M, 2 M) of M sightings of landmarks of the state from one clone.

    ``blocks`` (M, 2, 25) are their Jacobians over [camera 16, clone 6, landmark 3], of which cameras have ``of_camera``
    columns; these begin at ``cameras`` (M,), ``clone`` and ``landmarks`` (M,).
    """
    n, rows = len(P), 2 * len(blocks)
    HP = np.zeros((rows, n))
    for r in range(rows):
        b, camera, own, out = blocks[r // 2, r % 2], cameras[r // 2], landmarks[r // 2], HP[r]
        for k in range(of_camera):
            add(out, b[k], P[camera + k])
        for k in range(6):
            add(out, b[16 + k], P[clone + k])
        for k in range(3):
            add(out, b[22 + k], P[own + k])
    S = np.empty((rows, rows))
    for c in range(rows):
        b, camera, own = blocks[c // 2, c % 2], cameras[c // 2], landmarks[c // 2]
        for r in range(c, rows):
            total = 0.0
            for k in range(of_camera):
                total += HP[r, camera + k] * b[k]
            for k in range(6):
                total += HP[r, clone + k] * b[16 + k]
            for k in range(3):
                total += HP[r, own + k] * b[22 + k]
            S[r, c] = S[c, r] = total
        S[c, c] += variance
    return HP, S


@kernel
def distances(S: Float, residual: Float) -> Float:
    """(M,) the squared Mahalanobis distance of each pair of rows, by its own block of ``S`` (2 M, 2 M)."""
    out = np.empty(len(S) // 2)
    for i in range(len(out)):
        a, b, c = S[2 * i, 2 * i], S[2 * i, 2 * i + 1], S[2 * i + 1, 2 * i + 1]
        x, y = residual[2 * i], residual[2 * i + 1]
        out[i] = (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b)
    return out
