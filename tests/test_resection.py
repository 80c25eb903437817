"""A camera's pose from the landmarks that it sees."""

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.resection import reprojection, resect

FOCAL_PX = 458.0


def test_a_camera_is_put_where_its_landmarks_say():
    rng = np.random.default_rng(7)
    p_WF = np.column_stack([rng.uniform(-3.0, 3.0, (100, 2)), rng.uniform(4.0, 10.0, 100)])
    R_true, p_true = so3.exp(np.array([0.004, -0.006, 0.003])), np.array([0.03, -0.04, 0.02])
    xy = reprojection(p_WF, np.zeros((100, 2)), R_true, p_true)[0] + rng.normal(0.0, 0.1 / FOCAL_PX, (100, 2))
    xy[:10] += 0.1
    prior = np.repeat([np.radians(1.0), 0.03], 3) ** -2.0
    R, p, _, squared = resect(np.eye(3), np.zeros(3), p_WF, xy, 0.3 / FOCAL_PX, 1.0, prior)
    assert np.degrees(np.linalg.norm(so3.log(R_true.T @ R))) < 0.1
    assert np.linalg.norm(p - p_true) < 0.005
    assert (squared < 25.0).tolist() == [False] * 10 + [True] * 90


def test_the_jacobian_of_the_resection_is_its_derivative():
    rng = np.random.default_rng(8)
    p_WF = np.column_stack([rng.uniform(-3.0, 3.0, (9, 2)), rng.uniform(4.0, 10.0, 9)])
    R, p = so3.exp(np.array([0.1, -0.2, 0.3])), np.array([0.2, 0.1, -0.3])
    _, J = reprojection(p_WF, np.zeros((9, 2)), R, p)
    for k, d in enumerate(1e-6 * np.eye(6)):
        plus = reprojection(p_WF, np.zeros((9, 2)), R @ so3.exp(d[:3]), p + d[3:])[0]
        minus = reprojection(p_WF, np.zeros((9, 2)), R @ so3.exp(-d[:3]), p - d[3:])[0]
        np.testing.assert_allclose(J[:, :, k], (plus - minus) / 2e-6, atol=1e-7)


def test_a_landmark_behind_the_camera_is_an_outlier_that_moves_nothing():
    rng = np.random.default_rng(9)
    p_WF = np.column_stack([rng.uniform(-3.0, 3.0, (20, 2)), rng.uniform(4.0, 10.0, 20)])
    xy = reprojection(p_WF, np.zeros((20, 2)), np.eye(3), np.zeros(3))[0]
    p_WF[0, 2] = -5.0
    guess = so3.exp([0.01, -0.02, 0.0]), np.array([0.05, 0.0, -0.05])
    R, p, _, squared = resect(*guess, p_WF, xy, 1.0 / FOCAL_PX, 2.0)
    np.testing.assert_allclose(R, np.eye(3), atol=1e-6)
    np.testing.assert_allclose(p, 0.0, atol=1e-5)
    assert (squared < 1.0).tolist() == [False] + [True] * 19


def test_what_is_known_of_the_pose_holds_it_where_nothing_is_seen():
    R_WC, p_WC = so3.exp([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    R, p, information, _ = resect(R_WC, p_WC, np.empty((0, 3)), np.empty((0, 2)), 0.002, 1.0, np.arange(1.0, 7.0))
    np.testing.assert_allclose(R, R_WC, atol=1e-12)
    np.testing.assert_allclose(p, p_WC, atol=1e-12)
    np.testing.assert_allclose(information, np.diag(np.arange(1.0, 7.0)))
