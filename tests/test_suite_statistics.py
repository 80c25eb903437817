"""Statistics of a suite: nothing is dropped, nothing of different kinds is averaged."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from suite_helpers import MadeUp, comparison, key, labels, stress
from trajectory_helpers import flight

from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import write_tum
from vioframe.report.suite.statistics import (
    Duel,
    Study,
    averages,
    curves,
    data_caption,
    duels,
    groups,
    holm,
    median_flight,
    records,
    seeds_text,
    stage_means,
)
from vioframe.report.suite.tables import tables
from vioframe.runs.evaluated import write_matched_truth
from vioframe.runs.folder import RunFolder
from vioframe.runs.results import CELL, Data, task_count


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return comparison(tmp_path_factory.mktemp("suite") / "results").study()


@pytest.fixture(scope="module")
def stressed(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return stress(tmp_path_factory.mktemp("suite") / "results").study()


def only_group(made: MadeUp) -> pd.DataFrame:
    ((_, own),) = groups(made.study().flights)
    return own


def test_groups_come_in_the_order_of_the_suite_with_every_flight_in_them(compared):
    found = list(groups(compared.flights))
    assert [cell[4:] for cell, _ in found] == [
        ("shi_tomasi", "sliding_window"),
        ("shi_tomasi", "msckf"),
        ("keypointnet", "sliding_window"),
        ("keypointnet", "msckf"),
    ]
    assert [seeds_text(own) for _, own in found] == ["2", "1 of 2; 1 failed", "2", "1 of 2; 1 never initialised"]
    assert [own["seed"].tolist() for _, own in found] == [[0, 1]] * 4
    assert list(found[1][1]["reason"]) == ["", "PluginError: it broke"]
    assert list(found[3][1]["reason"]) == ["", "never initialised; last: initialisation refused: not at rest"]


def test_errors_over_time_are_those_of_the_rows(compared):
    for row in records(compared.flights):
        errors = compared.errors(row)
        assert (errors is None) == (not row["evaluated"])
        if errors is not None:
            assert errors.ate_m.rmse == pytest.approx(row["ate_m"])
            assert row["ate_percent"] == pytest.approx(100.0 * row["ate_m"] / errors.truth.path_length_m)


def test_stages_add_up_to_the_whole_and_leave_out_what_never_initialised(compared):
    means = stage_means(compared.flights)
    whole = compared.flights[compared.flights["evaluated"]]["frame_ms"].mean()
    # timings.csv keeps microseconds.
    assert means.sum(axis="columns").to_numpy() == pytest.approx([whole] * 4, abs=1e-3)


def test_a_flight_that_was_lost_for_long_or_cut_short_is_not_complete(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0), completion=0.949)
    made.flight(labels(seed=1), completion=0.951)
    made.flight(labels(seed=2), finished=False)
    own = only_group(made)
    assert list(own["outcome"]) == ["not complete", "complete", "not complete"]
    assert list(own["reason"]) == ["tracked 94.9 % of its frames", "", "cut short"]
    assert seeds_text(own) == "3; 2 not complete"
    assert list(own["succeeded"]) == [False, True, False]


@pytest.mark.parametrize(("after_s", "reason"), [(5.9, ""), (6.1, "initialised only after 6.1 s")])
def test_a_flight_that_is_initialised_in_its_second_half_is_not_complete(tmp_path, after_s, reason):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(), initialised_after_s=after_s, flown_s=12.0)
    own = only_group(made)
    assert (list(own["complete"]), list(own["reason"])) == ([not reason], [reason])


def test_the_median_flight_is_one_that_was_flown(tmp_path):
    made = MadeUp(tmp_path / "r")
    for seed, sigma_m in enumerate((0.3, 0.02, 0.1)):
        made.flight(labels(seed=seed), sigma_m=sigma_m)
    made.failed(labels(seed=3))
    assert median_flight(only_group(made))["seed"] == 2
    made.failed(labels(seed=2))
    assert median_flight(only_group(made))["seed"] == 0  # Of two, the worse.


def test_a_failed_flight_that_does_not_know_its_data_stands_with_its_siblings(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(seed=0), data=Data.REAL)
    made.failed(labels(seed=1), data=None)
    made.failed(labels("V1_01_easy"), "DatasetError: there is no V1_01_easy.bag", data=None)
    own = only_group(made)
    assert set(own["data"]) == {Data.REAL}
    assert seeds_text(own) == "1 of 2; 1 failed"
    # What belongs to no group is told all the same.
    assert len(next(t for t in tables(made.study()) if t.name == "failures").rows) == 2


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
    flights = made.study().flights
    rows = averages(flights)
    assert [(r.data, r.detector, list(r.means.index), r.of) for r in rows] == [
        (Data.REAL, "shi_tomasi", ["a", "b"], 3),
        (Data.REAL, "orb", ["a", "b"], 3),
        (Data.SIMULATED, "shi_tomasi", ["d", "e"], 2),
        (Data.SIMULATED, "orb", ["d", "e"], 2),
    ]
    orb = flights[flights["detector"] == "orb"].set_index("sequence")["ate_m"]
    assert list(rows[1].means["ate_m"]) == [orb["a"], orb["b"]]


def test_a_loop_closed_flight_is_told_by_its_corrected_trajectory(tmp_path):
    made = MadeUp(tmp_path / "r")
    run = made.flight(labels(), sigma_m=0.2)
    truth = RunFolder.open(run).ground_truth()
    write_tum(truth, run / "trajectory_loop.tum")
    made.change(key(labels()), loop_closed=True)
    study = made.study()
    assert study.errors(records(study.flights)[0]).ate_m.rmse == pytest.approx(0.0, abs=1e-9)
    evo = next(t for t in tables(study) if t.name == "evo")
    assert evo.values["command"][0].endswith("/trajectory_loop.tum --align")


def test_the_band_counts_instants():
    truth = flight(100)
    late = (np.arange(100) >= 40)[:, None] * np.array([0.0, 1.0, 0.0])
    errors = evaluate(Trajectory(truth.t_ns, truth.R_WB, truth.p_WB + late), truth)
    within = np.abs(errors.position_m) <= 0.2
    share = errors.inside_band(0.2)
    assert share["y"] < 50.0
    by_axis = dict(zip("xyz", 100.0 * within.mean(axis=0), strict=True))
    assert share == {**by_axis, "all": 100.0 * within.all(axis=1).mean()}


def test_a_stress_curve_begins_in_the_clear_and_counts_failures_against_success(stressed):
    by_name = dict(groups(curves(stressed.flights), ("condition", "detector")))
    assert len(by_name) == 4
    fog = by_name["fog", "shi_tomasi"]
    assert fog["level"].tolist() == [0.0, 0.5, 1.0]
    assert fog["success"].tolist() == [1.0, 1.0, 0.5]
    assert seeds_text(fog["flights"].iloc[2]) == "1 of 2; 1 failed"
    assert set(fog["flights"].iloc[0]["condition"]) == {"clear"}


def test_the_band_of_a_curve_is_students_t_with_the_spread_pooled_over_its_levels(stressed):
    from scipy import stats

    curve = dict(groups(curves(stressed.flights), ("condition", "detector")))["fog", "keypointnet"]
    logs = [np.log(own["ate_m"]) for own in curve["flights"]]
    sigma = np.sqrt(np.mean([each.var(ddof=1) for each in logs]))  # equally many seeds a level
    for point, each in zip(records(curve), logs, strict=True):
        low, high = stats.t.interval(0.95, df=3, loc=each.mean(), scale=sigma / np.sqrt(2))
        assert point["ate_m"] == pytest.approx(np.exp(each.mean()), rel=1e-12)
        assert (point["low"], point["high"]) == pytest.approx((np.exp(low), np.exp(high)), rel=1e-9)


def test_without_a_second_seed_there_is_no_band(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels())
    made.flight(labels(condition="fog", level=1.0))
    assert curves(made.study().flights)[["low", "high"]].isna().all(axis=None)


def test_duels_pair_flights_and_a_failure_loses(stressed):
    from scipy import stats

    assert stressed.baseline == "shi_tomasi"
    rows = duels(stressed.flights, "shi_tomasi")
    assert [(r.condition, r.won, r.lost, r.tied, r.both) for r in rows] == [
        ("clear", 2, 0, 0, 2),
        ("motion_blur", 4, 0, 0, 4),
        ("fog", 4, 0, 0, 3),
        (None, 8, 0, 0, 7),
    ]
    assert rows[0].ratio == pytest.approx(0.5, rel=0.05)
    assert rows[-1].p_value == pytest.approx(stats.binomtest(8, 8).pvalue)
    assert np.isnan(rows[-1].interval).all()  # of two worlds


def test_the_interval_of_a_ratio_is_as_wide_as_worlds_differ_not_as_flights_do():
    rng, worlds, levels = np.random.default_rng(1), 8, 30
    of_world = np.repeat(rng.normal(0.0, 0.3, worlds), levels)
    log_ratio = -0.2 + of_world + rng.normal(0.0, 0.05, worlds * levels)
    pairs = pd.DataFrame({"sequence": "a", "seed": np.repeat(range(worlds), levels), "log_ratio": log_ratio})
    low, high = Duel("simulated", None, "orb", "msckf", pairs).interval
    means = pairs.groupby("seed")["log_ratio"].mean()
    error, of_flights = means.std(ddof=0) / np.sqrt(worlds), log_ratio.std() / np.sqrt(worlds * levels)
    assert 0.5 * np.log(high / low) == pytest.approx(1.96 * error, rel=0.1)
    assert 1.96 * error > 4.0 * of_flights
    assert means.min() < np.log(low) < log_ratio.mean() < np.log(high) < means.max()


def test_holms_correction_is_that_of_the_textbook():
    # Holm (1979): the smallest times their number, the next times one less, never below the one before, at most 1.
    assert holm([0.01, 0.04, 0.03, 0.005, 0.9]) == pytest.approx([0.04, 0.09, 0.09, 0.025, 0.9])
    assert holm([]) == []


def test_two_failures_and_two_equal_flights_are_ties(tmp_path):
    made = MadeUp(tmp_path / "r")
    for detector in ("shi_tomasi", "orb"):
        made.failed(labels(detector=detector, seed=0))
        made.flight(labels(detector=detector, seed=1))
    (row,) = duels(made.study().flights, "shi_tomasi")
    assert (row.won, row.lost, row.tied, row.both, row.p_value) == (0, 0, 2, 1, 1.0)


def test_a_flight_that_was_lost_early_wins_no_duel_by_the_little_that_it_estimated(tmp_path):
    made = MadeUp(tmp_path / "r")
    made.flight(labels(detector="shi_tomasi", seed=0), sigma_m=0.1)
    made.flight(labels(detector="orb", seed=0), sigma_m=0.001, completion=0.3)
    made.failed(labels(detector="shi_tomasi", seed=1))
    made.flight(labels(detector="orb", seed=1), sigma_m=0.001, completion=0.3)
    (row,) = duels(made.study().flights, "shi_tomasi")
    assert (row.won, row.lost, row.tied, row.both) == (1, 1, 0, 0)
    assert np.isnan(row.ratio)  # not a hundredth: the one that flew on is off by what the other never saw


def test_the_baseline_is_the_first_of_the_suite_and_a_lone_detector_has_none(tmp_path):
    made = MadeUp(tmp_path / "r", detectors=["orb", "fast"])
    made.flight(labels(detector="fast"))
    assert made.study().baseline is None
    made.flight(labels(detector="orb"))
    assert made.study().baseline == "orb"


def test_nees_is_averaged_over_the_trials_that_have_one(tmp_path):
    made = MadeUp(tmp_path / "r", kind="trials", backends=["msckf"], seeds=4)
    for seed in range(3):
        made.trial("msckf", seed, 1.0)
    made.trial("msckf", 3, 1.0, "crashed")
    study = made.study()
    nees = study.nees(study.trials)["pose"]
    tables_ = [pd.read_csv(made.path / folder / "nees.csv") for folder in study.trials["folder"][:3]]
    assert nees.mean == pytest.approx(np.mean([each["pose"].mean() for each in tables_]))
    assert set(nees.trials) == {3}
    assert nees.verdict == "consistent"


def test_how_many_tasks_a_finished_sweep_has(compared, stressed):
    assert task_count(stressed.results.suite) == 2 * 1 * 1 * 5 * 2
    assert task_count(compared.results.suite) == 8
    assert task_count({"kind": "trials", "backends": ["a", "b"], "seeds": 25}) == 50
    assert task_count({"kind": "detector_speed"}) == 1
    grid = {"detectors": ["a"], "backends": ["b"], "sequences": ["c"]}
    assert task_count({"kind": "flights", **grid, "clear": False, "conditions": {"fog": [0.5, 1.0]}}) == 2
    assert task_count({}) is None


def test_captions_list_many_recordings_by_kind(tmp_path):
    made = MadeUp(tmp_path / "r", sequences=["a", "b", "c"])
    for sequence, data in (("a", Data.REAL), ("b", Data.REAL), ("c", Data.SIMULATED)):
        made.flight(labels(sequence), data=data)
    caption = data_caption(made.study().flights)
    assert "Data (real): a, b: real images and IMU." in caption
    assert "Data (simulated): c: a simulated stand-in flight" in caption


def test_what_a_group_has_in_common_is_all_but_the_seed(compared):
    assert list(CELL) == ["data", "sequence", "condition", "level", "detector", "backend"]
    for cell, own in groups(compared.flights):
        assert all((own[column] == value).all() for column, value in zip(CELL, cell, strict=True))


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
    study = made.study()
    command = next(t for t in tables(study) if t.name == "evo").values["command"][0].split()
    assert command[2:4] == [f"runs/{key(labels())}/{file}.tum" for file in ("ground_truth_matched", "trajectory")]
    program = shutil.which("evo_ape") or str(Path(sys.executable).parent / "evo_ape")
    said = subprocess.run([program, *command[1:]], cwd=made.path, capture_output=True, text=True, check=True).stdout
    rmse = next(float(line.split()[1]) for line in said.splitlines() if line.split()[:1] == ["rmse"])
    assert rmse == pytest.approx(study.flights["ate_se3_m"][0], abs=1e-6)
