"""SuperPoint against a second, slow writing of the paper; the weights are made here, as its own may not be shipped."""

import sys

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

torch = pytest.importorskip("torch", reason="superpoint needs PyTorch")

from vioframe.errors import ConfigError, PluginError  # noqa: E402
from vioframe.parts import registry  # noqa: E402
from vioframe.testing import check_detector  # noqa: E402
from vioframe_superpoint import superpoint  # noqa: E402
from vioframe_superpoint.detector import local_maxima  # noqa: E402

# Name, channels in, channels out and kernel of every layer of the published file.
LAYERS = [
    ("1a", 1, 64, 3),
    ("1b", 64, 64, 3),
    ("2a", 64, 64, 3),
    ("2b", 64, 64, 3),
    ("3a", 64, 128, 3),
    ("3b", 128, 128, 3),
    ("4a", 128, 128, 3),
    ("4b", 128, 128, 3),
    ("Pa", 128, 256, 3),
    ("Pb", 256, 65, 1),
    ("Da", 128, 256, 3),
    ("Db", 256, 256, 1),
]
ENCODER = [name for name, *_ in LAYERS[:8]]


def random_weights(seed=0):
    rng = np.random.default_rng(seed)
    table = {}
    for name, before, after, k in LAYERS:
        spread = 1.4 / np.sqrt(before * k * k)
        table[f"conv{name}.weight"] = torch.tensor(rng.normal(0, spread, (after, before, k, k)), dtype=torch.float32)
        table[f"conv{name}.bias"] = torch.tensor(rng.normal(0, 0.05, after), dtype=torch.float32)
    return table


def edge_weights(pixel):
    """A network that knows one thing: the more edges a cell has, the likelier is its pixel number ``pixel``."""
    table = {name: torch.zeros_like(value) for name, value in random_weights().items()}
    for channel, kernel in enumerate([(1, -1, 0), (-1, 1, 0)]):
        table["conv1a.weight"][channel, 0, 1] = torch.tensor(kernel, dtype=torch.float32)  # both signs of the gradient
    for name in [*ENCODER[1:], "Pa"]:
        for channel in range(2):
            table[f"conv{name}.weight"][channel, channel, 1, 1] = 1.0
    table["convPb.weight"][pixel, :2] = 20.0
    table["convPb.bias"][:] = -30.0
    table["convPb.bias"][pixel] = -6.0
    table["convPb.bias"][64] = 0.0
    return table


@pytest.fixture
def saved(tmp_path):
    def save(table):
        torch.save(table, tmp_path / "weights.pth")
        return tmp_path / "weights.pth"

    return save


def reference(table, image):
    """Probability (H, W) and each cell's descriptor (H/8, W/8, 256), of any length, in float64 and numpy alone."""

    def conv(x, name):
        weight, bias = (table[f"conv{name}.{part}"].double().numpy() for part in ("weight", "bias"))
        k = weight.shape[2]
        padded = np.pad(x, ((0, 0), (k // 2, k // 2), (k // 2, k // 2)))
        return (
            np.einsum("chwij,ocij->ohw", sliding_window_view(padded, (k, k), (1, 2)), weight, optimize=True)
            + (bias[:, None, None])
        )

    x = image[None] / 255.0
    for name in ENCODER:
        x = np.maximum(conv(x, name), 0)
        if name in ("1b", "2b", "3b"):
            x = np.stack([x[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]).max(axis=0)
    logits = conv(np.maximum(conv(x, "Pa"), 0), "Pb")
    coarse = conv(np.maximum(conv(x, "Da"), 0), "Db")
    probability = np.zeros(image.shape)
    for row, column in np.ndindex(logits.shape[1:]):
        e = np.exp(logits[:, row, column] - logits[:, row, column].max())
        for k in range(64):
            probability[8 * row + k // 8, 8 * column + k % 8] = e[k] / e.sum()
    return probability, np.moveaxis(coarse, 0, -1)


def greedy(score, threshold, radius, border, most):
    """The paper's suppression, one candidate and one pair at a time."""
    height, width = score.shape
    candidates = [
        (-score[y, x], y, x)
        for y in range(border, height - border)
        for x in range(border, width - border)
        if score[y, x] > threshold
    ]
    kept = []
    for _, y, x in sorted(candidates):
        if all(abs(y - b) > radius or abs(x - a) > radius for a, b in kept):
            kept.append((x, y))
    return np.array(kept[:most], float).reshape(-1, 2)


def noise(shape, seed=2):
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def test_keypoints_are_those_of_the_paper(saved):
    table, image = random_weights(), noise((64, 88))
    probability, _ = reference(table, image)
    found = superpoint(weights=saved(table), threshold=0.02).detect(image, 40)
    expected = greedy(probability, 0.02, 4, 4, 40)
    assert len(expected) == 40
    np.testing.assert_array_equal(found.xy, expected)
    columns, rows = expected.astype(int).T
    np.testing.assert_allclose(found.score, probability[rows, columns], rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("radius", "border", "most"), [(4, 4, 1000), (2, 0, 15), (0, 3, 1000), (9, 11, 1), (3, 40, 5)])
def test_suppression_is_greedy(seed, radius, border, most):
    """Also among equals: the scores take few values."""
    score = (np.random.default_rng(seed).integers(0, 12, (45, 60)) / 12).astype(np.float32)
    xy, kept = local_maxima(score, 0.2, radius, border, most)
    np.testing.assert_array_equal(xy, greedy(score, 0.2, radius, border, most))
    np.testing.assert_array_equal(kept, score[xy[:, 1].astype(int), xy[:, 0].astype(int)])


@pytest.mark.parametrize("pixel", [0, 5, 27, 40, 63])
def test_each_channel_is_its_pixel_of_the_cell(saved, pixel):
    """An edge in one cell only: there is one keypoint, in row k // 8 and column k % 8 of that cell."""
    image = np.full((48, 64), 100, np.uint8)
    image[18:22, 43:46] = 180  # in the cell of row 2, column 5
    found = superpoint(weights=saved(edge_weights(pixel)), border_px=8).detect(image, 10)
    assert found.xy.tolist() == [[8 * 5 + pixel % 8, 8 * 2 + pixel // 8]]


def test_the_conformance_kit_agrees(saved):
    check_detector(superpoint, weights=saved(edge_weights(27)), border_px=8)


def test_descriptors_are_of_their_places(saved):
    """In the middle of a cell, which is between its four middle pixels, that is the cell's own."""
    from vioframe_superpoint.network import load

    table, image = random_weights(3), noise((40, 56))
    network = load(saved(table))
    _, coarse = reference(table, image)
    coarse /= np.linalg.norm(coarse, axis=-1, keepdims=True)
    with torch.inference_mode():
        encoded = network.encode(torch.from_numpy(image / np.float32(255))[None, None])
        places = torch.tensor([[[8 * 4 + 3.5, 8 * 2 + 3.5], [8 * 1 + 3.5, 8 * 3 + 3.5], [0.0, 39.0]]])
        middle = network.describe(encoded, places)[0].double().numpy()
    np.testing.assert_allclose(middle[0], coarse[2, 4], atol=1e-4)
    np.testing.assert_allclose(middle[1], coarse[3, 1], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(middle, axis=1), 1.0, atol=1e-5)


def test_descriptors_on_request_change_no_keypoint(saved):
    path, image = saved(random_weights()), noise((64, 88))
    detectors = [superpoint(weights=path, threshold=0.02, descriptors=wanted) for wanted in (False, True)]
    plain, described = (detector.detect(image, 30) for detector in detectors)
    assert plain.descriptors is None
    assert described.descriptors.shape == (30, 256)
    np.testing.assert_allclose(np.linalg.norm(described.descriptors, axis=1), 1.0, atol=1e-5)
    assert plain.xy.tobytes() == described.xy.tobytes()


def test_images_of_any_size(saved):
    detector = superpoint(weights=saved(random_weights()), threshold=0.016, border_px=0, descriptors=True)
    for shape in [(1, 1), (3, 50), (8, 8), (37, 61)]:
        found = detector.detect(noise(shape), 50)
        assert 1 <= len(found.xy) <= 50
        assert (found.xy <= np.array(shape[::-1]) - 1).all()
        assert found.descriptors.shape == (len(found.xy), 256)
    assert superpoint(weights=saved(random_weights()), threshold=0.9).detect(noise((40, 40)), 5).xy.shape == (0, 2)


def test_without_weights_it_says_where_they_are():
    message = (
        r"^detector 'superpoint' needs the option 'weights' \(superpoint_v1.pth; .* licence\): pass -o weights=\.\.\."
    )
    with pytest.raises(ConfigError, match=message):
        registry.load().create_detector("superpoint")


@pytest.mark.parametrize(
    ("table", "why"),
    [
        ({"conv1a.weight": torch.zeros(64, 1, 3, 3)}, 'of another network.*Missing key.*"conv1a.bias"'),
        (random_weights() | {"convPb.bias": torch.zeros(64)}, r"of another network.*size mismatch for convPb.bias"),
        (random_weights() | {"bn1a.weight": torch.zeros(64)}, 'of another network.*Unexpected key.*"bn1a.weight"'),
        (random_weights() | {"convDb.bias": torch.full((256,), torch.nan)}, "not finite"),
        ({"state_dict": random_weights()}, "of another network"),
        ([1, 2], "of another network"),
        ({"code": np.random.default_rng}, r"is no file of PyTorch weights; superpoint needs superpoint_v1\.pth"),
    ],
)
def test_unsuitable_weights_are_refused(saved, table, why):
    with pytest.raises(ConfigError, match=why) as raised:
        superpoint(weights=saved(table))
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"not weights", b"PK\x03\x04 cut short", b"\x80\x02"])
def test_a_damaged_file_is_refused(tmp_path, content):
    (tmp_path / "w.pth").write_bytes(content)
    with pytest.raises(ConfigError, match=r"w\.pth is no file of PyTorch weights; superpoint needs superpoint_v1\.pth"):
        superpoint(weights=tmp_path / "w.pth")


def test_a_missing_file_is_said(tmp_path):
    for path, why in [(tmp_path / "none.pth", "No such file"), (tmp_path, "Is a directory")]:
        with pytest.raises(ConfigError, match=rf"the weights of superpoint, .*, cannot be read: {why}"):
            superpoint(weights=path)


def test_a_gpu_that_is_not_there_is_said(saved, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="finds no GPU here; use device=cpu"):
        superpoint(weights=saved(random_weights()), device="cuda")


def test_without_torch_it_says_what_to_install(monkeypatch, tmp_path):
    for name in [n for n in sys.modules if n.startswith("vioframe_superpoint.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(PluginError, match=r"needs PyTorch, .*: pip install 'vioframe\[superpoint\]'$"):
        registry.load().create_detector("superpoint", {"weights": tmp_path})
