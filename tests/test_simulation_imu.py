"""What a simulated IMU reads: the noise asked for, the errors asked for, and nothing else."""

import numpy as np
import pytest

from vioframe.errors import ConfigError
from vioframe.estimation.inertial.allan import allan_deviation
from vioframe.simulation.flights import flight
from vioframe.simulation.imu import ACCEL_RMS, GYRO_RMS, ImuErrors, read_imu, vibration
from vioframe.types import GRAVITY_M_S2, ImuNoise, Motion

NOISE = ImuNoise(gyro_density=1.7e-4, accel_density=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3)
RATES = (100.0, 200.0, 400.0)


def at_rest(count: int) -> Motion:
    zero = np.zeros((count, 3))
    return Motion(np.tile(np.eye(3), (count, 1, 1)), zero, zero, zero, zero)


def read(count, rate_hz, noise=None, errors=None, seed=0):
    return read_imu(at_rest(count), noise, np.random.default_rng(seed), rate_hz, errors)


def slope(tau_s, deviation):
    return np.polyfit(np.log(tau_s), np.log(deviation), 1)[0]


@pytest.mark.parametrize("rate_hz", RATES)
def test_allan_deviation_of_the_white_noise_is_the_density_asked_for(rate_hz):
    """At tau = 1 s the deviation is the density itself, and it falls as 1 / sqrt(tau): half an hour at rest."""
    noise = ImuNoise(NOISE.gyro_density, NOISE.accel_density, 0.0, 0.0)
    readings = read(int(1800 * rate_hz), rate_hz, noise)
    tau_s = np.geomspace(0.1, 10.0, 9)
    for x, density in ((readings.gyro_B, noise.gyro_density), (readings.accel_B, noise.accel_density)):
        # Three axes of 1800 averages over 1 s: 1.4 % is the scatter of their estimate, by IEEE Std 952.
        at_1_s = np.sqrt((allan_deviation(x, rate_hz, 1.0) ** 2).mean())
        assert at_1_s == pytest.approx(density, rel=0.04)
        mean = np.sqrt((allan_deviation(x, rate_hz, tau_s) ** 2).mean(axis=1))
        assert slope(tau_s, mean) == pytest.approx(-0.5, abs=0.03)


@pytest.mark.parametrize("rate_hz", RATES)
def test_allan_deviation_of_the_bias_walk_is_the_diffusion_asked_for(rate_hz):
    """It rises as walk sqrt(tau / 3): an hour at rest, without white noise."""
    noise = ImuNoise(0.0, 0.0, NOISE.gyro_walk, NOISE.accel_walk)
    readings = read(int(3600 * rate_hz), rate_hz, noise, seed=1)
    tau_s = np.geomspace(1.0, 30.0, 6)
    up = np.array([0.0, 0.0, GRAVITY_M_S2])
    for x, bias, walk in (
        (readings.gyro_B, readings.bias_gyro_B, noise.gyro_walk),
        (readings.accel_B - up, readings.bias_accel_B, noise.accel_walk),
    ):
        np.testing.assert_allclose(x, bias, atol=1e-12)
        mean = np.sqrt((allan_deviation(x, rate_hz, tau_s) ** 2).mean(axis=1))
        np.testing.assert_allclose(mean[:3], walk * np.sqrt(tau_s[:3] / 3.0), rtol=0.08)
        assert slope(tau_s, mean) == pytest.approx(0.5, abs=0.06)
        assert not bias[0].any()


def test_both_noises_together_cross_where_they_should():
    rate_hz = 200.0
    readings = read(int(3600 * rate_hz), rate_hz, NOISE, seed=2)
    tau_s = np.array([0.5, 1.0, 5.0, 20.0])
    mean = (allan_deviation(readings.accel_B, rate_hz, tau_s) ** 2).mean(axis=1)
    expected = NOISE.accel_density**2 / tau_s + NOISE.accel_walk**2 * tau_s / 3.0
    np.testing.assert_allclose(mean, expected, rtol=0.2)


def test_neighbouring_readings_are_uncorrelated():
    white = read(200_000, 200.0, ImuNoise(1e-4, 1e-3, 0.0, 0.0)).gyro_B[:, 0]
    assert abs(np.corrcoef(white[1:], white[:-1])[0, 1]) < 5.0 / np.sqrt(len(white))


def test_the_allan_deviation_of_a_known_series():
    """0 1 0 1 ...: neighbours differ by one, so by hand sqrt(1/2) over one reading, and nothing over two."""
    series = np.tile([0.0, 1.0], 50)
    np.testing.assert_allclose(allan_deviation(series, 10.0, [0.1, 0.2]), [np.sqrt(0.5), 0.0], atol=1e-12)
    for tau_s in (0.01, 6.0):
        with pytest.raises(ValueError, match="must span a reading"):
            allan_deviation(series, 10.0, tau_s)


def test_scale_and_misalignment_mix_the_axes_as_they_say():
    errors = ImuErrors(
        gyro_scale=(0.01, 0.0, -0.02),
        gyro_misalignment=((0.0, 0.003, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        accel_scale=(0.0, 0.05, 0.0),
        accel_misalignment=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, -0.004, 0.0)),
        bias_gyro_B=(0.1, 0.2, 0.3),
        bias_accel_B=(-0.1, 0.0, 0.1),
    )
    motion = flight("aggressive", 2.0, np.eye(3)).at(np.linspace(0.0, 2.0, 50))
    true = read_imu(motion, None, np.random.default_rng(0), 25.0)
    false = read_imu(motion, None, np.random.default_rng(0), 25.0, errors)
    w, f = true.gyro_B.T, true.accel_B.T
    expected = [1.01 * w[0] + 0.003 * w[1] + 0.1, w[1] + 0.2, 0.98 * w[2] + 0.3]
    np.testing.assert_allclose(false.gyro_B.T, expected, atol=1e-12)
    np.testing.assert_allclose(false.accel_B.T, [f[0] - 0.1, 1.05 * f[1], f[2] - 0.004 * f[1] + 0.1], atol=1e-12)
    assert np.array_equal(false.bias_gyro_B[-1], [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    ("errors", "why"),
    [
        ({"gyro_scale": (1.0, 0.0, 0.0)}, "must be below 0.5"),
        ({"accel_scale": (np.nan, 0.0, 0.0)}, "must be below 0.5"),
        ({"accel_misalignment": ((0.1, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3)}, "belongs in accel_scale"),
        ({"bias_gyro_B": (np.inf, 0.0, 0.0)}, "bias_gyro_B must be finite"),
    ],
)
def test_what_no_imu_has_is_refused(errors, why):
    with pytest.raises(ConfigError, match=why):
        ImuErrors(**errors)


class TestVibration:
    @pytest.mark.parametrize("rate_hz", [137.0, 200.0, 1000.0])
    def test_has_the_strength_asked_for_at_any_rate(self, rate_hz):
        shaken = vibration(0.5, np.arange(int(60 * rate_hz)) / rate_hz, np.random.default_rng(0))
        for x, rms in zip(shaken, (GYRO_RMS, ACCEL_RMS), strict=True):
            np.testing.assert_allclose(x.std(axis=0), 0.5 * rms, rtol=0.1)
            # It shakes and does not pull: over a minute nothing is left of it.
            assert np.abs(x.mean(axis=0)).max() < 0.02 * rms

    def test_is_the_same_motion_whatever_samples_it(self):
        slow, fast = (vibration(1.0, np.arange(0.0, 2.0, 1.0 / r), np.random.default_rng(3)) for r in (100.0, 400.0))
        for at_100_hz, at_400_hz in zip(slow, fast, strict=True):
            np.testing.assert_allclose(at_100_hz, at_400_hz[::4], atol=1e-9)

    def test_lies_at_the_rotors_and_above_the_motion(self):
        rate_hz = 1000.0
        x = vibration(1.0, np.arange(60_000) / rate_hz, np.random.default_rng(0))[1][:, 0]
        power, hz = np.abs(np.fft.rfft(x)) ** 2, np.fft.rfftfreq(len(x), 1.0 / rate_hz)
        assert power[hz < 15.0].sum() < 0.01 * power.sum()
        rotors = power[(hz > 67.0) & (hz < 93.0)].sum()
        assert rotors > 0.3 * power.sum()
