"""The initialiser as a whole: on real recordings, on real motion with simulated landmarks, and where it must refuse."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from april_board import april_sequence
from initialization_helpers import Errors, Motion, first_estimate, judge, seen_by, velocity_of, without_points

from vioframe.estimation.initialization import InitialEstimate, Initializer
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.io.synchronise import synchronise
from vioframe.io.trajectories import load_trajectory
from vioframe.simulation import Packet, TrackSequence, real_motion_sequence, simulated_sequence
from vioframe.simulation.scenario import interpolate_poses
from vioframe.types import DP, DTHETA, GRAVITY_M_S2, Calibration
from vioframe_euroc import EurocDataset
from vioframe_shi_tomasi import ShiTomasi

BIAS_GYRO, BIAS_ACCEL = np.array([-0.002, 0.021, 0.077]), np.array([-0.02, 0.13, 0.06])


def tracked(folder: Path, duration_s: float) -> tuple[Calibration, list[Packet]]:
    """The first seconds of a real recording through the front-end."""
    dataset, incidents = EurocDataset(folder, cameras=["cam0"]), Incidents()
    frontend = Frontend(ShiTomasi(), dataset.calibration, FrontendOptions(), incidents)
    packets = synchronise(dataset.measurements(), duration_s=duration_s, incidents=incidents)
    return dataset.calibration, [(imu, frontend.track(imu, frame, dataset.calibration)) for imu, frame in packets]


def motion(trajectory: Trajectory, packets: list[Packet]) -> Motion:
    t_ns = np.array([tracks.t_ns for _, tracks in packets])
    t_ns = t_ns[(t_ns >= trajectory.t_ns[0]) & (t_ns <= trajectory.t_ns[-1])]
    R, p = interpolate_poses(trajectory.t_ns, trajectory.R_WB, trajectory.p_WB, t_ns)
    return Motion(t_ns, R, p, velocity_of(t_ns, p))


def attempt(sequence: TrackSequence, start: int, frames: int) -> tuple[InitialEstimate | None, Errors | None, str]:
    packets = sequence.packets[start : start + frames]
    estimate, initializer = first_estimate(packets, sequence.calibration)
    if estimate is None:
        return None, None, initializer.refusal
    return estimate, judge(estimate, Motion.of(sequence), packets[0][1].t_ns), ""


def assert_sound(estimate: InitialEstimate) -> None:
    """What every back-end may rely on."""
    first, newest = estimate.states[0], estimate.states[-1]
    np.testing.assert_allclose(first.p_WB, 0.0, atol=1e-9)
    np.testing.assert_allclose(first.R_WB, so3.level_rotation(first.R_WB[2]), atol=1e-9)  # yaw zero
    for state in estimate.states:
        np.testing.assert_allclose(state.R_WB @ state.R_WB.T, np.eye(3), atol=1e-9)
    assert [s.t_ns for s in estimate.states] == sorted({s.t_ns for s in estimate.states})
    cov = newest.cov
    assert cov is not None
    np.testing.assert_array_equal(cov, cov.T)
    assert np.linalg.eigvalsh(cov)[0] > 0.0
    yaw = newest.R_WB[2]
    assert np.sqrt(yaw @ cov[DTHETA, DTHETA] @ yaw) < 2e-4
    assert np.sqrt(np.linalg.eigvalsh(cov[DP, DP])[-1]) < 2e-4
    assert len(estimate.landmark_ids) == len(estimate.p_WF)
    assert np.isfinite(estimate.p_WF).all()


class TestRealRecordings:
    def test_moving_from_the_first_frame(self, shared_data: Path):
        folder = shared_data / "euroc" / "MH_01_easy_15s"
        calibration, packets = tracked(folder, 3.0)
        estimate, _ = first_estimate(packets, calibration)
        assert estimate is not None
        assert estimate.method == "dynamic"
        assert_sound(estimate)
        truth = motion(load_trajectory(folder / "mav0/state_groundtruth_estimate0/data.csv"), packets)
        errors = judge(estimate, truth, packets[0][1].t_ns)
        assert errors.seconds < 2.0
        assert errors.velocity < 0.03
        assert errors.tilt_deg < 1.0
        assert abs(errors.scale) < 0.05

    def test_intrinsics_wrong_by_two_pixels_are_survived(self, shared_data: Path):
        folder = shared_data / "euroc" / "MH_01_easy_15s"
        calibration, packets = tracked(folder, 3.0)
        camera = calibration.cameras[0].model
        wrong = replace(camera, fx=camera.fx + 2.0, fy=camera.fy - 2.0, cx=camera.cx - 2.0, cy=camera.cy + 2.0)
        estimate, _ = first_estimate(seen_by(packets, wrong), calibration.with_camera(0, model=wrong))
        assert estimate is not None
        truth = motion(load_trajectory(folder / "mav0/state_groundtruth_estimate0/data.csv"), packets)
        errors = judge(estimate, truth, packets[0][1].t_ns)
        assert errors.velocity < 0.05
        assert errors.tilt_deg < 1.5

    def test_at_rest_with_spinning_rotors(self, shared_data: Path):
        folder = shared_data / "euroc" / "V1_01_easy_rest"
        calibration, packets = tracked(folder, 4.7)
        truth = motion(
            load_trajectory(folder / "mav0/state_groundtruth_estimate0/groundtruth_pose_openvins.txt"), packets
        )
        for start in (0, 25, 50, 70):
            estimate, _ = first_estimate(packets[start:], calibration)
            assert estimate is not None
            assert estimate.method == "static"
            assert_sound(estimate)
            errors = judge(estimate, truth, packets[start][1].t_ns)
            assert errors.seconds < 1.1
            assert errors.tilt_deg < 1.0
            assert errors.velocity < 0.02
            np.testing.assert_allclose(estimate.states[-1].bias_gyro_B, BIAS_GYRO, atol=0.01)

    def test_plane_under_strong_motion(self, shared_data: Path):
        """Every corner lies on one board, where an essential matrix is ambiguous."""
        sequence = april_sequence(shared_data / "euroc_imu_april")
        for start in (0, 100, 200, 300, 400, 500, 600):
            estimate, errors, refusal = attempt(sequence, start, 60)
            assert estimate is not None, refusal
            assert errors is not None
            assert estimate.method == "dynamic"
            assert errors.velocity < 0.1  # the truth's, from poses of single images, is good to 0.05
            assert errors.tilt_deg < 1.5
            assert abs(errors.scale) < 0.08


class TestRealMotion:
    """Simulated landmarks, 1 px of noise, along real flights with their real readings."""

    def test_soon_and_right(self, shared_data: Path):
        sequence = real_motion_sequence(shared_data / "euroc_imu_gt" / "V1_02_medium", duration_s=50.0)
        results = [attempt(sequence, start, 80) for start in range(120, 920, 160)]
        for estimate, errors, refusal in results:
            assert estimate is not None, refusal
            assert errors is not None
            assert_sound(estimate)
            assert errors.velocity < 0.12
            assert errors.tilt_deg < 1.5
            assert abs(errors.scale) < 0.15
        assert 0.2 < np.mean([errors.nees for _, errors, _ in results if errors]) < 2.0

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "name",
        [
            *("MH_05_difficult", "V1_02_medium"),
            *(pytest.param(name, marks=pytest.mark.very_slow) for name in ("MH_02_easy", "MH_03_medium", "V1_01_easy")),
        ],
    )
    def test_never_wrong_wherever_it_starts(self, shared_data: Path, name: str):
        """Started every 9 s along the whole flight. Refusing is right where a vehicle hovers or lands."""
        sequence = real_motion_sequence(shared_data / "euroc_imu_gt" / name)
        truth, accepted = Motion.of(sequence), []
        starts = range(0, len(sequence.packets) - 60, 180)
        for start in starts:
            packets = sequence.packets[start : start + 200]
            estimate, _ = first_estimate(packets, sequence.calibration)
            if estimate is not None:
                accepted.append(judge(estimate, truth, packets[0][1].t_ns))
        assert len(accepted) > 0.8 * len(starts)
        velocity, tilt, scale, nees, seconds = np.array(
            [(e.velocity, e.tilt_deg, abs(e.scale), e.nees, e.seconds) for e in accepted]
        ).T
        assert velocity.max() < 0.15
        assert tilt.max() < 2.5
        assert scale.max() < 0.2
        assert np.median(velocity) < 0.04
        assert np.median(scale) < 0.04
        assert np.median(nees) < 1.3
        assert np.median(seconds) < 3.0


class TestSimulatedFlights:
    @pytest.mark.parametrize("outlier_ratio", [0.0, 0.05])
    @pytest.mark.parametrize("flight", ["figure_eight", "aggressive", "hover"])
    def test_in_motion(self, flight: str, outlier_ratio: float):
        sequence = simulated_sequence(
            flight, duration_s=8.0, outlier_ratio=outlier_ratio, bias_gyro_B=BIAS_GYRO, bias_accel_B=BIAS_ACCEL
        )
        estimate, errors, refusal = attempt(sequence, 0, 160)
        assert estimate is not None, refusal
        assert errors is not None
        assert_sound(estimate)
        assert errors.velocity < 0.1
        assert errors.tilt_deg < 1.5
        assert abs(errors.scale) < 0.1
        assert errors.nees < 3.0
        np.testing.assert_allclose(estimate.states[-1].bias_gyro_B, BIAS_GYRO, atol=0.01)

    def test_the_sooner_the_more_accurate_points_are(self):
        """And as sure of itself as it may be: the noise that sightings count with is what they show."""
        begun_s = []
        for pixel_sigma in (0.05, 1.0):
            sequence = simulated_sequence("figure_eight", seed=3, duration_s=8.0, pixel_sigma=pixel_sigma)
            estimate, errors, refusal = attempt(sequence, 0, 160)
            assert estimate is not None, refusal
            assert errors is not None
            assert errors.nees < 3.0
            begun_s.append(errors.seconds)
        accurate_s, noisy_s = begun_s
        assert accurate_s < 0.8 * noisy_s

    def test_soon_wherever_a_flight_with_fast_turns_begins(self):
        sequence = simulated_sequence("aggressive", seed=50, duration_s=14.0)
        for start in range(0, 220, 20):
            estimate, errors, refusal = attempt(sequence, start, 60)
            assert estimate is not None, (start, refusal)
            assert errors is not None
            assert errors.velocity < 0.2
            assert errors.tilt_deg < 1.5
            assert abs(errors.scale) < 0.05

    def test_landmarks_are_where_they_are(self):
        sequence = simulated_sequence("figure_eight", duration_s=5.0, pixel_sigma=0.2)
        estimate, _, refusal = attempt(sequence, 0, 100)
        assert estimate is not None, refusal
        newest = estimate.states[-1]
        tracks = next(t for _, t in sequence.packets if t.t_ns == newest.t_ns)
        _, a, b = np.intersect1d(estimate.landmark_ids, tracks.ids, return_indices=True)
        camera = estimate.cameras
        assert camera is not None
        model = sequence.calibration.cameras[0].model.with_intrinsics(camera.intrinsics[0])
        p_C = ((estimate.p_WF[a] - newest.p_WB) @ newest.R_WB - camera.p_BC[0]) @ camera.R_BC[0]
        error = np.linalg.norm(model.project(p_C) - tracks.xy[b], axis=1)
        assert len(a) > 30
        assert np.median(error) < 0.5

    @pytest.mark.parametrize("outlier_ratio", [0.0, 0.05])
    def test_at_rest(self, outlier_ratio: float):
        sequence = simulated_sequence(
            "standstill", duration_s=2.0, outlier_ratio=outlier_ratio, bias_gyro_B=BIAS_GYRO, bias_accel_B=BIAS_ACCEL
        )
        estimate, errors, refusal = attempt(sequence, 0, 40)
        assert estimate is not None, refusal
        assert errors is not None
        assert estimate.method == "static"
        assert_sound(estimate)
        assert errors.tilt_deg < np.rad2deg(np.linalg.norm(BIAS_ACCEL) / GRAVITY_M_S2)
        assert errors.nees < 1.0
        np.testing.assert_allclose(estimate.states[-1].bias_gyro_B, BIAS_GYRO, atol=1e-3)

    @pytest.mark.parametrize("flight", ["constant_velocity", "pure_rotation"])
    def test_nothing_is_claimed_where_scale_cannot_be_known(self, flight: str):
        sequence = simulated_sequence(flight, duration_s=5.0, bias_gyro_B=BIAS_GYRO, bias_accel_B=BIAS_ACCEL)
        estimate, _, refusal = attempt(sequence, 0, 100)
        assert estimate is None
        assert "static: not at rest" in refusal


@pytest.fixture(scope="module")
def sequence() -> TrackSequence:
    return simulated_sequence("figure_eight", duration_s=6.0)


class TestBadInput:
    def test_no_tracks(self, sequence: TrackSequence):
        packets = [(imu, without_points(tracks)) for imu, tracks in sequence.packets[:60]]
        estimate, initializer = first_estimate(packets, sequence.calibration)
        assert estimate is None
        assert "dynamic: points were followed through the last 0.0 s alone" in initializer.refusal

    @pytest.mark.parametrize("cameras", [["cam0"], ["cam0", "cam1"]])
    def test_frames_from_before_the_camera_was_black_have_no_part_in_a_start(self, cameras: list[str]):
        calibration = packaged_calibration("euroc", cameras=cameras)
        sequence = simulated_sequence("figure_eight", duration_s=7.0, calibration=calibration)
        begin, end = (20, 24) if len(cameras) == 1 else (4, 8)
        packets = [
            (imu, without_points(tracks) if begin <= k < end else replace(tracks, ids=2 * tracks.ids + (k < begin)))
            for k, (imu, tracks) in enumerate(sequence.packets)
        ]
        estimate, _ = first_estimate(packets, calibration)
        alone, _ = first_estimate(packets[end:], calibration)
        assert estimate is not None
        assert alone is not None
        assert estimate.method == alone.method == ("dynamic" if len(cameras) == 1 else "stereo")
        assert_sound(estimate)
        assert estimate.states[0].t_ns >= packets[end][1].t_ns
        assert estimate.states[-1].t_ns <= alone.states[-1].t_ns + 0.3e9
        assert judge(estimate, Motion.of(sequence), packets[0][1].t_ns).velocity < 0.1

    def test_a_third_camera_that_sees_nothing_of_the_others_and_takes_turns_does_not_hold_stereo_up(self):
        two = packaged_calibration("euroc")
        third = replace(two.cameras[0], name="cam2", R_BC=two.cameras[0].R_BC @ so3.exp([0.0, np.pi, 0.0]))
        calibration = replace(two, cameras=(*two.cameras, third))
        sequence = simulated_sequence("figure_eight", duration_s=2.0, calibration=calibration)
        turns = ([0, 1], [2])
        packets = [
            (imu, tracks.only(np.isin(tracks.camera, turns[k % 2]))) for k, (imu, tracks) in enumerate(sequence.packets)
        ]
        estimate, _ = first_estimate(packets, calibration)
        assert estimate is not None
        assert estimate.method == "stereo"

    def test_points_that_cannot_be_undistorted_are_left_out(self, sequence: TrackSequence):
        packets = []
        for imu, tracks in sequence.packets:
            xy = tracks.xy_normalised.copy()
            xy[::7] = np.nan
            packets.append((imu, replace(tracks, xy_normalised=xy)))
        estimate, _ = first_estimate(packets, sequence.calibration)
        assert estimate is not None
        assert judge(estimate, Motion.of(sequence), packets[0][1].t_ns).velocity < 0.1

    def test_a_gap_in_the_readings_begins_the_window_anew(self, sequence: TrackSequence):
        clean, _ = first_estimate(sequence.packets, sequence.calibration)
        assert clean is not None
        gap_at = 20
        imu, tracks = sequence.packets[gap_at]
        packets = [*sequence.packets]
        packets[gap_at] = (replace(imu, largest_gap_s=0.5), tracks)
        estimate, _ = first_estimate(packets, sequence.calibration)
        assert estimate is not None
        assert estimate.states[0].t_ns >= tracks.t_ns
        assert clean.states[0].t_ns < tracks.t_ns

    def test_tracks_that_jump_to_other_features_are_refused(self, sequence: TrackSequence):
        rng = np.random.default_rng(0)
        packets = [(imu, replace(tracks, ids=rng.permutation(tracks.ids))) for imu, tracks in sequence.packets]
        estimate, initializer = first_estimate(packets, sequence.calibration)
        assert estimate is None
        assert "dynamic: " in initializer.refusal

    def test_readings_of_another_flight_are_refused(self, sequence: TrackSequence):
        other = simulated_sequence("aggressive", duration_s=6.0)
        packets = [(imu, tracks) for (imu, _), (_, tracks) in zip(other.packets, sequence.packets, strict=True)]
        estimate, _ = first_estimate(packets, sequence.calibration)
        assert estimate is None

    def test_each_attempt_is_logged_and_reset_forgets(self, sequence: TrackSequence, caplog: pytest.LogCaptureFixture):
        initializer = Initializer(sequence.calibration)
        with caplog.at_level(logging.DEBUG, "vioframe.estimation.initialization"):
            assert any(initializer.add(imu, tracks) is not None for imu, tracks in sequence.packets)
        assert initializer.refusal == ""
        assert any("static refused: not at rest" in message for message in caplog.messages)
        assert any("dynamic initialisation accepted" in message for message in caplog.messages)
        initializer.reset()
        assert all(initializer.add(imu, tracks) is None for imu, tracks in sequence.packets[:25])
