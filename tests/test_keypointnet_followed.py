"""Training by what becomes of points that are followed: what they are worth, against a world that is known."""

from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from simulation_helpers import small_simulation

torch = pytest.importorskip("torch")
pytest.importorskip("open3d", exc_type=ImportError)

from vioframe.cli import main  # noqa: E402
from vioframe.errors import ConfigError  # noqa: E402
from vioframe.parts import registry  # noqa: E402
from vioframe.simulation.record import record  # noqa: E402
from vioframe_keypointnet import weights  # noqa: E402
from vioframe_keypointnet.network import of_weights  # noqa: E402
from vioframe_keypointnet.options import TrainingOptions  # noqa: E402
from vioframe_keypointnet.training.followed import (  # noqa: E402
    IMAGES,
    Followed,
    follow,
    followed_losses,
    rank_correlation,
    told,
    wanted,
)
from vioframe_keypointnet.training.trainer import Training  # noqa: E402

SMALL = TrainingOptions(
    target="drift", width=0.25, dropout=0.0, size=(96, 64), batch=2, epochs=2, epoch_samples=4, threads=1
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    bag = folder / "flight.bag"
    record(small_simulation(folder, divisor=2, duration_s=2.5), [bag])
    return bag


@pytest.fixture(scope="module")
def pictures(flight):
    return follow(flight)


def test_points_are_followed_from_every_sixth_image_to_the_end(pictures):
    assert [p.name.partition("#")[2] for p in pictures] == [str(k) for k in range(len(pictures))]
    assert len(pictures) == 9
    for k, picture in enumerate(pictures):
        assert picture.pixels.shape == (240, 376)
        assert 100 < len(picture.xy) <= 600
        # 51 images in all: after the last nothing is known.
        rest = 50 - 6 * k
        assert picture.known[:, :rest].any(axis=0).all()
        assert not picture.known[:, rest:].any()
        assert picture.known[:, 0].mean() > 0.85
    first = pictures[0]
    # In the image after, a point is where its landmark is, nearly always; later ever more are lost or have slid off.
    assert np.median(first.off_px[:, 0]) < 0.2
    assert np.isinf(first.off_px[:, 0]).mean() < 0.2
    strayed = [np.mean((first.off_px[:, k] > 1.0)[first.known[:, k]]) for k in (0, 40)]
    assert strayed[0] < strayed[1] < 0.9


def test_what_leaves_the_image_is_not_known_rather_than_lost(pictures):
    """A fifth of a second later it is the points by the border of which nothing is known."""
    for picture in pictures[:2]:
        known = picture.known
        assert (known[:, :-1] >= known[:, 1:]).all()
        gone = np.flatnonzero(known[:, 0] & ~known[:, 3])
        near_edge = np.minimum(picture.xy, np.array([375, 239]) - picture.xy).min(axis=1)
        assert len(gone)
        assert np.median(near_edge[gone]) < 0.5 * np.median(near_edge)


def fates() -> Followed:
    """Six points: one that stays, one half a pixel off, one lost after 15 images, one that strays after 30, one that
    leaves the image after 30, and one that does after 10."""
    off_px, known = np.zeros((6, IMAGES)), np.ones((6, IMAGES), bool)
    off_px[1] = 0.5
    off_px[2, 15:] = np.inf
    off_px[3, 30:] = 2.0
    for point, last in ((4, 30), (5, 10)):
        known[point, last:] = False
        off_px[point, last:] = np.inf
    return Followed(
        "fates", np.zeros((64, 96), np.uint8), np.zeros((6, 2), np.float32), off_px.astype(np.float16), known
    )


@pytest.mark.parametrize(
    ("target", "worth"),
    [
        ("life", [1.0, 1.0, 0.25, 1.0, 1.0]),
        ("drift", [1.0, 0.5, 1.0, 1.0 / 9.0, 1.0]),
        ("faithful", [1.0, 1.0, 0.25, 0.5, 1.0]),
        ("information", [1.0, 0.01 / 0.26, 0.25, 0.5 + 0.5 * 0.01 / 4.01, 1.0]),
        ("clean", [1.0, 1.0, 1.0, 0.0, 1.0]),
    ],
)
def test_what_each_target_says_of_a_point(target, worth):
    score, enough = wanted(target, fates())
    np.testing.assert_allclose(score[:5], worth, atol=2e-3)
    assert enough.tolist() == [True] * 5 + [False]


def test_information_goes_by_what_is_usual_in_the_image():
    """Where all points stray three times as far, the same ones are as good; but not where all stray next to nothing."""
    off_px = np.repeat([[0.2], [0.4], [1.0]], IMAGES, axis=1).astype(np.float16)

    def worth(times):
        points = replace(fates(), xy=np.zeros((3, 2), np.float32), known=np.ones(off_px.shape, bool))
        return wanted("information", replace(points, off_px=(times * off_px).astype(np.float16)))[0]

    np.testing.assert_allclose(worth(1.0), [0.64 / (0.64 + off**2) for off in (0.2, 0.4, 1.0)], atol=2e-3)
    np.testing.assert_allclose(worth(3.0), worth(1.0), atol=2e-3)
    assert worth(0.05).min() > worth(1.0).min() + 0.3


def test_foresight_offers_what_will_tell_most_and_knows_no_other_image():
    from foresight import Foresight

    points = replace(fates(), xy=np.arange(12, dtype=np.float32).reshape(6, 2))
    detector = Foresight([points])
    found = detector.detect(points.pixels.copy(), 3)
    assert sorted(found.xy[:, 0].tolist()) == [0.0, 8.0, 10.0]  # that stay for as long as they are known
    assert len(detector.detect(points.pixels + np.uint8(1), 3).xy) == 0


def test_points_are_where_the_crops_show_them():
    """Mirrored or not: what is white in a picture is so in its crops."""
    rng = np.random.default_rng(1)
    xy = rng.integers(12, [180, 116], (60, 2))
    image = np.zeros((128, 192), np.uint8)
    image[xy[:, 1], xy[:, 0]] = 255
    followed = Followed(
        "", image, xy.astype(np.float32), np.zeros((60, IMAGES), np.float16), np.ones((60, IMAGES), bool)
    )
    steps = [told([followed], SMALL, step) for step in range(8)]
    for made in steps:
        assert len(made.at) > 5
        assert (made.crops[made.at[:, 0], 0, made.at[:, 1], made.at[:, 2]] == 255).all()


def scenes():
    """Images whose left half is textured finely and whose right half is not; points of the left stay, others slide."""
    rng = np.random.default_rng(0)
    out = []
    for number in range(4):
        image = np.full((64, 96), 120, np.uint8)
        image[:, :48] = rng.integers(0, 255, (64, 48))
        image[:, 48:] += (20 * np.sin(np.arange(48) / 5.0)).astype(np.int8).view(np.uint8)
        xy = rng.uniform([12, 12], [83, 51], (80, 2)).astype(np.float32)
        off_px = np.where(xy[:, :1] < 48, 0.05, 3.0) * np.ones(IMAGES)
        out.append(Followed(f"{number}", image, xy, off_px.astype(np.float16), np.ones((80, IMAGES), bool)))
    return out


def test_a_network_learns_which_points_stay():
    torch.manual_seed(0)
    training = Training(replace(SMALL, epochs=15, learning_rate=1e-2), scenes())
    before = rank_correlation(of_weights(training.weights()), scenes(), "drift")
    losses = [values["total"] for values in training.steps()]
    assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:3])
    assert training.validate(scenes())["rank_correlation"] > max(0.7, before + 0.3)


def test_a_step_depends_on_its_number_alone():
    training = Training(SMALL, scenes())
    training.network.eval()
    first, second = (
        [float(followed_losses(training.network, told(scenes(), SMALL, step))["total"].detach()) for step in range(6)]
        for _ in range(2)
    )
    assert first == second
    assert len(set(first)) > 3


def test_command_trains_weights_whose_points_are_taken_first_to_last(flight, tmp_path):
    options = [f for name in ("target=clean", "width=0.25", "size=[96, 64]", "epochs=1") for f in ("-o", name)]
    command = ["train", "keypointnet", "--images", str(flight), "--hold-out", "*#8", "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, [*command, *options, "-o", "threads=1"])
    assert done.exit_code == 0, done.output
    assert "rank_correlation" in done.output
    made = tmp_path / "out" / "keypointnet.safetensors"
    assert weights.load(made).target == "clean"
    assert weights.load(made).card["simulated_worlds"][0]["seed"] == 0
    installed = registry.load()
    assert installed.create_detector("keypointnet", {"weights": str(made), "threads": 1}).best_first
    assert not installed.create_detector("keypointnet", {"threads": 1}).best_first
    with pytest.raises(ConfigError, match="only=descriptors"):
        installed.create_detector("keypointnet", {"weights": str(made), "threads": 1, "descriptors": True})


def test_descriptors_trained_afterwards_leave_the_target_as_it_was(tmp_path):
    trained = Training(SMALL, scenes())
    assert not trained.weights().has_descriptors
    weights.save(tmp_path / "a.safetensors", trained.weights())
    later = Training(replace(SMALL, target="repeatability", only="descriptors"), scenes())
    later.start_from(weights.load(tmp_path / "a.safetensors"))
    assert (later.weights().target, later.weights().has_descriptors) == ("drift", True)
    later.save(tmp_path / "checkpoint.pt", [])
    again = Training(replace(SMALL, target="repeatability", only="descriptors"), scenes())
    again.resume(tmp_path / "checkpoint.pt")
    assert again.weights().target == "drift"
    anew = Training(replace(SMALL, target="repeatability"), scenes())
    anew.start_from(weights.load(tmp_path / "a.safetensors"))
    assert anew.weights().target == "repeatability"


def test_recordings_that_nobody_simulated_are_refused(tmp_path):
    import cv2

    for k in range(3):
        (tmp_path / "photographs").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "photographs" / f"{k}.png"), np.zeros((80, 96), np.uint8))
    command = ["train", "keypointnet", "--images", str(tmp_path / "photographs"), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, [*command, "-o", "target=drift"])
    assert result.exit_code == 2
    assert len(result.output.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"network": "full"}, "full says nothing"),
        ({"lesson_epochs": 1}, "--finetune"),
        ({"only": "descriptors"}, "--finetune"),
        ({"target": "depth"}, "target"),
    ],
)
def test_options_that_do_not_go_together(options, message):
    if options.get("target") == "depth":
        part = registry.load().find(registry.TRAINER, "keypointnet")
        with pytest.raises(ConfigError, match=message):
            part.create(None, options=options)
    else:
        with pytest.raises(ConfigError, match=message):
            replace(SMALL, **options)
