"""Sweeps: whatever happens to a worker or to the sweep, what is done is kept, and all of it is done in the end."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import pytest
from plugin_helpers import install
from suite_recordings import install_parts, record_toy

from vioframe.bench.suites import suite as suites
from vioframe.bench.suites.plan import plan
from vioframe.bench.suites.store import Store
from vioframe.bench.suites.sweep import Event, Outcome, agenda, sweep
from vioframe.errors import RunError
from vioframe.parts import registry
from vioframe.report.suite.results import Data, Kind, SuiteResults, load_results

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


@pytest.fixture
def parts(tmp_path, monkeypatch):
    install_parts(tmp_path / "parts", monkeypatch)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def run(
    folder: Path, text: str, data: Path | None, *, out: str = "results", **how
) -> tuple[Outcome, list[Event], Path]:
    file = folder / "toy.yaml"
    file.write_text(text)
    planned = plan(suites.read(file), [] if data is None else [data], registry.load())
    store = Store.at(folder / out)
    store.begin(planned, overwrite=how.pop("overwrite", False))
    events: list[Event] = []
    with store.alone():
        outcome = sweep(agenda(planned, store), store, on_event=events.append, **{"workers": 2, **how})
    return outcome, events, store.path


def found(path: Path) -> SuiteResults:
    return load_results(path)


def estimates(path: Path) -> dict[str, bytes]:
    return {task.key: (task.folder / "run" / "trajectory.tum").read_bytes() for task in found(path).tasks}


def unreliable(folder: Path, how: str, times: int) -> str:
    """The grid with a second back-end, which fails or dies so many times."""
    flag = folder / "flags"
    flag.mkdir(exist_ok=True)
    second = f"{{name: counting, label: unreliable, options: {{{how}: {times}, flag: {flag}}}}}"
    return GRID.replace("[shi_tomasi, fast]", "[fast]").replace("options: {}}]", f"options: {{}}}}, {second}]")


@pytest.mark.usefixtures("parts")
class TestSweep:
    def test_every_task_leaves_what_the_report_needs(self, tmp_path, toy):
        outcome, events, path = run(tmp_path, GRID, toy)
        assert (outcome.done, outcome.reused, outcome.failed) == (4, 0, {})
        assert len(events) == 4
        results = found(path)
        assert results.suite["title"] == "toy"
        for task in results.tasks:
            assert (task.kind, task.data, task.ok, task.attempts) == (Kind.FLIGHT, Data.REAL, True, 1)
            assert task.evaluation is not None
            assert task.errors is not None
            assert task.errors.ate_m.rmse == pytest.approx(task.evaluation["ate_m"]["rmse"])
            assert set(task.result["metrics"]["band:half_width_m=0.2"]) >= {"inside_y_percent", "inside_z_percent"}
            assert task.result["real_time_factor"] > 0.0
            assert task.result["stage_ms"]["klt" if "klt" in task.result["stage_ms"] else "frontend.klt"] > 0.0
            assert len(task.matched_truth()) == task.evaluation["poses"]
            assert task.run.summary["start_s"] == 0.5 * task.labels.seed
        assert {task.labels.detector for task in results.tasks} == {"shi_tomasi", "fast"}

    def test_what_is_done_is_not_done_again_unless_something_changed(self, tmp_path, toy):
        _, _, path = run(tmp_path, GRID, toy)
        before = {task.key: (task.folder / "task.json").stat().st_mtime_ns for task in found(path).tasks}
        outcome, events, _ = run(tmp_path, GRID, toy)
        assert (outcome.done, outcome.reused, events) == (0, 4, [])
        assert before == {task.key: (task.folder / "task.json").stat().st_mtime_ns for task in found(path).tasks}
        # A result that does not say what it was made of is not trusted.
        victim = found(path).tasks[0].folder / "task.json"
        tree = json.loads(victim.read_text())
        victim.write_text(json.dumps(tree | {"fingerprint": {**tree["fingerprint"], "code": "another"}}))
        assert run(tmp_path, GRID, toy)[0].done == 1

    def test_another_suite_does_not_get_the_folder(self, tmp_path, toy):
        run(tmp_path, GRID, toy)
        with pytest.raises(RunError, match="another suite's results, which differs in frontend"):
            run(tmp_path, GRID + "frontend: {max_points: 50}\n", toy)
        assert run(tmp_path, GRID + "frontend: {max_points: 50}\n", toy, overwrite=True)[0].done == 4
        (tmp_path / "mine").mkdir()
        (tmp_path / "mine" / "thesis.tex").touch()
        with pytest.raises(RunError, match="is no results folder"):
            run(tmp_path, GRID, toy, out="mine", overwrite=True)
        assert (tmp_path / "mine" / "thesis.tex").exists()

    def test_two_sweeps_keep_out_of_each_others_folder(self, tmp_path, toy):
        _, _, path = run(tmp_path, GRID, toy)
        with Store.at(path).alone(), pytest.raises(RunError, match="another sweep is at work"):
            run(tmp_path, GRID, toy)
        assert run(tmp_path, GRID, toy)[0].reused == 4

    def test_a_task_that_fails_once_is_done_the_second_time(self, tmp_path, toy):
        outcome, _, path = run(tmp_path, unreliable(tmp_path, "fail", 1), toy)
        assert (outcome.done, outcome.failed) == (4, {})
        assert sorted(task.attempts for task in found(path).tasks) == [1, 1, 1, 2]

    def test_a_task_that_fails_twice_is_reported_and_the_others_go_on(self, tmp_path, toy):
        outcome, events, path = run(tmp_path, unreliable(tmp_path, "fail", 9), toy)
        assert outcome.done == 2
        assert len(outcome.failed) == 2
        assert sum(bool(event.error) for event in events) == 2
        for task in found(path).tasks:
            assert task.ok == (task.labels.backend == "counting")
            assert ("fails as it was told to" in task.error) != task.ok
            assert task.ok or task.attempts == 2
        # What failed is tried again by the next sweep, and nothing else.
        assert run(tmp_path, unreliable(tmp_path, "fail", 9), toy)[0].reused == 2

    def test_a_worker_that_is_killed_loses_nothing(self, tmp_path, toy):
        outcome, _, path = run(tmp_path, unreliable(tmp_path, "die", 1), toy)
        assert (outcome.done, outcome.failed) == (4, {})
        assert sorted(task.attempts for task in found(path).tasks) == [1, 1, 1, 2]
        undisturbed = run(tmp_path, unreliable(tmp_path, "die", 1), toy, out="again")[2]
        assert estimates(path) == estimates(undisturbed)

    def test_a_task_that_kills_its_worker_twice_is_reported(self, tmp_path, toy):
        outcome, _, path = run(tmp_path, unreliable(tmp_path, "die", 9), toy)
        assert outcome.done == 2
        assert len(outcome.failed) == 2
        assert {task.error for task in found(path).tasks} == {"", "its worker died, killed or short of memory"}

    def test_workers_of_a_scheduler_elsewhere_do_it_as_well(self, tmp_path, toy, monkeypatch):
        from distributed import LocalCluster

        with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
            outcome, _, path = run(tmp_path, GRID, toy, scheduler=cluster.scheduler_address)
            # A plug-in that is installed here since, and not there.
            install(tmp_path / "more", monkeypatch, distribution="more", module="more_parts", code=MORE)
            with pytest.raises(RunError, match="has other code, plug-ins or versions"):
                run(tmp_path, GRID, toy, scheduler=cluster.scheduler_address, out="again")
        assert outcome.done == 4
        assert estimates(path) == estimates(run(tmp_path, GRID, toy, out="local")[2])

    def test_a_scheduler_that_is_not_there_is_an_error_in_a_line(self, tmp_path, toy, monkeypatch):
        monkeypatch.setattr("vioframe.bench.suites.cluster.CONNECT_S", 1.0)
        with pytest.raises(RunError, match="no dask scheduler at tcp://127"):
            run(tmp_path, GRID, toy, scheduler="tcp://127.0.0.1:9")


@pytest.mark.usefixtures("parts")
def test_a_simulated_recording_is_made_once_and_goes_when_it_is_no_longer_needed(tmp_path):
    text = GRID.replace("TOY", "{name: hover, duration_s: 0.5}") + "conditions: {noise: [0.5]}\n"
    outcome, events, path = run(tmp_path, text, tmp_path)
    assert (outcome.done, outcome.failed) == (8, {})
    assert sum(not event.is_task for event in events) == 2
    assert not (path / "recordings").exists()
    assert {task.data for task in found(path).tasks} == {Data.SIMULATED}


@pytest.mark.usefixtures("parts")
def test_a_recording_that_cannot_be_made_fails_its_flights_alone(tmp_path, toy):
    # A wall in the way is known when the world is built, which is when the recording is made.
    mesh = tmp_path / "wall.ply"
    mesh.write_text(WALL)
    text = GRID.replace("[TOY]", "[TOY, hover]")
    file = tmp_path / "toy.yaml"
    file.write_text(text)
    installed = registry.load()
    planned = plan(suites.read(file), [toy], installed)
    store = Store.at(tmp_path / "results")
    store.begin(planned, overwrite=False)
    left = agenda(planned, store)
    for recording in left.recordings.values():
        world = recording.config.world.model_copy(update={"name": "mesh", "options": {"file": mesh}})
        object.__setattr__(recording, "config", recording.config.model_copy(update={"world": world}))
    outcome = sweep(left, store, workers=1)
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


@pytest.mark.usefixtures("parts")
def test_trials_leave_their_nees(tmp_path):
    text = "title: t\nkind: trials\nbackends: [msckf]\nseeds: 2\nsetup: {flight: figure_eight, duration_s: 10.0}\n"
    outcome, _, path = run(tmp_path, text, None)
    assert (outcome.done, outcome.failed) == (2, {})
    for task in found(path).of(Kind.TRIAL):
        assert len(task.result["t_s"]) == len(task.result["nees"]["pose"]) > 50
        assert task.result["trial"]["failure"] is None


@pytest.mark.usefixtures("parts")
def test_detectors_are_timed_in_turns_in_this_process(tmp_path, toy):
    text = "title: t\nkind: detector_speed\ndetectors: [fast, orb]\nrounds: 1\nimages: 2\n"
    outcome, _, path = run(tmp_path, text, None)
    assert outcome.done == 1
    (task,) = found(path).of(Kind.DETECTOR_SPEED)
    assert [row["detector"] for row in task.result["rows"]] == ["fast", "orb"]
    assert task.result["settings"]["images"] == "drawn surfaces"
    recorded = run(tmp_path, text + "sequences: [TOY]\n", toy, out="recorded")[2]
    (task,) = found(recorded).of(Kind.DETECTOR_SPEED)
    assert task.result["settings"]["images"] == "frames of TOY"


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
@pytest.mark.usefixtures("parts")
def test_interrupted_by_ctrl_c_and_called_again_it_gives_what_it_would_have_given(tmp_path, toy):
    file = tmp_path / "toy.yaml"
    file.write_text(GRID.replace("seeds: 2", "seeds: 4"))
    command = [sys.executable, "-m", "vioframe", "bench", str(file), "--data", str(toy), "--no-report", "--quiet"]
    command += ["--workers", "1", "--out", str(tmp_path / "results")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    tasks = tmp_path / "results" / "tasks"
    deadline = monotonic() + 120.0
    while len(list(tasks.glob("[!.]*"))) < 2 and monotonic() < deadline:
        sleep(0.05)
    os.killpg(process.pid, signal.SIGINT)
    stderr = process.communicate(timeout=60)[1]
    assert process.returncode == 130, stderr
    assert stderr.strip().splitlines() == ["vioframe: interrupted"]
    kept = len(list(tasks.glob("[!.]*")))
    assert 2 <= kept < 8
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    assert f"{8 - kept} tasks done, {kept} done before" in finished.stdout
    whole = run(tmp_path, file.read_text(), toy, out="whole")[2]
    assert estimates(tmp_path / "results") == estimates(whole)
