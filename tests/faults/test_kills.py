"""Runs that are interrupted, terminated or killed: what was written is readable, and the same command works again."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from plugin_helpers import install

from faults.command_line import vioframe_, vioframe_process
from vioframe.odometry import Odometry
from vioframe.parts import registry
from vioframe.parts.config import parse
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder

SLOW = """
import time
import numpy as np
from vioframe.types import Keypoints

class Slow:
    def detect(self, image, max_points):
        import cv2
        time.sleep(0.05)
        return Keypoints(cv2.goodFeaturesToTrack(image, max_points, 0.01, 10)[:, 0], np.ones(max_points))

@hookimpl
def vioframe_detectors(): return {"slow": Slow}
"""

# The exit code, and what is said: killed, a process says nothing.
SIGNALS = {
    signal.SIGINT: (130, "vioframe: interrupted"),
    signal.SIGTERM: (143, "vioframe: terminated"),
    signal.SIGKILL: (-signal.SIGKILL, ""),
}


def kill(how: signal.Signals, ready: Callable[[], bool], *arguments: object, **options: object) -> None:
    """Begin a command, end it by a signal once it is ``ready``, and check what it says."""
    process = vioframe_process(*arguments, **options)
    deadline = time.monotonic() + 120.0
    while not ready():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(how)
    _, stderr = process.communicate(timeout=60)
    code, says = SIGNALS[how]
    assert process.returncode == code, stderr
    assert stderr.startswith(says)
    assert stderr.count("\n") == (1 if says else 0)


@pytest.mark.parametrize(
    # Ctrl-C is tried by the command line's own tests as well.
    "how",
    [signal.SIGTERM, signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.very_slow)],
)
def test_a_run_that_is_ended_can_be_evaluated_and_drawn(here, monkeypatch, how):
    install(here / "site", monkeypatch, distribution="slow", module="slow_detector", code=SLOW)
    trajectory = Path("out/trajectory.tum")
    kill(
        how,
        lambda: trajectory.is_file() and trajectory.read_text().count("\n") > 20,
        *("run", "good.bag", "--ground-truth", "truth.tum", "--out", "out", "--quiet"),
        *("--detector", "slow", "-o", "refill_below=1.0"),
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(here / "site"), os.environ.get("PYTHONPATH", "")])},
    )
    assert len(RunFolder.open("out").trajectory()) >= 20
    summary = json.loads(Path("out/summary.json").read_text())
    assert summary["finished"] is False
    # Told to stop, it counts up what it has.
    assert ("frames" in summary) == (how != signal.SIGKILL)
    evaluated = vioframe_("evaluate", "out", "--format", "json")
    assert evaluated.exit_code == 0, evaluated.output
    assert "the run was interrupted; these figures cover what it left" in evaluated.stderr
    if how == signal.SIGKILL:
        drawn = vioframe_("plot", "out")
        assert drawn.exit_code == 0, drawn.output
        assert Path("out/plots/top_view.png").is_file()
    assert vioframe_("run", "good.bag", "--out", "out", "--overwrite", "--duration", 1, "--quiet").exit_code == 0
    assert RunFolder.open("out").summary["finished"] is True


@pytest.mark.parametrize(
    "how",
    [signal.SIGKILL, *(pytest.param(s, marks=pytest.mark.very_slow) for s in (signal.SIGINT, signal.SIGTERM))],
)
def test_a_simulation_that_is_ended_leaves_nothing_under_its_name(here, how):
    before = set(os.listdir())
    command = ("--flight", "hover", "--rate", 2, "--workers", 1, "--quiet")
    begun = Path(".made.bag.unfinished/made.bag")
    kill(
        how,
        lambda: begun.is_file() and begun.stat().st_size > 10_000,
        *("simulate", "made.bag", "--duration", 100, *command),
    )
    left = {begun.parent.name} if how == signal.SIGKILL else set()
    assert set(os.listdir()) - before == left
    # What is left of it is in nobody's way.
    assert vioframe_("simulate", "made.bag", "--duration", 1, *command).exit_code == 0
    assert set(os.listdir()) - before == {"made.bag", "made.bag.calib", "made.bag.simulation"}


def test_ctrl_c_within_compiled_code_is_an_interruption(here):
    class Interrupted:
        def begin(self, start):
            pass

        def process(self, imu, tracks, still):
            raise SystemError("a result with an exception set") from KeyboardInterrupt()

    experiment = prepare(parse({"dataset": {"path": "good.bag"}}), registry.load())
    odometry = Odometry(experiment.dataset.calibration, "shi_tomasi", Interrupted())
    with pytest.raises(KeyboardInterrupt):
        record(replace(experiment, odometry=odometry), Path("out"))
    assert len(RunFolder.open("out").trajectory()) == 1
