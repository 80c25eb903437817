"""The pose graph where some loops may be wrong: graduated non-convexity.

Yang, Antonante, Tzoumas, Carlone, "Graduated non-convexity for robust spatial perception" (RA-L 2020), with truncated
least squares (their section IV): a loop that the others leave further than the gate from where it would be is worth the
gate, no more, and so has no pull. That cost is not convex; it is approached from one that is, so that the loops that
agree settle the matter before the others are let go. Edges of the odometry are always believed.
"""

from __future__ import annotations

import numpy as np

from vioframe.types import Float
from vioframe_pose_graph.graph import Edges, residuals, solve

_GROWTH = 1.4
_DECIDED = 1e-3
_MAX_ROUNDS = 60


def solve_robustly(p: Float, odometry: Edges, loops: Edges, gate: float) -> tuple[Float, Float, Float]:
    """Positions (N, 3), yaws (N,) and the weights (L,) of the loops: 1 believed, 0 let go.

    ``p`` (N, 3) are the positions by the odometry alone; ``gate`` is the squared whitened residual at which a loop
    starts to be worth no more.
    """
    edges = odometry + loops
    weights = np.ones(len(edges))
    p, yaw = solve(p, np.zeros(len(p)), edges, weights)
    squares = _squares(p, yaw, loops)
    largest = float(squares.max(initial=0.0))
    if largest <= gate:
        return p, yaw, weights[len(odometry) :]
    mu = gate / (2.0 * largest - gate)
    for _ in range(_MAX_ROUNDS):
        loop_weights = _weights(squares, gate, mu)
        weights[len(odometry) :] = loop_weights
        p, yaw = solve(p, yaw, edges, weights)
        squares = _squares(p, yaw, loops)
        if np.abs(loop_weights - np.round(loop_weights)).max() < _DECIDED and mu > 1.0:
            break
        mu *= _GROWTH
    return p, yaw, loop_weights


def _squares(p: Float, yaw: Float, loops: Edges) -> Float:
    return np.asarray(np.sum(residuals(p, yaw, loops)[0] ** 2, axis=1))


def _weights(squares: Float, gate: float, mu: float) -> Float:
    """(L,) their eq. (14)."""
    between = np.sqrt(gate * mu * (mu + 1.0) / np.maximum(squares, 1e-300)) - mu
    inside, outside = squares <= mu / (mu + 1.0) * gate, squares >= (mu + 1.0) / mu * gate
    return np.where(inside, 1.0, np.where(outside, 0.0, between))
