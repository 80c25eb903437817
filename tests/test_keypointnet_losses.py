"""The losses of KeypointNet against cases counted by hand, their gradients against differences, and the lessons."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from keypointnet_helpers import texture  # noqa: E402

from vioframe.bench.detectors.metrics import warp as transfer  # noqa: E402
from vioframe_keypointnet.architecture import COMPACT, FULL, Architecture  # noqa: E402
from vioframe_keypointnet.network import (  # noqa: E402
    Detection,
    KeypointNet,
    cells_of,
    describe,
    keypoint_places,
    locally_normalised,
    peak_places,
)
from vioframe_keypointnet.training import losses, samples  # noqa: E402
from vioframe_keypointnet.training.losses import (  # noqa: E402
    Candidates,
    InlierOutlierNet,
    corners,
    lesson,
    lesson_loss,
    matching_loss,
)
from vioframe_keypointnet.training.samples import random_homography  # noqa: E402

SIZE = (96, 64)


def exact(*values):
    return torch.tensor(values, dtype=torch.float64)


def candidates(xy, score, off_border=None):
    xy = torch.as_tensor(xy, dtype=torch.float64)[None]
    off = torch.ones(xy.shape[1], dtype=torch.bool) if off_border is None else torch.tensor(off_border)
    return Candidates(xy, torch.as_tensor(score, dtype=torch.float64)[None], off)


def test_network_is_the_published_one():
    network = KeypointNet(FULL)
    assert sum(p.numel() for p in network.parameters()) == 5_312_227
    assert len(network.state_dict()) == 84
    assert sum(p.numel() for p in InlierOutlierNet().parameters()) == 135_169
    seen = network(torch.rand(1, 3, 64, 96))
    assert seen.score.shape == (1, 8, 12)
    assert seen.xy.shape == (1, 2, 8, 12)
    assert seen.descriptors.shape == (1, 256, 16, 24)
    ring = torch.ones(8, 12, dtype=torch.bool)
    ring[1:-1, 1:-1] = False
    assert (seen.score[0, ring] == 0.0).all()


@pytest.mark.parametrize("architecture", [FULL.widened(0.125), COMPACT], ids=["regressed", "peaks"])
def test_places_are_in_their_cells_reach_and_in_the_image(architecture):
    torch.manual_seed(0)
    seen = KeypointNet(architecture).eval()(torch.rand(2, 1, 64, 96))
    centre = keypoint_places(torch.zeros(1, 2, 8, 12))
    assert centre[0, :, 2, 3].tolist() == [3 * 8 + 3.5, 2 * 8 + 3.5]
    assert (seen.xy - centre).abs().max() <= (3.5 if architecture.peaks else 7.0)
    assert seen.xy.min() >= 0.0
    assert (seen.xy[:, 0].max(), seen.xy[:, 1].max()) <= (95.0, 63.0)


def test_cells_are_pixels_row_by_row():
    fine = torch.arange(16.0 * 24).reshape(1, 1, 16, 24)
    folded = torch.nn.functional.pixel_unshuffle(fine, 2)
    cells = cells_of(folded)
    assert cells.shape == (1, 64, 2, 3)
    assert torch.equal(cells[0, :, 1, 2].reshape(8, 8), fine[0, 0, 8:16, 16:24])


def test_a_peak_is_weighted_with_its_neighbours_only():
    response = torch.full((1, 8, 8), -100.0)
    response[0, 2, 5], response[0, 2, 6] = math.log(3.0), math.log(1.0)
    response[0, 7, 0] = math.log(2.9)  # nearly as high, but elsewhere
    x, y = peak_places(response.reshape(1, 64, 1, 1)).flatten().tolist()
    assert x == pytest.approx(5.25 - 3.5, abs=1e-5)
    assert y == pytest.approx(2.0 - 3.5, abs=1e-5)


def test_light_and_contrast_are_taken_out_of_images():
    image = torch.from_numpy(texture((64, 96)).astype(np.float32) / 255.0)[None, None]
    plain = locally_normalised(image)
    assert plain.abs().mean() > 0.3
    torch.testing.assert_close(locally_normalised(0.6 * image + 0.3), plain, atol=0.15, rtol=0.0)
    assert locally_normalised(torch.full_like(image, 0.4)).abs().max() < 1e-5


def test_nearest_candidates_are_off_the_border():
    target = candidates([[10.0, 10.0], [13.0, 14.0], [50.0, 50.0]], [0.1, 0.2, 0.3], [False, True, True])
    distance, nearest = losses.nearest_candidates(exact([10.0, 10.0], [50.0, 47.0])[None], target)
    assert nearest.tolist() == [[1, 2]]
    np.testing.assert_allclose(distance[0], [5.0, 3.0])


def test_score_loss_by_hand():
    # (0.8 + 0.6) / 2 (1 - 2) + (0.2 + 0.4) / 2 (3 - 2), over two; and (0.2^2 + 0.2^2) / 2.
    value = losses.score_loss(exact(0.8, 0.2), exact(0.6, 0.4), exact(1.0, 3.0))
    assert float(value) == pytest.approx((-0.7 + 0.3) / 2 + 0.04)


@pytest.mark.parametrize("outside", [[30.0, 10.0], [10.0, 30.0], [13.9, 5.9]])
def test_descriptor_loss_takes_the_hardest_negative_outside_the_box(outside):
    def unit(degrees):
        return [math.cos(math.radians(degrees)), math.sin(math.radians(degrees))]

    anchors, positives = exact(unit(0.0))[None], exact(unit(20.0))[None]
    others = exact(unit(5.0), unit(30.0), unit(90.0))[None]
    xy = exact([13.9, 6.1], outside, [50.0, 50.0])[None]
    loss = losses.descriptor_loss(anchors, positives, others, exact([10.0, 10.0])[None], xy, torch.tensor([[True]]))
    # The first is the most alike, but within 4 px: it may be the very point.
    apart = [2.0 * math.sin(math.radians(angle / 2)) for angle in (20.0, 30.0)]
    assert float(loss) == pytest.approx(apart[0] - apart[1] + 0.2, abs=1e-6)
    assert losses.descriptor_loss(anchors, positives, others, xy[:, :1], xy, torch.tensor([[False]])) == 0.0


def test_inlier_loss_labels_matches_within_four_pixels(monkeypatch):
    monkeypatch.setattr(losses, "_TOP", 2)

    class Judge(torch.nn.Module):
        def forward(self, matches):
            self.matches = matches
            return exact(0.5, -0.25)[None]

    judge = Judge()
    a = candidates([[10.0, 10.0], [40.0, 30.0], [70.0, 50.0]], [0.9, 0.8, 0.1])
    b = candidates([[13.9, 10.0], [40.0, 34.1], [70.0, 50.0]], [0.5, 0.5, 0.5])
    descriptors = torch.eye(3, dtype=torch.float64)[None]
    size = exact(96.0, 64.0)
    loss = losses.inlier_loss(judge, a, b, a.xy, descriptors, descriptors, size)
    # Of the two best, the first match is 3.9 px off and right, which is +1, the second 4.1 px off and wrong, -1: half
    # of 0.5^2 and of 0.75^2, in the mean. The other way round it were half of 1.5^2 and of 1.25^2.
    assert float(loss) == pytest.approx((0.125 + 0.28125) / 2)
    np.testing.assert_allclose(
        judge.matches[0, :, 0], [20 / 96 - 1, 20 / 64 - 1, 27.8 / 96 - 1, 20 / 64 - 1, 1e-6], atol=1e-5
    )


def test_inlier_loss_is_over_the_three_hundred_strongest():
    """The strongest 300 of 301 matches are right, the last one is not, and a judge that calls all right is right."""

    class Trusting(torch.nn.Module):
        def forward(self, matches):
            return torch.ones(matches.shape[0], matches.shape[2], dtype=matches.dtype)

    def loss(weakest):
        a = candidates(np.zeros((301, 2)), [*np.linspace(0.9, 0.5, 300), weakest])
        b = candidates([[0.0, 0.0]] * 300 + [[50.0, 50.0]], [0.5] * 301)
        each = torch.eye(301, dtype=torch.float64)[None]
        return float(losses.inlier_loss(Trusting(), a, b, a.xy, each, each, exact(96.0, 64.0)))

    assert loss(0.1) == 0.0
    assert loss(0.95) == pytest.approx(0.5 * 2.0**2 / 300)


def test_the_losses_of_three_candidates_by_hand():
    """Three candidates off the border of either view, the target 2 px to the right; the first at 1 px, the second at 2.

    The third is found 5 px off, which is not the same point, so that location is (1 + 2) / 2 = 1.5 and the scores are
    those of two: (0.8 + 0.6) / 2 (1 - 1.5) + (0.2 + 0.4) / 2 (2 - 1.5), over two, is -0.1, and (0.2^2 + 0.2^2) / 2 is
    0.04. Descriptors are the same everywhere in a view, so that positives are as far as negatives: the margin is left.
    """
    places = torch.zeros(1, 2, 3, 5, dtype=torch.float64)
    scores = [torch.zeros(1, 3, 5, dtype=torch.float64) for _ in range(2)]
    xy = [places.clone(), places.clone()]
    xy[0][0, :, 1, 1:4] = exact([11.0, 12.0], [19.0, 12.0], [27.0, 12.0]).T
    xy[1][0, :, 1, 1:4] = exact([14.0, 12.0], [21.0, 14.0], [29.0, 17.0]).T
    xy[1][0, :, 0, 0] = exact(13.0, 12.0)  # where the first one belongs, but at the border
    scores[0][0, 1, 1:4], scores[1][0, 1, 1:4] = exact(0.8, 0.2, 0.9), exact(0.6, 0.4, 0.1)
    alike = [exact(1.0, 0.0), exact(0.5, math.sqrt(0.75))]
    fields = [each[None, :, None, None].expand(1, 2, 6, 10) for each in alike]
    a, b = map(Detection, scores, xy, fields)
    to_the_right = exact([1.0, 0.0, 2.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0])[None]
    values = losses.losses(a, b, to_the_right, InlierOutlierNet().double().eval())
    assert float(values["location"]) == pytest.approx(1.5)
    assert float(values["score"]) == pytest.approx(-0.1 + 0.04)
    assert float(values["descriptor"]) == pytest.approx(0.2)


def test_the_loss_of_lessons_weighs_scores_four_times(monkeypatch):
    """The mean of both views: places of 1 and 3 px, cross entropies of 0.5 and 0.7."""
    told = iter([(torch.tensor(1.0), torch.tensor(0.5)), (torch.tensor(3.0), torch.tensor(0.7))])
    monkeypatch.setattr(losses, "lesson_loss", lambda seen, wanted: next(told))
    values = losses.teach(*[None] * 4)
    assert {name: float(value) for name, value in values.items()} == pytest.approx({"place": 2.0, "corner": 2.4})


def test_points_that_the_other_view_does_not_show_count_for_nothing():
    """A target shifted out of sight: no location, no descriptor, no score loss."""
    torch.manual_seed(0)
    network = KeypointNet(COMPACT).eval()
    seen = network(torch.rand(1, 1, 64, 96))
    away = torch.eye(3)[None].clone()
    away[0, 0, 2] = 1000.0
    values = losses.losses(seen, seen, away, InlierOutlierNet().eval())
    assert (values["location"], values["descriptor"], values["score"]) == (0.0, 0.0, 0.0)


def test_the_same_image_twice_has_no_location_loss():
    torch.manual_seed(0)
    seen = KeypointNet(COMPACT).eval()(torch.rand(1, 1, 64, 96))
    values = losses.losses(seen, seen, torch.eye(3)[None], InlierOutlierNet().eval())
    assert float(values["location"]) < 1e-3
    assert abs(float(values["score"])) < 1e-3


def free_detection(seed):
    rng = np.random.default_rng(seed)

    def free(*shape):
        return torch.from_numpy(rng.uniform(-1.0, 1.0, shape)).requires_grad_()

    h, w = SIZE[1] // 8, SIZE[0] // 8
    return free(1, h, w), free(1, 2, h, w), free(1, 8, 2 * h, 2 * w)


@pytest.mark.parametrize(
    ("moving", "checked"), [((0, 1, 3, 4), ("location", "score")), ((2, 5), ("descriptor", "inlier"))]
)
def test_gradients_of_the_losses_are_those_of_differences(moving, checked):
    """Nearest neighbours do not change within the step, so what remains is smooth.

    Scores and places move the location and score losses, descriptors the others, which hold the keypoints.
    """
    torch.manual_seed(1)
    judge = InlierOutlierNet().double().eval()
    H = torch.from_numpy(random_homography(np.random.default_rng(3), SIZE, (0.7, 1.0)))[None]
    leaves = [*free_detection(0), *free_detection(1)]

    def values(*leaves):
        a, b = (Detection(torch.sigmoid(s), keypoint_places(3.0 * p), d) for s, p, d in (leaves[:3], leaves[3:]))
        return losses.losses(a, b, H, judge)

    rng = np.random.default_rng(2)
    steps = [torch.from_numpy(rng.normal(size=x.shape)) * (k in moving) for k, x in enumerate(leaves)]
    eps = 1e-7
    after, before = (
        values(*(x.detach() + sign * eps * d for x, d in zip(leaves, steps, strict=True))) for sign in (1.0, -1.0)
    )
    now = values(*leaves)
    for name in checked:
        gradients = torch.autograd.grad(now[name], leaves, allow_unused=True, retain_graph=True)
        slope = sum((g * d).sum() for g, d in zip(gradients, steps, strict=True) if g is not None)
        numeric = (after[name] - before[name]) / (2.0 * eps)
        assert abs(float(numeric)) > 1e-3
        assert float(slope) == pytest.approx(float(numeric), rel=1e-4)


def test_descriptor_gradient_is_that_of_differences():
    rng = np.random.default_rng(0)
    field = torch.from_numpy(rng.normal(size=(1, 4, 16, 24))).requires_grad_()
    xy = torch.from_numpy(rng.uniform(4.0, 60.0, (1, 7, 2)))
    torch.autograd.gradcheck(lambda f: describe(f, xy), (field,), eps=1e-6, atol=1e-6)


def test_descriptors_are_sampled_where_the_keypoints_are():
    """A field that grows along x and y: the sample tells the place."""
    h, w = 16, 24
    rows, columns = torch.meshgrid(torch.linspace(0, 63, h), torch.linspace(0, 95, w), indexing="ij")
    field = torch.stack([columns, rows, torch.ones(h, w)])[None]
    out = describe(field, torch.tensor([[[0.0, 0.0], [95.0, 63.0], [40.0, 21.0]]]))[0]
    np.testing.assert_allclose(out[:, :2] / out[:, 2:], [[0, 0], [95, 63], [40, 21]], atol=1e-3)
    np.testing.assert_allclose(out.norm(dim=1), 1.0, rtol=1e-6)


def test_homography_there_and_back():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, 60.0, (50, 2))
    for _ in range(20):
        H = random_homography(rng, SIZE, (0.7, 1.0))
        there = transfer(H, xy)
        np.testing.assert_allclose(transfer(np.linalg.inv(H), there), xy, atol=1e-8)
        by_torch = losses.warp(torch.from_numpy(H)[None], torch.from_numpy(xy)[None])[0]
        np.testing.assert_allclose(by_torch, there, atol=1e-8)


def test_homographies_show_what_is_in_the_image(monkeypatch):
    """The view's corners come from within the image, whatever was drawn."""
    rng = np.random.default_rng(1)
    monkeypatch.setattr(samples, "_ROTATION_DEG", 5.0)
    monkeypatch.setattr(samples, "_SCALE", (0.9, 1.0))
    corners_px = np.array([[0, 0], [95, 0], [95, 63], [0, 63]], np.float64)
    for _ in range(100):
        seen = transfer(np.linalg.inv(random_homography(rng, SIZE, (0.7, 0.7))), corners_px)
        assert (seen >= -1.0).all()
        assert (seen <= np.array(SIZE) + 1.0).all()


@pytest.mark.parametrize("patch_ratio", [(0.7, 0.7), (0.9, 1.0)])
def test_views_are_of_as_much_of_the_image_as_asked_for(monkeypatch, patch_ratio):
    rng = np.random.default_rng(2)
    monkeypatch.setattr(samples, "_SCALE", (1.0, 1.0))
    corners_px = np.array([[0, 0], [95, 0], [95, 63], [0, 63]], np.float32)
    seen = [transfer(np.linalg.inv(random_homography(rng, SIZE, patch_ratio)), corners_px) for _ in range(200)]
    sides = [np.sqrt(cv2.contourArea(each.astype(np.float32)) / cv2.contourArea(corners_px)) for each in seen]
    assert np.mean(sides) == pytest.approx(np.mean(patch_ratio), rel=0.02)
    assert np.ptp(sides) > 0.0


def squares():
    image = np.full((64, 96), 60, np.uint8)
    image[13:37, 18:50] = 200
    return image


def test_lessons_name_the_corners_in_their_cells():
    points = corners(squares())
    true = np.array([[17.5, 12.5], [49.5, 12.5], [17.5, 36.5], [49.5, 36.5]])
    nearest = np.linalg.norm(points[:, None, :2] - true, axis=-1).min(axis=0)
    assert nearest.max() < 0.7
    taught = lesson(points, np.eye(3), SIZE)
    assert taught.shape == (3, 8, 12)
    cell = taught[:, 1, 2]  # x 16-23, y 8-15
    np.testing.assert_allclose(cell[:2], [17.5, 12.5], atol=0.7)
    assert cell[2] > 0.0
    assert taught[2, 5, 9] == 0.0
    shifted = np.array([[1.0, 0.0, 16.0], [0.0, 1.0, 8.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(lesson(points, shifted, SIZE)[:, 2, 4], cell + np.array([16.0, 8.0, 0.0]), atol=1e-4)


def test_of_two_corners_in_a_cell_the_stronger_is_taught():
    points = np.array([[10.0, 10.0, 0.9], [12.0, 12.0, 0.5]])
    assert lesson(points, np.eye(3), SIZE)[:, 1, 1].tolist() == pytest.approx([10.0, 10.0, 0.9])


@pytest.mark.parametrize("peaks", [False, True])
def test_a_lesson_learnt_is_a_smaller_loss(peaks):
    wanted = torch.zeros(1, 3, 8, 12)
    wanted[0, :, 3, 4] = torch.tensor([35.0, 29.0, 1.0])
    score = torch.full((1, 8, 12), 0.01)
    xy = keypoint_places(torch.zeros(1, 2, 8, 12))
    response = torch.zeros(1, 64, 8, 12)
    ignorant = Detection(score, xy, torch.empty(0), response if peaks else None)
    score, xy, response = score.clone(), xy.clone(), response.clone()
    score[0, 3, 4], xy[0, :, 3, 4] = 0.99, torch.tensor([35.0, 29.0])
    pixels = np.indices((8, 8)) - np.array([5, 3])[:, None, None]
    response[0, :, 3, 4] = torch.from_numpy(-(pixels**2).sum(axis=0).ravel())
    taught = replace(ignorant, score=score, xy=xy, response=response if peaks else None)
    (place, corner), (place_before, corner_before) = lesson_loss(taught, wanted), lesson_loss(ignorant, wanted)
    assert place < 0.8 * place_before
    assert corner < 0.5 * corner_before


def test_descriptors_that_tell_places_apart_match():
    """Of 60 candidates off the border, 36 px apart from none, one descriptor for all says nothing: ln 60."""
    places = keypoint_places(torch.zeros(1, 2, 8, 12))
    h, w = 16, 24
    rows, columns = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    telling = torch.stack([torch.cos(3 * columns), torch.sin(3 * columns), torch.cos(3 * rows), torch.sin(3 * rows)])[
        None
    ]
    saying_nothing = torch.ones(1, 4, h, w)
    losses_ = [
        matching_loss(*(Detection(torch.zeros(1, 8, 12), places, d) for _ in range(2)), torch.eye(3)[None]).item()
        for d in (saying_nothing, telling)
    ]
    assert losses_[0] == pytest.approx(math.log(60.0), abs=1e-4)
    assert losses_[1] < 0.6 * losses_[0]


def test_architectures_that_cannot_be_are_refused():
    for wrong in (
        {"blocks": ((8,), (8,), (8,))},
        {"blocks": ((8,), (), (8,), (8,))},
        {"head": 0},
        {"image_channels": 2},
    ):
        with pytest.raises(ValueError, match="validation error"):
            Architecture.from_json(replace(COMPACT, **wrong).to_json())
    assert Architecture.from_json(COMPACT.to_json()) == COMPACT
    assert FULL.widened(0.5).head == 128
