"""The benchmark of detectors from end to end: images and pairs, who takes part, what the command prints and refuses."""

import json
import re
from itertools import product
from pathlib import Path
from shutil import copytree

import cv2
import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from image_helpers import textured
from plugin_helpers import install
from rendered_flight import rendered_flight

from vioframe.bench.detectors.degradations import Degradation
from vioframe.bench.detectors.entrants import everyone, line_up, parse_entrants
from vioframe.bench.detectors.flight import Stretch, fly_detectors
from vioframe.bench.detectors.images import (
    corners_of,
    evenly,
    find_images,
    fit,
    fitting,
    hpatches_pair,
    hpatches_pairs,
    procedural_images,
    random_homography,
    read_grey,
    synthetic_pair,
    synthetic_pairs,
)
from vioframe.bench.detectors.metrics import lands_inside, warp
from vioframe.bench.detectors.quality import score_detectors
from vioframe.bench.detectors.speed import time_detectors
from vioframe.cli import main
from vioframe.errors import ConfigError, DatasetError, PluginError
from vioframe.parts import registry
from vioframe.parts.config import LabelledPart
from vioframe.types import Keypoints

SIZE = (320, 240)


@pytest.fixture
def photographs(tmp_path):
    """Three textures of 480 x 360."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for k in range(3):
        cv2.imwrite(str(folder / f"{k}.png"), textured(k, (480, 360)))
    return folder


@pytest.fixture
def hpatches(tmp_path):
    """One sequence of 640 x 480 whose views are moved by 20 px times k."""
    sequence = tmp_path / "hpatches" / "v_moved"
    sequence.mkdir(parents=True)
    wide = textured(5, (900, 480))
    for k in range(1, 7):
        cv2.imwrite(str(sequence / f"{k}.ppm"), cv2.merge([wide[:, 20 * (k - 1) :][:, :640]] * 3))
        if k > 1:
            np.savetxt(sequence / f"H_1_{k}", [[1, 0, -20 * (k - 1)], [0, 1, 0], [0, 0, 1]])
    return sequence.parent


@pytest.fixture(scope="module")
def installed():
    return registry.load()


def bench(*arguments, code=0):
    result = CliRunner().invoke(main, ["bench", "detectors", *map(str, arguments)], catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result


def error_line(*arguments):
    result = bench(*arguments, code=2)
    assert result.stderr.count("\n") == 1, result.stderr
    return result.stderr


# Images and pairs


def test_a_view_is_filled_and_cut_evenly():
    """480 x 360 and 320 x 240 are of one shape: corner comes to corner. A wider image loses its sides."""
    A = fitting((360, 480), SIZE)
    np.testing.assert_allclose(warp(A, np.array([[-0.5, -0.5], [479.5, 359.5]])), [[-0.5, -0.5], [319.5, 239.5]])
    A = fitting((360, 600), SIZE)
    np.testing.assert_allclose(warp(A, np.array([[59.5, -0.5], [539.5, 359.5]])), [[-0.5, -0.5], [319.5, 239.5]])


def test_a_fitted_image_looks_as_it_did():
    """A smooth picture, shrunk to two thirds, holds at every pixel what it had at that place."""
    y, x = np.mgrid[:360, :480]
    small = fit(np.round(128 + 60 * np.sin(x / 25.0) + 50 * np.cos(y / 20.0)).astype(np.uint8), SIZE)
    y, x = (np.mgrid[:240, :320] + 0.5) * 1.5 - 0.5
    expected = 128 + 60 * np.sin(x / 25.0) + 50 * np.cos(y / 20.0)
    assert small.shape == (240, 320)
    assert np.abs(small - expected)[3:-3, 3:-3].max() < 1.6


def test_images_are_taken_evenly():
    assert evenly("abcdefg", 3) == ["a", "d", "g"]
    assert evenly("abc", 5) == evenly("abc", None) == ["a", "b", "c"]


def test_procedural_images_are_the_same_for_the_same_seed_and_hold_corners():
    one, again, other = (procedural_images(2, (640, 480), seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)
    assert all(image.shape == (480, 640) and len(cv2.goodFeaturesToTrack(image, 300, 0.01, 5)) == 300 for image in one)


@pytest.mark.parametrize("seed", range(5))
def test_a_random_homography_keeps_most_of_the_view(seed):
    H = random_homography(np.random.default_rng(seed), SIZE)
    x, y = np.meshgrid(np.arange(0.0, 320.0, 4), np.arange(0.0, 240.0, 4))
    xy = np.column_stack([x.ravel(), y.ravel()])
    assert lands_inside(xy, H, SIZE).mean() > 0.4
    np.testing.assert_allclose(warp(np.linalg.inv(H), warp(H, xy)), xy, atol=1e-6)
    corners = warp(H, corners_of(SIZE))
    assert np.linalg.norm(corners - corners_of(SIZE), axis=1).min() > 1.0


@pytest.mark.parametrize("seed", range(3))
def test_the_views_of_a_pair_are_as_far_apart_as_their_homography_says(photographs, seed):
    views = synthetic_pair(photographs / "0.png", (seed,), SIZE)
    back = cv2.warpPerspective(views.second, np.linalg.inv(views.H_21), SIZE)
    inside = cv2.warpPerspective(np.full((240, 320), 255, np.uint8), np.linalg.inv(views.H_21), SIZE) == 255
    off = back[inside].astype(float) - views.first[inside]
    assert np.sqrt(np.mean(off**2)) < 0.15 * views.first.std()


def test_pairs_of_hpatches_are_known_at_the_size_they_are_compared_at(hpatches):
    """Half the size: moved by half the pixels."""
    assert len(hpatches_pairs(hpatches)) == 5
    views = hpatches_pairs(hpatches)[1](SIZE)
    np.testing.assert_allclose(views.H_21, [[1, 0, -20], [0, 1, 0], [0, 0, 1]], atol=1e-9)
    # Not at the edges, beyond which either image is mirrored before it is smoothed.
    assert np.abs(views.first[:, 24:-4].astype(int) - views.second[:, 4:-24]).max() <= 1


def test_folders_without_what_is_needed_are_refused(tmp_path, hpatches, photographs):
    with pytest.raises(DatasetError, match="holds no images"):
        find_images(_empty(tmp_path))
    with pytest.raises(DatasetError, match="is not a folder"):
        synthetic_pairs(tmp_path / "nowhere", 0)
    with pytest.raises(DatasetError, match=r"no folders i_\* and v_\*"):
        hpatches_pairs(photographs)
    (hpatches / "v_moved" / "H_1_4").write_text("1 0 0\n0 1 0\n")
    with pytest.raises(DatasetError, match="H_1_4 is no homography"):
        hpatches_pair(hpatches / "v_moved", 4, SIZE)
    (hpatches / "v_moved" / "H_1_4").unlink()
    with pytest.raises(DatasetError, match="H_1_4 is missing"):
        hpatches_pairs(hpatches)
    (photographs / "1.png").write_bytes(b"no image")
    with pytest.raises(DatasetError, match=r"1\.png cannot be decoded"):
        read_grey(photographs / "1.png")


def _empty(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


# Who takes part


def test_every_installed_detector_takes_part_unless_some_are_named(installed):
    names = installed.names(registry.DETECTOR)
    assert everyone(installed, "frontend") == names
    for question in ("speed", "quality"):
        specs = everyone(installed, question)
        assert sorted({spec.partition(":")[0] for spec in specs}) == names
        assert len(specs) == len(set(specs)) > len(names)
    assert [e.label for e in parse_entrants(["orb", "sift", "orb"], (), installed)] == ["orb", "sift"]


def test_options_go_to_whom_they_are_meant_for(installed):
    specs = ["orb", "orb:levels=2,fast_threshold=9", "sift"]
    entrants = parse_entrants(specs, ["orb.fast_threshold=7", "contrast_threshold=0.01"], installed)
    assert [e.label for e in entrants] == specs
    assert [dict(e.options) for e in entrants] == [
        {"fast_threshold": 7},
        {"fast_threshold": 9, "levels": 2},
        {"contrast_threshold": 0.01},
    ]


def test_descriptors_are_asked_of_those_that_have_them(installed):
    orb, fast = parse_entrants(["orb", "fast"], (), installed, describing=True)
    assert (dict(orb.options), dict(fast.options)) == ({"descriptors": True}, {})


def test_wrong_names_and_options_are_errors(installed):
    with pytest.raises(PluginError, match="no detector is called 'sitf'"):
        parse_entrants(["sitf"], (), installed)
    with pytest.raises(ConfigError, match="no part has such an option"):
        parse_entrants(["orb"], ["threshold_of_pain=3"], installed)
    with pytest.raises(ConfigError, match="levels='many'"):
        parse_entrants(["orb:levels=many"], (), installed)


BROKEN = """
import numpy as np
from vioframe.types import Keypoints

class Corner:
    "Finds one point, unless it is told to fail from some call on."
    device, precision = "cuda", "float16"
    def __init__(self, *, weights: str = "missing", fail_at: int = 99):
        if weights == "missing":
            raise FileNotFoundError("no weights; train some")
        self.calls, self.fail_at = 0, fail_at
    def detect(self, image, max_points):
        self.calls += 1
        if self.calls >= self.fail_at: raise ZeroDivisionError("by zero")
        return Keypoints(np.full((1, 2), 9.0, np.float32), np.ones(1, np.float32))

@hookimpl
def vioframe_detectors(): return {"corner": Corner}
"""


@pytest.fixture
def with_broken(tmp_path, monkeypatch):
    install(tmp_path / "site", monkeypatch, distribution="corner-parts", module="corner_parts", code=BROKEN)
    return registry.load()


def test_who_cannot_be_made_is_listed_with_the_reason(with_broken):
    lined_up = line_up(parse_entrants(["corner", "fast"], (), with_broken), with_broken)
    assert [entrant.label for entrant, _ in lined_up.ready] == ["fast"]
    assert "no weights; train some" in lined_up.absent["corner"]
    with pytest.raises(ConfigError, match=r"no detector can take part: corner: .*no weights"):
        line_up(parse_entrants(["corner"], (), with_broken), with_broken)


# Speed


def test_every_call_is_counted(with_broken):
    entrants = parse_entrants(["corner:weights=own", "shi_tomasi"], (), with_broken)
    rounds = []
    rows = time_detectors(
        line_up(entrants, with_broken).ready, {"textures": [textured(k) for k in range(4)]}, 3, on_round=rounds.append
    )
    assert len(rounds) == 4  # one of them to warm up
    corner, shi_tomasi = rows.to_dict("records")
    assert corner["calls"] == shi_tomasi["calls"] == 12
    assert (corner["on"], shi_tomasi["on"]) == ("cuda, float16", "cpu")
    assert (corner["keypoints"], shi_tomasi["keypoints"] > 100) == (1.0, True)
    assert 0.0 < shi_tomasi["fps_low"] <= shi_tomasi["fps"] <= shi_tomasi["fps_high"]
    assert shi_tomasi["ms_low"] <= shi_tomasi["ms"] == pytest.approx(1e3 / shi_tomasi["fps"])


def test_a_detector_that_fails_on_the_way_is_named(with_broken):
    ready = line_up(parse_entrants(["corner:weights=own,fail_at=3"], (), with_broken), with_broken).ready
    with pytest.raises(PluginError, match="corner:weights=own,fail_at=3 failed: ZeroDivisionError"):
        time_detectors(ready, {"textures": [textured()]}, 2)


def test_speeds_are_shown_and_kept(tmp_path):
    keep = tmp_path / "speed.json"
    out = bench(
        "--detector", "shi_tomasi", "--detector", "orb", "--rounds", 1, "--limit", 2, "--quiet", "--record", keep
    )
    shown = {line.split()[0]: line.split() for line in out.stdout.splitlines() if line.strip()}
    for name in ("shi_tomasi", "orb"):
        assert float(shown[name][1]) > 0.0
        assert shown[name][-1] == "cpu"
    content = json.loads(keep.read_text())
    assert [row["detector"] for row in content["results"]] == ["shi_tomasi", "orb"]
    assert content["settings"]["question"] == "speed"
    assert content["machine"]["cpu"] in content["settings"]["devices"][0]


def test_one_run_times_drawn_surfaces_photographs_and_frames_alike(photographs, flight, tmp_path):
    keep = tmp_path / "speed.json"
    arguments = [flight[0], "--images", photographs, "--detector", "shi_tomasi", "--detector", "fast"]
    out = bench(*arguments, "--rounds", 2, "--limit", 2, "--quiet", "--record", keep)
    kinds = ["drawn surfaces", "photographs of photographs", "frames of flight"]
    rows = json.loads(keep.read_text())["results"]
    assert [(row["images"], row["detector"]) for row in rows] == list(product(kinds, ["shi_tomasi", "fast"]))
    assert {(row["image_count"], row["calls"]) for row in rows} == {(2, 4)}
    for kind in kinds:
        _, _, table = out.stdout.partition(f"2 images, {kind}\n")
        assert [line.split()[0] for line in table.splitlines()[1:3]] == ["shi_tomasi", "fast"]


def test_figures_of_a_kind_of_images_are_of_its_calls_alone():
    """Five points in white images and two in black ones, whatever order they come in."""

    class Sees:
        def detect(self, image, max_points):
            count = 5 if image[0, 0] else 2
            return Keypoints(np.zeros((count, 2), np.float32), np.ones(count, np.float32))

    white, black = np.full((8, 8), 255, np.uint8), np.zeros((8, 8), np.uint8)
    rows = time_detectors([(LabelledPart(name="sees"), Sees())], {"black": [black] * 3, "white": [white]}, 4)
    assert rows[["images", "image_count", "keypoints", "calls"]].to_numpy().tolist() == [
        ["black", 3, 2.0, 12],
        ["white", 1, 5.0, 4],
    ]


# Quality


def test_scores_do_not_depend_on_the_number_of_processes(installed, photographs):
    entrants = parse_entrants(["shi_tomasi"], (), installed)
    pairs = synthetic_pairs(photographs, 3)
    degradations = [Degradation(), Degradation("noise", 0.05), Degradation("motion_blur", 0.02)]
    done = []
    one, two = (score_detectors(entrants, pairs, degradations, seed=3, workers=n, on_pairs=done.append) for n in (1, 2))
    assert one.equals(two)
    assert sum(done) == 6
    clean, noisy, blurred = (one[one["degradation"] == each.name]["repeatability"] for each in degradations)
    assert len(clean) == len(noisy) == len(blurred) == 3
    assert clean.mean() > max(noisy.mean(), blurred.mean())
    assert clean.min() > 0.4


def test_the_quality_of_two_detectors(photographs, tmp_path):
    keep = tmp_path / "quality.json"
    arguments = ["--quality", "--images", photographs, "--detector", "shi_tomasi", "--detector", "orb", "--workers", 1]
    out = bench(*arguments, "--degradation", "noise", "--quiet", "--record", keep)
    assert "3 pairs (photographs, synthetic homographies)" in out.stdout
    assert "lead over shi_tomasi" in out.stdout
    content = json.loads(keep.read_text())
    assert content["settings"]["detectors"] == {"shi_tomasi": {}, "orb": {"descriptors": True}}
    rows = content["results"]
    assert len(rows) == 2 * 4
    shi_tomasi, orb = rows[:2]
    assert shi_tomasi["matching_score"] is None
    assert orb["matching_score"] > 0.2
    assert 0.0 <= orb["homography_1px"] <= orb["homography_5px"] <= 1.0
    assert orb["lead_repeatability"] == pytest.approx(orb["repeatability"] - shi_tomasi["repeatability"])
    assert (shi_tomasi["pairs"], shi_tomasi["lead_repeatability"]) == (3, None)


def test_hpatches_is_measured_as_it_is(hpatches):
    out = bench("--quality", "--hpatches", hpatches, "--detector", "sift", "--degradation", "none", "--workers", 1)
    assert "5 pairs (HPatches)" in out.stdout
    assert "by degradation" not in out.stdout
    sift = next(line for line in out.stdout.splitlines() if line.startswith("sift")).split()
    assert float(sift[2]) > 0.7  # repeatability
    assert [float(x) for x in sift[8:11]] == [1.0, 1.0, 1.0]  # homographies right at 1, 3 and 5 px


# The front-end


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    recording = rendered_flight().write(folder / "flight")
    return recording, rendered_flight().write_ground_truth(folder / "truth.tum")


def test_the_front_end_follows_less_far_in_noise(installed, flight):
    recording, truth = flight
    entrants = parse_entrants(["shi_tomasi", "fast"], (), installed)
    degradations = [Degradation(), Degradation("noise", 0.1)]
    rows = fly_detectors(entrants, Stretch(recording, 2.0, 4.0, truth), degradations, seed=0, workers=1)
    assert list(zip(rows["detector"], rows["degradation"], strict=True)) == [
        ("shi_tomasi", "none"),
        ("fast", "none"),
        ("shi_tomasi", "noise"),
        ("fast", "noise"),
    ]
    clean, fast, noisy, _ = (row for _, row in rows.iterrows())
    assert clean["frames"] == 41
    assert clean["alive"] > 80
    assert 1.0 > clean["survival_5"] > clean["survival_20"] > 0.3
    assert noisy["survival_10"] < clean["survival_10"]
    assert clean["epipolar_inliers"] > 0.95
    assert noisy["epipolar_median_px"] > clean["epipolar_median_px"]
    assert 0.5 < clean["coverage"] <= 1.0
    assert fast["lead_survival_10"] == pytest.approx(fast["survival_10"] - clean["survival_10"])
    again = fly_detectors(entrants, Stretch(recording, 2.0, 4.0, truth), degradations[1:], seed=0, workers=1)
    pd.testing.assert_frame_equal(again, rows[2:].reset_index(drop=True))


def test_the_front_end_by_the_command(flight):
    recording, truth = flight
    arguments = ["--frontend", recording, "--ground-truth", truth, "--start", 2, "--duration", 2, "--workers", 1]
    out = bench(*arguments, "--detector", "shi_tomasi", "--degradation", "gamma")
    for figure in ("alive after 10 frames", "epipolar inliers", "cells covered", "fewer than half"):
        assert re.search(f"{figure}.*, by degradation", out.stdout)
    assert "gamma 2.5" in out.stdout
    assert "4/4 flights" in out.stderr


def test_of_a_simulated_recording_its_seed_is_shown_and_kept(flight, tmp_path):
    copytree(flight[0], tmp_path / "flight")
    (tmp_path / "flight" / "simulation").mkdir()
    (tmp_path / "flight" / "simulation" / "manifest.yaml").write_text("seed: 3001\n")
    arguments = ["--frontend", tmp_path / "flight", "--ground-truth", flight[1], "--duration", 1, "--workers", 1]
    out = bench(*arguments, "--detector", "fast", "--degradation", "none", "--record", tmp_path / "kept.json")
    assert "flight (simulated, seed 3001, for reporting), 1 s" in out.stdout
    assert json.loads((tmp_path / "kept.json").read_text())["settings"]["simulated_seed"] == 3001


def test_a_recording_without_truth_or_images_is_refused(flight):
    recording, truth = flight
    assert "name a file of it with --ground-truth" in error_line("--frontend", recording, "--quiet")
    late = error_line("--frontend", recording, "--ground-truth", truth, "--start", 99, "--workers", 1, "--quiet")
    assert "no image" in late


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--quality", "--frontend"], "two questions"),
        (["--quality"], "no images given"),
        (["--frontend"], "no recording given"),
        (["somewhere.bag"], "somewhere.bag does not exist"),
        (["--quality", "somewhere.bag"], "DATASET would do nothing here: it goes with --frontend or is about speed"),
        (["--hpatches", "."], "--hpatches would do nothing here: it goes with --quality"),
        (["--degradation", "noise"], "--degradation would do nothing here: it goes with --quality or --frontend"),
        (["--quality", "--rounds", "3"], "--rounds would do nothing here: it is about speed alone"),
        (["--quality", "--images", ".", "--degradation", "fog"], "no degradation is called 'fog'"),
        (["--quality", "--images", ".", "--hpatches", "."], "two sets of pairs"),
        (["--quality", "--images", ".", "--baseline", "orbb"], "--baseline orbb does not take part; one of "),
        (["--baseline", "orb"], "--baseline would do nothing here: it goes with --quality or --frontend"),
        (["--quality", "--images", "nowhere"], "nowhere is not a folder"),
        (["--images", "nowhere"], "nowhere is not a folder"),
        (["--detector", "nobody"], "no detector is called 'nobody'"),
        (["--frontend", "nowhere.bag"], "nowhere.bag does not exist"),
        (["--frontend", "nowhere.bag", "--duration", "0"], "--duration must be above 0"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(arguments, message):
    assert message in error_line(*arguments)


def test_a_folder_without_images_is_refused(tmp_path):
    assert "holds no images" in error_line("--quality", "--images", _empty(tmp_path))
