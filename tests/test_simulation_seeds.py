"""Worlds to train in, to tune in and to report on are not the same ones, whoever asks for them."""

import runpy
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

import vioframe_worlds
from vioframe.bench.suites import suite as suites
from vioframe.bench.suites.plan import plan
from vioframe.errors import ConfigError
from vioframe.parts import registry
from vioframe.parts.config import PartConfig
from vioframe.simulation.config import MANIFEST, SimulationConfig, complete, made_of, simulation_folder
from vioframe.simulation.recording import SimulatedRecording
from vioframe.simulation.seeds import SEEDS, purpose_of, seed_for
from vioframe_keypointnet import weights

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
INSTALLED = registry.load()


def test_no_world_serves_two_purposes():
    for one, other in combinations(SEEDS.values(), 2):
        assert not set(one) & set(other)
    assert [purpose_of(seeds[-1]) for seeds in SEEDS.values()] == list(SEEDS)
    assert purpose_of(max(seeds[-1] for seeds in SEEDS.values()) + 1) is None


def test_what_anybody_simulates_may_be_trained_on():
    assert purpose_of(SimulationConfig().seed) == "training"


def test_worlds_are_counted_from_the_first_of_a_purpose():
    assert [seed_for("reporting", number) for number in (0, 1)] == list(SEEDS["reporting"][:2])
    with pytest.raises(ConfigError, match="there are 2000 worlds for tuning, 0 to 1999, and no 2000"):
        seed_for("tuning", 2000)


def test_a_seed_has_the_same_surfaces_wherever_one_flies_and_another_has_others(monkeypatch):
    """So it is by their seeds that worlds are told apart."""

    monkeypatch.setattr(vioframe_worlds, "_TEXTURES", 3)

    def surfaces(seed, flight):
        config = SimulationConfig(seed=seed, flight=PartConfig(name=flight), duration_s=2.0)
        return SimulatedRecording(complete(config, INSTALLED), INSTALLED).world.textures

    one, again, other = surfaces(0, "hover"), surfaces(0, "walk"), surfaces(seed_for("reporting", 0), "hover")
    np.testing.assert_array_equal(one, again)
    assert not any(np.array_equal(a, b) for a in one for b in other)


FLOWN = [name for name, path in suites.shipped().items() if suites.read(path).kind == "flights"]


@pytest.mark.parametrize("name", FLOWN)
def test_a_suite_that_ships_flies_in_worlds_for_reporting_but_for_the_one_to_choose_by(name):
    suite = suites.read(suites.find(name))
    assert suite.worlds == ("tuning" if name == "tuning" else "reporting")
    seeds = {task.recording.config.seed for task in plan(suite, (), INSTALLED)}
    assert seeds
    assert {purpose_of(seed) for seed in seeds} == {suite.worlds}
    assert len(seeds) == (suite.seeds if suite.seeds_vary == "recording" else 1)


def test_options_are_chosen_along_other_motions_than_those_reported_under_hard_conditions():
    chosen, reported = ({each.name for each in suites.read(suites.find(n)).sequences} for n in ("tuning", "stress"))
    assert chosen
    assert not chosen & reported


TOY = "title: toy\ndetectors: [fast]\nbackends: [msckf]\nsequences: [hover]\nseeds: 2\nseeds_vary: recording\n"


@pytest.mark.parametrize("purpose", SEEDS)
def test_a_suite_flies_in_the_worlds_it_names(tmp_path, purpose):
    (tmp_path / "toy.yaml").write_text(f"{TOY}worlds: {purpose}\n")
    tasks = plan(suites.read(tmp_path / "toy.yaml"), (), INSTALLED)
    assert [task.recording.config.seed for task in tasks] == list(SEEDS[purpose][:2])


@pytest.mark.parametrize("script", ["rendered_flights", "loops"])
def test_benchmarks_of_detectors_fly_in_worlds_for_reporting(script, monkeypatch):
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    names = runpy.run_path(str(BENCHMARKS / f"{script}.py"))
    seeds = names["seeds"](names["WORLDS"])
    assert len(seeds) == names["WORLDS"]
    assert {purpose_of(seed) for seed in seeds} == {"reporting"}


@pytest.mark.parametrize("name", weights.shipped())
def test_weights_that_ship_saw_worlds_for_training_alone(name):
    """Cards from before they listed worlds say in words: two flights of seed 0, which nothing may report on."""
    card = weights.load(name).card
    seeds = [world["seed"] for world in card.get("simulated_worlds", [{"seed": 0}])]
    assert {purpose_of(seed) for seed in seeds} <= {"training"}


def test_a_simulated_recording_says_what_it_was_made_of(tmp_path):
    recording = tmp_path / "flight.bag"
    assert made_of(recording) is None
    simulation_folder(recording).mkdir()
    (simulation_folder(recording) / MANIFEST).write_text("seed: 7\n")
    assert made_of(recording) == SimulationConfig(seed=7)
