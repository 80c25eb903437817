"""The sliding window as a whole: accuracy, consistency, what its options do, keyframes, standstill, repeatability."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, EXACT, STEREO, drawn_start, pose_nees, since
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from vioframe.bench import BackendRun, backend_row, run_backend
from vioframe.errors import ConfigError
from vioframe.estimation.factors.solver import Solution, solve
from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.inertial.preintegration import Preintegrated, join_segments, preintegrate
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.options import EstimationOptions
from vioframe.geometry import so3
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import registry
from vioframe.simulation import TrackSequence, real_motion_sequence, simulated_sequence
from vioframe.simulation.flights import flight as named_flight
from vioframe.simulation.tracks import TrackOptions, TrackSimulator
from vioframe.types import DTHETA, CameraOnBody, Estimate, Float, FrameTracks, NavState, Status
from vioframe_sliding_window.backend import SlidingWindow
from vioframe_sliding_window.options import SlidingWindowOptions as Options
from vioframe_sliding_window.window import parallax

UP = np.array([0.0, 0.0, 1.0])
CALIBRATED = Options(calibrate_extrinsics=False, calibrate_time_offset=False)


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Several would fight over matrices this small."""
    with threadpool_limits(1):
        yield


def fly(
    sequence: TrackSequence,
    options: Options | None = None,
    seed: int = 0,
    *,
    estimation: EstimationOptions | None = None,
) -> BackendRun:
    """From a start drawn about the truth; tracking to the end."""
    return run(sequence, SlidingWindow(options), drawn_start(sequence, 1, seed), estimation)


def run(
    sequence: TrackSequence, backend: SlidingWindow, start: NavState, estimation: EstimationOptions | None = None
) -> BackendRun:
    """From ``start`` at the second frame on."""
    done = run_backend(since(sequence, 1), backend, estimation, start)
    assert done.completion == 1.0
    return done


def position_errors(done: BackendRun, sequence: TrackSequence) -> Float:
    truth = {state.t_ns: state.p_WB for state in sequence.true_states}
    return np.array([np.linalg.norm(state.p_WB - truth[state.t_ns]) for state in done.states])


def optimised(estimate: Estimate) -> bool:
    return "optimise" in estimate.stage_seconds


def sigmas(done: BackendRun) -> Float:
    """(N, 15) stated standard deviations."""
    return np.sqrt([np.diag(state.cov) for state in done.states])


# How good it is.


@pytest.mark.parametrize(
    ("flight", "residual", "limit_m"),
    [("figure_eight", "plane", 1e-4), ("figure_eight", "sphere", 1e-4), ("aggressive", "plane", 1e-3)],
)
def test_exact_tracks_and_readings_give_the_exact_flight(flight, residual, limit_m):
    sequence = simulated_sequence(flight, None, pixel_sigma=0.0, seed=1, duration_s=10.0)
    start = replace(sequence.true_states[1], cov=1e-10 * np.eye(15))
    done = run(sequence, SlidingWindow(Options(residual=residual)), start)
    assert position_errors(done, sequence).max() < limit_m
    # Landmarks are where the tracks see them.
    checked = 0
    (camera,) = sequence.calibration.cameras
    tracks = dict(zip(done.t_ns, (t for _, t in sequence.packets[1:]), strict=True))
    for estimate in done.estimates[40::10]:
        state = estimate.state
        if not optimised(estimate):
            continue
        _, i, j = np.intersect1d(estimate.landmark_ids, tracks[state.t_ns].ids, return_indices=True)
        checked += len(i)
        R_WC, p_WC = state.R_WB @ camera.R_BC, state.R_WB @ camera.p_BC + state.p_WB
        seen = camera.model.project((estimate.p_WF[i] - p_WC) @ R_WC)
        assert np.abs(seen - tracks[state.t_ns].xy[j]).max() < 0.2
    assert checked > 500


RIGS = pytest.mark.parametrize("calibration", [CALIBRATION, STEREO], ids=["mono", "stereo"])


@RIGS
def test_errors_are_as_large_as_the_covariance_says(calibration):
    """Three degrees of freedom over six flights, on readings as noisy as stated; each flight counts as one."""
    flights = 6
    values = []
    for seed in range(flights):
        sequence = simulated_sequence("figure_eight", seed=seed, duration_s=10.0, calibration=calibration)
        done = fly(sequence, seed=seed, estimation=EXACT)
        assert position_errors(done, sequence).max() < 0.15
        values.append(pose_nees(done.states, {s.t_ns: s for s in sequence.true_states}))
    low, high = chi2.ppf([0.001, 0.999], 3 * flights) / flights
    orientation, position = np.mean(values, axis=0)
    assert low < orientation < high
    assert low < position < high


@pytest.mark.parametrize("flight", ["figure_eight", "aggressive", "stop_and_go"])
def test_estimates_are_finite_and_covariances_positive(flight):
    """Of the frames that are optimised as of those that are only predicted."""
    sequence = simulated_sequence(flight, seed=4, duration_s=8.0)
    done = fly(sequence, seed=4)
    for estimate, (_, tracks) in zip(done.estimates, sequence.packets[1:], strict=True):
        state = estimate.state
        assert estimate.status is Status.TRACKING
        assert state.t_ns == tracks.t_ns
        assert np.abs(state.R_WB.T @ state.R_WB - np.eye(3)).max() < 1e-11
        for values in (state.p_WB, state.v_WB, state.bias_gyro_B, state.bias_accel_B, state.cov, estimate.p_WF):
            assert np.isfinite(values).all()
        assert (state.cov == state.cov.T).all()
        assert np.linalg.eigvalsh(state.cov)[0] > 0.0


@RIGS
@pytest.mark.parametrize("first_estimates", [True, False])
def test_yaw_never_becomes_better_known_than_it_was(first_estimates, calibration):
    """Without first estimates it does, from nothing."""
    sequence = simulated_sequence("aggressive", seed=3, duration_s=10.0, calibration=calibration)
    true = sequence.true_states[1]
    up_B = true.R_WB.T @ UP
    # Position and velocity turn with yaw, as after an initialisation: else a velocity would be a compass.
    cov = np.diag(np.repeat([0.005, 0.01, 0.05, 0.005, 0.05], 3) ** 2)
    cov[DTHETA, DTHETA] -= 0.005**2 * np.outer(up_B, up_B)
    turned = np.concatenate([up_B, np.cross(UP, true.p_WB), np.cross(UP, true.v_WB), np.zeros(6)])
    start = replace(true, cov=cov + 0.1**2 * np.outer(turned, turned))
    options = replace(CALIBRATED, first_estimate_jacobians=first_estimates)
    done = run(sequence, SlidingWindow(options), start, EXACT)

    def yaw_sigma(state: NavState) -> float:
        up_B = state.R_WB.T @ UP
        return float(np.sqrt(up_B @ state.cov[DTHETA, DTHETA] @ up_B))

    ratio = np.array([yaw_sigma(state) for state in done.states]) / yaw_sigma(start)
    assert (ratio.min() > 0.999) if first_estimates else (ratio.min() < 0.9)


def test_two_runs_are_the_same_to_the_last_bit():
    sequence = simulated_sequence("aggressive", seed=2, duration_s=5.0)

    def all_bytes() -> bytes:
        parts = [
            np.ascontiguousarray(x).tobytes()
            for estimate in fly(sequence, seed=2).estimates
            for s in [estimate.state]
            for x in (
                s.R_WB,
                s.p_WB,
                s.v_WB,
                s.bias_gyro_B,
                s.bias_accel_B,
                s.cov,
                estimate.landmark_ids,
                estimate.p_WF,
            )
        ]
        return b"".join(parts)

    assert all_bytes() == all_bytes()


# Which frames stay.


@pytest.mark.parametrize("size", [3, 10])
def test_the_window_fills_and_never_exceeds_its_size(size):
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=6.0)
    backend = SlidingWindow(Options(window_size=size))
    life = LifeCycle(backend, sequence.calibration, initial_state=drawn_start(sequence, 1, 1))
    sizes = []
    for packet in sequence.packets[1:]:
        life.process(*packet)
        sizes.append(len(backend.window))
    # Keyframes, and the newest frame.
    assert max(sizes) == size + 1
    assert backend.window.tracks.seen.shape[1] == len(backend.window) == len(backend.window.prior.frozen)
    assert min(sizes[-20:]) == size


def test_cameras_that_take_turns_have_as_many_frames_each():
    """Else they would share a window, and it would reach back half as far; one that falls silent leaves no room."""
    size, turns = 4, 80
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=7.0, calibration=packaged_calibration("euroc"))
    backend = SlidingWindow(Options(window_size=size))
    life = LifeCycle(backend, sequence.calibration, initial_state=drawn_start(sequence, 1, 1))
    sizes = []
    for k, (imu, tracks) in enumerate(sequence.packets[1:]):
        life.process(imu, tracks.of_camera(k % 2 if k < turns else 0))
        sizes.append(len(backend.window))
    assert max(sizes) == sizes[turns - 1] == 2 * size + 1
    assert max(sizes[-20:]) == size + 1


def test_frames_are_optimised_at_a_rate_and_predicted_between():
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=3.0)
    for rate_hz, every in ((20.0, 1), (10.0, 2), (5.0, 4), (100.0, 1)):
        done = fly(sequence, Options(max_rate_hz=rate_hz), 1)
        assert np.diff(np.flatnonzero([optimised(e) for e in done.estimates])).tolist() == [every] * (
            (len(done.estimates) - 1 - every) // every
        )
    done = fly(sequence, Options(max_rate_hz=5.0), 1)
    at = np.flatnonzero([optimised(e) for e in done.estimates])[5]
    base = done.estimates[at].state
    for k in range(1, 4):
        imu = join_segments([imu for imu, _ in sequence.packets[at + 2 : at + 2 + k]])
        predicted = preintegrate(imu, base.bias_gyro_B, base.bias_accel_B, sequence.calibration.imu).predict(base)
        np.testing.assert_allclose(done.estimates[at + k].state.p_WB, predicted.p_WB, atol=1e-12)
        assert not len(done.estimates[at + k].landmark_ids)
        assert not done.estimates[at + k].is_keyframe


def keyframes(done: BackendRun) -> list[int]:
    return [k for k, estimate in enumerate(done.estimates) if estimate.is_keyframe]


NEVER = {"keyframe_parallax_px": 1e6, "keyframe_min_tracks": 0, "keyframe_interval_s": 1e6}


def test_each_reason_makes_keyframes():
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=4.0)
    assert keyframes(fly(sequence, Options(**NEVER), 1)) == []
    by_interval = keyframes(fly(sequence, Options(**NEVER | {"keyframe_interval_s": 0.5}), 1))
    assert np.diff(by_interval).tolist() == [10] * (len(by_interval) - 1)
    assert len(by_interval) >= 7
    by_tracks = fly(sequence, Options(**NEVER | {"keyframe_min_tracks": 10_000}), 1)
    assert keyframes(by_tracks) == np.flatnonzero([optimised(e) for e in by_tracks.estimates]).tolist()
    # One track in common, for where there is none no motion can be told.
    by_parallax = NEVER | {"keyframe_min_tracks": 1}
    few, many = (
        len(keyframes(fly(sequence, Options(**by_parallax | {"keyframe_parallax_px": px}), 1))) for px in (40.0, 10.0)
    )
    assert 3 < few < 0.7 * many


def test_a_frame_that_is_no_keyframe_gives_way_to_the_next():
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=4.0)
    options = Options(**NEVER | {"keyframe_interval_s": 0.5})
    backend = SlidingWindow(options)
    life = LifeCycle(backend, sequence.calibration, initial_state=drawn_start(sequence, 1, 1))
    kept = [sequence.true_states[1].t_ns]
    for packet in sequence.packets[1:]:
        estimate = life.process(*packet)
        if estimate.is_keyframe:
            kept.append(estimate.state.t_ns)
        inside = backend.window._t_ns
        assert set(inside[:-1]) <= set(kept)
        # Readings lead from each frame to the next without a gap.
        stamps = [(int(r.imu.t_ns[0]), int(r.imu.t_ns[-1])) for r in backend.window._readings]
        assert stamps == list(pairwise(inside))


def test_cameras_that_take_turns_have_keyframes_as_often_each():
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=4.0, calibration=packaged_calibration("euroc"))
    options = Options(**NEVER | {"keyframe_interval_s": 0.5, "max_rate_hz": 20.0})
    life = LifeCycle(SlidingWindow(options), sequence.calibration, initial_state=drawn_start(sequence, 1, 1))
    taken = [
        k for k, (imu, seen) in enumerate(sequence.packets[1:]) if life.process(imu, seen.of_camera(k % 2)).is_keyframe
    ]
    for camera in (0, 1):
        own = [k for k in taken if k % 2 == camera]
        assert len(own) >= 6
        assert np.diff(own).tolist() == [10] * (len(own) - 1)


def frames(*xy: Float) -> TrackTable:
    table = TrackTable()
    for t_ns, points in enumerate(xy):
        tracks = FrameTracks(t_ns, np.arange(len(points)), np.zeros(len(points), np.int64), points, points)
        table.add_frame(tracks)
    return table


def test_parallax_is_free_of_rotation():
    rng = np.random.default_rng(0)
    p_C = np.column_stack([rng.uniform(-1.0, 1.0, (30, 2)), np.full(30, 4.0)])
    R = so3.exp([0.1, -0.2, 0.3])

    def seen(points: Float) -> Float:
        return points[:, :2] / points[:, 2:]

    R_WC, focal_px = np.stack([np.eye(3), R]), np.array([400.0])
    table = frames(seen(p_C), seen(p_C @ R))
    assert parallax(table, R_WC, focal_px) == (30, pytest.approx(0.0, abs=1e-9))
    aside = p_C - [0.4, 0.0, 0.0]
    common, moved_px = parallax(frames(seen(p_C), seen((aside @ R)[:20])), R_WC, focal_px)
    assert (common, moved_px) == (20, pytest.approx(40.0, abs=1e-9))
    assert parallax(frames(seen(p_C), np.empty((0, 2))), R_WC, focal_px) == (0, 0.0)


def test_cameras_that_take_turns_have_parallax_each_to_its_own_last_frame():
    """Also by what does not count."""
    table, xy = TrackTable(cameras=2), np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2))
    for t, (camera, moved) in enumerate([(0, 0.0), (1, 0.0), (0, 0.1), (1, 0.05)]):
        ids = 100 * camera + np.arange(20)
        seen = xy + np.array([moved, 0.0])
        table.add_frame(FrameTracks(t, ids, np.full(20, camera), 400.0 * seen, seen), np.zeros(20, bool))
    R_WC = np.tile(np.eye(3), (8, 1, 1))
    assert parallax(table, R_WC, np.array([400.0, 200.0])) == (20, pytest.approx(10.0))
    table.drop_frame(3)
    assert parallax(table, R_WC[:6], np.array([400.0, 200.0])) == (20, pytest.approx(40.0))


# What the options do.


def test_iterations_are_bounded_in_number_and_time(monkeypatch):
    sequence = simulated_sequence("aggressive", seed=1, duration_s=3.0)
    taken: list[int] = []

    def counted(*problem: Any, **limits: Any) -> Solution:
        solution = solve(*problem, **limits)
        taken.append(solution.iterations)
        return solution

    monkeypatch.setattr("vioframe_sliding_window.window.solve", counted)
    most = {}
    for name, options in {
        "eight": Options(),
        "two": Options(max_iterations=2),
        "short": Options(max_solve_ms=1e-6),
    }.items():
        taken.clear()
        fly(sequence, options, 1)
        most[name] = max(taken)
    assert 2 < most["eight"] <= 8
    assert most["two"] == 2
    assert most["short"] == 1


def test_min_observations_delays_landmarks():
    """The frame that it begins with counts."""
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=3.0)
    first = []
    for views in (2, 3, 6):
        done = fly(sequence, Options(min_observations=views, **NEVER | {"keyframe_min_tracks": 10_000}), 1)
        count = [len(e.landmark_ids) for e in done.estimates if optimised(e)]
        first.append(next(k for k, n in enumerate(count) if n) + 2)
    assert first == [2, 3, 6]


def test_noisier_readings_are_trusted_less():
    """Readings that jump six times as much as the calibration has it."""
    sequence = simulated_sequence("figure_eight", CALIBRATION.imu.times(6.0, 6.0), seed=1, duration_s=4.0)
    factors = EXACT, EstimationOptions(gyro_noise_factor=8.0, accel_noise_factor=8.0)
    once, often = (sigmas(fly(sequence, seed=1, estimation=each)) for each in factors)
    assert (often[-1, :9] > 1.1 * once[-1, :9]).all()
    loose = sigmas(fly(sequence, Options(pixel_sigma=2.0), 1, estimation=EXACT))
    assert loose[-1, :9].sum() > 1.1 * once[-1, :9].sum()


@pytest.mark.parametrize(("flown_px", "found_px"), [(0.05, 0.08), (0.7, 0.7), (1.5, 1.5)])
def test_noise_of_points_is_found_where_it_is_larger_than_was_taken_for_granted(flown_px, found_px):
    backend = SlidingWindow()
    sequence = simulated_sequence("figure_eight", pixel_sigma=flown_px, seed=1, duration_s=15.0)
    run(sequence, backend, drawn_start(sequence, 1, 1))
    assert backend.window.point_noise.px == pytest.approx(found_px, rel=0.1)


@pytest.mark.parametrize("seed", [1, 3, 6])
def test_a_take_off_is_not_taken_for_its_mirror_image(seed, shared_data):
    """Before the accelerometer tells which way it goes, landmarks behind the camera fit a body that flies backwards."""
    folder = shared_data / "euroc_imu_gt/V1_01_easy"
    sequence = real_motion_sequence(folder, pixel_sigma=0.1, duration_s=7.0, seed=seed)
    done = run_backend(sequence, SlidingWindow())
    assert not done.resets
    assert backend_row(sequence, done)["ate_m"] < 0.01


@pytest.mark.parametrize("seed", [1, 3, 6])
def test_the_jerk_of_a_slow_take_off_tells_its_scale(seed, shared_data):
    """With a keyframe a second it is off by 14 mm."""
    folder = shared_data / "euroc_imu_gt/V1_01_easy"
    sequence = real_motion_sequence(folder, pixel_sigma=0.1, duration_s=12.0, seed=seed)
    assert backend_row(sequence, run_backend(sequence, SlidingWindow()))["ate_m"] < 0.0075


def test_robust_loss_keeps_outliers_from_harm():
    sequence = simulated_sequence("figure_eight", seed=1, duration_s=10.0, outlier_ratio=0.05)
    neither = {"cauchy_sigmas": 1e6, "outlier_px": 1e6}
    rms = {}
    for name, options in {"both": {}, "robust": neither | {"cauchy_sigmas": 3.0}, "neither": neither}.items():
        errors = position_errors(fly(sequence, Options(**options), 1), sequence)
        rms[name] = float(np.sqrt((errors**2).mean()))
    assert rms["both"] < 0.05
    assert rms["robust"] < 0.5 * rms["neither"]
    assert rms["both"] < 0.8 * rms["neither"]


def late(sequence: TrackSequence, flight: str, duration_s: float, offset_s: float) -> TrackSequence:
    """The same with images that were taken ``offset_s`` later than their stamps say."""
    simulator = TrackSimulator(sequence.calibration, TrackOptions(), np.random.default_rng(5))
    t_s = (sequence.ground_truth.t_ns - sequence.ground_truth.t_ns[0]) * 1e-9
    motion = named_flight(flight, duration_s, sequence.calibration.cameras[0].R_BC).at(
        np.clip(t_s + offset_s, 0.0, duration_s)
    )
    packets = tuple(
        (imu, simulator.observe(tracks.t_ns, R, p))
        for (imu, tracks), R, p in zip(sequence.packets, motion.R_WB, motion.p_WB, strict=True)
    )
    return replace(sequence, packets=packets)


@pytest.mark.parametrize("offset_s", [0.0, 0.008, -0.015])
def test_time_offset_is_found_and_is_what_it_is_worth(offset_s):
    """To a millisecond, though the tracks' own velocities are as noisy as the tracks."""
    sequence = late(simulated_sequence("aggressive", seed=1, duration_s=10.0), "aggressive", 10.0, offset_s)
    done = fly(sequence, seed=1)
    assert learned_camera(done).time_offset_ns * 1e-9 == pytest.approx(offset_s, abs=1e-3)
    backend = SlidingWindow(Options(calibrate_time_offset=False))
    # Where it is less sure how the camera sits, that is taken for what is off.
    estimation = EstimationOptions(extrinsics_sigma_deg=0.3, extrinsics_sigma_m=0.015)
    without = run_backend(since(sequence, 1), backend, estimation, drawn_start(sequence, 1, 1))
    if abs(offset_s) > 0.01:
        # Images and readings contradict each other, and the next start finds it.
        assert without.resets
        assert learned_camera(without).time_offset_ns * 1e-9 == pytest.approx(offset_s, abs=1e-3)
    else:
        assert learned_camera(without).time_offset_ns == 0
    if offset_s:
        assert position_errors(done, sequence).mean() < 0.5 * position_errors(without, sequence).mean()


def learned_camera(done: BackendRun) -> CameraOnBody:
    """The camera as the run has learned it."""
    learned = done.estimates[-1].calibration
    assert learned is not None
    return learned.calibration.cameras[0]


def test_extrinsics_converge_to_the_truth():
    """The camera sits otherwise than it was told, as far off as the prior allows."""
    (told,) = CALIBRATION.cameras
    off = np.array([0.004, -0.006, 0.005]), np.array([0.012, -0.015, 0.01])
    true = replace(told, R_BC=told.R_BC @ so3.exp(off[0]), p_BC=told.p_BC + off[1])
    flown = replace(CALIBRATION, cameras=(true,))
    sequence = simulated_sequence("aggressive", seed=3, duration_s=15.0, calibration=flown)
    sequence = replace(sequence, calibration=CALIBRATION)

    def errors(options: Options) -> tuple[float, float, Float]:
        done = fly(sequence, options, 3)
        camera = learned_camera(done)
        turned = float(np.linalg.norm(so3.log(camera.R_BC.T @ true.R_BC)))
        return turned, float(np.linalg.norm(camera.p_BC - true.p_BC)), position_errors(done, sequence)

    turned, moved, found = errors(Options())
    assert turned < 0.2 * np.linalg.norm(off[0])
    assert moved < 0.4 * np.linalg.norm(off[1])
    turned, moved, fixed = errors(Options(calibrate_extrinsics=False))
    np.testing.assert_allclose([turned, moved], np.linalg.norm(off, axis=1), rtol=1e-9)
    assert found.mean() < 0.7 * fixed.mean()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"window_size": 2}, "window_size=2: Input should be greater than or equal to 3"),
        ({"min_observations": 1}, "min_observations=1: Input should be greater than or equal to 2"),
        ({"max_iterations": 0}, "max_iterations=0: Input should be greater than 0"),
        ({"pixel_sigma": 0.0}, "pixel_sigma=0.0: Input should be greater than 0"),
        ({"max_rate_hz": -1.0}, "max_rate_hz=-1.0: Input should be greater than 0"),
        ({"keyframe_parallax_px": -1.0}, "keyframe_parallax_px=-1.0: Input should be greater than or equal to 0"),
        ({"max_solve_ms": -1.0}, "max_solve_ms=-1.0: Input should be greater than or equal to 0"),
        ({"residual": "cube"}, "residual"),
        ({"window_sise": 10}, "window_size"),
    ],
)
def test_bad_options_are_one_clear_line(options, message):
    with pytest.raises(ConfigError) as refused:
        registry.load().create_backend("sliding_window", options)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


# Readings and standstill.


@pytest.mark.parametrize(("bias", "anew"), [(0.0, False), (0.03, True)])
def test_readings_are_integrated_anew_where_the_bias_moves(bias, anew, monkeypatch):
    """The start knows nothing of a bias of 1.7 degrees a second."""
    sequence = simulated_sequence("aggressive", seed=1, duration_s=4.0, bias_gyro_B=np.array([bias, -bias, bias]))
    start = replace(sequence.true_states[1], bias_gyro_B=np.zeros(3))
    sigma = [0.005, 0.001, 0.02, 0.05, 0.05] if bias else [0.005, 0.001, 0.02, 0.001, 0.01]
    start = replace(start, cov=np.diag(np.repeat(sigma, 3) ** 2))
    calls: list[float] = []
    repropagated = Preintegrated.repropagated

    def counted(reading: Preintegrated, gyro: Float, accel: Float) -> Preintegrated:
        calls.append(float(np.linalg.norm(gyro - reading.bias_gyro_B)))
        return repropagated(reading, gyro, accel)

    monkeypatch.setattr(Preintegrated, "repropagated", counted)
    backend = SlidingWindow()
    done = run(sequence, backend, start)
    assert any(moved > 0.01 for moved in calls) is anew
    assert np.linalg.norm(done.states[-1].bias_gyro_B - bias * np.array([1.0, -1.0, 1.0])) < 0.003
    backend.window.repropagate()
    for reading, at in zip(backend.window._readings, backend.window._states.bias_gyro_B, strict=False):
        assert np.linalg.norm(reading.bias_gyro_B - at) < 0.01


def test_standstill_does_not_drift_and_nothing_grows():
    sequence = simulated_sequence("standstill", pixel_sigma=0.1, duration_s=10.0)
    backend = SlidingWindow()
    life = LifeCycle(backend, sequence.calibration)
    estimates, sizes = [], []
    for packet in sequence.packets:
        estimates.append(life.process(*packet))
        if estimates[-1].state is not None:
            sizes.append((len(backend.window), len(backend.window.tracks.ids)))
    states = [e.state for e in estimates if e.state is not None]
    assert any(event == "initialised (static)" for e in estimates for event in e.events)
    assert (states[-1].t_ns - states[0].t_ns) * 1e-9 > 8.0
    p_WB = np.array([state.p_WB for state in states])
    assert np.linalg.norm(p_WB - p_WB[0], axis=1).max() < 2e-3
    assert max(np.linalg.norm(state.v_WB) for state in states[10:]) < 5e-3
    assert sizes[-1] == sizes[len(sizes) // 3]
    sigma = np.sqrt(np.diag(states[-1].cov))
    assert 1e-6 < sigma[3:6].min() <= sigma[3:6].max() < 0.02
    # Nor does what is said of frames between: a body that may be about to set off has not done so yet.
    said = np.array([np.sqrt(np.diag(state.cov))[3:6].max() for state in states[len(states) // 3 :]])
    assert np.ptp(said) < 0.8e-3


def test_stop_and_go_is_held_at_every_stop():
    sequence = simulated_sequence("stop_and_go", pixel_sigma=0.1, duration_s=20.0)
    speed = np.linalg.norm([s.v_WB for s in sequence.true_states[1:]], axis=1)
    stands = speed < 1e-3
    assert 0.2 < stands.mean() < 0.8
    held = fly(sequence)
    velocity = np.linalg.norm([s.v_WB for s in held.states], axis=1)
    # It takes half a second to be told, and the readings of the last 0.2 s lead on from what is sure.
    told = stands & np.roll(stands, 11)
    told[:11] = False
    assert velocity[told].max() < 0.045
    assert position_errors(held, sequence).max() < 0.03
    # Nothing is triangulated from a place that one does not leave: on readings alone the body wanders off.
    loose = EstimationOptions(zero_velocity_update=False)
    wandering = run_backend(since(sequence, 1), SlidingWindow(), loose, drawn_start(sequence, 1, 0))
    assert position_errors(wandering, sequence).max() > 0.1


def test_calibration_of_the_camera_is_in_its_own_hands():
    """The back-end leaves what it was given alone."""
    calibration = packaged_calibration("euroc", cameras=["cam0"])
    (camera,) = calibration.cameras
    R_BC, p_BC = camera.R_BC.copy(), camera.p_BC.copy()
    fly(simulated_sequence("aggressive", seed=1, duration_s=2.0, calibration=calibration), seed=1)
    np.testing.assert_array_equal(camera.R_BC, R_BC)
    np.testing.assert_array_equal(camera.p_BC, p_BC)
