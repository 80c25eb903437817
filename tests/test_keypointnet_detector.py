"""The detector keypointnet: which candidates become keypoints, on images of any kind, and the contract."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from keypointnet_helpers import TINY, network, texture, weights  # noqa: E402

from vioframe.bench.detectors.images import random_homography  # noqa: E402
from vioframe.bench.detectors.metrics import score_pair  # noqa: E402
from vioframe.errors import ConfigError  # noqa: E402
from vioframe.testing import check_detector  # noqa: E402
from vioframe_keypointnet import vioframe_detectors  # noqa: E402
from vioframe_keypointnet import weights as weights_file  # noqa: E402
from vioframe_keypointnet.network import strongest  # noqa: E402
from vioframe_keypointnet.selection import Rules, candidate_places, first_varied, padded_to_cells, peaks  # noqa: E402
from vioframe_keypointnet.selection import select as chosen  # noqa: E402

FACTORY = vioframe_detectors()["keypointnet"]


NO_RULES = Rules(0.0, 0)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A weights file of a small network that was never trained."""
    path = tmp_path_factory.mktemp("weights") / "tiny.safetensors"
    weights_file.save(path, weights(network(TINY)))
    return str(path)


def random_heads(h=30, w=40, seed=0):
    return np.random.default_rng(seed).normal(size=(3, h, w)).astype(np.float32)


def by_definition(heads, image, shape, rules):
    """The keypoints in the plainest words: (N, 2) px, strongest first."""
    xs, ys = candidate_places(heads)
    h, w = xs.shape
    inner = [(r, c) for r in range(1, h - 1) for c in range(1, w - 1)]
    kept = []
    for r, c in sorted(inner, key=lambda rc: -heads[0][rc]):
        x, y = xs[r, c], ys[r, c]
        others = [o for o in inner if heads[0][o] > heads[0][r, c]]
        near = any((xs[o] - x) ** 2 + (ys[o] - y) ** 2 < rules.nms_px**2 for o in others)
        row, column = round(float(y)), round(float(x))
        if near or x > shape[1] - 1 or y > shape[0] - 1:
            continue
        window = image[max(row - 8, 0) : row + 9, max(column - 8, 0) : column + 9]
        if int(window.max()) - int(window.min()) >= rules.min_contrast:
            kept.append((x, y))
    return np.array(kept, np.float32).reshape(-1, 2)


def half_blank(shape):
    image = texture(shape)
    image[:, : shape[1] // 2] = 100
    return image


def select_by_torch(heads, image, shape, max_points, rules):
    """As it is done in a CUDA graph."""
    found = strongest(torch.from_numpy(heads), rules.nms_px)
    assert found.shape == (heads[0].size, 3)
    return first_varied(found.numpy(), image, shape, max_points, rules)


@pytest.fixture(params=[chosen, select_by_torch])
def select(request):
    return request.param


@pytest.mark.parametrize("nms_px", [0.0, 2.5, 4.0, 9.0, 15.0])
def test_selection_is_as_defined(select, nms_px):
    heads, image, rules = random_heads(15, 20), half_blank((120, 160)), Rules(nms_px, 4)
    xy, score = select(heads, image, (117, 155), 1000, rules)
    expected = by_definition(heads, image, (117, 155), rules)
    assert len(expected) > (20 if nms_px < 10.0 else 5)
    if select is chosen:
        assert np.array_equal(xy, expected)
    assert xy.shape == expected.shape
    assert np.abs(xy - expected).max() < 1e-4  # torch's tanh differs in the last bit
    assert (np.diff(score) <= 0.0).all()
    first, _ = select(heads, image, (117, 155), 7, rules)
    assert np.array_equal(first, xy[:7])


def response_of_peaks(shape=(120, 160), seed=0):
    return cv2.GaussianBlur(np.random.default_rng(seed).normal(size=shape).astype(np.float32), (0, 0), 1.0)


def folded(response):
    """As networks give it: (H/4, W/4, 16)."""
    rows, columns = response.shape[0] // 4, response.shape[1] // 4
    return response.reshape(rows, 4, columns, 4).swapaxes(1, 2).reshape(rows, columns, 16)


def peaks_by_definition(response, image, shape, rules):
    reach = max(int(np.ceil(rules.nms_px)) - 1, 1)
    kept = []
    for y in range(8, min(response.shape[0] - 8, shape[0])):
        for x in range(8, min(response.shape[1] - 8, shape[1])):
            around = response[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1]
            window = image[max(y - 8, 0) : y + 9, max(x - 8, 0) : x + 9].astype(int)
            if response[y, x] == around.max() and window.max() - window.min() >= rules.min_contrast:
                kept.append((y, x))
    kept.sort(key=lambda at: -response[at])
    return np.array(kept)


@pytest.mark.parametrize("nms_px", [0.0, 3.0, 4.0, 4.5, 15.0])
def test_peaks_are_as_defined(nms_px):
    response, image, rules = response_of_peaks(), half_blank((120, 160)), Rules(nms_px, 4)
    xy, score = peaks(folded(response), image, (110, 155), 1000, rules)
    expected = peaks_by_definition(response, image, (110, 155), rules)
    assert len(expected) > 5
    assert np.array_equal(np.round(xy)[:, ::-1], expected)
    assert np.allclose(score, 1.0 / (1.0 + np.exp(-response[tuple(expected.T)])))
    assert 0.05 < np.abs(xy - np.round(xy)).mean() < 0.35
    first, _ = peaks(folded(response), image, (110, 155), 7, rules)
    assert np.array_equal(first, xy[:7])


def test_a_peak_between_pixels_is_found_there():
    rows, columns = np.indices((40, 48), dtype=np.float32)
    response = -((columns - 20.3) ** 2) - (rows - 17.6) ** 2
    xy, _ = peaks(folded(response), texture((40, 48)), (40, 48), 5, Rules(4.0, 0))
    assert np.abs(xy - [[20.3, 17.6]]).max() < 1e-3


def test_of_a_plateau_the_first_pixel_is_the_peak():
    response = np.zeros((40, 48), np.float32)
    response[20:22, 30:33] = 1.0
    xy, _ = peaks(folded(response), texture((40, 48)), (40, 48), 1, Rules(3.0, 0))
    assert np.abs(xy - [[30.5, 20.5]]).max() < 1e-6


def test_equal_scores_leave_one_of_two_neighbours(select):
    heads = random_heads()
    heads[0] = 1.0
    image = texture((240, 320))
    rules = Rules(4.0, 0)
    xy, _ = select(heads, image, (240, 320), 10_000, rules)
    gap = np.linalg.norm(xy[:, None] - xy[None], axis=2)
    assert gap[np.triu_indices(len(xy), 1)].min() >= 4.0


def test_the_outermost_cells_are_left_out(select):
    heads = np.zeros((3, 15, 20), np.float32)
    xy, score = select(heads, texture(), (120, 160), 1000, NO_RULES)
    assert len(xy) == 13 * 18
    assert (xy.min(axis=0) == [11.5, 11.5]).all()
    assert (xy.max(axis=0) == [147.5, 107.5]).all()
    assert (score == 0.5).all()


def test_cells_that_say_nothing_give_nothing(select):
    heads = random_heads(15, 20)
    heads[0] = -np.inf
    heads[0, 5, 5:8] = [3.0, -200.0, np.nan]
    xy, score = select(heads, texture(), (120, 160), 1000, NO_RULES)
    assert len(xy) == 2
    assert score[0] == pytest.approx(1.0 / (1.0 + np.exp(-3.0)))
    assert 0.0 < score[1] < 1e-30


@pytest.mark.parametrize("max_points", [0, 1, 50])
def test_no_more_points_than_asked_for(tiny, max_points):
    assert len(FACTORY(weights=tiny, threads=1).detect(texture(), max_points).xy) <= max_points


@pytest.mark.parametrize("shape", [(117, 155), (121, 161), (24, 24), (23, 9), (1, 1)])
def test_images_of_any_size(tiny, shape):
    image = texture(shape)
    found = FACTORY(weights=tiny, threads=1, descriptors=True).detect(image, 500)
    assert len(found.xy) == len(found.score) == len(found.descriptors)
    assert len(found.xy) > 0 or min(shape) <= 24
    assert (found.xy >= 0).all()
    assert (found.xy <= np.array(shape[::-1]) - 1).all()


@pytest.mark.parametrize(("shape", "halvings"), [((479, 500), 0), ((480, 750), 1), ((753, 481), 1), ((960, 976), 2)])
def test_large_images_are_seen_as_in_training(shape, halvings):
    pytest.importorskip("openvino")
    image, side = texture(shape), 2**halvings
    rows, columns = shape[0] // side, shape[1] // side
    means = image[: rows * side, : columns * side].reshape(rows, side, columns, side).mean(axis=(1, 3))
    # OpenCV rounds halves up in squares of two, and to even numbers in others.
    small = (np.floor(means + 0.5) if side == 2 else np.rint(means)).astype(np.uint8)
    as_it_is = FACTORY(weights="compact", threads=1, halvings=0)
    found, expected = FACTORY(weights="compact", threads=1).detect(image, 200), as_it_is.detect(small, 200)
    assert len(found.xy) == 200
    np.testing.assert_array_equal(found.xy, (expected.xy + np.float32(0.5)) * np.float32(side) - np.float32(0.5))
    assert np.array_equal(found.score, expected.score)
    # A dot is found where it is.
    dot = np.full(shape, 90, np.uint8)
    dot[200:216, 300:316] = 220
    at = FACTORY(weights="compact", threads=1).detect(cv2.GaussianBlur(dot, (0, 0), 6.0), 1).xy
    assert np.abs(at - [307.5, 207.5]).max() < 3.0


def test_large_images_vary_as_near_keypoints_as_small_ones():
    pytest.importorskip("openvino")
    image = np.full((480, 640), 90, np.uint8)
    image[200:280, 300:400] = texture((80, 100))
    xy = FACTORY(weights="compact", threads=1).detect(image, 300).xy
    assert len(xy) > 20
    # Half a square and half a pixel of it, by the summit of a parabola, beyond the window.
    assert (np.abs(xy - [349.5, 239.5]) < np.array([50.0, 40.0]) + 8.0 + 2.0).all()


def test_weights_trained_on_larger_views_see_more(tmp_path):
    pytest.importorskip("openvino")
    path, card = tmp_path / "large.safetensors", {"options": {"size": [640, 480]}}
    weights_file.save(path, replace(weights_file.load("compact"), card=card))
    image = texture((500, 640))
    found, expected = (
        FACTORY(weights=str(path), threads=1, **more).detect(image, 50) for more in ({}, {"halvings": 0})
    )
    assert np.array_equal(found.xy, expected.xy)


@pytest.mark.parametrize("name", ["tracks", "untrained:full"])
def test_other_networks_see_images_as_they_are(name):
    pytest.importorskip("openvino")
    image = texture((480, 500))
    found, expected = (FACTORY(weights=name, threads=1, **more).detect(image, 50) for more in ({}, {"halvings": 0}))
    assert len(found.xy) > 0
    assert np.array_equal(found.xy, expected.xy)


def test_padding_repeats_the_border():
    image = texture((21, 16))
    padded = padded_to_cells(image)
    assert padded.shape == (24, 16)
    assert np.array_equal(padded[:21], image)
    assert (padded[21:] == image[-1]).all()
    assert padded_to_cells(padded) is padded


def test_blank_images_have_no_keypoints_unless_asked_for(tiny):
    blank = np.full((120, 160), 80, np.uint8)
    assert len(FACTORY(weights=tiny, threads=1).detect(blank, 50).xy) == 0
    assert len(FACTORY(weights=tiny, threads=1, min_contrast=0).detect(blank, 50).xy) > 0


def test_colour_and_other_depths_are_refused(tiny):
    detector = FACTORY(weights=tiny, threads=1)
    for image in (np.zeros((24, 24, 3), np.uint8), np.zeros((24, 24), np.uint16)):
        with pytest.raises(ConfigError, match=r"\(H, W\) of uint8"):
            detector.detect(image, 10)


@pytest.mark.parametrize("runtime", ["torch", "openvino"])
def test_all_runtimes_find_the_same_keypoints(tiny, runtime):
    pytest.importorskip(runtime)
    image = texture((117, 155))
    expected = FACTORY(weights=tiny, runtime="torch", threads=1, descriptors=True).detect(image, 60)
    found = FACTORY(weights=tiny, runtime=runtime, threads=1, descriptors=True).detect(image, 60)
    assert len(found.xy) == 60
    assert np.abs(found.xy - expected.xy).max() < 1e-3
    assert np.abs(found.score - expected.score).max() < 1e-5
    assert np.abs(found.descriptors - expected.descriptors).max() < 1e-4
    assert np.allclose(np.linalg.norm(found.descriptors, axis=1), 1.0, atol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize(("precision", "tolerance_px"), [("float32", 0.01), ("float16", 0.5)])
@pytest.mark.parametrize("name", ["tiny", "untrained:full"])
def test_a_gpu_finds_the_same_keypoints(tiny, name, precision, tolerance_px, compiled):
    image, name = texture((117, 155)), tiny if name == "tiny" else name
    expected = FACTORY(weights=name, runtime="torch").detect(image, 60)
    found = FACTORY(weights=name, runtime="cuda", precision=precision, compiled=compiled).detect(image, 60)
    distance = np.linalg.norm(found.xy[:, None] - expected.xy[None], axis=2).min(axis=1)
    assert np.mean(distance < tolerance_px) > 0.9


def test_without_a_gpu_cuda_is_refused(tiny, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="torch finds no CUDA device"):
        FACTORY(weights=tiny, runtime="cuda")


def test_only_a_gpu_runs_it_compiled(tiny):
    with pytest.raises(ConfigError, match="compiled is of runtime=cuda, and the network runs by torch"):
        FACTORY(weights=tiny, runtime="torch", compiled=True)


@pytest.mark.parametrize("runtime", ["torch", "openvino"])
def test_the_conformance_kit_agrees_whatever_the_weights(tiny, runtime):
    pytest.importorskip(runtime)
    check_detector(FACTORY, weights=tiny, runtime=runtime, threads=1)


@pytest.mark.parametrize("name", weights_file.shipped())
def test_weights_that_ship_conform_and_say_what_they_are(name):
    shipped = weights_file.load(name)
    assert shipped.card
    # Regressed places are too fine for 8 bits: those of the full network would be off by 1.6 px in place of 0.7.
    assert set(shipped.activation_ranges or ()) == set(
        shipped.architecture.ranged if shipped.architecture.peaks else ()
    )
    check_detector(FACTORY, weights=name, threads=1)


@pytest.mark.parametrize("name", [name for name in weights_file.shipped() if name != "full"])
def test_int8_costs_weights_that_ship_little_repeatability(name, shared_data):
    """At most 0.02, on photographs that none were trained on, as seen under homographies."""
    pytest.importorskip("openvino")
    files = sorted((shared_data / "photographs" / "bsds500_val").glob("*.jpg"))[:25]
    assert len(files) == 25
    precise, coarse = (
        repeatability(FACTORY(weights=name, runtime="openvino", precision=p, threads=1), files)
        for p in ("float32", "int8")
    )
    assert coarse > precise - 0.02


def repeatability(detector, files):
    rng, resolution, scores = np.random.default_rng(0), (320, 240), []
    for file in files:
        image = cv2.resize(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), resolution, interpolation=cv2.INTER_AREA)
        H_21 = random_homography(rng, resolution)
        found = [detector.detect(view, 1000) for view in (image, cv2.warpPerspective(image, H_21, resolution))]
        scores.append(score_pair(*found, H_21, resolution, top_k=300).repeatability)
    return np.mean(scores)


def test_naming_the_detector_loads_nothing_heavy():
    program = "import sys, vioframe_keypointnet as k; k.vioframe_detectors(); k.vioframe_trainers(); "
    program += "sys.exit(' '.join({'torch', 'openvino', 'cv2', 'numba'} & set(sys.modules)) or 0)"
    done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
