"""Pre-integration against exact motion, gtsam, numeric Jacobians, and samples of its noise."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy.stats import chi2

from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.inertial.preintegration import Preintegrated, join_segments, preintegrate
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, DV, Float, ImuNoise, ImuSegment, NavState, g_W

NOISE = ImuNoise(gyro_density=1.7e-3, accel_density=2.0e-2, gyro_walk=4.0e-4, accel_walk=5.0e-3)
ZERO = np.zeros(3)
BIAS_GYRO, BIAS_ACCEL = np.array([0.01, -0.02, 0.03]), np.array([0.1, 0.05, -0.1])


def exact_state(t_s: float) -> NavState:
    """A motion known in closed form: the attitude turns about a tilted axis while the path swings on all axes."""
    angle = 0.8 * np.sin(1.3 * t_s) + 0.5 * t_s
    phase = np.array([0.9, 1.4, 1.1]) * t_s + np.array([0.0, 0.5, 1.0])
    rate = np.array([0.9, 1.4, 1.1])
    size = np.array([1.5, 1.0, 0.6])
    return NavState(
        round(t_s * 1e9),
        so3.exp(np.array([0.48, -0.6, 0.64]) * angle),
        size * np.sin(phase),
        size * rate * np.cos(phase),
        ZERO,
        ZERO,
    )


def exact_segment(
    start_s: float, stop_s: float, rate_hz: float, bias_gyro: Float = ZERO, bias_accel: Float = ZERO
) -> ImuSegment:
    """What an ideal IMU with these biases reads along :func:`exact_state`."""
    t_ns = np.round(np.linspace(start_s, stop_s, round((stop_s - start_s) * rate_hz) + 1) * 1e9).astype(np.int64)
    t = t_ns[:, None] * 1e-9
    gyro = np.array([0.48, -0.6, 0.64]) * (0.8 * 1.3 * np.cos(1.3 * t) + 0.5)
    rate = np.array([0.9, 1.4, 1.1])
    a_W = -np.array([1.5, 1.0, 0.6]) * rate**2 * np.sin(rate * t + np.array([0.0, 0.5, 1.0]))
    R_WB = np.stack([exact_state(s).R_WB for s in t[:, 0]])
    accel = (np.swapaxes(R_WB, -1, -2) @ (a_W - g_W)[..., None])[..., 0]
    return ImuSegment(t_ns, gyro + bias_gyro, accel + bias_accel)


def error_of(a: NavState, b: NavState) -> Float:
    return np.concatenate([so3.log(b.R_WB.T @ a.R_WB), a.p_WB - b.p_WB, a.v_WB - b.v_WB])


def random_states(rng: np.random.Generator, count: int) -> StateArrays:
    return StateArrays(
        so3.exp(rng.normal(0.0, 1.0, (count, 3))),
        rng.normal(0.0, 2.0, (count, 3)),
        rng.normal(0.0, 1.0, (count, 3)),
        rng.normal(0.0, 0.02, (count, 3)),
        rng.normal(0.0, 0.05, (count, 3)),
    )


def numeric_jacobian(function, size: int, step: float = 1e-6) -> Float:
    columns = [(function(step * e) - function(-step * e)) / (2.0 * step) for e in np.eye(size)]
    return np.stack(columns, axis=-1)


def test_prediction_follows_an_exact_motion_and_converges_with_the_square_of_the_interval():
    truth = exact_state(2.0)

    def error(rate_hz: float) -> float:
        measured = preintegrate(exact_segment(1.0, 2.0, rate_hz), ZERO, ZERO, NOISE)
        return float(np.linalg.norm(error_of(measured.predict(exact_state(1.0)), truth)))

    errors = [error(rate) for rate in (100.0, 200.0, 400.0)]
    assert errors[1] < 1e-4
    np.testing.assert_allclose([errors[0] / errors[1], errors[1] / errors[2]], 4.0, rtol=0.05)


def test_biases_are_subtracted():
    bias_gyro, bias_accel = np.array([0.02, -0.05, 0.08]), np.array([0.2, -0.1, 0.3])
    clean = preintegrate(exact_segment(0.0, 0.5, 200.0), ZERO, ZERO, NOISE)
    biased = preintegrate(exact_segment(0.0, 0.5, 200.0, bias_gyro, bias_accel), bias_gyro, bias_accel, NOISE)
    np.testing.assert_allclose(biased.dR, clean.dR, atol=1e-12)
    np.testing.assert_allclose([biased.dp, biased.dv], [clean.dp, clean.dv], atol=1e-12)


def test_bias_jacobian_is_the_derivative_of_integrating_anew():
    bias_gyro, bias_accel = np.array([0.02, -0.05, 0.08]), np.array([0.2, -0.1, 0.3])
    measured = preintegrate(exact_segment(0.3, 1.3, 100.0), bias_gyro, bias_accel, NOISE)

    def relative(d: Float) -> Float:
        other = measured.repropagated(bias_gyro + d[:3], bias_accel + d[3:])
        return np.concatenate([so3.log(measured.dR.T @ other.dR), other.dp, other.dv])

    np.testing.assert_allclose(measured.bias_jacobian, numeric_jacobian(relative, 6), atol=1e-8)


def test_first_order_correction_is_wrong_to_second_order_only():
    measured = preintegrate(exact_segment(0.3, 1.3, 200.0), ZERO, ZERO, NOISE)

    def error(size: float) -> float:
        change = size * np.array([0.6, -0.48, 0.64]), size * np.array([1.0, 2.0, -2.0])
        dR, dp, dv = measured.corrected(*change)
        exact = measured.repropagated(*change)
        return float(np.linalg.norm(np.concatenate([so3.log(exact.dR.T @ dR), dp - exact.dp, dv - exact.dv])))

    assert error(0.02) < 5e-4
    np.testing.assert_allclose(error(0.02) / error(0.01), 4.0, rtol=0.05)


def test_joined_segments_integrate_as_one_and_match_the_composition_of_both():
    whole, first, second = (exact_segment(*span, 200.0) for span in ((0.0, 0.8), (0.0, 0.3), (0.3, 0.8)))
    joined = join_segments([first, second])
    np.testing.assert_array_equal(joined.t_ns, whole.t_ns)
    one = preintegrate(joined, ZERO, ZERO, NOISE).predict(exact_state(0.0))
    two = preintegrate(second, ZERO, ZERO, NOISE).predict(
        preintegrate(first, ZERO, ZERO, NOISE).predict(exact_state(0.0))
    )
    np.testing.assert_allclose(error_of(one, two), 0.0, atol=1e-12)
    assert join_segments([first, ImuSegment(second.t_ns, second.gyro_B, second.accel_B, 0.07)]).largest_gap_s == 0.07


def test_what_is_uncertain_where_the_motion_begins_is_moved_to_its_end():
    """As it would be if the state it begins from were uncertain; also when the readings are integrated anew."""
    imu, sigma = exact_segment(0.3, 1.1, 200.0), np.repeat([0.01, 0.03, 0.2], 3)
    begun = preintegrate(imu, ZERO, ZERO, NOISE, sigma)
    for bias in (ZERO, 0.02 * np.ones(3)):
        state = replace(exact_state(0.3), bias_gyro_B=bias, bias_accel_B=bias)
        uncertain = replace(state, cov=np.diag(np.append(sigma, np.zeros(6)) ** 2))
        expected = preintegrate(imu, bias, bias, NOISE).predict(uncertain).cov
        found = begun.repropagated(bias, bias).predict(replace(state, cov=np.zeros((15, 15)))).cov
        np.testing.assert_allclose(found, expected, atol=1e-9 * expected.max())


def test_covariance_agrees_with_samples():
    """White noise on every reading and walking biases; the sum of squared Mahalanobis distances is chi-square."""
    rng = np.random.default_rng(4)
    rate_hz, samples = 200.0, 1500
    clean = exact_segment(0.0, 0.6, rate_hz)
    # Each as loud as the others, so that the biases' correlation with the motion shows.
    noise = ImuNoise(gyro_density=1.7e-3, accel_density=5.0e-3, gyro_walk=8.0e-3, accel_walk=2.0e-2)
    truth = preintegrate(clean, ZERO, ZERO, noise)
    count = len(clean.t_ns)
    errors = np.empty((samples, 15))
    for k in range(samples):
        walk = np.concatenate([np.zeros((1, 6)), rng.normal(0.0, np.sqrt(1.0 / rate_hz), (count - 1, 6))]).cumsum(
            axis=0
        )
        white = rng.normal(0.0, np.sqrt(rate_hz), (count, 6))
        gyro = clean.gyro_B + noise.gyro_density * white[:, :3] + noise.gyro_walk * walk[:, :3]
        accel = clean.accel_B + noise.accel_density * white[:, 3:] + noise.accel_walk * walk[:, 3:]
        noisy = preintegrate(ImuSegment(clean.t_ns, gyro, accel), ZERO, ZERO, noise)
        # The error is truth beyond measurement; the true bias at the end is what it walked to.
        errors[k, DTHETA] = so3.log(noisy.dR.T @ truth.dR)
        errors[k, DP], errors[k, DV] = truth.dp - noisy.dp, truth.dv - noisy.dv
        errors[k, DBG], errors[k, DBA] = noise.gyro_walk * walk[-1, :3], noise.accel_walk * walk[-1, 3:]
    distances = np.einsum("ki,ij,kj->k", errors, np.linalg.inv(truth.cov), errors)
    low, high = chi2.ppf([0.0005, 0.9995], 15 * samples) / samples
    assert low < distances.mean() < high
    sigma = np.sqrt(np.diag(truth.cov))
    correlation, sampled = (cov / np.outer(sigma, sigma) for cov in (truth.cov, errors.T @ errors / samples))
    # A sample covariance of 1500 scatters by 2.6-3.7 %.
    assert np.abs(sampled - correlation).max() < 0.12
    # The cross terms must be there to be right.
    for row, column in combinations((DTHETA, DP, DV, DBG, DBA), 2):
        apart = (row, column) in ((DTHETA, DBA), (DBG, DBA))
        assert np.linalg.norm(correlation[row, column]) > 0.3 or apart


def test_residual_vanishes_at_the_prediction_and_is_the_error_beside_it():
    rng = np.random.default_rng(0)
    state = random_states(rng, 1)
    measured = preintegrate(exact_segment(0.0, 0.4, 200.0), state.bias_gyro_B[0], state.bias_accel_B[0], NOISE)
    factor = ImuFactors.stack([measured])
    predicted = StateArrays.stack([measured.predict(state.unstack(np.zeros(1, np.int64))[0])])
    np.testing.assert_allclose(factor.residuals(state, predicted), 0.0, atol=1e-12)
    turned = predicted.retract(np.concatenate([[0.01, -0.02, 0.03], np.zeros(12)])[None])
    np.testing.assert_allclose(factor.residuals(state, turned)[0, DTHETA], [0.01, -0.02, 0.03], atol=1e-12)


def test_factor_jacobians_on_the_manifold():
    rng = np.random.default_rng(1)
    i, j = random_states(rng, 4), random_states(rng, 4)
    factors = ImuFactors.stack(
        [
            preintegrate(exact_segment(s, s + 0.3, 200.0), 0.01 * rng.normal(size=3), ZERO, NOISE)
            for s in (0.0, 1.0, 2.0, 3.0)
        ]
    )
    r, J_i, J_j = factors.linearise(i, j)
    np.testing.assert_array_equal(r, factors.residuals(i, j))
    for analytic, residual in (
        (J_i, lambda d: factors.residuals(i.retract(np.tile(d, (4, 1))), j)),
        (J_j, lambda d: factors.residuals(i, j.retract(np.tile(d, (4, 1))))),
    ):
        np.testing.assert_allclose(analytic, numeric_jacobian(residual, 15), atol=2e-8)


def test_sqrt_information_whitens():
    measured = preintegrate(exact_segment(0.0, 0.4, 200.0), ZERO, ZERO, NOISE)
    L = ImuFactors.stack([measured]).sqrt_information[0]
    np.testing.assert_allclose(L @ measured.cov @ L.T, np.eye(15), atol=1e-8)


def _gtsam_measurement(gtsam, segment: ImuSegment, bias_gyro: Float, bias_accel: Float):
    """gtsam integrates readings as constant over a step: give it those of the middle of each."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(np.eye(3) * NOISE.gyro_density**2)
    params.setAccelerometerCovariance(np.eye(3) * NOISE.accel_density**2)
    params.setBiasOmegaCovariance(np.eye(3) * NOISE.gyro_walk**2)
    params.setBiasAccCovariance(np.eye(3) * NOISE.accel_walk**2)
    params.setIntegrationCovariance(np.eye(3) * 1e-16)
    measured = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias_accel, bias_gyro))
    for h, w, a in zip(
        segment.dt,
        0.5 * (segment.gyro_B[:-1] + segment.gyro_B[1:]),
        0.5 * (segment.accel_B[:-1] + segment.accel_B[1:]),
        strict=True,
    ):
        measured.integrateMeasurement(a, w, h)
    return measured


@pytest.fixture(scope="module")
def gtsam():
    """An independent implementation; it integrates to first order, hence fine steps."""
    return pytest.importorskip("gtsam")


@pytest.fixture(scope="module")
def both(gtsam):
    segment = exact_segment(0.2, 0.7, 4000.0)
    ours = preintegrate(segment, BIAS_GYRO, BIAS_ACCEL, NOISE)
    return ours, _gtsam_measurement(gtsam, segment, BIAS_GYRO, BIAS_ACCEL)


def test_relative_motion_equals_gtsam(both: tuple[Preintegrated, object]):
    ours, theirs = both
    np.testing.assert_allclose(ours.dR, theirs.deltaRij().matrix(), atol=1e-6)
    np.testing.assert_allclose(ours.dp, theirs.deltaPij(), atol=2e-4)
    np.testing.assert_allclose(ours.dv, theirs.deltaVij(), atol=5e-4)


def test_prediction_at_other_biases_equals_gtsam(gtsam, both: tuple[Preintegrated, object]):
    """Goes through the bias Jacobians of both."""
    ours, theirs = both
    change = np.array([0.004, 0.003, -0.005]), np.array([0.02, -0.03, 0.04])
    state = NavState(0, so3.exp([0.3, -0.5, 1.0]), ZERO, np.array([0.5, -1.0, 0.2]), BIAS_GYRO, BIAS_ACCEL)
    begin = gtsam.NavState(gtsam.Rot3(state.R_WB), state.p_WB, state.v_WB)

    def shifts() -> tuple[Float, Float]:
        out = []
        for d_gyro, d_accel in ((ZERO, ZERO), change):
            bias_gyro, bias_accel = BIAS_GYRO + d_gyro, BIAS_ACCEL + d_accel
            mine = ours.predict(NavState(0, state.R_WB, state.p_WB, state.v_WB, bias_gyro, bias_accel))
            yours = theirs.predict(begin, gtsam.imuBias.ConstantBias(bias_accel, bias_gyro))
            out.append((mine, NavState(0, yours.attitude().matrix(), yours.position(), yours.velocity(), ZERO, ZERO)))
        (mine_0, yours_0), (mine_1, yours_1) = out
        np.testing.assert_allclose(error_of(mine_0, yours_0), 0.0, atol=1e-3)
        return error_of(mine_1, mine_0), error_of(yours_1, yours_0)

    mine, yours = shifts()
    assert np.linalg.norm(yours) > 0.02
    np.testing.assert_allclose(mine, yours, atol=2e-5)


def test_covariance_and_residual_equal_gtsam_through_the_error_of_a_factor(gtsam, both: tuple[Preintegrated, object]):
    """Half the squared Mahalanobis distance of states that fit badly, which is the same in any coordinates."""
    ours, theirs = both
    rng = np.random.default_rng(3)
    i = StateArrays.stack([NavState(0, so3.exp([0.3, -0.5, 1.0]), ZERO, np.ones(3), BIAS_GYRO, BIAS_ACCEL)])
    best = StateArrays.stack([ours.predict(i.unstack(np.zeros(1, np.int64))[0])])
    factor = ImuFactors.stack([ours])
    X, V, B = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.V, gtsam.symbol_shorthand.B
    theirs_factor = gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), theirs)
    for _ in range(5):
        j = best.retract((np.linalg.cholesky(ours.cov) @ rng.normal(0.0, 5.0, 15))[None])
        values = gtsam.Values()
        for k, s in enumerate((i, j)):
            values.insert(X(k), gtsam.Pose3(gtsam.Rot3(s.R_WB[0]), s.p_WB[0]))
            values.insert(V(k), s.v_WB[0])
            values.insert(B(k), gtsam.imuBias.ConstantBias(s.bias_accel_B[0], s.bias_gyro_B[0]))
        whitened = factor.sqrt_information[0] @ factor.residuals(i, j)[0]
        np.testing.assert_allclose(0.5 * whitened @ whitened, theirs_factor.error(values), rtol=0.02)
