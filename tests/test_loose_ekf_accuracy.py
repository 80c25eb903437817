"""How accurate the loosely coupled back-end is on real images: what the project promises, from files to trajectory."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from vioframe.evaluation import evaluate
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder

TRUTH = "mav0/state_groundtruth_estimate0/data.csv"


def fly(clip: Path, folder: Path):
    """The whole pipeline into ``folder``; the summary and the errors against the clip's ground truth."""
    config = Config(dataset=DatasetConfig(path=clip), backend=PartConfig(name="loose_ekf"), ground_truth=clip / TRUTH)
    record(prepare(config, registry.load()), folder)
    done = RunFolder.open(folder)
    summary = json.loads((folder / "summary.json").read_text())
    return summary, evaluate(done.trajectory(), done.ground_truth())


def test_machine_hall(shared_data, tmp_path):
    summary, errors = fly(shared_data / "euroc/MH_01_easy_15s", tmp_path / "run")
    assert summary["frames"] == 300
    assert summary["completion"] == 1.0
    assert summary["resets"] == 0
    assert errors.coverage > 0.8
    assert errors.truth.path_length_m > 3.0
    assert errors.ate_m.rmse <= 0.015
    assert errors.scale == pytest.approx(1.0, abs=0.035)


def test_vicon_room_at_rest(shared_data, tmp_path):
    summary, errors = fly(shared_data / "euroc/V1_01_easy_rest", tmp_path / "run")
    drift_m = np.linalg.norm(errors.estimate.p_WB - errors.estimate.p_WB[0], axis=1).max()
    assert "initialised (static)" in [event["event"] for event in summary["events"]]
    assert summary["completion"] == 1.0
    assert drift_m <= 0.010
