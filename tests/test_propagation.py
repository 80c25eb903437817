"""Strap-down propagation against numeric integration, numeric differences and Monte Carlo."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vioframe.estimation.inertial.gyro_path import GyroPath
from vioframe.estimation.inertial.propagation import Propagation, propagate, yaw_consistent_transition
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, DV, NS_PER_S, Float, ImuNoise, ImuSegment, g_W

NOISE = ImuNoise(gyro_density=2e-4, accel_density=2e-3, gyro_walk=2e-5, accel_walk=3e-3, rate_hz=200.0)
BLOCKS = {"theta": DTHETA, "p": DP, "v": DV, "bg": DBG, "ba": DBA}


@dataclass(frozen=True)
class Start:
    R_WB: Float
    p_WB: Float
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float

    @classmethod
    def random(cls, rng: np.random.Generator) -> "Start":
        return cls(so3.exp(rng.normal(size=3)), *(scale * rng.normal(size=3) for scale in (5.0, 2.0, 0.05, 0.3)))

    def moved(self, d: Float) -> "Start":
        """By the error ``d`` (15,)."""
        return Start(
            self.R_WB @ so3.exp(d[DTHETA]),
            self.p_WB + d[DP],
            self.v_WB + d[DV],
            self.bias_gyro_B + d[DBG],
            self.bias_accel_B + d[DBA],
        )


def readings(rng: np.random.Generator, intervals: int = 20, rate_hz: float = 200.0) -> ImuSegment:
    """A hand-held IMU: smooth over some 0.1 s, at several rad/s and half a g."""
    t_ns = NS_PER_S + np.round(np.arange(intervals + 1) * (NS_PER_S / rate_hz)).astype(np.int64)
    t_s = (t_ns - t_ns[0]) * 1e-9
    phase, rate = rng.uniform(0.0, 2.0 * np.pi, (2, 6)), rng.uniform(3.0, 15.0, (2, 6))
    waves = np.sin(rate[0] * t_s[:, None] + phase[0]) + 0.5 * np.sin(rate[1] * t_s[:, None] + phase[1])
    return ImuSegment(t_ns, 2.0 * waves[:, :3], np.array([0.0, 0.0, 9.81]) + 4.0 * waves[:, 3:])


def run(imu: ImuSegment, start: Start, noise: ImuNoise = NOISE) -> Propagation:
    return propagate(imu, start.R_WB, start.p_WB, start.v_WB, start.bias_gyro_B, start.bias_accel_B, noise)


def error(of: Propagation, to: Propagation) -> Float:
    """(9,) [dtheta dp dv] that takes one end to the other."""
    return np.concatenate([so3.log(of.R_WB.T @ to.R_WB), to.p_WB - of.p_WB, to.v_WB - of.v_WB])


def integrated(imu: ImuSegment, start: Start) -> tuple[Float, Float, Float]:
    """R, p, v at the end: the differential equations solved to rounding, interval by interval."""
    R, p, v = start.R_WB, start.p_WB, start.v_WB
    for h, *ends in zip(imu.dt, imu.gyro_B, imu.gyro_B[1:], imu.accel_B, imu.accel_B[1:], strict=False):
        solution = solve_ivp(
            _derivative(h, start, *ends),
            (0.0, h),
            np.concatenate([R.ravel(), p, v]),
            method="DOP853",
            rtol=1e-13,
            atol=1e-14,
        )
        y = solution.y[:, -1]
        R, p, v = y[:9].reshape(3, 3), y[9:12], y[12:]
    return R, p, v


def _derivative(
    h: float, start: Start, w_0: Float, w_1: Float, a_0: Float, a_1: Float
) -> Callable[[float, Float], Float]:
    def derivative(t: float, y: Float) -> Float:
        R = y[:9].reshape(3, 3)
        w = w_0 + t / h * (w_1 - w_0) - start.bias_gyro_B
        a = a_0 + t / h * (a_1 - a_0) - start.bias_accel_B
        return np.concatenate([(R @ so3.hat(w)).ravel(), y[12:], R @ a + g_W])

    return derivative


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_numeric_integration(seed):
    rng = np.random.default_rng(seed)
    imu, start = readings(rng), Start.random(rng)
    step, (R, p, v) = run(imu, start), integrated(imu, start)
    assert np.linalg.norm(so3.log(step.R_WB.T @ R)) < 2e-9
    np.testing.assert_allclose(step.v_WB, v, rtol=0.0, atol=2e-9)
    np.testing.assert_allclose(step.p_WB, p, rtol=0.0, atol=2e-9)


def test_is_of_fourth_order():
    """Halving the intervals of the same piecewise linear readings divides the error by about sixteen."""
    rng = np.random.default_rng(7)
    imu, start = readings(rng, intervals=8, rate_hz=40.0), Start.random(rng)
    R, p, v = integrated(imu, start)
    errors = []
    for _ in range(3):
        errors.append(error(run(imu, start), Propagation(R, p, v, np.eye(15), np.eye(15))).reshape(3, 3))
        t_ns = np.insert(imu.t_ns, np.arange(1, len(imu.t_ns)), (imu.t_ns[1:] + imu.t_ns[:-1]) // 2)
        imu = ImuSegment(t_ns, _with_midpoints(imu.gyro_B), _with_midpoints(imu.accel_B))
    sizes = np.linalg.norm(errors, axis=2)
    ratios = sizes[:-1] / sizes[1:]
    assert (ratios > 14.0).all(), ratios
    assert (ratios < 18.0).all(), ratios


def _with_midpoints(x: Float) -> Float:
    return np.insert(x, np.arange(1, len(x)), 0.5 * (x[1:] + x[:-1]), axis=0)


def test_free_fall_and_standstill_are_exact():
    t_ns = np.arange(201, dtype=np.int64) * 5_000_000
    start = Start(so3.exp([0.3, -0.2, 1.0]), np.ones(3), np.array([1.0, 2.0, 3.0]), np.zeros(3), np.zeros(3))
    falling = run(ImuSegment(t_ns, np.zeros((201, 3)), np.zeros((201, 3))), start)
    np.testing.assert_allclose(falling.p_WB, start.p_WB + start.v_WB + 0.5 * g_W, atol=1e-12)
    np.testing.assert_allclose(falling.v_WB, start.v_WB + g_W, atol=1e-12)

    resting = replace(start, v_WB=np.zeros(3))
    still = run(ImuSegment(t_ns, np.zeros((201, 3)), np.tile(-start.R_WB.T @ g_W, (201, 1))), resting)
    np.testing.assert_allclose(still.p_WB, start.p_WB, atol=1e-12)
    np.testing.assert_allclose(still.v_WB, 0.0, atol=1e-12)


def test_input_is_not_changed_and_a_single_reading_goes_nowhere():
    rng = np.random.default_rng(0)
    imu, start = readings(rng), Start.random(rng)
    before = [x.copy() for x in (start.R_WB, start.p_WB, start.v_WB)]
    run(imu, start)
    assert all((a == b).all() for a, b in zip(before, (start.R_WB, start.p_WB, start.v_WB), strict=True))
    nowhere = run(ImuSegment(imu.t_ns[:1], imu.gyro_B[:1], imu.accel_B[:1]), start)
    assert (nowhere.R_WB == start.R_WB).all()
    assert (nowhere.transition == np.eye(15)).all()
    assert (nowhere.noise == 0.0).all()


@pytest.mark.parametrize("seed", range(3))
def test_transition_is_the_derivative_on_the_manifold(seed):
    rng = np.random.default_rng(seed)
    imu, start = readings(rng, intervals=10), Start.random(rng)
    step, eps = run(imu, start), 1e-4
    numeric = np.eye(15)
    for k, e in enumerate(np.eye(15)):
        plus, minus = run(imu, start.moved(eps * e)), run(imu, start.moved(-eps * e))
        numeric[:9, k] = (error(step, plus) - error(step, minus)) / (2.0 * eps)
    for row in BLOCKS:
        for column in BLOCKS:
            expected, got = numeric[BLOCKS[row], BLOCKS[column]], step.transition[BLOCKS[row], BLOCKS[column]]
            # How the bias of the gyroscope bends the specific force is taken to first order within an interval.
            tolerance = 2e-3 if column in ("bg", "ba") else 1e-7
            scale = max(np.linalg.norm(expected), 1e-3)
            assert np.linalg.norm(got - expected) < tolerance * scale, (row, column)


def test_noise_is_what_noisy_readings_scatter_by():
    """Monte Carlo over white noise and wandering biases, as a sensor of these densities would read."""
    rng = np.random.default_rng(11)
    # Each as loud as the others, so that the biases' correlation with the motion shows.
    noise = ImuNoise(gyro_density=2e-3, accel_density=5e-3, gyro_walk=1.5e-2, accel_walk=2e-2, rate_hz=200.0)
    imu, start = readings(rng, intervals=100), Start.random(rng)
    truth, root = run(imu, start, noise), np.sqrt(noise.rate_hz)
    count, runs = len(imu.t_ns), 4000
    errors = np.empty((runs, 15))
    for k in range(runs):
        walks = [
            np.cumsum(rng.normal(0.0, walk / root, (count, 3)), axis=0) for walk in (noise.gyro_walk, noise.accel_walk)
        ]
        white = [rng.normal(0.0, d * root, (count, 3)) for d in (noise.gyro_density, noise.accel_density)]
        noisy = ImuSegment(imu.t_ns, imu.gyro_B + walks[0] + white[0], imu.accel_B + walks[1] + white[1])
        errors[k] = np.concatenate([error(run(noisy, start, noise), truth), walks[0][-1], walks[1][-1]])
    sample = errors.T @ errors / runs
    sigma = np.sqrt(np.diag(truth.noise))
    scaled = (sample - truth.noise) / np.outer(sigma, sigma)
    # A sample covariance of 4000 scatters by 1.6-2.2 %; the two ends of a segment count half, another 1 %.
    assert np.abs(scaled).max() < 0.07
    # The cross terms must be there to be right.
    correlation = truth.noise / np.outer(sigma, sigma)
    for row, column in combinations(BLOCKS, 2):
        apart = (row, column) in (("theta", "ba"), ("bg", "ba"))
        assert np.linalg.norm(correlation[BLOCKS[row], BLOCKS[column]]) > 0.3 or apart


def test_noise_of_two_segments_in_turn_is_that_of_both_together():
    rng = np.random.default_rng(5)
    imu, start = readings(rng, intervals=40), Start.random(rng)
    whole = run(imu, start)
    first = run(ImuSegment(imu.t_ns[:16], imu.gyro_B[:16], imu.accel_B[:16]), start)
    middle = replace(start, R_WB=first.R_WB, p_WB=first.p_WB, v_WB=first.v_WB)
    second = run(ImuSegment(imu.t_ns[15:], imu.gyro_B[15:], imu.accel_B[15:]), middle)
    np.testing.assert_allclose(second.transition @ first.transition, whole.transition, atol=1e-12)
    chained = second.transition @ first.noise @ second.transition.T + second.noise
    np.testing.assert_allclose(chained, whole.noise, rtol=1e-10, atol=1e-20)


def unobservable(R_WB: Float, p_WB: Float, v_WB: Float) -> Float:
    """(15, 4): a shift of the world along its axes, and its rotation about gravity."""
    N = np.zeros((15, 4))
    up = np.array([0.0, 0.0, 1.0])
    N[DP, :3] = np.eye(3)
    N[DTHETA, 3], N[DP, 3], N[DV, 3] = R_WB.T @ up, np.cross(up, p_WB), np.cross(up, v_WB)
    return N


def test_yaw_consistent_transition_is_the_plain_one_at_the_same_states():
    rng = np.random.default_rng(2)
    imu, start = readings(rng), Start.random(rng)
    step = run(imu, start)
    consistent = yaw_consistent_transition(
        step.transition,
        (start.R_WB, start.p_WB, start.v_WB),
        (step.R_WB, step.p_WB, step.v_WB),
        imu.duration_s,
    )
    np.testing.assert_allclose(consistent, step.transition, atol=1e-12)


def test_yaw_consistent_transition_carries_the_unobservable_directions_over():
    """Also where the start's first estimate is not the state that was propagated; the plain transition does not."""
    rng = np.random.default_rng(3)
    imu, start = readings(rng), Start.random(rng)
    step = run(imu, start)
    first = start.moved(0.05 * rng.normal(size=15))
    begin, end = (first.R_WB, first.p_WB, first.v_WB), (step.R_WB, step.p_WB, step.v_WB)
    plain = step.transition.copy()
    consistent = yaw_consistent_transition(step.transition, begin, end, imu.duration_s)
    assert (step.transition == plain).all()
    np.testing.assert_allclose(consistent @ unobservable(*begin), unobservable(*end), atol=1e-12)
    assert np.abs(plain @ unobservable(*begin) - unobservable(*end)).max() > 1e-2


def test_the_path_of_a_gyroscope_is_exact_where_its_rate_grows_evenly_about_one_axis():
    axis = np.array([0.6, -0.48, 0.64])
    t_s = np.linspace(0.0, 1.0, 21)
    path = GyroPath(t_s, (0.3 + 2.0 * t_s)[:, None] * axis)
    asked_s = np.random.default_rng(0).uniform(-0.02, 1.02, (4, 3))  # of any shape, and a little beyond the ends
    R_B0B, rate_B = path.at(asked_s)
    np.testing.assert_allclose(rate_B, (0.3 + 2.0 * asked_s)[..., None] * axis, atol=1e-12)
    np.testing.assert_allclose(R_B0B, so3.exp((0.3 * asked_s + asked_s**2)[..., None] * axis), atol=1e-12)
