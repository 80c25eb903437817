import copy
import gzip
import json
from io import StringIO

import numpy as np
import pytest
from trajectory_helpers import BEGIN_NS, PEERS, PERIOD_NS, disturbed, flight, moved

from vioframe.errors import TrajectoryError
from vioframe.evaluation import Stats, associate, evaluate
from vioframe.evaluation.alignment import align_se3
from vioframe.evaluation.metrics import relative_errors, rotation_error_rpy_deg
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory


def straight(n=1001, speed=1.0, yaw_rate=0.0, step_m=0.1):
    """Along x with a heading that drifts: a pose every ``step_m``."""
    yaw = yaw_rate * np.arange(n) * step_m
    p_WB = np.outer(np.arange(n) * step_m * speed, [1.0, 0.0, 0.0])
    return Trajectory(BEGIN_NS + PERIOD_NS * np.arange(n), so3.exp(np.outer(yaw, [0.0, 0.0, 1.0])), p_WB)


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.parametrize("pairing", ["evo", "interpolated"])
def test_se3_ate_equals_evos(shared_data, name, pairing):
    """evo pairs by the nearest stamp. The stamps of all these are the images', which the ground truth has as well."""
    sync, metrics = pytest.importorskip("evo.core.sync"), pytest.importorskip("evo.core.metrics")
    evo_trajectory = pytest.importorskip("evo.core.trajectory")
    file_interface = pytest.importorskip("evo.tools.file_interface")
    path = shared_data / "peer_trajectories" / f"{name}.txt.gz"
    estimate = load_trajectory(path, keep_first_of_repeats=True)
    truth = load_trajectory(shared_data / "euroc_imu_gt" / PEERS[name])
    by_stamp = {line.split()[0]: line for line in reversed(gzip.decompress(path.read_bytes()).decode().splitlines())}
    evo_estimate = file_interface.read_tum_trajectory_file(StringIO("\n".join(reversed(by_stamp.values()))))
    quat_wxyz = truth.quat_xyzw[:, [3, 0, 1, 2]]
    evo_truth = evo_trajectory.PoseTrajectory3D(truth.p_WB.copy(), quat_wxyz, truth.t_ns * 1e-9)
    # evo also pairs poses that are up to 10 ms outside the ground truth's time.
    covered = truth.covers(estimate.t_ns)
    evo_estimate.reduce_to_ids(np.flatnonzero(covered))
    evo_truth, evo_estimate = sync.associate_trajectories(evo_truth, evo_estimate, max_diff=0.01)
    aligned = copy.deepcopy(evo_estimate)
    aligned.align(evo_truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((evo_truth, aligned))
    scaled = copy.deepcopy(evo_estimate)
    _, _, scale = scaled.align(evo_truth, correct_scale=True)

    if pairing == "evo":
        quat_xyzw = evo_truth.orientations_quat_wxyz[:, [1, 2, 3, 0]]
        truth = Trajectory.from_quat_xyzw(estimate.t_ns[covered], evo_truth.positions_xyz, quat_xyzw)
    found = evaluate(estimate, truth, alignment="se3")
    tolerance = 1e-9 if pairing == "evo" else 1e-6
    assert len(found.estimate) == evo_truth.num_poses
    assert found.ate_se3_m == pytest.approx(ape.get_statistic(metrics.StatisticsType.rmse), abs=tolerance)
    assert found.ate_m.mean == pytest.approx(ape.get_statistic(metrics.StatisticsType.mean), abs=tolerance)
    assert found.ate_m.max == pytest.approx(ape.get_statistic(metrics.StatisticsType.max), abs=10 * tolerance)
    assert found.scale == pytest.approx(scale, abs=tolerance)


def test_stats():
    stats = Stats.of(np.array([3.0, -4.0, 0.0, 1.0]))
    assert (stats.mean, stats.median, stats.max) == (2.0, 2.0, 4.0)
    assert stats.rmse == pytest.approx(np.sqrt(26.0 / 4.0))


def test_a_perfect_estimate_in_another_gauge_has_no_error():
    truth = flight()
    found = evaluate(moved(truth, rotation_z(-1.2), np.array([4.0, 5.0, 6.0])), truth)
    assert found.ate_m.max < 1e-10
    assert found.ate_se3_m < 1e-10
    assert found.orientation_deg.max < 1e-5
    assert found.scale == pytest.approx(1.0, abs=1e-12)
    assert found.coverage == 1.0
    assert all(errors.translation_percent.max() < 1e-9 for errors in found.relative.values())
    assert found.notes == ()


def test_a_known_disturbance_is_measured_by_axis():
    truth = flight(2000)
    offset = np.zeros((2000, 3))
    offset[::2, 1], offset[1::2, 1] = 0.1, -0.1
    tilt = so3.exp(np.outer(np.where(np.arange(2000) % 2, 1.0, -1.0), [np.radians(2.0), 0.0, 0.0]))
    found = evaluate(Trajectory(truth.t_ns, tilt @ truth.R_WB, truth.p_WB + offset), truth)
    assert found.ate_m.rmse == pytest.approx(0.1, rel=1e-4)
    np.testing.assert_allclose(found.max_position_m, [0.0, 0.1, 0.0], atol=2e-4)
    np.testing.assert_allclose(found.max_rotation_deg, [2.0, 0.0, 0.0], atol=2e-3)
    assert found.orientation_deg.rmse == pytest.approx(2.0, rel=1e-5)
    assert found.yaw_deg.rmse < 2e-3


@pytest.mark.parametrize("yaw_deg", [-170.0, 0.0, 35.0])
def test_rotation_error_splits_into_tilt_and_yaw(yaw_deg):
    truth = flight(1)
    E = rotation_z(np.radians(yaw_deg)) @ so3.exp(np.radians([3.0, -2.0, 0.0]))
    turned = Trajectory(truth.t_ns, E @ truth.R_WB, truth.p_WB)
    np.testing.assert_allclose(rotation_error_rpy_deg(turned, truth), [[3.0, -2.0, yaw_deg]], atol=1e-10)


def test_relative_errors_of_a_wrong_scale_are_its_percentage():
    (errors,) = relative_errors(straight(speed=1.02), straight(), {8.0: 8.0}).values()
    np.testing.assert_allclose(errors.translation_percent, 2.0, rtol=1e-9)
    np.testing.assert_allclose(errors.rotation_deg, 0.0, atol=1e-9)
    assert len(errors.start_ns) == pytest.approx(1001 - 80, abs=1)


def test_relative_errors_of_a_drifting_heading_grow_with_the_length():
    found = relative_errors(straight(yaw_rate=np.radians(0.1)), straight(), {8.0: 8.0, 24.0: 24.0})
    for length, errors in found.items():
        np.testing.assert_allclose(errors.yaw_deg, 0.1 * length, rtol=0.02)
        np.testing.assert_allclose(errors.rotation_deg, errors.yaw_deg, rtol=1e-9)


def test_yaw_of_relative_errors_is_about_gravity_whatever_the_attitude():
    truth = flight()
    drift = so3.exp(np.outer(np.linspace(0.0, 0.2, len(truth)), [0.0, 0.0, 1.0]))
    estimate = Trajectory(truth.t_ns, drift @ truth.R_WB, truth.p_WB)
    for errors in relative_errors(estimate, truth, {8.0: 8.0}).values():
        np.testing.assert_allclose(errors.yaw_deg, errors.rotation_deg, rtol=1e-9)
        assert errors.yaw_deg.min() > 0.1


def test_no_rigid_alignment_changes_relative_errors():
    truth = flight()
    estimate = disturbed(truth, 0.05, 0.02)
    turned = moved(estimate, so3.exp([0.5, 0.2, -2.0]), np.array([1.0, 2.0, 3.0]))
    for a, b in zip(
        relative_errors(estimate, truth, {16.0: 16.0}).values(),
        relative_errors(turned, truth, {16.0: 16.0}).values(),
        strict=True,
    ):
        np.testing.assert_allclose(a.translation_percent, b.translation_percent, rtol=1e-9)
        np.testing.assert_allclose(a.yaw_deg, b.yaw_deg, atol=1e-9)


def test_lengths_beyond_the_path_are_left_out():
    truth = flight()
    assert 48.0 < truth.path_length_m < 60.0
    assert list(relative_errors(truth, truth, {8.0: 8.0, 60.0: 60.0})) == [8.0]
    assert relative_errors(truth, truth, {60.0: 60.0}) == {}


def test_a_stretch_across_a_gap_is_not_counted_as_shorter_than_it_is():
    whole = straight()
    holed = whole.select(np.concatenate([np.arange(300), np.arange(600, 1001)]))
    (errors,) = relative_errors(holed, holed, {8.0: 8.0}).values()
    across = (errors.start_ns > whole.t_ns[225]) & (errors.start_ns < whole.t_ns[300])
    assert not across.any()


def test_a_body_at_rest_is_evaluated_by_its_attitude():
    rng = np.random.default_rng(3)
    t_ns, R_WB = BEGIN_NS + PERIOD_NS * np.arange(100), np.tile(so3.exp([0.2, 0.1, 0.7]), (100, 1, 1))
    truth = Trajectory(t_ns, R_WB, rng.normal(0.0, 1e-3, (100, 3)))
    estimate = Trajectory(t_ns, rotation_z(1.0) @ R_WB, rng.normal(0.0, 1e-3, (100, 3)))
    found = evaluate(estimate, truth)
    assert found.orientation_deg.max < 1e-5
    assert found.ate_m.rmse == pytest.approx(np.sqrt(6.0) * 1e-3, rel=0.1)
    assert (found.scale, found.ate_se3_m, found.relative, found.relative_by_fraction) == (None, None, {}, {})
    assert "at rest" in found.notes[0]


def test_a_straight_flight_has_no_se3_figure_but_the_rest():
    found = evaluate(straight(speed=1.01), straight())
    assert (found.ate_se3_m, found.scale) == (None, None)
    assert found.ate_m.rmse == pytest.approx(0.01 * 100.0 / np.sqrt(12.0), rel=1e-2)


def test_what_looks_wrong_is_noted():
    truth = flight()
    turned_body = Trajectory(truth.t_ns, truth.R_WB @ so3.exp([0.0, np.pi, 0.0]), truth.p_WB)
    assert "turned by 180 deg" in evaluate(turned_body, truth).notes[0]
    R_WB, p_WB = truth.R_WB.copy(), truth.p_WB.copy()
    R_WB[:3], p_WB[:3] = np.eye(3), 0.0
    assert "the first 3 poses" in evaluate(Trajectory(truth.t_ns, R_WB, p_WB), truth).notes[0]


def test_the_summary_is_plain_json_and_says_what_it_was(tmp_path):
    truth = flight()
    found = json.loads(json.dumps(evaluate(disturbed(truth, 0.1, 0.01), truth, alignment="sim3").to_dict()))
    assert found["alignment"] == "sim3"
    assert found["ate_m"]["rmse"] == pytest.approx(0.1 * np.sqrt(3.0), rel=0.05)
    assert list(found["relative"]) == ["8m", "16m", "24m", "32m", "40m", "48m"]
    assert list(found["relative_by_fraction"]) == ["10%", "20%", "30%", "40%", "50%"]
    assert found["nees"] == {}


def test_an_unknown_alignment_is_an_error():
    with pytest.raises(TrajectoryError, match="unknown alignment 'yaw'; use one of posyaw, se3, sim3, first"):
        evaluate(flight(), flight(), alignment="yaw")


def test_coverage_is_the_part_of_the_flight_that_was_estimated():
    truth = flight(401)
    found = evaluate(truth.select(slice(100, 301)), truth)
    assert found.coverage == pytest.approx(0.5)


def test_se3_alignment_is_reported_beside_any_other():
    truth = flight()
    estimate = disturbed(moved(truth, so3.exp([0.05, 0.0, 1.0]), np.zeros(3)), 0.05, 0.0)
    aligned = align_se3(*associate(estimate, truth)).apply(estimate)
    expected = np.sqrt(np.mean(np.sum((aligned.p_WB - truth.p_WB) ** 2, axis=1)))
    found = evaluate(estimate, truth)
    assert found.ate_se3_m == pytest.approx(expected, rel=1e-12)
    assert found.ate_m.rmse > 2.0 * found.ate_se3_m
