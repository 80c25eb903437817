"""The filter's analytic Jacobians against numeric ones on the manifold."""

import copy

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, STEREO, add_independent, random_covariance, seeing_state, sighting_rows
from scipy.linalg import null_space
from scipy.stats import chi2

from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, intrinsics_of
from vioframe.types import FrameTracks
from vioframe_msckf.measurement import (
    ACCEPTED,
    GATED,
    NOT_TRIANGULATED,
    Window,
    distance_and_variances,
    landmark_blocks,
    msckf_rows,
    observations,
    reduce_landmark,
    track_rows,
)
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.state import IMU, OFFSET, READOUT
from vioframe_msckf.updates import PointNoise, Selection, update_from_landmarks, update_from_tracks

NOISE = PointNoise(0.2)
CAMERAS = {
    "radtan": Camera(458.654, 457.296, 367.215, 248.375, (-0.283, 0.0740, 0.00019, 1.76e-05), (752, 480), "radtan"),
    "equidistant": Camera(380.0, 379.0, 367.0, 248.0, (0.01, -0.02, 0.005, -0.001), (752, 480), "equidistant"),
}


@pytest.mark.parametrize("readout_s", [0.0, 0.03, -0.02], ids=["global", "rolling", "upwards"])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_observation_jacobian_is_the_derivative_on_the_manifold(camera, readout_s):
    rng = np.random.default_rng(3)
    model, k = intrinsics_of(camera)
    R_BC, p_BC = so3.exp(rng.normal(size=3)), 0.1 * rng.normal(size=3)
    R_WB, p_WB = so3.exp(rng.normal(size=3)), rng.normal(size=3)
    p_WF = p_WB + R_WB @ (R_BC @ np.array([0.7, -0.4, 3.0]) + p_BC)
    rate_B, velocity_B, y = np.array([0.7, -1.1, 1.6]), np.array([1.2, 0.4, -0.9]), 40.0
    row, offset_s = (y + 0.5) / 480 - 0.5, 0.004

    def predicted(d):
        """Pixel after perturbing [theta_BC p_BC offset k(8) readout | theta_WB p_WB | p_WF] by d (25,)."""
        R_C, p_C = R_BC @ so3.exp(d[0:3]), p_BC + d[3:6]
        R_B, p_B = R_WB @ so3.exp(d[16:19]), p_WB + d[19:22]
        late_s = offset_s + d[6] + (readout_s + d[15]) * row
        R_row, p_row = R_B @ so3.exp(rate_B * late_s), p_B + R_B @ velocity_B * late_s
        point = R_C.T @ (R_row.T @ (p_WF + d[22:25] - p_row) - p_C)
        perturbed = k + d[7:15]
        return Camera(*perturbed[:4], tuple(perturbed[4:]), camera.resolution, camera.distortion_model).project(
            point[None]
        )[0]

    exact = predicted(np.zeros(25))
    xy = np.array([exact[0] + 0.3, y])
    motion = rate_B[None], velocity_B[None]
    # The second camera of two; the first is another one.
    cameras = np.stack([np.eye(3), R_BC]), np.stack([np.zeros(3), p_BC]), np.array([1 - model, model])
    late = np.array([0.1, offset_s]), np.array([0.1, readout_s])
    window = Window(
        R_WB[None], p_WB[None], R_WB[None], p_WB[None], *motion, *cameras, np.stack([0.5 * k, k]), *late,
        np.array([240, 480]), of_camera=16,
    )  # fmt: skip
    blocks, residual = observations(window, 0, np.array([1]), p_WF[None], p_WF[None], xy[None])
    eps = 1e-6
    numeric = np.stack([(predicted(eps * e) - predicted(-eps * e)) / (2 * eps) for e in np.eye(25)], axis=1)
    np.testing.assert_allclose(residual[0], [0.3, y - exact[1]], atol=1e-9)
    np.testing.assert_allclose(blocks[0], numeric, rtol=1e-6, atol=1e-5)


def rows_of(table, row, window, pixel_sigma):
    """``track_rows`` of one row of the observation table."""
    return track_rows(window, table.xy[row], table.xy_normalised[row], table.seen[row], pixel_sigma)


def promote(state, table, rows, options, point_noise, gate):
    """The rows used up of those offered as landmarks."""
    selection = Selection(np.empty(0, np.intp), rows)
    return update_from_tracks(state, table, selection, options, point_noise, gate)[0]


@pytest.mark.parametrize("calibration", [CALIBRATION, STEREO], ids=["mono", "stereo"])
@pytest.mark.parametrize("readout_s", [0.0, 0.03], ids=["global", "rolling"])
def test_rows_of_landmarks_predict_how_residuals_change_with_the_state(readout_s, calibration):
    """Column by column, through the filter's own correction."""
    state, table = seeing_state(readout_s=readout_s, calibration=calibration)
    state.offset_s += 0.003
    cameras_count = len(calibration.cameras)
    full = np.flatnonzero(table.seen.all(axis=1))[:4]
    for row in full:
        ok, p_WF, *_ = rows_of(table, row, Window.of(state, False), 1.0)
        assert ok
        add_independent(state, row, p_WF, np.eye(3))
    landmarks, cameras = (index.ravel() for index in np.indices((len(full), cameras_count)))
    clone = 3
    xy = table.xy[full[landmarks], cameras_count * clone + cameras]

    def residual(dx):
        moved = copy.deepcopy(state)
        moved._correct(dx)
        return landmark_blocks(moved, clone, landmarks, cameras, xy, False)[1]

    blocks, _ = landmark_blocks(state, clone, landmarks, cameras, xy, False)
    H = sighting_rows(state, clone, landmarks, cameras, blocks)
    eps, n = 1e-6, len(state.cov)
    numeric = np.stack([(residual(-eps * e) - residual(eps * e)) / (2 * eps) for e in np.eye(n)], axis=1)
    np.testing.assert_allclose(H, numeric, rtol=1e-6, atol=2e-4)
    own = H[np.arange(len(H))[:, None], IMU + state.of_camera * np.repeat(cameras, 2)[:, None] + np.arange(16)]
    assert np.abs(own[:, OFFSET]).max() > 50.0
    assert readout_s == 0.0 or np.abs(own[:, READOUT]).max() > 10.0


def test_exact_poses_explain_exact_rows():
    """Pixels of a rolling shutter, each from the pose at the time of its row; what is left is of second order."""
    state, table = seeing_state(readout_s=0.03, exact=True)
    full = np.flatnonzero(table.seen.all(axis=1))

    def largest(window):
        rows = [rows_of(table, row, window, 1.0) for row in full]
        assert all(ok for ok, *_ in rows)
        return max(np.abs(residual).max() for *_, residual in rows)

    window = Window.of(state, False)
    assert len(full) > 20
    assert largest(window) < 0.02
    assert largest(window._replace(readout_s=np.array([0.0]))) > 0.5
    assert largest(window._replace(readout_s=np.array([-0.03]))) > 1.0


def test_first_estimates_hold_the_jacobian_and_not_the_residual():
    state, table = seeing_state()
    row = np.flatnonzero(table.seen.all(axis=1))[0]
    _, p_WF, *_ = rows_of(table, row, Window.of(state, True), 1.0)
    add_independent(state, row, p_WF, np.eye(3))
    moved, dx = copy.deepcopy(state), 0.01 * np.random.default_rng(0).normal(size=len(state.cov))
    dx[state.calibrated] = 0.0
    moved._correct(dx)

    def rows(of, first_estimates):
        only = np.zeros(1, np.int64)
        blocks, residual = landmark_blocks(of, 2, only, only, table.xy[[row], 2], first_estimates)
        return sighting_rows(of, 2, only, only, blocks), residual

    H, residual = rows(state, True)
    np.testing.assert_array_equal(rows(moved, True)[0], H)
    assert np.abs(rows(moved, False)[0] - H).max() > 0.1
    np.testing.assert_array_equal(rows(moved, True)[1], rows(moved, False)[1])
    np.testing.assert_allclose(rows(moved, True)[1], residual - H @ dx, atol=0.5)
    assert np.abs(residual - rows(moved, True)[1]).max() > 1.0


@pytest.mark.parametrize("views", [2, 5, 11])
def test_reduction_is_orthogonal_and_frees_the_rows_below_the_third(views):
    rng = np.random.default_rng(views)
    H, H_f, residual = rng.normal(size=(2 * views, 20)), rng.normal(size=(2 * views, 3)), rng.normal(size=2 * views)
    before = np.column_stack([H, H_f, residual])
    reduce_landmark(H, H_f, residual)
    after = np.column_stack([H, H_f, residual])
    # An orthogonal transformation of the rows is one that leaves all inner products of columns as they are.
    np.testing.assert_allclose(after.T @ after, before.T @ before, atol=1e-12)
    assert np.abs(H_f[3:]).max() < 1e-14
    assert np.abs(np.tril(H_f[:3], -1)).max() < 1e-14
    assert np.abs(np.diag(H_f)).min() > 0.1


def test_distance_of_a_track_is_that_of_what_is_free_of_the_landmark():
    rng = np.random.default_rng(1)
    S, H_f, residual = random_covariance(rng, 10), rng.normal(size=(10, 3)), rng.normal(size=10)
    free = null_space(H_f.T)
    expected = residual @ free @ np.linalg.inv(free.T @ (S + 0.3 * np.eye(10)) @ free) @ free.T @ residual
    assert distance_and_variances(S, H_f, residual, 0.3, 1.0)[0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("views", [6, 7, 11])
def test_the_variance_ratio_is_one_for_errors_as_expected_and_more_for_those_that_last(views):
    """Against Bartlett's weights as a matrix, and in the mean over errors of both kinds."""
    rng = np.random.default_rng(views)
    S, H_f = random_covariance(rng, 2 * views), rng.normal(size=(2 * views, 3))
    N = np.eye(2 * views) - H_f @ np.linalg.pinv(H_f)
    apart = np.abs(np.subtract.outer(np.arange(views), np.arange(views)))
    W = np.kron(np.maximum(1.0 - apart / (views // 2), 0.0), np.eye(2))

    def ratio(S, residual):
        return distance_and_variances(S, H_f, residual, 0.3, 1.0)[2]

    residual = rng.normal(size=2 * views)
    left, expected = N @ residual, N @ (S + 0.3 * np.eye(2 * views)) @ N
    sums, single = left @ W @ left / np.trace(W @ expected), left @ left / np.trace(expected)
    assert ratio(S, residual) == pytest.approx(sums / single, rel=1e-9)
    white, lasting = rng.normal(size=(4000, 2 * views)), np.linalg.cholesky(np.kron(0.7**apart, np.eye(2)))
    nothing = np.zeros_like(S)
    assert np.mean([ratio(nothing, e) for e in white]) == pytest.approx(1.0, abs=0.04)
    assert np.mean([ratio(nothing, lasting @ e) for e in white]) > 1.4
    assert ratio(S, nothing[0]) == 1.0


def test_no_track_is_believed_where_the_covariance_is_none():
    """What is not positive definite says nothing of how far off a track may be."""
    state, table = seeing_state()
    P = np.ascontiguousarray(state.cov[IMU:, IMU:])
    window, gate = Window.of(state, True), np.full(100, 1e9)
    for cov, verdict in ((P, ACCEPTED), (-1e6 * P, GATED)):
        seen = table.xy, table.xy_normalised, table.seen
        assert set(msckf_rows(window, *seen, cov, 0.2, 3.0, gate).verdict) == {verdict, NOT_TRIANGULATED}


def test_sightings_that_do_not_fit_get_cauchys_variance():
    rng = np.random.default_rng(2)
    S, H_f, residual = random_covariance(rng, 10), rng.normal(size=(10, 3)), rng.normal(size=10)
    residual[4:6] += 20.0
    free = null_space(H_f.T)
    left, expected = free @ free.T @ residual, free @ free.T @ (S + 0.3 * np.eye(10)) @ free @ free.T
    squared = (left.reshape(5, 2) ** 2).sum(axis=1) / np.diag(expected).reshape(5, 2).mean(axis=1)
    for cauchy in (0.5, 2.0):
        _, variances, _ = distance_and_variances(S, H_f, residual, 0.3, cauchy)
        np.testing.assert_allclose(variances, 0.3 * (1.0 + squared / cauchy**2), rtol=1e-9)
    assert variances.argmax() == 2
    # Moving the landmark is no misfit.
    moved = residual + H_f @ np.array([50.0, -20.0, 30.0])
    np.testing.assert_allclose(distance_and_variances(S, H_f, moved, 0.3, 2.0)[1], variances, rtol=1e-6)


@pytest.mark.parametrize("cauchy", [0.5, 1e6])
def test_tracks_and_new_landmarks_are_one_update_with_nothing_known_of_any_landmark(cauchy):
    """Two tracks become landmarks and two do not, between them in the table."""
    state, table = seeing_state()
    options, noise = MsckfOptions(cauchy_sigmas=cauchy), PointNoise(0.14)
    full = np.flatnonzero(table.seen.all(axis=1))[:4]
    promoted, finished = full[[0, 2]], full[[1, 3]]
    # In information form the landmarks' prior is exactly nothing; those that stay in the state come first.
    n = len(state.cov)
    information, gradient, p_WF = np.zeros((n + 12, n + 12)), np.zeros(n + 12), []
    information[:n, :n] = np.linalg.inv(state.cov)
    for k, row in enumerate([*promoted, *finished]):
        _, p, H, H_f, residual = rows_of(table, row, Window.of(state, True), noise.px)
        joint = np.zeros((len(residual), n + 12))
        joint[:, IMU:n], joint[:, n + 3 * k : n + 3 * k + 3] = H, H_f
        S = H @ state.cov[IMU:, IMU:] @ H.T
        variances = np.repeat(distance_and_variances(S, H_f, residual, noise.px**2, cauchy)[1], 2)
        information += joint.T @ (joint / variances[:, None])
        gradient += joint.T @ (residual / variances)
        p_WF.append(p)
    cov = np.linalg.inv(information)
    dx, cov = cov @ gradient, cov[: n + 6, : n + 6]

    before = copy.deepcopy(state)
    gate = np.r_[0.0, chi2.ppf(0.999999, np.arange(1, 40))]
    gone, ids, positions = update_from_tracks(state, table, Selection(finished, promoted), options, noise, gate)
    assert sorted(gone) == full.tolist()
    assert ids.tolist() == table.ids[finished].tolist()
    assert state.landmark_ids.tolist() == table.ids[promoted].tolist()
    np.testing.assert_allclose(positions, p_WF[2:], atol=0.0)
    np.testing.assert_allclose(state.cov, cov, rtol=1e-6, atol=1e-9 * np.abs(cov).max())
    np.testing.assert_allclose(state.p_WF, p_WF[:2] + dx[n : n + 6].reshape(2, 3), atol=1e-9)
    np.testing.assert_allclose(state.p_WF_first, p_WF[:2], atol=0.0)
    np.testing.assert_allclose(state.p_WB, before.p_WB + dx[3:6], atol=1e-9)
    np.testing.assert_allclose(so3.log(before.R_WB.T @ state.R_WB), dx[:3], atol=1e-9)
    np.testing.assert_allclose(state.clones.p_WB, before.clones.p_WB + dx[30:n].reshape(-1, 6)[:, 3:], atol=1e-9)


@pytest.mark.parametrize("cauchy", [0.5, 1e6])
def test_a_landmark_that_does_not_fit_is_discounted_and_gated_as_it_is(cauchy):
    """Of four landmarks one is off by two standard deviations, and one by four, more than the gate lets pass."""
    state, table = seeing_state()
    full = np.flatnonzero(table.seen.all(axis=1))[:4]
    for row in full:
        _, p_WF, *_ = rows_of(table, row, Window.of(state, True), 1.0)
        add_independent(state, int(table.ids[row]), p_WF, 0.01**2 * np.eye(3))
    options, noise = MsckfOptions(cauchy_sigmas=cauchy, landmark_drift=0.0), PointNoise(2.0)
    index, first, newest = np.arange(4), np.zeros(4, np.int64), len(state.clones) - 1
    xy = table.xy[full, -1].copy()

    def measured():
        blocks, residual = landmark_blocks(state, newest, index, first, xy, True)
        H = sighting_rows(state, newest, index, first, blocks)
        S = H @ state.cov @ H.T + noise.px**2 * np.eye(8)
        blocks_of_S, pairs = S.reshape(4, 2, 4, 2)[index, :, index], residual.reshape(4, 2)
        return H, residual, np.einsum("ia,iab,ib->i", pairs, np.linalg.inv(blocks_of_S), pairs)

    H, residual, _ = measured()
    xy -= residual.reshape(4, 2)
    spread = np.sqrt(np.einsum("ij,jk,ik->i", H, state.cov, H) + noise.px**2)
    xy[1, 0], xy[3, 1] = xy[1, 0] + 2.0 * spread[2], xy[3, 1] + 4.0 * spread[7]
    H, residual, squares = measured()
    fits = np.repeat([True, True, True, False], 2)
    H, residual, R = H[fits], residual[fits], np.repeat(noise.px**2 * (1.0 + squares / cauchy**2), 2)[fits]
    gain = state.cov @ H.T @ np.linalg.inv(H @ state.cov @ H.T + np.diag(R))
    cov, p_WB = state.cov - gain @ H @ state.cov, state.p_WB + (gain @ residual)[3:6]

    seen = FrameTracks(0, table.ids[full], first, xy, xy)
    gate = np.r_[0.0, chi2.ppf(0.95, np.arange(1, 40))]
    assert update_from_landmarks(state, seen, seen.ids, options, noise, gate) == 3
    assert state.landmark_ids.tolist() == table.ids[full[:3]].tolist()
    np.testing.assert_allclose(state.cov, cov[: len(state.cov), : len(state.cov)], atol=1e-9 * np.abs(cov).max())
    np.testing.assert_allclose(state.p_WB, p_WB, atol=1e-9)


def test_delayed_initialisation_is_gated_by_two_rows_a_view_but_for_the_three_of_the_landmark():
    _, table = seeing_state()
    views = table.seen.sum(axis=1)
    for count in (4, 6):
        for at_dof, elsewhere in ((np.inf, 0.0), (0.0, np.inf)):
            state, _ = seeing_state()
            gate = np.full(40, elsewhere)
            gate[2 * count - 3] = at_dof
            rows = np.flatnonzero(views == count)[:1]
            assert promote(state, table, rows, MsckfOptions(), NOISE, gate).tolist() == rows.tolist()
            assert len(state.landmark_ids) == (at_dof > 0.0)


def test_an_implausible_track_is_used_up_and_changes_nothing():
    state, table = seeing_state()
    row = np.flatnonzero(table.seen.all(axis=1))[0]
    table.xy[row, 2] += 60.0
    cov = state.cov.copy()
    gate = np.r_[0.0, chi2.ppf(0.95, np.arange(1, 40))]
    assert promote(state, table, np.array([row]), MsckfOptions(), NOISE, gate).tolist() == [row]
    assert not len(state.landmark_ids)
    np.testing.assert_array_equal(state.cov, cov)


def test_a_track_waits_until_its_distance_is_known():
    """With points as noisy as that nobody can tell how far it is: neither taken in nor used up."""
    state, table = seeing_state()
    rows = np.flatnonzero(table.seen.all(axis=1))[:1]
    cov, gate = state.cov.copy(), np.full(40, np.inf)
    assert not len(promote(state, table, rows, MsckfOptions(), PointNoise(28.0), gate))
    assert not len(state.landmark_ids)
    np.testing.assert_array_equal(state.cov, cov)
    assert promote(state, table, rows, MsckfOptions(), PointNoise(0.14), gate).tolist() == rows.tolist()
