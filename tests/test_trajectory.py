import dataclasses

import numpy as np
import pytest
from trajectory_helpers import BEGIN_NS, PERIOD_NS, flight

from vioframe.errors import TrajectoryError
from vioframe.evaluation import associate
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory


def test_takes_copies_that_nobody_can_change():
    t_ns, R_WB, p_WB = np.arange(3), np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3))
    trajectory = Trajectory(t_ns, R_WB, p_WB)
    p_WB[0] = 7.0
    assert trajectory.p_WB[0, 0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        trajectory.p_WB[0] = 1.0
    assert p_WB.flags.writeable


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t_ns": np.array([0, 1, 1])}, "stamps must increase: pose 2 at 1 ns follows 1 ns"),
        ({"t_ns": np.array([0, 2, 1])}, "stamps must increase: pose 2"),
        ({"t_ns": np.array([0.0, 1.0, 2.0])}, "integer nanoseconds, got float64"),
        ({"t_ns": np.array([], dtype=np.int64)}, "at least one pose"),
        ({"p_WB": np.zeros((2, 3))}, r"p_WB has shape \(2, 3\), expected \(3, 3\)"),
        ({"p_WB": np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]])}, "pose 1 is not finite"),
        ({"R_WB": np.stack([np.eye(3), np.eye(3), 1.001 * np.eye(3)])}, "pose 2 is not a rotation"),
        ({"R_WB": np.stack([-np.eye(3), np.eye(3), np.eye(3)])}, "pose 0 is not a rotation"),
        ({"cov_pose": np.zeros((3, 3, 3))}, "cov_pose has shape"),
    ],
)
def test_refuses_what_is_no_trajectory(change, message):
    good = Trajectory(np.arange(3), np.tile(np.eye(3), (3, 1, 1)), np.zeros((3, 3)))
    with pytest.raises(TrajectoryError, match=message):
        dataclasses.replace(good, **change)


def test_lengths_and_times():
    p_WB = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]])
    trajectory = Trajectory(BEGIN_NS + PERIOD_NS * np.arange(3), np.tile(np.eye(3), (3, 1, 1)), p_WB)
    assert trajectory.path_length_m == 7.0
    np.testing.assert_array_equal(trajectory.travelled_m, [0.0, 5.0, 7.0])
    assert trajectory.duration_s == pytest.approx(0.1, abs=1e-12)


def test_quaternions_round_trip():
    truth = flight()
    again = Trajectory.from_quat_xyzw(truth.t_ns, truth.p_WB, -3.0 * truth.quat_xyzw)
    np.testing.assert_allclose(again.R_WB, truth.R_WB, atol=1e-14)
    with pytest.raises(TrajectoryError, match="quaternion is zero"):
        Trajectory.from_quat_xyzw(truth.t_ns, truth.p_WB, 0.0 * truth.quat_xyzw)


def test_interpolation_is_exact_for_a_constant_twist():
    s = np.arange(6) * 0.2
    phi, velocity = np.array([0.5, -0.3, 0.8]), np.array([1.0, 2.0, -0.5])
    knots = Trajectory(
        BEGIN_NS + (1e9 * s).astype(np.int64), so3.exp(s[:, None] * phi), s[:, None] * velocity, np.ones((6, 6, 6))
    )
    between = np.array([0.0, 0.05, 0.2, 0.333333333, 0.999999999, 1.0])
    found = knots.at(BEGIN_NS + np.round(1e9 * between).astype(np.int64), max_gap_s=0.2)
    np.testing.assert_allclose(found.R_WB, so3.exp(between[:, None] * phi), atol=1e-9)
    np.testing.assert_allclose(found.p_WB, between[:, None] * velocity, atol=1e-8)
    assert found.cov_pose is None


def test_interpolates_inside_only_and_never_across_a_gap():
    ms = 1_000_000
    knots = flight(5)
    knots = Trajectory(np.array([0, 50, 100, 400, 450]) * ms, knots.R_WB, knots.p_WB)
    stamps = np.array([-1, 0, 75, 100, 101, 399, 400, 450, 451]) * ms
    expected = [False, True, True, True, False, False, True, True, False]
    np.testing.assert_array_equal(knots.covers(stamps, max_gap_s=0.1), expected)
    assert knots.covers(stamps, max_gap_s=0.3)[4]
    with pytest.raises(TrajectoryError, match="cannot interpolate at 101000000 ns"):
        knots.at(stamps[3:5], max_gap_s=0.1)


def test_select_takes_the_covariance_along():
    truth = flight(10)
    cov = np.arange(10)[:, None, None] * np.eye(6)
    some = Trajectory(truth.t_ns, truth.R_WB, truth.p_WB, cov).select(np.array([2, 5]))
    np.testing.assert_array_equal(some.cov_pose[:, 0, 0], [2, 5])
    np.testing.assert_array_equal(some.t_ns, truth.t_ns[[2, 5]])


def test_association_interpolates_the_truth_where_it_covers_the_estimate():
    truth = flight(100)
    shift_ns = PERIOD_NS // 2
    estimate = Trajectory(truth.t_ns + shift_ns, truth.R_WB, truth.p_WB)
    matched, interpolated = associate(estimate, truth)
    assert len(matched) == 99
    np.testing.assert_array_equal(matched.t_ns, interpolated.t_ns)
    np.testing.assert_allclose(interpolated.p_WB, (truth.p_WB[1:] + truth.p_WB[:-1]) / 2, atol=1e-6)


def test_trajectories_of_different_clocks_are_told_apart():
    truth = flight()
    later = Trajectory(truth.t_ns + 3_600_000_000_000, truth.R_WB, truth.p_WB)
    with pytest.raises(TrajectoryError, match="no stamps in common"):
        associate(later, truth)
