"""Levenberg-Marquardt over the factors of a window (Madsen, Nielsen, Tingleff, "Methods for non-linear least squares",
2004)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from vioframe import lapack
from vioframe.arrays import Float, Int
from vioframe.estimation.factors.problem import Normal, Problem, Variables, symmetric
from vioframe.jit import kernel
from vioframe.stopwatch import working_s

# Relative to the diagonal, beside which what is known of a whole window's scale or speed is little: it starts small.
_FIRST_DAMPING, _LEAST_DAMPING, _LARGEST_DAMPING = 1e-8, 1e-12, 1e3


@dataclass(frozen=True, slots=True)
class Solution:
    """Where the solver came to, and the equations there; cost and errors apart, or where its last, small step began.

    ``iterations`` counts the steps it took, which may not have been enough.
    """

    variables: Variables
    normal: Normal
    iterations: int
    converged: bool

    @property
    def cost(self) -> float:
        return self.normal.cost


def solve(
    problem: Problem,
    x: Variables,
    active: Int,
    max_iterations: int,
    relative_decrease: float = 1e-3,
    decrease: float = 0.0,
    max_seconds: float = 0.0,
) -> Solution:
    """Minimise from ``x`` over the entries ``active`` of the error vector; the others stay.

    It has converged where a step lowers the cost by less than ``decrease`` or, as a part of it, ``relative_decrease``;
    one that promises less than half of ``decrease`` is the last, and the equations are not set up again.
    ``max_seconds`` ends it early, where it is not zero. Raises ``LinAlgError`` where nothing finite comes out.
    """
    begin_s = working_s()
    damping, growth, normal = _FIRST_DAMPING, 2.0, problem.linearise(x)
    for iteration in range(max_iterations):
        while True:
            step, landmark_step = _step(normal, active, damping)
            promised = -0.5 * float(normal.b @ step + (normal.c * landmark_step).sum())
            trial = x.retract(step, landmark_step)
            # Robust losses give more than was promised; a step that is damped promises little.
            if promised < 0.5 * decrease and damping <= _FIRST_DAMPING:
                cost, errors = problem.evaluated(trial)
                if cost <= normal.cost:
                    known = replace(normal, cost=cost, errors=errors)
                    return _finite(Solution(trial, known, iteration + 1, True))
            # Nearly all steps lead down: their equations are those of the next one.
            trial_normal = problem.linearise(trial)
            if trial_normal.cost <= normal.cost:
                break
            damping, growth = growth * damping, 2.0 * growth
            if damping > _LARGEST_DAMPING or not np.isfinite(trial_normal.cost):
                # No step leads down: a minimum to rounding.
                return _finite(Solution(x, normal, iteration, bool(np.isfinite(trial_normal.cost))))
        decreased = normal.cost - trial_normal.cost
        small = decreased < max(decrease, relative_decrease * max(abs(trial_normal.cost), 1.0))
        # The damping falls the more, the better a step does what the equations promised: as Nielsen has it there.
        ratio = decreased / promised if promised > 0.0 else 0.0
        damping = max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), _LEAST_DAMPING)
        x, normal, growth = trial, trial_normal, 2.0
        if small or 0.0 < max_seconds < working_s() - begin_s:
            return _finite(Solution(x, normal, iteration + 1, small))
    return _finite(Solution(x, normal, max_iterations, False))


def _step(normal: Normal, active: Int, damping: float) -> tuple[Float, Float]:
    """Of the states and the calibration (n,), and of the landmarks (L, 3)."""
    S, g, eliminated = normal.reduced(damping)
    L, right, scale = _factored(S, g, active)
    solved, _ = lapack.dpotrs(L, right, lower=1, overwrite_b=1)
    step = np.zeros(len(g))
    step[active] = -scale * solved
    return step, normal.landmark_step(step, eliminated)


def covariance(normal: Normal, active: Int, last: int) -> Float:
    """(last, last) of the ``last`` of the unknowns that are ``active``, all of these being free."""
    S, g, _ = normal.reduced(0.0)
    L, _, scale = _factored(S, g, active)
    # The last rows of the factor are that of the equations which remain, all others being eliminated.
    cov, _ = lapack.dpotri(L[-last:, -last:], lower=1)
    return np.asarray(symmetric(cov.T) * np.outer(scale[-last:], scale[-last:]))


def _factored(S: Float, g: Float, active: Int) -> tuple[Float, Float, Float]:
    """Cholesky's factor of the ``active`` equations, of which the lower half counts, right side and scaling of both."""
    scaled, right, scale = _scaled(S, g, active)
    L, bad = lapack.dpotrf(scaled.T, lower=1, clean=0, overwrite_a=1)
    if bad:
        raise np.linalg.LinAlgError("the window's equations are not positive definite")
    return L, right, scale


@kernel
def _scaled(S: Float, g: Float, active: Int) -> tuple[Float, Float, Float]:
    """The upper half of the ``active`` equations, the right side, and the Jacobi scaling that is in both.

    The entries of S differ by many orders of magnitude.
    """
    count = len(active)
    out, right, scale = np.empty((count, count)), np.empty(count), np.empty(count)
    for u in range(count):
        scale[u] = 1.0 / math.sqrt(max(S[active[u], active[u]], 1e-12))
        right[u] = scale[u] * g[active[u]]
    for u in range(count):
        row = S[active[u]]
        for v in range(u, count):
            out[u, v] = scale[u] * scale[v] * row[active[v]]
    return out, right, scale


def _finite(solution: Solution) -> Solution:
    if not np.isfinite(solution.cost):
        raise np.linalg.LinAlgError("the window's estimate is not finite")
    return solution
