"""The pose graph over x, y, z and yaw, and its least-squares solution; ``docs/derivations/pose_graph.md``.

Roll and pitch are not touched: gravity tells them, and the odometry knows them without drift (Qin, Li, Shen, T-RO 2018,
section VII). A node is the position ``p`` (3,) m of a keyframe and its ``yaw``, by which the attitude that the odometry
gave it is turned: ``R_WB = R_z(yaw) R_WB_odometry``. An edge says where j is, seen from i::

    r = L^T [R_z(yaw_i)^T (p_j - p_i) - z ; yaw_j - yaw_i - turn],    L L^T the inverse of its covariance
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from vioframe.types import Float, Int

_ITERATIONS = 50
_CONVERGED = 1e-6


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


def solve(p: Float, yaw: Float, edges: Edges, weights: Float) -> tuple[Float, Float]:
    """Positions (N, 3) and yaws (N,) that minimise the weighted squares, from a first guess; node 0 is held.

    Levenberg-Marquardt on the normal equations, which a sparse factorisation solves. ``weights`` (E,) are those of the
    squared residuals.
    """
    structure = _Structure(len(p), edges)
    damping = 1e-6
    r, J_i, J_j = residuals(p, yaw, edges)
    cost = _cost(r, weights)
    for _ in range(_ITERATIONS):
        step = structure.step(r, J_i, J_j, weights, damping)
        new_p, new_yaw = p + step[:, :3], yaw + step[:, 3]
        new = residuals(new_p, new_yaw, edges)
        new_cost = _cost(new[0], weights)
        if new_cost > cost:
            damping = max(10.0 * damping, 1e-6)
            if damping > 1e6:
                break
            continue
        done = cost - new_cost <= _CONVERGED * cost
        p, yaw, (r, J_i, J_j), cost = new_p, new_yaw, new, new_cost
        damping *= 0.1
        if done:
            break
    return p, yaw


def _cost(r: Float, weights: Float) -> float:
    return float(weights @ np.sum(r**2, axis=1))


class _Structure:
    """Where the blocks of the normal equations go, which does not change between iterations."""

    def __init__(self, nodes: int, edges: Edges) -> None:
        self._size, self._i, self._j = 4 * nodes, edges.i, edges.j
        block = np.arange(4)
        row_of = {"i": 4 * edges.i[:, None] + block, "j": 4 * edges.j[:, None] + block}
        pairs = (("i", "i"), ("i", "j"), ("j", "i"), ("j", "j"))
        self._rows = np.concatenate([np.repeat(row_of[a], 4, axis=1).ravel() for a, _ in pairs])
        self._columns = np.concatenate([np.tile(row_of[b], 4).ravel() for _, b in pairs])

    def step(self, r: Float, J_i: Float, J_j: Float, weights: Float, damping: float) -> Float:
        """(N, 4) the damped Gauss-Newton step; zero for node 0."""
        WJ_i, WJ_j = weights[:, None, None] * J_i, weights[:, None, None] * J_j
        blocks = [np.einsum("eki,ekj->eij", a, b) for a in (WJ_i, WJ_j) for b in (J_i, J_j)]
        H = csc_array(
            (np.concatenate([block.ravel() for block in blocks]), (self._rows, self._columns)),
            shape=(self._size, self._size),
        )
        g = np.zeros((self._size // 4, 4))
        np.add.at(g, self._i, np.einsum("eki,ek->ei", WJ_i, r))
        np.add.at(g, self._j, np.einsum("eki,ek->ei", WJ_j, r))
        free = H[4:, 4:]
        free.setdiag(free.diagonal() * (1.0 + damping))
        out = np.zeros(self._size)
        factor = splu(free.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        out[4:] = -factor.solve(g.ravel()[4:])
        return out.reshape(-1, 4)
