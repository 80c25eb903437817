"""The steps of initialisation one by one: exact on exact data, unbiased on noisy data, Jacobians and covariances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import chi2

from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.landmarks import camera_poses, positions
from vioframe.estimation.factors.problem import Problem, Variables
from vioframe.estimation.factors.reprojection import Calibrated
from vioframe.estimation.inertial.preintegration import Preintegrated, preintegrate
from vioframe.estimation.initialization import GIVEN, dynamic, static
from vioframe.estimation.initialization.bundle_adjustment import adjusted, adjustment, covariance, noise_px
from vioframe.estimation.initialization.closed_form import (
    _solve_on_gravity_sphere,
    align,
    estimate_gyro_bias,
    rotations,
    solve_structure,
)
from vioframe.estimation.initialization.dynamic import path_scale_sigma
from vioframe.estimation.initialization.window import (
    BIAS_ACCEL_SIGMA,
    RefusalError,
    Window,
    build_window,
    spread_indices,
)
from vioframe.geometry import so3
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation.flights import flight
from vioframe.simulation.imu import ImuErrors, read_imu
from vioframe.simulation.tracks import cut_segments, simulated_sequence
from vioframe.types import DBA, DTHETA, GRAVITY_M_S2, Float, FrameTracks, ImuNoise, ImuSegment

CAMERA = packaged_calibration("euroc").cameras[0]
PIXEL = 1.0 / CAMERA.model.focal_px
BIAS_GYRO, BIAS_ACCEL = np.array([-0.02, 0.03, 0.08]), np.array([-0.05, 0.1, 0.08])
ZERO = np.zeros(3)
# Loud, so that a covariance that forgot the readings' noise would be caught.
NOISE = ImuNoise(1.0e-3, 2.0e-2, 1.0e-4, 1.0e-2, 200.0)


# Of the calibration, which is right here: rad, m, s.
CALIBRATION_COV = np.diag(np.repeat([1e-5, 1e-5, 1e-6, 0.0], [3, 3, 1, 9]) ** 2)


@dataclass(frozen=True)
class Scene:
    """Two seconds of the figure of eight seen in eleven keyframes, and the truth there."""

    window: Window
    truth: StateArrays
    p_WF: Float

    def imu(self, bias_gyro: Float = BIAS_GYRO, bias_accel: Float = BIAS_ACCEL) -> list[Preintegrated]:
        return [preintegrate(s, bias_gyro, bias_accel, NOISE) for s in self.window.segments]

    @property
    def camera(self) -> Float:
        """True camera positions from the first, in the axes of the first body."""
        p_WC = self.truth.p_WB + self.truth.R_WB @ CAMERA.p_BC
        return (p_WC - p_WC[0]) @ self.truth.R_WB[0]

    @property
    def R_B0C(self) -> Float:
        return self.truth.R_WB[0].T @ self.truth.R_WB @ CAMERA.R_BC


def scene(
    pixels: float = 0.0,
    seed: int = 0,
    plane: bool = False,
    noise: ImuNoise | None = None,
    bias_accel: Float = BIAS_ACCEL,
) -> Scene:
    """Sixty landmarks 2 to 8 m deep, or on a tilted plane, observed with noise of ``pixels``."""
    rng = np.random.default_rng(seed)
    path = flight("figure_eight", 4.0, CAMERA.R_BC)
    rate = noise.rate_hz if noise else 1000.0
    imu_s, frames_s = 1.0 + np.arange(round(2.0 * rate) + 1) / rate, 1.0 + 0.2 * np.arange(11)
    errors = ImuErrors(bias_gyro_B=tuple(BIAS_GYRO), bias_accel_B=tuple(bias_accel))
    readings = read_imu(path.at(imu_s), noise, rng, rate, errors)
    imu_ns, frames_ns = (np.round(t * 1e9).astype(np.int64) for t in (imu_s, frames_s))
    segments = tuple(cut_segments(imu_ns, readings.gyro_B, readings.accel_B, frames_ns)[1:])
    at = np.searchsorted(imu_ns, frames_ns)
    motion = path.at(frames_s)
    truth = StateArrays(motion.R_WB, motion.p_WB, motion.v_WB, readings.bias_gyro_B[at], readings.bias_accel_B[at])

    R_WC, p_WC = truth.R_WB @ CAMERA.R_BC, truth.p_WB + truth.R_WB @ CAMERA.p_BC
    rays = np.column_stack([rng.uniform(-0.6, 0.6, 60), rng.uniform(-0.4, 0.4, 60), np.ones(60)])
    depth = 4.0 / (1.0 + 0.4 * rays[:, 0] - 0.3 * rays[:, 1]) if plane else rng.uniform(2.0, 8.0, 60)
    p_WF = (rays * depth[:, None]) @ R_WC[5].T + p_WC[5]
    p_C = np.einsum("kji,klj->kli", R_WC, p_WF - p_WC[:, None])
    xy = p_C[..., :2] / p_C[..., 2:]
    seen = (p_C[..., 2] > 0.3) & (np.abs(xy) < [0.8, 0.5]).all(axis=2)
    xy = np.where(seen[..., None], xy + rng.normal(0.0, pixels * PIXEL, xy.shape), np.nan)
    keep = seen.sum(axis=0) >= 4
    window = Window(frames_ns, segments, np.arange(60), xy, seen, np.zeros_like(xy)).only(keep)
    return Scene(window, truth, p_WF[keep])


def problem_of(s: Scene) -> tuple[Problem, Variables]:
    """The bundle adjustment of a scene, and its true values."""
    camera = Calibrated.of(CAMERA)
    R_WC, p_WC = camera_poses(s.truth, camera)
    host = s.window.seen.argmax(axis=0)
    p_C = np.einsum("lji,lj->li", R_WC[host], s.p_WF - p_WC[host])
    truth = Variables(s.truth, camera, np.column_stack([p_C[:, :2] / p_C[:, 2:], 1.0 / p_C[:, 2]]))
    return adjustment(s.window, s.imu(), truth, [CAMERA], CALIBRATION_COV), truth


class TestGyroBias:
    @pytest.mark.parametrize("plane", [False, True])
    def test_exact_on_exact_data(self, plane: bool):
        s = scene(plane=plane)
        bias, distance = estimate_gyro_bias(s.window, s.imu(ZERO, ZERO), CAMERA.R_BC, PIXEL, 0.2)
        # What is left is the pull of the prior and the first-order correction of the readings.
        np.testing.assert_allclose(bias, BIAS_GYRO, atol=2e-4)
        assert np.nanmax(distance) < 0.1

    @pytest.mark.parametrize("plane", [False, True])
    def test_noise_scatters_it_but_does_not_pull_it(self, plane: bool):
        """A pixel of noise costs 0.005 rad/s on a plane and less elsewhere; the bundle adjustment takes that out."""
        estimates = []
        for seed in range(16):
            s = scene(1.0, seed, plane)
            bias, _ = estimate_gyro_bias(s.window, s.imu(ZERO, ZERO), CAMERA.R_BC, PIXEL, 0.2)
            estimates.append(bias)
        off = np.stack(estimates) - BIAS_GYRO
        scatter = off.std(axis=0)
        assert np.all(scatter < 0.008)
        assert np.all(np.abs(off.mean(axis=0)) < 3.5 * scatter / np.sqrt(len(off)) + 2e-4)
        assert np.abs(off).max() < 0.02

    def test_wrong_tracks_show_and_do_not_harm(self):
        s = scene(0.5)
        xy = s.window.xy.copy()
        wrong = np.arange(0, len(s.window.ids), 8)
        xy[:, wrong] = xy[:, wrong[::-1]] + np.random.default_rng(0).normal(0.0, 0.05, xy[:, wrong].shape)
        window = replace(s.window, xy=xy, seen=~np.isnan(xy[..., 0]))
        bias, distance = estimate_gyro_bias(window, s.imu(ZERO, ZERO), CAMERA.R_BC, PIXEL, 0.2)
        np.testing.assert_allclose(bias, BIAS_GYRO, atol=0.008)
        good = np.setdiff1d(np.arange(len(window.ids)), wrong)
        assert np.nanmedian(distance[wrong]) > 3.0 > np.nanmax(distance[good])


class TestStructure:
    @pytest.mark.parametrize("plane", [False, True])
    def test_exact_on_exact_data(self, plane: bool):
        s = scene(plane=plane)
        structure = solve_structure(s.window, s.R_B0C, 1e-9)
        scale = (structure.position * s.camera).sum() / (structure.position**2).sum()
        np.testing.assert_allclose(scale * structure.position, s.camera, atol=1e-7)
        assert structure.good.all()
        assert np.nanmax(structure.error) < 1e-7

    def test_noise_does_not_shrink_it(self):
        """Plain least squares, without the compensation, would put the landmarks nearer by several per cent."""
        ratio = []
        for seed in range(10):
            s = scene(2.0, seed)
            structure = solve_structure(s.window, s.R_B0C, 2.0 * PIXEL)
            true_size, size = np.linalg.norm(s.camera), np.linalg.norm(structure.position)
            p_C = np.einsum("kji,klj->kli", s.truth.R_WB @ CAMERA.R_BC, s.p_WF - s.truth.p_WB[:, None])
            use = s.window.seen & structure.good
            ratio.append(np.median(structure.depth[use] / p_C[..., 2][use]) * true_size / size)
        assert abs(np.mean(ratio) - 1.0) < 0.01

    def test_no_parallax_is_refused(self):
        s = scene()
        xy = np.broadcast_to(s.window.xy[5], s.window.xy.shape)
        window = replace(s.window, xy=xy, seen=~np.isnan(xy[..., 0]))
        with pytest.raises(RefusalError, match="parallax"):
            solve_structure(window, np.tile(np.eye(3), (11, 1, 1)), PIXEL)


class TestAlignment:
    def test_exact_on_exact_data(self):
        s = scene()
        alignment = align(s.camera / 3.7, s.imu(BIAS_GYRO, ZERO), CAMERA.p_BC, 10.0)
        R_0, g_B0 = s.truth.R_WB[0], s.truth.R_WB[0].T @ [0.0, 0.0, -GRAVITY_M_S2]
        np.testing.assert_allclose(alignment.scale, 3.7, rtol=1e-3)
        np.testing.assert_allclose(alignment.g_B0, g_B0, atol=5e-3)
        np.testing.assert_allclose(alignment.states.bias_accel_B[0], BIAS_ACCEL, atol=5e-3)
        np.testing.assert_allclose(alignment.states.v_WB, s.truth.v_WB @ R_0, atol=2e-3)
        np.testing.assert_allclose(alignment.states.p_WB, (s.truth.p_WB - s.truth.p_WB[0]) @ R_0, atol=1e-3)
        np.testing.assert_allclose(alignment.states.R_WB, R_0.T @ s.truth.R_WB, atol=1e-5)

    def test_mirrored_path_has_negative_scale(self):
        s = scene()
        assert align(-s.camera, s.imu(BIAS_GYRO, ZERO), CAMERA.p_BC, 0.15).scale < 0.0

    @pytest.mark.parametrize("seed", range(5))
    def test_gravity_sphere_holds_the_global_minimum(self, seed: int):
        rng = np.random.default_rng(seed)
        A, b = rng.normal(size=(12, 10)), rng.normal(0.0, 10.0, 12)
        H, linear = A.T @ A, A.T @ b
        x = _solve_on_gravity_sphere(H, linear)
        np.testing.assert_allclose(np.linalg.norm(x[3:6]), GRAVITY_M_S2, rtol=1e-12)

        def best_cost(g: Float) -> Float:
            """Over all else, at gravity (N, 3)."""
            others = [0, 1, 2, 6, 7, 8, 9]
            rest = b - g @ A[:, 3:6].T
            fit = np.linalg.lstsq(A[:, others], rest.T, rcond=None)[0]
            return np.square(A[:, others] @ fit - rest.T).sum(axis=0)

        g = rng.normal(size=(20000, 3))
        g *= GRAVITY_M_S2 / np.linalg.norm(g, axis=1, keepdims=True)
        cost = np.square(A @ x - b).sum()
        np.testing.assert_allclose(cost, best_cost(x[3:6][None])[0], rtol=1e-9)
        assert cost <= best_cost(g).min()

    def test_rotations_chain(self):
        s = scene()
        np.testing.assert_allclose(rotations(s.imu()), s.truth.R_WB[0].T @ s.truth.R_WB, atol=1e-6)


class TestBundleAdjustment:
    def test_errors_vanish_at_the_truth(self):
        s = scene()
        problem, truth = problem_of(s)
        np.testing.assert_allclose(
            problem.sightings.errors(truth.poses, truth.cameras, truth.landmarks), 0.0, atol=1e-9
        )
        hosts = problem.sightings.seen.argmax(axis=1)
        np.testing.assert_allclose(positions(s.truth, truth.cameras, hosts, truth.landmarks), s.p_WF, atol=1e-9)

    @pytest.mark.parametrize(("pixels", "counted_px"), [(0.0, 0.15), (0.1, 0.3), (0.2, 0.6), (2.0, 1.0)])
    def test_sightings_count_with_three_times_the_noise_they_show(self, pixels: float, counted_px: float):
        problem, truth = problem_of(scene(pixels))
        adjusted_to_them = adjusted(problem, truth, CALIBRATION_COV).variables
        assert noise_px(problem, adjusted_to_them) == pytest.approx(counted_px, rel=0.2)

    def test_finds_back_from_far_off(self):
        s = scene()
        problem, truth = problem_of(s)
        rng = np.random.default_rng(0)
        sigma = np.repeat([0.05, 0.1, 0.1, 0.005, 0.05], 3)
        start = s.truth.retract(rng.normal(0.0, sigma, (11, 15)))
        points = truth.landmarks + rng.normal(0.0, [0.01, 0.01, 0.05], truth.landmarks.shape)
        start = replace(truth, states=start, landmarks=points)
        problem = adjustment(s.window, s.imu(), start, [CAMERA], CALIBRATION_COV)
        solution = adjusted(problem, start, CALIBRATION_COV)
        states = solution.variables.states
        assert solution.converged
        # The first state has not moved, nor turned about gravity.
        np.testing.assert_allclose(states.p_WB[0], start.states.p_WB[0], atol=1e-6)
        assert abs(so3.log(states.R_WB[0] @ start.states.R_WB[0].T)[2]) < 1e-3
        # The prior pulls the accelerometer's bias a little towards zero, and tilt with it.
        relative = np.swapaxes(states.R_WB[:1], -1, -2) @ states.R_WB
        np.testing.assert_allclose(relative, s.truth.R_WB[:1].swapaxes(-1, -2) @ s.truth.R_WB, atol=2e-4)
        size = np.linalg.norm(states.p_WB[-1] - states.p_WB[0])
        np.testing.assert_allclose(size, np.linalg.norm(s.truth.p_WB[-1] - s.truth.p_WB[0]), rtol=5e-3)

    def test_covariance_is_honest(self):
        """Squared Mahalanobis distances of velocity, tilt and biases over noisy trials, and the scale's deviation."""
        distances, scales = [], []
        for seed in range(24):
            # The prior must be true as well, or the distances would not be chi-square.
            bias_accel = np.random.default_rng(100 + seed).normal(0.0, 0.15, 3)
            s = scene(1.0, seed, noise=NOISE, bias_accel=bias_accel)
            problem, truth = problem_of(s)
            solution = adjusted(problem, truth, CALIBRATION_COV)
            x, cov = solution.variables, covariance(problem, solution, CALIBRATION_COV)
            newest, true = x.states[-1:], s.truth[-1:]
            yaw = so3.log(newest.R_WB[0] @ true.R_WB[0].T)[2]
            turn = so3.exp([0.0, 0.0, yaw])
            error = np.concatenate(
                [
                    so3.log(newest.R_WB[0].T @ turn @ true.R_WB[0]),
                    turn @ true.v_WB[0] - newest.v_WB[0],
                    true.bias_gyro_B[0] - newest.bias_gyro_B[0],
                    true.bias_accel_B[0] - newest.bias_accel_B[0],
                ]
            )
            pick = np.r_[0:3, 6:15] + 15 * 10
            P = cov[np.ix_(pick, pick)]
            horizontal = np.linalg.svd(newest.R_WB[0][2][None])[2][1:]
            basis = np.zeros((11, 12))
            basis[:2, :3], basis[2:, 3:] = horizontal, np.eye(9)
            e = basis @ error
            distances.append(e @ np.linalg.solve(basis @ P @ basis.T, e))
            q, p = (path - path.mean(axis=0) for path in (x.states.p_WB, s.truth.p_WB @ turn.T))
            scales.append(((q * p).sum() / (p * p).sum() - 1.0) / path_scale_sigma(x.states.p_WB, cov))
        low, high = chi2.ppf([0.001, 0.999], 11 * len(distances)) / len(distances)
        assert low < np.mean(distances) < high
        low, high = chi2.ppf([0.001, 0.999], len(scales)) / len(scales)
        assert low < np.mean(np.square(scales)) < high


class TestLookAhead:
    @pytest.mark.parametrize("off_px", [0.0, 8.0])
    def test_frames_that_the_estimate_does_not_predict_refuse_it(self, off_px: float):
        """Those held back, but for the newest, which is estimated with the others."""
        sequence = simulated_sequence("figure_eight", duration_s=2.5, pixel_sigma=0.3)
        calibration, packets = sequence.calibration, list(sequence.packets)
        for k in (-4, -3, -2):
            imu, tracks = packets[k]
            moved = replace(tracks, xy=tracks.xy + np.array([off_px, 0.0]))
            packets[k] = imu, moved.undistorted(calibration.cameras[0].model)
        known = np.diag(GIVEN.stacked() ** 2)
        attempt = partial(dynamic.initialise, packets, calibration, known, known, ZERO, found=False)
        if off_px:
            with pytest.raises(RefusalError, match="the prediction misses a later frame"):
                attempt()
        else:
            assert attempt().states[-1].t_ns == packets[-1][1].t_ns


class TestStatic:
    def test_tilt_and_bias_are_tied_together(self):
        sequence = simulated_sequence("standstill", duration_s=1.0, bias_accel_B=BIAS_ACCEL)
        estimate = static.initialise(sequence.packets, sequence.calibration.imu)
        cov = estimate.states[-1].cov
        assert cov is not None
        # To first order the specific force explained, hat(f) dtheta + dba, is known far better than either part.
        f = estimate.states[-1].R_WB.T @ [0.0, 0.0, GRAVITY_M_S2]
        J = np.concatenate([so3.hat(f), np.eye(3)], axis=1)
        part = np.r_[DTHETA, DBA]
        both = cov[np.ix_(part, part)]
        assert np.sqrt(np.linalg.eigvalsh(J @ both @ J.T)[-1]) < 0.01
        tilt_sigma = np.sqrt(np.linalg.eigvalsh(cov[DTHETA, DTHETA])[-1])
        np.testing.assert_allclose(tilt_sigma, BIAS_ACCEL_SIGMA / GRAVITY_M_S2, rtol=0.02)
        up = estimate.states[-1].R_WB[2]
        assert np.sqrt(up @ cov[DBA, DBA] @ up) < 0.01  # along gravity the bias is seen

    def test_the_bias_is_the_part_along_gravity_that_readings_are_too_long_by(self):
        sequence = simulated_sequence("standstill", duration_s=1.0, bias_accel_B=BIAS_ACCEL)
        newest = static.initialise(sequence.packets, sequence.calibration.imu).states[-1]
        up = newest.R_WB[2]
        np.testing.assert_allclose(newest.bias_accel_B, up * (up @ BIAS_ACCEL), atol=2e-3)
        assert abs(up @ BIAS_ACCEL) > 0.04

    def test_a_bias_beyond_its_prior_is_refused(self):
        sequence = simulated_sequence("standstill", duration_s=1.0)
        packets = [(ImuSegment(imu.t_ns, imu.gyro_B, 1.1 * imu.accel_B), tracks) for imu, tracks in sequence.packets]
        with pytest.raises(RefusalError, match="too far from gravity"):
            static.initialise(packets, sequence.calibration.imu)

    def test_too_few_frames_are_refused(self):
        sequence = simulated_sequence("standstill", duration_s=1.0, frame_rate_hz=2.0)
        with pytest.raises(RefusalError, match="only 3 frames"):
            static.initialise(sequence.packets, sequence.calibration.imu)

    def test_too_few_frames_for_a_start_in_motion_are_refused(self):
        """As many as are left where an estimator is too slow: all of them among the newest."""
        sequence = simulated_sequence("figure_eight", duration_s=3.0)
        packets = sequence.packets[-4:]
        known = np.eye(16)
        with pytest.raises(RefusalError, match="4 frames are too few"):
            dynamic.initialise(packets, sequence.calibration, known, known, np.zeros(3), found=False)


class TestWindow:
    def test_longest_tracks_and_readings_joined(self):
        t_ns = np.arange(4) * 100_000_000
        seen = ([0, 1, 2], [0, 1, 2], [0, 1], [0, 3])
        packets = []
        for k, ids in enumerate(seen):
            stamps = np.array([max(k - 1, 0), k]) * 100_000_000 if k else np.zeros(1, np.int64)
            readings = np.full((len(stamps), 3), float(k))
            xy = np.column_stack([ids, np.full(len(ids), k)]).astype(float)
            packets.append(
                (
                    ImuSegment(stamps, readings, readings),
                    FrameTracks(int(t_ns[k]), np.array(ids), np.zeros(len(ids), np.int64), xy, xy / 10),
                )
            )
        window = build_window(packets, [0, 2, 3], 2, 10)
        np.testing.assert_array_equal(window.ids, [0, 1])
        np.testing.assert_array_equal(window.seen, [[True, True], [True, True], [True, False]])
        np.testing.assert_allclose(window.xy[1, 1], [0.1, 0.2])
        np.testing.assert_array_equal(window.segments[0].t_ns, [0, 100_000_000, 200_000_000])
        np.testing.assert_array_equal(build_window(packets, [0, 2, 3], 2, 1).ids, [0])

    def test_no_view_is_left_out_for_longer_tracks(self):
        """Of thirty through the first ten frames, and ten through the six that come then, a dozen."""
        early, late = list(range(30)), list(range(30, 40))
        packets = []
        for k in range(14):
            ids = np.array((early if k < 10 else []) + (late if k >= 8 else []))
            stamps, xy = np.array([k, k + 1]) * 100_000_000, np.zeros((len(ids), 2))
            tracks = FrameTracks(int(stamps[1]), ids, np.zeros(len(ids), np.int64), xy, xy)
            packets.append((ImuSegment(stamps, np.zeros((2, 3)), np.zeros((2, 3))), tracks))
        window = build_window(packets, range(14), 4, 12)
        assert len(window.ids) == 12
        assert (window.seen.sum(axis=1) >= 4).all()
        np.testing.assert_array_equal(window.ids[:5], early[:5])

    def test_indices_spread_over_time_not_over_frames(self):
        t_ns = np.array([0, 1, 2, 3, 4, 100, 200]) * 1_000_000
        assert spread_indices(t_ns, 3) == [0, 5, 6]
        assert spread_indices(t_ns, 50)[0] == 0
        assert spread_indices(t_ns, 50)[-1] == 6


class TestAttitude:
    def test_puts_the_vertical_upright_without_turning_about_it(self):
        rng = np.random.default_rng(0)
        for up in rng.normal(size=(20, 3)):
            R = so3.level_rotation(up)
            np.testing.assert_allclose(R @ up, [0.0, 0.0, np.linalg.norm(up)], atol=1e-12)
            assert abs(so3.log(R)[2]) < 1e-12

    @pytest.mark.parametrize("up", [[0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [1e-9, 0.0, 1.0], [1e-9, 0.0, -1.0]])
    def test_upright_and_upside_down(self, up: list[float]):
        R = so3.level_rotation(np.array(up))
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(R @ up, [0.0, 0.0, np.linalg.norm(up)], atol=1e-12)
