"""The filter's covariance against dense matrix formulas, and its update against filterpy."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from msckf_helpers import CALIBRATION, random_covariance, random_state
from scipy.linalg import block_diag

from vioframe.errors import DivergedError
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, DV, NS_PER_S, Float, ImuNoise, ImuSegment
from vioframe_msckf import covariance
from vioframe_msckf.state import IMU, FilterState, compress

NOISE = ImuNoise(gyro_density=2e-3, accel_density=2e-2, gyro_walk=2e-3, accel_walk=3e-2, rate_hz=200.0)


def segment(rng: np.random.Generator) -> ImuSegment:
    t_ns = NS_PER_S + 5_000_000 * np.arange(11, dtype=np.int64)
    return ImuSegment(t_ns, rng.normal(size=(11, 3)), np.array([0.0, 0.0, 9.8]) + rng.normal(size=(11, 3)))


def mean(state: FilterState) -> list[Float]:
    """Everything the error state is an error of, and is no rotation."""
    return [
        state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B,
        state.p_BC, state.offset_s, state.intrinsics, state.clones.p_WB, state.p_WF,
    ]  # fmt: skip


def test_a_clone_is_the_pose_with_all_its_correlations():
    state, gyro_B = random_state(1), np.array([0.4, -1.2, 0.7])
    P, at = state.cov.copy(), state.landmarks_begin
    state.augment_clone(gyro_B)
    stack = np.insert(np.eye(len(P)), [at] * 6, np.eye(6, len(P)), axis=0)
    np.testing.assert_array_equal(state.cov, stack @ P @ stack.T)
    assert state.landmarks_begin == at + 6
    clones = state.clones
    for R_WB, p_WB in ((clones.R_WB, clones.p_WB), (clones.R_WB_first, clones.p_WB_first)):
        np.testing.assert_array_equal(R_WB[-1], state.R_WB)
        np.testing.assert_array_equal(p_WB[-1], state.p_WB)
    np.testing.assert_array_equal(clones.rate_B[-1], gyro_B)
    np.testing.assert_allclose(state.R_WB @ clones.velocity_B[-1], state.v_WB, atol=1e-15)


def test_propagation_is_the_dense_formula():
    state, rng = random_state(3), np.random.default_rng(3)
    P, imu = state.cov.copy(), segment(rng)
    from vioframe.estimation.inertial.propagation import propagate

    step = propagate(imu, state.R_WB, state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B, NOISE)
    before = mean(state)
    state.propagate(imu, NOISE, first_estimates=False)
    Phi, Q = np.eye(len(P)), np.zeros_like(P)
    Phi[:IMU, :IMU], Q[:IMU, :IMU] = step.transition, step.noise
    np.testing.assert_allclose(state.cov, Phi @ P @ Phi.T + Q, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(state.R_WB, step.R_WB)
    np.testing.assert_array_equal(state.p_WB, step.p_WB)
    np.testing.assert_array_equal(state.v_WB, step.v_WB)
    assert all((a == b).all() for a, b in zip(before[2:], mean(state)[2:], strict=True))


def test_dropping_a_clone_and_landmarks_leaves_the_marginal():
    state = random_state(4, clones=4, landmarks=3)
    P, poses, points = state.cov.copy(), state.clones, state.p_WF
    state.drop_oldest_clone()
    begin = state.calibrated.stop
    keep = np.r_[0:begin, begin + 6 : len(P)]
    np.testing.assert_array_equal(state.cov, P[np.ix_(keep, keep)])
    np.testing.assert_array_equal(state.clones.p_WB, poses.p_WB[1:])
    np.testing.assert_array_equal(state.clones.R_WB_first, poses.R_WB_first[1:])

    P, begin = state.cov.copy(), state.landmarks_begin
    state.keep_landmarks(np.array([True, False, True]))
    keep = np.r_[0 : begin + 3, begin + 6 : len(P)]
    np.testing.assert_array_equal(state.cov, P[np.ix_(keep, keep)])
    np.testing.assert_array_equal(state.landmark_ids, [10, 12])
    np.testing.assert_array_equal(state.p_WF, points[[0, 2]])


def test_landmarks_come_last_with_their_correlations():
    state, rng = random_state(5), np.random.default_rng(5)
    P, n, columns = state.cov.copy(), len(state.cov), slice(IMU, state.landmarks_begin)
    gain, own = rng.normal(size=(2, 3, columns.stop - IMU)), np.stack([random_covariance(rng, 3) for _ in range(2)])
    p_WF = rng.normal(size=(2, 3))
    state.add_landmarks(np.array([98, 99]), p_WF, p_WF + 0.1, gain, columns, own)
    G = np.zeros((6, n))
    G[:, columns] = gain.reshape(6, -1)
    np.testing.assert_array_equal(state.cov[:n, :n], P)
    np.testing.assert_allclose(state.cov[n:, :n], G @ P, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(state.cov[n:, n:], G @ P @ G.T + block_diag(*own), rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(state.cov, state.cov.T)
    assert state.landmark_ids[-2:].tolist() == [98, 99]
    np.testing.assert_array_equal(state.p_WF[-2:], p_WF)
    np.testing.assert_array_equal(state.p_WF_first[-2:], p_WF + 0.1)


@pytest.mark.parametrize("part", ["all", "window", "imu"])
@pytest.mark.parametrize("noise", ["common", "by_row"])
def test_update_agrees_with_filterpy(part, noise):
    state, rng = random_state(6, scale=0.02), np.random.default_rng(6)
    n = len(state.cov)
    columns = {"all": slice(0, n), "window": slice(IMU, state.landmarks_begin), "imu": slice(0, IMU)}[part]
    H, residual = rng.normal(size=(20, columns.stop - columns.start)), 0.05 * rng.normal(size=20)
    R = 0.04 if noise == "common" else rng.uniform(0.01, 0.1, 20)

    oracle = KalmanFilter(dim_x=n, dim_z=20)
    oracle.P = state.cov.copy()
    dense = np.zeros((20, n))
    dense[:, columns] = H
    oracle.update(residual[:, None], R=np.diag(np.broadcast_to(R, 20)), H=dense)
    x = oracle.x.ravel()

    R_WB, R_BC, clones, before = state.R_WB, state.R_BC, state.clones, mean(state)
    state.update(H, residual, columns, R)
    np.testing.assert_allclose(state.cov, oracle.P, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(so3.log(R_WB.T @ state.R_WB), x[DTHETA], atol=1e-12)
    cameras = x[state.calibrated].reshape(-1, 15)
    np.testing.assert_allclose(so3.log(R_BC.transpose(0, 2, 1) @ state.R_BC), cameras[:, :3], atol=1e-12)
    poses = x[state.calibrated.stop : state.landmarks_begin].reshape(-1, 6)
    np.testing.assert_allclose(so3.log(clones.R_WB.transpose(0, 2, 1) @ state.clones.R_WB), poses[:, :3], atol=1e-12)
    of_cameras = cameras[:, 3:6], cameras[:, 6], cameras[:, 7:]
    additive = [x[DP], x[DV], x[DBG], x[DBA], *of_cameras, poses[:, 3:], x[state.landmarks_begin :]]
    for new, old, dx in zip(mean(state), before, additive, strict=True):
        np.testing.assert_allclose(new - old, dx.reshape(old.shape), atol=1e-12)
    np.testing.assert_array_equal(state.clones.R_WB_first, clones.R_WB_first)
    np.testing.assert_array_equal(state.clones.p_WB_first, clones.p_WB_first)


def test_compression_gives_the_same_update():
    rng = np.random.default_rng(7)
    columns = slice(IMU, random_state(7).landmarks_begin)
    H, residual = rng.normal(size=(300, columns.stop - columns.start)), 0.05 * rng.normal(size=300)
    small_H, small_residual = compress(H.copy(), residual.copy())
    assert small_H.shape == (H.shape[1], H.shape[1])
    full, small = random_state(7, scale=0.02), random_state(7, scale=0.02)
    full.update(H, residual, columns, 0.04)
    small.update(small_H, small_residual, columns, 0.04)
    np.testing.assert_allclose(small.cov, full.cov, rtol=1e-8, atol=1e-13)
    np.testing.assert_allclose(small.R_WB, full.R_WB, atol=1e-12)
    for a, b in zip(mean(small), mean(full), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_what_is_not_longer_than_wide_is_not_compressed():
    H, residual = np.ones((4, 5)), np.ones(4)
    same_H, same_residual = compress(H, residual)
    assert same_H is H
    assert same_residual is residual


def test_calibration_that_is_not_estimated_never_moves():
    state, rng = random_state(8, calibrate=False), np.random.default_rng(8)
    before = state.R_BC, state.p_BC, state.offset_s, state.intrinsics
    columns = slice(IMU, state.landmarks_begin)
    state.update(rng.normal(size=(30, columns.stop - columns.start)), rng.normal(size=30), columns, 1.0)
    np.testing.assert_allclose(state.R_BC, before[0], atol=1e-16)
    np.testing.assert_array_equal(state.p_BC, before[1])
    np.testing.assert_array_equal(state.offset_s, before[2])
    np.testing.assert_array_equal(state.intrinsics, before[3])
    assert (state.cov[state.calibrated] == 0.0).all()


def test_biases_walk_at_standstill():
    state = random_state(9)
    P = state.cov.copy()
    state.drift_biases(0.05, NOISE)
    walk = np.zeros(len(P))
    walk[DBG], walk[DBA] = 0.05 * NOISE.gyro_walk**2, 0.05 * NOISE.accel_walk**2
    np.testing.assert_allclose(state.cov, P + np.diag(walk), rtol=1e-15)


def test_landmarks_slide_in_proportion_to_their_distance():
    state = random_state(9)
    P, at = state.cov.copy(), state.landmarks_begin
    state.slide_landmarks(0.5)
    focal_px = float(CALIBRATION.cameras[0].model.fx)
    far_m = np.repeat(np.linalg.norm(state.p_WF - state.p_WB, axis=1), 3)
    np.testing.assert_allclose((state.cov - P)[:at], 0.0)
    np.testing.assert_allclose((state.cov - P)[at:, at:], np.diag((0.5 * far_m / focal_px) ** 2), atol=1e-12)


def test_covariance_stays_symmetric_and_positive_through_everything():
    """Two hundred rounds of all that may happen to it, with measurements of very different strength."""
    state, rng = random_state(10, scale=0.02), np.random.default_rng(10)
    for k in range(200):
        state.propagate(segment(rng), NOISE, first_estimates=True)
        state.augment_clone(rng.normal(size=3))
        n = len(state.cov)
        whole = slice(0, n)
        if k % 3 == 0:
            gain = rng.normal(size=(1, 3, n)) / np.sqrt(n)
            state.add_landmarks(np.array([100 + k]), *np.ones((2, 1, 3)), gain, whole, 1e-4 * np.eye(3)[None])
        H = rng.normal(size=(5 + k % 60, n))
        S = H @ state.cov[whole, whole] @ H.T
        variance = 10.0 ** rng.uniform(-8, 2)
        residual = np.linalg.cholesky(S + variance * np.eye(len(S))) @ rng.normal(size=len(S))
        state.update(H, residual, whole, variance)
        if len(state.landmark_ids) > 5:
            state.keep_landmarks(rng.random(len(state.landmark_ids)) < 0.7)
        if len(state.clones) > 8:
            state.drop_oldest_clone()
        assert (state.cov == state.cov.T).all()
        eigenvalues = np.linalg.eigvalsh(state.cov)
        assert eigenvalues[0] > -1e-12 * eigenvalues[-1]
        for R in (state.R_WB, *state.R_BC, *state.clones.R_WB):
            assert np.abs(R.T @ R - np.eye(3)).max() < 1e-12


@pytest.mark.parametrize("what", ["residual", "covariance"])
def test_what_is_not_finite_is_refused(what):
    state = random_state(11)
    H, residual = np.ones((2, IMU)), np.zeros(2)
    if what == "residual":
        residual[0] = np.nan
    else:
        state.cov[0, 0] = np.nan
    with pytest.raises(DivergedError):
        state.update(H, residual, slice(0, IMU), 1.0)


def test_a_covariance_that_is_not_positive_is_refused():
    state = random_state(12)
    state.cov[:IMU, :IMU] = -np.eye(IMU)
    with pytest.raises(DivergedError, match="positive definite"):
        state.update(np.eye(IMU), np.zeros(IMU), slice(0, IMU), 0.1)


def test_a_copy_of_the_body_is_its_own():
    state = random_state(13)
    nav = state.nav_state(7)
    assert nav.cov is not None
    nav.cov[:] = 0.0
    nav.p_WB[:] = 0.0
    assert np.linalg.norm(state.cov[:IMU, :IMU]) > 0.0
    assert np.linalg.norm(state.p_WB) > 0.0


class TestCovariance:
    """The algebra by structure against the same written out."""

    def test_inserting_and_leaving_out_are_inverse(self):
        rng = np.random.default_rng(0)
        P, cross, block = random_covariance(rng, 40), rng.normal(size=(6, 40)), random_covariance(rng, 6)
        for at in (0, 21, 40):
            out = covariance.inserted(P, at, cross, block)
            new, old = np.arange(at, at + 6), np.delete(np.arange(46), np.s_[at : at + 6])
            np.testing.assert_array_equal(out[np.ix_(old, old)], P)
            np.testing.assert_array_equal(out[np.ix_(new, old)], cross)
            np.testing.assert_array_equal(out, out.T)
            np.testing.assert_allclose(out[np.ix_(new, new)], block)
            np.testing.assert_array_equal(covariance.only(out, old), P)

    @pytest.mark.parametrize("of_camera", [15, 16])
    def test_landmarks_innovation_is_that_of_their_dense_rows(self, of_camera: int):
        rng = np.random.default_rng(1)
        clones = 15 + 2 * of_camera
        n, clone = clones + 18 + 15, clones + 6
        # Seen once or by both cameras.
        cameras, landmarks = 15 + of_camera * np.array([0, 1, 1, 0, 1]), clones + 18 + 3 * np.array([0, 0, 2, 4, 4])
        P, blocks = random_covariance(rng, n), rng.normal(size=(5, 2, 25))
        H = np.zeros((10, n))
        for i, block in enumerate(blocks):
            rows = slice(2 * i, 2 * i + 2)
            H[rows, cameras[i] : cameras[i] + of_camera] = block[:, :of_camera]
            H[rows, clone : clone + 6] = block[:, 16:22]
            H[rows, landmarks[i] : landmarks[i] + 3] = block[:, 22:]
        HP, S = covariance.landmark_innovation(P, blocks, cameras, of_camera, clone, landmarks, 0.3)
        np.testing.assert_allclose(HP, H @ P, atol=1e-12)
        np.testing.assert_allclose(S, H @ P @ H.T + 0.3 * np.eye(10), atol=1e-11)
        residual = rng.normal(size=10)
        expected = [
            residual[k : k + 2] @ np.linalg.solve(S[k : k + 2, k : k + 2], residual[k : k + 2]) for k in range(0, 10, 2)
        ]
        np.testing.assert_allclose(covariance.distances(S, residual), expected)
