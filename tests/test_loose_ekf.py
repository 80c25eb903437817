"""The loosely coupled back-end: its visual odometry by itself, the scale it finds, and what it does when misled."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msckf_helpers import EXACT, drawn_start, pose_nees
from threadpoolctl import threadpool_limits

from vioframe.bench import BackendRun, run_backend
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.options import EstimationOptions
from vioframe.evaluation import evaluate
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.parts import registry
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.testing import check_backend
from vioframe.types import NS_PER_S, Float, FrameTracks, Status
from vioframe_loose_ekf import vioframe_backends
from vioframe_loose_ekf.backend import LooseEkf
from vioframe_loose_ekf.odometry import Event, VisualOdometry
from vioframe_loose_ekf.options import LooseEkfOptions
from vioframe_loose_ekf.resection import resect
from vioframe_loose_ekf.state import VisionPose
from vioframe_loose_ekf.vision_map import VisionMap, adjust

SIGMA = 1.0 / 458.0


@pytest.fixture(autouse=True)
def _one_thread():
    with threadpool_limits(1):
        yield


@cache
def flight(duration_s: float = 20.0) -> TrackSequence:
    return simulated_sequence("figure_eight", duration_s=duration_s, seed=1)


def camera_path(sequence: TrackSequence) -> tuple[Float, Float]:
    """R_WC (N, 3, 3) and p_WC (N, 3) at every frame."""
    truth, (camera,) = sequence.ground_truth, sequence.calibration.cameras
    return truth.R_WB @ camera.R_BC, truth.p_WB + truth.R_WB @ camera.p_BC


def scene(seed: int, points: int = 80) -> tuple[VisionMap, Float]:
    """Six keyframes along a line, points before them, exact; and the points' positions (L, 3)."""
    rng = np.random.default_rng(seed)
    p_VF = rng.uniform([-2.0, -1.5, 3.0], [2.0, 1.5, 8.0], (points, 3))
    made = VisionMap()
    for k in range(6):
        pose = VisionPose(so3.exp(0.02 * rng.normal(size=3)), np.array([0.15 * k, 0.0, 0.05 * k]))
        q = (p_VF - pose.p_VC) @ pose.R_VC
        ids, xy = np.arange(points), q[:, :2] / q[:, 2:]
        made.add_keyframe(pose, FrameTracks(k, ids, np.zeros_like(ids), xy, xy))
    made.known[:], made.p_VF = True, p_VF.copy()
    return made, p_VF


@pytest.mark.parametrize("far", [False, True], ids=["near", "far"])
def test_a_camera_is_placed_among_outliers(far):
    exact, p_VF = scene(0)
    rng = np.random.default_rng(1)
    true, xy = exact.poses[3], exact.xy_normalised[:, 3] + SIGMA * rng.normal(size=(80, 2))
    wrong = rng.permutation(80)[:24]
    xy[wrong] += rng.choice([-1.0, 1.0], (24, 2)) * rng.uniform(10.0, 100.0, (24, 2)) * SIGMA
    off = VisionPose(true.R_VC @ so3.exp([0.8, -0.6, 0.4]), true.p_VC + 2.0) if far else exact.poses[2]
    found = resect(off, p_VF, xy, SIGMA)
    assert found is not None
    assert not found.inliers[wrong].any()
    assert found.inliers.sum() > 50
    error = np.concatenate([so3.log(true.R_VC.T @ found.pose.R_VC), found.pose.p_VC - true.p_VC])
    assert error @ np.linalg.solve(found.cov, error) < 20.0
    assert np.abs(error[3:]).max() < 0.02


def test_points_anywhere_place_no_camera():
    exact, p_VF = scene(0, points=20)
    rng = np.random.default_rng(2)
    found = resect(exact.poses[0], p_VF, rng.uniform(-0.5, 0.5, (20, 2)), SIGMA)
    assert found is None or found.inliers.sum() < 10
    assert resect(exact.poses[0], p_VF[:5], exact.xy_normalised[:5, 0], SIGMA) is None


def test_adjustment_puts_the_free_keyframes_back_and_leaves_the_held_ones():
    disturbed, p_VF = scene(3)
    true = list(disturbed.poses)
    rng = np.random.default_rng(4)
    for k in range(2, 6):
        turn, way = so3.exp(0.01 * rng.normal(size=3)), 0.03 * rng.normal(size=3)
        disturbed.poses[k] = VisionPose(true[k].R_VC @ turn, true[k].p_VC + way)
    disturbed.p_VF = p_VF + 0.05 * rng.normal(size=p_VF.shape)
    disturbed.xy_normalised[7, 4] += 0.2  # one wrong sighting: its point goes, and nothing else
    adjust(disturbed, SIGMA, held=2, iterations=15)
    assert disturbed.ids[disturbed.known].tolist() == [i for i in range(80) if i != 7]
    np.testing.assert_allclose(disturbed.p_VF[disturbed.known], np.delete(p_VF, 7, axis=0), atol=1e-3)
    for k, pose in enumerate(disturbed.poses):
        np.testing.assert_allclose(pose.R_VC, true[k].R_VC, atol=1e-4 if k > 1 else 0.0)
        np.testing.assert_allclose(pose.p_VC, true[k].p_VC, atol=1e-4 if k > 1 else 0.0)


def test_the_odometry_alone_draws_the_path_up_to_scale():
    sequence = flight()
    R_WC, p_WC = camera_path(sequence)
    odometry = VisualOdometry(sequence.calibration, LooseEkfOptions())
    odometry.restart(sequence.packets[0][1])
    events, stamps, R_VC, p_VC = [], [], [], []
    for k, (_, tracks) in enumerate(sequence.packets[1:], start=1):
        sighting = odometry.track(tracks, np.eye(3))  # it does without the gyroscope
        events.append(sighting.event)
        if sighting.placement is not None:
            stamps.append(k)
            R_VC.append(sighting.placement.pose.R_VC)
            p_VC.append(sighting.placement.pose.p_VC)
    assert events.count(Event.BEGUN) == 1
    assert events.count(Event.REFERENCE) == 0
    assert len(stamps) > 380
    t_ns = sequence.ground_truth.t_ns[stamps]
    drawn = Trajectory(t_ns, np.array(R_VC), np.array(p_VC))
    true = Trajectory(t_ns, R_WC[stamps], p_WC[stamps])
    errors = evaluate(drawn, true, alignment="sim3")
    assert errors.ate_m.rmse < 0.005 * true.path_length_m
    assert errors.orientation_deg.rmse < 1.0


def test_turning_on_the_spot_makes_no_map():
    sequence = simulated_sequence("pure_rotation", duration_s=6.0)
    R_WC, _ = camera_path(sequence)
    odometry = VisualOdometry(sequence.calibration, LooseEkfOptions())
    odometry.restart(sequence.packets[0][1])
    for k in range(1, len(sequence.packets)):
        assert odometry.track(sequence.packets[k][1], R_WC[k - 1].T @ R_WC[k]).placement is None


def test_a_stop_in_flight_holds_it_where_it_is():
    """The map outlasts the stop, over which the vision frame may drift."""
    sequence = simulated_sequence("stop_and_go", pixel_sigma=0.1, duration_s=26.0)
    run = run_backend(sequence, LooseEkf())
    begun_ns = next(t for t, e in zip(run.t_ns, run.estimates, strict=True) if len(e.landmark_ids))
    stops = {s.t_ns for s in sequence.true_states if s.t_ns > begun_ns and np.linalg.norm(s.v_WB) < 1e-3}
    speeds = [np.linalg.norm(state.v_WB) for state in run.states if state.t_ns in stops]
    assert len(speeds) > 20
    assert max(speeds) < 0.05
    assert run.resets == 0
    assert evaluate(run.trajectory, sequence.ground_truth).ate_m.rmse < 0.1


@cache
def flown() -> tuple[TrackSequence, BackendRun]:
    return flight(), run_backend(flight(), LooseEkf())


def test_the_flight_has_its_true_length():
    sequence, run = flown()
    errors = evaluate(run.trajectory, sequence.ground_truth)
    assert run.completion == 1.0
    assert run.resets == 0
    assert errors.scale == pytest.approx(1.0, abs=0.01)
    assert errors.ate_m.rmse < 0.002 * errors.truth.path_length_m


def test_landmarks_are_where_they_are():
    sequence, run = flown()
    depths = [e.p_WF for e in run.estimates[100:] if len(e.landmark_ids)]
    assert len(depths) > 0.9 * len(run.estimates[100:])
    state, estimate = run.states[-1], run.estimates[-1]
    tracks, (camera,) = sequence.packets[-1][1], sequence.calibration.cameras
    p_B = (estimate.p_WF - state.p_WB) @ state.R_WB
    xy = camera.model.project((p_B - camera.p_BC) @ camera.R_BC)
    seen = tracks.xy[[tracks.ids.tolist().index(i) for i in estimate.landmark_ids]]
    assert np.median(np.linalg.norm(xy - seen, axis=1)) < 2.0
    assert sum(e.is_keyframe for e in run.estimates) > 20


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_the_scale_comes_back_from_thirty_per_cent_off(factor):
    sequence = flight()
    backend = LooseEkf()
    life = LifeCycle(backend, sequence.calibration)
    speeds = []
    for k, (imu, tracks) in enumerate(sequence.packets):
        estimate = life.process(imu, tracks)
        if k == 200:
            fusion = backend.fusion
            here = fusion.state.pose(sequence.calibration.cameras[0])
            fusion.tie_anew(here, 1e-6 * np.eye(6), 0.3)
            right = fusion.state.log_scale
            fusion.state = replace(fusion.state, log_scale=right + np.log(factor))
        if k > 320:
            speeds.append(np.linalg.norm(estimate.state.v_WB) / np.linalg.norm(sequence.true_states[k].v_WB))
    assert abs(fusion.state.log_scale - right) < 0.05
    assert np.median(speeds) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_covariance_is_of_the_size_of_the_errors(seed):
    """Poses of one odometry hang together, which the filter does not know: the bounds are wide, and on both sides."""
    sequence = simulated_sequence("figure_eight", duration_s=15.0, seed=seed)
    start = drawn_start(sequence, 0, seed)
    run = run_backend(sequence, LooseEkf(), EXACT, start)
    truth = {state.t_ns: state for state in sequence.true_states}
    orientation, position = pose_nees(run.states, truth)
    assert 0.75 < orientation < 6.0
    assert 0.75 < position < 6.0


@pytest.fixture(scope="module")
def blinded():
    """A flight on which the camera sees nothing for six seconds."""
    sequence = flight()
    packets = tuple(
        (imu, tracks.only(np.zeros(len(tracks.ids), bool)) if 160 <= k < 280 else tracks)
        for k, (imu, tracks) in enumerate(sequence.packets)
    )
    renamed = tuple((i, replace(t, ids=t.ids + 1_000_000) if k >= 280 else t) for k, (i, t) in enumerate(packets))
    return sequence, run_backend(replace(sequence, packets=renamed), LooseEkf())


def test_it_says_that_it_is_lost_and_goes_on_from_there(blinded):
    sequence, run = blinded
    events = [(k, event) for k, estimate in enumerate(run.estimates) for event in estimate.events]
    lost = [k for k, event in events if event.startswith("lost: nothing usable was seen for")]
    begun = [k for k, event in events if event == "initialised (dynamic)"]
    assert len(lost) == 1
    assert 160 + 80 <= lost[0] <= 160 + 84  # max_blind_s is 4 s
    assert run.estimates[lost[0]].status is Status.LOST
    assert len(begun) == 2
    assert 280 < begun[1] < 370
    before, again = run.estimates[lost[0] - 1].state, run.estimates[begun[1]].state
    np.testing.assert_array_equal(again.p_WB, before.p_WB)
    last = run.stretches[-1]
    assert evaluate(last, sequence.ground_truth).ate_m.rmse < 0.1


def test_all_new_tracks_are_a_new_vision_frame_and_no_loss():
    """What was seen is gone from one frame to the next: readings bridge the time to the next map."""
    sequence = flight()
    packets = tuple(
        (imu, replace(tracks, ids=tracks.ids + 1_000_000) if k >= 200 else tracks)
        for k, (imu, tracks) in enumerate(sequence.packets)
    )
    run = run_backend(replace(sequence, packets=packets), LooseEkf())
    assert run.resets == 0
    assert evaluate(run.trajectory, sequence.ground_truth).ate_m.rmse < 0.1
    seen = [bool(len(estimate.landmark_ids)) for estimate in run.estimates]
    assert not any(seen[200:202])
    assert all(seen[260:])


def test_a_wrong_pose_here_and_there_changes_nothing(monkeypatch):
    sequence, undisturbed = flown()
    placed = VisualOdometry.track
    wrong = set(range(100, 400, 10))
    count = iter(range(len(sequence.packets)))

    def sometimes_wrong(self, tracks, R_CbC):
        sighting = placed(self, tracks, R_CbC)
        if next(count) not in wrong or sighting.event is not Event.TRACKED:
            return sighting
        pose = sighting.placement.pose
        return replace(sighting, placement=replace(sighting.placement, pose=replace(pose, p_VC=pose.p_VC + 1.0)))

    monkeypatch.setattr(VisualOdometry, "track", sometimes_wrong)
    run = run_backend(sequence, LooseEkf())
    assert not any(event.startswith(("lost", "vision", "new")) for e in run.estimates for event in e.events)
    apart = [np.linalg.norm(a.p_WB - b.p_WB) for a, b in zip(run.states, undisturbed.states, strict=True)]
    assert 0.0 < max(apart) < 0.05


def test_it_keeps_every_promise_of_a_backend():
    check_backend(vioframe_backends()["loose_ekf"])


@pytest.mark.parametrize(
    "wrong",
    [
        {"keyframes": 2},
        {"pixel_sigma": 0.0},
        {"bootstrap_parallax_px": float("nan")},
        {"vision_noise_factor": -1.0},
    ],
    ids=lambda wrong: next(iter(wrong)),
)
def test_options_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="needs"):
        LooseEkfOptions(**wrong)


def test_it_is_found_by_name_with_its_options():
    sequence = flight()
    backend = registry.load().create_backend("loose_ekf", {"keyframes": 8})
    blind = tuple(
        (i, t.only(np.zeros(len(t.ids), bool)) if k > 100 else t) for k, (i, t) in enumerate(sequence.packets)
    )
    run = run_backend(replace(sequence, packets=blind[:130]), backend, EstimationOptions(max_blind_s=1.0))
    lost_ns = next(t for t, e in zip(run.t_ns, run.estimates, strict=False) if e.status is Status.LOST)
    assert (lost_ns - run.t_ns[100]) / NS_PER_S == pytest.approx(1.05, abs=0.01)
