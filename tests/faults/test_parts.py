"""Plug-ins that fail: the one to blame is named, what was estimated until then is kept, and no other is taken down."""

from __future__ import annotations

from pathlib import Path

import pytest
from plugin_helpers import install

from faults.command_line import error_line, vioframe_
from vioframe.evaluation import evaluate
from vioframe.runs.folder import RunFolder

RUN = ("run", "good.bag", "--out", "out")

PARTS = """
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import cv2
import numpy as np
from vioframe.errors import DivergedError
from vioframe.types import *

def points(xy):
    return Keypoints(np.asarray(xy, np.float32), np.ones(len(xy), np.float32))

def found(image, max_points):
    return points(cv2.goodFeaturesToTrack(image, max_points, 0.01, 10)[:, 0])

def raises(image, max_points):
    raise RuntimeError("no\\nmemory")

def exits(image, max_points):
    raise SystemExit(0)

def paints(image, max_points):
    image[:] = 0

def prints(image, max_points):
    print("found")
    return found(image, max_points)

BAD = {
    "nothing": lambda image, max_points: points(np.empty((0, 2))),
    "nan": lambda image, max_points: points(np.full((9, 2), np.nan)),
    "outside": lambda image, max_points: points(np.full((9, 2), -50.0)),
    "too_many": lambda image, max_points: points(np.tile(found(image, 50).xy, (1000, 1))),
    "wide": lambda image, max_points: points(np.ones((9, 3))),
    "words": lambda image, max_points: Keypoints("xy", None),
    "none": lambda image, max_points: None,
    "raises": raises,
    "exits": exits,
    "paints": paints,
    "prints": prints,
}

def detector(bad):
    class Spoilt:
        "Good for some calls, then what is bad."
        def __init__(self, *, good_calls: int = 0):
            self.good_calls = good_calls
        def detect(self, image, max_points):
            self.good_calls -= 1
            return bad(image, max_points) if self.good_calls < 0 else found(image, max_points)
    return Spoilt

class Still:
    "Says that the body rests; its fifth estimate is spoilt."
    def __init__(self, *, spoil: str = ""):
        self.spoil, self.k = spoil, 0
    def begin(self, start):
        self.k = 0
    def process(self, imu, tracks, still):
        self.k += 1
        state = NavState(tracks.t_ns, np.eye(3), np.zeros(3), *np.zeros((3, 3)), np.eye(15))
        estimate = Estimate(Status.TRACKING, state, np.array([1]), np.ones((1, 3)))
        if self.k != 5 or imu.t_ns[-1] < 50 * NS_PER_S:  # not while warming up
            return estimate
        if self.spoil.startswith("state"):
            return replace(estimate, state=replace(state, **eval(self.spoil.removeprefix("state "))))
        return eval(self.spoil)

def throw(error):
    raise error

class Loops:
    "A loop closer that fails in one way or another."
    def __init__(self, calibration, *, fails: str = ""):
        self.fails, self.pool = fails, ThreadPoolExecutor(1)
        self.work = self.pool.submit(lambda: throw(ValueError("in a thread")) if fails == "beside" else None)
        self.count = 0
    def add(self, step):
        self.count += 1
        if self.fails == "at once" and self.count == 13:
            raise ValueError("at once")
    def finish(self):
        self.work.result()
        return None if self.fails == "nothing" else 5

@hookimpl
def vioframe_detectors(): return {name: detector(bad) for name, bad in BAD.items()}
@hookimpl
def vioframe_backends(): return {"still": Still}
@hookimpl
def vioframe_loop_closers(): return {"loops": Loops}
"""


@pytest.fixture(autouse=True)
def spoilt(here, monkeypatch):
    install(here / "site", monkeypatch, distribution="spoilt", module="spoilt_parts", code=PARTS)


# Detectors, each good for its first ten calls: the incident that is counted, and whether they print.
DETECTORS = {
    "nothing": "detector_found_nothing",
    "nan": "detector_points_not_finite",
    "outside": "detector_points_outside",
    "too_many": "detector_too_many_points",
    "wide": "detector_failed",
    "words": "detector_failed",
    "none": "detector_failed",
    "raises": "detector_failed",
    "exits": "detector_failed",
    "paints": "detector_failed",
    "prints": None,
}


@pytest.mark.parametrize(("detector", "incident"), DETECTORS.items(), ids=DETECTORS)
def test_a_detector_that_goes_bad_is_counted_and_what_it_found_before_is_used(detector, incident):
    command = ("--detector", detector, "-o", "good_calls=10", "--duration", 4, "--ground-truth", "truth.tum", "--quiet")
    done = vioframe_(*RUN, *command, "--cores", 1)  # by two, it prints to where the other process' errors go
    assert done.exit_code == 0
    assert (done.stdout != "", done.stderr) == (detector == "prints", "")
    run = RunFolder.open("out")
    assert run.summary["incidents"].keys() == ({incident} if incident else set())
    assert all(count > 10 for count in run.summary["incidents"].values())
    assert run.summary["completion"] == 1.0
    assert evaluate(run.trajectory(), run.ground_truth()).ate_m.rmse < 0.05


@pytest.mark.parametrize("detector", ["nothing", "nan", "outside"])
def test_a_detector_that_never_finds_a_point_gives_a_run_that_says_so(detector):
    done = vioframe_(*RUN, "--detector", detector, "--duration", 2)
    assert "never initialised" in done.output
    assert RunFolder.open("out").summary["incidents"] == {DETECTORS[detector]: 21}


@pytest.mark.parametrize(
    ("detector", "why"),
    [("none", "has no attribute 'xy'"), ("raises", "RuntimeError: no memory"), ("exits", "SystemExit: 0")],
)
def test_a_detector_that_never_works_ends_the_run(detector, why):
    line = error_line(*RUN, "--detector", detector, "--quiet")
    assert "failed on each of its first 10 calls" in line
    assert why in line
    assert "repair the plug-in or choose another detector" in line
    assert RunFolder.open("out").summary["incidents"] == {"detector_failed": 10}


# What the back-end makes of its fifth frame: what is said of it.
ESTIMATES = {
    "throw(ZeroDivisionError('division\\nby zero'))": "failed: ZeroDivisionError: division by zero",
    "throw(SystemExit(3))": "failed: SystemExit: 3",
    "throw(MemoryError())": "failed: MemoryError",
    "None": "it returned a NoneType, not an Estimate",
    "5": "it returned a int, not an Estimate",
    "replace(estimate, status='fine')": "its status is 'fine', not a Status",
    "replace(estimate, state=None)": "it tracks without a state",
    "replace(estimate, state=np.eye(4))": "its state is a ndarray, not a NavState",
    "replace(estimate, p_WF=np.ones((3, 3)))": "p_WF has the shape (3, 3), expected (1, 3)",
    "replace(estimate, events=(5,))": "its events are not a tuple of texts",
    "replace(estimate, events='lost')": "its events are not a tuple of texts",
    "replace(estimate, stage_seconds={'solve': None})": "stage_seconds are not seconds by stage",
    "replace(estimate, stage_seconds=[0.1])": "stage_seconds are not seconds by stage",
    "state dict(R_WB=2 * np.eye(3))": "R_WB is not a rotation",
    "state dict(R_WB=-np.eye(3))": "R_WB is not a rotation",
    "state dict(t_ns=0)": "its state is of 0 ns, the frame of ",
    "state dict(t_ns=tracks.t_ns + 1)": "its state is of ",
    "state dict(cov=np.diag(np.r_[-1.0, np.ones(14)]))": "cov has the eigenvalue -1.00e+00",
    "state dict(p_WB=np.full(3, np.nan))": "p_WB is not finite",
    "state dict(v_WB=np.zeros(2))": "v_WB has the shape (2,), expected (3,)",
    "state dict(bias_gyro_B=None)": "bias_gyro_B is no array of numbers",
}


@pytest.mark.parametrize(("spoil", "says"), ESTIMATES.items(), ids=ESTIMATES)
def test_an_estimate_that_cannot_be_ends_the_run_and_names_the_plugin(spoil, says):
    line = error_line(*RUN, "--backend", "still", "-o", f"spoil={spoil}", "--quiet")
    assert "spoilt 1.0" in line
    assert says in line
    assert line.endswith("what was estimated until then is in out\n")
    run = RunFolder.open("out")
    # That of the start, four, and one that was told before the back-end was given it: the images stand still.
    assert len(run.trajectory()) == 6
    assert run.summary["finished"] is False
    assert "spoilt 1.0" in run.summary["stopped_by"]
    assert vioframe_("evaluate", "out", "--ground-truth", "truth.tum").exit_code == 0


def test_a_back_end_that_diverges_is_begun_anew():
    line = ("--backend", "still", "-o", "spoil=throw(DivergedError('all is lost'))", "--duration", 1.8, "--quiet")
    assert vioframe_(*RUN, *line).exit_code == 0
    summary = RunFolder.open("out").summary
    assert summary["resets"] == 1
    assert [event["event"] for event in summary["events"] if "lost" in event["event"]] == ["lost: all is lost"]


@pytest.mark.parametrize(
    ("fails", "says"),
    [
        ("at once", "failed: ValueError: at once"),
        ("beside", "failed: ValueError: in a thread"),
        ("number", "'loops' (spoilt 1.0) returned a int, not a LoopClosure"),
        ("nothing", "'loops' (spoilt 1.0) returned a NoneType, not a LoopClosure"),
    ],
)
def test_a_loop_closer_that_fails_is_named_and_the_run_is_kept(fails, says):
    line = error_line(*RUN, "--loop-closure", "loops", "-o", f"fails={fails}", "--duration", 1.5, "--quiet")
    assert "spoilt 1.0" in line
    assert says in line
    assert len(RunFolder.open("out").trajectory()) == (2 if fails == "at once" else 6)


def test_a_plugin_that_fails_to_load_does_not_stop_the_others(here, monkeypatch):
    install(
        here / "broken", monkeypatch, distribution="broken", module="broken_parts", code="raise ValueError('a\\nb')"
    )
    done = vioframe_(*RUN, "--detector", "prints", "--duration", 1, "--quiet")
    assert done.exit_code == 0
    assert done.stderr == "vioframe: warning: plug-in broken_parts (broken 1.0) is skipped: ValueError: a b\n"
    gone = vioframe_("run", "good.bag", "--detector", "broken")
    assert gone.exit_code == 2
    assert "no detector is called 'broken'" in gone.stderr
    assert "(failed to load: broken_parts; `vioframe plugins` says why)" in gone.stderr


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("good_calls=few", "good_calls='few': Input should be a valid integer"),
        ("good_calls=[1]", "good_calls=[1]: Input should be a valid integer"),
        ("good_calls=1.5", "good_calls=1.5: Input should be a valid integer"),
        ("good_call=1", "did you mean 'good_calls'?"),
        ("=1", "-o takes key=value"),
    ],
)
def test_an_option_of_the_wrong_type_is_refused(option, says):
    assert says in error_line(*RUN, "--detector", "prints", "-o", option)
    assert not Path("out").exists()
