"""The pose graph where some loops may be wrong: each must agree with all that the others and the odometry say.

The residual that is left in the solution cannot tell: an odometry that drifts is soft, and bends to wherever a wrong
loop wants it. What tells is how far the loop lies from where the rest of the graph, without it, has its two keyframes.
That innovation need not be computed by leaving out one loop after the other. With r the residual that is left and S the
covariance of what the loop measures in the solution with it, both whitened, its squared Mahalanobis distance is
``r^T (I - S)^-1 r``; ``docs/derivations/pose_graph.md``, section 4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float
from vioframe_pose_graph.graph import Edges, residuals, solve, uncertainty

# A wrong loop bends the graph, so that right ones disagree with it as well: only the worst are let go at a time.
_WORST = 0.5


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
