"""The pose graph over x, y, z and yaw, and its least-squares solution; ``docs/derivations/pose_graph.md``.

Roll and pitch are not touched: gravity tells them, and the odometry knows them without drift (Qin, Li, Shen, T-RO 2018,
section VII). A node is the position ``p`` (3,) m of a keyframe and its ``yaw``, by which the attitude that the odometry
gave it is turned: ``R_WB = R_z(yaw) R_WB_odometry``. An edge says where j is, seen from i::

    r = L^T [R_z(yaw_i)^T (p_j - p_i) - z ; yaw_j - yaw_i - turn],    L L^T the inverse of its covariance

Some loops may be wrong: each must agree with all that the others and the odometry say.

The residual that is left in the solution cannot tell: an odometry that drifts is soft, and bends to wherever a wrong
loop wants it. What tells is how far the loop lies from where the rest of the graph, without it, has its two keyframes.
That innovation need not be computed by leaving out one loop after the other. With r the residual that is left and S the
covariance of what the loop measures in the solution with it, both whitened, its squared Mahalanobis distance is
``r^T (I - S)^-1 r``; ``docs/derivations/pose_graph.md``, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import SuperLU, splu

from vioframe.arrays import Bool
from vioframe.geometry.so3 import rotation_z
from vioframe.quantiles import chi2_quantile
from vioframe.types import Float, Int

GATE = float(chi2_quantile(0.999, 4))
"""Squared Mahalanobis distance in [x y z yaw] that a correct loop stays below in 999 of 1000 cases."""

_ITERATIONS = 50
_CONVERGED = 1e-6
_MAX_DAMPING = 1e6
# Edges whose uncertainty is solved for at once: the right-hand sides are dense.
_AT_A_TIME = 64
# A wrong loop bends the graph, so that right ones disagree with it as well: only the worst are let go at a time.
_WORST = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """E edges: ``i`` (E,) and ``j`` (E,) their nodes, ``z`` (E, 3) m and ``turn`` (E,) rad the measurements.

    ``cov`` (E, 4, 4) are the covariances of [z turn].
    """

    i: Int
    j: Int
    z: Float
    turn: Float
    cov: Float

    def __add__(self, other: Edges) -> Edges:
        return Edges(*(np.concatenate([getattr(self, f.name), getattr(other, f.name)]) for f in fields(self)))

    def __len__(self) -> int:
        return len(self.i)

    def select(self, which: Bool | Int) -> Edges:
        """The edges that ``which`` marks (E,) or numbers."""
        return Edges(*(getattr(self, f.name)[which] for f in fields(self)))


def residuals(p: Float, yaw: Float, edges: Edges) -> tuple[Float, Float, Float]:
    """(E, 4) whitened, and (E, 4, 4) their derivatives by [p yaw] of node i and of node j."""
    R_T = np.swapaxes(rotation_z(yaw[edges.i]), 1, 2)
    seen = np.einsum("eij,ej->ei", R_T, p[edges.j] - p[edges.i])
    r = np.column_stack([seen - edges.z, wrapped(yaw[edges.j] - yaw[edges.i] - edges.turn)])
    J_i, J_j = np.zeros((len(edges), 4, 4)), np.zeros((len(edges), 4, 4))
    J_i[:, :3, :3], J_j[:, :3, :3] = -R_T, R_T
    J_i[:, 0, 3], J_i[:, 1, 3] = seen[:, 1], -seen[:, 0]
    J_i[:, 3, 3], J_j[:, 3, 3] = -1.0, 1.0
    root = np.linalg.inv(np.linalg.cholesky(edges.cov))  # L^T with L L^T the information
    return np.einsum("eij,ej->ei", root, r), root @ J_i, root @ J_j


def solve(p: Float, yaw: Float, edges: Edges) -> tuple[Float, Float]:
    """Positions (N, 3) and yaws (N,) of least squares, from a first guess; node 0 is held.

    Levenberg-Marquardt on the normal equations, which a sparse factorisation solves.
    """
    damping = 1e-6
    r, *blocks = residuals(p, yaw, edges)
    cost = float(np.sum(r**2))
    for _ in range(_ITERATIONS):
        J = _jacobian(len(p), edges, *blocks)
        step = np.zeros((len(p), 4))
        step[1:] = -_factorised(J, damping).solve(J.T @ r.ravel()).reshape(-1, 4)
        new_p, new_yaw = p + step[:, :3], yaw + step[:, 3]
        new_r, *new_blocks = residuals(new_p, new_yaw, edges)
        new_cost = float(np.sum(new_r**2))
        if new_cost > cost:
            damping *= 10.0
            if damping > _MAX_DAMPING:
                break
            continue
        done = cost - new_cost <= _CONVERGED * cost
        p, yaw, r, blocks, cost = new_p, new_yaw, new_r, new_blocks, new_cost
        damping *= 0.1
        if done:
            break
    return p, yaw


def uncertainty(p: Float, yaw: Float, edges: Edges, of: Edges) -> Float:
    """(M, 4, 4) covariance of what the edges ``of`` measure, by the solution of ``edges``; whitened as ``of`` are."""
    factor = _factorised(_jacobian(len(p), edges, *residuals(p, yaw, edges)[1:]), 0.0)
    J = _jacobian(len(p), of, *residuals(p, yaw, of)[1:])
    cov = np.empty((len(of), 4, 4))
    for begin in range(0, len(of), _AT_A_TIME):
        rows_T = J[4 * begin : 4 * (begin + _AT_A_TIME)].T.toarray()
        blocks = (rows_T.shape[0], -1, 4)
        cov[begin : begin + _AT_A_TIME] = np.einsum(
            "nka,nkb->kab", rows_T.reshape(blocks), factor.solve(rows_T).reshape(blocks)
        )
    return cov


def _jacobian(nodes: int, edges: Edges, J_i: Float, J_j: Float) -> csr_array:
    """(4 E, 4 (N - 1)) of its blocks by node i and by node j; node 0, which is held, has no columns."""
    blocks = np.stack([J_i, J_j], axis=1).reshape(-1, 4, 4)
    columns = np.column_stack([edges.i, edges.j]).ravel()
    starts = 2 * np.arange(len(edges) + 1)
    return bsr_array((blocks, columns, starts), shape=(4 * len(edges), 4 * nodes)).tocsr()[:, 4:]


def _factorised(J: csr_array, damping: float) -> SuperLU:
    """The factors of J^T J, its diagonal raised by the part ``damping``."""
    H = (J.T @ J).tocsc()
    H.setdiag(H.diagonal() * (1.0 + damping))
    return splu(H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})


def solve_robustly(p: Float, odometry: Edges, loops: Edges, trusted: Bool) -> tuple[Float, Float, Bool]:
    """Positions (N, 3), yaws (N,) and which of the ``loops`` (L,) were believed.

    ``p`` (N, 3) are the positions by the odometry alone. The ``trusted`` loops (L,) are used until they prove wrong,
    the others only if they agree with what came of those.
    """
    used = trusted.copy()
    q, yaw = _eliminate(p, odometry, loops, used)
    doubted = ~used
    if doubted.any() and used.any():
        edges, asked = odometry + loops.select(used), loops.select(doubted)
        cov = np.eye(4) + uncertainty(q, yaw, edges, asked)
        used[doubted] = mahalanobis_squared(residuals(q, yaw, asked)[0], cov) < GATE
        if used[doubted].any():
            q, yaw = _eliminate(p, odometry, loops, used)
    return q, yaw, used


def _eliminate(p: Float, odometry: Edges, loops: Edges, used: Bool) -> tuple[Float, Float]:
    """Solve, and let go of the loops that the rest contradicts (``used`` is changed) until there are none."""
    q, yaw = p, np.zeros(len(p))
    while used.any():
        chosen = loops.select(used)
        edges = odometry + chosen
        q, yaw = solve(q, yaw, edges)
        left = np.eye(4) - uncertainty(q, yaw, edges, chosen)
        squares = mahalanobis_squared(residuals(q, yaw, chosen)[0], left)
        if squares.max() < GATE:
            return q, yaw
        used[np.flatnonzero(used)[squares > max(GATE, _WORST * squares.max())]] = False
    return p, np.zeros(len(p))


def mahalanobis_squared(error: Float, cov: Float) -> Float:
    """(E,) of errors (E, 4) with covariances (E, 4, 4)."""
    return np.asarray(np.einsum("ei,ei->e", error, np.linalg.solve(cov, error[..., None])[..., 0]))


def wrapped(angle: Float) -> Float:
    """The same angles (...,) rad within -pi and pi."""
    return np.arctan2(np.sin(angle), np.cos(angle))
