"""The built-in detectors: the contract all share, and what each promises of its own."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from vioframe.interfaces import Detector
from vioframe.testing import check_detector
from vioframe_akaze import Akaze
from vioframe_brisk import Brisk
from vioframe_fast import Fast
from vioframe_orb import Orb
from vioframe_random import Random
from vioframe_shi_tomasi import ShiTomasi
from vioframe_sift import Sift
from vioframe_surf import Surf

DESCRIBING = {"orb": Orb, "sift": Sift, "akaze": Akaze, "brisk": Brisk, "surf": Surf}
DETECTORS = {"shi_tomasi": ShiTomasi, "fast": Fast, "random": Random, **DESCRIBING}
each_detector = pytest.mark.parametrize("make", DETECTORS.values(), ids=DETECTORS)


def squares(side_px=16, pitch_px=40, shape=(240, 320)):
    """Bright squares on grey, as soft as a lens makes them: (image, (N, 2) their corner pixels)."""
    image = np.full(shape, 60, np.uint8)
    corners = []
    for top in range(20, shape[0] - side_px - 10, pitch_px):
        for left in range(20, shape[1] - side_px - 10, pitch_px):
            image[top : top + side_px, left : left + side_px] = 200
            ends = (0, side_px - 1)
            corners += [(left + x, top + y) for x in ends for y in ends]
    return cv2.GaussianBlur(image, (0, 0), 0.8), np.array(corners, float)


def texture(shape=(240, 320), seed=3):
    noise = np.random.default_rng(seed).normal(size=shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


@each_detector
def test_keypoints_are_what_the_types_promise(make):
    detector = make()
    assert isinstance(detector, Detector)
    image = texture()
    found = detector.detect(image, 60)
    assert 40 <= len(found.xy) <= 60
    assert found.xy.shape == (len(found.xy), 2)
    assert found.xy.dtype == found.score.dtype == np.float32
    assert ((found.xy >= 0) & (found.xy <= [image.shape[1] - 1, image.shape[0] - 1])).all()
    assert (np.diff(found.score) <= 0).all()
    assert found.descriptors is None
    assert len(np.unique(found.xy, axis=0)) == len(found.xy)


@each_detector
def test_the_conformance_kit_agrees(make):
    check_detector(make)


@each_detector
def test_the_same_image_gives_the_same_keypoints(make):
    image = texture()
    first, second = make().detect(image, 100), make().detect(image.copy(), 100)
    assert first.xy.tobytes() == second.xy.tobytes()


@each_detector
@pytest.mark.parametrize("level", [0, 128, 255])
def test_an_image_of_one_grey_has_no_keypoints(make, level):
    found = make().detect(np.full((240, 320), level, np.uint8), 50)
    assert found.xy.shape == (0, 2)
    assert found.score.shape == (0,)


@pytest.mark.parametrize("make", [ShiTomasi, Fast], ids=["shi_tomasi", "fast"])
def test_corners_are_found_where_they_are(make):
    image, corners = squares()
    found = make().detect(image, 500).xy
    nearest = np.linalg.norm(corners[:, None] - found[None], axis=2).min(axis=1)
    assert nearest.max() <= 1.5


@each_detector
def test_an_image_too_small_for_anything_is_survived(make):
    """OpenCV's detectors raise on some of these; AKAZE writes beyond its memory."""
    detector = make()
    for shape in [(1, 1), (1, 60), (60, 1), (2, 3), (8, 8), (15, 200), (200, 15), (37, 36), (40, 40)]:
        found = detector.detect(np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8), 5)
        assert len(found.xy) <= 5
        assert ((found.xy >= 0) & (found.xy <= np.array(shape[::-1]) - 1)).all()


@pytest.mark.parametrize(
    ("name", "width", "dtype"),
    [
        ("orb", 32, np.uint8),
        ("sift", 128, np.float32),
        ("akaze", 61, np.uint8),
        ("brisk", 64, np.uint8),
        ("surf", 64, np.float32),
    ],
)
def test_descriptors_come_when_asked_for(name, width, dtype):
    detector = DESCRIBING[name](descriptors=True)
    for image, fewest in [(texture(), 10), (np.full((240, 320), 90, np.uint8), 0), (texture((12, 12)), 0)]:
        found = detector.detect(image, 50)
        assert found.descriptors is not None
        assert found.descriptors.shape == (len(found.xy), width)
        assert found.descriptors.dtype == dtype
        assert len(found.xy) == len(found.score) >= fewest


@pytest.mark.parametrize("make", DESCRIBING.values(), ids=DESCRIBING)
def test_descriptors_belong_to_their_keypoints(make):
    """In the image moved by (24, 16) px each keypoint's nearest descriptor is that of the same place."""
    image = texture((480, 640))
    moved = np.array([24, 16])
    here, there = (make(descriptors=True).detect(i, 150) for i in (image, np.ascontiguousarray(image[16:, 24:])))
    a, b = (_as_vectors(found.descriptors) for found in (here, there))
    match = np.linalg.norm(a[:, None] - b[None], axis=2).argmin(axis=1)
    distance = np.linalg.norm(here.xy[:, None] - (there.xy + moved)[None], axis=2)
    seen_twice = distance.min(axis=1) < 1.5
    right = distance[np.arange(len(match)), match] < 3.0
    assert seen_twice.sum() >= 60
    assert right[seen_twice].mean() >= 0.9


def _as_vectors(descriptors):
    return np.unpackbits(descriptors, axis=1).astype(np.float32) if descriptors.dtype == np.uint8 else descriptors


def test_sift_finds_blobs_without_bias():
    """Blobs at random sub-pixel places: the mean error is far below the 0.23 px that a plain upscale causes."""
    rng = np.random.default_rng(5)
    centres = np.array([(x, y) for y in range(30, 220, 35) for x in range(30, 300, 35)]) + rng.uniform(
        -0.5, 0.5, (48, 2)
    )
    rows, columns = np.mgrid[:240, :320]
    image = np.full((240, 320), 40.0)
    for x, y in centres:
        image += 180.0 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4.0**2))
    found = Sift().detect(np.round(image).astype(np.uint8), 500).xy
    distance = np.linalg.norm(centres[:, None] - found[None], axis=2)
    error = (found[distance.argmin(axis=1)] - centres)[distance.min(axis=1) < 2.0]
    assert len(error) >= 45
    assert np.abs(error.mean(axis=0)).max() < 0.03


def test_fast_keeps_one_corner_a_cell():
    found = Fast(cell_px=20).detect(texture(), 1000).xy
    cells = np.floor(found / 20).astype(int)
    assert len(np.unique(cells, axis=0)) == len(cells) > 30


def test_random_places_are_steep_and_of_no_order():
    image = texture()
    found = Random(min_distance_px=3.0).detect(image, 300)
    steep = np.hypot(*(d.astype(float) for d in cv2.spatialGradient(image)))
    columns, rows = found.xy.T.astype(int)
    assert len(found.xy) == 300
    assert (steep[rows, columns] >= np.quantile(steep, 0.8)).all()
    assert abs(np.corrcoef(found.score, steep[rows, columns])[0, 1]) < 0.15
    assert np.abs(np.quantile(found.xy, 0.5, axis=0) - [160, 120]).max() < 20


def test_shi_tomasi_keeps_its_distance():
    found = ShiTomasi(min_distance_px=12.0).detect(texture(), 1000).xy
    gap = np.linalg.norm(found[:, None] - found[None], axis=2)
    assert gap[np.triu_indices(len(found), 1)].min() >= 12.0


def test_naming_the_detectors_loads_no_opencv():
    modules = [f"vioframe_{name}" for name in DETECTORS]
    program = f"import sys, {', '.join(modules)}; {'; '.join(f'{m}.vioframe_detectors()' for m in modules)}; "
    program += "sys.exit('cv2' in sys.modules or 'mahotas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
