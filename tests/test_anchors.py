"""Points found again as they looked at first: against maps that are known exactly, and over a long approach."""

import itertools

import cv2
import numpy as np
import pytest
from image_helpers import textured

from vioframe.frontend.anchors import Anchors
from vioframe.frontend.flow import follow
from vioframe.frontend.lucas_kanade import Pyramid

SIZE = 640, 480
MIDDLE = np.array([319.5, 239.5])
LEVELS, WINDOW_PX = 4, 15


def mapped(image, A, about=MIDDLE):
    """``image`` with its pixels ``x`` moved to ``about + A (x - about)``."""
    M = np.column_stack([A, about - A @ about])
    return cv2.warpAffine(image, M, SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)


def moved(xy, A, about=MIDDLE):
    return about + (xy - about) @ A.T


def pyramid(image):
    return Pyramid.of(image, LEVELS, WINDOW_PX)


@pytest.fixture(scope="module")
def image():
    return cv2.GaussianBlur(textured(seed=3, size=SIZE), (0, 0), 1.0)


@pytest.fixture(scope="module")
def xy(image):
    """Corners that stay in the image whatever is done to it here."""
    found = cv2.goodFeaturesToTrack(image, 200, 0.01, 10.0)[:, 0].astype(np.float64)
    return found[(np.abs(found - MIDDLE) < [130, 90]).all(axis=1)]


def test_what_does_not_move_stays_to_the_last_bit(image, xy):
    anchors = Anchors.of(pyramid(image), xy)
    again, found, held = anchors.refine(pyramid(image), xy, np.ones(len(xy), bool))
    assert held.all()
    np.testing.assert_array_equal(found, xy)
    np.testing.assert_array_equal(again.warp, anchors.warp)


@pytest.mark.parametrize(
    "A",
    [
        [[1.08, 0.0], [0.0, 1.08]],
        [[0.93, 0.0], [0.0, 0.93]],
        [[np.cos(0.12), -np.sin(0.12)], [np.sin(0.12), np.cos(0.12)]],
        [[1.06, 0.07], [-0.02, 0.95]],
    ],
    ids=["grown", "shrunk", "turned", "sheared"],
)
@pytest.mark.parametrize(("gain", "level"), [(1.0, 0.0), (0.6, 60.0)], ids=["same light", "other light"])
def test_it_finds_place_and_map_from_a_pixel_beside_it(image, xy, A, gain, level):
    A = np.array(A)
    after = np.clip(gain * mapped(image, A) + level, 0, 255).astype(np.uint8)
    true = moved(xy, A)
    beside = true + np.array([0.7, -0.6])
    anchors = Anchors.of(pyramid(image), xy)
    for _ in range(2):  # a map takes an image or two to be learned
        anchors, found, held = anchors.refine(pyramid(after), beside, np.ones(len(xy), bool))
    off = np.linalg.norm(found - true, axis=1)[held]
    assert held.mean() > 0.95
    assert np.median(off) < 0.04
    assert np.quantile(off, 0.9) < 0.12
    assert np.median(np.abs(anchors.warp[held] - A).max(axis=(1, 2))) < 0.02


def test_over_an_approach_points_slide_off_their_landmarks_unless_they_are_anchored(image, xy):
    """Thirty images, each 1 % nearer: from image to image it is a patch that is followed, and not its middle."""
    growth = 1.01 ** np.arange(31)
    views = [pyramid(mapped(image, s * np.eye(2))) for s in growth]
    anchors, held_at, free_at = Anchors.of(views[0], xy), xy, xy
    lasts = np.ones(len(xy), bool)
    for before, after in itertools.pairwise(views):
        free_at, _ = follow(before, after, free_at, free_at)
        guess, found = follow(before, after, held_at, held_at)
        anchors, held_at, held = anchors.refine(after, guess, found)
        lasts &= held
    true = moved(xy, growth[-1] * np.eye(2))
    free, anchored = (np.linalg.norm(at - true, axis=1)[lasts] for at in (free_at, held_at))
    assert lasts.mean() > 0.9
    assert np.median(anchored) < 0.08
    assert np.median(anchored) < 0.2 * np.median(free)


def test_another_patch_is_not_taken_for_it(image, xy):
    """Half of the points are covered by something else, close to where they are looked for."""
    after = image.copy()
    after[:, :320] = cv2.GaussianBlur(textured(seed=8, size=(320, 480)), (0, 0), 1.0)
    anchors = Anchors.of(pyramid(image), xy)
    again, found, held = anchors.refine(pyramid(after), xy, np.ones(len(xy), bool))
    covered, seen = xy[:, 0] < 305, xy[:, 0] > 335
    assert held[seen].all()
    assert held[covered].mean() < 0.05
    np.testing.assert_array_equal(found[~held], xy[~held])
    np.testing.assert_array_equal(again.warp[~held], np.tile(np.eye(2), (np.sum(~held), 1, 1)))


def test_what_is_not_tried_or_leads_out_of_the_image_is_left_alone(image):
    xy = np.array([[100.0, 100.0], [320.0, 240.0]])
    anchors = Anchors.of(pyramid(image), xy)
    _, found, held = anchors.refine(
        pyramid(image), np.array([[100.3, 100.0], [2000.0, 240.0]]), np.array([False, True])
    )
    assert not held.any()
    np.testing.assert_array_equal(found, [[100.3, 100.0], [2000.0, 240.0]])


def test_anchors_go_with_their_points(image, xy):
    one, other = Anchors.of(pyramid(image), xy[:5]), Anchors.of(pyramid(image), xy[5:8])
    both = one.joined(other)
    np.testing.assert_array_equal(both.patch, Anchors.of(pyramid(image), xy[:8]).patch)
    np.testing.assert_array_equal(both.keep(np.arange(8) >= 5).inverse, other.inverse)
