"""What ``vioframe evaluate`` prints and keeps."""

import csv
import json
from io import StringIO

import numpy as np
import pytest
from click.testing import CliRunner
from trajectory_helpers import disturbed, flight, write_run

from vioframe.cli import main
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import write_tum


@pytest.fixture
def runs(tmp_path):
    """Two run folders of one flight with their ground truth, and the estimate of the first as a bare file."""
    truth = flight()
    for name, sigma_m in (("fine", 0.02), ("coarse", 0.2)):
        estimate = disturbed(truth, sigma_m, 0.01)
        cov = np.tile(np.diag([1e-4] * 3 + [sigma_m**2] * 3), (len(truth), 1, 1))
        write_run(tmp_path / name, Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, cov), truth)
    write_tum(disturbed(truth, 0.02, 0.01), tmp_path / "bare.tum")
    write_tum(truth, tmp_path / "truth.tum")
    return tmp_path


def evaluate_command(*arguments):
    return CliRunner().invoke(main, ["evaluate", *map(str, arguments)])


def test_the_table_has_a_column_a_run(runs):
    result = evaluate_command(runs / "fine", runs / "coarse")
    assert result.exit_code == 0, result.output
    rows = {line.split("│")[0].strip(): line.split("│")[1:] for line in result.stdout.splitlines() if "│" in line}
    assert [cell.strip() for cell in rows["detector"]] == ["shi_tomasi", "shi_tomasi"]
    assert [cell.strip() for cell in rows["completion after that"]] == ["100.0%", "100.0%"]
    (fine, mm), (coarse, m) = map(str.split, rows["RMSE after SE(3) alignment"])
    assert (mm, m) == ("mm", "m")
    fine, coarse = 1e-3 * float(fine), float(coarse)
    assert coarse == pytest.approx(10.0 * fine, rel=0.05)
    assert {"8m", "48m", "pose, ideally 6", "backend.update", "max |x|, |y|, |z|", "scale by Sim(3) [1]"} <= set(rows)
    assert "Position error, position + yaw aligned" in result.stdout


def test_the_result_is_kept_in_each_run_folder(runs):
    assert evaluate_command(runs / "fine", runs / "coarse", "--alignment", "se3").exit_code == 0
    kept = json.loads((runs / "coarse" / "evaluation.json").read_text())
    assert (kept["alignment"], kept["detector"], kept["completion"]) == ("se3", "shi_tomasi", 1.0)
    assert kept["ate_m"]["rmse"] == kept["ate_se3_m"]
    assert kept["nees"]["position"]["dof"] == 3


def test_a_bare_trajectory_takes_its_ground_truth_by_option(runs):
    result = evaluate_command(runs / "bare.tum", "--ground-truth", runs / "truth.tum", "--format", "json")
    (found,) = json.loads(result.stdout)
    expected = evaluate(disturbed(flight(), 0.02, 0.01), flight())
    assert found["name"] == "bare"
    assert found["ate_m"]["rmse"] == pytest.approx(expected.ate_m.rmse, rel=1e-6)
    assert found["ate_se3_m"] == pytest.approx(expected.ate_se3_m, rel=1e-6)


def test_csv_is_a_row_a_run_at_full_precision(runs):
    result = evaluate_command(runs / "fine", runs / "coarse", "--format", "csv")
    fine, coarse = csv.DictReader(StringIO(result.stdout))
    kept = json.loads((runs / "fine" / "evaluation.json").read_text())
    assert float(fine["ate_m.rmse"]) == kept["ate_m"]["rmse"]
    assert float(fine["relative.8m.translation_percent.mean"]) == kept["relative"]["8m"]["translation_percent"]["mean"]
    assert (fine["name"], coarse["name"]) == ("fine", "coarse")


def test_markdown_is_a_table(runs):
    lines = evaluate_command(runs / "fine", "--format", "markdown").stdout.splitlines()
    assert lines[:2] == ["|  | fine |", "| --- | ---: |"]
    assert all(line.replace("\\|", "").count("|") == 3 for line in lines)


def test_runs_of_one_name_are_told_apart_by_their_paths(runs):
    (runs / "again").mkdir()
    write_run(runs / "again" / "fine", disturbed(flight(), 0.02, 0.01), flight())
    result = evaluate_command(runs / "fine", runs / "again" / "fine", "--format", "json")
    assert [run["name"] for run in json.loads(result.stdout)] == [str(runs / "fine"), str(runs / "again" / "fine")]


def test_an_interrupted_run_is_evaluated_as_far_as_it_goes(runs):
    path = runs / "fine" / "trajectory.tum"
    path.write_text(path.read_text()[:-20])
    (runs / "fine" / "summary.json").unlink()
    result = evaluate_command(runs / "fine")
    assert result.exit_code == 0
    assert "fine: the run was interrupted" in result.stderr


def test_runs_without_ground_truth_or_without_a_pose_still_show_how_they_went(tmp_path):
    write_run(tmp_path / "blind", flight())
    write_run(tmp_path / "never", flight(20), flight(20), waiting=20)
    result = evaluate_command(tmp_path / "blind", tmp_path / "never")
    assert result.exit_code == 0
    assert "blind: no ground truth; pass --ground-truth to measure errors" in result.stderr
    assert "never: never initialised" in result.stderr
    assert "klt" in result.stdout
    assert "RMSE" not in result.stdout


def test_what_is_no_run_among_several_is_left_aside(runs):
    (runs / "plots").mkdir()
    result = evaluate_command(runs / "fine", runs / "plots", runs / "coarse", "--format", "json")
    assert result.exit_code == 0
    assert [run["name"] for run in json.loads(result.stdout)] == ["fine", "coarse"]
    assert f"note: {runs / 'plots'} is left aside" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fine", "nowhere"], "no such trajectory file; check the path; while evaluating"),
        (["."], "is not a run folder"),
        (["fine", "--ground-truth", "leica0/data.csv"], "raw Vicon or Leica measurements"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(runs, monkeypatch, arguments, message):
    monkeypatch.chdir(runs)
    (runs / "leica0").mkdir()
    (runs / "leica0" / "data.csv").write_text("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n1,2,3,4\n")
    result = evaluate_command(*arguments)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1
