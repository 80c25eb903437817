import numpy as np
import pytest
from scipy.stats import chi2
from trajectory_helpers import flight, moved

from vioframe.evaluation import evaluate
from vioframe.evaluation.nees import Nees, band, nees
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z
from vioframe.geometry.trajectory import Trajectory

SIGMA = np.array([2e-3, 1e-3, 4e-3, 0.05, 0.02, 0.01])


def correlated_cov(seed=0):
    A = np.eye(6) + 0.4 * np.random.default_rng(seed).normal(size=(6, 6))
    return np.diag(SIGMA) @ A @ A.T @ np.diag(SIGMA)


def honest_estimate(truth, cov, seed=1):
    """Errors drawn from ``cov`` at every pose, the convention of the covariance as documented."""
    error = np.random.default_rng(seed).multivariate_normal(np.zeros(6), cov, len(truth))
    R_WB = truth.R_WB @ so3.exp(-error[:, :3])
    return Trajectory(truth.t_ns, R_WB, truth.p_WB - error[:, 3:], np.tile(cov, (len(truth), 1, 1)))


def by_part(found):
    return {n.part: n for n in found}


def test_an_honest_covariance_has_its_degrees_of_freedom_as_mean():
    truth = flight(20_000)
    found = by_part(nees(honest_estimate(truth, correlated_cov()), truth))
    for part, dof in {"orientation": 3, "position": 3, "pose": 6}.items():
        assert found[part].dof == dof
        # Five standard errors of the mean of n chi-squared variables with variance 2 dof.
        assert found[part].mean == pytest.approx(dof, abs=5.0 * np.sqrt(2.0 * dof / len(truth)))
        assert found[part].inside == pytest.approx(0.95, abs=5.0 * np.sqrt(0.95 * 0.05 / len(truth)))


def test_a_boastful_covariance_is_found_out():
    truth = flight(2000)
    estimate = honest_estimate(truth, correlated_cov())
    boastful = Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, estimate.cov_pose / 9.0)
    found = by_part(nees(boastful, truth))
    assert found["pose"].mean == pytest.approx(54.0, rel=0.1)
    assert found["pose"].inside < 0.1


def test_nees_does_not_depend_on_the_estimates_world():
    """A covariance left unturned would fail this: the errors along x and y differ, and the world is turned."""
    truth = flight(300)
    estimate = honest_estimate(truth, correlated_cov())
    # The same estimator that happened to start elsewhere, with its own covariance in its own world.
    R, p = rotation_z(1.9), np.array([3.0, -7.0, 2.0])
    A = np.eye(6)
    A[3:, 3:] = R
    elsewhere = moved(estimate, R, p)
    elsewhere = Trajectory(elsewhere.t_ns, elsewhere.R_WB, elsewhere.p_WB, A @ estimate.cov_pose @ A.T)
    for a, b in zip(evaluate(estimate, truth).nees, evaluate(elsewhere, truth).nees, strict=True):
        np.testing.assert_allclose(a.values, b.values, rtol=1e-7, atol=1e-20)


def test_drift_is_judged_in_the_gauge_of_the_first_pose():
    """A random walk from a known start: fitted to the whole path, the start would be wrong by many of its sigmas."""
    truth = flight(1000)
    step = np.array([1e-4, 1e-4, 1e-4, 5e-3, 5e-3, 5e-3])
    means = []
    for seed in range(30):
        walk = np.cumsum(np.random.default_rng(seed).normal(0.0, step, (1000, 6)), axis=0)
        walk -= walk[0]
        # dtheta is a walk in the body frame of each pose only to first order in the angle, which stays below 1e-2.
        cov = np.arange(1000)[:, None, None] * np.diag(step**2)
        estimate = Trajectory(truth.t_ns, truth.R_WB @ so3.exp(walk[:, :3]), truth.p_WB + walk[:, 3:], cov)
        found = by_part(evaluate(moved(estimate, rotation_z(0.0), np.ones(3)), truth).nees)
        means.append(found["position"].mean)
        assert len(found["position"].values) == 999  # at the first pose the gauge leaves nothing to judge
    assert np.mean(means) == pytest.approx(3.0, abs=0.5)


def test_poses_without_covariance_are_left_out():
    truth = flight(10)
    cov = np.tile(correlated_cov(), (10, 1, 1))
    cov[2], cov[5, 4, :], cov[5, :, 4] = np.nan, 0.0, 0.0
    estimate = Trajectory(truth.t_ns, truth.R_WB, truth.p_WB, cov)
    np.testing.assert_array_equal(nees(estimate, truth)[0].t_ns, np.delete(truth.t_ns, [2, 5]))


@pytest.mark.parametrize("cov", [None, np.zeros((10, 6, 6)), np.full((10, 6, 6), np.nan)])
def test_no_covariance_no_nees(cov):
    truth = flight(10)
    assert nees(Trajectory(truth.t_ns, truth.R_WB, truth.p_WB, cov), truth) == ()


@pytest.mark.parametrize("dof", [3, 6])
def test_the_band_is_two_sided(dof):
    np.testing.assert_allclose(band(dof), chi2.ppf([0.025, 0.975], dof), rtol=1e-12)


def test_inside_counts_both_sides():
    found = Nees("pose", 6, np.arange(4), np.array([0.1, 5.0, 6.0, 40.0]), band(6))
    assert found.inside == 0.5
