"""Where AKAZE, BRISK and SURF put their keypoints: the right axes, no shift, and sub-pixel where they say so."""

import sys
from functools import partial

import cv2
import numpy as np
import pytest
from image_helpers import textured

import vioframe_shi_tomasi
from vioframe.errors import ConfigError, PluginError
from vioframe.parts import registry
from vioframe_akaze import Akaze
from vioframe_brisk import Brisk
from vioframe_shi_tomasi import ShiTomasi
from vioframe_surf import Surf
from vioframe_surf.descriptors import describe

FINEST = {"akaze": Akaze, "brisk": partial(Brisk, octaves=0), "surf": Surf}
each_detector = pytest.mark.parametrize("make", FINEST.values(), ids=FINEST)


def blobs(sigma_px, seed=5):
    """Bright blobs around random sub-pixel places: (image (480, 640), (35, 2) px their centres)."""
    grid = np.array([(x, y) for y in range(80, 401, 80) for x in range(80, 561, 80)], float)
    centres = grid + np.random.default_rng(seed).uniform(-5.0, 5.0, grid.shape)
    return np.round(40.0 + 180.0 * sum(blob(x, y, sigma_px) for x, y in centres)).astype(np.uint8), centres


def blob(x, y, sigma_px, shape=(480, 640)):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma_px**2))


def errors(found, centres, within_px=3.0):
    """(M, 2) px from each centre to the nearest point, where there is one."""
    distance = np.linalg.norm(centres[:, None] - found[None], axis=2)
    near = distance.min(axis=1) < within_px
    return (found[distance.argmin(axis=1)] - centres)[near]


def texture(seed=3):
    noise = np.random.default_rng(seed).normal(size=(240, 320))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("make", "sigma_px", "mean_px", "largest_px"),
    [
        pytest.param(Akaze, 2.0, 0.01, 0.05, id="akaze-fine"),
        pytest.param(Akaze, 4.0, 0.01, 0.05, id="akaze-coarse"),
        pytest.param(partial(Brisk, octaves=0), 1.5, 0.02, 0.15, id="brisk-fine"),
        pytest.param(Brisk, 1.5, 0.3, 1.0, id="brisk"),
        pytest.param(Surf, 2.5, 0.01, 0.06, id="surf-finest-octave"),
        pytest.param(Surf, 6.0, 0.02, 0.08, id="surf-second-octave"),
        pytest.param(partial(Surf, octaves=3), 9.0, 0.02, 0.08, id="surf-third-octave"),
    ],
)
def test_blobs_are_found_where_they_are(make, sigma_px, mean_px, largest_px):
    image, centres = blobs(sigma_px)
    error = errors(make().detect(image, 1000).xy, centres)
    assert len(error) >= len(centres) - 1
    assert np.abs(error.mean(axis=0)).max() <= mean_px
    assert np.abs(error).max() <= largest_px


@each_detector
def test_an_image_upside_down_has_the_same_keypoints_upside_down(make):
    """What shifts every point shows twice; a shift of half a pixel would be one pixel."""
    image = texture()
    here = make().detect(image, 300).xy
    back = np.array([319, 239]) - make().detect(np.ascontiguousarray(image[::-1, ::-1]), 300).xy
    difference = errors(back, here, within_px=1.5)
    assert len(difference) >= 0.8 * len(here)
    assert np.abs(difference.mean(axis=0)).max() <= 0.03


@each_detector
def test_fewer_points_are_the_strongest_of_more(make):
    image = texture()
    many, few = make().detect(image, 60), make().detect(image, 7)
    assert len(few.xy) == 7
    assert few.score.tolist() == many.score[:7].tolist()
    assert {tuple(xy) for xy in few.xy[few.score > many.score[7]]} <= {tuple(xy) for xy in many.xy[:7]}


@pytest.mark.parametrize(("sigma_px", "x", "y"), [(2.5, 21.3, 25.8), (6.0, 39.2, 41.7)])
def test_surf_finds_what_is_near_the_border(sigma_px, x, y):
    """mahotas by itself keeps 18, then 64 px away from it."""
    image = np.round(40.0 + 180.0 * blob(x, y, sigma_px, shape=(200, 300))).astype(np.uint8)
    assert Surf().detect(image, 1).xy[0] == pytest.approx([x, y], abs=0.15)


@pytest.mark.parametrize("direction_deg", [0, 90, 180, -90, 37])
def test_surf_describes_a_slope_alike_in_every_direction(direction_deg):
    """In its own direction a slope rises along u everywhere and along v nowhere; a part's share is its Gaussian's."""
    rows, columns = np.mgrid[:200, :200] - 100.0
    angle = np.radians(direction_deg)
    image = np.round(128 + 2.5 * (np.cos(angle) * columns + np.sin(angle) * rows)).clip(0, 255).astype(np.uint8)
    (found,) = describe(image, np.array([[100.0, 100.0]]), np.array([2.0])).reshape(1, 16, 4)
    steps = np.exp(-((np.arange(20) - 9.5) ** 2) / (2 * 3.3**2)).reshape(4, 5).sum(axis=1)
    share = np.outer(steps, steps).ravel()
    expected = share[:, None] * np.array([1, 0, 1, 0]) / np.linalg.norm(share) / np.sqrt(2)
    np.testing.assert_allclose(found, expected, atol=0.02)


@pytest.mark.parametrize("turn_deg", [25, 140, 180, -80])
def test_surf_descriptors_turn_with_the_image(turn_deg):
    """Box filters do not quite; with orientations that do not turn, as mahotas has them, about a tenth are right."""
    image = cv2.resize(texture(), (640, 480))
    turn = cv2.getRotationMatrix2D((319.5, 239.5), turn_deg, 1.0)
    turned = cv2.warpAffine(image, turn, (640, 480), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    here, there = (Surf(descriptors=True).detect(view, 150) for view in (image, turned))
    match = np.linalg.norm(here.descriptors[:, None] - there.descriptors[None], axis=2).argmin(axis=1)
    moved = here.xy @ turn[:, :2].T + turn[:, 2]
    distance = np.linalg.norm(moved[:, None] - there.xy[None], axis=2)
    seen_twice = distance.min(axis=1) < 1.5
    assert seen_twice.sum() >= 40
    assert (distance[np.arange(len(match)), match] < 3.0)[seen_twice].mean() >= 0.7


def test_surf_says_what_to_install(monkeypatch):
    for name in ("mahotas", "mahotas.features"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(PluginError, match=r"^detector 'surf' needs mahotas, .*: pip install 'vioframe\[surf\]'$"):
        registry.load().create_detector("surf")


@pytest.mark.parametrize(
    ("name", "key", "value"),
    [
        ("akaze", "threshold", "-1"),
        ("brisk", "octaves", "-1"),
        ("surf", "threshold", "-1"),
        ("surf", "octaves", "0"),
        ("random", "steepest", "0"),
    ],
)
def test_an_option_out_of_range_is_refused(name, key, value):
    with pytest.raises(ConfigError, match=rf"detector '{name}': {key}='{value}': Input should be greater than"):
        registry.load().create_detector(name, {key: value})


def test_a_pattern_that_repeats_itself_has_more_equal_corners_than_a_quarter_of_its_pixels():
    """Of a tiling of three pixels by three nearly every one is as high as its neighbours."""
    image = np.tile(np.array([[0, 0, 0], [0, 0, 0], [255, 0, 0]], np.uint8), (40, 40))
    gradients = (np.asarray(d, np.int16) for d in cv2.spatialGradient(image))
    eigenvalue = vioframe_shi_tomasi._least_eigenvalue(*gradients)
    least = 0.001 * eigenvalue.max()
    high = (eigenvalue >= cv2.dilate(eigenvalue, np.ones((3, 3), np.uint8))) & (eigenvalue > least)
    high[[0, -1]], high[:, [0, -1]] = False, False
    assert high.sum() > image.size / 4
    np.testing.assert_array_equal(vioframe_shi_tomasi._peaks(eigenvalue, least), np.flatnonzero(high))
    found = ShiTomasi().detect(image, 500)
    assert len(found.xy) > 50


def test_shi_tomasi_finds_the_corners_that_opencv_does():
    image = textured(seed=5, size=(752, 480))
    for count in (100, 10**6):
        theirs, quality = cv2.goodFeaturesToTrackWithQuality(image, count, 0.01, 10.0, None, blockSize=3)
        ours = ShiTomasi().detect(image, count)
        theirs = {(x, y): q for (x, y), q in zip(theirs[:, 0], quality.ravel(), strict=True)}
        score = dict(zip(map(tuple, ours.xy), ours.score, strict=True))
        both = theirs.keys() & score.keys()
        assert abs(len(score) - len(theirs)) <= 0.02 * len(theirs)
        # What differs is near the edge, where gradients are those of reflections.
        assert len(both) > 0.95 * len(theirs)
        np.testing.assert_allclose([score[k] for k in both], [theirs[k] for k in both], rtol=1e-4)
        assert (np.diff(ours.score) <= 0.0).all()
