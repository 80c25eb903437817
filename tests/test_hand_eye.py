"""What is wrong between camera and gyroscope: exact on exact data, found soon and right, refused where unclear."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from initialization_helpers import Motion, judge, seen_by, without_points

from vioframe import pipeline
from vioframe.errors import ConfigError
from vioframe.estimation.hand_eye import HandEye, Turns
from vioframe.estimation.initialization import Initializer
from vioframe.estimation.initialization.found import Found
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.turns import likeliest_translations, linearise_pairs, turn_between, turns_before_plane
from vioframe.evaluation import evaluate
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.io.trajectories import load_trajectory
from vioframe.odometry import Odometry
from vioframe.simulation import Packet, TrackSequence, simulated_sequence
from vioframe.simulation.flights import ShapedFlight, levelled
from vioframe.types import NS_PER_S, Calibration, Estimate, Float, FrameTracks, ImuSample, NavState, Status
from vioframe_euroc import EurocDataset
from vioframe_msckf.backend import Msckf
from vioframe_shi_tomasi import ShiTomasi

EUROC = packaged_calibration("euroc", cameras=["cam0"])
BIAS_GYRO = np.array([-0.002, 0.021, 0.077])
FLIGHTS = ["figure_eight", "aggressive", "stop_and_go", "pure_rotation"]
EUROC_LEVEL = levelled(EUROC.cameras[0].R_BC)
SIGMA = 1.0 / EUROC.cameras[0].model.focal_px


def turned(calibration: Calibration, R_BC: Float | None = None) -> Calibration:
    """The calibration with the camera turned some other way: as the body unless ``R_BC`` says how."""
    return calibration.with_camera(0, R_BC=np.eye(3) if R_BC is None else R_BC)


def unknown(calibration: Calibration) -> Calibration:
    """The calibration of which nobody knows how the camera is turned."""
    return calibration.with_camera(0, R_BC=np.eye(3), rotation_known=False)


def late(calibration: Calibration, offset_ms: float) -> Calibration:
    """The calibration with a time offset that is not the sensors' own."""
    return calibration.with_camera(0, time_offset_ns=round(offset_ms * 1e6))


def find(packets: Sequence[Packet], calibration: Calibration) -> tuple[Found | None, Initializer]:
    """What the initialiser finds first; readings are those of ``calibration``'s time offset."""
    initializer = Initializer(calibration)
    for imu, tracks in packets:
        initializer.add(imu, tracks)
        if initializer.found is not None:
            break
    return initializer.found, initializer


def shifted(packets: Sequence[Packet], offset_ms: float) -> list[Packet]:
    """The packets with the readings of a moment later by ``offset_ms``, stamped as if they were not: whole samples."""
    period_ns, offset_ns = 5_000_000, round(offset_ms * 1e6)
    assert offset_ns % period_ns == 0
    t_ns = np.concatenate([imu.t_ns for imu, _ in packets])
    _, once = np.unique(t_ns, return_index=True)
    gyro, accel = (np.concatenate([getattr(imu, name) for imu, _ in packets])[once] for name in ("gyro_B", "accel_B"))
    t_ns = t_ns[once]
    out = []
    for imu, tracks in packets:
        if t_ns[0] <= imu.t_ns[0] + offset_ns and imu.t_ns[-1] + offset_ns <= t_ns[-1]:
            at = np.searchsorted(t_ns, imu.t_ns + offset_ns)
            out.append((replace(imu, gyro_B=gyro[at], accel_B=accel[at]), tracks))
    return out


def error_deg(found: Found | None, calibration: Calibration) -> float:
    assert found is not None
    R_BC, true = found.calibration.cameras[0].R_BC, calibration.cameras[0].R_BC
    return float(np.rad2deg(np.linalg.norm(so3.log(R_BC.T @ true))))


def yawing(t_s: Float) -> Float:
    """A whole radian to and fro, and nothing about the other two axes."""
    return np.column_stack([np.sin(t_s), np.zeros_like(t_s), np.zeros_like(t_s)])


def swaying(t_s: Float) -> Float:
    return np.column_stack([np.sin(1.3 * t_s), np.cos(1.7 * t_s), 0.3 * np.sin(0.8 * t_s)])


class TestTurns:
    def test_a_few_steps_bring_a_rotation_back_on_exact_data(self):
        rng = np.random.default_rng(0)
        f, g, common, R_12 = random_pairs(rng)
        R, weight, distance = (
            R_12 @ so3.exp(0.02 * rng.normal(size=(len(R_12), 3))),
            common * 1.0,
            np.zeros(f.shape[:2]),
        )
        for _ in range(20):
            H, b = linearise_pairs(f, g, common, R, weight, 1e-3, 1e6, distance)
            R = R @ so3.exp(-np.linalg.solve(H[:, :3, :3], b[:, :3, None])[..., 0])
        np.testing.assert_allclose(R, R_12, atol=1e-9)

    def test_the_likeliest_translation_lies_in_every_epipolar_plane(self):
        f, g, common, R_12 = random_pairs(np.random.default_rng(1))
        y = g @ np.swapaxes(R_12, -1, -2)
        common[0] = False
        t = likeliest_translations(f, y, R_12, np.ones(common.shape), common)
        off = (np.cross(f, y) @ t[..., None])[..., 0]
        np.testing.assert_allclose(off[common], 0.0, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1.0)
        np.testing.assert_array_equal(t[0], [0.0, 0.0, 1.0])  # where nothing tells

    def test_small_parallax_does_not_pull_the_rotation(self):
        """Motion of a pixel or two under a pixel of noise: the mean over many pairs is still the truth."""
        rng = np.random.default_rng(2)
        f, g, common, R_12 = random_pairs(rng, count=400, tracks=60, baseline=0.03, sigma=SIGMA)
        R, weight, distance = R_12, common * 1.0, np.zeros(f.shape[:2])
        for _ in range(30):
            H, b = linearise_pairs(f, g, common, R, weight, SIGMA, 1e6, distance)
            R = R @ so3.exp(-np.linalg.solve(H[:, :3, :3] + 1e4 * np.eye(3), b[:, :3, None])[..., 0])
        off = so3.log(np.swapaxes(R_12, -1, -2) @ R)
        assert np.all(np.abs(off.mean(axis=0)) < 4.0 * off.std(axis=0) / np.sqrt(len(off)))

    def test_a_longer_focal_length_turns_it_as_its_equations_say(self):
        s = simulated_sequence("figure_eight", noise=None, pixel_sigma=0.0, duration_s=2.0)
        frames = [tracks for _, tracks in s.packets]
        step = 1e-3
        for before, now in zip(frames[5:30:5], frames[9:34:5], strict=True):
            turn = turn_between(before, now, SIGMA)
            longer = turn_between(scaled(before, 1.0 - step), scaled(now, 1.0 - step), SIGMA)
            assert turn is not None
            assert longer is not None
            predicted = -np.linalg.solve(turn.H[:3, :3], turn.H[:3, 3])
            numeric = so3.log(turn.R_C1C2.T @ longer.R_C1C2) / step
            np.testing.assert_allclose(predicted, numeric, atol=0.02 * np.linalg.norm(numeric) + 1e-4)

    def test_too_few_tracks_say_nothing(self):
        s = simulated_sequence("figure_eight", duration_s=1.0)
        a, b = s.packets[0][1], s.packets[4][1]
        assert turn_between(a, without_points(b), SIGMA) is None


def turn_a_little(rng: np.random.Generator, R: Float) -> Float:
    return R @ so3.exp(0.02 * rng.normal(size=(len(R), 3)))


def before_a_wall(s: TrackSequence, sigma_px: float = 0.3) -> list[Packet]:
    """The packets of a camera that sees a wall 3 m before where it begins, and nothing else."""
    rng, (camera,), out = np.random.default_rng(0), s.calibration.cameras, []
    first = s.true_states[0]
    p_CF = np.column_stack([rng.uniform([-4.0, -3.0], [4.0, 3.0], (300, 2)), np.full(300, 3.0)])
    p_WF = (p_CF @ camera.R_BC.T + camera.p_BC) @ first.R_WB.T + first.p_WB
    for true, (imu, tracks) in zip(s.true_states, s.packets, strict=True):
        p_C = ((p_WF - true.p_WB) @ true.R_WB - camera.p_BC) @ camera.R_BC
        ids = np.flatnonzero((p_C[:, 2] > 0.3) & (np.abs(p_C[:, :2]) < 0.7 * p_C[:, 2:]).all(axis=1))
        xy = camera.model.project(p_C[ids]) + sigma_px * rng.normal(size=(len(ids), 2))
        ids, xy = ids[camera.model.contains(xy)], xy[camera.model.contains(xy)]
        seen = FrameTracks(tracks.t_ns, ids, np.zeros_like(ids), xy, camera.model.undistort(xy))
        out.append((imu, seen))
    return out


def scaled(tracks: FrameTracks, factor: float) -> FrameTracks:
    return replace(tracks, xy_normalised=factor * tracks.xy_normalised)


def random_pairs(
    rng: np.random.Generator, count: int = 5, tracks: int = 40, baseline: float = 0.5, sigma: float = 0.0
) -> tuple[Float, Float, Float, Float]:
    """Bearings (P, N, 3) of landmarks 2 to 8 m deep in pairs of views, which are in both, and R_C1C2 (P, 3, 3)."""
    xy_1 = rng.uniform([-0.7, -0.45], [0.7, 0.45], (count, tracks, 2))
    depth = rng.uniform(2.0, 8.0, (count, tracks, 1))
    R_12, p_12 = so3.exp(0.1 * rng.normal(size=(count, 3))), baseline * rng.normal(size=(count, 1, 3))
    p_1 = np.concatenate([xy_1, np.ones((count, tracks, 1))], axis=2) * depth
    p_2 = (p_1 - p_12) @ R_12
    f, g = (np.concatenate([p[..., :2] / p[..., 2:], np.ones(depth.shape)], axis=2) for p in (p_1, p_2))
    f, g = (v + sigma * rng.normal(size=v.shape) * [1.0, 1.0, 0.0] for v in (f, g))
    return f, g, p_2[..., 2] > 0.1, R_12


class TestPlanes:
    @pytest.mark.parametrize("seed", range(5))
    def test_two_views_of_a_plane_allow_of_two_turns_and_one_of_them_it_was(self, seed: int):
        rng = np.random.default_rng(seed)
        normal = so3.exp(0.3 * rng.normal(size=3))[:, 2]
        f = np.column_stack([rng.uniform(-0.6, 0.6, (60, 2)), np.ones(60)])
        p_1 = f * (4.0 / (f @ normal))[:, None]
        R_12, p_12 = so3.exp(0.15 * rng.normal(size=3)), rng.normal(size=3)
        p_2 = (p_1 - p_12) @ R_12
        g = p_2 / p_2[:, 2:]
        both = turns_before_plane(f, g, SIGMA)
        assert len(both) == 2
        off = sorted(float(np.linalg.norm(so3.log(R.T @ R_12))) for R in both)
        assert off[0] < 2e-3
        assert off[1] > 0.01
        # Outliers do not hide it.
        wrong = g.copy()
        wrong[::4, :2] += 0.05 * rng.normal(size=(15, 2))
        off = sorted(float(np.linalg.norm(so3.log(R.T @ R_12))) for R in turns_before_plane(f, wrong, SIGMA))
        assert off[0] < 0.01
        # Points before and behind it leave one.
        p_2 = (p_1 * rng.uniform(0.7, 1.3, (60, 1)) - p_12) @ R_12
        assert not turns_before_plane(f, p_2 / p_2[:, 2:], SIGMA)

    def test_the_gyroscope_tells_which(self):
        flight = ShapedFlight(8.0, lambda t: 0.6 * swaying(t), lambda t: 0.3 * swaying(t + 2.0), EUROC_LEVEL)
        s = simulated_sequence(flight, bias_gyro_B=BIAS_GYRO)
        wall = before_a_wall(s)
        found, initializer = find(shifted(wall, 100.0), s.calibration)
        assert found is not None, initializer.refusal
        assert abs(found.calibration.cameras[0].time_offset_ns + 100e6) < 12e6
        found, initializer = find(wall, unknown(s.calibration))
        assert found is not None, initializer.refusal
        assert error_deg(found, s.calibration) < 3.0


class TestHandEye:
    def turns(self, **options: float) -> tuple[Turns, TrackSequence]:
        s = simulated_sequence("figure_eight", noise=None, duration_s=4.0, bias_gyro_B=BIAS_GYRO, **options)
        frames = [tracks for _, tracks in s.packets]
        pairs = [turn_between(a, b, SIGMA) for a, b in zip(frames, frames[4:], strict=False)]
        imu = [reading for reading in s.measurements() if isinstance(reading, ImuSample)]
        t_ns, gyro = np.array([r.t_ns for r in imu]), np.stack([r.gyro_B for r in imu])
        return Turns([pair for pair in pairs if pair is not None], t_ns, gyro), s

    def test_jacobian_is_that_of_differences(self):
        turns, s = self.turns(pixel_sigma=1.0)
        x = HandEye(
            np.array([0.02, -0.01, 0.03]), s.calibration.cameras[0].R_BC @ so3.exp([0.02, 0.01, -0.03]), 0.013, 0.02
        )
        _, J, _ = turns._linearise(x)
        for k in range(8):
            step = np.zeros(8)
            step[k] = 1e-5
            a, b = (
                HandEye(
                    x.bias_gyro_B + sign * step[:3],
                    x.R_BC @ so3.exp(sign * step[3:6]),
                    x.offset_s + sign * step[6],
                    x.log_focal + sign * step[7],
                )
                for sign in (1.0, -1.0)
            )
            numeric = (turns._linearise(a)[0] - turns._linearise(b)[0]) / 2e-5
            # Taken at small residuals and short turns: it leads to the minimum, and says how sure it is.
            assert np.linalg.norm(numeric - J[:, :, k]) < 0.12 * np.linalg.norm(numeric)

    def test_all_of_it_comes_out_on_exact_data(self):
        turns, s = self.turns(pixel_sigma=0.0)
        R_BC = s.calibration.cameras[0].R_BC
        start = HandEye(np.zeros(3), R_BC @ so3.exp([0.1, -0.05, 0.08]), 0.02, 0.0)
        found, _ = turns.fit(start, ("rotation", "offset", "focal"))
        np.testing.assert_allclose(found.bias_gyro_B, BIAS_GYRO, atol=1e-3)
        assert np.rad2deg(np.linalg.norm(so3.log(R_BC.T @ found.R_BC))) < 0.1
        assert abs(found.offset_s) < 2e-4
        assert abs(found.log_focal) < 2e-3

    def test_a_grid_finds_any_rotation_and_a_far_offset(self):
        turns, s = self.turns(pixel_sigma=1.0)
        near = turns.nearest(HandEye(np.zeros(3), so3.exp([1.0, 2.0, -0.5])), turned=True)
        assert abs(near.offset_s) < 0.021
        assert np.rad2deg(np.linalg.norm(so3.log(s.calibration.cameras[0].R_BC.T @ near.R_BC))) < 3.0


class TestFound:
    @pytest.mark.parametrize("flight", [*FLIGHTS, "inspection"])
    def test_a_camera_that_nobody_knows_how_it_is_turned(self, flight: str):
        s = simulated_sequence(flight, duration_s=12.0, bias_gyro_B=BIAS_GYRO)
        found, initializer = find(s.packets, unknown(s.calibration))
        assert found is not None, initializer.refusal
        assert error_deg(found, s.calibration) < 3.0
        assert found.rotation_sigma is not None
        assert np.deg2rad(error_deg(found, s.calibration)) < 4.0 * found.rotation_sigma

    @pytest.mark.parametrize("seed", range(3))
    def test_any_mounting(self, seed: int):
        R_BC = so3.exp(np.random.default_rng(seed).uniform(-1.8, 1.8, 3))
        s = simulated_sequence("figure_eight", duration_s=8.0, calibration=turned(EUROC, R_BC), bias_gyro_B=BIAS_GYRO)
        found, _ = find(s.packets, unknown(s.calibration))
        assert error_deg(found, s.calibration) < 3.0

    def test_what_the_calibration_says_of_an_unknown_rotation_plays_no_part(self):
        s = simulated_sequence("aggressive", duration_s=4.0)
        one, _ = find(s.packets, unknown(s.calibration))
        other, _ = find(s.packets, turned(unknown(s.calibration), so3.exp([1.0, -2.0, 0.5])))
        assert one is not None
        assert other is not None
        a, b = (found.calibration.cameras[0].R_BC for found in (one, other))
        assert np.rad2deg(np.linalg.norm(so3.log(a.T @ b))) < 0.01

    @pytest.mark.parametrize("degrees", [10.0, 90.0])
    def test_a_rotation_given_wrong(self, degrees: float):
        s = simulated_sequence("figure_eight", duration_s=8.0, bias_gyro_B=BIAS_GYRO)
        wrong = s.calibration.cameras[0].R_BC @ so3.exp(np.deg2rad(degrees) * np.array([0.6, 0.64, 0.48]))
        found, _ = find(s.packets, turned(s.calibration, wrong))
        assert error_deg(found, s.calibration) < 3.0

    @pytest.mark.parametrize("offset_ms", [-100.0, -30.0, 30.0, 100.0])
    def test_a_time_offset_given_wrong(self, offset_ms: float):
        s = simulated_sequence("aggressive", duration_s=6.0, bias_gyro_B=BIAS_GYRO)
        found, _ = find(shifted(s.packets, offset_ms), s.calibration)
        assert found is not None
        assert found.offset_sigma_s is not None
        error_s = 1e-9 * found.calibration.cameras[0].time_offset_ns + 1e-3 * offset_ms
        assert abs(error_s) < min(0.006, 4.0 * found.offset_sigma_s)
        assert found.rotation_sigma is None

    @pytest.mark.parametrize("percent", [-10.0, 10.0])
    def test_a_focal_length_given_wrong(self, percent: float):
        s = simulated_sequence("figure_eight", duration_s=8.0, pixel_sigma=0.5, bias_gyro_B=BIAS_GYRO)
        true = s.calibration.cameras[0].model
        wrong = true.zoomed(1.0 + percent / 100.0)
        found, _ = find(seen_by(s.packets, wrong), s.calibration.with_camera(0, model=wrong))
        assert found is not None
        assert abs(found.calibration.cameras[0].model.fx / true.fx - 1.0) < 0.04

    @pytest.mark.parametrize("flight", ["aggressive", "inspection", "hover"])
    def test_nothing_where_all_is_as_given(self, flight: str):
        s = simulated_sequence(flight, duration_s=8.0, outlier_ratio=0.05, bias_gyro_B=BIAS_GYRO)
        initializer = Initializer(s.calibration)
        for imu, tracks in s.packets:
            if initializer.add(imu, tracks) is not None:
                initializer.reset()
        assert initializer.found is None


class TestRefusals:
    def test_turns_about_one_axis(self):
        flight = ShapedFlight(10.0, swaying, yawing, levelled(EUROC.cameras[0].R_BC))
        s = simulated_sequence(flight, bias_gyro_B=BIAS_GYRO)
        found, initializer = find(s.packets, unknown(s.calibration))
        assert found is None
        assert "turn about two axes" in initializer.refusal

    @pytest.mark.parametrize("flight", ["standstill", "constant_velocity"])
    def test_no_turns(self, flight: str):
        s = simulated_sequence(flight, duration_s=6.0, bias_gyro_B=BIAS_GYRO)
        found, initializer = find(s.packets, unknown(s.calibration))
        assert found is None
        assert "turn about two axes" in initializer.refusal

    def test_readings_of_another_flight(self):
        tracks, imu = (simulated_sequence(name, duration_s=8.0) for name in ("figure_eight", "aggressive"))
        packets = [(i, t) for (i, _), (_, t) in zip(imu.packets, tracks.packets, strict=True)]
        found, initializer = find(packets, unknown(EUROC))
        assert found is None
        assert initializer.refusal

    def test_tracks_that_jump_to_other_features(self):
        rng, s = np.random.default_rng(0), simulated_sequence("figure_eight", duration_s=8.0)
        packets = [(imu, replace(tracks, ids=rng.permutation(tracks.ids))) for imu, tracks in s.packets]
        found, initializer = find(packets, unknown(s.calibration))
        assert found is None
        assert initializer.refusal

    def test_no_tracks(self):
        s = simulated_sequence("aggressive", duration_s=4.0)
        found, initializer = find([(imu, without_points(t)) for imu, t in s.packets], unknown(s.calibration))
        assert found is None
        assert "points were followed through the last 0.0 s alone" in initializer.refusal


class TestBadInput:
    def test_points_that_cannot_be_undistorted_are_left_out(self):
        s = simulated_sequence("aggressive", duration_s=4.0)
        packets = []
        for imu, tracks in s.packets:
            xy = tracks.xy_normalised.copy()
            xy[::7] = np.nan
            packets.append((imu, replace(tracks, xy_normalised=xy)))
        found, _ = find(packets, unknown(s.calibration))
        assert error_deg(found, s.calibration) < 3.0

    def test_a_gap_in_the_readings_begins_anew(self):
        s = simulated_sequence("aggressive", duration_s=6.0)
        packets, gap_at = list(s.packets), 25
        imu, tracks = packets[gap_at]
        # What was read over the gap is wrong, and must not be used.
        packets[gap_at] = (replace(imu, gyro_B=imu.gyro_B + 5.0, largest_gap_s=0.5), tracks)
        found, _ = find(packets[:50], unknown(s.calibration))
        assert found is None
        found, _ = find(packets, unknown(s.calibration))
        assert error_deg(found, s.calibration) < 3.0


class TestInitializer:
    def test_begins_once_the_rotation_is_found(self, caplog: pytest.LogCaptureFixture):
        s = simulated_sequence("aggressive", duration_s=10.0, bias_gyro_B=BIAS_GYRO)
        initializer = Initializer(unknown(s.calibration))
        with caplog.at_level(logging.INFO, "vioframe.estimation.initialization"):
            for imu, tracks in s.packets:
                estimate = initializer.add(imu, tracks)
                if estimate is not None:
                    break
        assert estimate is not None, initializer.refusal
        assert judge(estimate, Motion.of(s), s.packets[0][1].t_ns).velocity < 0.1
        found = initializer.found
        assert error_deg(found, s.calibration) < 3.0
        assert found is not None
        assert any(str(found) in message for message in caplog.messages)
        np.testing.assert_array_equal(initializer.calibration.cameras[0].p_BC, s.calibration.cameras[0].p_BC)

    def test_waits_at_rest_and_says_why(self):
        s = simulated_sequence("standstill", duration_s=4.0, bias_gyro_B=BIAS_GYRO)
        initializer = Initializer(unknown(s.calibration))
        assert all(initializer.add(imu, tracks) is None for imu, tracks in s.packets)
        assert "rotation on the body" in initializer.refusal

    def test_what_was_found_outlives_a_reset(self):
        s = simulated_sequence("aggressive", duration_s=5.0)
        found, initializer = find(s.packets, unknown(s.calibration))
        initializer.reset()
        assert found is not None
        assert initializer.found is found
        at_rest = simulated_sequence("standstill", duration_s=2.0)
        assert any(initializer.add(imu, tracks) is not None for imu, tracks in at_rest.packets)


def fly(sequence: TrackSequence, calibration: Calibration, backend: str = "msckf") -> list[Estimate]:
    """Estimates of a back-end that takes ``calibration`` for that of the sequence."""
    odometry = Odometry(calibration, ShiTomasi(), backend, wait_ms=0.0)
    steps = []
    for measured in sequence.measurements():
        steps += odometry.add_tracks(measured) if isinstance(measured, FrameTracks) else odometry.add(measured)
    return [step.estimate for step in [*steps, *odometry.finish()]]


def flown(estimates: Sequence[Estimate]) -> Trajectory:
    states = [e.state for e in estimates if e.state is not None]
    return Trajectory(*(np.stack(x) for x in zip(*((x.t_ns, x.R_WB, x.p_WB) for x in states), strict=True)))


@cache
def lively_flight() -> TrackSequence:
    return simulated_sequence("aggressive", duration_s=12.0, bias_gyro_B=BIAS_GYRO)


@cache
def clean_ate_m() -> float:
    """The error on the same flight with nothing wrong."""
    s = lively_flight()
    return evaluate(flown(fly(s, s.calibration)), s.ground_truth).ate_m.rmse


class TestFlights:
    @pytest.mark.parametrize(("backend", "offset_ms"), [("msckf", -100.0), ("sliding_window", 60.0)])
    def test_flies_with_a_time_offset_that_is_not_given(self, backend: str, offset_ms: float):
        """The offset that is found goes back to where readings and frames are brought together."""
        s = lively_flight()
        # Stamps of the readings that are late by so much: t_imu = t_cam + offset.
        moved = replace(s, calibration=late(s.calibration, offset_ms))
        estimates = fly(moved, s.calibration, backend)
        assert Status.LOST not in {e.status for e in estimates}
        assert any("time offset" in event for e in estimates for event in e.events)
        learned = [e.calibration for e in estimates if e.calibration is not None][-1].calibration.cameras[0]
        assert abs(learned.time_offset_ns / NS_PER_S - 1e-3 * offset_ms) < 0.003
        assert evaluate(flown(estimates), s.ground_truth).ate_m.rmse < 2.0 * clean_ate_m() + 0.02

    def test_flies_with_a_camera_mounted_unknown(self):
        s = lively_flight()
        estimates = fly(s, unknown(s.calibration))
        assert Status.LOST not in {e.status for e in estimates}
        assert any("camera's rotation on the body" in event for e in estimates for event in e.events)
        errors = evaluate(flown(estimates), s.ground_truth)
        assert errors.coverage > 0.7
        assert errors.ate_m.rmse < 0.15

    def test_a_start_from_a_known_state_does_not_go_with_an_unknown_camera(self):
        s = simulated_sequence("aggressive", duration_s=1.0)
        start: NavState = replace(s.true_states[0], cov=np.eye(15))
        with pytest.raises(ConfigError, match="whose rotation on the body is known"):
            LifeCycle(Msckf(), unknown(s.calibration), initial_state=start)


class TestRealRecordings:
    @pytest.mark.parametrize(
        "fault",
        [
            "offset 60 ms",
            "focal length 10 %",
            *(pytest.param(fault, marks=pytest.mark.very_slow) for fault in ("rotation unknown", "rotation 10 deg")),
        ],
    )
    def test_machine_hall_starts_and_flies_as_if_it_were_right(self, shared_data: Path, fault: str):
        folder = shared_data / "euroc" / "MH_01_easy_15s"
        dataset = EurocDataset(folder, cameras=["cam0"])
        true = dataset.calibration.cameras[0]
        wrong = {
            "rotation unknown": unknown(dataset.calibration),
            "rotation 10 deg": turned(dataset.calibration, true.R_BC @ so3.exp([0.1, -0.1, 0.1])),
            "offset 60 ms": late(dataset.calibration, 60.0),
            "focal length 10 %": dataset.calibration.with_camera(0, model=true.model.zoomed(1.1)),
        }[fault]
        odometry = Odometry(wrong, ShiTomasi(), "msckf")
        estimates = [step.estimate for step in pipeline.run(dataset, odometry, duration_s=8.0)]
        learned = odometry.calibration.cameras[0]
        assert np.rad2deg(np.linalg.norm(so3.log(learned.R_BC.T @ true.R_BC))) < 1.0
        assert abs(learned.time_offset_ns - true.time_offset_ns) < 2e6
        assert abs(learned.model.fx / true.model.fx - 1.0) < 0.01
        assert Status.LOST not in {e.status for e in estimates}
        truth = load_trajectory(folder / "mav0/state_groundtruth_estimate0/data.csv")
        assert evaluate(flown(estimates), truth).ate_m.rmse < 0.015

    def test_at_rest_with_a_camera_mounted_unknown(self, shared_data: Path):
        dataset = EurocDataset(shared_data / "euroc" / "V1_01_easy_rest", cameras=["cam0"])
        steps = list(pipeline.run(dataset, Odometry(unknown(dataset.calibration), ShiTomasi(), "msckf")))
        assert all(step.estimate.state is None for step in steps)
        assert "turn about two axes" in steps[-1].estimate.events[0]
