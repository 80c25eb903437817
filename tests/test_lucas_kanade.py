"""The tracker's Lucas-Kanade against OpenCV's, and against motion that is known."""

import cv2
import numpy as np
import pytest
from image_helpers import textured

from vioframe.frontend.flow import follow, returns
from vioframe.frontend.lucas_kanade import Pyramid, search

LEVELS = 4


def moved(image, shift=(5.3, -3.6), turn_deg=2.0):
    """``image`` turned about its centre and shifted, and the 2 x 3 map that does it."""
    height, width = image.shape
    A = cv2.getRotationMatrix2D((0.5 * width, 0.5 * height), turn_deg, 1.0)
    A[:, 2] += shift
    return cv2.warpAffine(image, A, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101), A


def by_opencv(before, after, xy, guess, window_px):
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        before,
        after,
        xy,
        guess.copy(),
        winSize=(window_px, window_px),
        maxLevel=LEVELS,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    return found, status.ravel() == 1


@pytest.mark.parametrize("window_px", [9, 15, 21])
@pytest.mark.parametrize("resolution", [(752, 480), (321, 243)])
def test_it_finds_what_opencv_does(window_px, resolution):
    """To 0.01 px, wherever OpenCV's finds its way back; near the edge, too, where the coarse levels see beyond it."""
    before = textured(seed=1, size=resolution)
    after, _ = moved(before)
    xy = cv2.goodFeaturesToTrack(before, 300, 0.01, 8.0)[:, 0].astype(np.float32)
    theirs, ok = by_opencv(before, after, xy, xy, window_px)
    back, returned = by_opencv(after, before, theirs, xy, window_px)
    ok &= returned & (np.linalg.norm(back - xy, axis=1) < 0.5)
    ours, found = search(Pyramid.of(before, LEVELS, window_px), Pyramid.of(after, LEVELS, window_px), xy, xy.copy())
    off = np.linalg.norm(ours - theirs, axis=1)[ok]
    assert ok.sum() > 0.8 * len(xy)
    assert found[ok].mean() > 0.99
    assert (off < 0.01).mean() > 0.99
    assert np.median(off) < 0.001


def test_it_is_where_the_motion_took_it():
    before = textured(seed=2, size=(640, 480))
    after, A = moved(before, turn_deg=0.5)
    xy = cv2.goodFeaturesToTrack(before, 200, 0.01, 10.0)[:, 0].astype(np.float32)
    true = xy @ A[:, :2].T + A[:, 2]
    inside = ((true > 12) & (true < np.array([628, 468]))).all(axis=1)
    found, ok = search(Pyramid.of(before, LEVELS, 15), Pyramid.of(after, LEVELS, 15), xy, xy.copy())
    error = np.linalg.norm(found - true, axis=1)[ok & inside]
    assert np.median(error) < 0.05
    assert (error < 0.3).mean() > 0.95


def test_a_good_guess_needs_no_coarse_levels():
    before = textured(seed=3, size=(640, 480))
    after, _ = moved(before, shift=(40.0, 0.0), turn_deg=0.0)
    xy = cv2.goodFeaturesToTrack(before, 100, 0.01, 10.0)[:, 0].astype(np.float32)
    xy = xy[xy[:, 0] < 560.0]
    pyramids = Pyramid.of(before, LEVELS, 15), Pyramid.of(after, LEVELS, 15)
    true = xy + np.float32([40.0, 0.0])

    def right(guess, levels):
        found, ok = search(*pyramids, xy, guess.astype(np.float32), levels)
        return (ok & (np.linalg.norm(found - true, axis=1) < 0.2)).mean()

    assert right(true + 0.5, 0) > 0.9
    assert right(xy, 0) < 0.2
    assert right(xy, LEVELS) > 0.7


def test_a_patch_without_gradients_in_two_directions_is_not_followed():
    stripes = np.tile(np.where(np.arange(320) // 8 % 2, 200, 50).astype(np.uint8), (240, 1))
    flat = np.full((240, 320), 128, np.uint8)
    for image in (stripes, flat):
        pyramid = Pyramid.of(image, LEVELS, 15)
        _, ok = search(pyramid, pyramid, *2 * (np.float32([[160.0, 120.0], [161.0, 60.0]]),))
        assert not ok.any()


def test_what_is_hidden_does_not_find_its_way_back():
    """Another picture looks like the patch somewhere, and leads elsewhere from there; a plain one leads nowhere."""
    before = textured(seed=5, size=(480, 240))
    after = before.copy()
    after[:, :150] = textured(seed=6, size=(150, 240))
    after[:, 330:] = 128
    xy = cv2.goodFeaturesToTrack(before, 400, 0.01, 8.0)[:, 0]
    pyramids = Pyramid.of(before, LEVELS, 15), Pyramid.of(after, LEVELS, 15)
    _, forth = search(*pyramids, xy, xy.copy())
    found, ok = follow(*pyramids, xy.astype(np.float64), xy.astype(np.float64))
    ok &= returns(*pyramids, xy.astype(np.float64), found, 0.5)
    another, same, plain = ((xy[:, 0] > a) & (xy[:, 0] < b) for a, b in ((0, 130), (180, 300), (350, 480)))
    assert ok[same].all()
    np.testing.assert_allclose(found[same], xy[same], atol=0.01)
    assert forth[another].mean() > 0.7
    assert ok[another].mean() < 0.15
    assert forth[plain].mean() > 0.6
    assert not ok[plain].any()


def test_what_leaves_the_image_is_lost():
    image = textured(seed=4, size=(320, 240))
    pyramid = Pyramid.of(image, LEVELS, 15)
    xy = np.float32([[160.0, 120.0], [160.0, 120.0], [-400.0, 50.0]])
    _, ok = search(pyramid, pyramid, xy, np.float32([[160.0, 120.0], [160.0, 2000.0], [160.0, 120.0]]))
    np.testing.assert_array_equal(ok, [True, False, False])


def test_images_smaller_than_patches_have_one_level():
    assert len(Pyramid.of(np.zeros((12, 12), np.uint8), LEVELS, 15).images) == 1
    assert len(Pyramid.of(np.zeros((480, 752), np.uint8), 8, 15).images) == 5
