"""What goes wrong in mid-flight: the run goes on, says what happened, and never writes anything but finite numbers."""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from vioframe.evaluation import evaluate
from vioframe.odometry import Odometry
from vioframe.parts import registry
from vioframe.parts.config import parse
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder
from vioframe.types import FrameSet, ImuSample

S = 1_000_000_000


class Disturbed:
    """A recording whose measurements go through ``change(measurement, seconds since the first) -> list``."""

    def __init__(self, dataset, change):
        self._dataset, self._change = dataset, change

    def __getattr__(self, name):
        return getattr(self._dataset, name)

    def measurements(self):
        begin = None
        for measurement in self._dataset.measurements():
            begin = measurement.t_ns if begin is None else begin
            yield from self._change(measurement, (measurement.t_ns - begin) / S)


def painted(grey):
    def change(m, t):
        if not (isinstance(m, FrameSet) and 8.0 < t < 9.0):
            return [m]
        return [replace(m, images=tuple(np.full_like(image, grey) for image in m.images))]

    return change


def without(kind, begin, end):
    return lambda m, t: [] if isinstance(m, kind) and begin < t < end else [m]


def not_finite(m, t):
    return [replace(m, accel_B=np.array([np.nan, 0.0, 0.0]))] if isinstance(m, ImuSample) and 8.0 < t < 8.1 else [m]


def repeated(m, t):
    return [m, m] if 8.0 < t < 8.5 else [m]


class Swapped:
    """Every other IMU sample comes after its successor."""

    def __init__(self):
        self.held = None

    def __call__(self, m, t):
        if not isinstance(m, ImuSample):
            return [m]
        if self.held is None:
            self.held = m
            return []
        pair, self.held = [m, self.held], None
        return pair


# name: (change, the incident it must leave or None, resets that are allowed)
CASES = {
    "black images": (painted(0), "featureless_image", 1),
    "saturated images": (painted(255), "featureless_image", 1),
    "short camera gap": (without(FrameSet, 8.0, 8.5), "camera_gap", 0),
    "long camera gap": (without(FrameSet, 8.0, 10.0), "camera_gap", 1),
    "short imu gap": (without(ImuSample, 8.0, 8.1), "imu_gap", 0),
    "long imu gap": (without(ImuSample, 8.0, 9.0), "imu_gap", 1),
    "imu not finite": (not_finite, "imu_nan", 0),
    "everything twice": (repeated, "imu_duplicate", 0),
    "imu out of order": (Swapped(), None, 0),
    "images before the imu": (without(ImuSample, -1.0, 3.0), "frame_before_imu", 0),
}


@pytest.mark.parametrize(("change", "incident", "resets"), CASES.values(), ids=CASES.keys())
def test_a_disturbed_flight_goes_on(shared_data, tmp_path, change, incident, resets):
    installed = registry.load()
    clip = str(shared_data / "euroc/MH_01_easy_15s")
    config = parse({"dataset": {"path": clip}, "detector": {"name": "fast"}}, "test")
    experiment = prepare(config, installed)
    experiment = replace(experiment, dataset=Disturbed(experiment.dataset, change))
    summary = record(experiment, tmp_path / "run")

    if incident is not None:
        assert summary["incidents"][incident] > 0
    assert summary["resets"] <= resets
    run = RunFolder.open(tmp_path / "run")
    estimate = run.trajectory()
    assert np.isfinite(estimate.p_WB).all()
    assert np.isfinite(estimate.R_WB).all()
    # Tracking again within 5 s of good data, and until the end.
    assert estimate.t_ns[-1] == summary["last_frame_t_ns"]
    if summary["resets"] == 0:
        assert evaluate(estimate, run.ground_truth()).ate_m.rmse < 0.05
    else:
        assert any("lost" in event["event"] for event in summary["events"])


@pytest.mark.parametrize(
    ("how", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -signal.SIGKILL)], ids=["ctrl-c", "killed"]
)
def test_an_interrupted_run_leaves_what_it_had(shared_data, tmp_path, how, code):
    folder = tmp_path / "run"
    data = shared_data / "euroc/MH_01_easy_15s"
    command = [sys.executable, "-m", "vioframe", "run", str(data), "--quiet", "--out", str(folder)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=dict(os.environ))
    trajectory = folder / "trajectory.tum"
    deadline = time.monotonic() + 120.0
    while time.monotonic() < deadline and not (trajectory.exists() and trajectory.read_text().count("\n") > 20):
        time.sleep(0.05)
    process.send_signal(how)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == code, errors
    assert b"Traceback" not in errors
    assert len(RunFolder.open(folder).trajectory()) >= 20
    if how is signal.SIGINT:
        assert json.loads((folder / "summary.json").read_text())["finished"] is False


def test_ctrl_c_within_compiled_code_is_an_interruption(shared_data, tmp_path):
    class Interrupted:
        def begin(self, start):
            pass

        def process(self, imu, tracks, still):
            raise SystemError("a result with an exception set") from KeyboardInterrupt()

    config = parse({"dataset": {"path": str(shared_data / "euroc/MH_01_easy_15s")}, "duration_s": 4.0}, "test")
    experiment = prepare(config, registry.load())
    experiment = replace(experiment, odometry=Odometry(experiment.dataset.calibration, "fast", Interrupted()))
    with pytest.raises(KeyboardInterrupt):
        record(experiment, tmp_path / "run")
    assert len(RunFolder.open(tmp_path / "run").trajectory()) == 1
