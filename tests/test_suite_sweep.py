"""Sweeps: whatever happens to a worker or to the sweep, what is done is kept, and all of it is done in the end."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import monotonic, sleep

import pytest
from plugin_helpers import install
from suite_recordings import install_parts, record_toy

from vioframe.bench.suites import suite as suites
from vioframe.bench.suites.plan import plan
from vioframe.bench.suites.store import Store
from vioframe.bench.suites.sweep import Sweep
from vioframe.errors import RunError
from vioframe.parts import registry
from vioframe.report.suite.statistics import Study
from vioframe.runs.folder import RunFolder
from vioframe.runs.results import Data, Row, load_results, read_rows, write_rows

pytest.importorskip("distributed", reason="sweeps need the extra bench")

GRID = """
title: toy
detectors: [shi_tomasi, fast]
backends: [{name: counting, options: {}}]
sequences: [TOY]
seeds: 2
metrics: ["band:half_width_m=0.2"]
"""

MORE = """
@hookimpl
def vioframe_backends():
    return {"idle": object}
"""


@pytest.fixture(scope="module")
def toy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that TOY is in."""
    return record_toy(tmp_path_factory.mktemp("toy")).parent


@pytest.fixture(scope="module", autouse=True)
def parts(tmp_path_factory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        install_parts(tmp_path_factory.mktemp("parts"), monkeypatch)
        monkeypatch.setenv("OMP_NUM_THREADS", "1")
        yield


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a scheduler with a worker: to begin one takes longer than most sweeps here."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="module")
def flown(tmp_path_factory, toy) -> tuple[Sweep, list[str], Path]:
    """The grid once through: the sweep, what it told, and the results, to be looked at and copied."""
    return run(tmp_path_factory.mktemp("flown"), GRID, toy, workers=2)


@pytest.fixture
def results(flown, tmp_path) -> Path:
    """A copy of these where :func:`run` finds it."""
    return Path(shutil.copytree(flown[2], tmp_path / "results"))


def run(folder: Path, text: str, data: Path | None, *, out: str = "results", **how) -> tuple[Sweep, list[str], Path]:
    file = folder / "toy.yaml"
    file.write_text(text)
    suite = suites.read(file)
    store = Store.at(folder / out)
    store.begin(suite, overwrite=how.pop("overwrite", False))
    progress: list[str] = []
    with store.alone():
        sweep = Sweep(plan(suite, [] if data is None else [data], registry.load()), store)
        cost_s = sweep.cost_s
        costs: list[float] = []

        def on_progress(label: str, cost_s: float) -> None:
            progress.append(label)
            costs.append(cost_s)

        sweep.run(on_progress=on_progress, **{"workers": 1, **how})
    assert sum(costs) == pytest.approx(cost_s)
    return sweep, progress, store.path


def found(path: Path) -> list[Row]:
    return list(load_results(path).rows)


def estimates(path: Path) -> dict[str, bytes]:
    return {row["task"]: (path / row["folder"] / "trajectory.tum").read_bytes() for row in found(path)}


def unreliable(folder: Path, how: str, times: int) -> str:
    """The grid with a second back-end, which fails or dies so many times."""
    flag = folder / "flags"
    flag.mkdir(exist_ok=True)
    second = f"{{name: counting, label: unreliable, options: {{{how}: {times}, flag: {flag}}}}}"
    return GRID.replace("[shi_tomasi, fast]", "[fast]").replace("options: {}}]", f"options: {{}}}}, {second}]")


class TestSweep:
    def test_every_task_leaves_what_the_report_needs(self, flown):
        outcome, progress, path = flown
        assert (outcome.done, outcome.reused, outcome.failed) == (4, 0, {})
        assert len(progress) == 4
        results = load_results(path)
        assert results.suite["title"] == "toy"
        study = Study(results)
        for row in results.rows:
            assert (row["kind"], row["data"], row["status"], row["attempts"]) == ("flight", Data.REAL, "ok", 1)
            assert 0.0 <= row["metrics.band:half_width_m=0.2.inside_y_percent"] <= 100.0
            assert row["real_time_factor"] > 0.0
            assert row.get("stage_ms.klt", row.get("stage_ms.frontend.klt")) > 0.0
            assert row["start_s"] == 0.5 * row["seed"]
        for _, flight in study.flights.iterrows():
            errors = study.errors(flight)
            assert errors is not None
            assert errors.ate_m.rmse == pytest.approx(flight["ate_m"])
            matched = path / flight["folder"] / "ground_truth_matched.tum"
            assert len(matched.read_text().splitlines()) - 1 == len(errors.estimate)
            assert RunFolder.open(path / flight["folder"]).summary["start_s"] == flight["start_s"]
        assert {row["detector"] for row in results.rows} == {"shi_tomasi", "fast"}

    def test_what_is_done_is_not_done_again_unless_something_changed(self, tmp_path, toy, results, cluster):
        table = (results / "results.jsonl").read_bytes()
        outcome, progress, _ = run(tmp_path, GRID, toy, scheduler=cluster)
        assert (outcome.done, outcome.reused, progress) == (0, 4, [])
        assert (results / "results.jsonl").read_bytes() == table
        # A result that does not say what it was made of is not trusted.
        rows = read_rows(results)
        victim = next(iter(rows))
        write_rows(results, {**rows, victim: [{**rows[victim][0], "code": "another"}]})
        assert run(tmp_path, GRID, toy, scheduler=cluster)[0].done == 1

    def test_another_suite_does_not_get_the_folder(self, tmp_path, toy, results, cluster):
        with pytest.raises(RunError, match="another suite's results, which differs in frontend"):
            run(tmp_path, GRID + "frontend: {max_points: 50}\n", toy, scheduler=cluster)
        theirs = [results / "notes.txt", next((results / "runs").iterdir()) / "notes.txt"]
        for note in theirs:
            note.write_text("precious")
        stale = set(results.rglob("*.tum"))
        assert run(tmp_path, GRID + "frontend: {max_points: 50}\n", toy, overwrite=True, scheduler=cluster)[0].done == 4
        assert [note.read_text() for note in theirs] == ["precious"] * 2
        assert set(results.rglob("*.tum")) == stale
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "thesis.tex").touch()
        with pytest.raises(RunError, match="is no results folder"):
            run(tmp_path, GRID, toy, out="mine", overwrite=True)
        assert (tmp_path / "mine" / "thesis.tex").exists()

    def test_more_seeds_are_flown_beside_those_there_are(self, tmp_path, toy, results, cluster):
        kept = estimates(results)
        outcome, _, _ = run(tmp_path, GRID.replace("seeds: 2", "seeds: 3"), toy, scheduler=cluster)
        assert (outcome.done, outcome.reused, outcome.failed) == (2, 4, {})
        assert estimates(results).items() > kept.items()
        with pytest.raises(RunError, match="another suite's results, which differs in seeds"):
            run(tmp_path, GRID, toy, scheduler=cluster)

    def test_two_sweeps_keep_out_of_each_others_folder(self, tmp_path, toy, results):
        with Store.at(results).alone(), pytest.raises(RunError, match="another sweep is at work"):
            run(tmp_path, GRID, toy)
        assert run(tmp_path, GRID, toy)[0].reused == 4

    def test_a_task_that_fails_once_is_done_the_second_time(self, tmp_path, toy, cluster):
        outcome, _, path = run(tmp_path, unreliable(tmp_path, "fail", 1), toy, scheduler=cluster)
        assert (outcome.done, outcome.failed) == (4, {})
        assert sorted(row["attempts"] for row in found(path)) == [1, 1, 1, 2]

    def test_a_task_that_fails_twice_is_reported_and_the_others_go_on(self, tmp_path, toy, cluster):
        outcome, progress, path = run(tmp_path, unreliable(tmp_path, "fail", 9), toy, scheduler=cluster)
        assert outcome.done == 2
        assert len(outcome.failed) == 2
        assert len(progress) == 4
        for row in found(path):
            failed = row["status"] == "failed"
            assert failed == (row["backend"] == "unreliable")
            assert ("fails as it was told to" in (row["error"] or "")) == failed
            assert not failed or row["attempts"] == 2
        # What failed is tried again by the next sweep, and nothing else.
        assert run(tmp_path, unreliable(tmp_path, "fail", 9), toy, scheduler=cluster)[0].reused == 2

    def test_a_worker_that_is_killed_loses_nothing(self, tmp_path, toy, flown):
        outcome, _, path = run(tmp_path, unreliable(tmp_path, "die", 1), toy, workers=2)
        assert (outcome.done, outcome.failed) == (4, {})
        assert sorted(row["attempts"] for row in found(path)) == [1, 1, 1, 2]
        undisturbed = estimates(flown[2])
        paths = estimates(path)
        assert paths == {task: undisturbed[task.replace("unreliable", "counting")] for task in paths}

    def test_a_task_that_kills_its_worker_twice_is_reported(self, tmp_path, toy):
        outcome, _, path = run(tmp_path, unreliable(tmp_path, "die", 9), toy)
        assert outcome.done == 2
        assert len(outcome.failed) == 2
        assert {row["error"] for row in found(path)} == {None, "its worker died, killed or short of memory"}

    def test_workers_of_a_scheduler_elsewhere_do_it_as_well(self, tmp_path, toy, flown, cluster, monkeypatch):
        outcome, _, path = run(tmp_path, GRID, toy, scheduler=cluster)
        assert outcome.done == 4
        assert estimates(path) == estimates(flown[2])
        # A plug-in that is installed here since, and not there.
        install(tmp_path / "more", monkeypatch, distribution="more", module="more_parts", code=MORE)
        with pytest.raises(RunError, match="has other code, plug-ins or versions"):
            run(tmp_path, GRID, toy, scheduler=cluster, out="again")

    def test_a_scheduler_that_is_not_there_is_an_error_in_a_line(self, tmp_path, toy, monkeypatch):
        monkeypatch.setattr("vioframe.bench.suites.sweep.CONNECT_S", 1.0)
        with pytest.raises(RunError, match="no dask scheduler at tcp://127"):
            run(tmp_path, GRID, toy, scheduler="tcp://127.0.0.1:9")


def test_a_simulated_recording_is_made_once_and_goes_when_it_is_no_longer_needed(tmp_path):
    text = GRID.replace("TOY", "{name: hover, duration_s: 0.5}") + "conditions: {noise: [0.5]}\n"
    outcome, progress, path = run(tmp_path, text, tmp_path, workers=2)
    assert (outcome.done, outcome.failed) == (8, {})
    assert sum(label.endswith(" simulated") for label in progress) == 2
    assert not (path / "recordings").exists()
    assert {row["data"] for row in found(path)} == {Data.SIMULATED}


def test_a_recording_that_cannot_be_made_fails_its_flights_alone(tmp_path, toy, cluster):
    # A wall in the way is known when the world is built, which is when the recording is made.
    mesh = tmp_path / "wall.ply"
    mesh.write_text(WALL)
    text = GRID.replace("[TOY]", "[TOY, hover]")
    file = tmp_path / "toy.yaml"
    file.write_text(text)
    suite = suites.read(file)
    store = Store.at(tmp_path / "results")
    store.begin(suite, overwrite=False)
    outcome = Sweep(plan(suite, [toy], registry.load()), store)
    for recording in outcome.recordings.values():
        world = recording.config.world.model_copy(update={"name": "mesh", "options": {"file": mesh}})
        object.__setattr__(recording, "config", recording.config.model_copy(update={"world": world}))
    outcome.run(scheduler=cluster)
    assert outcome.done == 4
    assert len(outcome.failed) == 4
    assert all("could not be simulated" in error for error in outcome.failed.values())


WALL = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
-9 -9 0
9 -9 0
0 9 0.01
3 0 1 2
"""


def test_trials_leave_their_nees(tmp_path, cluster):
    text = "title: t\nkind: trials\nbackends: [msckf]\nseeds: 2\nsetup: {flight: figure_eight, duration_s: 10.0}\n"
    outcome, _, path = run(tmp_path, text, None, scheduler=cluster)
    assert (outcome.done, outcome.failed) == (2, {})
    for row in found(path):
        nees = (path / row["folder"] / "nees.csv").read_text().splitlines()
        assert nees[0] == "t_ns,orientation,position,pose"
        assert len(nees) > 50
        assert row["failure"] is None
        assert row["ate_m"] < 1.0


def test_detectors_are_timed_in_turns_in_this_process(tmp_path, toy):
    text = "title: t\nkind: detector_speed\ndetectors: [fast, orb]\nrounds: 1\nimages: 2\n"
    outcome, _, path = run(tmp_path, text, None)
    assert outcome.done == 1
    assert [row["detector"] for row in found(path)] == ["fast", "orb"]
    assert {row["images"] for row in found(path)} == {"drawn surfaces"}
    assert run(tmp_path, text, None)[0].reused == 1
    recorded = run(tmp_path, text + "sequences: [TOY]\n", toy, out="recorded")[2]
    assert {row["images"] for row in found(recorded)} == {"frames of TOY"}


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
def test_interrupted_by_ctrl_c_and_called_again_it_gives_what_it_would_have_given(tmp_path, toy, cluster):
    file = tmp_path / "toy.yaml"
    file.write_text(GRID.replace("seeds: 2", "seeds: 4"))
    command = [sys.executable, "-m", "vioframe", "bench", str(file), "--data", str(toy), "--no-report", "--quiet"]
    command += ["--workers", "1", "--out", str(tmp_path / "results")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    results, deadline = tmp_path / "results", monotonic() + 120.0
    while len(read_rows(results)) < 2 and monotonic() < deadline:
        sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    stderr = process.communicate(timeout=60)[1]
    assert process.returncode == 130, stderr
    assert stderr.strip().splitlines() == ["vioframe: interrupted"]
    kept = len(read_rows(results))
    assert 2 <= kept < 8
    command.remove("--quiet")
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    assert f"{8 - kept} tasks done, {kept} done before" in finished.stdout
    whole = run(tmp_path, file.read_text(), toy, out="whole", scheduler=cluster)[2]
    assert estimates(results) == estimates(whole)
