import numpy as np
import pytest
from scipy.optimize import minimize
from trajectory_helpers import disturbed, flight, moved

from vioframe.errors import TrajectoryError
from vioframe.evaluation import ALIGNMENTS, Alignment
from vioframe.evaluation.alignment import align_posyaw, align_posyaw_by_attitude, align_se3
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.geometry.trajectory import Trajectory

YAW = rotation_z(2.6)
TURN = so3.exp([0.3, -1.1, 2.0])
SHIFT = np.array([5.0, -3.0, 11.0])
GAUGES = {
    "posyaw": (YAW, 1.0),
    "first": (YAW, 1.0),
    "se3": (TURN, 1.0),
    "sim3": (TURN, 0.37),
}


@pytest.mark.parametrize("name", GAUGES)
def test_each_alignment_undoes_its_own_gauge(name):
    truth = flight()
    R, scale = GAUGES[name]
    estimate = moved(truth, R, SHIFT, scale)
    found = ALIGNMENTS[name](estimate, truth)
    np.testing.assert_allclose(found.R_GW, R.T, atol=1e-12)
    assert found.scale == pytest.approx(1.0 / scale, rel=1e-12)
    aligned = found.apply(estimate)
    np.testing.assert_allclose(aligned.p_WB, truth.p_WB, atol=1e-11)
    np.testing.assert_allclose(aligned.R_WB, truth.R_WB, atol=1e-12)


@pytest.mark.parametrize("name", ["posyaw", "se3", "sim3"])
def test_alignment_is_the_least_squares_optimum(name):
    truth = flight(80)
    estimate = disturbed(moved(truth, TURN if name != "posyaw" else YAW, SHIFT, 0.9), 0.3, 0.0)
    best = ALIGNMENTS[name](estimate, truth)

    def cost(step):
        phi = {"posyaw": np.array([0.0, 0.0, step[2]])}.get(name, step[:3])
        scale = best.scale * np.exp(step[6]) if name == "sim3" else 1.0
        tried = Alignment(so3.exp(phi) @ best.R_GW, best.p_GW + step[3:6], scale)
        return np.sum((tried.apply(estimate).p_WB - truth.p_WB) ** 2)

    assert cost(minimize(cost, np.full(7, 0.02), tol=1e-12).x) == pytest.approx(cost(np.zeros(7)), rel=1e-9)


def test_alignment_never_reflects():
    truth = flight()
    mirrored = Trajectory(truth.t_ns, truth.R_WB, truth.p_WB * [1.0, 1.0, -1.0])
    assert np.linalg.det(align_se3(mirrored, truth).R_GW) == pytest.approx(1.0, abs=1e-12)


def test_alignment_changes_nothing_it_is_given():
    truth, estimate = flight(), moved(flight(), YAW, SHIFT)
    before = estimate.p_WB.copy(), estimate.R_WB.copy()
    for align in ALIGNMENTS.values():
        align(estimate, truth).apply(estimate)
    np.testing.assert_array_equal(estimate.p_WB, before[0])
    np.testing.assert_array_equal(estimate.R_WB, before[1])


def test_position_and_yaw_leave_the_tilt_alone():
    truth = flight()
    tilted = moved(truth, so3.exp([0.1, 0.0, 0.0]), SHIFT)
    R_GW = align_posyaw(tilted, truth).R_GW
    np.testing.assert_array_equal(R_GW[2], [0.0, 0.0, 1.0])


def test_a_straight_path_leaves_a_rotation_open():
    line = Trajectory(np.arange(50), np.tile(np.eye(3), (50, 1, 1)), np.outer(np.arange(50.0), [0.3, 0.5, 0.1]))
    for name in ("se3", "sim3"):
        with pytest.raises(TrajectoryError, match="on one line"):
            ALIGNMENTS[name](line, line)
    np.testing.assert_allclose(align_posyaw(line, line).R_GW, np.eye(3), atol=1e-12)


def test_only_associated_trajectories_align():
    with pytest.raises(TrajectoryError, match="associated trajectories, got 50 and 80 poses"):
        align_se3(flight(50), flight(80))


def test_a_body_at_rest_tells_its_yaw_by_its_attitude():
    rng = np.random.default_rng(3)
    R_WB = np.tile(so3.exp([0.2, 0.1, 0.7]), (100, 1, 1))
    truth = Trajectory(np.arange(100), R_WB, rng.normal(0.0, 1e-3, (100, 3)))
    estimate = Trajectory(np.arange(100), YAW @ R_WB, SHIFT + rng.normal(0.0, 1e-3, (100, 3)))
    np.testing.assert_allclose(align_posyaw_by_attitude(estimate, truth).R_GW, YAW.T, atol=1e-12)


def test_yaw_is_the_nearest_rotation_about_z():
    for R in so3.exp(np.random.default_rng(0).normal(0.0, 1.0, (20, 3))):
        angles = np.linspace(-np.pi, np.pi, 20001)
        overlap = np.einsum("aij,ij->a", rotation_z(angles), R)
        assert abs(np.exp(1j * angles[np.argmax(overlap)]) - np.exp(1j * float(yaw_of(R)))) < 4e-4


@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_covariance_turns_with_the_world(scale):
    """Samples drawn in W and moved to G have the covariance that apply() claims."""
    rng = np.random.default_rng(5)
    A = rng.normal(0.0, 1e-3, (6, 6))
    cov = A @ A.T
    at = flight(1)
    alignment = Alignment(TURN, SHIFT, scale)
    claimed = alignment.apply(Trajectory(at.t_ns, at.R_WB, at.p_WB, cov[None]))
    n = 200_000
    sample = rng.multivariate_normal(np.zeros(6), cov, n)
    drawn = Trajectory(np.arange(n), at.R_WB @ so3.exp(sample[:, :3]), at.p_WB + sample[:, 3:])
    moved_samples = alignment.apply(drawn)
    dtheta = so3.log(claimed.R_WB[0].T @ moved_samples.R_WB)
    empirical = np.cov(np.column_stack([dtheta, moved_samples.p_WB - claimed.p_WB]).T)
    sigma = np.sqrt(np.diag(claimed.cov_pose[0]))
    np.testing.assert_allclose(
        empirical / np.outer(sigma, sigma), claimed.cov_pose[0] / np.outer(sigma, sigma), atol=0.015
    )
