"""The loosely coupled filter's equations: derivatives on the manifold, changes of variables, and filterpy's part."""

from dataclasses import replace

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from msckf_helpers import CALIBRATION, random_covariance

from vioframe.estimation.inertial.propagation import propagate
from vioframe.geometry import so3
from vioframe.simulation import simulated_sequence
from vioframe.types import DP, DTHETA, ImuSegment, NavState, g_W
from vioframe_loose_ekf.fusion import Fusion
from vioframe_loose_ekf.state import DP_WA, DTHETA_WV, IMU, LOG_SCALE, SIZE, FilterState, VisionPose

CAMERA = CALIBRATION.cameras[0]
SEEDS = pytest.mark.parametrize("seed", range(4))
STEP = 1e-6


def random_state(seed: int) -> FilterState:
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(6, 3))
    return FilterState(
        so3.exp(rng.normal(size=3)), *vectors[:4], rng.normal(), so3.exp(rng.normal(size=3)), vectors[4], vectors[5]
    )


def random_fusion(seed: int) -> Fusion:
    """In the midst of a flight, everything correlated with everything."""
    rng = np.random.default_rng(seed + 100)
    nav = NavState(0, np.eye(3), *np.zeros((4, 3)), np.eye(15))
    fusion = Fusion(nav, CAMERA)
    fusion.state = random_state(seed)
    fusion._kalman.P = 0.01**2 * random_covariance(rng, SIZE)
    return fusion


def pose_covariance(fusion: Fusion) -> np.ndarray:
    """(6, 6), of the camera's pose in V as the filter has it."""
    H = fusion.state.pose_jacobian(CAMERA)
    return H @ fusion.cov @ H.T


@SEEDS
def test_the_pose_jacobian_is_the_derivative_on_the_manifold(seed):
    state = random_state(seed)
    here = state.pose(CAMERA)

    def moved(dx):
        return state.retract(dx).pose(CAMERA).beyond(here)

    numeric = np.column_stack([(moved(d) - moved(-d)) / (2 * STEP) for d in STEP * np.eye(SIZE)])
    np.testing.assert_allclose(state.pose_jacobian(CAMERA), numeric, atol=1e-7)


@SEEDS
def test_moving_the_anchor_changes_neither_what_is_seen_nor_how_sure_it_is(seed):
    fusion = random_fusion(seed)
    points_V = np.random.default_rng(seed).normal(size=(5, 3))
    before, sure, points_W = fusion.state, pose_covariance(fusion), fusion.state.in_world(points_V)
    fusion.move_anchor(before.p_VA + np.array([1.0, -2.0, 0.5]))
    np.testing.assert_allclose(fusion.state.in_world(points_V), points_W, atol=1e-12)
    moved = fusion.state.pose(CAMERA)
    np.testing.assert_allclose(moved.beyond(before.pose(CAMERA)), 0.0, atol=1e-12)
    np.testing.assert_allclose(pose_covariance(fusion), sure, rtol=1e-8, atol=1e-14)
    drifted = random_fusion(seed)
    drifted.move_anchor(fusion.state.p_VA, (0.1, 0.2, 0.3))
    added = np.diag(drifted.cov - fusion.cov)[IMU:]
    expected = np.repeat([0.1, 0.2, 0.3 / fusion.state.scale], [1, 3, 3])
    np.testing.assert_allclose(added, expected**2, rtol=1e-8)


@SEEDS
def test_a_new_vision_frame_is_the_camera_exactly_and_of_unknown_scale(seed):
    fusion = random_fusion(seed)
    body = fusion.cov[:IMU, :IMU].copy()
    fusion.place_vision_frame()
    pose = fusion.state.pose(CAMERA)
    np.testing.assert_allclose(pose.R_VC, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose.p_VC, 0.0, atol=1e-12)
    np.testing.assert_allclose(pose_covariance(fusion), 0.0, atol=1e-14)
    np.testing.assert_array_equal(fusion.cov[:IMU, :IMU], body)
    assert fusion.cov[LOG_SCALE, LOG_SCALE].item() == pytest.approx(0.49)
    assert not fusion.cov[LOG_SCALE, :IMU].any()


@SEEDS
def test_a_frame_tied_anew_fits_the_pose_as_well_as_the_pose_is_known(seed):
    fusion = random_fusion(seed)
    scale = fusion.state.log_scale
    rng = np.random.default_rng(seed)
    measured = VisionPose(so3.exp(rng.normal(size=3)), rng.normal(size=3))
    cov = 1e-6 * random_covariance(rng, 6)
    known = fusion.cov[LOG_SCALE, LOG_SCALE].item()
    fusion.tie_anew(measured, cov, 0.1)
    predicted = fusion.state.pose(CAMERA)
    np.testing.assert_allclose(measured.beyond(predicted), 0.0, atol=1e-12)
    np.testing.assert_allclose(pose_covariance(fusion), cov, rtol=1e-7, atol=1e-14)
    assert fusion.state.log_scale == scale
    assert fusion.cov[LOG_SCALE, LOG_SCALE].item() == pytest.approx(known + 0.01)


def test_filterpy_holds_the_covariance_and_updates_as_the_textbook_does():
    fusion = random_fusion(0)
    assert isinstance(fusion._kalman, ExtendedKalmanFilter)
    assert fusion.cov is fusion._kalman.P
    state, P = fusion.state, fusion.cov.copy()
    predicted = state.pose(CAMERA)
    offset = np.array([0.01, -0.02, 0.015, 0.02, -0.01, 0.03])
    measured = VisionPose(predicted.R_VC @ so3.exp(offset[:3]), predicted.p_VC + offset[3:])
    R = np.diag([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2

    H = state.pose_jacobian(CAMERA)
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    dx = K @ offset
    assert fusion.update_pose(measured, R, gate=np.inf)
    np.testing.assert_allclose(fusion.cov, P - K @ S @ K.T, atol=1e-12)
    expected = state.retract(dx)
    for name in ("R_WB", "p_WB", "v_WB", "bias_gyro_B", "bias_accel_B", "log_scale", "R_WV", "p_WA"):
        np.testing.assert_allclose(getattr(fusion.state, name), getattr(expected, name), atol=1e-12)
    assert not fusion._kalman.x.any()


def test_readings_move_the_body_and_leave_the_vision_frame():
    fusion, noise = random_fusion(1), CALIBRATION.imu
    state, P = fusion.state, fusion.cov.copy()
    t_ns = np.arange(11) * 5_000_000
    imu = ImuSegment(t_ns, np.full((11, 3), 0.3), np.tile(-g_W, (11, 1)))
    ahead = propagate(imu, state.R_WB, state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B, noise)
    fusion.propagate(imu, noise)
    np.testing.assert_array_equal(fusion.state.p_WB, ahead.p_WB)
    np.testing.assert_array_equal(fusion.state.p_WA, state.p_WA)
    F = ahead.transition
    np.testing.assert_allclose(fusion.cov[:IMU, :IMU], F @ P[:IMU, :IMU] @ F.T + ahead.noise, atol=1e-14)
    np.testing.assert_allclose(fusion.cov[:IMU, IMU:], F @ P[:IMU, IMU:], atol=1e-14)
    np.testing.assert_array_equal(fusion.cov[IMU:, IMU:], P[IMU:, IMU:])


def test_a_pose_that_does_not_fit_is_left_out():
    fusion = random_fusion(2)
    state, P = fusion.state, fusion.cov.copy()
    predicted = state.pose(CAMERA)
    off = replace(predicted, p_VC=predicted.p_VC + 1.0)
    assert not fusion.update_pose(off, 1e-4 * np.eye(6), gate=16.8)
    assert fusion.state is state
    np.testing.assert_array_equal(fusion.cov, P)


def test_the_scale_begins_as_long_as_the_readings_say_the_way_was():
    fusion = random_fusion(3)
    fusion.place_vision_frame()
    start = fusion.state
    fusion.state = replace(start, p_WB=start.p_WB + start.R_WV @ [0.3, 0.0, 0.4])
    assert fusion.begin_scale(np.array([0.6, 0.0, 0.8]))
    assert fusion.state.scale == pytest.approx(2.0)
    for wrong in ([-0.6, 0.0, -0.8], [0.0, 1.0, 0.0]):
        assert not fusion.begin_scale(np.array(wrong))
        assert fusion.state.scale == pytest.approx(2.0)


def test_at_rest_the_readings_measure_and_nothing_moves():
    sequence = simulated_sequence("standstill", duration_s=1.0)
    truth = sequence.true_states[0]
    fusion = Fusion(replace(truth, v_WB=np.array([0.05, 0.0, 0.0]), cov=0.05**2 * np.eye(15)), CAMERA)
    fusion.place_vision_frame()
    for imu, _ in sequence.packets[1:]:
        assert fusion.hold_still(imu, CALIBRATION.imu)
    state = fusion.state
    assert np.linalg.norm(state.v_WB) < 0.01
    np.testing.assert_allclose(state.p_WB, truth.p_WB, atol=1e-12)
    assert np.linalg.norm(state.bias_gyro_B) < 3e-3
    # Attitude errors of the body and of the frame placed there are the same errors.
    correlation = fusion.cov[DTHETA, DTHETA_WV] - fusion.cov[DTHETA, DTHETA] @ CAMERA.R_BC
    np.testing.assert_allclose(correlation, 0.0, atol=1e-10)
    assert np.abs(fusion.cov[DP_WA, DP]).max() > 1e-3
    turning = replace(sequence.packets[5][0], gyro_B=sequence.packets[5][0].gyro_B + 1.0)
    assert not fusion.hold_still(turning, CALIBRATION.imu)
    assert fusion.state is state
