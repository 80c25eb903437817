"""What the benchmark of detectors measures, against cases counted by hand."""

from dataclasses import asdict
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from image_helpers import textured

from vioframe.bench.detectors.degradations import KINDS, Circumstances, Degradation, choose, line_kernel
from vioframe.bench.detectors.flight import _with_leads, coverage, lives, survival
from vioframe.bench.detectors.metrics import (
    PairScore,
    corner_error_px,
    fit_homography,
    lands_inside,
    matching_score,
    mutual_matches,
    repeated,
    score_pair,
    warp,
)
from vioframe.bench.detectors.quality import summary
from vioframe.bench.detectors.tables import verdict
from vioframe.errors import ConfigError
from vioframe.frontend.distinct import distinct
from vioframe.types import FrameTracks, Keypoints

SIZE = (320, 240)
IDENTITY = np.eye(3)


def shift(dx, dy=0.0):
    return np.array([[1.0, 0.0, dx], [0.0, 1.0, dy], [0.0, 0.0, 1.0]])


def keypoints(xy, descriptors=None):
    xy = np.asarray(xy, np.float32)
    return Keypoints(xy, np.arange(len(xy), 0, -1, dtype=np.float32), descriptors)


def grid(step=20):
    x, y = np.meshgrid(np.arange(30.0, 290.0, step), np.arange(30.0, 210.0, step))
    return np.column_stack([x.ravel(), y.ravel()])


def still(seed=0):
    return Circumstances(np.random.default_rng(seed))


# Repeatability and localisation


def test_the_same_points_are_all_found_again_at_their_places():
    assert repeated(grid(), grid(), IDENTITY) == (1.0, 0.0)


def test_a_known_homography_is_undone():
    H = shift(7.0, -3.0) @ np.diag([1.1, 1.1, 1.0])
    share, error_px = repeated(grid(), warp(H, grid()), H)
    assert share == 1.0
    assert error_px == pytest.approx(0.0, abs=1e-9)


def test_points_that_are_a_pixel_off_are_found_again_a_pixel_off():
    assert repeated(grid(), warp(shift(1.0), grid()), IDENTITY) == (1.0, pytest.approx(1.0))


def test_three_pixels_are_near_enough_and_more_is_not():
    assert repeated(grid(), warp(shift(3.0), grid()), IDENTITY) == (1.0, pytest.approx(3.0))
    assert repeated(grid(), warp(shift(3.1), grid()), IDENTITY) == (0.0, None)


def test_repeatability_counts_from_either_view():
    """Three of four here, three of six there: 6 of 10. The distances are 0, 1 and 2 px, each counted twice."""
    first = np.array([[50.0, 50.0], [100.0, 50.0], [150.0, 50.0], [200.0, 50.0]])
    again, others = [[50.0, 50.0], [101.0, 50.0], [150.0, 52.0]], [[50.0, 150.0], [90.0, 150.0], [130.0, 150.0]]
    second = np.array(again + others)
    assert repeated(first, second, IDENTITY) == (pytest.approx(0.6), pytest.approx(1.0))


def test_nothing_found_is_nothing_repeated():
    assert repeated(np.empty((0, 2)), grid(), IDENTITY) == (0.0, None)
    assert repeated(grid(), np.empty((0, 2)), IDENTITY) == (0.0, None)


def test_points_that_only_one_view_shows_are_left_out():
    """The second view begins 100 px further right: of the first one's points those left of x = 100 are not in it."""
    H = shift(-100.0)
    inside = lands_inside(grid(), H, SIZE)
    np.testing.assert_array_equal(inside, grid()[:, 0] >= 100.0)
    score = score_pair(keypoints(grid()), keypoints(warp(H, grid()[inside])), H, SIZE, 300)
    assert (score.repeatability, score.points) == (1.0, inside.sum())


def test_what_lies_behind_the_camera_lands_nowhere():
    H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.01, 0.0, 1.0]])  # x = 100 goes to infinity
    assert not lands_inside(np.array([[100.0, 50.0], [150.0, 50.0], [300.0, 200.0]]), H, SIZE).any()


def test_the_strongest_are_chosen_among_those_in_both_views():
    """Two points of each, after the first one's strongest, which leaves the second view."""
    first = [[10.0, 50.0], [150.0, 50.0], [200.0, 50.0], [250.0, 50.0]]
    second = [[50.0, 50.0], [100.0, 50.0], [150.0, 150.0]]
    score = score_pair(keypoints(first), keypoints(second), shift(-100.0), SIZE, 2)
    assert (score.points, score.repeatability) == (2.0, 1.0)


def test_many_points_on_one_spot_count_once_where_they_are_to_be_distinct():
    """Nine neighbours and one elsewhere that is not found again: 0.9 of all, 1 of 2 distinct ones."""
    spot = np.array([[100.0 + 0.3 * k, 100.0] for k in range(9)])
    first, second = np.vstack([spot, [[200.0, 50.0]]]), np.vstack([spot, [[200.0, 150.0]]])
    score = score_pair(keypoints(first), keypoints(second), IDENTITY, SIZE, 300)
    assert (score.repeatability, score.distinct) == (pytest.approx(0.9), pytest.approx(0.5))


def test_distinct_points_keep_their_distance_from_the_stronger_ones_kept():
    xy = np.array([[0.0, 0.0], [3.9, 0.0], [4.0, 0.0], [7.0, 0.0], [20.0, 0.0], [40.0, 0.0]])
    np.testing.assert_array_equal(distinct(xy, 4.0, 10), [0, 2, 4, 5])
    np.testing.assert_array_equal(distinct(xy, 4.0, 3), [0, 2, 4])
    assert len(distinct(np.empty((0, 2)), 4.0, 3)) == 0


# Matching


def test_only_mutual_matches_count():
    """The second of view 2 is nearest to nobody: it prefers the first of view 1, which prefers the first of view 2."""
    first = np.array([[0.0, 0.0], [10.0, 0.0]])
    second = np.array([[0.1, 0.0], [1.0, 0.0], [9.0, 0.0]])
    i, j = mutual_matches(first, second)
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == [(0, 0), (1, 2)]


def test_bytes_are_compared_bit_by_bit():
    """128 is one bit from 0, 7 is three: the other way round as numbers."""
    i, j = mutual_matches(np.array([[0]], np.uint8), np.array([[7], [128]], np.uint8))
    assert (i.tolist(), j.tolist()) == ([0], [1])


def test_nobody_matches_nobody():
    i, j = mutual_matches(np.empty((0, 4), np.float32), np.ones((3, 4), np.float32))
    assert len(i) == len(j) == 0


def test_the_matching_score_is_the_share_of_right_matches_in_either_view():
    """Four and eight points, four matches of which three are right: (3/4 + 3/8) / 2."""
    first = np.array([[50.0, 50.0], [100.0, 50.0], [150.0, 50.0], [200.0, 50.0]])
    second = np.vstack([first[:3], [[200.0, 60.0]], warp(shift(0.0, 100.0), first)])
    score = matching_score(first, second, np.arange(4), np.arange(4), IDENTITY)
    assert score == pytest.approx(0.5 * (3 / 4 + 3 / 8))


def test_a_homography_is_found_among_wrong_matches():
    H = shift(5.0, 2.0) @ np.diag([0.9, 1.1, 1.0])
    xy = grid()
    moved = warp(H, xy)
    moved[::4] = xy[::4][::-1]
    assert corner_error_px(fit_homography(xy, moved), H, SIZE) < 0.01
    assert fit_homography(xy[:3], moved[:3]) is None


def test_the_corner_error_is_the_mean_over_the_corners():
    assert corner_error_px(shift(3.0, 4.0), IDENTITY, SIZE) == pytest.approx(5.0)
    assert corner_error_px(np.diag([1.0 + 4.0 / 319.0, 1.0, 1.0]), IDENTITY, SIZE) == pytest.approx(2.0)
    assert corner_error_px(None, IDENTITY, SIZE) == np.inf


def test_what_needs_descriptors_is_left_open_without():
    bare = score_pair(keypoints(grid()), keypoints(grid()), IDENTITY, SIZE, 300)
    assert (bare.matching_score, bare.corner_error_px) == (None, None)
    own = np.eye(len(grid()), dtype=np.float32)
    score = score_pair(keypoints(grid(), own), keypoints(grid(), own), IDENTITY, SIZE, 300)
    assert score.matching_score == 1.0
    assert score.corner_error_px < 1e-6


# Summaries


def scores(detector, *repeatabilities, error_px=None, degradation=Degradation()):  # noqa: B008
    return [
        {"detector": detector, **degradation.columns, "pair": k}
        | asdict(PairScore(300, r, r, 1.0, None if error_px is None else 0.5, error_px))
        for k, r in enumerate(repeatabilities)
    ]


def summarised(*scores, baseline="shi_tomasi"):
    return summary(pd.DataFrame([row for rows in scores for row in rows]), baseline)


@pytest.mark.parametrize(
    ("error_px", "right"), [(0.5, [1, 1, 1]), (2.0, [0, 1, 1]), (4.0, [0, 0, 1]), (9.0, [0, 0, 0]), (np.inf, [0, 0, 0])]
)
def test_a_homography_is_right_within_one_three_or_five_pixels(error_px, right):
    (row,) = summarised(scores("one", 0.5, error_px=error_px)).itertuples()
    assert [row.homography_1px, row.homography_3px, row.homography_5px] == right


def test_a_row_states_mean_and_spread():
    (row,) = summarised(scores("one", 0.4, 0.6)).itertuples()
    assert (row.repeatability, row.repeatability_sd) == (pytest.approx(0.5), pytest.approx(0.1))
    assert row.pairs == 2
    assert np.isnan([row.homography_1px, row.matching_score]).all()
    assert not hasattr(row, "lead_repeatability")


def test_pairs_without_a_point_found_again_say_nothing_of_localisation():
    none_again = {**scores("one", 0.0)[0], "pair": 1, "localisation_px": None}
    (row,) = summarised(scores("one", 0.5), [none_again]).itertuples()
    assert (row.localisation_px, row.localisation_px_sd, row.repeatability) == (1.0, 0.0, 0.25)


def test_the_lead_is_that_of_the_differences_on_the_same_pairs():
    base, ahead = np.array([0.5, 0.6, 0.4, 0.5]), np.array([0.1, -0.1, 0.12, -0.08])
    row = summarised(scores("orb", *(base + ahead)), scores("shi_tomasi", *base)).iloc[0]
    # Differences of 0.1, -0.1, 0.12, -0.08: mean 0.01, deviation 0.11605, of four.
    assert row["lead_distinct"] == pytest.approx(0.01)
    assert row["lead_distinct_half_width"] == pytest.approx(1.96 * 0.11605 / 2, rel=1e-3)
    alone = summarised(scores("orb", 0.5), scores("shi_tomasi", 0.4))
    assert alone["lead_repeatability_half_width"].isna().all()  # one difference has no spread


def test_leads_are_won_lost_or_even():
    assert [verdict(lead, 0.05) for lead in (0.1, -0.1, 0.04, -0.05)] == ["won", "lost", "even", "even"]


def test_the_lead_is_over_shi_tomasi_at_the_same_degradation():
    hard = Degradation("noise", 0.1)
    found = summarised(
        scores("shi_tomasi", 0.5, 0.5),
        scores("orb", 0.6, 0.6),
        scores("shi_tomasi", 0.4, 0.4, degradation=hard),
        scores("orb", 0.1, 0.1, degradation=hard),
    )
    assert list(found["detector"]) == ["shi_tomasi", "orb"] * 2
    np.testing.assert_allclose(found["lead_repeatability"], [np.nan, 0.1, np.nan, -0.3])
    over_orb = summarised(scores("orb", 0.6, 0.6), scores("sift", 0.4, 0.4), baseline="orb")
    np.testing.assert_allclose(over_orb["lead_distinct"], [np.nan, -0.2])


def test_leads_of_shares_know_of_how_many():
    def led(tracks):
        columns = {
            f"{name}_{n}": value for n in (5, 10, 20) for name, value in (("survival", [0.5, 0.6]), ("tracks", tracks))
        }
        rows = pd.DataFrame({"detector": ["shi_tomasi", "orb"], "degradation": "none", "level": 0.0, **columns})
        return _with_leads(rows, "shi_tomasi")

    many, few = led([1000, 1000]), led([10, 10])
    np.testing.assert_allclose(few["lead_survival_10"], [np.nan, 0.1])
    assert few["lead_survival_10_half_width"][1] == pytest.approx(1.96 * np.sqrt(0.024 + 0.025))
    assert many["lead_survival_5_half_width"][1] < 0.1 < few["lead_survival_5_half_width"][1]


# Tracks


def tracks(*ids_by_frame, xy=None):
    out = []
    for k, ids in enumerate(ids_by_frame):
        places = np.zeros((len(ids), 2)) if xy is None else np.array(xy[k], float).reshape(-1, 2)
        out.append(FrameTracks(k, np.array(ids, np.int64), np.zeros(len(ids), np.int64), places, places))
    return out


def test_survival_counted_by_hand():
    """Four frames. 0 sees all, 1 the first two, 2 the first alone; 3 all but the first, 4 only the last.

    After one frame, of 0 to 3 all but 2 live; after two, of the same, 0 and 3; after three, of 0 to 2, only 0.
    """
    alive, known = lives(tracks([0, 1, 2], [0, 1, 3], [0, 3], [0, 3, 4]))
    np.testing.assert_array_equal(known, [5, 4, 4, 3])
    np.testing.assert_array_equal(alive, [5, 3, 2, 1])
    assert survival(alive, known)["median_life"] == 3


def test_the_share_that_survives_is_of_those_that_could_be_seen_for_so_long():
    alive, known = np.array([8, 8, 8, 8, 7, 6, 5]), np.array([9, 9, 9, 9, 8, 8, 8])
    figures = survival(alive, known)
    assert (figures["survival_5"], figures["tracks_5"]) == (0.75, 8)
    assert (figures["survival_10"], figures["tracks_10"]) == (None, 0)


def test_tracks_that_never_end_have_no_median():
    assert survival(*lives(tracks([0, 1], [0, 1], [0, 1])))["median_life"] is None


def test_frames_without_tracks_know_nothing():
    figures = survival(*lives(tracks(*[[]] * 6)))
    assert (figures["survival_5"], figures["tracks_5"], figures["median_life"]) == (None, 0, None)


def test_coverage_is_the_mean_share_of_cells_with_a_point():
    """A grid of 2 x 2 over 100 x 100: two points in one cell, then one each in two."""
    steps = tracks([0, 1], [0, 1], xy=[[[10, 10], [20, 20]], [[49.4, 10], [49.6, 10]]])
    assert coverage(steps, (100, 100), (2, 2)) == pytest.approx(0.5 * (0.25 + 0.5))


# Degradations


@pytest.mark.parametrize("name", KINDS)
def test_a_degradation_is_the_same_for_the_same_seed_and_leaves_the_image_alone(name):
    image = textured()
    image.flags.writeable = False
    for level in KINDS[name].levels:
        once, twice = (Degradation(name, level)(image, still()) for _ in range(2))
        assert (once.dtype, once.shape) == (image.dtype, image.shape)
        np.testing.assert_array_equal(once, twice)
        assert not np.array_equal(once, image)


@pytest.mark.parametrize("name", KINDS)
def test_each_level_is_harder_than_the_one_before(name):
    image = textured().astype(float)
    off = [np.abs(Degradation(name, level)(textured(), still()) - image).mean() for level in KINDS[name].levels]
    assert all(a < b for a, b in pairwise(off))


def test_no_degradation_changes_nothing():
    image = textured()
    assert Degradation()(image, still()) is image


@pytest.mark.parametrize("direction", [0.0, 0.4, np.pi / 2, 2.5])
@pytest.mark.parametrize("length", [0.5, 3.2, 12.8, 30.1])
def test_a_blur_kernel_is_a_line_through_its_middle(length, direction):
    kernel = line_kernel(length, direction)
    half = len(kernel) // 2
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    assert kernel.shape == (2 * half + 1, 2 * half + 1)
    assert kernel.sum() == pytest.approx(1.0)
    assert (kernel * x).sum() == pytest.approx(0.0, abs=1e-9)
    assert (kernel * y).sum() == pytest.approx(0.0, abs=1e-9)
    along = x * np.cos(direction) + y * np.sin(direction)
    across = y * np.cos(direction) - x * np.sin(direction)
    # A uniform line of that length has the variance L^2 / 12; sharing a point out over pixels adds at most a quarter.
    assert length**2 / 12 <= (kernel * along**2).sum() + 1e-3 <= length**2 / 12 + 0.26
    assert (kernel * across**2).sum() <= 0.26


def test_motion_blur_takes_the_contrast_along_its_direction_only():
    stripes = np.tile(np.where(np.arange(320) // 2 % 2, 200, 50).astype(np.uint8), (240, 1))
    blurred = Degradation("motion_blur", 0.04)
    across = blurred(stripes, Circumstances(np.random.default_rng(0), direction_rad=0.0))
    along = blurred(stripes, Circumstances(np.random.default_rng(0), direction_rad=np.pi / 2))
    assert np.std(across[:, 20:-20]) < 0.2 * np.std(stripes)
    np.testing.assert_allclose(along.astype(int), stripes.astype(int), atol=1)


def test_gamma_darkens_by_its_exponent_once_the_phase_is_there():
    grey = np.full((20, 20), 128, np.uint8)
    rng = np.random.default_rng(0)
    assert (Degradation("gamma", 2.5)(grey, Circumstances(rng, phase=0.0)) == 128).all()
    assert (Degradation("gamma", 2.5)(grey, Circumstances(rng, phase=1.0)) == round(255 * (128 / 255) ** 2.5)).all()


def test_noise_has_the_deviation_of_its_level():
    grey = np.full((400, 400), 128, np.uint8)
    noisy = Degradation("noise", 0.05)(grey, still())
    assert noisy.std() == pytest.approx(0.05 * 255, rel=0.02)
    assert noisy.mean() == pytest.approx(128, abs=0.2)


@pytest.mark.parametrize("grey", [60, 150])
def test_low_light_has_shot_noise_and_read_noise_as_the_gain_amplifies_them(grey):
    """In a fifth of the light of 10000 electrons for white, and with 0.002 of white from the read-out."""
    image = Degradation("low_light", 0.2)(np.full((400, 400), grey, np.uint8), still())
    electrons = grey / 255 * 10_000 / 5
    expected = grey * np.hypot(1 / np.sqrt(electrons), 0.002 * 5 * 255 / grey)
    assert image.std() == pytest.approx(expected, rel=0.02)
    assert image.mean() == pytest.approx(grey, abs=0.1)


def test_contrast_keeps_the_mean():
    image = textured()
    dull = Degradation("contrast", 0.2)(image, still())
    assert dull.mean() == pytest.approx(image.mean(), abs=0.5)
    assert dull.std() == pytest.approx(np.hypot(0.2 * image.std(), 1.0), rel=0.05)


def test_degradations_are_chosen_by_name():
    assert choose(["none"]) == [Degradation()]
    assert choose(["noise"]) == [Degradation(), *(Degradation("noise", level) for level in KINDS["noise"].levels)]
    assert len(choose([])) == 1 + sum(len(kind.levels) for kind in KINDS.values())
    with pytest.raises(ConfigError, match="did you mean 'noise'"):
        choose(["nois"])
