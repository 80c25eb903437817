"""A flight's velocities and accelerations are the derivatives of its pose, and its readings lead back to it."""

import numpy as np
import pytest

from vioframe import registry
from vioframe.calibration import packaged_calibration
from vioframe.errors import PluginError
from vioframe.geometry import so3
from vioframe.simulation import simulated_sequence
from vioframe.simulation.flights import flight
from vioframe.simulation.imu import read_imu
from vioframe.types import ImuNoise, g_W

FLIGHTS = registry.load().names(registry.FLIGHT)
R_BC = packaged_calibration("euroc").R_BC
TIMES_S = np.random.default_rng(3).uniform(0.1, 19.9, 200)


@pytest.mark.parametrize("name", FLIGHTS)
def test_derivatives_are_those_of_the_pose(name):
    path, h = flight(name, 20.0, R_BC), 1e-4
    before, here, after = (path.at(TIMES_S + d) for d in (-h, 0.0, h))
    np.testing.assert_allclose(here.v_WB, (after.p_WB - before.p_WB) / (2 * h), atol=1e-5)
    np.testing.assert_allclose(here.a_WB, (after.v_WB - before.v_WB) / (2 * h), atol=1e-5)
    turned = np.swapaxes(before.R_WB, 1, 2) @ after.R_WB
    np.testing.assert_allclose(here.omega_B, so3.log(turned) / (2 * h), atol=1e-5)


@pytest.mark.parametrize("name", FLIGHTS)
def test_exact_readings_integrate_back_to_the_flight(name):
    """10 s of dead reckoning by the trapezoidal rule at 1 kHz; the rule's own error falls as the square of the rate."""
    rate = 1000.0
    t_s = np.arange(int(10 * rate) + 1) / rate
    motion = flight(name, 10.0, R_BC).at(t_s)
    readings = read_imu(motion, None, np.random.default_rng(0), rate)
    dt = 1.0 / rate
    turns = so3.exp(0.5 * (readings.gyro_B[1:] + readings.gyro_B[:-1]) * dt)
    R, p, v = motion.R_WB[0], motion.p_WB[0], motion.v_WB[0]
    for k, turn in enumerate(turns):
        R_next = R @ turn
        a = 0.5 * (R @ readings.accel_B[k] + R_next @ readings.accel_B[k + 1]) + g_W
        R, p, v = R_next, p + v * dt + 0.5 * a * dt**2, v + a * dt
        assert np.linalg.norm(p - motion.p_WB[k + 1]) < 1e-3
    assert np.linalg.norm(so3.log(R.T @ motion.R_WB[-1])) < 1e-5


def test_rest_is_exact_and_between_two_rests_there_is_motion():
    path = flight("stop_and_go", 24.0, R_BC)
    # The spline of degree five reaches three control points of 0.25 s ahead.
    rest = path.at(np.linspace(0.0, 3.2, 50))
    assert np.array_equal(rest.a_WB, np.zeros((50, 3)))
    assert np.array_equal(rest.omega_B, np.zeros((50, 3)))
    np.testing.assert_allclose(path.at(np.linspace(13.0, 15.0, 9)).v_WB, 0.0, atol=1e-12)
    assert np.linalg.norm(path.at(np.linspace(5.0, 11.0, 50)).v_WB, axis=1).max() > 1.0


def test_flights_are_what_their_names_say():
    t_s = np.linspace(0.0, 20.0, 400)
    turning = flight("pure_rotation", 20.0, R_BC).at(t_s)
    assert not turning.v_WB.any()
    assert np.linalg.norm(turning.omega_B, axis=1).max() > 0.5
    straight = flight("constant_velocity", 20.0, R_BC).at(t_s)
    np.testing.assert_allclose(straight.v_WB, np.tile([1.0, 0.0, 0.0], (400, 1)), atol=1e-12)
    np.testing.assert_allclose(straight.a_WB, 0.0, atol=1e-9)
    assert np.linalg.norm(flight("aggressive", 20.0, R_BC).at(t_s).a_WB, axis=1).max() > 9.81
    # The camera looks ahead and is level: its z axis is W's x, its y axis points down.
    R_WC = straight.R_WB[0] @ R_BC
    np.testing.assert_allclose(R_WC, [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)


def test_an_unknown_flight_lists_those_there_are():
    with pytest.raises(PluginError, match="figure_eight"):
        simulated_sequence("loop_the_loop")


def test_noise_has_the_densities_asked_for():
    """White noise by the variance of differences over one sample, diffusion by that over 1 s, each within 5 sigma."""
    noise = ImuNoise(gyro_density=2e-4, accel_density=3e-3, gyro_walk=4e-5, accel_walk=5e-3, rate_hz=100.0)
    count, rate = 200_000, 100
    motion = flight("standstill", 1.0, R_BC).at(np.zeros(count))
    exact = read_imu(motion, None, np.random.default_rng(1), rate)
    noisy = read_imu(motion, noise, np.random.default_rng(1), rate)
    for read, true, bias, density, walk in (
        (noisy.gyro_B, exact.gyro_B, noisy.bias_gyro_B, noise.gyro_density, noise.gyro_walk),
        (noisy.accel_B, exact.accel_B, noisy.bias_accel_B, noise.accel_density, noise.accel_walk),
    ):
        white = read - true - bias
        assert white.std() == pytest.approx(density * np.sqrt(rate), rel=5 / np.sqrt(2 * white.size))
        steps = bias[rate::rate] - bias[:-rate:rate]
        assert steps.std() == pytest.approx(walk, rel=5 / np.sqrt(2 * steps.size))
        assert np.array_equal(bias[0], np.zeros(3))
    # Fresh at every sample: neighbours are uncorrelated.
    white = (noisy.gyro_B - exact.gyro_B - noisy.bias_gyro_B)[:, 0]
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 5 / np.sqrt(count)
