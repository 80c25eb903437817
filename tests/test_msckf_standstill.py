"""Standing still: nothing drifts or grows, and slow motion is not taken for it."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, EXACT, drawn_start, prior_of, random_covariance, random_state, since

from vioframe.bench import run_backend
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.standstill import Standstill, StandstillDetector, common_motion_px
from vioframe.geometry import so3
from vioframe.parts import registry
from vioframe.simulation import simulated_sequence
from vioframe.simulation.flights import ShapedFlight, levelled
from vioframe.types import DBA, DBG, DTHETA, DV, Estimate, FrameTracks, ImuNoise, ImuSegment, Start, Status, g_W
from vioframe_msckf.backend import Msckf
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.state import IMU
from vioframe_msckf.updates import hold_still
from vioframe_sliding_window.backend import SlidingWindow

NOISE = ImuNoise(gyro_density=1.7e-4, accel_density=2e-3, gyro_walk=2e-5, accel_walk=3e-3, rate_hz=200.0)


def held(estimate: Estimate) -> bool:
    """Whether the frame was answered by a zero-velocity update alone."""
    return estimate.status is Status.TRACKING and set(estimate.stage_seconds) == {"standstill"}


def frame(t_s: float, xy, ids=None) -> FrameTracks:
    xy = np.asarray(xy, dtype=np.float64)
    ids = np.arange(len(xy)) if ids is None else np.asarray(ids)
    return FrameTracks(round(t_s * 1e9), ids, np.zeros(len(xy), np.int64), xy, 0.001 * xy)


def test_what_noise_points_have_is_found_anew_after_a_standstill():
    """It sets off at 4 s and stands again at 13 s."""
    sequence = simulated_sequence("stop_and_go", pixel_sigma=0.1, duration_s=14.0)
    backend = Msckf()
    life = LifeCycle(backend, sequence.calibration)
    least_px, px = MsckfOptions().pixel_sigma, {True: [], False: []}
    for packet in sequence.packets:
        estimate = life.process(*packet)
        if estimate.state is not None:
            px[held(estimate)].append(backend.point_noise.px)
    assert min(px[True]) > 3.0 * least_px
    assert min(px[False]) == least_px


def test_standstill_does_not_drift_and_nothing_grows():
    """Tracks that never end leave the filter as it is, for ten seconds."""
    sequence = simulated_sequence("standstill", pixel_sigma=0.1, duration_s=12.0)
    backend = Msckf()
    life = LifeCycle(backend, sequence.calibration)
    sizes = []
    estimates = []
    for packet in sequence.packets:
        estimates.append(life.process(*packet))
        if estimates[-1].state is not None:
            sizes.append((len(backend.state.cov), len(backend._observations.ids)))
    states = [e.state for e in estimates if e.state is not None]
    assert (states[-1].t_ns - states[0].t_ns) * 1e-9 > 10.0
    assert any(event == "initialised (static)" for e in estimates for event in e.events)
    assert {e.status for e in estimates[-len(states) :]} == {Status.TRACKING}
    p_WB = np.array([s.p_WB for s in states])
    assert np.linalg.norm(p_WB - p_WB[0], axis=1).max() < 2e-3
    assert max(np.linalg.norm(s.v_WB) for s in states[1:]) < 0.01
    assert max(sizes) == sizes[-1] == sizes[len(sizes) // 2]
    # Each state tells its own uncertainty, and it neither explodes nor vanishes.
    sigma = np.sqrt(np.diag(states[-1].cov))
    assert sigma[3:6].min() > 1e-6
    assert sigma[3:6].max() < 0.01


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("speed", [0.05, 0.1])
def test_slow_motion_is_not_taken_for_standstill(axis, speed):
    """Creeping ahead, aside and up, seen almost without noise."""
    R_LB = levelled(CALIBRATION.cameras[0].R_BC)
    creep = ShapedFlight(
        6.0, lambda t_s: np.outer(t_s, speed * np.eye(3)[axis]), lambda t_s: np.zeros((len(t_s), 3)), R_LB
    )
    sequence = simulated_sequence(creep, pixel_sigma=0.1, duration_s=6.0)
    run = run_backend(since(sequence, 1), Msckf(), initial_state=drawn_start(sequence, 1, 0))
    assert not any(map(held, run.estimates))


def test_hover_is_not_taken_for_standstill():
    """A few centimetres to and fro, and images that are good to a tenth of a pixel."""
    sequence = simulated_sequence("hover", pixel_sigma=0.1, duration_s=10.0)
    run = run_backend(since(sequence, 1), Msckf(), initial_state=drawn_start(sequence, 1, 0))
    assert not any(map(held, run.estimates))
    speed = np.linalg.norm([s.v_WB for s in sequence.true_states], axis=1)
    assert 0.03 < np.median(speed) < 0.3


def test_stop_and_go_is_held_at_every_stop_only():
    sequence = simulated_sequence("stop_and_go", pixel_sigma=0.1, duration_s=26.0)
    run = run_backend(since(sequence, 1), Msckf(), initial_state=drawn_start(sequence, 1, 0))
    speed = np.linalg.norm([s.v_WB for s in sequence.true_states[1:]], axis=1)
    is_held = np.array(list(map(held, run.estimates)))
    # What is held at a frame is that of 0.2 s before, unless the body has just come to rest.
    assert speed[np.flatnonzero(is_held) - 4].max() < 0.03
    # Half a second of each stop goes by before it is seen to be one.
    assert is_held[speed < 1e-3].mean() > 0.7
    errors = [np.linalg.norm(s.p_WB - t.p_WB) for s, t in zip(run.states, sequence.true_states[1:], strict=True)]
    assert max(errors) < 0.2


@pytest.mark.parametrize(("name", "most"), [("msckf", 40.0), ("sliding_window", 25.0), ("loose_ekf", 5.0)])
def test_take_off_is_followed_from_where_it_begins(name, most):
    """Images show it a while later; had the body been held until then, its error would be hundreds of variances."""
    sequence = simulated_sequence("inspection", pixel_sigma=0.1, duration_s=5.0, seed=1)
    backend = registry.load().create_backend(name)
    start = drawn_start(sequence, 1, 0)
    run = run_backend(since(sequence, 1), backend, EXACT, start)
    errors = np.array([s.p_WB - t.p_WB for s, t in zip(run.states, sequence.true_states[1:], strict=True)])
    assert np.linalg.norm(errors, axis=1)[: 3 * 20].max() < 0.035
    nees = [e @ np.linalg.solve(s.cov[3:6, 3:6], e) for s, e in zip(run.states, errors, strict=True)]
    assert max(nees) < most


@pytest.mark.parametrize("seed", range(3))
def test_what_a_body_crept_at_rest_is_no_velocity_of_its_take_off(seed):
    """For four seconds it creeps by 2 mm/s, which no picture shows in half a second, and then goes up.

    Had it stood until the window saw it elsewhere, 0.2 s later, it would have jumped there, at 4 to 5 cm/s.
    """
    R_LB = levelled(CALIBRATION.cameras[0].R_BC)

    def position(t_s):
        crept, risen = 2e-3 * np.clip(t_s, 0.0, 4.0), 0.15 * np.clip(t_s - 4.0, 0.0, 1.2) ** 2
        return np.column_stack([np.zeros_like(t_s), crept, risen])

    flight = ShapedFlight(6.0, position, lambda t_s: np.zeros((len(t_s), 3)), R_LB)
    sequence = simulated_sequence(flight, pixel_sigma=0.1, duration_s=6.0, seed=seed)
    run = run_backend(since(sequence, 1), SlidingWindow(), EXACT, drawn_start(sequence, 1, seed))
    pairs = list(zip(run.states, sequence.true_states[1:], strict=True))
    assert max(np.linalg.norm(s.v_WB - t.v_WB) for s, t in pairs[80:]) < 0.03
    errors = [(s.p_WB - t.p_WB, s.cov[3:6, 3:6]) for s, t in pairs]
    assert max(e @ np.linalg.solve(cov, e) for e, cov in errors) < 15.0


def test_a_filter_sets_off_at_a_velocity_that_the_picture_did_not_show():
    sequence = simulated_sequence("standstill", NOISE, 0.1, duration_s=2.0)
    frames, noise = sequence.packets[1:4], sequence.calibration.imu
    backend = Msckf()
    backend.begin(Start(drawn_start(sequence, 1, 0), prior_of(sequence.calibration), noise, *frames[0]))
    assert set(backend.process(*frames[1], still=True).stage_seconds) == {"standstill"}
    expected = copy.deepcopy(backend.state)
    expected.cov[DV, DV] += 5e-3**2 * np.eye(3)
    imu, tracks = frames[2]
    expected.propagate(imu, noise, True)
    in_the_dark = tracks.only(np.zeros(len(tracks.ids), bool))
    set_off = backend.process(imu, in_the_dark, still=False).state
    np.testing.assert_allclose(set_off.cov, expected.cov[:IMU, :IMU], rtol=1e-9, atol=1e-15)


def test_motion_is_what_the_common_tracks_do_together():
    before = frame(0.0, np.zeros((12, 2)), ids=np.arange(12))
    now = frame(0.5, [[3.0, 4.0]] * 9 + [[50.0, 0.0]] * 4, ids=[*range(11, 2, -1), 20, 21, 2, 1])
    assert common_motion_px(before, now) == 5.0
    assert common_motion_px(before, frame(0.5, np.zeros((9, 2)))) == np.inf


def test_trembling_is_no_motion_but_a_shift_a_turn_and_an_approach_are():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, 700.0, (100, 2))
    trembling = [frame(0.5 * k, xy + rng.normal(0.0, 1.0, xy.shape)) for k in range(2)]
    assert common_motion_px(*trembling) < 0.7
    outward = xy - xy.mean(axis=0)
    far_px = np.median(np.linalg.norm(outward, axis=1))
    along, around = 2.0 / far_px * outward, 2.0 / far_px * outward[:, ::-1] * np.array([1.0, -1.0])
    for moved in (xy + np.array([0.0, 2.0]), xy + along, xy + around):
        assert common_motion_px(frame(0.0, xy), frame(0.5, moved)) == pytest.approx(2.0, rel=0.15)


def test_cameras_are_looked_at_one_by_one():
    """A point in two cameras is two tracks, and what is opposite in two cameras that look away is motion."""
    xy = np.random.default_rng(0).uniform(0.0, 700.0, (24, 2))
    ids, camera = np.tile(np.arange(12), 2), np.repeat([0, 1], 12)
    shift = np.repeat([[2.0, 0.0], [-2.0, 0.0]], 12, axis=0)

    def seen(time_s, xy):
        return replace(frame(time_s, xy), ids=ids, camera=camera)

    assert common_motion_px(seen(0.0, xy), seen(0.5, xy)) == 0.0
    assert common_motion_px(seen(0.0, xy), seen(0.5, xy + shift)) == pytest.approx(2.0, rel=0.01)


def test_detector_looks_half_a_second_back():
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.0, 700.0, (30, 2))
    detector = StandstillDetector(0.7)
    # 0.1 px a frame, which no two neighbours show, is 1 px in half a second.
    assert not any(detector.sees_standstill(frame(0.05 * k, xy + 0.1 * k)) for k in range(40))
    detector = StandstillDetector(0.7)
    seen = [detector.sees_standstill(frame(0.05 * k, xy)) for k in range(20)]
    assert seen == [False] * 10 + [True] * 10
    # After a gap the last half second is not known.
    assert detector.sees_standstill(frame(5.0, xy + 3.0)) is False


def still_readings(state, rng, rate=0.0, shake=0.0):
    t_ns = 5_000_000 * np.arange(11, dtype=np.int64)
    white = rng.normal(size=(2, 11, 3)) * np.array([1.7e-4, 2e-3])[:, None, None] * np.sqrt(200.0)
    force = -state.R_WB.T @ g_W + state.bias_accel_B
    return ImuSegment(t_ns, state.bias_gyro_B + rate + white[0], force + shake + white[1])


@pytest.mark.parametrize(
    ("v", "rate", "shake", "held"),
    [
        (0.0, 0.0, 0.0, True),
        (0.002, 0.0, 0.0, True),
        (0.3, 0.0, 0.0, False),
        (0.0, 0.2, 0.0, False),
        (0.0, 0.0, 1.0, False),
    ],
)
def test_is_held_only_where_the_imu_agrees(v, rate, shake, held):
    state, rng = random_state(1, scale=0.005), np.random.default_rng(1)
    state.v_WB = np.array([v, 0.0, 0.0])
    before = copy.deepcopy(state)
    assert hold_still(state, still_readings(state, rng, rate, shake), NOISE, True) is held
    if held:
        assert np.linalg.norm(state.v_WB) < max(v, 5e-4)
        assert (np.diag(state.cov)[DV] < np.diag(before.cov)[DV]).all()
    else:
        np.testing.assert_array_equal(state.cov, before.cov)
        np.testing.assert_array_equal(state.v_WB, before.v_WB)


def test_readings_at_rest_agree_with_standstill_at_the_nominal_rate():
    """Errors are drawn from the state's covariance, means of readings from their noise: one in twenty is refused."""
    rng, R_WB = np.random.default_rng(3), so3.exp([0.3, -0.2, 1.0])
    bias_gyro, bias_accel = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.05, -0.1])
    cov = 0.005**2 * random_covariance(rng, IMU)
    root, sigma = np.linalg.cholesky(cov), Standstill(bias_gyro, bias_accel, 0.05, NOISE).sigma
    agreed = []
    for _ in range(4000):
        d, noise = root @ rng.normal(size=IMU), sigma * rng.normal(size=9)
        gyro, accel = bias_gyro + noise[:3], -R_WB.T @ g_W + bias_accel + noise[3:6]
        still, R = Standstill(gyro, accel, 0.05, NOISE), R_WB @ so3.exp(-d[DTHETA])
        residual = still.residual(R, noise[6:] - d[DV], bias_gyro - d[DBG], bias_accel - d[DBA])
        agreed.append(still.agrees(residual, still.jacobian(R, np.zeros(3)), cov))
    # Of a degree of freedom more or less it would be 0.968 or 0.922; 4000 scatter by 0.0034.
    assert np.mean(agreed) == pytest.approx(0.95, abs=0.012)


def test_holding_still_is_the_kalman_update_with_numeric_jacobians():
    """Expected readings as a function of the state, differentiated on the manifold."""
    state, rng = random_state(2, scale=0.005), np.random.default_rng(2)
    state.v_WB = np.array([0.003, -0.002, 0.001])
    imu = still_readings(state, rng)
    before = copy.deepcopy(state)

    def expected(d):
        R_BW = (before.R_WB @ so3.exp(d[DTHETA])).T
        force = -R_BW @ g_W + before.bias_accel_B + d[DBA]
        return np.concatenate([before.bias_gyro_B + d[DBG], force, R_BW @ (before.v_WB + d[DV])])

    eps = 1e-6
    H = np.zeros((9, len(state.cov)))
    H[:, :IMU] = np.stack([(expected(eps * e) - expected(-eps * e)) / (2 * eps) for e in np.eye(IMU)], axis=1)
    residual = np.concatenate([imu.gyro_B.mean(axis=0), imu.accel_B.mean(axis=0), np.zeros(3)]) - expected(np.zeros(15))
    P = before.cov.copy()
    P[DBG, DBG] += np.eye(3) * NOISE.gyro_walk**2 * imu.duration_s
    P[DBA, DBA] += np.eye(3) * NOISE.accel_walk**2 * imu.duration_s
    assert hold_still(state, imu, NOISE, first_estimates=False)
    # The noise of the sensors ten times over, for a body that stands but shakes; that of the mean of a bias that walks
    # meanwhile; and a velocity of 1 cm/s.
    T = imu.duration_s
    gyro = np.hypot(10 * NOISE.gyro_density / np.sqrt(T), NOISE.gyro_walk * np.sqrt(T / 3))
    accel = np.hypot(10 * NOISE.accel_density / np.sqrt(T), NOISE.accel_walk * np.sqrt(T / 3))
    sigma = np.repeat([gyro, accel, 0.01], 3)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(sigma**2))
    dx = K @ residual
    np.testing.assert_allclose(state.cov, P - K @ H @ P, atol=1e-9 * np.abs(P).max())
    np.testing.assert_allclose(so3.log(before.R_WB.T @ state.R_WB), dx[DTHETA], atol=1e-9)
    np.testing.assert_allclose(state.v_WB - before.v_WB, dx[DV], atol=1e-9)
    np.testing.assert_allclose(state.bias_accel_B - before.bias_accel_B, dx[DBA], atol=1e-9)
