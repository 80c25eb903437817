"""The camera's rotation on the body: exact on exact data, honest under noise, refused where it cannot be known."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from initialization_helpers import Motion, judge, without_points
from scipy.stats import chi2

from vioframe import pipeline
from vioframe.errors import ConfigError
from vioframe.estimation.initialization import CameraRotation, Initializer, RotationCalibrator, hand_eye
from vioframe.estimation.initialization.epipolar_pairs import BearingPairs, _noise_of_normals
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.evaluation import evaluate
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.io.synchronise import synchronise
from vioframe.io.trajectories import load_trajectory
from vioframe.odometry import Odometry
from vioframe.simulation import Packet, TrackSequence, simulated_sequence
from vioframe.simulation.flights import ShapedFlight, levelled
from vioframe.types import Calibration, Estimate, Float, NavState, Status
from vioframe_euroc import EurocDataset
from vioframe_msckf.backend import Msckf
from vioframe_shi_tomasi import ShiTomasi

EUROC = packaged_calibration("euroc", cameras=["cam0"])
BIAS_GYRO = np.array([-0.002, 0.021, 0.077])
FLIGHTS = ["figure_eight", "aggressive", "stop_and_go", "pure_rotation"]


def turned(calibration: Calibration, R_BC: Float | None = None) -> Calibration:
    """The calibration with the camera turned some other way: as the body unless ``R_BC`` says how."""
    return calibration.with_camera(0, R_BC=np.eye(3) if R_BC is None else R_BC)


def unknown(calibration: Calibration) -> Calibration:
    """The calibration of which nobody knows how the camera is turned."""
    return calibration.with_camera(0, R_BC=np.eye(3), rotation_known=False)


def calibrate(packets: Sequence[Packet], calibration: Calibration) -> tuple[CameraRotation | None, RotationCalibrator]:
    """What the calibrator says first, the true rotation kept from it."""
    calibrator = RotationCalibrator(turned(calibration))
    for imu, tracks in packets:
        found = calibrator.add(imu, tracks)
        if found is not None:
            return found, calibrator
    return None, calibrator


def error(found: CameraRotation, calibration: Calibration) -> Float:
    """(3,) rad."""
    return so3.log(found.R_BC.T @ calibration.cameras[0].R_BC)


def error_deg(found: CameraRotation | None, calibration: Calibration) -> float:
    assert found is not None
    return float(np.rad2deg(np.linalg.norm(error(found, calibration))))


def yawing(t_s: Float) -> Float:
    """A whole radian to and fro, and nothing about the other two axes."""
    return np.column_stack([np.sin(t_s), np.zeros_like(t_s), np.zeros_like(t_s)])


def swaying(t_s: Float) -> Float:
    return np.column_stack([np.sin(1.3 * t_s), np.cos(1.7 * t_s), 0.3 * np.sin(0.8 * t_s)])


class TestPairs:
    def test_a_few_steps_bring_a_rotation_back_on_exact_data(self):
        rng = np.random.default_rng(0)
        pairs, R_12, _ = random_pairs(rng)
        R, weight = R_12 @ so3.exp(0.02 * rng.normal(size=(len(R_12), 3))), pairs.common.astype(float)
        for _ in range(20):
            equations = pairs.linearise(R, weight, 1e-3, 1e6)
            R = R @ so3.exp(-np.linalg.solve(equations.H, equations.b[..., None])[..., 0])
            weight = equations.weight
        np.testing.assert_allclose(R, R_12, atol=1e-9)

    def test_noise_of_the_normals_is_what_simulation_shows(self):
        rng = np.random.default_rng(1)
        pairs, R_12, _ = random_pairs(rng)
        weight = rng.uniform(0.5, 2.0, pairs.common.shape) * pairs.common
        predicted = _noise_of_normals(pairs.f, pairs.g @ np.swapaxes(R_12, -1, -2), R_12, weight)
        seen, sigma, draws = np.zeros_like(predicted), 1e-3, 2000
        clean = np.cross(pairs.f, pairs.g @ np.swapaxes(R_12, -1, -2))
        for _ in range(draws):
            f, g = (v + sigma * rng.normal(size=v.shape) * [1.0, 1.0, 0.0] for v in (pairs.f, pairs.g))
            dn = np.cross(f, g @ np.swapaxes(R_12, -1, -2)) - clean
            seen += np.swapaxes(dn * weight[..., None], -1, -2) @ dn / draws / sigma**2
        np.testing.assert_allclose(seen, predicted, atol=0.03 * np.abs(predicted).max())

    def test_small_parallax_does_not_pull_the_rotation(self):
        """Motion of a pixel or two under a pixel of noise: the mean over many pairs is still the truth."""
        rng, sigma = np.random.default_rng(2), 1.0 / EUROC.cameras[0].model.focal_px
        pairs, R_12, _ = random_pairs(rng, count=400, tracks=60, baseline=0.03, sigma=sigma)
        R, weight = R_12, pairs.common.astype(float)
        for _ in range(30):
            equations = pairs.linearise(R, weight, sigma, 1e6)
            R = R @ so3.exp(-np.linalg.solve(equations.H + 1e4 * np.eye(3), equations.b[..., None])[..., 0])
            weight = equations.weight
        off = so3.log(np.swapaxes(R_12, -1, -2) @ R)
        assert np.all(np.abs(off.mean(axis=0)) < 4.0 * off.std(axis=0) / np.sqrt(len(off)))


def random_pairs(
    rng: np.random.Generator, count: int = 5, tracks: int = 40, baseline: float = 0.5, sigma: float = 0.0
) -> tuple[BearingPairs, Float, Float]:
    """Pairs of views of landmarks 2 to 8 m deep, their rotations R_C1C2 (P, 3, 3) and translations (P, 3) m."""
    xy_1 = rng.uniform([-0.7, -0.45], [0.7, 0.45], (count, tracks, 2))
    depth = rng.uniform(2.0, 8.0, (count, tracks, 1))
    R_12, p_12 = so3.exp(0.1 * rng.normal(size=(count, 3))), baseline * rng.normal(size=(count, 1, 3))
    p_1 = np.concatenate([xy_1, np.ones((count, tracks, 1))], axis=2) * depth
    p_2 = (p_1 - p_12) @ R_12
    xy_1, xy_2 = (xy + sigma * rng.normal(size=xy.shape) for xy in (xy_1, p_2[..., :2] / p_2[..., 2:]))
    return BearingPairs.of(xy_1, xy_2, p_2[..., 2] > 0.1), R_12, p_12[:, 0]


class TestExact:
    @pytest.mark.parametrize("flight", FLIGHTS)
    def test_exact_on_exact_data(self, flight: str):
        s = simulated_sequence(flight, noise=None, pixel_sigma=0.0, duration_s=8.0, bias_gyro_B=BIAS_GYRO)
        found, _ = calibrate(s.packets, s.calibration)
        # What is left is the pull of the bias's prior and the midpoint rule's error at 200 Hz.
        assert error_deg(found, s.calibration) < 0.01

    @pytest.mark.parametrize("seed", range(3))
    def test_any_mounting(self, seed: int):
        R_BC = so3.exp(np.random.default_rng(seed).uniform(-1.8, 1.8, 3))
        s = simulated_sequence("figure_eight", duration_s=8.0, calibration=turned(EUROC, R_BC), bias_gyro_B=BIAS_GYRO)
        found, _ = calibrate(s.packets, s.calibration)
        assert error_deg(found, s.calibration) < 1.0

    def test_what_the_calibration_says_of_it_plays_no_part(self):
        s = simulated_sequence("aggressive", duration_s=3.0)
        one = RotationCalibrator(s.calibration)
        other = RotationCalibrator(turned(s.calibration, so3.exp([1.0, -2.0, 0.5])))
        for imu, tracks in s.packets:
            a, b = one.add(imu, tracks), other.add(imu, tracks)
            assert (a is None) == (b is None)
            if a is not None and b is not None:
                np.testing.assert_array_equal(a.R_BC, b.R_BC)
                return
        pytest.fail("nothing was found")


class TestNoise:
    @pytest.mark.parametrize("flight", [*FLIGHTS, "inspection"])
    @pytest.mark.parametrize("seed", range(2))
    def test_within_a_degree_and_within_what_it_claims(self, flight: str, seed: int):
        s = simulated_sequence(flight, seed=seed, duration_s=12.0, bias_gyro_B=BIAS_GYRO)
        found, calibrator = calibrate(s.packets, s.calibration)
        assert found is not None, calibrator.refusal
        assert error_deg(found, s.calibration) < 1.0
        assert found.sigma_deg < 0.4
        d = error(found, s.calibration)
        assert d @ np.linalg.solve(found.cov, d) < chi2.ppf(0.99, 3)

    @pytest.mark.parametrize("flight", ["figure_eight", "pure_rotation"])
    def test_outliers(self, flight: str):
        s = simulated_sequence(flight, duration_s=10.0, outlier_ratio=0.15, bias_gyro_B=BIAS_GYRO)
        found, calibrator = calibrate(s.packets, s.calibration)
        assert found is not None, calibrator.refusal
        assert error_deg(found, s.calibration) < 1.0


class TestRefusals:
    def test_turns_about_one_axis(self):
        flight = ShapedFlight(15.0, swaying, yawing, levelled(EUROC.cameras[0].R_BC))
        s = simulated_sequence(flight, bias_gyro_B=BIAS_GYRO)
        found, calibrator = calibrate(s.packets, s.calibration)
        assert found is None
        assert "about a second axis" in calibrator.refusal
        assert "turn the vehicle about two axes" in calibrator.refusal

    def test_turns_about_one_axis_are_seen_by_the_covariance_too(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(hand_eye, "_LEAST_SECOND_TURN", 0.0)
        flight = ShapedFlight(15.0, swaying, yawing, levelled(EUROC.cameras[0].R_BC))
        s = simulated_sequence(flight, bias_gyro_B=BIAS_GYRO)
        found, calibrator = calibrate(s.packets, s.calibration)
        assert found is None
        assert "is known to" in calibrator.refusal

    @pytest.mark.parametrize("flight", ["standstill", "constant_velocity"])
    def test_no_turns(self, flight: str):
        s = simulated_sequence(flight, duration_s=6.0, bias_gyro_B=BIAS_GYRO)
        found, calibrator = calibrate(s.packets, s.calibration)
        assert found is None
        assert calibrator.refusal.startswith("turned by 0.0")

    def test_readings_of_another_flight(self):
        tracks, imu = (simulated_sequence(name, duration_s=8.0) for name in ("figure_eight", "aggressive"))
        packets = [(i, t) for (i, _), (_, t) in zip(imu.packets, tracks.packets, strict=True)]
        found, calibrator = calibrate(packets, EUROC)
        assert found is None
        assert calibrator.refusal

    def test_tracks_that_jump_to_other_features(self):
        rng, s = np.random.default_rng(0), simulated_sequence("figure_eight", duration_s=8.0)
        packets = [(imu, replace(tracks, ids=rng.permutation(tracks.ids))) for imu, tracks in s.packets]
        found, calibrator = calibrate(packets, s.calibration)
        assert found is None
        assert calibrator.refusal

    def test_no_tracks(self):
        s = simulated_sequence("aggressive", duration_s=4.0)
        found, calibrator = calibrate([(imu, without_points(t)) for imu, t in s.packets], s.calibration)
        assert found is None
        assert "too few tracks" in calibrator.refusal


class TestBadInput:
    def test_points_that_cannot_be_undistorted_are_left_out(self):
        s = simulated_sequence("aggressive", duration_s=4.0)
        packets = []
        for imu, tracks in s.packets:
            xy = tracks.xy_normalised.copy()
            xy[::7] = np.nan
            packets.append((imu, replace(tracks, xy_normalised=xy)))
        found, _ = calibrate(packets, s.calibration)
        assert error_deg(found, s.calibration) < 1.0

    def test_a_gap_in_the_readings_begins_the_chain_anew(self):
        s = simulated_sequence("aggressive", duration_s=6.0)
        packets, gap_at = list(s.packets), 30
        imu, tracks = packets[gap_at]
        # What was read over the gap is wrong, and must not be used.
        packets[gap_at] = (replace(imu, gyro_B=imu.gyro_B + 5.0, largest_gap_s=0.5), tracks)
        found, _ = calibrate(packets[:60], s.calibration)
        assert found is None
        found, _ = calibrate(packets, s.calibration)
        assert error_deg(found, s.calibration) < 1.0


class TestInitializer:
    def test_begins_once_the_rotation_is_found(self, caplog: pytest.LogCaptureFixture):
        s = simulated_sequence("aggressive", duration_s=10.0, bias_gyro_B=BIAS_GYRO)
        initializer = Initializer(unknown(s.calibration))
        np.testing.assert_array_equal(initializer.calibration.cameras[0].R_BC, np.eye(3))
        with caplog.at_level(logging.INFO, "vioframe.estimation.initialization"):
            for imu, tracks in s.packets:
                estimate = initializer.add(imu, tracks)
                if estimate is not None:
                    break
                assert initializer.camera_rotation is not None or "dynamic" not in initializer.refusal
        assert estimate is not None, initializer.refusal
        assert judge(estimate, Motion.of(s), s.packets[0][1].t_ns).velocity < 0.1
        found = initializer.camera_rotation
        assert error_deg(found, s.calibration) < 1.0
        assert found is not None
        assert any(str(found) in message for message in caplog.messages)
        np.testing.assert_array_equal(initializer.calibration.cameras[0].R_BC, found.R_BC)
        np.testing.assert_array_equal(initializer.calibration.cameras[0].p_BC, s.calibration.cameras[0].p_BC)

    def test_waits_at_rest_and_says_why(self):
        s = simulated_sequence("standstill", duration_s=4.0, bias_gyro_B=BIAS_GYRO)
        initializer = Initializer(unknown(s.calibration))
        assert all(initializer.add(imu, tracks) is None for imu, tracks in s.packets)
        assert initializer.refusal.startswith("hand-eye: turned by 0.0")

    def test_the_rotation_outlives_a_reset(self):
        s = simulated_sequence("aggressive", duration_s=5.0)
        initializer = Initializer(unknown(s.calibration))
        for imu, tracks in s.packets:
            initializer.add(imu, tracks)
            if initializer.camera_rotation is not None:
                break
        found = initializer.camera_rotation
        initializer.reset()
        assert found is not None
        assert initializer.camera_rotation is found
        at_rest = simulated_sequence("standstill", duration_s=2.0)
        assert any(initializer.add(imu, tracks) is not None for imu, tracks in at_rest.packets)


def fly(sequence: TrackSequence, calibration: Calibration) -> tuple[list[Estimate], list[NavState]]:
    """Estimates of a filter that takes ``calibration`` for that of the sequence."""
    life = LifeCycle(Msckf(), calibration)
    estimates = [life.process(imu, tracks) for imu, tracks in sequence.packets]
    return estimates, [e.state for e in estimates if e.state is not None]


class TestMsckf:
    def test_flies_with_a_camera_mounted_unknown(self):
        s = simulated_sequence("aggressive", duration_s=12.0, bias_gyro_B=BIAS_GYRO)
        estimates, states = fly(s, unknown(s.calibration))
        assert Status.LOST not in {e.status for e in estimates}
        assert any("camera's rotation on the body found" in event for e in estimates for event in e.events)
        path = Trajectory(*(np.stack(x) for x in zip(*((x.t_ns, x.R_WB, x.p_WB) for x in states), strict=True)))
        errors = evaluate(path, s.ground_truth)
        assert errors.coverage > 0.7
        assert errors.ate_m.rmse < 0.15

    def test_never_begins_with_a_wrong_rotation_taken_for_true(self):
        s = simulated_sequence("aggressive", duration_s=4.0)
        assert not fly(s, turned(s.calibration))[1]

    def test_a_start_from_a_known_state_does_not_go_with_it(self):
        s = simulated_sequence("aggressive", duration_s=1.0)
        start = replace(s.true_states[0], cov=np.eye(15))
        with pytest.raises(ConfigError, match="whose rotation on the body is known"):
            LifeCycle(Msckf(), unknown(s.calibration), initial_state=start)


class TestRealRecordings:
    def test_machine_hall_from_a_camera_taken_to_be_turned_as_the_body(self, shared_data: Path):
        """The front-end predicts nothing until it is found, and the filter ends up as good as ever."""
        folder = shared_data / "euroc" / "MH_01_easy_15s"
        dataset = EurocDataset(folder, cameras=["cam0"])
        true = dataset.calibration.cameras[0]
        odometry = Odometry(unknown(dataset.calibration), ShiTomasi(), "msckf")
        steps = pipeline.run(dataset, odometry)
        states = [step.estimate.state for step in steps if step.estimate.state is not None]
        learned = odometry.calibration.cameras[0]
        assert learned.rotation_known
        assert np.rad2deg(np.linalg.norm(so3.log(learned.R_BC.T @ true.R_BC))) < 1.0
        path = Trajectory(*(np.stack(x) for x in zip(*((x.t_ns, x.R_WB, x.p_WB) for x in states), strict=True)))
        errors = evaluate(path, load_trajectory(folder / "mav0/state_groundtruth_estimate0/data.csv"))
        assert errors.coverage > 0.7
        assert errors.ate_m.rmse < 0.015

    def test_at_rest(self, shared_data: Path):
        dataset, incidents = EurocDataset(shared_data / "euroc" / "V1_01_easy_rest", cameras=["cam0"]), Incidents()
        calibration = dataset.calibration
        frontend = Frontend(ShiTomasi(), calibration, FrontendOptions(), incidents)
        packets = synchronise(dataset.measurements(), incidents=incidents)
        tracked = [(imu, frontend.track(imu, frame, calibration)) for imu, frame in packets]
        found, calibrator = calibrate(tracked, calibration)
        assert found is None
        assert "about a second axis" in calibrator.refusal
