"""Metrics come in by name, say what they were made to say, and leave the others alone when they cannot."""

import json
import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from click.testing import CliRunner
from plugin_helpers import install
from trajectory_helpers import BEGIN_NS, PEERS, PERIOD_NS, disturbed, flight, moved, write_run

from vioframe.cli import main
from vioframe.errors import ConfigError, PluginError, TrajectoryError
from vioframe.evaluation import Comparison, evaluate
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory, write_tum
from vioframe.parts import registry
from vioframe.parts.config import PartConfig, parse_part
from vioframe.runs.evaluated import create_metrics, measure
from vioframe.simulation import simulated_sequence
from vioframe.testing import check_metric

needs_evo = pytest.mark.skipif(find_spec("evo") is None, reason="needs evo: pip install 'vioframe[evo]'")

BUILT_IN = ["ate", "band", "nees", "relative"]


@pytest.fixture(scope="module")
def installed():
    return registry.load()


def figures(installed, spec, estimate, truth):
    measured = measure(create_metrics([spec], installed), Comparison.of(estimate, truth))
    assert measured.left_out == {}
    return measured.figures[spec]


def why_left_out(installed, spec, estimate, truth):
    measured = measure(create_metrics([spec], installed), Comparison.of(estimate, truth))
    assert measured.figures == {}
    return measured.left_out[spec]


def with_errors(position_m, speed_m=0.5):
    """Straight along x without turning, and an estimate that is off by ``position_m`` (N, 3), whose mean is zero."""
    n = len(position_m)
    truth = Trajectory(
        BEGIN_NS + PERIOD_NS * np.arange(n),
        np.tile(np.eye(3), (n, 1, 1)),
        np.outer(speed_m * np.arange(n), [1.0, 0.0, 0.0]),
    )
    return Trajectory(truth.t_ns, truth.R_WB, truth.p_WB + position_m), truth


def test_they_come_in_through_the_entry_points(installed):
    assert set(installed.names(registry.METRIC)) >= {*BUILT_IN, "evo"}


@pytest.mark.parametrize("name", [*BUILT_IN, pytest.param("evo", marks=needs_evo)])
def test_they_conform(installed, name):
    check_metric(installed.find(registry.METRIC, name).factory)


def test_a_shifted_and_turned_estimate_has_no_absolute_error(installed):
    truth = flight()
    found = figures(installed, "ate", moved(truth, rotation_z(2.5), np.array([100.0, -20.0, 3.0])), truth)
    assert found == pytest.approx({"ate_m": 0.0, "ate_se3_m": 0.0, "ate_sim3_m": 0.0, "scale": 1.0}, abs=1e-10)


def test_only_sim3_forgives_a_wrong_scale_and_only_se3_a_tilt(installed):
    truth = flight()
    spread_m = np.sqrt(truth.p_WB.var(axis=0).sum())
    grown = figures(installed, "ate", moved(truth, np.eye(3), np.zeros(3), scale=1.25), truth)
    # Every point is off by a quarter of its distance from the mean.
    assert grown["ate_m"] == pytest.approx(0.25 * spread_m, rel=1e-9)
    assert grown["ate_se3_m"] == pytest.approx(0.25 * spread_m, rel=1e-9)
    assert grown["ate_sim3_m"] < 1e-10
    assert grown["scale"] == pytest.approx(0.8, rel=1e-12)
    tilted = figures(installed, "ate", moved(truth, so3.exp(np.array([0.1, 0.0, 0.0])), np.zeros(3)), truth)
    assert tilted["ate_m"] > 0.1
    assert tilted["ate_se3_m"] < 1e-10


def test_a_straight_path_has_no_se3_figure(installed):
    estimate, truth = with_errors(np.zeros((50, 3)))
    assert figures(installed, "ate", estimate, truth) == {"ate_m": pytest.approx(0.0, abs=1e-12)}


def test_the_band_counts_the_instants_inside(installed):
    """Errors that no alignment changes: their mean is zero, y is uncorrelated with the way along x."""
    off = np.zeros((20, 3))
    off[[0, 19], 1] = 0.3  # 2 of 20 outside the default of 0.2 m
    off[[1, 18, 2, 17], 1] = -0.15
    off[[4, 5, 6, 7], 2] = [0.25, -0.25, 0.19, -0.19]
    estimate, truth = with_errors(off)
    assert evaluate(estimate, truth).position_m == pytest.approx(off, abs=1e-12)
    assert figures(installed, "band", estimate, truth) == {
        "inside_x_percent": 100.0,
        "inside_y_percent": 90.0,
        "inside_z_percent": 90.0,
        "inside_all_percent": 80.0,
    }
    wide, narrow = (figures(installed, f"band:half_width_m={w}", estimate, truth) for w in ("0.35", "0.1"))
    assert wide["inside_all_percent"] == 100.0
    assert (narrow["inside_y_percent"], narrow["inside_z_percent"]) == (70.0, 80.0)


def test_relative_error_of_a_scale_is_that_scale_over_every_length(installed):
    truth = flight()
    found = figures(installed, "relative:lengths_m=[5, 20]", moved(truth, np.eye(3), np.zeros(3), scale=1.02), truth)
    assert set(found) == {
        f"{what}_{length}m_{unit}"
        for length in (5, 20)
        for what, unit in (("translation", "percent"), ("yaw", "deg"), ("rotation", "deg"))
    }
    assert found["yaw_5m_deg"] == pytest.approx(0.0, abs=1e-5)
    # 2 % of the straight line between the ends, which is shorter than the way between them.
    assert found["translation_20m_percent"] < found["translation_5m_percent"] < 2.0
    estimate, truth = with_errors(np.zeros((50, 3)))
    straight = figures(installed, "relative:lengths_m=[8]", moved(estimate, np.eye(3), np.zeros(3), scale=1.02), truth)
    assert straight["translation_8m_percent"] == pytest.approx(2.0, rel=1e-9)


def test_relative_and_nees_say_what_evaluate_says(installed):
    truth = flight()
    noisy = disturbed(truth, 0.05, 0.01)
    cov = np.tile(np.diag([1e-4] * 3 + [0.05**2] * 3), (len(truth), 1, 1))
    estimate = Trajectory(noisy.t_ns, noisy.R_WB, noisy.p_WB, cov)
    expected = evaluate(estimate, truth)
    found = figures(installed, "relative", estimate, truth)
    assert len(found) == 3 * len(expected.relative)
    assert found["yaw_8m_deg"] == pytest.approx(expected.relative[8.0].yaw_deg.mean(), rel=1e-12)
    consistency = figures(installed, "nees", estimate, truth)
    for nees in expected.nees:
        assert consistency[f"{nees.part}_nees_mean"] == nees.mean
        assert consistency[f"{nees.part}_inside_95_percent"] == 100.0 * nees.inside


def test_what_cannot_be_told_is_left_out_with_the_reason(installed):
    truth = flight()
    n = len(truth)
    at_rest = Trajectory(truth.t_ns, np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)))
    short, of_short = with_errors(np.zeros((5, 3)))
    assert "no usable covariance" in why_left_out(installed, "nees", truth, truth)
    assert "at rest" in why_left_out(installed, "relative", at_rest, at_rest)
    assert "no stretch of 8 m fits into the path of 2.00 m" in why_left_out(installed, "relative", short, of_short)
    measured = measure(create_metrics(["nees", "ate", "relative"], installed), Comparison.of(at_rest, at_rest))
    assert (list(measured.figures), list(measured.left_out)) == (["ate"], ["nees", "relative"])


@pytest.mark.parametrize(
    ("spec", "error", "why"),
    [
        ("bnad", PluginError, r"no metric is called 'bnad' \(did you mean 'band'\?\); installed: ate, band"),
        ("band:half_width=1", ConfigError, r"metric 'band' has no option 'half_width' \(did you mean 'half_width_m'"),
        ("band:half_width_m=0", ConfigError, "half_width_m=0: Input should be greater than 0"),
        ("band:half_width_m=.inf", ConfigError, "finite number"),
        ("band:half_width_m", ConfigError, "'band:half_width_m': options are given as band:KEY=VALUE,..., got"),
        ("relative:lengths_m=[]", ConfigError, "at least 1 item"),
        ("relative:lengths_m=[8,-1]", ConfigError, "greater than 0"),
        ("ate:level=3", ConfigError, "it has no options"),
    ],
)
def test_wrong_names_and_options_are_errors(installed, spec, error, why):
    with pytest.raises(error, match=why):
        create_metrics([spec], installed)


def test_options_follow_the_name_and_a_list_keeps_its_commas(installed):
    assert parse_part("relative", registry.METRIC, installed) == PartConfig(name="relative")
    (asked,) = create_metrics(["relative:lengths_m=[1,2.5]"] * 2, installed)
    assert asked.label == "relative:lengths_m=[1,2.5]"
    assert parse_part(asked.label, registry.METRIC, installed).options == {"lengths_m": [1, 2.5]}


THIRD_PARTY = """
    class Longest:
        "The longest distance from where it began."
        def __init__(self, *, horizontally: bool = False): self.axes = 2 if horizontally else 3
        def measure(self, comparison):
            from numpy.linalg import norm
            out = {}
            for name in ("estimate", "ground_truth", "unaligned", "truth"):
                p = getattr(comparison, name).p_WB[:, : self.axes]
                out[f"{name}_m"] = norm(p - p[0], axis=1).max()
            return out
    class Failing:
        def measure(self, comparison): return {}["deep"]
    class Undecided:
        def measure(self, comparison): return {"x_m": float("nan")}
    class Listing:
        def measure(self, comparison): return [1.0]
    class Nothing: ...
    @hookimpl
    def vioframe_metrics():
        return {"longest": Longest, "failing": Failing, "undecided": Undecided, "listing": Listing, "nothing": Nothing}
"""


@pytest.fixture
def third_party(tmp_path, monkeypatch):
    """The parts with those of a distribution that somebody else made."""
    folder = tmp_path / "third"
    folder.mkdir()
    install(folder, monkeypatch, distribution="far-away", module="far_away", code=THIRD_PARTY)
    return registry.load()


def test_a_third_party_metric_sees_the_whole_of_both_and_the_pairs(third_party):
    truth = flight()
    estimate = moved(truth.select(slice(100, 300)), rotation_z(1.0), np.ones(3))
    found = figures(third_party, "longest", estimate, truth)
    assert found["ground_truth_m"] == pytest.approx(np.linalg.norm(truth.p_WB - truth.p_WB[0], axis=1).max())
    assert found["estimate_m"] == pytest.approx(found["unaligned_m"]) == pytest.approx(found["truth_m"])
    assert found["estimate_m"] < found["ground_truth_m"]
    flat = figures(third_party, "longest:horizontally=true", estimate, truth)
    assert flat["ground_truth_m"] < found["ground_truth_m"]


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("failing", r"metric 'failing' \(far-away 1\.0\) failed: KeyError: 'deep'; leave it out or repair it"),
        ("undecided", r"metric 'undecided' \(far-away 1\.0\) returned 'x_m': nan; a figure is a finite number by name"),
        ("listing", r"metric 'listing' \(far-away 1\.0\) returned a list, not figures by name"),
    ],
)
def test_a_metric_that_fails_is_named(third_party, name, why):
    with pytest.raises(PluginError, match=why):
        measure(create_metrics(["ate", name], third_party), Comparison.of(flight(), flight()))


def test_a_part_that_is_no_metric_is_refused(third_party):
    with pytest.raises(PluginError, match=r"metric 'nothing' .* made a Nothing, which has no measure"):
        create_metrics(["nothing"], third_party)


class Absolute:
    """Of a world that means nothing: not invariant to where the estimate starts."""

    def measure(self, comparison):
        return {"height_m": comparison.estimate.p_WB[:, 2].max()}


class Growing:
    def __init__(self):
        self.asked = 0

    def measure(self, comparison):
        self.asked += 1
        return {"asked": self.asked}


class Spoiling:
    def measure(self, comparison):
        comparison.errors.position_m[:] = 0.0
        return {"x_m": 1.0}


class Refusing:
    def measure(self, comparison):
        raise TrajectoryError("not today")


class TakingMuchForGranted:
    def measure(self, comparison):
        return {"orientation": comparison.errors.nees[0].mean}


@pytest.mark.parametrize(
    ("factory", "broken"),
    [
        (Absolute, "which means nothing"),
        (Growing, "other figures later"),
        (Spoiling, "changed the errors"),
        (Refusing, "gave no figure"),
        (TakingMuchForGranted, "raised on an estimate without error: IndexError"),
    ],
)
def test_the_kit_finds_broken_promises(factory, broken):
    with pytest.raises(AssertionError, match=broken):
        check_metric(factory)


@needs_evo
def test_evo_agrees_on_a_simulated_flight(installed):
    truth = simulated_sequence("figure_eight", duration_s=15.0, max_points=20).ground_truth
    estimate = moved(disturbed(truth, 0.05, 0.01), so3.exp(np.array([0.05, -0.02, 1.0])), np.ones(3), scale=1.03)
    found, own = (figures(installed, name, estimate, truth) for name in ("evo", "ate"))
    assert own["ate_se3_m"] > 0.05
    assert found == pytest.approx({**{k: own[k] for k in ("ate_se3_m", "ate_sim3_m", "scale")}, "difference_m": 0.0})
    assert abs(found["difference_m"]) < 1e-12


@needs_evo
@pytest.mark.parametrize("name", PEERS)
def test_evo_agrees_on_what_others_estimated(installed, shared_data, name):
    estimate = load_trajectory(shared_data / "peer_trajectories" / f"{name}.txt.gz", keep_first_of_repeats=True)
    truth = load_trajectory(shared_data / "euroc_imu_gt" / PEERS[name])
    found = figures(installed, "evo", estimate, truth)
    assert found["ate_se3_m"] > 0.01
    assert abs(found["difference_m"]) < 1e-12


def test_evo_absent_says_what_to_install(installed, monkeypatch):
    for module in [m for m in sys.modules if m == "evo" or m.startswith("evo.")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "evo", None)
    with pytest.raises(PluginError, match=r'needs evo \(GPL-3\.0\), .*: pip install "vioframe\[evo\]"'):
        create_metrics(["evo"], installed)


@needs_evo
def test_evo_leaves_home_logging_and_matplotlib_alone(tmp_path):
    """In a process of its own, as other tests load evo in this one."""
    code = """
        import logging, sys
        from vioframe.parts import registry
        from vioframe.runs.evaluated import create_metrics, measure
        from vioframe.evaluation import Comparison
        from trajectory_helpers import flight
        installed = registry.load()
        assert not [m for m in sys.modules if m.startswith("evo")]
        measured = measure(create_metrics(["evo"], installed), Comparison.of(flight(), flight()))
        assert list(measured.figures) == ["evo"]
        assert not [m for m in sys.modules if m.startswith(("evo.tools", "matplotlib"))]
        assert logging.getLogger("evo").level == logging.NOTSET and not logging.getLogger().handlers
    """
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": paths}
    subprocess.run([sys.executable, "-c", dedent(code)], env=environment, check=True)
    assert not (tmp_path / ".evo").exists()


@pytest.fixture
def runs(tmp_path):
    """A run with its ground truth and covariance, and a bare trajectory of a body that hardly moves."""
    truth = flight()
    estimate = disturbed(truth, 0.1, 0.01)
    cov = np.tile(np.diag([1e-4] * 3 + [0.1**2] * 3), (len(truth), 1, 1))
    write_run(tmp_path / "fine", Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, cov), truth)
    write_run(tmp_path / "blind", estimate)
    write_tum(disturbed(truth.select(slice(0, 20)), 0.02, 0.01), tmp_path / "short.tum")
    return tmp_path


def evaluate_command(*arguments):
    return CliRunner().invoke(main, ["evaluate", *map(str, arguments)])


ASKED = ("--metric", "ate", "--metric", "band:half_width_m=0.15", "--metric", "relative", "--metric", "nees")


def test_evaluate_shows_and_keeps_what_was_asked_for(runs):
    result = evaluate_command(
        runs / "fine", runs / "short.tum", "--ground-truth", runs / "fine/ground_truth.tum", *ASKED
    )
    assert result.exit_code == 0, result.output
    kept = json.loads((runs / "fine" / "evaluation.json").read_text())
    assert list(kept["metrics"]) == ["ate", "band:half_width_m=0.15", "relative", "nees"]
    assert kept["metrics"]["ate"]["ate_m"] == kept["ate_m"]["rmse"]
    assert "metrics_left_out" not in kept
    rows = {line.split("│")[0].strip(): line.split("│")[1:] for line in result.stdout.splitlines() if "│" in line}
    assert {"Metric ate", "Metric band:half_width_m=0.15", "Metric nees"} <= set(rows)
    fine, short = (float(cell) for cell in rows["inside_y_percent"])
    assert fine == pytest.approx(kept["metrics"]["band:half_width_m=0.15"]["inside_y_percent"], rel=1e-3)
    assert short == 100.0
    assert rows["translation_8m_percent"][1].strip() == rows["pose_nees_mean"][1].strip() == "–"
    assert "note: short: metric nees: the estimate brings no usable covariance" in result.stderr
    assert "note: short: metric relative: no stretch of 8 m fits" in result.stderr


def test_metrics_mean_the_same_however_the_table_is_aligned(runs):
    found = {}
    for alignment in ("posyaw", "sim3"):
        result = evaluate_command(runs / "fine", "--alignment", alignment, *ASKED, "--format", "json")
        (found[alignment],) = json.loads(result.stdout)
    assert found["posyaw"]["ate_m"] != found["sim3"]["ate_m"]
    assert found["posyaw"]["metrics"] == found["sim3"]["metrics"]


def test_a_run_without_ground_truth_has_no_metrics(runs):
    result = evaluate_command(runs / "blind", "--metric", "ate", "--format", "json")
    assert result.exit_code == 0
    assert "metrics" not in json.loads(result.stdout)[0]


def test_csv_has_a_column_a_figure(runs):
    header = evaluate_command(runs / "fine", "--metric", "band", "--format", "csv").stdout.splitlines()[0]
    assert "metrics.band.inside_all_percent" in header.split(",")


@pytest.mark.parametrize(
    ("spec", "why"),
    [("bnad", "did you mean 'band'?"), ("band:half_width_m=wide", "half_width_m='wide'"), ("failing", "KeyError")],
)
def test_a_wrong_or_failing_metric_is_one_line_and_exit_code_2(runs, third_party, spec, why):
    result = evaluate_command(runs / "fine", "--metric", spec)
    assert result.exit_code == 2
    assert why in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_the_metric_of_the_documentation_works():
    page = (Path(__file__).resolve().parents[1] / "docs" / "metrics.md").read_text()
    (code,) = re.findall(r"^```python\n(# vioframe_final\.py.*?)^```$", page, re.MULTILINE | re.DOTALL)
    names = {}
    exec(code, names)
    check_metric(names["vioframe_metrics"]()["final"])
