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

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu

from vioframe.types import Float, Int

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

    ``root`` (E, 4, 4) are the square roots L^T of the information of [z turn].
    """

    i: Int
    j: Int
    z: Float
    turn: Float
    root: Float

    def __add__(self, other: Edges) -> Edges:
        pairs = ((getattr(self, name), getattr(other, name)) for name in ("i", "j", "z", "turn", "root"))
        return Edges(*(np.concatenate(pair) for pair in pairs))

    def __len__(self) -> int:
        return len(self.i)

    def select(self, which: NDArray[np.bool_]) -> Edges:
        """The edges that ``which`` (E,) marks."""
        return Edges(self.i[which], self.j[which], self.z[which], self.turn[which], self.root[which])


def root_of(cov: Float) -> Float:
    """(..., 4, 4) covariance -> L^T with L L^T its inverse."""
    return np.linalg.inv(np.linalg.cholesky(cov))


def residuals(p: Float, yaw: Float, edges: Edges) -> tuple[Float, Float, Float]:
    """(E, 4) whitened, and (E, 4, 4) their derivatives by [p yaw] of node i and of node j."""
    cos, sin = np.cos(yaw[edges.i]), np.sin(yaw[edges.i])
    zero, one = np.zeros(len(edges)), np.ones(len(edges))
    R_T = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    seen = np.einsum("eij,ej->ei", R_T, p[edges.j] - p[edges.i])
    r = np.empty((len(edges), 4))
    r[:, :3] = seen - edges.z
    turned = yaw[edges.j] - yaw[edges.i] - edges.turn
    r[:, 3] = np.arctan2(np.sin(turned), np.cos(turned))
    J_i, J_j = np.zeros((len(edges), 4, 4)), np.zeros((len(edges), 4, 4))
    J_i[:, :3, :3], J_j[:, :3, :3] = -R_T, R_T
    J_i[:, 0, 3], J_i[:, 1, 3] = seen[:, 1], -seen[:, 0]
    J_i[:, 3, 3], J_j[:, 3, 3] = -1.0, 1.0
    return np.einsum("eij,ej->ei", edges.root, r), edges.root @ J_i, edges.root @ J_j


def solve(p: Float, yaw: Float, edges: Edges) -> tuple[Float, Float]:
    """Positions (N, 3) and yaws (N,) of least squares, from a first guess; node 0 is held.

    Levenberg-Marquardt on the normal equations, which a sparse factorisation solves.
    """
    blocks = _Blocks(len(p), edges)
    damping = 1e-6
    r, J_i, J_j = residuals(p, yaw, edges)
    cost = float(np.sum(r**2))
    for _ in range(_ITERATIONS):
        step = -blocks.factorised(J_i, J_j, damping).solve(blocks.gradient(r, J_i, J_j)).reshape(-1, 4)
        new_p, new_yaw = p.copy(), yaw.copy()
        new_p[1:], new_yaw[1:] = p[1:] + step[:, :3], yaw[1:] + step[:, 3]
        new = residuals(new_p, new_yaw, edges)
        new_cost = float(np.sum(new[0] ** 2))
        if new_cost > cost:
            damping *= 10.0
            if damping > _MAX_DAMPING:
                break
            continue
        done = cost - new_cost <= _CONVERGED * cost
        p, yaw, (r, J_i, J_j), cost = new_p, new_yaw, new, new_cost
        damping *= 0.1
        if done:
            break
    return p, yaw


def uncertainty(p: Float, yaw: Float, edges: Edges, of: Edges) -> Float:
    """(M, 4, 4) covariance of what the edges ``of`` measure, by the solution of ``edges``; whitened as ``of`` are."""
    _, J_i, J_j = residuals(p, yaw, edges)
    factor = _Blocks(len(p), edges).factorised(J_i, J_j, 0.0)
    _, J_i, J_j = residuals(p, yaw, of)
    cov = np.empty((len(of), 4, 4))
    for begin in range(0, len(of), _AT_A_TIME):
        part = slice(begin, begin + _AT_A_TIME)
        count = len(of.i[part])
        # The rows of the Jacobian as columns: (4 N, 4 count).
        J_T = np.zeros((len(p), 4, count, 4))
        number = np.arange(count)
        J_T[of.i[part], :, number] += J_i[part].transpose(0, 2, 1)
        J_T[of.j[part], :, number] += J_j[part].transpose(0, 2, 1)
        columns = J_T[1:].reshape(4 * (len(p) - 1), 4 * count)
        solved = factor.solve(columns).reshape(-1, count, 4)
        cov[part] = np.einsum("nka,nkb->kab", columns.reshape(-1, count, 4), solved)
    return cov


class _Blocks:
    """Where the blocks of the normal equations go, which does not change between iterations; node 0 has none."""

    def __init__(self, nodes: int, edges: Edges) -> None:
        self._size, self._i, self._j = 4 * nodes, edges.i, edges.j
        block = np.arange(4)
        rows_i, rows_j = 4 * edges.i[:, None] + block, 4 * edges.j[:, None] + block
        pairs = [(a, b) for a in (rows_i, rows_j) for b in (rows_i, rows_j)]
        self._rows = np.concatenate([np.repeat(a, 4, axis=1).ravel() for a, _ in pairs])
        self._columns = np.concatenate([np.tile(b, 4).ravel() for _, b in pairs])

    def factorised(self, J_i: Float, J_j: Float, damping: float) -> SuperLU:
        """The factors of J^T J, its diagonal raised by the part ``damping``."""
        blocks = [np.einsum("eki,ekj->eij", a, b).ravel() for a in (J_i, J_j) for b in (J_i, J_j)]
        whole = csc_array((np.concatenate(blocks), (self._rows, self._columns)), shape=(self._size, self._size))
        H = whole[4:, 4:].tocsc()
        H.setdiag(H.diagonal() * (1.0 + damping))
        return splu(H, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def gradient(self, r: Float, J_i: Float, J_j: Float) -> Float:
        """(4 (N - 1),) J^T r."""
        g = np.zeros((self._size // 4, 4))
        np.add.at(g, self._i, np.einsum("eki,ek->ei", J_i, r))
        np.add.at(g, self._j, np.einsum("eki,ek->ei", J_j, r))
        return g.ravel()[4:]


def solve_robustly(
    p: Float, odometry: Edges, loops: Edges, trusted: NDArray[np.bool_], gate: float
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Positions (N, 3), yaws (N,) and which of the ``loops`` (L,) were believed.

    ``p`` (N, 3) are the positions by the odometry alone. The ``trusted`` loops (L,) are used until they prove wrong,
    the others only if they agree with what came of those: lie within ``gate``, a squared Mahalanobis distance.
    """
    used = trusted.copy()
    q, yaw = _eliminate(p, odometry, loops, used, gate)
    doubted = ~used
    if doubted.any() and used.any():
        edges, asked = odometry + loops.select(used), loops.select(doubted)
        r = residuals(q, yaw, asked)[0]
        cov = np.eye(4) + uncertainty(q, yaw, edges, asked)
        used[doubted] = _squares(r, cov) < gate
        if used[doubted].any():
            q, yaw = _eliminate(p, odometry, loops, used, gate)
    return q, yaw, used


def _eliminate(p: Float, odometry: Edges, loops: Edges, used: NDArray[np.bool_], gate: float) -> tuple[Float, Float]:
    """Solve, and let go of the loops that the rest contradicts (``used`` is changed) until there are none."""
    q, yaw = p, np.zeros(len(p))
    while used.any():
        chosen = loops.select(used)
        edges = odometry + chosen
        q, yaw = solve(q, yaw, edges)
        r = residuals(q, yaw, chosen)[0]
        rest = np.linalg.inv(np.eye(4) - uncertainty(q, yaw, edges, chosen))
        squares = np.einsum("ei,eij,ej->e", r, rest, r)
        if squares.max() < gate:
            return q, yaw
        used[np.flatnonzero(used)[squares > max(gate, _WORST * squares.max())]] = False
    return p, np.zeros(len(p))


def _squares(r: Float, cov: Float) -> Float:
    return np.asarray(np.einsum("ei,ei->e", r, np.linalg.solve(cov, r[..., None])[..., 0]))
