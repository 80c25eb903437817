"""The run folder: complete after a run, readable after an interruption, never silently replaced."""

import json
from dataclasses import replace
from time import perf_counter

import numpy as np
import pytest

from vioframe.errors import RunError
from vioframe.geometry import so3
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.runs import machine
from vioframe.runs import recorder as recorder_module
from vioframe.runs.folder import RunFolder
from vioframe.runs.recorder import (
    CALIBRATION_COLUMNS,
    POSE_COV_COLUMNS,
    STATE_COLUMNS,
    Recorder,
    check_run_folder,
    free_run_folder,
    new_run_folder,
)
from vioframe.types import (
    Calibration,
    CalibrationEstimate,
    CameraSigma,
    Estimate,
    FrameSet,
    FrameTracks,
    MapCorrection,
    NavState,
    Status,
    Step,
)

FIRST_NS = 1_403_636_579_763_555_584  # a float of seconds would lose the last digits
PERIOD_NS = 50_000_000


def step(k: int, status: Status = Status.TRACKING, *, points: int = 2, cov: bool = True, **more) -> Step:
    """Frame ``k`` of a run that moves 0.1 m a frame and yaws 0.02 rad."""
    t_ns = FIRST_NS + k * PERIOD_NS
    camera, xy = np.arange(points) % 2, np.full((points, 2), 10.25 + k)
    tracks = FrameTracks(t_ns, np.arange(points), camera, xy, np.zeros((points, 2)))
    state = None
    if status is Status.TRACKING:
        R_WB, p_WB = so3.exp([0.0, 0.0, 0.02 * k]), np.array([0.1 * k, 0.0, 1e-9])
        covariance = np.diag(np.arange(1.0, 16.0)) + 0.5 if cov else None
        state = NavState(t_ns, R_WB, p_WB, np.array([2.0, 0.0, 0.0]), np.full(3, 1e-3), np.full(3, 2e-2), covariance)
    seconds = {"klt": 0.004, "backend": 0.006} | ({"backend.update": 0.005} if state else {})
    estimate = Estimate(status, state, **more)
    return Step(FrameSet(t_ns, (np.zeros((4, 4), np.uint8),)), tracks, estimate, seconds)


def record(folder, steps, incidents=None):
    new_run_folder(folder)
    with Recorder(folder, {"name": "test"}, incidents or Incidents(), perf_counter()) as recorder:
        for one in steps:
            recorder.add(one)
    return recorder.summary


def columns(path):
    return path.read_text().splitlines()[0].split(",")


def test_a_run_says_everything(tmp_path):
    incidents = Incidents()
    incidents.add("imu_nan", FIRST_NS, "dropped")
    waiting = [step(0, Status.INITIALISING, events=("refused: no parallax",)), step(1, Status.INITIALISING)]
    record(tmp_path / "run", [*waiting, *(step(k) for k in range(2, 10))], incidents)
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["finished"] is True
    assert summary["frames"] == 10
    assert summary["first_frame_t_ns"] == FIRST_NS
    assert summary["initialised_t_ns"] == FIRST_NS + 2 * PERIOD_NS
    assert summary["initialised_after_s"] == 0.1
    assert summary["completion"] == 1.0
    assert summary["resets"] == 0
    assert summary["tracked_points_mean"] == 2.0
    assert summary["mean_ms"] == pytest.approx({"klt": 4.0, "backend": 6.0, "backend.update": 4.0})
    assert summary["mean_frame_ms"] == pytest.approx(10.0), "a back-end's stages are parts of its whole"
    assert summary["real_time_factor"] == pytest.approx(0.45 / summary["working_s"])
    assert summary["events"] == [{"t_ns": FIRST_NS, "event": "refused: no parallax"}]
    assert summary["event_counts"] == {"refused": 1}
    assert summary["incidents"] == {"imu_nan": 1}


def test_the_files_hold_what_the_steps_said(tmp_path):
    record(tmp_path / "run", [step(k) for k in range(5)])
    run = RunFolder.open(tmp_path / "run")
    estimate = run.trajectory()
    np.testing.assert_array_equal(estimate.t_ns, FIRST_NS + PERIOD_NS * np.arange(5))
    np.testing.assert_allclose(estimate.p_WB[:, 0], 0.1 * np.arange(5), atol=1e-9)
    np.testing.assert_allclose(estimate.p_WB[:, 2], 1e-9, atol=0.0)
    np.testing.assert_allclose(so3.log(estimate.R_WB)[:, 2], 0.02 * np.arange(5), atol=1e-11)
    np.testing.assert_allclose(estimate.cov_pose[3], (np.diag(np.arange(1.0, 16.0)) + 0.5)[:6, :6])
    assert columns(run.path / "states.csv") == list(STATE_COLUMNS)
    assert columns(run.path / "pose_cov.csv") == list(POSE_COV_COLUMNS)
    states = np.loadtxt(run.path / "states.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(states[2, 1:10], [2.0, 0.0, 0.0, *[1e-3] * 3, *[2e-2] * 3])
    np.testing.assert_allclose(states[2, 10:], np.arange(1.0, 16.0) + 0.5)
    counts = run.tracks()
    assert counts.tracked.tolist() == [2] * 5
    assert counts.new.tolist() == [2, 0, 0, 0, 0]
    assert columns(run.path / "tracks.csv") == ["t_ns", "id", "camera", "x_px", "y_px"]
    assert counts.camera.tolist() == [0, 1] * 5
    assert counts.xy[-1].tolist() == [14.25, 14.25]


def learned(k: int) -> CalibrationEstimate:
    """Of a rig of two, off by what tells the frames and the cameras apart."""
    rig: Calibration = packaged_calibration("euroc")
    for place, camera in enumerate(rig.cameras):
        moved = camera.p_BC + np.array([0.001 * k, 0.01 * place, 0.0])
        rig = rig.with_camera(place, p_BC=moved, time_offset_ns=1_000_000 * k + place, readout_s=0.01 * k)
    sigma = CameraSigma(np.full(3, 1e-3), np.full(3, 2e-3 / (k + 1)), 3e-3, np.arange(8.0), 4e-3)
    return CalibrationEstimate(rig, (sigma,) * len(rig.cameras))


def test_what_is_learned_of_the_rig_is_kept_a_row_a_frame_and_camera_and_at_last_as_files(tmp_path):
    frames = [step(0, Status.INITIALISING), *(step(k, calibration=learned(k)) for k in range(1, 4))]
    record(tmp_path / "run", frames)
    assert columns(tmp_path / "run" / "calibration.csv") == list(CALIBRATION_COLUMNS)
    table = np.genfromtxt(tmp_path / "run" / "calibration.csv", delimiter=",", names=True)
    stamps = np.genfromtxt(
        tmp_path / "run" / "calibration.csv", delimiter=",", skip_header=1, usecols=0, dtype=np.int64
    )
    assert stamps.tolist() == [FIRST_NS + k * PERIOD_NS for k in (1, 1, 2, 2, 3, 3)]
    assert table["camera"].tolist() == [0, 1] * 3
    given = packaged_calibration("euroc")
    np.testing.assert_allclose(
        table["px"] - np.tile([c.p_BC[0] for c in given.cameras], 3), np.repeat([1, 2, 3], 2) / 1e3
    )
    np.testing.assert_allclose(table["sigma_px"], np.repeat([1e-3, 2e-3 / 3, 5e-4], 2))
    np.testing.assert_allclose(table["time_offset_s"], np.repeat([1e-3, 2e-3, 3e-3], 2), atol=1e-8)
    np.testing.assert_allclose(table["readout_s"], np.repeat([0.01, 0.02, 0.03], 2))
    np.testing.assert_allclose(table["sigma_readout_s"], 0.004)
    np.testing.assert_allclose(table["fx"], [c.model.fx for c in given.cameras] * 3)
    assert table["sigma_d4"].tolist() == [7.0] * 6
    read, last = RunFolder.open(tmp_path / "run").learned_calibration(), learned(3).calibration
    assert read is not None
    assert read.imu == last.imu
    for camera, expected in zip(read.cameras, last.cameras, strict=True):
        for name in ("name", "model", "time_offset_ns", "readout_s"):
            assert getattr(camera, name) == getattr(expected, name)
        np.testing.assert_array_equal(camera.p_BC, expected.p_BC)
        np.testing.assert_allclose(camera.R_BC, expected.R_BC, atol=1e-15)


def test_corrections_are_kept_where_they_change(tmp_path):
    moved = MapCorrection(so3.rotation_z(0.25), np.array([0.5, -1.0, 2.0]))
    corrections = [MapCorrection(), MapCorrection(), moved, moved, MapCorrection()]
    steps = [replace(step(k), correction=correction) for k, correction in enumerate(corrections)]
    record(tmp_path / "run", steps)
    lines = (tmp_path / "run" / "loop_corrections.csv").read_text().splitlines()
    assert lines == [
        "t_ns,x_m,y_m,z_m,yaw_rad",
        f"{FIRST_NS},0,0,0,0",
        f"{FIRST_NS + 2 * PERIOD_NS},0.5,-1,2,0.25",
        f"{FIRST_NS + 4 * PERIOD_NS},0,0,0,0",
    ]
    record(tmp_path / "without", [step(k) for k in range(3)])
    assert not (tmp_path / "without" / "loop_corrections.csv").exists()


def test_events_are_counted_and_only_the_first_of_a_kind_and_its_last_are_kept(tmp_path):
    frames = [step(k, Status.INITIALISING, events=(f"refused: by {k} m",)) for k in range(300)]
    summary = record(tmp_path / "run", [*frames, step(300, events=("initialised (static)",))])
    assert summary["event_counts"] == {"refused": 300, "initialised (static)": 1}
    kept = [event["event"] for event in summary["events"]]
    assert kept == [*(f"refused: by {k} m" for k in range(20)), "refused: by 299 m", "initialised (static)"]


def test_a_stage_that_first_occurs_later_is_a_column_for_all_rows(tmp_path):
    record(tmp_path / "run", [step(0, Status.INITIALISING), step(1), step(2)])
    timings = RunFolder.open(tmp_path / "run").timings()
    assert timings.seconds["backend.update"].tolist() == [0.0, 0.005, 0.005]
    assert timings.seconds["klt"].tolist() == [0.004] * 3
    assert len(timings.t_ns) == 3


def test_an_unknown_covariance_is_nan(tmp_path):
    record(tmp_path / "run", [step(0, cov=False), step(1)])
    states = np.loadtxt(tmp_path / "run" / "states.csv", delimiter=",", skiprows=1)
    assert np.isnan(states[0, 10:]).all()
    assert np.isfinite(states[1]).all()


def test_a_reset_is_counted_and_its_landmarks_are_dropped(tmp_path):
    seen = [step(k, landmark_ids=np.array([k, 7]), p_WF=np.full((2, 3), float(k))) for k in (0, 1)]
    again = step(4, landmark_ids=np.array([9, 8]), p_WF=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    summary = record(tmp_path / "run", [*seen, step(2, Status.LOST), step(3, Status.INITIALISING), again])
    assert summary["resets"] == 1
    assert summary["completion"] == 3 / 5
    header, rows = (tmp_path / "run" / "map.ply").read_text().split("end_header\n")
    assert "element vertex 2\n" in header
    assert rows == "4.000000 5.000000 6.000000 8\n1.000000 2.000000 3.000000 9\n"


def test_a_landmark_is_written_as_last_refined(tmp_path):
    refined = [step(k, landmark_ids=np.array([3]), p_WF=np.full((1, 3), 0.5 * k)) for k in (1, 2)]
    record(tmp_path / "run", refined)
    assert (tmp_path / "run" / "map.ply").read_text().endswith("end_header\n1.000000 1.000000 1.000000 3\n")


def test_of_many_landmarks_each_is_written_as_last_refined(tmp_path, monkeypatch):
    """Also those that were put aside meanwhile."""
    monkeypatch.setattr(recorder_module, "_RECENT_LANDMARKS", 10)
    seen = [step(k, landmark_ids=np.arange(k, k + 8), p_WF=np.full((8, 3), float(k))) for k in range(30)]
    record(tmp_path / "run", seen)
    landmarks = RunFolder.open(tmp_path / "run").landmarks()
    assert landmarks.ids.tolist() == list(range(37))
    assert landmarks.p_WF[:, 1].tolist() == [float(min(i, 29)) for i in range(37)]


def test_an_interrupted_run_keeps_what_it_had(tmp_path):
    def steps():
        yield from (step(k) for k in range(3))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(tmp_path / "run", steps())
    run = RunFolder.open(tmp_path / "run")
    assert len(run.trajectory()) == 3
    assert run.summary["finished"] is False
    assert run.summary["frames"] == 3
    assert run.summary["stopped_by"] == "KeyboardInterrupt:"


def test_a_run_that_is_killed_has_written_every_frame_so_far(tmp_path):
    new_run_folder(tmp_path / "run")
    recorder = Recorder(tmp_path / "run", {"name": "test"}, Incidents(), perf_counter())
    for k in range(3):
        recorder.add(step(k))
        run = RunFolder.open(tmp_path / "run")
        assert len(run.trajectory()) == k + 1
        assert len(run.timings().t_ns) == k + 1
        assert run.summary["finished"] is False


def test_a_run_that_never_initialises_is_readable(tmp_path):
    summary = record(tmp_path / "run", [step(0, Status.INITIALISING, points=0)])
    assert (summary["initialised_t_ns"], summary["completion"], summary["finished"]) == (None, 0.0, True)
    assert RunFolder.open(tmp_path / "run").trajectory() is None


def test_two_runs_are_the_same_byte_for_byte(tmp_path):
    for name in ("a", "b"):
        record(tmp_path / name, [step(k, landmark_ids=np.array([k]), p_WF=np.ones((1, 3)) / 3) for k in range(4)])
    for file in ("trajectory.tum", "states.csv", "pose_cov.csv", "tracks.csv", "map.ply"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_a_run_is_replaced_only_on_request_and_nothing_but_the_run(tmp_path):
    run = tmp_path / "run"
    record(run, [step(0)])
    mine = [run / "notes.md", run / "calibration" / "mine.yaml", tmp_path / "elsewhere" / "cam0" / "sensor.yaml"]
    (run / "calibration" / "cam0").mkdir(parents=True)
    (run / "calibration" / "cam0" / "sensor.yaml").touch()
    for file in mine:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    (run / "calibration_learned").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(RunError, match="exists already; choose another --out or pass --overwrite"):
        new_run_folder(run)
    assert (run / "trajectory.tum").exists()
    new_run_folder(run, overwrite=True)
    assert all(file.exists() for file in mine)
    assert {file.name for file in run.rglob("*")} == {"notes.md", "calibration", "mine.yaml", "calibration_learned"}


def test_what_is_no_run_is_never_replaced(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").touch()
    (tmp_path / "file").touch()
    for path in (tmp_path / "thesis", tmp_path / "file"):
        with pytest.raises(RunError, match="is not a run folder and is not overwritten"):
            new_run_folder(path, overwrite=True)
    assert (tmp_path / "thesis" / "chapter.tex").exists()


def test_a_folder_that_cannot_be_made_is_an_error_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="cannot create the run folder"):
        new_run_folder(tmp_path / "file" / "run")


def test_free_names_are_numbered(tmp_path):
    assert free_run_folder(tmp_path, "a").name == "a"
    (tmp_path / "a").mkdir()
    (tmp_path / "a_2").mkdir()
    assert free_run_folder(tmp_path, "a").name == "a_3"
    check_run_folder(tmp_path / "a")  # an empty folder may be used


def test_the_machine_is_described_in_plain_values():
    facts = machine.describe()
    assert json.loads(json.dumps(facts)) == facts
    assert {"numpy", "opencv-python-headless", "scipy"} <= set(facts["versions"])
    assert facts["cpu"]
    assert facts["threads"]["opencv"] >= 1


def test_the_commit_is_that_of_the_code_or_none(tmp_path):
    (tmp_path / "__init__.py").touch()
    assert machine.commit(tmp_path) is None
