"""The built-in detectors: the contract all share, and what each promises of its own."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from vioframe.interfaces import Detector
from vioframe.testing import check_detector
from vioframe_fast import Fast
from vioframe_orb import Orb
from vioframe_shi_tomasi import ShiTomasi
from vioframe_sift import Sift

DETECTORS = {"shi_tomasi": ShiTomasi, "fast": Fast, "orb": Orb, "sift": Sift}
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


@pytest.mark.parametrize("make", [Orb, Sift], ids=["orb", "sift"])
def test_descriptors_come_when_asked_for(make):
    found = make(descriptors=True).detect(texture(), 50)
    assert found.descriptors is not None
    assert len(found.descriptors) == len(found.xy) == len(found.score) > 0


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


def test_shi_tomasi_keeps_its_distance():
    found = ShiTomasi(min_distance_px=12.0).detect(texture(), 1000).xy
    gap = np.linalg.norm(found[:, None] - found[None], axis=2)
    assert gap[np.triu_indices(len(found), 1)].min() >= 12.0


def test_naming_the_detectors_loads_no_opencv():
    modules = [f"vioframe_{name}" for name in DETECTORS]
    program = f"import sys, {', '.join(modules)}; {'; '.join(f'{m}.vioframe_detectors()' for m in modules)}; "
    program += "sys.exit('cv2' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
