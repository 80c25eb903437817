"""The path that an IMU felt: found again where the published one is off, steps and has gaps."""

from dataclasses import replace

import numpy as np
import pytest

from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import TrueTrajectory, true_values
from vioframe.simulation.felt import between, felt
from vioframe.simulation.flights import flight
from vioframe.simulation.imu import ImuErrors
from vioframe.simulation.scenario import fly, motion_along
from vioframe.simulation.tracks import EUROC_NOISE

BIAS_GYRO, BIAS_ACCEL = (0.02, -0.01, 0.07), (0.1, -0.2, 0.05)


@pytest.fixture(scope="module")
def flown():
    errors = ImuErrors(bias_gyro_B=BIAS_GYRO, bias_accel_B=BIAS_ACCEL)
    times = {"frames_s": np.arange(0.1, 19.9, 0.05), "imu_s": np.arange(0.0, 20.0, 0.005)}
    path = flight("figure_eight", 20.0, np.eye(3))
    rng = np.random.default_rng(3)
    return fly(path, "", rng, **times, imu_rate_hz=200.0, noise=EUROC_NOISE, errors=errors)


def published(flown, R_WB, p_WB, kept=slice(None)):
    """The scenario with other poses for its truth, and nothing else in it."""
    poses = Trajectory(flown.imu_ns, R_WB, p_WB).select(kept)
    truth = TrueTrajectory(poses.t_ns, poses.R_WB, poses.p_WB, values=true_values(poses))
    return replace(flown, truth=truth, motion=motion_along(truth))


def far(scenario, flown, frames=0):
    """How far the path lies from the one flown, (N,) m; or how far its change over some ``frames`` does."""
    off = scenario.motion(scenario.frames_ns)[1] - flown.motion(scenario.frames_ns)[1]
    return np.linalg.norm(off[frames:] - off[:-frames] if frames else off, axis=1)


def test_derivatives(flown):
    rng, dt = np.random.default_rng(0), np.array([0.005, 0.02, 0.004])
    gyro_B, accel_B = rng.normal(0.0, 2.0, (4, 3)), rng.normal(0.0, 8.0, (4, 3))
    state = [so3.exp(rng.normal(0.0, 1.0, (4, 3))), *rng.normal(0.0, 1.0, (2, 4, 3)), rng.normal(0.0, 0.1, (4, 6))]
    for k, step in enumerate(dt):  # rotations near those that were read: the derivatives hold for small residuals
        turn = so3.exp((0.5 * (gyro_B[k] + gyro_B[k + 1]) - state[3][k, :3]) * step)
        state[0][k + 1] = state[0][k] @ turn @ so3.exp(rng.normal(0.0, 1e-7, 3))

    def moved(node, axis, by):
        R, p, v, biases = (part.copy() for part in state)
        change = np.zeros(15)
        change[axis] = by
        R[node] = R[node] @ so3.exp(change[:3])
        p[node] += change[3:6]
        v[node] += change[6:9]
        biases[node] += change[9:]
        return between(dt, gyro_B, accel_B, R, p, v, biases, EUROC_NOISE)[0]

    _, before, after = between(dt, gyro_B, accel_B, *state, EUROC_NOISE)
    for k in range(3):
        for derivative, node in ((before[k], k), (after[k], k + 1)):
            numeric = [(moved(node, axis, 1e-6)[k] - moved(node, axis, -1e-6)[k]) / 2e-6 for axis in range(15)]
            scale = np.abs(derivative).max(axis=1, keepdims=True)
            # That by the gyroscope's bias is of first order in the turn between two readings.
            np.testing.assert_allclose(np.transpose(numeric) / scale, derivative / scale, atol=5e-4)


def test_what_was_flown_is_found_behind_steps(flown):
    """Of a path that steps by 5 cm and 5 mrad every two seconds, motion in a second comes out to a centimetre."""
    rng, count = np.random.default_rng(1), len(flown.imu_ns)
    step = np.arange(count) // 400
    off_p, off_R = (rng.normal(0.0, size, (step[-1] + 1, 3))[step] for size in (0.02, 0.002))
    given = published(flown, flown.truth.R_WB @ so3.exp(off_R), flown.truth.p_WB + off_p)
    found = felt(given, EUROC_NOISE)
    assert np.sqrt(np.mean(far(found, flown) ** 2)) < 0.8 * np.sqrt(np.mean(far(given, flown) ** 2))
    assert np.sqrt(np.mean(far(given, flown, 20) ** 2)) > 0.02
    assert np.sqrt(np.mean(far(found, flown, 20) ** 2)) < 0.012
    assert np.linalg.norm(np.diff(found.truth.p_WB - flown.truth.p_WB, axis=0), axis=1).max() < 3e-4
    biases = found.truth.values[:, 10:].mean(axis=0)
    np.testing.assert_allclose(biases[:3], BIAS_GYRO, atol=1e-3)
    np.testing.assert_allclose(biases[3:], BIAS_ACCEL, atol=0.02)


def test_a_gap_is_flown_through(flown):
    """What is between poses two seconds apart was felt; a curve drawn through them is not believed."""
    t_s = (flown.imu_ns - flown.imu_ns[0]) * 1e-9
    given = published(flown, flown.truth.R_WB, flown.truth.p_WB, np.abs(t_s - 10.0) > 1.0)
    assert far(given, flown).max() > 0.05
    assert far(felt(given, EUROC_NOISE), flown).max() < 0.005


def test_what_is_at_rest_stays_there():
    """While it stands, though the published path trembles and the readings' noise would lead it on."""
    times = {"frames_s": np.arange(0.1, 7.9, 0.05), "imu_s": np.arange(0.0, 8.0, 0.005)}
    path = flight("stop_and_go", 8.0, np.eye(3))
    flown = fly(path, "", np.random.default_rng(3), **times, imu_rate_hz=200.0, noise=EUROC_NOISE)
    trembling = 0.0003 * np.random.default_rng(1).normal(size=(len(flown.imu_ns), 3))
    found = felt(published(flown, flown.truth.R_WB, flown.truth.p_WB + trembling), EUROC_NOISE)
    t_s = (found.truth.t_ns - found.truth.t_ns[0]) * 1e-9
    assert np.ptp(found.truth.p_WB[t_s < 3.0], axis=0).max() < 0.002
    assert np.ptp(found.truth.p_WB[t_s > 5.0], axis=0).max() > 0.1


def test_frames_without_readings_or_poses_are_left_out(flown):
    given = published(flown, flown.truth.R_WB, flown.truth.p_WB, slice(500, 3000))
    found = felt(given, EUROC_NOISE)
    assert found.truth.t_ns[0] <= found.frames_ns[0]
    assert found.frames_ns[-1] <= found.truth.t_ns[-1]
    assert len(found.frames_ns) == pytest.approx(2500 * 0.005 / 0.05, abs=2)
    assert len(found.truth) == 2500
    assert len(found.states_at(found.frames_ns)) == len(found.frames_ns)
