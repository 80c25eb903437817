"""Monte Carlo: is the statistics right, is every failure shown, is the result the same on any number of processes?

At the end, what the project promises of its own filter: as accurate as asked for, and honest about it.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner
from plugin_helpers import install
from scipy.stats import chi2
from trajectory_helpers import run_of

from vioframe.bench.montecarlo import Setup, fly, nees_by_stretch
from vioframe.bench.processes import installed, map_in_processes
from vioframe.cli import main
from vioframe.cores import usable_cores
from vioframe.evaluation import evaluate
from vioframe.evaluation.consistency import PARTS, average_band, average_nees, over_trials
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z
from vioframe.parts.config import PartConfig
from vioframe.simulation import simulated_sequence
from vioframe.types import Estimate, NavState, Status

# Back-ends for a body at rest at the origin: they know the truth, and lie about it as told.
PARTS_THAT_FAIL = """
import multiprocessing, os, time
import numpy as np
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.simulation.flights import levelled
from vioframe.types import *

class Drawn:
    "Draws its errors from the covariance it states, or from one larger by `error_factor`."
    def __init__(self, *, error_factor: float = 1.0, pause_s: float = 0.0):
        self.factor, self.pause_s = error_factor, pause_s
    def begin(self, start):
        self.start, self.rng = start.state, np.random.default_rng(int(1e6 * start.tracks.xy.sum()))
        R_true = levelled(start.calibration.calibration.cameras[0].R_BC)
        # The truth in the gauge of where it began: what cannot be observed is that of the first pose.
        self.R_WB = rotation_z(float(yaw_of(start.state.R_WB @ R_true.T))) @ R_true
    def state(self, tracks, error, cov):
        R_WB, p_WB = self.R_WB @ so3.exp(error[:3]), self.start.p_WB + error[3:6]
        return NavState(tracks.t_ns, R_WB, p_WB, np.zeros(3), np.zeros(3), np.zeros(3), cov)
    def process(self, imu, tracks, still):
        time.sleep(self.pause_s)
        # So sure of all that leads on from a frame at rest that this adds nothing.
        cov = np.diag(np.repeat([0.002, 0.01, 1e-3, 1e-4, 1e-3], 3) ** 2)
        error = self.factor * np.sqrt(np.diag(cov)[:6]) * self.rng.normal(size=6)
        return Estimate(Status.TRACKING, self.state(tracks, error, cov))

class Unlucky(Drawn):
    "Each seed goes wrong in a way of its own, or not."
    def process(self, imu, tracks, still):
        if not hasattr(self, 'fate'): self.fate = int(1e6 * tracks.xy.sum()) % 3
        estimate = super().process(imu, tracks, still)
        if self.fate == 1: estimate.state.p_WB[0] = 3.0 * (tracks.t_ns * 1e-9 - 1.0)
        if self.fate == 2 and tracks.t_ns > 3 * 10**9: raise ZeroDivisionError("division by zero")
        return estimate

class Silent(Drawn):
    "Knows no covariance."
    def process(self, imu, tracks, still):
        return Estimate(Status.TRACKING, self.state(tracks, np.zeros(6), None))

class Deadly(Drawn):
    "Takes its process down, if that is a worker's."
    def process(self, imu, tracks, still):
        if multiprocessing.parent_process(): os._exit(1)
        return super().process(imu, tracks, still)

@hookimpl
def vioframe_backends():
    return {"drawn": Drawn, "unlucky": Unlucky, "silent": Silent, "deadly": Deadly}
"""


@pytest.fixture
def parts(tmp_path, monkeypatch):
    """A working folder of its own, with the back-ends above installed."""
    install(tmp_path / "site", monkeypatch, distribution="odd-parts", module="odd_parts", code=PARTS_THAT_FAIL)
    monkeypatch.chdir(tmp_path)
    installed.cache_clear()
    yield
    installed.cache_clear()


def montecarlo(*arguments: object, code: int = 0):
    command = ["montecarlo", "--duration", "10", "--flight", "standstill", "--quiet", *map(str, arguments)]
    result = CliRunner().invoke(main, command, catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result


def results(folder: str) -> list[dict]:
    """What was recorded, without what no two runs have in common."""
    found = json.loads((Path(folder) / "montecarlo.json").read_text())["results"]
    for case in found:
        del case["cpu_ms"]
        for trial in case["by_seed"]:
            trial.pop("cpu_ms", None)
    return found


# The statistics


def honest_outcome(trials: int, instants: int, factor: float = 1.0) -> list[pd.DataFrame]:
    """NEES of trials that begin one instant after the other, drawn independently at each."""
    rng = np.random.default_rng(1)
    made = []
    for seed in range(trials):
        t_ns = np.arange(seed % 5, instants) * 50_000_000
        nees = {part: factor * rng.chisquare(dof, len(t_ns)) for part, dof in PARTS.items()}
        made.append(pd.DataFrame({"t_ns": t_ns, **nees}))
    return made


def test_bounds_of_the_average_are_those_of_the_chi2_distribution():
    assert average_band(6, 25) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 150) / 25))


@pytest.mark.parametrize("part", PARTS)
def test_an_honest_filter_is_within_its_bounds_at_95_percent_of_the_instants(part):
    nees = average_nees(honest_outcome(25, 2000))[part]
    assert nees.trials[:6].tolist() == [5, 10, 15, 20, 25, 25]
    assert nees.low[0] < nees.low[-1] < PARTS[part] < nees.high[-1] < nees.high[0]
    assert nees.inside == pytest.approx(0.95, abs=0.015)
    assert nees.per_axis == pytest.approx(1.0, abs=0.02)
    assert nees.verdict == "consistent"


@pytest.mark.parametrize(("factor", "verdict"), [(2.0, "overconfident"), (0.5, "pessimistic")])
def test_a_wrong_covariance_is_called_so(factor, verdict):
    for nees in average_nees(honest_outcome(25, 200, factor)).values():
        assert nees.verdict == verdict
        assert nees.per_axis == pytest.approx(factor, rel=0.05)


def test_each_flight_counts_once_however_long_it_was_tracked():
    short = pd.DataFrame({"t_ns": np.arange(10), **dict.fromkeys(PARTS, 8.0)})
    long = pd.DataFrame({"t_ns": np.arange(90), **dict.fromkeys(PARTS, 2.0)})
    nees = average_nees([short, long, short[:0]])["pose"]
    assert nees.mean == 5.0
    assert nees.values[[0, 9, 10, 89]].tolist() == [5.0, 5.0, 2.0, 2.0]
    assert nees.trials[[9, 10]].tolist() == [2, 1]


def wanderer(sequence, seed):
    """Errors drawn from its covariance, in a world turned and moved; halfway it is lost and begins in another."""
    truth, rng = sequence.true_states, np.random.default_rng(seed)
    A = np.random.default_rng(0).normal(size=(6, 6))
    scale = np.diag(np.repeat([0.001, 0.01], 3))
    drawn_cov, half, estimates = scale @ (A @ A.T + np.eye(6)) @ scale, len(truth) // 2, []
    for k, true in enumerate(truth):
        R, p = (rotation_z(2.0), np.array([5.0, 1.0, 0.3])) if k < half else (rotation_z(-0.7), np.ones(3))
        cov, error = np.zeros((15, 15)), np.zeros(6)
        if k not in (0, half + 1):
            cov[:6, :6], error = drawn_cov, rng.multivariate_normal(np.zeros(6), drawn_cov)
        # R_true = R_est Exp(dtheta) and p_true = p_est + dp, in the world of the estimate.
        R_WB, p_WB = R @ true.R_WB @ so3.exp(-error[:3]), R @ true.p_WB + p - error[3:]
        state = NavState(true.t_ns, R_WB, p_WB, *np.zeros((3, 3)), cov)
        estimates.append(Estimate(Status.LOST) if k == half else Estimate(Status.TRACKING, state))
    return run_of(sequence, estimates)


def test_nees_is_taken_in_the_gauge_of_each_stretchs_first_pose():
    sequence = simulated_sequence("figure_eight", seed=0, duration_s=10.0, max_points=1)
    found = []
    for seed in range(20):
        run = wanderer(sequence, seed)
        assert [len(piece) for piece in run.stretches] == [100, 100]
        t_ns, nees = nees_by_stretch(run, sequence.ground_truth)
        assert len(t_ns) == 198
        found.append([nees[part].mean() for part in PARTS])
    assert np.mean(found, axis=0) == pytest.approx([3.0, 3.0, 6.0], rel=0.05)
    # One alignment for all of it takes the second world for an error.
    whole = {n.part: n.mean for n in evaluate(run.trajectory, sequence.ground_truth).nees}
    assert whole["position"] > 1000.0


# What is refused


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        (["--backend", "msckff"], "no backend is called 'msckff' (did you mean 'msckf'?)"),
        (["--flight", "figure_nine"], "figure_nine"),
        (["--seeds", "0"], "seeds: Input should be greater than or equal to 1, got 0"),
        (["--duration", "2"], "--duration: Input should be greater than or equal to 10, got 2.0"),
        (["--duration", "nan"], "--duration: Input should be a finite number"),
        (["--pixel-sigma", "-1"], "--pixel-sigma: Input should be greater than or equal to 0, got -1.0"),
        (["--outliers", "1"], "--outliers: Input should be less than 1, got 1.0"),
        (["--max-points", "0"], "--max-points: Input should be greater than or equal to 1, got 0"),
        (["--backend", "msckf:max_clone=5"], "max_clone"),
        (["--backend", "msckf:max_clones"], "options are given as msckf:KEY=VALUE"),
        (["--backend", "msckf:max_clones=1"], "should be greater than or equal to 3"),
        (["--backend", "msckf:max_clones=many"], "should be a valid integer"),
    ],
)
def test_bad_input_is_one_line(tmp_path, arguments, why):
    result = montecarlo(*arguments, "--out", tmp_path / "out", code=2)
    assert result.stderr.count("\n") == 1
    assert why in result.stderr
    assert not (tmp_path / "out").exists()


def test_only_a_monte_carlo_is_replaced_and_only_on_request(parts):
    for name in ("mine", "done"):
        Path(name).mkdir()
    Path("mine/thesis.txt").touch()
    Path("done/montecarlo.json").touch()
    for name in ("old_trials.png", "mine.txt"):
        Path("done", name).touch()
    command = ["--backend", "drawn", "--seeds", "1", "--workers", "1", "--out"]
    assert "exists already" in montecarlo(*command, "done", code=2).stderr
    assert "is not overwritten" in montecarlo(*command, "mine", "--overwrite", code=2).stderr
    montecarlo(*command, "done", "--overwrite")
    assert {path.name for path in Path("done").iterdir()} == {
        *("montecarlo.json", "nees.csv", "nees_of_trials.png", "trials.png", "mine.txt")
    }


# The command


def test_results_do_not_depend_on_the_number_of_processes(parts):
    command = ["--backend", "drawn", "--backend", "unlucky", "--seeds", "4"]
    for workers in (1, 2):
        montecarlo(*command, "--workers", workers, "--out", f"by_{workers}")
    assert results("by_1") == results("by_2")
    assert Path("by_1/nees.csv").read_bytes() == Path("by_2/nees.csv").read_bytes()
    assert len({trial["nees.pose"] for trial in results("by_1")[0]["by_seed"]}) == 4


def test_the_table_says_who_is_honest(parts):
    result = montecarlo("--backend", "drawn", "--backend", "drawn:error_factor=2", "--seeds", "6", "--workers", "1")
    honest, liar = results("runs/montecarlo")
    assert honest["nees"]["pose"]["verdict"] == "consistent"
    assert honest["nees"]["pose"]["per_axis"] == pytest.approx(1.0, abs=0.05)
    assert liar["nees"]["pose"]["per_axis"] == pytest.approx(4.0, abs=0.2)
    lines = [line for line in result.stdout.splitlines() if line.strip().startswith(("orientation, v", "pose, v"))]
    assert len(lines) == 2
    for line in lines:
        assert "consistent" in line
        assert "overconfident" in line
    rows = np.genfromtxt("runs/montecarlo/nees.csv", delimiter=",", skip_header=1)
    assert len(rows) % 2 == 0
    assert (rows[:, 3] <= 6).all()
    assert (rows[-100:, 3] == 6).all()
    assert rows[: len(rows) // 2, 4].mean() == pytest.approx(honest["nees"]["orientation"]["mean"], rel=1e-4)


def test_no_failure_is_dropped(parts):
    result = montecarlo("--backend", "unlucky", "--seeds", "12", "--workers", "1", "--out", "out")
    (case,) = results("out")
    counts = case["failures"]
    assert all(counts[kind] > 0 for kind in ("diverged", "crashed"))
    assert case["trials"] == len(case["by_seed"]) == 12
    assert f"{counts['diverged']} diverged, {counts['crashed']} crashed" in result.stdout
    notes = result.stderr.splitlines()
    assert len(notes) == sum(counts.values())
    assert any("crashed: ZeroDivisionError: division by zero" in note for note in notes)
    # One that diverged has figures, and they count.
    diverged = [trial for trial in case["by_seed"] if trial["failure"] == "diverged"]
    assert case["ate_m"] > 1.0
    assert case["nees"]["position"]["mean"] > np.mean([t["nees.position"] for t in diverged]) / 12


def test_a_trial_that_never_initialises_is_counted(parts):
    result = montecarlo(
        "--flight", "figure_eight", "--max-points", "3", "--seeds", "1", "--workers", "1", "--out", "out"
    )
    assert results("out")[0]["failures"]["never initialised"] == 1
    assert "never initialised: " in result.stderr


def test_without_covariance_or_estimate_there_is_still_a_table(parts):
    result = montecarlo("--backend", "silent", "--backend", "unlucky", "--seeds", "1", "--workers", "1", "--out", "out")
    assert "silent on standstill: states no covariance, so there is no NEES" in result.stderr
    assert results("out")[0]["nees"] == {}
    assert not Path("out/nees_of_trials.png").exists()
    assert Path("out/trials.png").exists()


def test_a_worker_that_dies_is_one_line(parts):
    result = montecarlo("--backend", "deadly", "--seeds", "2", "--workers", "2", "--out", "out", code=2)
    assert result.stderr.count("\n") == 1
    assert "a worker process died" in result.stderr
    assert not Path("out").exists()


def runs(pid: str) -> bool:
    """Whether a process is there and more than a zombie that its new parent has not noticed."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def leaves_interrupts_to_its_parent(pid: str) -> bool:
    """Whether a process is past its imports and ignores SIGINT, as the workers do."""
    status = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return bool(int(status["SigIgn"], 16) >> (signal.SIGINT - 1) & 1)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks for processes in /proc")
@pytest.mark.parametrize(("rig", "method"), [("mono", "dynamic"), ("stereo", "stereo")])
def test_trials_fly_the_rig_they_are_told(rig, method):
    """By two cameras they begin within a second, by one they do not."""
    setup = Setup(rig=rig, duration_s=10.0)
    cameras = setup.sequence(0).calibration.cameras
    assert [camera.name for camera in cameras] == ["cam0", "cam1"][: len(cameras)]
    trial = fly(setup, PartConfig(name="msckf"), 0)
    assert trial.failure is None
    assert (trial.figures["initialised_s"] < 1.0) == (method == "stereo")


def test_ctrl_c_ends_all_processes_and_leaves_nothing(parts, tmp_path):
    command = [sys.executable, "-m", "vioframe", "montecarlo", "--backend", "drawn:pause_s=0.05", "--duration", "10"]
    process = subprocess.Popen(
        [*command, "--seeds", "50", "--workers", "2", "--flight", "standstill", "--out", "out"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), os.environ.get("PYTHONPATH", "")])},
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 60
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    while len(children.read_text().split()) < 3 and time.monotonic() < deadline:  # two workers, a resource tracker
        time.sleep(0.1)
    workers = children.read_text().split()
    while not all(map(leaves_interrupts_to_its_parent, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130
    assert stderr.rstrip().endswith("vioframe: interrupted")
    assert "Traceback" not in stderr
    assert len(workers) >= 3
    while any(map(runs, workers)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(runs, workers))
    assert not Path("out").exists()


# What the project promises


@pytest.mark.very_slow
def test_the_msckf_is_accurate_and_honest_and_not_without_first_estimates():
    """25 flights of 60 s at EuRoC's noise, with its own initialisation and its defaults: every figure promised."""
    honest, nees = flown(25)
    assert_came_through(honest)
    assert honest["orientation_deg"] <= 0.4
    assert honest["percent"] <= 0.25
    for each in nees.values():
        assert 0.7 <= each.per_axis <= 1.5

    # What is learnt wrongly adds up, so that the longer flight tells.
    _, sure = flown(12, duration_s=120.0, first_estimate_jacobians=False)
    for each in sure.values():
        assert each.per_axis > 1.5
        assert each.verdict == "overconfident"
    # Yaw is what a filter believes to learn where it must not; position follows more slowly.
    assert sure["orientation"].per_axis > 3.0
    assert sure["pose"].inside < 0.5


@pytest.mark.very_slow
def test_the_sliding_window_is_accurate_and_honest():
    """On the side of caution, by how it tells its prior of long tracks; to count them twice it must not."""
    honest, nees = flown(12, "sliding_window")
    assert_came_through(honest)
    assert honest["orientation_deg"] <= 0.25
    assert honest["percent"] <= 0.04
    for each in nees.values():
        assert 0.6 <= each.per_axis <= 1.3


def assert_came_through(summary):
    assert sum(summary["failures"].values()) == 0
    assert summary["resets"] == 0
    assert summary["completion"] == 1.0


def flown(seeds, backend="msckf", duration_s=60.0, **options):
    """What so many trials say together, and their average NEES."""
    part = PartConfig(name=backend, options=options)
    trials = map_in_processes(partial(fly, Setup(duration_s=duration_s), part), range(seeds), usable_cores())
    return over_trials(pd.DataFrame([t.to_dict() for t in trials])), average_nees([t.nees_over_time() for t in trials])
