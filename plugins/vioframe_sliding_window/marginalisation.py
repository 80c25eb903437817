"""Letting the oldest state go: all that its factors say about the others is kept as the prior.

The Schur complement of the normal equations (Sibley, Matthies, Sukhatme, "Sliding window filter with application to
planetary landing", J. Field Robotics 2010). Derivation: ``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

import numpy as np

from vioframe.types import Float
from vioframe_sliding_window.problem import STATE_SIZE, Prior, Problem, Variables

# Eigenvalues below this part of the largest tell nothing: rounding made them.
_NULL = 1e-12


def marginalise_oldest(problem: Problem, x: Variables) -> Prior:
    """The prior on all states but the first, and calibration, that replaces all of ``problem``.

    ``problem`` holds just the factors that touch the first state. Its landmarks go with it, robust weights as they are
    at ``x``. States it touches are frozen at ``x`` unless they were before.
    """
    normal = problem.linearise(x)
    H, b, _ = normal.reduced(0.0)
    K = len(x.states)
    touched = (H[: STATE_SIZE * K].reshape(K, -1) != 0.0).any(axis=1)
    prior = problem.prior
    first = prior.first(x.states)
    # The gradient at the first estimates, from which the prior counts.
    b = b - H @ prior.difference(x)
    H, b = schur(H, b, STATE_SIZE)
    return Prior(H, b, first[1:], prior.camera, (prior.frozen | touched)[1:])


def schur(H: Float, b: Float, count: int) -> tuple[Float, Float]:
    """Equations without the first ``count`` unknowns, which are at their best for whatever the others are.

    Directions of which ``H`` knows nothing are left out by a pseudo-inverse.
    """
    m, r = slice(0, count), slice(count, None)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[m], 1e-12))
    values, U = np.linalg.eigh(H[m, m] * scale[:, None] * scale)
    good = values > _NULL * values[-1]
    half = (scale[:, None] * U[:, good]) / np.sqrt(values[good])
    Z = half.T @ H[m, r]
    reduced = H[r, r] - Z.T @ Z
    return 0.5 * (reduced + reduced.T), b[r] - Z.T @ (half.T @ b[m])
