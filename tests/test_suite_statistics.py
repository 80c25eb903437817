"""Statistics of a suite: nothing is dropped, nothing of different kinds is averaged."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from suite_helpers import MadeUp, comparison, key, labels, stress
from trajectory_helpers import flight

from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import write_tum
from vioframe.report.suite.flights import Flight, Outcome
from vioframe.report.suite.pooled import BAND_M, inside_band, pool_relative
from vioframe.report.suite.results import Data, Kind, SuiteResults
from vioframe.report.suite.statistics import Spread, averages, expected_tasks, groups, unplaced
from vioframe.report.suite.stress import baseline_of, curves, duels, wilson
from vioframe.report.suite.tables_about import evo_command
from vioframe.runs.evaluated import write_matched_truth
from vioframe.runs.folder import RunFolder


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> SuiteResults:
    return comparison(tmp_path_factory.mktemp("suite") / "results").load()


@pytest.fixture(scope="module")
def stressed(tmp_path_factory: pytest.TempPathFactory) -> SuiteResults:
    return stress(tmp_path_factory.mktemp("suite") / "results").load()


def test_groups_come_in_the_order_of_the_suite_with_every_flight_in_them(compared):
    found = groups(compared)
    assert [(g.cell.detector, g.cell.backend) for g in found] == [
        ("shi_tomasi", "sliding_window"),
        ("shi_tomasi", "msckf"),
        ("keypointnet", "sliding_window"),
        ("keypointnet", "msckf"),
    ]
    assert [g.seeds_text for g in found] == ["2", "1 of 2; 1 failed", "2", "1 of 2; 1 never initialised"]
    assert [g.count for g in found] == [2, 2, 2, 2]
    assert found[1].reasons == {"PluginError: it broke": 1}
    assert found[3].reasons == {"never initialised; last: initialisation refused: not at rest": 1}


def test_figures_are_those_of_the_evaluation_with_mean_and_spread_over_the_seeds(compared):
    results = compared
    group = groups(results)[0]
    own = [t.result["evaluation"] for t in results.tasks if t.labels.detector == "shi_tomasi" and "window" in t.key]
    ate = np.array([e["ate_m"]["rmse"] for e in own])
    spread = group.spread("ate_m")
    assert spread.to_dict() == pytest.approx(
        {"n": 2, "mean": ate.mean(), "std": ate.std(ddof=1), "median": ate.mean(), "min": ate.min(), "max": ate.max()}
    )
    assert group.mean("ate_percent") == pytest.approx(
        100.0 * np.mean([e["ate_m"]["rmse"] / e["path_length_m"] for e in own])
    )
    assert group.mean("start_s") == 5.25
    assert group.means("nees.").keys() == {"orientation", "position", "pose"}
    assert group.mean("no such figure") is None
    stages = group.means("stage_ms.")
    # timings.csv keeps microseconds.
    assert sum(stages.values()) == pytest.approx(group.mean("frame_ms"), abs=1e-3)


def test_a_single_value_has_no_spread():
    assert Spread((0.3,)).std is None


def test_a_flight_that_was_lost_for_long_or_cut_short_is_not_complete(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0), completion=0.949)
    made.flight(labels(seed=1), completion=0.951)
    cut = made.flight(labels(seed=2)).parent / "task.json"
    tree = json.loads(cut.read_text())
    tree["result"]["summary"]["finished"] = False
    cut.write_text(json.dumps(tree))
    (group,) = groups(made.load())
    assert [f.outcome for f in group.flights] == [Outcome.INCOMPLETE, Outcome.COMPLETE, Outcome.INCOMPLETE]
    assert [f.reason for f in group.flights] == ["tracked 94.9 % of its frames", "", "cut short"]
    assert group.seeds_text == "3; 2 not complete"
    assert [f.succeeded for f in group.flights] == [False, True, False]


@pytest.mark.parametrize(("after_s", "outcome"), [(5.9, Outcome.COMPLETE), (6.1, Outcome.INCOMPLETE)])
def test_a_flight_that_is_initialised_in_its_second_half_is_not_complete(tmp_path, after_s, outcome):
    made = MadeUp(tmp_path / "r")
    task = made.flight(labels()).parent / "task.json"
    tree = json.loads(task.read_text())
    tree["result"]["summary"] |= {
        "initialised_after_s": after_s,
        "first_frame_t_ns": 10**18,
        "last_frame_t_ns": 10**18 + 12 * 10**9,
    }
    task.write_text(json.dumps(tree))
    ((flown,),) = [group.flights for group in groups(made.load())]
    assert flown.outcome is outcome
    assert flown.reason == ("" if flown.complete else "initialised only after 6.1 s")


def test_the_median_flight_is_one_that_was_flown(tmp_path):
    made = MadeUp(tmp_path / "r")
    for seed, sigma_m in enumerate((0.3, 0.02, 0.1)):
        made.flight(labels(seed=seed), sigma_m=sigma_m)
    made.failed(labels(seed=3))
    (group,) = groups(made.load())
    assert group.median_flight().seed == 2
    made.failed(labels(seed=2))
    (group,) = groups(made.load())
    assert group.median_flight().seed == 0  # Of two, the worse.


def test_a_failed_flight_that_does_not_know_its_data_stands_with_its_siblings(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0), data=Data.REAL)
    made.failed(labels(seed=1), data=None)
    made.failed(labels("V1_01_easy"), "DatasetError: there is no V1_01_easy.bag", data=None)
    results = made.load()
    (group,) = groups(results)
    assert group.cell.data is Data.REAL
    assert group.seeds_text == "1 of 2; 1 failed"
    assert [f.task.labels.sequence for f in unplaced(results)] == ["V1_01_easy"]


def test_averages_are_over_sequences_that_everyone_completed_and_never_mix_kinds_of_data(tmp_path):
    made = MadeUp(tmp_path / "r", sequences=["a", "b", "c", "d", "e"], detectors=["shi_tomasi", "orb"])
    kinds = {"a": Data.REAL, "b": Data.REAL, "c": Data.REAL, "d": Data.SIMULATED, "e": Data.SIMULATED}
    for k, (sequence, data) in enumerate(kinds.items()):
        for detector in ("shi_tomasi", "orb"):
            of = labels(sequence, detector=detector)
            if (sequence, detector) == ("c", "orb"):
                made.failed(of, data=data)
            else:
                made.flight(of, data=data, sigma_m=0.01 * (k + 1))
    found = groups(made.load())
    rows = averages(found)
    assert [(r.data, r.detector, r.sequences, r.of) for r in rows] == [
        (Data.REAL, "shi_tomasi", ("a", "b"), 3),
        (Data.REAL, "orb", ("a", "b"), 3),
        (Data.SIMULATED, "shi_tomasi", ("d", "e"), 2),
        (Data.SIMULATED, "orb", ("d", "e"), 2),
    ]
    of_a, of_b = (next(g for g in found if g.cell.sequence == s and g.cell.detector == "orb") for s in "ab")
    assert rows[1].spreads["ate_m"].values == (of_a.mean("ate_m"), of_b.mean("ate_m"))


def test_a_loop_closed_flight_is_told_by_its_corrected_figures(tmp_path):
    made = MadeUp(tmp_path / "r")
    run = made.flight(labels(), sigma_m=0.2)
    truth = RunFolder.open(run).ground_truth()
    write_tum(truth, run / "trajectory_loop.tum")
    tree = json.loads((run.parent / "task.json").read_text())
    tree["result"]["evaluation_loop"] = evaluate(truth, truth).to_dict()
    (run.parent / "task.json").write_text(json.dumps(tree))
    (task,) = made.load().of(Kind.FLIGHT)
    one = Flight.of(task)
    assert one.figures["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert task.loop_closed
    assert evo_command(one).endswith("run/trajectory_loop.tum --align")


def test_the_band_counts_instants_and_prefers_what_the_metric_said(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0), sigma_m=0.001, bias_m=(0.0, 1.0, 0.0))
    told = {"inside_x_percent": 1.0, "inside_y_percent": 2.0, "inside_z_percent": 3.0, "inside_all_percent": 0.5}
    made.flight(labels(seed=1), metrics={f"band:half_width_m={BAND_M:g}": told, "band:half_width_m=0.1": {}})
    first, second = (Flight.of(task) for task in made.load().tasks)
    within = np.abs(first.task.errors.position_m) <= BAND_M
    assert within[:, 1].mean() < 0.5
    assert inside_band(first) == pytest.approx(
        {**dict(zip("xyz", 100.0 * within.mean(axis=0), strict=True)), "all": 100.0 * within.all(axis=1).mean()}
    )
    assert inside_band(second) == {"x": 1.0, "y": 2.0, "z": 3.0, "all": 0.5}


def test_relative_errors_are_pooled_over_the_flights_of_a_group(compared):
    found = groups(compared)
    pools = pool_relative(found)
    assert [pool.flights for pool in pools] == [2, 1, 2, 1]
    errors = [flight.task.errors for flight in found[0].flights]
    at_8m = np.concatenate([e.relative[8.0].translation_percent for e in errors])
    np.testing.assert_array_equal(pools[0].stretches[8.0].translation_percent, at_8m)
    assert not pools[0].of_path


def test_a_stress_curve_begins_in_the_clear_and_counts_failures_against_success(stressed):
    found = groups(stressed)
    by_name = {(c.condition, c.detector): c for c in curves(found)}
    assert len(by_name) == 4
    fog = by_name["fog", "shi_tomasi"]
    assert [p.level for p in fog.points] == [0.0, 0.5, 1.0]
    assert [p.success for p in fog.points] == [1.0, 1.0, 0.5]
    assert fog.points[2].group.seeds_text == "1 of 2; 1 failed"
    assert fog.points[0].group is by_name["motion_blur", "shi_tomasi"].points[0].group


def test_the_band_of_a_curve_is_students_t_with_the_spread_pooled_over_its_levels(stressed):
    from scipy import stats

    curve = next(c for c in curves(groups(stressed)) if c.detector == "keypointnet")
    logs = [np.log(p.group.spread("ate_m").values) for p in curve.points]
    sigma = np.sqrt(np.mean([each.var(ddof=1) for each in logs]))  # equally many seeds a level
    for point, each in zip(curve.points, logs, strict=True):
        low, high = stats.t.interval(0.95, df=3, loc=each.mean(), scale=sigma / np.sqrt(2))
        assert point.ate_m == pytest.approx(np.exp(each.mean()), rel=1e-12)
        assert (point.band.low, point.band.high) == pytest.approx((np.exp(low), np.exp(high)), rel=1e-9)


def test_without_a_second_seed_there_is_no_band(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels())
    made.flight(labels(condition="fog", level=1.0))
    (curve,) = curves(groups(made.load()))
    assert [p.band for p in curve.points] == [None, None]


@given(n=st.integers(1, 40), share=st.floats(0.0, 1.0))
def test_wilsons_interval_is_that_of_scipy(n, share):
    from scipy import stats

    successes = round(share * n)
    expected = stats.binomtest(successes, n).proportion_ci(0.95, method="wilson")
    found = wilson(successes, n)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_duels_pair_flights_and_a_failure_loses(stressed):
    from scipy import stats

    results = stressed
    found = groups(results)
    assert baseline_of(found) == "shi_tomasi"
    rows = duels(found, "shi_tomasi")
    assert [(r.condition, r.level, r.won, r.lost, r.tied, r.both) for r in rows] == [
        ("clear", 0.0, 2, 0, 0, 2),
        ("motion_blur", 0.5, 2, 0, 0, 2),
        ("motion_blur", 1.0, 2, 0, 0, 2),
        ("fog", 0.5, 2, 0, 0, 2),
        ("fog", 1.0, 2, 0, 0, 1),
        (None, None, 8, 0, 0, 7),
    ]
    assert rows[0].ratio == pytest.approx(0.5, rel=0.05)
    assert rows[-1].p_value == pytest.approx(stats.binomtest(8, 8).pvalue)


def test_two_failures_and_two_equal_flights_are_ties(tmp_path):
    made = MadeUp(tmp_path / "r")
    for detector in ("shi_tomasi", "orb"):
        made.failed(labels(detector=detector, seed=0))
        made.flight(labels(detector=detector, seed=1))
    (row,) = duels(groups(made.load()), "shi_tomasi")
    assert (row.won, row.lost, row.tied, row.both, row.p_value) == (0, 0, 2, 1, 1.0)


def test_a_flight_that_was_lost_early_wins_no_duel_by_the_little_that_it_estimated(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(detector="shi_tomasi", seed=0), sigma_m=0.1)
    made.flight(labels(detector="orb", seed=0), sigma_m=0.001, completion=0.3)
    made.failed(labels(detector="shi_tomasi", seed=1))
    made.flight(labels(detector="orb", seed=1), sigma_m=0.001, completion=0.3)
    (row,) = duels(groups(made.load()), "shi_tomasi")
    assert (row.won, row.lost, row.tied, row.both) == (1, 1, 0, 1)


def test_a_lone_detector_has_no_baseline(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels())
    results = made.load()
    assert baseline_of(groups(results)) is None


def test_how_many_tasks_a_finished_sweep_has(compared, stressed):
    assert expected_tasks(stressed.suite) == 2 * 1 * 1 * 5 * 2
    assert expected_tasks(compared.suite) == 8
    assert expected_tasks({"kind": "trials", "backends": ["a", "b"], "seeds": 25}) == 50
    assert expected_tasks({"kind": "detector_speed"}) == 1
    grid = {"detectors": ["a"], "backends": ["b"], "sequences": ["c"]}
    assert expected_tasks({"kind": "flights", **grid, "clear": False, "conditions": {"fog": [0.5, 1.0]}}) == 2
    assert expected_tasks({}) is None


def test_matched_truth_is_paired_as_the_evaluation_pairs(tmp_path):
    truth = flight(200)
    # Stamps between those of the truth, and before and after it.
    t_ns = truth.t_ns[0] + np.arange(-5, 210) * 49_000_000
    inside = truth.covers(t_ns)
    estimate = Trajectory(
        t_ns, np.broadcast_to(np.eye(3), (len(t_ns), 3, 3)), np.random.default_rng(0).normal(size=(len(t_ns), 3))
    )
    write_tum(estimate, tmp_path / "trajectory.tum")
    write_tum(truth, tmp_path / "ground_truth.tum")
    matched = RunFolder.open(tmp_path).path / "ground_truth_matched.tum"
    assert write_matched_truth(tmp_path) == matched
    lines = [line.split()[0] for line in matched.read_text().splitlines()[1:]]
    assert [int(line.replace(".", "")) for line in lines] == t_ns[inside].tolist()


def test_without_poses_or_truth_nothing_is_matched(tmp_path):
    (tmp_path / "trajectory.tum").write_text("# timestamp tx ty tz qx qy qz qw\n")
    assert write_matched_truth(tmp_path) is None
    write_tum(flight(20), tmp_path / "trajectory.tum")
    assert write_matched_truth(tmp_path) is None


@pytest.mark.skipif(
    shutil.which("evo_ape") is None and not (Path(sys.executable).parent / "evo_ape").is_file(),
    reason="evo is not installed",
)
def test_evo_finds_the_se3_ate_by_the_command_that_the_report_prints(tmp_path):
    made = MadeUp(tmp_path / "results")
    truth = flight(160, seed=3)
    # Half a period off the truth's stamps, so that pairing the nearest would show.
    off = truth.t_ns[:-1] + 25_000_000
    between = truth.at(off)
    noisy = between.p_WB + np.random.default_rng(1).normal(0.0, 0.05, (len(off), 3))
    made.flight(labels(), estimate=Trajectory(off, between.R_WB, noisy))
    (task,) = made.load().tasks
    command = evo_command(Flight.of(task)).split()
    assert command[2:4] == [
        f"tasks/{key(labels())}/run/ground_truth_matched.tum",
        f"tasks/{key(labels())}/run/trajectory.tum",
    ]
    program = shutil.which("evo_ape") or str(Path(sys.executable).parent / "evo_ape")
    said = subprocess.run([program, *command[1:]], cwd=made.path, capture_output=True, text=True, check=True).stdout
    rmse = next(float(line.split()[1]) for line in said.splitlines() if line.split()[:1] == ["rmse"])
    assert rmse == pytest.approx(task.evaluation["ate_se3_m"], abs=1e-6)
