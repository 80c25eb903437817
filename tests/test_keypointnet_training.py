"""Training a KeypointNet: the loss falls, a resumed training is one not interrupted, and what can go wrong says so."""

import csv
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

torch = pytest.importorskip("torch")

from keypointnet_helpers import texture  # noqa: E402

from vioframe.bench.detectors.degradations import line_kernel  # noqa: E402
from vioframe.cli import main  # noqa: E402
from vioframe.errors import ConfigError  # noqa: E402
from vioframe.interfaces import Trainer  # noqa: E402
from vioframe.parts import registry  # noqa: E402
from vioframe.types import TrainingJob  # noqa: E402
from vioframe_keypointnet import (  # noqa: E402
    runtimes,
    vioframe_trainers,
    weights,
)
from vioframe_keypointnet.options import KeypointNetOptions, TrainingOptions  # noqa: E402
from vioframe_keypointnet.selection import padded_to_cells  # noqa: E402
from vioframe_keypointnet.training import samples, trainer  # noqa: E402
from vioframe_keypointnet.training.samples import Picture, batch, disturbed, gather, pair, split  # noqa: E402
from vioframe_keypointnet.training.trainer import Training, step_losses, validate  # noqa: E402

SMALL = TrainingOptions(width=0.25, size=(96, 64), batch=2, epochs=2, epoch_samples=4, threads=1)
PUBLISHED = replace(SMALL, network="full", width=0.0625)
FLAGS = ["-o", "width=0.25", "-o", "size=[96, 64]", "-o", "batch=2", "-o", "epoch_samples=4", "-o", "threads=1"]


def scene(seed):
    """Patches with corners: what a detector can learn to find."""
    rng = np.random.default_rng(seed)
    image = texture((100, 140), seed)
    for _ in range(12):
        x, y = rng.integers(0, 120), rng.integers(0, 80)
        cv2.rectangle(image, (int(x), int(y)), (int(x) + 22, int(y) + 15), int(rng.integers(0, 255)), -1)
    return image


@pytest.fixture(scope="module")
def pictures():
    return [Picture(f"scene{k}.png", scene(k)) for k in range(3)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    for k in range(4):
        cv2.imwrite(str(folder / f"scene{k}.png"), scene(k))
    return folder


@pytest.mark.parametrize("options", [SMALL, PUBLISHED], ids=["compact", "full"])
@pytest.mark.parametrize("taught", [True, False], ids=["lessons", "published losses"])
def test_steps_lower_the_loss_of_a_fixed_batch(pictures, options, taught):
    options = replace(options, dropout=0.0)
    training = Training(options, pictures)
    pairs = batch(pictures, options, 0)
    optimiser = torch.optim.Adam([*training.network.parameters(), *training.judge.parameters()], lr=1e-3)
    totals = []
    for _ in range(12):
        values = step_losses(training.network, training.judge, options, pairs, taught=taught)
        optimiser.zero_grad()
        values["total"].backward()
        optimiser.step()
        totals.append(values["total"].item())
        assert np.isfinite(totals[-1])
    assert totals[-1] < 0.9 * totals[0]


@pytest.mark.parametrize(
    ("taught", "only", "total"),
    [
        (False, None, 1.0 + 2.0 * 10.0 + 100.0 + 1000.0),
        (False, "detector", 1.0 + 100.0),
        (False, "descriptors", 10.0),
        (True, None, 1.0 + 2.0 + 4.0),
        (True, "detector", 1.0 + 2.0),
        (True, "descriptors", 4.0),
    ],
)
def test_losses_are_weighted_as_published(pictures, monkeypatch, taught, only, total):
    """Twice the descriptors', once the others (alpha 1, beta 2, lambda 1); of lessons, what they say themselves."""
    of_detector = {"location": torch.tensor(1.0), "score": torch.tensor(100.0)}
    of_all = of_detector | {"descriptor": torch.tensor(10.0), "inlier": torch.tensor(1000.0)}
    told = {
        "losses": lambda a, b, homography, judge: of_detector if judge is None else of_all,
        "matching_loss": lambda *_: torch.tensor(4.0),
        "teach": lambda *_: {"place": torch.tensor(1.0), "corner": torch.tensor(2.0)},
    }
    for name, stand_in in told.items():
        monkeypatch.setattr(trainer, name, stand_in)
    training = Training(replace(SMALL, only=only), pictures)
    pairs = batch(pictures, training.options, 0)
    values = step_losses(training.network, training.judge, training.options, pairs, taught=taught)
    assert float(values["total"]) == total


@pytest.mark.parametrize("options", [SMALL, PUBLISHED], ids=["compact", "full"])
def test_descriptors_alone_are_trained_beside_a_detector_left_as_it_is(pictures, options):
    training = Training(replace(options, only="descriptors", lesson_epochs=1), pictures)
    before = training.weights()
    totals = [values["total"] for values in training.steps()]
    after = training.weights()
    assert len(totals) == 4
    assert np.isfinite(totals).all()
    image = padded_to_cells(pictures[0].pixels)
    asked = KeypointNetOptions(descriptors=True, threads=1)
    found = [runtimes.start("torch", "float32", w, asked)(image) for w in (before, after)]
    np.testing.assert_array_equal(found[0][0], found[1][0])
    assert np.abs(found[0][1] - found[1][1]).max() > 1e-4


@pytest.mark.parametrize("options", [SMALL, PUBLISHED], ids=["compact", "full"])
def test_a_detector_trained_alone_is_the_same_detector(pictures, options):
    """What it is taught does not depend on whether descriptors are computed beside; these have no weights then."""
    options = replace(options, dropout=0.0)
    pairs = batch(pictures, options, 0)
    gradients = []
    for only, judged in ((None, True), ("detector", False)):
        training = Training(replace(options, only=only), pictures)
        for part in (training.network, training.judge):
            part.train()
        values = step_losses(training.network, training.judge, training.options, pairs)
        assert ("descriptor" in values) == ("inlier" in values) == judged
        (values["location"] + values["score"]).backward()
        detecting = [w for part in trainer._detecting(training.network) for w in part.parameters()]
        gradients.append([w.grad for w in detecting if w.grad is not None])
        assert training.weights().has_descriptors == judged
    for alone, beside in zip(*gradients, strict=True):
        torch.testing.assert_close(alone, beside)


def states(training):
    return [*training.network.state_dict().values(), *training.judge.state_dict().values()]


@pytest.mark.parametrize("stop", [1, 3])
def test_a_resumed_training_is_one_not_interrupted(pictures, tmp_path, stop):
    options = replace(SMALL, lesson_epochs=1)
    whole = Training(options, pictures)
    for _ in whole.steps():
        pass
    first = Training(options, pictures)
    for _ in range(stop):
        next(first.steps())
    first.save(tmp_path / "checkpoint.pt", [{"epoch": 1.0}])
    torch.manual_seed(999)
    second = Training(options, pictures)
    assert second.resume(tmp_path / "checkpoint.pt") == [{"epoch": 1.0}]
    for _ in second.steps():
        pass
    assert second.step == whole.step == 4
    assert all(torch.equal(a, b) for a, b in zip(states(whole), states(second), strict=True))


def test_it_does_not_matter_who_makes_the_views(pictures):
    trained = [Training(replace(SMALL, workers=workers), pictures) for workers in (0, 2)]
    for training in trained:
        assert len(list(training.steps())) == 4
    for alone, together in zip(*map(states, trained), strict=True):
        assert torch.equal(alone, together)


def test_a_checkpoint_of_another_training_is_refused(pictures, tmp_path):
    path = tmp_path / "checkpoint.pt"
    Training(SMALL, pictures).save(path, [])
    Training(replace(SMALL, epochs=9), pictures).resume(path)
    with pytest.raises(ConfigError, match=r"other options \(learning_rate\)"):
        Training(replace(SMALL, learning_rate=1e-5), pictures).resume(path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ConfigError, match="damaged"):
        Training(SMALL, pictures).resume(path)


def test_the_learning_rate_is_halved_where_asked(pictures):
    training = Training(replace(SMALL, halve_at=(1,)), pictures)
    rates = [training._optimiser.param_groups[0]["lr"] for _ in training.steps()]
    assert rates == [1e-3, 1e-3, 5e-4, 5e-4]


def test_pairs_are_views_of_one_image(pictures):
    """The target, warped back by the homography, is the source, where light does not differ."""
    options = replace(SMALL, photometric_probability=0.0)
    for number in range(6):
        one = pair(pictures[0], options, number)
        back = cv2.warpPerspective(
            one.target[0], np.linalg.inv(one.homography), SMALL.size, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan
        )
        seen = np.isfinite(back)
        assert seen.mean() > 0.2
        assert np.median(np.abs(back - one.source[0])[seen]) < 0.03
        again = pair(pictures[0], options, number)
        np.testing.assert_array_equal(again.source, one.source)
        np.testing.assert_array_equal(again.homography, one.homography)


def test_an_epoch_takes_every_image():
    order = [samples._order(k, 7, seed=0) for k in range(21)]
    assert sorted(order[:7]) == sorted(order[7:14]) == list(range(7))
    assert order[:7] != order[7:14]


LIGHT = ("_EXPOSURE", "_GAMMA", "_CONTRAST", "_BRIGHTNESS", "_BLUR_SIGMA_PX", "_MOTION_BLUR_PX", "_NOISE_SIGMA")
UNCHANGED = ((1.0, 1.0), (1.0, 1.0), (1.0, 1.0), 0.0, 0.1001, 1.0, 0.0)


def test_each_photometric_effect_does_what_it_says(monkeypatch):
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal(0.5, 0.15, (60, 80)), 0.0, 1.0).astype(np.float32)

    def in_light(seed=0, **effect):
        for name, value in (dict(zip(LIGHT, UNCHANGED, strict=True)) | effect).items():
            monkeypatch.setattr(samples, name, value)
        return disturbed(image, np.random.default_rng(seed), 1.0)

    # A line of one pixel is shared out over two.
    monkeypatch.setattr(samples, "line_kernel", lambda px, _: line_kernel(px, 0.3) if px > 1.0 else np.ones((1, 1)))
    np.testing.assert_allclose(in_light(), image, atol=1e-6)
    np.testing.assert_allclose(in_light(_EXPOSURE=(1.5, 1.5)), np.minimum(1.5 * image, 1.0), atol=1e-6)
    np.testing.assert_allclose(in_light(_GAMMA=(2.0, 2.0)), image**2, atol=1e-6)
    assert in_light(_CONTRAST=(0.4, 0.4)).std() == pytest.approx(0.4 * image.std(), rel=1e-3)
    assert 0.001 < (in_light(2, _NOISE_SIGMA=0.1) - image).std() < 0.1
    assert in_light(_MOTION_BLUR_PX=9.0).std() < 0.9 * image.std()
    assert in_light(_BLUR_SIGMA_PX=2.0).std() < 0.99 * image.std()
    assert abs(in_light(1, _BRIGHTNESS=0.2).mean() - image.mean()) > 0.005


def test_images_come_from_folders_in_grey(tmp_path):
    (tmp_path / "deep").mkdir()
    colour = np.zeros((80, 100, 3), np.uint8)
    colour[..., 2] = 200  # red, in OpenCV's order
    cv2.imwrite(str(tmp_path / "deep" / "red.png"), colour)
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((20, 20), np.uint8))
    (tmp_path / "notes.txt").write_text("no image")
    (grey,) = gather([tmp_path], 10)
    assert grey.pixels.shape == (80, 100)
    assert grey.pixels[0, 0] == 60  # 0.299 of 200


def test_images_come_from_recordings(shared_data):
    frames = gather([shared_data / "euroc/MH_01_easy_15s"], 7)
    assert len(frames) == 7
    assert len({f.name for f in frames}) == 7
    assert frames[0].pixels.shape == (480, 752)
    assert not np.array_equal(frames[0].pixels, frames[-1].pixels)


def simulated(recording, manifest):
    """A recording of the simulator's, as far as it says so itself."""
    images = recording / "mav0" / "cam0" / "data"
    images.mkdir(parents=True)
    for number in range(2):
        cv2.imwrite(str(images / f"{number}.png"), scene(number))
    (recording / "simulation").mkdir()
    (recording / "simulation" / "manifest.yaml").write_text(manifest)
    return recording


def test_simulated_worlds_are_known_by_their_recordings_and_what_is_around_and_in_them(tmp_path):
    flown = simulated(tmp_path / "flown", "seed: 5\nflight: {name: hover}\n")
    along = simulated(tmp_path / "along", "seed: 6\nrecorded: /data/MH_05_difficult\n")
    first = {"seed": 5, "flight": "hover", "world": "hall"}
    second = {"seed": 6, "flight": "MH_05_difficult", "world": "hall"}
    assert samples.simulated_worlds([flown, along]) == [first, second]
    assert samples.simulated_worlds([flown / "mav0" / "cam0" / "data"]) == [first]
    assert samples.simulated_worlds([tmp_path]) == [second, first]
    bag = tmp_path / "elsewhere" / "flight.bag"
    bag.with_name("flight.bag.simulation").mkdir(parents=True)
    (bag.with_name("flight.bag.simulation") / "manifest.yaml").write_text("seed: 5\nflight: {name: hover}\n")
    assert samples.simulated_worlds([bag]) == [first]
    assert samples.simulated_worlds([bag.with_name("real.bag")]) == []


def test_the_card_names_the_simulated_worlds_of_all_that_led_to_the_weights(folder, tmp_path):
    """Those it began with, those before it was interrupted, and those after; each once."""
    flown = [simulated(tmp_path / f"flight{seed}", f"seed: {seed}\n") for seed in (0, 1, 2)]
    once = train("--images", flown[0] / "mav0", "--out", tmp_path / "a", "-o", "epochs=1", *FLAGS)
    assert once.exit_code == 0, once.output
    first = ["--images", flown[1] / "mav0", "--out", tmp_path / "b"]
    fine = train(*first, "--finetune", tmp_path / "a" / "keypointnet.safetensors", "-o", "epochs=1", *FLAGS)
    assert fine.exit_code == 0, fine.output
    more = ["--images", flown[1] / "mav0", "--images", flown[2] / "mav0", "--images", folder, "--resume"]
    rest = train(*more, "--out", tmp_path / "b", "-o", "epochs=2", *FLAGS)
    assert rest.exit_code == 0, rest.output
    worlds = weights.load(tmp_path / "b" / "keypointnet.safetensors").card["simulated_worlds"]
    assert worlds == [{"seed": seed, "flight": "figure_eight", "world": "hall"} for seed in (0, 1, 2)]


@pytest.mark.parametrize(("seed", "purpose"), [(1000, "tuning"), (3000, "reporting")])
def test_worlds_for_tuning_and_reporting_are_not_trained_on(folder, tmp_path, seed, purpose):
    flight = simulated(tmp_path / "flight", f"seed: {seed}\n")
    result = train("--images", folder, "--images", flight, "--out", tmp_path / "out", *FLAGS[:2])
    assert result.exit_code == 2
    assert len(result.output.strip().splitlines()) == 1
    assert f"seed {seed}, a world kept for {purpose}; simulate it with a --seed for training, 0 to 999" in result.output
    assert not (tmp_path / "out").exists()


def test_images_are_held_out_by_name(pictures):
    train, held = split(pictures, ["scene1"])
    assert [p.name for p in held] == ["scene1.png"]
    assert len(train) == 2
    assert [p.name for p in split(pictures, ["*[02].png"])[1]] == ["scene0.png", "scene2.png"]
    with pytest.raises(ConfigError, match="no image is left to train on"):
        split(pictures, ["scene"])
    with pytest.raises(ConfigError, match="no image is named like"):
        split(pictures, ["dog"])


def test_validation_of_points_that_never_move(pictures):
    """A network whose score and place are those of the view's pixels finds nothing again; validation is a share."""
    found = validate(Training(SMALL, pictures).weights(), pictures, seed=0)
    assert 0.0 <= found["repeatability"] < 0.8
    assert 0.0 < found["localisation_px"] <= 3.0


def train(*arguments):
    return CliRunner().invoke(main, ["train", "keypointnet", *map(str, arguments)])


def test_command_trains_resumes_and_finetunes(folder, tmp_path):
    out = tmp_path / "training"
    done = train("--images", folder, "--hold-out", "scene3", "--out", out, "-o", "epochs=1", *FLAGS)
    assert done.exit_code == 0, done.output
    assert {p.name for p in out.iterdir()} == {"checkpoint.pt", "log.csv", "keypointnet.safetensors"}
    again = train("--images", folder, "--out", out, *FLAGS)
    assert again.exit_code == 2
    assert "--resume" in again.output
    more = train("--images", folder, "--hold-out", "scene3", "--out", out, "--resume", "-o", "epochs=2", *FLAGS)
    assert more.exit_code == 0, more.output
    assert "4 steps" in more.output
    rows = list(csv.DictReader((out / "log.csv").open()))
    assert [float(row["epoch"]) for row in rows] == [1.0, 2.0]
    assert float(rows[-1]["total"]) > 0.0
    assert 0.0 <= float(rows[-1]["repeatability"]) <= 1.0
    made = weights.load(out / "keypointnet.safetensors")
    assert made.architecture.name == "compact-x0.25"
    assert made.activation_ranges
    assert made.card["trained_on"] == 3
    assert made.card["options"]["epochs"] == 2
    tuned = tmp_path / "tuned"
    made_file = out / "keypointnet.safetensors"
    fine = train(
        "--images",
        folder,
        "--finetune",
        made_file,
        "--out",
        tuned,
        "-o",
        "epochs=1",
        "-o",
        "learning_rate=1e-9",
        *FLAGS,
    )
    assert fine.exit_code == 0, fine.output
    before, after = made.tensors, weights.load(tuned / "keypointnet.safetensors").tensors
    np.testing.assert_allclose(after["conv2a.0.weight"], before["conv2a.0.weight"], atol=1e-6)


def test_the_log_goes_on_where_lessons_end(folder, tmp_path):
    done = train("--images", folder, "--out", tmp_path, "-o", "lesson_epochs=1", "-o", "epochs=2", *FLAGS)
    assert done.exit_code == 0, done.output
    lesson, after = csv.DictReader((tmp_path / "log.csv").open())
    assert float(lesson["place"]) > 0.0
    assert lesson["location"] == after["place"] == ""
    assert float(after["location"]) > 0.0


def test_command_reads_options_from_a_file(folder, tmp_path):
    (tmp_path / "options.yaml").write_text("width: 0.25\nsize: [96, 64]\nbatch: 2\nepoch_samples: 2\nepochs: 1\n")
    done = train("--images", folder, "--config", tmp_path / "options.yaml", "--out", tmp_path / "out", "-o", "seed=3")
    assert done.exit_code == 0, done.output
    assert "1 steps" in done.output
    card = weights.load(tmp_path / "out" / "keypointnet.safetensors").card
    assert (card["options"]["seed"], card["options"]["batch"]) == (3, 2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--images", "/nowhere"], "/nowhere does not exist"),
        (["--images", "{folder}", "-o", "epochs=0"], "epochs=0: Input should be greater than 0"),
        (["--images", "{folder}", "-o", "epoch=1"], "did you mean 'epochs'"),
        (["--images", "{folder}", "-o", "size=[90, 64]"], "multiples of 8"),
        (["--images", "{folder}", "-o", "patch_ratio=[0.9, 0.7]"], "the least and the largest"),
        (["--images", "{folder}", "--resume"], "nothing to resume"),
        (["--images", "{folder}", "--finetune", "/nowhere.ckpt"], "/nowhere.ckpt"),
        (["--images", "{folder}", "--hold-out", "cat"], "no image is named like"),
        (["--images", "{empty}"], "holds neither photographs nor a recording"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(folder, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    given = [a.format(folder=folder, empty=tmp_path / "empty") for a in arguments]
    result = train(*given, "--out", tmp_path / "out", *FLAGS[:2])
    assert result.exit_code == 2
    assert message in result.output
    assert len(result.output.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_unknown_trainer_lists_those_installed(folder):
    result = CliRunner().invoke(main, ["train", "keypoint", "--images", str(folder)])
    assert result.exit_code == 2
    assert "did you mean 'keypointnet'" in result.output


def test_trainer_is_a_part_like_any(folder, tmp_path):
    part = registry.load().find(registry.TRAINER, "keypointnet")
    job = TrainingJob((folder,), tmp_path / "out")
    trainer = part.create(job, options={"width": 0.25, "size": [96, 64], "batch": 2, "epoch_samples": 2, "epochs": 1})
    assert isinstance(trainer, Trainer)
    assert set(vioframe_trainers()) == {"keypointnet"}
    (step,) = trainer.train()
    assert (step.done, step.total) == (1, 1)
    assert step.epoch is not None


def test_an_interrupted_training_keeps_what_is_done(folder, tmp_path):
    part = registry.load().find(registry.TRAINER, "keypointnet")
    options = {"width": 0.25, "size": [96, 64], "batch": 2, "epoch_samples": 20, "epochs": 1}
    steps = part.create(TrainingJob((folder,), tmp_path / "out"), options=options).train()
    for _ in range(3):
        next(steps)
    steps.close()
    assert [p.name for p in Path(tmp_path / "out").iterdir()] == ["checkpoint.pt"]
    rest = part.create(TrainingJob((folder,), tmp_path / "out", resume=True), options=options).train()
    assert next(rest).done == 4
    rest.close()
