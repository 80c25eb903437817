import json

import numpy as np
import pytest
from trajectory_helpers import disturbed, flight, write_run

from vioframe.errors import RunError
from vioframe.geometry.trajectory import Trajectory
from vioframe.runs.folder import RunFolder, Timings


@pytest.fixture
def run(tmp_path):
    truth = flight(60)
    estimate = disturbed(truth, 0.01, 0.01)
    cov = np.diag(np.arange(1.0, 7.0)) + 0.5
    estimate = Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, np.arange(1.0, 61.0)[:, None, None] * cov)
    write_run(tmp_path / "run", estimate, truth, waiting=10)
    return tmp_path / "run", estimate, truth


def test_reads_what_a_run_wrote(run):
    path, estimate, truth = run
    folder = RunFolder.open(path)
    assert folder.name == "run"
    assert folder.summary["completion"] == 1.0
    found = folder.trajectory()
    np.testing.assert_array_equal(found.t_ns, estimate.t_ns[10:])
    np.testing.assert_allclose(found.p_WB, estimate.p_WB[10:], atol=1e-9)
    np.testing.assert_allclose(found.cov_pose, estimate.cov_pose[10:], rtol=1e-8)
    np.testing.assert_allclose(folder.ground_truth().p_WB, truth.p_WB, atol=1e-9)


def test_counts_tracked_and_new_features(run):
    counts = RunFolder.open(run[0]).tracks()
    np.testing.assert_array_equal(counts.tracked, np.full(60, 120))
    np.testing.assert_array_equal(counts.new, [120, *[3] * 59])


def test_a_frame_without_features_counts_as_zero(run):
    path, estimate, _ = run
    lines = (path / "tracks.csv").read_text().splitlines(keepends=True)
    (path / "tracks.csv").write_text("".join(line for line in lines if not line.startswith(str(estimate.t_ns[7]))))
    counts = RunFolder.open(path).tracks()
    assert counts.tracked[7] == 0
    assert counts.new[8] == 6


def test_stages_add_up_to_the_whole(run):
    timings = RunFolder.open(run[0]).timings()
    assert timings.seconds["backend"][0] == 1e-3
    assert timings.seconds["backend.update"][0] == 0.0
    whole = sum(seconds for stage, seconds in timings.seconds.items() if "." not in stage)
    np.testing.assert_allclose(sum(timings.exclusive().values()), whole, atol=1e-12)
    assert set(timings.mean_ms()) >= {"klt", "backend.update", "backend.propagate", "backend.other"}


def test_rounding_never_makes_a_stage_negative():
    timings = Timings(np.arange(1), {"a": np.array([0.001]), "a.b": np.array([0.0011])})
    assert timings.exclusive()["a.other"][0] == 0.0


@pytest.mark.parametrize("name", ["trajectory.tum", "pose_cov.csv", "timings.csv", "tracks.csv"])
def test_a_last_line_cut_short_is_ignored(run, name):
    path = run[0]
    text = (path / name).read_text()
    (path / name).write_text(text[:-9])
    (path / "summary.json").write_text('{"name": "ru')
    folder = RunFolder.open(path)
    assert folder.summary == {}
    assert len(folder.trajectory()) == (49 if name == "trajectory.tum" else 50)
    assert np.isfinite(folder.trajectory().cov_pose).all(axis=(1, 2)).sum() >= 49
    assert len(folder.timings().t_ns) == (59 if name == "timings.csv" else 60)
    assert folder.tracks() is not None


def test_only_the_trajectory_is_needed(run):
    path = run[0]
    for file in path.iterdir():
        if file.name != "trajectory.tum":
            file.unlink()
    folder = RunFolder.open(path)
    assert folder.trajectory().cov_pose is None
    assert (folder.timings(), folder.tracks(), folder.ground_truth(), folder.summary) == (None, None, None, {})


def test_a_run_that_never_initialised_has_no_trajectory(tmp_path):
    write_run(tmp_path / "run", flight(20), waiting=20)
    folder = RunFolder.open(tmp_path / "run")
    assert folder.trajectory() is None
    assert folder.summary["completion"] == 0.0


def test_unknown_covariance_is_none(tmp_path):
    write_run(tmp_path / "run", flight(20))
    assert RunFolder.open(tmp_path / "run").trajectory().cov_pose is None


def test_what_is_no_run_folder_is_an_error(tmp_path):
    with pytest.raises(RunError, match=r"is not a run folder: it holds no trajectory\.tum"):
        RunFolder.open(tmp_path)


def test_a_damaged_file_is_named(run):
    path = run[0]
    lines = (path / "timings.csv").read_text().splitlines(keepends=True)
    (path / "timings.csv").write_text("".join([*lines[:5], "what\n", *lines[5:]]))
    with pytest.raises(RunError, match=r"timings\.csv is damaged") as caught:
        RunFolder.open(path).timings()
    assert "\n" not in str(caught.value)


def test_a_summary_that_is_no_mapping_is_as_good_as_none(run):
    (run[0] / "summary.json").write_text(json.dumps([1, 2]))
    assert RunFolder.open(run[0]).summary == {}
