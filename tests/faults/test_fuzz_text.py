"""Trajectories, configurations and suites: text from anybody."""

from __future__ import annotations

import gzip
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from hypothesis import strategies as st
from recordings import true_trajectory

from faults.fuzzing import YAML_BOMBS, bounded, budgets, damaged, fuzz, misshapen, written
from vioframe.bench.suites import suite as suites
from vioframe.errors import ConfigError, TrajectoryError
from vioframe.io.trajectories import load_trajectory, write_euroc, write_tum
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import read_tree
from vioframe.simulation import config as simulation

INSTALLED = registry.load()
TRAJECTORIES = {"truth.tum": write_tum, "truth.tum.gz": write_tum, "truth.csv": write_euroc}


def load(path: Path) -> None:
    for options in ({}, {"complete_lines_only": True, "keep_first_of_repeats": True}):
        trajectory = load_trajectory(path, **options)
        assert (np.diff(trajectory.t_ns) > 0).all()
        assert np.isfinite(trajectory.p_WB).all()
        assert np.isfinite(trajectory.R_WB).all()
        assert np.allclose(np.linalg.det(trajectory.R_WB), 1.0)


@pytest.mark.parametrize("name", TRAJECTORIES)
@budgets(quick=40, thorough=3000)
def test_bytes_of_a_trajectory(tmp_path, name, examples):
    path = tmp_path / name
    TRAJECTORIES[name](true_trajectory(), path)
    load(path)

    def use(data: bytes) -> None:
        path.write_bytes(data)
        load(path)

    fuzz(examples, damaged(path.read_bytes()), use)


FIELDS = st.sampled_from(
    [
        *("0", "1", "-1", "nan", "inf", "1e400", "1e308", "1e-320", "0.1", "1.7e18", "1e30", "9" * 5000, "1e9999999"),
        *("-0", "", "x", "١", "1_0", "0x1", "1e-9999999", "-1e18", "\0", "1403636584763555584", "NaN123", "sNaN"),
    ]
)


@budgets(quick=40, thorough=3000)
def test_columns_of_a_trajectory(tmp_path, examples):
    path = tmp_path / "made.txt"

    def use(made: tuple[str, list[list[str]]]) -> None:
        separator, rows = made
        path.write_text("\n".join(separator.join(row) for row in rows), encoding="utf-8")
        load(path)

    columns = st.sampled_from([8, 8, 8, 11, 17, 1, 4])
    rows = columns.flatmap(lambda n: st.lists(st.lists(FIELDS, min_size=n, max_size=n), min_size=1, max_size=4))
    fuzz(examples, st.tuples(st.sampled_from([" ", ","]), rows), use)


def test_a_trajectory_that_unpacks_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("vioframe.io.trajectories._MOST_BYTES", 2**24)
    path = tmp_path / "truth.tum.gz"
    path.write_bytes(gzip.compress(bytes(2**28), 1))
    with bounded(), pytest.raises(TrajectoryError, match="holds more than 16 MiB"):
        load_trajectory(path)


def use_configuration(path: Path) -> None:
    installed = INSTALLED
    config = configuration.read(path)
    complete = configuration.complete(config.model_copy(update={"dataset": configuration.DatasetConfig()}), installed)
    again = path.with_name("again.yaml")
    again.write_text(configuration.render(complete, installed))
    configuration.read(again)


READ = {"configuration": use_configuration, "suite": suites.read, "simulation": simulation.read}


def good_tree(kind: str) -> dict[str, object]:
    if kind == "suite":
        return read_tree(suites.find("euroc")) | {"reference": {}}
    model = configuration.Config() if kind == "configuration" else simulation.SimulationConfig()
    if kind == "configuration":
        model = configuration.complete(model, INSTALLED)
    return read_tree_of(model)


def read_tree_of(section: configuration.Section) -> dict[str, object]:
    path = Path(mkdtemp()) / "good.yaml"
    path.write_text(configuration.to_yaml(section))
    return read_tree(path)


@pytest.mark.parametrize("kind", READ)
@budgets(quick=40, thorough=3000)
def test_keys_and_values_of_settings(tmp_path, kind, examples):
    def use(tree: dict[str, object]) -> None:
        path = Path(mkdtemp(dir=tmp_path)) / "bad.yaml"
        path.write_text(written(tree))
        READ[kind](path)

    use(good_tree(kind))
    fuzz(examples, misshapen(good_tree(kind)), use)


@pytest.mark.parametrize("bomb", YAML_BOMBS.values(), ids=YAML_BOMBS)
def test_a_bomb_in_settings_is_refused(tmp_path, bomb):
    path = tmp_path / "bad.yaml"
    path.write_text(bomb.replace("KEY", "frontend"))
    with bounded(), pytest.raises(ConfigError):
        use_configuration(path)
