"""The way to a minimum, on a problem of two unknowns that is all valley: Rosenbrock's, ever narrower."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from vioframe.estimation.factors.solver import solve
from vioframe.types import Float

NO_LANDMARKS = np.zeros((0, 3))


@dataclass
class At:
    place: Float

    def retract(self, step: Float, landmark_step: Float) -> At:
        return At(self.place + step)


@dataclass
class Equations:
    H: Float
    b: Float
    cost: float
    c: Float

    def reduced(self, damping: float):
        return self.H + damping * np.diag(np.diag(self.H)), self.b, None

    def landmark_step(self, step: Float, eliminated: None) -> Float:
        return NO_LANDMARKS


@dataclass
class Valley:
    """The least is at (1, 1), zero; the floor y = x^2 leads there, with walls as ``steep``."""

    steep: float
    evaluations: int = 0

    def linearise(self, at: At) -> Equations:
        self.evaluations += 1
        x, y = at.place
        residual = np.array([self.steep * (y - x * x), 1.0 - x])
        J = np.array([[-2.0 * self.steep * x, self.steep], [-1.0, 0.0]])
        return Equations(J.T @ J, J.T @ residual, 0.5 * residual @ residual, NO_LANDMARKS)


@pytest.mark.parametrize(("steep", "evaluations", "cost"), [(10.0, 35, 1e-5), (100.0, 120, 1e-2)])
def test_a_curved_valley_is_followed_to_its_end(steep, evaluations, cost):
    """Steps that hardly lead on are no minimum: the damping is what holds them back."""
    valley = Valley(steep)
    solution = solve(valley, At(np.array([-1.2, 1.0])), np.arange(2), 60)
    assert solution.converged
    assert solution.cost < cost
    assert valley.evaluations < evaluations
