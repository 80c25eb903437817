"""A start by two cameras that see the same: at once, at rest and in motion, with the scale, as sure as it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from initialization_helpers import Motion, first_estimate, judge
from msckf_helpers import CALIBRATION, STEREO
from test_initialization import assert_sound, motion

from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.estimation.initialization import Initializer
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.geometry import so3
from vioframe.incidents import Incidents
from vioframe.io.synchronise import synchronise
from vioframe.io.trajectories import load_trajectory
from vioframe.simulation import Packet, TrackSequence, simulated_sequence
from vioframe.types import Calibration
from vioframe_euroc import EurocDataset
from vioframe_shi_tomasi import ShiTomasi

FLIGHTS = ["figure_eight", "aggressive", "stop_and_go", "hover"]


def flown(flight: str, seed: int = 0, calibration: Calibration = STEREO, frame_rate_hz: float = 20.0) -> TrackSequence:
    return simulated_sequence(flight, duration_s=6.0, seed=seed, calibration=calibration, frame_rate_hz=frame_rate_hz)


def in_turns(sequence: TrackSequence) -> list[Packet]:
    """Each camera sees every other frame, the left one the first."""
    return [(imu, tracks.of_camera(k % 2)) for k, (imu, tracks) in enumerate(sequence.packets)]


@pytest.mark.parametrize("flight", FLIGHTS)
def test_it_begins_within_six_tenths_of_a_second_and_is_as_sure_as_it_says(flight):
    """Wherever in the flight it begins; velocity and tilt have five degrees of freedom."""
    nees = []
    for seed in range(2):
        sequence = flown(flight, seed)
        for start in range(0, 96, 16):
            packets = sequence.packets[start : start + 20]
            estimate, _ = first_estimate(packets, STEREO)
            assert estimate is not None
            assert estimate.method == "stereo"
            assert_sound(estimate)
            errors = judge(estimate, Motion.of(sequence), packets[0][1].t_ns)
            assert errors.seconds < 0.65
            assert errors.velocity < 0.3
            nees.append(errors.nees)
    assert 0.1 < np.mean(nees) < 1.5
    assert max(nees) < 5.0


@pytest.mark.parametrize("flight", ["figure_eight", "stop_and_go", "hover"])
def test_cameras_that_take_turns_begin_as_soon_with_the_scale(flight):
    """25 ms apart: how far the body flies meanwhile is found, too."""
    nees, scale = [], []
    for seed in range(2):
        sequence = flown(flight, seed, frame_rate_hz=40.0)
        packets = in_turns(sequence)
        for start in range(0, 160, 32):
            estimate, _ = first_estimate(packets[start : start + 32], STEREO)
            assert estimate is not None
            assert estimate.method == "stereo"
            assert_sound(estimate)
            errors = judge(estimate, Motion.of(sequence), packets[start][1].t_ns)
            assert errors.seconds < 0.65
            assert errors.velocity < 0.15
            nees.append(errors.nees)
            scale.append(abs(errors.scale))
    assert 0.1 < np.mean(nees) < 1.5
    assert max(nees) < 5.0
    assert np.median(scale) < 0.06


def test_cameras_that_take_turns_in_a_flight_too_fast_for_that_begin_by_the_first_one():
    """At 5 m/s the body flies more than the baseline meanwhile: what is assumed at first may be too far off."""
    estimate, _ = first_estimate(in_turns(flown("aggressive", frame_rate_hz=40.0))[96:176], STEREO)
    assert estimate is not None
    assert estimate.method == "dynamic"
    assert_sound(estimate)


def test_landmarks_are_where_they_are():
    sequence = flown("figure_eight", 1)
    estimate, _ = first_estimate(sequence.packets[:20], STEREO)
    assert estimate is not None
    assert len(estimate.landmark_ids) > 25
    # Far less parallax than one camera would need: the same frames refuse without the other one.
    alone = [(imu, tracks.of_camera(0)) for imu, tracks in sequence.packets[:20]]
    assert first_estimate(alone, CALIBRATION)[0] is None
    newest, camera = estimate.states[-1], STEREO.cameras[0]
    tracks = next(tracks for _, tracks in sequence.packets if tracks.t_ns == newest.t_ns).of_camera(0)
    _, i, j = np.intersect1d(estimate.landmark_ids, tracks.ids, return_indices=True)
    p_C = ((estimate.p_WF[i] - newest.p_WB) @ newest.R_WB - camera.p_BC) @ camera.R_BC
    off_px = np.linalg.norm(camera.model.project(p_C) - tracks.xy[j], axis=1)
    assert np.median(off_px) < 2.0


@pytest.mark.parametrize("turned_deg", [8.0, 90.0])
def test_cameras_that_sit_otherwise_are_left_to_the_slower_start(turned_deg):
    """The first camera turned, and the other with it: images and readings contradict each other where it turns."""
    sequence = flown("aggressive", 2)
    turn = so3.exp(np.deg2rad(turned_deg) * np.array([0.6, -0.5, 0.62]))
    wrong = STEREO.moved_with(replace(STEREO.cameras[0], R_BC=turn @ STEREO.cameras[0].R_BC))
    estimate, initializer = first_estimate(sequence.packets[:40], wrong)
    assert estimate is None or initializer.found is not None
    estimate, initializer = first_estimate(sequence.packets, wrong)
    assert estimate is not None
    left = so3.log(initializer.calibration.cameras[0].R_BC.T @ STEREO.cameras[0].R_BC)
    assert np.rad2deg(np.linalg.norm(left)) < 3.0
    # The other one is where it was beside the first.
    (a, b), (c, d) = initializer.calibration.cameras, STEREO.cameras
    np.testing.assert_allclose(a.R_BC.T @ b.R_BC, c.R_BC.T @ d.R_BC, atol=1e-9)


def test_a_pair_that_shares_nothing_begins_by_the_first_camera():
    sequence = flown("figure_eight", 3)
    apart = [(imu, replace(tracks, ids=tracks.ids + 10_000 * tracks.camera)) for imu, tracks in sequence.packets]
    estimate, _ = first_estimate(apart, STEREO)
    assert estimate is not None
    assert estimate.method == "dynamic"


@pytest.mark.parametrize(("every", "seconds"), [(2, 0.65), (5, 1.5), (9, 4.0)])
def test_slow_cameras_begin_when_there_are_frames_enough(every, seconds):
    """At 10, 4 and 2 Hz; between their frames the readings are joined."""
    sequence, pending, packets = flown("figure_eight", 2), [], []
    for k, (imu, tracks) in enumerate(sequence.packets):
        pending.append(imu)
        if k % every == 0:
            packets.append((join_segments(pending), tracks))
            pending.clear()
    estimate, _ = first_estimate(packets, STEREO)
    assert estimate is not None
    assert (estimate.states[-1].t_ns - packets[0][1].t_ns) * 1e-9 < seconds


def test_frames_of_one_camera_alone_are_no_pair():
    sequence = flown("figure_eight", 3)
    initializer = Initializer(STEREO)
    for imu, tracks in sequence.packets[:25]:
        assert initializer.add(imu, tracks.of_camera(0)) is None


def test_a_real_flight_begins_at_once(shared_data: Path):
    folder = shared_data / "euroc" / "MH_01_easy_15s"
    dataset, incidents = EurocDataset(folder, cameras=["cam0", "cam1"]), Incidents()
    frontend = Frontend(ShiTomasi(), dataset.calibration, FrontendOptions(), incidents)
    packets = [
        (imu, frontend.track(imu, frames, dataset.calibration))
        for imu, frames in synchronise(dataset.measurements(), duration_s=1.0, incidents=incidents)
    ]
    estimate, _ = first_estimate(packets, dataset.calibration)
    assert estimate is not None
    assert estimate.method == "stereo"
    truth = motion(load_trajectory(folder / "mav0/state_groundtruth_estimate0/data.csv"), packets)
    errors = judge(estimate, truth, packets[0][1].t_ns)
    assert errors.seconds <= 0.5
    assert errors.velocity < 0.06
    assert errors.tilt_deg < 1.0
