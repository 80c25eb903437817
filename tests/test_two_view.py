"""Epipolar geometry: what it calls an outlier, and that no scene makes it reject everything."""

from functools import partial

import numpy as np
import pytest

from vioframe.geometry import so3, two_view
from vioframe.geometry.two_point import two_point_inliers

FOCAL_PX = 460.0
PIXEL = 1.0 / FOCAL_PX
R_C2C1 = so3.exp([0.01, -0.03, 0.02])
P_C2C1 = np.array([0.10, -0.02, 0.05])

METHODS = {
    "fundamental": two_view.fundamental_inliers,
    "magsac": two_view.magsac_inliers,
    # The rotation as a gyroscope with a bias of 0.1 rad/s would give it at 20 Hz.
    "two_point": lambda a, b, t: two_point_inliers(a, b, R_C2C1 @ so3.exp([0.003, -0.003, 0.003]), t),
}


@pytest.fixture
def rng():
    return np.random.default_rng(7)


each_method = pytest.mark.parametrize("find_inliers", METHODS.values(), ids=METHODS)


def scene(kind, rng, count=200, noise_px=0.2):
    """Matches of ``count`` fixed points seen from two places."""
    p_C1 = np.column_stack([rng.uniform(-0.7, 0.7, (count, 2)), np.ones(count)])
    p_C1 *= 3.0 if kind == "plane" else rng.uniform(2.0, 8.0, (count, 1))
    p_C2 = p_C1 @ R_C2C1.T + (0.0 if kind == "rotation" else P_C2C1)
    views = (p[:, :2] / p[:, 2:] + rng.normal(0.0, noise_px * PIXEL, (count, 2)) for p in (p_C1, p_C2))
    return tuple(views)


def test_sampson_distance_vanishes_on_exact_matches(rng):
    xy_1, xy_2 = scene("general", rng, noise_px=0.0)
    E = two_view.essential_matrix(R_C2C1, P_C2C1)
    assert np.abs(two_view.sampson_distance(E, xy_1, xy_2)).max() < 1e-15


def test_sampson_distance_is_the_correction_the_match_needs(rng):
    """Sideways motion makes all epipolar lines horizontal: both points share a vertical error d as d / 2 each."""
    xy_1 = rng.uniform(-0.5, 0.5, (50, 2))
    d = rng.normal(0.0, 1e-3, 50)
    xy_2 = xy_1 + np.column_stack([rng.uniform(-0.1, 0.0, 50), d])
    E = two_view.essential_matrix(np.eye(3), np.array([-1.0, 0.0, 0.0]))
    np.testing.assert_allclose(np.abs(two_view.sampson_distance(E, xy_1, xy_2)), np.abs(d) / np.sqrt(2.0), rtol=1e-12)


def test_sampson_distance_is_zero_where_a_match_says_nothing():
    epipole = np.zeros((1, 2))
    E = two_view.essential_matrix(np.eye(3), np.array([0.0, 0.0, 1.0]))
    assert two_view.sampson_distance(E, epipole, epipole) == 0.0


@each_method
@pytest.mark.parametrize("count", [30, 60])
def test_outliers_go_and_inliers_stay(find_inliers, count, rng):
    """The 7-point fundamental matrix follows the noise of its sample further than the calibrated models do."""
    xy_1, xy_2 = scene("general", rng)
    E = two_view.essential_matrix(R_C2C1, P_C2C1)
    strays = np.arange(count)
    xy_2[strays] += rng.normal(0.0, 30.0 * PIXEL, (len(strays), 2))
    off_px = np.abs(two_view.sampson_distance(E, xy_1, xy_2)) * FOCAL_PX
    inliers = find_inliers(xy_1, xy_2, PIXEL)
    assert not inliers[off_px > 3.0].any()
    assert inliers[count:].mean() >= (0.92 if find_inliers is two_view.fundamental_inliers else 0.97)


@each_method
@pytest.mark.parametrize("kind", ["plane", "rotation"])
def test_degenerate_scenes_keep_their_points(find_inliers, kind, rng):
    xy_1, xy_2 = scene(kind, rng)
    assert find_inliers(xy_1, xy_2, PIXEL).mean() >= 0.95


@each_method
def test_standstill_keeps_all_points(find_inliers, rng):
    xy = rng.uniform(-0.7, 0.7, (150, 2))
    if find_inliers is METHODS["two_point"]:
        find_inliers = partial(two_point_inliers, R_C2C1=np.eye(3))
        assert find_inliers(xy, xy.copy(), threshold=PIXEL).all()
    else:
        assert find_inliers(xy, xy.copy(), PIXEL).all()


def test_two_points_suffice_where_hardly_anything_moves_sideways(rng):
    """Of a parallax of a pixel a pair says next to nothing about the direction: it is the refinement that finds it."""
    for _ in range(100):
        p_C1 = np.column_stack([rng.uniform(-0.7, 0.7, (150, 2)), np.ones(150)]) * rng.uniform(2.0, 8.0, (150, 1))
        p_C2 = p_C1 @ R_C2C1.T + 0.1 * P_C2C1
        xy_1, xy_2 = (p[:, :2] / p[:, 2:] + rng.normal(0.0, 0.1 * PIXEL, (150, 2)) for p in (p_C1, p_C2))
        turn = so3.exp(rng.normal(0.0, 0.002, 3))
        assert two_point_inliers(xy_1, xy_2, R_C2C1 @ turn, 0.7 * PIXEL).mean() > 0.97


def test_a_turn_that_is_wrong_costs_few_points(rng):
    """By three degrees, from a camera that is not mounted as the calibration says: it is left out of account."""
    for turn in rng.normal(0.0, 0.06 / np.sqrt(3.0), (30, 3)):
        assert two_point_inliers(*scene("general", rng), R_C2C1 @ so3.exp(turn), PIXEL).mean() > 0.75


@each_method
def test_the_same_matches_give_the_same_answer(find_inliers, rng):
    import cv2

    xy_1, xy_2 = scene("general", rng)
    xy_2[:80] += rng.normal(0.0, 5.0 * PIXEL, (80, 2))
    cv2.setRNGSeed(1)
    first = find_inliers(xy_1, xy_2, PIXEL)
    cv2.setRNGSeed(2)
    np.testing.assert_array_equal(first, find_inliers(xy_1, xy_2, PIXEL))
