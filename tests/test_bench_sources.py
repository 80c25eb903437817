"""Track sources of the benchmarks, and what is made of a back-end's run on them."""

import json
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from april_board import (
    BoardView,
    april_sequence,
    board_poses,
    corner_count,
    fitted_lens,
    gravity_in_frame,
    read_board_views,
    reprojection_px,
    rotation_to_vertical,
    turned_otherwise,
)
from common import table
from position_clock import position_clock, with_positions_of_later
from trajectory_helpers import run_of

from vioframe.bench import backend_row, record
from vioframe.errors import DatasetError, TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.cameras import intrinsics_of
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import simulated_sequence
from vioframe.simulation.scenario import interpolate_poses, linear
from vioframe.types import Estimate, NavState, Status, g_W

CALIBRATION = packaged_calibration("euroc", cameras=["cam0"])


@pytest.fixture(scope="module")
def april(shared_data):
    return shared_data / "euroc_imu_april"


@pytest.fixture(scope="module")
def april_tracks(april):
    return april_sequence(april)


def rows_of(segments):
    """Stamps, gyroscope and accelerometer of all segments in one, without the ends that neighbours share."""
    parts = [(s.t_ns[:-1], s.gyro_B[:-1], s.accel_B[:-1]) for s in segments]
    return tuple(np.concatenate(column) for column in zip(*parts, strict=True))


@pytest.mark.parametrize("seed", range(3))
def test_gravity_is_found_in_a_turned_frame(seed):
    """Exact poses in an arbitrary frame A, noisy and biased readings: a tenth of what the bias does to it."""
    bias = np.array([0.2, -0.1, 0.15])
    sequence = simulated_sequence("figure_eight", seed=seed, max_points=1, bias_accel_B=bias)
    R_AW = so3.exp(np.random.default_rng(seed).normal(size=3))
    truth = sequence.ground_truth
    in_A = Trajectory(truth.t_ns, R_AW @ truth.R_WB, truth.p_WB @ R_AW.T)
    t_ns, _, accel_B = rows_of([imu for imu, _ in sequence.packets[1:]])
    g_A = gravity_in_frame(in_A, t_ns, accel_B)
    assert np.linalg.norm(g_A) == pytest.approx(9.81, abs=0.03)
    assert np.degrees(np.arccos(g_A @ (R_AW @ g_W) / np.linalg.norm(g_A) / 9.81)) < 0.1
    np.testing.assert_allclose(rotation_to_vertical(g_A) @ g_A, [0, 0, -np.linalg.norm(g_A)], atol=1e-12)


@pytest.mark.parametrize("late_ms", [-20.0, 0.0, 7.0])
def test_the_clock_of_positions_is_found_and_its_error_is_as_it_says(late_ms):
    """Of noisy positions and of noisy, biased readings."""
    off = []
    for seed in range(8):
        sequence = simulated_sequence("figure_eight", seed=seed, max_points=1, bias_accel_B=np.array([0.2, -0.1, 0.15]))
        truth, (t_ns, _, accel_B) = sequence.ground_truth, rows_of([imu for imu, _ in sequence.packets[1:]])
        often_ns = np.arange(truth.t_ns[0], truth.t_ns[-1], 5_000_000)
        R_WB, p_WB = interpolate_poses(truth.t_ns, truth.R_WB, truth.p_WB, often_ns)
        noisy = p_WB + np.random.default_rng(seed).normal(0.0, 2e-3, p_WB.shape)
        moved_ns = often_ns + round(late_ms * 1e6)
        seen = (often_ns >= moved_ns[0]) & (often_ns <= moved_ns[-1])
        late = linear(moved_ns, noisy, often_ns[seen])
        clock = position_clock(Trajectory(often_ns[seen], R_WB[seen], late), t_ns, accel_B)
        off.append((1e3 * clock.late_s - late_ms) / (1e3 * clock.sigma_s))
        assert 1e3 * clock.sigma_s < 1.0
        on_time = with_positions_of_later(Trajectory(often_ns[seen], R_WB[seen], late), clock.late_s)
        due = linear(often_ns, p_WB, on_time.t_ns)
        assert np.sqrt(((on_time.p_WB - due) ** 2).sum(axis=1).mean()) < 5e-3
    assert np.sqrt(np.mean(np.square(off))) < 1.7


def test_positions_far_off_in_time_have_no_clock():
    """By 0.3 s."""
    sequence = simulated_sequence("figure_eight", max_points=1)
    truth, (t_ns, _, accel_B) = sequence.ground_truth, rows_of([imu for imu, _ in sequence.packets[1:]])
    with pytest.raises(TrajectoryError, match="stamps and axes"):
        position_clock(Trajectory(truth.t_ns[6:], truth.R_WB[6:], truth.p_WB[:-6]), t_ns, accel_B)


def test_gravity_needs_some_motion():
    sequence = simulated_sequence("hover", duration_s=1.5, max_points=1)
    t_ns, _, accel_B = rows_of([imu for imu, _ in sequence.packets[1:]])
    with pytest.raises(TrajectoryError, match="2 s"):
        gravity_in_frame(sequence.ground_truth, t_ns, accel_B)


@pytest.mark.parametrize("g_A", [[0.0, 0.0, -9.81], [0.0, 0.0, 9.81], [9.81, 0.0, 0.0]])
def test_any_direction_can_be_brought_to_the_vertical(g_A):
    R_WA = rotation_to_vertical(np.array(g_A))
    np.testing.assert_allclose(R_WA @ g_A, g_W, atol=1e-12)
    np.testing.assert_allclose(R_WA @ R_WA.T, np.eye(3), atol=1e-12)


BOARD_CENTRE = np.array([0.33, 0.33, 0.0])


def seen_board(camera, R_AC, p_AC):
    """What a ``camera`` at the poses (N, 3, 3) and (N, 3) m sees of a board of 12 x 12 corners, without noise."""
    p_A = 0.06 * np.array([[x, y, 0.0] for y in range(12) for x in range(12)])
    views = []
    for k, (R, p) in enumerate(zip(R_AC, p_AC, strict=True)):
        xy = camera.project((p_A - p) @ R)
        keep = camera.contains(xy)
        views.append(BoardView(k, np.flatnonzero(keep), xy[keep], p_A[keep]))
    return views


def test_board_poses_recover_a_known_camera():
    """A synthetic board, seen without noise and with 0.3 px: exact, and within a few millimetres at 1.2 m."""
    rng = np.random.default_rng(0)
    R_true = so3.exp(rng.uniform(-0.5, 0.5, (20, 3)))  # tilted by up to 30 deg
    p_true = BOARD_CENTRE - R_true @ [0.0, 0.0, 1.2]
    views = seen_board(CALIBRATION.cameras[0].model, R_true, p_true)
    R_AC, p_AC = board_poses(views, CALIBRATION.cameras[0].model)
    np.testing.assert_allclose(R_AC, R_true, atol=1e-6)
    np.testing.assert_allclose(p_AC, p_true, atol=1e-6)
    noisy = [BoardView(v.t_ns, v.corner, v.xy + rng.normal(0, 0.3, v.xy.shape), v.p_A) for v in views]
    R_AC, p_AC = board_poses(noisy, CALIBRATION.cameras[0].model)
    assert np.linalg.norm(p_AC - p_true, axis=1).max() < 5e-3
    assert np.sqrt(np.mean(reprojection_px(noisy, CALIBRATION.cameras[0].model, R_AC, p_AC) ** 2)) == pytest.approx(
        0.3 * np.sqrt(2), rel=0.05
    )


def test_a_lens_is_found_from_a_board_and_how_it_is_turned():
    """One whose centre is 6 px aside, seen in views that the published lens begins with."""
    rng, published = np.random.default_rng(1), CALIBRATION.cameras[0].model
    true = replace(published, cx=published.cx - 6.0, fx=published.fx - 2.0, distortion=(-0.31, 0.1, 0.0, 0.0003))
    R_AC = so3.exp(rng.uniform(-0.5, 0.5, (160, 3)))
    ahead_C = rng.uniform([-0.2, -0.2, 0.7], [0.2, 0.2, 1.3], (160, 3))
    views = seen_board(true, R_AC, BOARD_CENTRE - (R_AC @ ahead_C[..., None])[..., 0])
    fitted, R_CF = fitted_lens(views, published)
    np.testing.assert_allclose(intrinsics_of(fitted)[1], intrinsics_of(true)[1], rtol=1e-4, atol=1e-4)
    # What the published lens sees 6 px to the right of its centre lies straight ahead of a camera turned that way.
    assert so3.log(R_CF) @ [0.0, 1.0, 0.0] == pytest.approx(-6.0 / published.fx, abs=2e-3)


def test_april_corners_fit_the_published_calibration_and_a_lens_of_their_own(april, april_tracks):
    views, published = read_board_views(april), CALIBRATION.cameras[0].model
    assert len(views) == 720
    fitted, _ = fitted_lens(views, published)
    for lens, limit_px in ((published, 0.42), (fitted, 0.37)):
        assert np.sqrt(np.mean(reprojection_px(views, lens, *board_poses(views, lens)) ** 2)) < limit_px
    # The first image is 15 ms older than the first reading.
    assert len(april_tracks.packets) == 719
    assert april_tracks.ground_truth.path_length_m == pytest.approx(19.77, abs=0.1)


def test_april_ids_are_corners_and_new_after_every_absence(april, april_tracks):
    views = read_board_views(april)
    count = corner_count(views)
    assert count == 144
    last: dict[int, tuple[int, int]] = {}
    returned = 0
    for k, ((_, tracks), view) in enumerate(zip(april_tracks.packets, views[1:], strict=True)):
        assert np.array_equal(tracks.ids % count, view.corner)
        assert np.array_equal(tracks.xy, view.xy)
        for i in tracks.ids.tolist():
            at, before = last.get(i % count, (k - 1, i))
            assert (i == before) == (at == k - 1)
            returned += i != before
            last[i % count] = (k, i)
    assert returned > 100


def test_april_truth_agrees_with_the_gyroscope_and_the_vertical(april, april_tracks):
    """Over 0.2 s, by more than a quarter radian at times; by the published lens it does so less well."""
    R_WB = april_tracks.ground_truth.R_WB
    assert max(np.linalg.norm(so3.log(a.T @ b)) for a, b in zip(R_WB, R_WB[4:], strict=False)) > 0.25
    by_published = turned_otherwise(april_sequence(april, truth_by=(CALIBRATION.cameras[0].model, np.eye(3))))
    assert turned_otherwise(april_tracks) < 0.75 * by_published < 2.5e-3
    force_W = np.mean([R @ imu.accel_B[-1] for R, (imu, _) in zip(R_WB, april_tracks.packets, strict=True)], axis=0)
    assert np.degrees(np.arccos(force_W[2] / np.linalg.norm(force_W))) < 2.0


def test_missing_files_are_named(tmp_path):
    with pytest.raises(DatasetError, match="imu0"):
        april_sequence(tmp_path)


def oracle(sequence, offset_m):
    """What a back-end says that is told the truth, with an offset along x; it begins late and is lost once."""
    estimates = []
    for k, s in enumerate(sequence.true_states):
        p_WB = s.p_WB + np.array([offset_m if k % 2 else -offset_m, 0.0, 0.0])
        state = NavState(s.t_ns, s.R_WB, p_WB, s.v_WB, s.bias_gyro_B, s.bias_accel_B, np.eye(15) * 0.01)
        estimates.append(Estimate(Status.TRACKING, state))
        if k < 10:
            estimates[k] = Estimate(Status.INITIALISING, stage_seconds={"initialise": 0.5})
        elif 20 <= k < 25:
            estimates[k] = Estimate(Status.LOST)
    return run_of(sequence, estimates)


def test_a_run_is_counted_and_measured():
    sequence = simulated_sequence("figure_eight", max_points=5, duration_s=5.0)
    run = oracle(sequence, offset_m=0.1)
    row = backend_row(sequence, run)
    assert row["frames"] == 101
    assert row["initialised_s"] == pytest.approx(0.5)
    assert row["resets"] == 1
    assert row["completion"] == pytest.approx(86 / 91)
    assert row["ate_m"] == pytest.approx(0.1, rel=0.01)
    assert row["path_m"] == pytest.approx(sequence.ground_truth.at(run.trajectory.t_ns).path_length_m)
    assert row["percent"] == pytest.approx(100 * row["ate_m"] / row["path_m"])
    assert row["stage_ms"]["initialise"] == pytest.approx(10 * 500 / 101)
    assert run.trajectory.cov_pose.shape == (86, 6, 6)


def test_a_back_end_that_never_begins_is_a_row_too():
    sequence = simulated_sequence("figure_eight", max_points=5, duration_s=0.4)
    run = oracle(sequence, offset_m=0.0)
    row = backend_row(sequence, run)
    assert row["initialised_s"] is None
    assert row["completion"] == 0.0
    assert "ate_m" not in row
    with pytest.raises(TrajectoryError, match="initialisation"):
        _ = run.trajectory


def test_rows_are_shown_and_kept(tmp_path):
    from rich.console import Console

    rows = [{"sequence": "one", "ate_m": 0.12345, "stage_ms": {"total": 3.21}}, {"sequence": "two"}]
    console = Console(width=80, file=StringIO())
    console.print(table("Title", rows, {"sequence": "", "ate_m": ".3f", "stage_ms.total": ".1f"}))
    text = console.file.getvalue()
    assert [word for word in ("Title", "one", "0.123", "3.2", "two", "-") if word not in text] == []
    record(tmp_path / "new" / "x.json", rows, {"seed": 1})
    kept = json.loads((tmp_path / "new" / "x.json").read_text())
    assert kept["results"] == rows
    assert kept["settings"] == {"seed": 1}
    assert kept["machine"]["cpu"]
