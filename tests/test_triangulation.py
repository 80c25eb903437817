"""Triangulation against the truth and against scipy's least squares."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from vioframe.geometry import so3
from vioframe.geometry.triangulation import MAX_DEPTH_M, triangulate
from vioframe.types import Float

PIXEL = 1.0 / 458.0


def views(rng: np.random.Generator, count: int = 8, baseline_m: float = 1.0) -> tuple[Float, Float]:
    """Cameras along a curve, all of them looking ahead (z), within some degrees."""
    along = np.linspace(0.0, baseline_m, count)
    p_WC = np.column_stack([along, 0.2 * along**2, 0.3 * along]) + 0.02 * baseline_m * rng.normal(size=(count, 3))
    return so3.exp(0.1 * rng.normal(size=(count, 3))), p_WC


def project(R_WC: Float, p_WC: Float, p_WF: Float) -> Float:
    p_C = np.einsum("nji,nj->ni", R_WC, p_WF - p_WC)
    return p_C[:, :2] / p_C[:, 2:]


@pytest.mark.parametrize("depth_m", [0.8, 3.0, 12.0, 50.0])
@pytest.mark.parametrize("count", [2, 3, 11])
def test_exact_for_exact_points(depth_m, count):
    R_WC, p_WC = views(np.random.default_rng(count), count, baseline_m=0.2 * depth_m)
    p_WF = np.array([0.1, -0.05, 1.0]) * depth_m
    ok, found = triangulate(R_WC, p_WC, project(R_WC, p_WC, p_WF), PIXEL)
    assert ok
    np.testing.assert_allclose(found, p_WF, atol=1e-9 * depth_m)


@pytest.mark.parametrize("seed", range(20))
def test_maximum_likelihood_for_noisy_points(seed):
    rng = np.random.default_rng(seed)
    R_WC, p_WC = views(rng, baseline_m=rng.uniform(0.3, 2.0))
    p_WF = np.array([0.4, -0.3, rng.uniform(3.0, 8.0)])
    xy = project(R_WC, p_WC, p_WF) + PIXEL * rng.normal(size=(len(p_WC), 2))
    best = least_squares(lambda p: (project(R_WC, p_WC, p) - xy).ravel() / PIXEL, p_WF, xtol=1e-14, ftol=1e-14)
    ok, found = triangulate(R_WC, p_WC, xy, PIXEL)
    assert ok
    # How far from the optimum, in its own standard deviations.
    distance = np.linalg.norm(best.jac @ (found - best.x))
    assert distance < 1e-4


def test_points_behind_a_camera_are_refused():
    rng = np.random.default_rng(0)
    R_WC, p_WC = views(rng)
    behind = np.array([0.3, 0.2, -4.0])
    assert not triangulate(R_WC, p_WC, project(R_WC, p_WC, behind), PIXEL)[0]
    ahead = np.array([0.3, 0.2, 4.0])
    R_turned = R_WC.copy()
    R_turned[-1] = R_WC[-1] @ so3.exp([0.0, np.pi, 0.0])
    assert triangulate(R_WC, p_WC, project(R_WC, p_WC, ahead), PIXEL)[0]
    assert not triangulate(R_turned, p_WC, project(R_turned, p_WC, ahead), PIXEL)[0]


def test_rays_that_cross_behind_a_later_camera_are_refused():
    """Half a metre ahead of the first camera, but the second has already flown past that."""
    R_WC, p_WC = np.tile(np.eye(3), (2, 1, 1)), np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.8]])
    ok, _ = triangulate(R_WC, p_WC, np.array([[0.2, 0.0], [0.167, 0.0]]), PIXEL)
    assert not ok


def test_points_too_near_or_too_far_are_refused():
    R_WC, p_WC = views(np.random.default_rng(1), baseline_m=20.0)
    assert triangulate(R_WC, p_WC, project(R_WC, p_WC, np.array([0.0, 0.0, 0.9 * MAX_DEPTH_M])), PIXEL)[0]
    assert not triangulate(R_WC, p_WC, project(R_WC, p_WC, np.array([0.0, 0.0, 1.2 * MAX_DEPTH_M])), PIXEL)[0]
    R_WC, p_WC = views(np.random.default_rng(1), baseline_m=0.01)
    assert not triangulate(R_WC, p_WC, project(R_WC, p_WC, np.array([0.0, 0.0, 0.05])), PIXEL)[0]


@pytest.mark.parametrize("seed", range(10))
def test_without_parallax_is_refused(seed):
    """A camera that only turns, and one that moves by less than its noise can tell."""
    rng = np.random.default_rng(seed)
    R_WC, p_WC = views(rng, baseline_m=0.0)
    p_WF = np.array([0.4, -0.3, 5.0])
    exact = project(R_WC, p_WC, p_WF)
    assert not triangulate(R_WC, p_WC, exact, PIXEL)[0]
    assert not triangulate(R_WC, p_WC, exact + PIXEL * rng.normal(size=exact.shape), PIXEL)[0]
    p_WC = p_WC + 0.002 * np.linspace(0.0, 1.0, len(p_WC))[:, None] * [1.0, 0.0, 0.0]
    assert not triangulate(R_WC, p_WC, project(R_WC, p_WC, p_WF), PIXEL)[0]
