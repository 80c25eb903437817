"""How accurate it is on real recordings: what the project promises, from the bag to the trajectory.

Real images (EuRoC), real corners (an AprilGrid), and simulated landmarks along real motion with the readings of the
real IMU. Everything goes through the same doors as the command line and the benchmarks. Limits are one and a half times
what was measured.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from april_board import april_sequence
from threadpoolctl import threadpool_limits

from vioframe.bench import Row, backend_row, run_backend
from vioframe.evaluation import TrajectoryErrors, evaluate
from vioframe.io.convert import convert
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder
from vioframe.simulation import REAL_MOTION_SEQUENCES, TrackSequence, real_motion_sequence

TRUTH = "mav0/state_groundtruth_estimate0/data.csv"


@cache
def installed() -> registry.Registry:
    return registry.load()


def fly(
    recording: Path, clip: Path, folder: Path, detector: str = "shi_tomasi", backend: str = "msckf"
) -> tuple[Row, TrajectoryErrors]:
    """The whole pipeline into ``folder``; the summary and the errors against the clip's ground truth."""
    config = Config(
        dataset=DatasetConfig(path=recording),
        detector=PartConfig(name=detector),
        backend=PartConfig(name=backend),
        ground_truth=clip / TRUTH,
    )
    record(prepare(config, installed()), folder)
    done = RunFolder.open(folder)
    estimate, truth = done.trajectory(), done.ground_truth()
    assert estimate is not None
    assert truth is not None
    return json.loads((folder / "summary.json").read_text()), evaluate(estimate, truth)


def fly_tracks(sequence: TrackSequence, backend: str = "msckf") -> Row:
    estimator = installed().create_backend(backend)
    with threadpool_limits(1):
        return backend_row(sequence, run_backend(sequence, estimator))


@pytest.fixture(scope="module")
def machine_hall(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The clip that begins in motion, and a ROS 1 bag made of it."""
    clip = shared_data / "euroc/MH_01_easy_15s"
    bag = tmp_path_factory.mktemp("bags") / "MH_01_easy_15s.bag"
    source = installed().open_dataset(clip)
    convert(source.measurements(), source.calibration, bag)
    return clip, bag


Flown = Callable[[str, str], tuple[Path, Row, TrajectoryErrors]]


@pytest.fixture(scope="module")
def flown(machine_hall: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """The run of a detector and a back-end on the bag, its summary and its errors: flown when first asked for."""
    clip, bag = machine_hall

    @cache
    def once(detector: str, backend: str) -> tuple[Path, Row, TrajectoryErrors]:
        folder = tmp_path_factory.mktemp("flown") / "run"
        return folder, *fly(bag, clip, folder, detector, backend)

    return once


def test_two_cameras_know_the_scale(shared_data, tmp_path):
    """Until the right one falls silent, after 10 s."""
    config = Config(
        dataset=DatasetConfig(path=shared_data / "euroc/MH_01_easy_15s", options={"cameras": ["cam0", "cam1"]}),
        detector=PartConfig(name="shi_tomasi"),
        backend=PartConfig(name="msckf"),
        duration_s=9.5,
    )
    record(prepare(config, installed()), tmp_path / "run")
    done = RunFolder.open(tmp_path / "run")
    errors = evaluate(done.trajectory(), done.ground_truth())
    assert errors.ate_m.rmse < 0.012
    assert abs(errors.scale - 1.0) < 0.01
    tracks = done.tracks()
    assert tracks is not None
    assert set(tracks.camera) == {0, 1}


@pytest.mark.parametrize(
    ("detector", "backend", "limit_m"),
    [
        ("shi_tomasi", "msckf", 0.0081),
        ("fast", "msckf", 0.0081),
        ("orb", "msckf", 0.0092),
        pytest.param("sift", "msckf", 0.0099, marks=pytest.mark.very_slow),
        pytest.param("akaze", "msckf", 0.0093, marks=pytest.mark.very_slow),
        pytest.param("brisk", "msckf", 0.0086, marks=pytest.mark.very_slow),
        pytest.param("surf", "msckf", 0.0084, marks=pytest.mark.very_slow),
        ("keypointnet", "msckf", 0.0090),
        ("shi_tomasi", "sliding_window", 0.0089),
    ],
)
def test_machine_hall_from_a_bag(flown, detector, backend, limit_m):
    _, summary, errors = flown(detector, backend)
    assert summary["finished"]
    assert summary["frames"] == 300
    assert summary["initialised_after_s"] <= 1.3
    assert summary["completion"] == 1.0
    assert summary["resets"] == 0
    assert errors.coverage > 0.8
    assert errors.truth.path_length_m > 3.0
    assert errors.ate_m.rmse <= limit_m
    assert errors.scale == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("backend", ["msckf", "sliding_window"])
def test_two_runs_on_one_bag_are_the_same_byte_for_byte(machine_hall, flown, tmp_path, backend):
    clip, bag = machine_hall
    once, _, _ = flown("shi_tomasi", backend)
    again = tmp_path / "run"
    fly(bag, clip, again, "shi_tomasi", backend)
    for file in ("trajectory.tum", "states.csv", "pose_cov.csv", "tracks.csv", "map.ply"):
        first, second = ((run / file).read_bytes() for run in (once, again))
        assert len(first) > 1000
        assert first == second, file


@pytest.mark.parametrize(("backend", "limit_m"), [("msckf", 0.008), ("sliding_window", 0.0125)])
def test_vicon_room_at_rest(shared_data, tmp_path, backend, limit_m):
    clip = shared_data / "euroc/V1_01_easy_rest"
    summary, errors = fly(clip, clip, tmp_path / "run", backend=backend)
    drift_m = np.linalg.norm(errors.estimate.p_WB - errors.estimate.p_WB[0], axis=1).max()
    assert "initialised (static)" in [event["event"] for event in summary["events"]]
    assert summary["completion"] == 1.0
    assert summary["initialised_after_s"] <= 1.5
    assert drift_m <= limit_m


@pytest.mark.parametrize(("backend", "limit_m"), [("msckf", 0.013), ("sliding_window", 0.013)])
def test_april_grid_under_strong_motion(shared_data, backend, limit_m):
    row = fly_tracks(april_sequence(shared_data / "euroc_imu_april"), backend)
    assert row["completion"] == 1.0
    assert row["resets"] == 0
    assert row["initialised_s"] < 3.0
    assert row["path_m"] > 10.0
    assert row["ate_m"] <= limit_m


@pytest.mark.very_slow
@pytest.mark.parametrize("name", REAL_MOTION_SEQUENCES)
def test_real_motion(shared_data, name):
    """Both back-ends on the same tracks."""
    sequence = real_motion_sequence(shared_data / "euroc_imu_gt" / name)
    for backend in ("msckf", "sliding_window"):
        assert _check_real_motion(sequence, 55.0, backend)["percent"] <= 0.25


def test_half_a_minute_of_real_motion(shared_data):
    """Part of the above for everyday: the liveliest flight's middle."""
    folder = shared_data / "euroc_imu_gt/V1_02_medium"
    sequence = real_motion_sequence(folder, start_s=15.0, duration_s=30.0)
    assert _check_real_motion(sequence, least_path_m=20.0)["percent"] <= 0.26


def _check_real_motion(sequence: TrackSequence, least_path_m: float, backend: str = "msckf") -> Row:
    row = fly_tracks(sequence, backend)
    assert row["completion"] == 1.0
    assert row["resets"] == 0
    assert row["path_m"] > least_path_m
    assert row["percent"] <= 0.5
    return row
