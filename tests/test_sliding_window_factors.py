"""Every factor of the sliding window: analytic Jacobians against numeric ones on the manifold, gradients, weights.

The reference projects through the world, point by point, which the kernels never do.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sliding_window_helpers import (
    CAMERA,
    flown_window,
    moved,
    natural,
    numeric,
    retracted,
    row_poses,
    standing,
    without_sightings,
)

from vioframe.estimation.factors import reprojection
from vioframe.estimation.factors.inertial import ImuFactors
from vioframe.estimation.factors.landmarks import camera_poses, positions
from vioframe.estimation.factors.problem import INFINITELY_FAR, Prior, Problem, Variables, pose_columns, symmetric
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, OFFSET, READOUT, Poses, Sightings
from vioframe.estimation.factors.solver import covariance
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, intrinsics_of
from vioframe.types import Float, Int

CAMERAS = {
    "radtan": CAMERA,
    "equidistant": Camera(380.0, 379.0, 367.0, 248.0, (0.01, -0.02, 0.005, -0.001), (752, 480), "equidistant"),
}


def across(xy: Float) -> Float:
    """(N, 2, 3): two orthonormal directions across the rays through ``xy`` (N, 2), the first level."""
    first = np.column_stack([np.ones(len(xy)), np.zeros(len(xy)), -xy[:, 0]])
    second = np.cross(np.column_stack([xy, np.ones(len(xy))]), first)
    T = np.stack([first, second], axis=1)
    return T / np.linalg.norm(T, axis=2, keepdims=True)


def residuals(x: Variables, s: Sightings) -> Float:
    """(N, 2) px, of all sightings in turn, neither whitened nor weighted."""
    row, view = np.nonzero(s.seen)
    of = view % len(x.cameras.p_BC)
    p_WF = positions(x.states, x.cameras, s.seen.argmax(axis=1), x.landmarks)
    R_WC, p_WC = row_poses(x.states, x.cameras, s.shutter, row, view)
    p_C = np.einsum("...ji,...j", R_WC, p_WF[row] - p_WC)
    xy = s.xy[row, view] - x.cameras.offset_s[of, None] * s.velocity[row, view]
    if s.on_sphere:
        r = (across(xy) @ (p_C / np.linalg.norm(p_C, axis=1, keepdims=True))[..., None])[..., 0]
    else:
        r = p_C[:, :2] / p_C[:, 2:] - xy
    lens = s.lens.px[row, view] @ (x.cameras.intrinsics[of] - s.lens.at[view])[..., None]
    return (s.to_px[row, view] @ r[..., None] + lens)[..., 0]


def sizes(x: Variables) -> Float:
    return np.concatenate([natural(x), np.tile([0.01, 0.01, 0.01], len(x.landmarks))])


def expected_normal(x: Variables, at: Variables, s: Sightings) -> tuple[Float, Float]:
    """Gauss-Newton matrix and gradient over states, calibration and landmarks; Jacobians numeric, taken ``at``."""
    J = numeric(lambda d: residuals(retracted(at, d), s), sizes(x))
    r = residuals(x, s)
    weight = s.share[s.seen] / (1.0 + (r * r).sum(axis=1) / (s.sigma * s.cauchy) ** 2)
    J_w = J * (weight[:, None, None] / s.sigma**2)
    return np.einsum("nai,naj->ij", J_w, J), np.einsum("nai,na->i", J_w, r)


def assembled(x: Variables, first: Variables, s: Sightings) -> tuple[Float, Float]:
    """The same as the kernels have it."""
    n = len(natural(x))
    poses, first_poses = (Poses.of(v.states.R_WB, v.states.p_WB) for v in (x, first))
    H_p, b_p, V, W, c, *_ = s.linearise(poses, first_poses, x.cameras, x.landmarks)
    total = n + 3 * len(x.landmarks)
    H, b, columns = np.zeros((total, total)), np.zeros(total), columns_of(x)
    H[np.ix_(columns, columns)], b[columns] = symmetric(H_p), b_p
    for i in range(len(V)):
        own = np.arange(n + 3 * i, n + 3 * i + 3)
        H[np.ix_(own, own)], b[own] = V[i], c[i]
        H[np.ix_(own, columns)], H[np.ix_(columns, own)] = W[i], W[i].T
    return H, b


def columns_of(x: Variables) -> Int:
    return pose_columns(len(x.states), len(x.cameras.p_BC))


def offsets_of(x: Variables) -> Int:
    """Where the time offsets are: by them Jacobians on the sphere hold to first order in the noise alone."""
    return np.arange(15 * len(x.states) + OFFSET, len(natural(x)), CALIBRATION_SIZE)


def assert_normal(actual: tuple[Float, Float], expected: tuple[Float, Float], scale: Float, rtol: float) -> None:
    """Equal to ``rtol`` of the largest entry, in natural units."""
    for a, e in zip(actual, expected, strict=True):
        unit = np.outer(scale, scale) if a.ndim == 2 else scale
        np.testing.assert_allclose(a * unit, e * unit, rtol=0.0, atol=rtol * np.abs(e * unit).max())


RIGS = pytest.mark.parametrize("cameras", [1, 2], ids=["mono", "stereo"])
SHUTTERS = pytest.mark.parametrize("readout_s", [0.0, 0.03], ids=["global", "rolling"])


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("on_sphere", [False, True], ids=["plane", "sphere"])
@RIGS
@SHUTTERS
def test_sightings_on_the_manifold(camera, on_sphere, cameras, readout_s):
    """Without noise, so that the tangents of the sphere, which turn with the time offset, have no part in it."""
    problem, x = flown_window(on_sphere=on_sphere, noise_px=0.0, camera=camera, cameras=cameras, readout_s=readout_s)
    H, b = assembled(x, x, problem.sightings)
    expected, _ = expected_normal(x, x, problem.sightings)
    scale = sizes(x)
    assert_normal((H,), (expected,), scale, 1e-9)
    # No block is zero: poses of the host and the frame, the calibration, landmarks; all but the readout of no shutter.
    seen = np.diag(H) > 0.0
    seen[15 * len(x.states) + READOUT : len(natural(x)) : CALIBRATION_SIZE] |= not readout_s
    assert seen[columns_of(x)].all()
    assert seen[15 * len(x.states) :].all()
    # The sphere's residual is exact, so there is nothing to pull at.
    assert np.abs(b * scale).max() < 1e-6


@pytest.mark.parametrize("on_sphere", [False, True], ids=["plane", "sphere"])
@RIGS
@SHUTTERS
def test_first_estimates_hold_the_jacobian_and_not_the_residual(on_sphere, cameras, readout_s):
    problem, first = flown_window(on_sphere=on_sphere, cameras=cameras, readout_s=readout_s)
    x = moved(first, np.random.default_rng(1), 0.3)
    # Of what is linearised anew the first estimate is the present one.
    at = replace(x, states=first.states)
    s, scale = problem.sightings, sizes(x)
    expected, actual = expected_normal(x, at, s), assembled(x, at, s)
    if on_sphere:
        offset = offsets_of(x)
        expected, actual = ((np.delete(H, offset, 0), np.delete(b, offset)) for H, b in (expected, actual))
        expected, actual = ((np.delete(H, offset, 1), b) for H, b in (expected, actual))
        scale = np.delete(scale, offset)
    assert_normal(actual, expected, scale, 1e-9)
    plain = assembled(x, x, s)[0]
    assert np.abs(plain - assembled(x, at, s)[0]).max() > 1e-3 * np.abs(plain).max()


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("on_sphere", [False, True], ids=["plane", "sphere"])
def test_another_lens_moves_points_as_undistorting_them_anew(camera, on_sphere):
    """To first order: a tenth of the change leaves a hundredth of the difference."""
    problem, x = flown_window(on_sphere=on_sphere, noise_px=0.0, camera=camera, offset_s=0.0)
    s = problem.sightings
    change = np.array([4.0, -3.0, 2.0, 1.0, 0.01, -0.01, 0.001, 0.002])
    left = []
    for part in (1.0, 0.1):
        other = camera.with_intrinsics(x.cameras.intrinsics[0] + part * change)
        xy = np.zeros_like(s.xy)
        xy[s.seen] = other.undistort(camera.distort(s.xy[s.seen]))
        anew = s._replace(xy=xy).errors(x.poses, x.cameras, x.landmarks)
        moved_lens = s.errors(x.poses, x.cameras._replace(intrinsics=intrinsics_of(other)[1][None]), x.landmarks)
        assert anew.min() > 0.1 * part
        left.append(np.abs(moved_lens - anew).max())
    assert left[0] < 0.3
    assert left[1] < 0.02 * left[0]


def test_only_frozen_states_keep_their_first_estimates():
    problem, first = flown_window()
    x = moved(first, np.random.default_rng(1), 0.3)
    at = replace(x, states=problem.prior.first(x.states))
    assert problem.prior.frozen.tolist() == [True, True, False, False, False]
    H = symmetric(problem.linearise(x).H) - problem.prior.H - _of_readings(problem, x, at)
    n = len(H)
    np.testing.assert_allclose(
        H, assembled(x, at, problem.sightings)[0][:n, :n], rtol=1e-9, atol=1e-9 * np.abs(H).max()
    )
    late = replace(problem, first_estimates=False)
    H = symmetric(late.linearise(x).H) - problem.prior.H - _of_readings(problem, x, x)
    np.testing.assert_allclose(H, assembled(x, x, problem.sightings)[0][:n, :n], rtol=1e-9, atol=1e-9 * np.abs(H).max())


def _of_readings(problem: Problem, x: Variables, at: Variables) -> Float:
    """(n, n) from the readings' own Jacobians, which have tests of their own."""
    H = np.zeros_like(problem.prior.H)
    _, J_i, J_j = problem.readings.linearise(at.states[:-1], at.states[1:])
    for k, (A, B, L) in enumerate(zip(J_i, J_j, problem.readings.sqrt_information, strict=True)):
        J = L @ np.column_stack([A, B])
        H[15 * k : 15 * k + 30, 15 * k : 15 * k + 30] += J.T @ J
    return H


def assert_gradient(problem: Problem, x: Variables, skip: Int | tuple[()] = ()) -> None:
    """The gradient is that of the cost, to a millionth of a standard deviation's worth."""
    normal = problem.linearise(x)
    b = np.concatenate([normal.b, normal.c.ravel()])
    curvature = np.concatenate([np.diag(normal.H), normal.V[:, [0, 1, 2], [0, 1, 2]].ravel()])
    unit = 1.0 / np.sqrt(np.maximum(curvature, 1.0))
    expected = numeric(lambda d: problem.cost(retracted(x, d)), unit, 1e-2)
    keep = np.delete(np.arange(len(b)), skip)
    largest = np.abs(b * unit).max()
    assert largest > 0.1
    np.testing.assert_allclose((b * unit)[keep], (expected * unit)[keep], rtol=0.0, atol=1e-6 * largest)


@pytest.mark.parametrize("on_sphere", [False, True], ids=["plane", "sphere"])
@pytest.mark.parametrize("noise_px", [0.5, 20.0])
@RIGS
@SHUTTERS
def test_gradient_of_the_robust_cost_of_sightings(on_sphere, noise_px, cameras, readout_s):
    """Also far out, where Cauchy's loss discounts nearly all."""
    problem, x = flown_window(
        on_sphere=on_sphere, noise_px=noise_px, cameras=cameras, first_estimates=False, readout_s=readout_s
    )
    nothing = replace(problem.prior, H=np.zeros_like(problem.prior.H), b=np.zeros_like(problem.prior.b))
    problem = replace(problem, prior=nothing, readings=ImuFactors.stack([]))
    skip = offsets_of(x) if on_sphere else np.empty(0, int)
    assert_gradient(problem, moved(x, np.random.default_rng(0), 0.2), skip)


def test_gradient_of_readings_and_standstill():
    problem, x = flown_window(first_estimates=False)
    problem = standing(without_sightings(problem), 2)
    problem = replace(problem, prior=replace(problem.prior, H=0.0 * problem.prior.H, b=0.0 * problem.prior.b))
    x = replace(x, landmarks=x.landmarks[:0])
    still = replace(problem, readings=ImuFactors.stack([]))
    for part in (replace(problem, still={}), still, problem):
        assert_gradient(part, moved(x, np.random.default_rng(0), 0.3))
    H = symmetric(still.linearise(x).H)
    assert np.flatnonzero(np.abs(H).max(axis=1)).tolist() == [*range(30, 33), *range(36, 45)]


@RIGS
def test_gradient_of_everything_at_once(cameras):
    problem, x = flown_window(first_estimates=False, cameras=cameras, readout_s=0.03)
    assert_gradient(standing(problem, 3), replace(x, landmarks=x.landmarks + 0.01))


def test_prior_is_a_parabola_about_its_first_estimates():
    """Where rotations have moved it counts their logarithm; its gradient stays that of the first estimates."""
    problem, first = flown_window()
    prior = problem.prior
    alone = replace(without_sightings(problem), readings=ImuFactors.stack([]))
    first = replace(first, landmarks=first.landmarks[:0])
    assert_gradient(alone, first)
    x = moved(first, np.random.default_rng(0), 1.0)
    d = prior.difference(x)
    assert alone.cost(x) == pytest.approx(0.5 * d @ prior.H @ d + prior.b @ d, rel=1e-12)
    np.testing.assert_allclose(alone.linearise(x).b, prior.b + prior.H @ d, rtol=1e-12)
    np.testing.assert_array_equal(alone.linearise(x).H, prior.H)
    np.testing.assert_allclose(d[:3], so3.log(first.states.R_WB[0].T @ x.states.R_WB[0]), atol=1e-15)
    assert (d[30:75] == 0.0).all()


def test_prior_follows_the_window():
    problem, x = flown_window(frames=4)
    _, longer = flown_window(frames=5)
    prior, n = problem.prior, 60
    grown = prior.with_state(longer.states)
    assert grown.frozen.tolist() == [True, True, False, False, False]
    index = np.r_[0:n, n + 15 : n + 15 + CALIBRATION_SIZE]
    np.testing.assert_array_equal(grown.H[np.ix_(index, index)], prior.H)
    np.testing.assert_array_equal(grown.b[index], prior.b)
    assert not grown.H[n : n + 15].any()
    shrunk = grown.without_newest()
    for name in ("H", "b", "frozen"):
        np.testing.assert_array_equal(getattr(shrunk, name), getattr(prior, name))
    # Of the states that it does not know it holds whatever they are.
    wrong = moved(longer, np.random.default_rng(0), 1.0)
    np.testing.assert_array_equal(prior.with_state(wrong.states).first(wrong.states).p_WB[:2], x.states.p_WB[:2])
    np.testing.assert_array_equal(prior.with_state(wrong.states).first(wrong.states).p_WB[2:], wrong.states.p_WB[2:])


def test_prior_on_one_state_is_its_covariance():
    _, x = flown_window(frames=2)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(15, 15))
    state = replace(x.states[:1].unstack(np.zeros(1, np.int64))[0], cov=A @ A.T)
    prior = Prior.of(state, x.cameras, np.diag(np.arange(1.0, 17.0)))
    np.testing.assert_allclose(prior.H[:15, :15] @ state.cov, np.eye(15), atol=1e-8)
    np.testing.assert_allclose(np.diag(prior.H)[15:], 1.0 / np.arange(1.0, 17.0))
    assert not prior.H[:15, 15:].any()
    assert prior.frozen.tolist() == [True]


def test_covariance_of_the_last_unknowns_is_their_part_of_the_whole():
    problem, x = flown_window()
    normal, count = problem.linearise(x), 15 + CALIBRATION_SIZE
    S, _, _ = normal.reduced(0.0)
    active = np.delete(np.arange(len(S)), [2, 15 * len(x.states) + READOUT])
    unit = natural(x)[active]
    expected = np.linalg.inv(symmetric(S)[np.ix_(active, active)] * np.outer(unit, unit))[1 - count :, 1 - count :]
    cov = covariance(normal, active, count - 1) / np.outer(unit[1 - count :], unit[1 - count :])
    np.testing.assert_allclose(cov, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(cov, cov.T)


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
@pytest.mark.parametrize("on_sphere", [False, True], ids=["plane", "sphere"])
def test_residuals_are_pixels_of_the_distorted_image(camera, on_sphere):
    """To first order: of a step ten times smaller the error is a hundred times smaller."""
    rng = np.random.default_rng(0)
    xy = camera.undistort(rng.uniform([5.0, 5.0], [747.0, 475.0], (50, 2)))
    to_px = reprojection.pixels_by_residual(*intrinsics_of(camera), xy, on_sphere)
    direction = rng.normal(size=xy.shape)
    errors = []
    for step in (1e-3, 1e-4):
        p_C = np.column_stack([xy + step * direction, np.ones(len(xy))])
        T, r = np.empty((2, 3)), np.empty(2)
        predicted = []
        for i in range(len(xy)):
            reprojection._residual(p_C[i], *xy[i], to_px[i], on_sphere, T, r)
            predicted.append(r.copy())
        moved_px = camera.distort(xy + step * direction) - camera.distort(xy)
        assert np.linalg.norm(moved_px, axis=1).mean() > 300.0 * step
        errors.append(np.abs(np.array(predicted) - moved_px).max() / step)
    assert errors[0] < 5.0
    assert errors[1] < 0.11 * errors[0]


@pytest.mark.parametrize("on_sphere", [False, True], ids=["plane", "sphere"])
def test_errors_are_root_mean_squares_and_infinite_behind_the_camera(on_sphere):
    problem, x = flown_window(on_sphere=on_sphere)
    s = problem.sightings
    poses, camera = Poses.of(x.states.R_WB, x.states.p_WB), x.cameras
    r = residuals(x, s)
    row, _ = np.nonzero(s.seen)
    expected = np.sqrt(np.bincount(row, (r * r).sum(axis=1)) / (2.0 * s.seen.sum(axis=1))) / s.sigma
    np.testing.assert_allclose(s.errors(poses, camera, x.landmarks), expected, rtol=1e-9)
    *_, cost, errors = s.linearise(poses, poses, camera, x.landmarks)
    np.testing.assert_allclose(errors, expected, rtol=1e-9)
    assert cost == pytest.approx(s.cost(poses, camera, x.landmarks), rel=1e-12)
    # Every other one a centimetre from its host, so that cameras that flew on have it behind them.
    near = x.landmarks.copy()
    near[::2, 2] = 100.0
    p_WF = positions(x.states, camera, s.seen.argmax(axis=1), near)
    R_WC, p_WC = camera_poses(x.states, camera)
    depth = np.einsum("kj,lkj->lk", R_WC[..., 2], p_WF[:, None] - p_WC)
    behind = ((depth < 0.0) & s.seen).any(axis=1)
    assert 0 < behind.sum() < len(behind)
    np.testing.assert_array_equal(np.isinf(s.errors(poses, camera, near)), behind)
    np.testing.assert_array_equal(np.isinf(s.linearise(poses, poses, camera, near)[-1]), behind)
    assert np.isfinite(s.cost(poses, camera, near))


def test_sphere_and_plane_agree_to_first_order():
    """Both are in pixels, so near the solution one weighs as the other."""
    plane, x = flown_window(noise_px=0.0, offset_s=0.0)
    sphere, _ = flown_window(noise_px=0.0, offset_s=0.0, on_sphere=True)
    H_plane, H_sphere = assembled(x, x, plane.sightings)[0], assembled(x, x, sphere.sightings)[0]
    assert_normal((H_sphere,), (H_plane,), sizes(x), 1e-9)


def test_landmarks_are_eliminated_exactly():
    problem, x = flown_window()
    x = moved(x, np.random.default_rng(0), 0.1)
    normal = problem.linearise(x)
    n, L = len(normal.b), len(x.landmarks)
    full_H, full_b = np.zeros((n + 3 * L, n + 3 * L)), np.concatenate([normal.b, normal.c.ravel()])
    full_H[:n, :n] = symmetric(normal.H)
    for i in range(L):
        own = np.arange(n + 3 * i, n + 3 * i + 3)
        full_H[np.ix_(own, own)] = normal.V[i]
        full_H[np.ix_(own, normal.columns)] = normal.W[i]
        full_H[np.ix_(normal.columns, own)] = normal.W[i].T
    for damping in (0.0, 0.1):
        damped = full_H.copy()
        damped[np.diag_indices_from(damped)] *= 1.0 + damping
        scale = 1.0 / np.sqrt(np.diag(damped))
        expected = -scale * np.linalg.solve(damped * np.outer(scale, scale), full_b * scale)
        S, g, eliminated = normal.reduced(damping)
        s = 1.0 / np.sqrt(np.diag(S))
        step = -s * np.linalg.solve(symmetric(S) * np.outer(s, s), g * s)
        np.testing.assert_allclose(step / natural(x), expected[:n] / natural(x), rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(normal.landmark_step(step, eliminated).ravel(), expected[n:], rtol=1e-6, atol=1e-8)


def test_no_step_takes_a_landmark_behind_infinity():
    _, x = flown_window()
    step = np.zeros_like(x.landmarks)
    step[:, 2] = np.where(np.arange(len(step)) % 2, -2.0, 1.0) * x.landmarks[:, 2]
    rho = x.retract(np.zeros(len(natural(x))), step).landmarks[:, 2]
    np.testing.assert_array_equal(rho[1::2], INFINITELY_FAR)
    np.testing.assert_allclose(rho[::2], 2.0 * x.landmarks[::2, 2])


def test_a_landmark_seen_from_one_place_only_is_survived():
    """Two frames at the same pose say nothing of the depth: its step is finite, and tells the states nothing."""
    problem, x = flown_window(frames=2, landmarks=6, first_estimates=False)
    normal = problem.linearise(replace(x, states=x.states[:1].append(x.states[:1])))
    assert np.abs(normal.V[:, 2]).max() < 1e-12
    S, g, eliminated = normal.reduced(0.0)
    assert np.isfinite(S).all()
    step = normal.landmark_step(np.zeros(len(g)), eliminated)
    assert np.isfinite(step).all()
    assert np.abs(step[:, 2]).max() < 1e-6
    assert np.abs(step[:, :2]).max() > 1e-4
