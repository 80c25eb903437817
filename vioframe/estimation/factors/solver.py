"""Levenberg-Marquardt over the factors of a window (Madsen, Nielsen, Tingleff, "Methods for non-linear least squares",
2004)."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs

from vioframe.arrays import Float, Int
from vioframe.estimation.factors.problem import Problem, Variables

_FIRST_DAMPING, _LARGEST_DAMPING = 1e-6, 1e3


@dataclass(frozen=True, slots=True)
class Solution:
    """Where the solver came to; ``iterations`` counts the steps it took, which may not have been enough."""

    variables: Variables
    cost: float
    iterations: int
    converged: bool


def solve(
    problem: Problem,
    x: Variables,
    active: Int,
    max_iterations: int,
    relative_decrease: float = 1e-3,
    max_seconds: float = 0.0,
) -> Solution:
    """Minimise from ``x`` over the entries ``active`` of the error vector; the others stay.

    It has converged where a step lowers the cost by less than ``relative_decrease``. ``max_seconds`` ends it early,
    where it is not zero. Raises ``LinAlgError`` where nothing finite comes out.
    """
    begin_s = perf_counter()
    damping, cost = _FIRST_DAMPING, problem.cost(x)
    for iteration in range(max_iterations):
        normal = problem.linearise(x)
        while True:
            S, g, eliminated = normal.reduced(damping)
            step = np.zeros(len(g))
            step[active] = -solve_positive(S[np.ix_(active, active)], g[active])
            trial = x.retract(step, normal.landmark_step(step, eliminated))
            trial_cost = problem.cost(trial)
            if trial_cost <= cost:
                break
            damping = max(10.0 * damping, 1e-4)
            if damping > _LARGEST_DAMPING or not np.isfinite(trial_cost):
                # No step leads down: a minimum to rounding.
                return _finite(Solution(x, cost, iteration, bool(np.isfinite(trial_cost))))
        small = cost - trial_cost < relative_decrease * max(abs(trial_cost), 1.0)
        x, cost, damping = trial, trial_cost, 0.1 * damping
        if small or 0.0 < max_seconds < perf_counter() - begin_s:
            return _finite(Solution(x, cost, iteration + 1, small))
    return _finite(Solution(x, cost, max_iterations, False))


def solve_positive(S: Float, g: Float) -> Float:
    """S^-1 g for a positive definite S (n, n), g (n,) or (n, m); raises ``LinAlgError`` for any other."""
    # Jacobi scaling: the entries of S differ by many orders of magnitude.
    scale = 1.0 / np.sqrt(np.maximum(np.diag(S), 1e-12))
    L, bad = dpotrf(S * scale[:, None] * scale, lower=1, overwrite_a=1)
    if bad:
        raise np.linalg.LinAlgError("the window's equations are not positive definite")
    scaled = (scale * g.T).T
    out, _ = dpotrs(L, scaled, lower=1)
    return np.asarray((scale * out.T).T)


def _finite(solution: Solution) -> Solution:
    if not np.isfinite(solution.cost):
        raise np.linalg.LinAlgError("the window's estimate is not finite")
    return solution
