"""Real motion: interpolation is accurate, the recorded IMU agrees with the poses, and jumps are told from motion."""

import gzip

import numpy as np
import pytest

from vioframe.errors import DatasetError, TrajectoryError
from vioframe.geometry import so3
from vioframe.simulation import REAL_MOTION_SEQUENCES, real_motion_sequence
from vioframe.simulation.flights import flight
from vioframe.simulation.scenario import interpolate_poses
from vioframe.types import g_W


@pytest.fixture(scope="module")
def mh_05(shared_data):
    return shared_data / "euroc_imu_gt" / "MH_05_difficult"


def test_interpolation_is_of_fourth_order_and_exact_at_samples():
    path = flight("aggressive", 10.0, np.eye(3))
    query_ns = np.random.default_rng(0).integers(0.2e9, 9.8e9, 300)
    truth = path.at(query_ns * 1e-9)

    def errors(interval_ns):
        t_ns = np.arange(0, 10_000_000_001, interval_ns)
        samples = path.at(t_ns * 1e-9)
        R, p = interpolate_poses(t_ns, samples.R_WB, samples.p_WB, query_ns)
        np.testing.assert_allclose(
            interpolate_poses(t_ns, samples.R_WB, samples.p_WB, t_ns)[1], samples.p_WB, atol=1e-12
        )
        turned = np.linalg.norm(so3.log(np.swapaxes(R, 1, 2) @ truth.R_WB), axis=1)
        return np.array([np.linalg.norm(p - truth.p_WB, axis=1).max(), turned.max()])

    coarse, fine = errors(40_000_000), errors(20_000_000)
    assert (coarse / fine > 12.0).all()  # 2^4 in the limit
    assert (errors(5_000_000) < [1e-6, 1e-6]).all()


def test_interpolation_refuses_to_extrapolate():
    t_ns = np.arange(10) * 5_000_000
    with pytest.raises(TrajectoryError, match="outside"):
        interpolate_poses(t_ns, np.tile(np.eye(3), (10, 1, 1)), np.zeros((10, 3)), np.array([t_ns[-1] + 1]))


@pytest.mark.parametrize("name", REAL_MOTION_SEQUENCES)
def test_recorded_rates_agree_with_the_poses(shared_data, name):
    """Rotation over half a second: gyroscope less its bias against ground truth, no axis mixed up, no shift in time."""
    sequence = real_motion_sequence(shared_data / "euroc_imu_gt" / name, max_points=1, start_s=20.0, duration_s=30.0)
    bias = np.array([-0.0022, 0.0209, 0.0766])  # All sequences were flown with one IMU.
    R_WB, step = sequence.ground_truth.R_WB, 10
    turned, residual = [], []
    for k in range(0, len(R_WB) - step, step):
        turn = np.eye(3)
        for imu, _ in sequence.packets[k + 1 : k + 1 + step]:
            for rate, dt in zip(0.5 * (imu.gyro_B[1:] + imu.gyro_B[:-1]) - bias, imu.dt, strict=True):
                turn = turn @ so3.exp(rate * dt)
        turned.append(np.linalg.norm(so3.log(turn)))
        residual.append(np.linalg.norm(so3.log(R_WB[k + step].T @ R_WB[k] @ turn)))
    assert np.median(residual) < 1.5e-3
    assert max(residual) < 6e-3
    assert max(turned) > 0.15


@pytest.mark.parametrize(("remove_jumps", "largest_m"), [(False, 0.053), (True, 0.002)])
def test_jumps_of_the_published_positions(mh_05, remove_jumps, largest_m):
    """79.3 s after the first pose the machine hall's ground truth steps by 5 cm, which no velocity explains."""
    sequence = real_motion_sequence(mh_05, max_points=1, start_s=78.0, duration_s=3.0, remove_jumps=remove_jumps)
    p = sequence.ground_truth.p_WB
    v = np.array([state.v_WB for state in sequence.true_states])
    dt = np.diff(sequence.ground_truth.t_ns)[:, None] * 1e-9
    step = np.linalg.norm(np.diff(p, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt, axis=1)
    if remove_jumps:
        assert step.max() < largest_m + 2e-3
    else:
        assert step.max() == pytest.approx(largest_m, abs=3e-3)


def test_published_states_predict_the_motion(mh_05):
    """Dead reckoning for a second stays within 10 cm; with a frame or a sign wrong it would be metres."""
    sequence = real_motion_sequence(mh_05, max_points=1, start_s=30.0, duration_s=1.0)
    start, end = sequence.true_states[0], sequence.true_states[-1]
    R, p, v = start.R_WB, start.p_WB, start.v_WB
    for imu, _ in sequence.packets[1:]:
        for k, dt in enumerate(imu.dt):
            R_next = R @ so3.exp((0.5 * (imu.gyro_B[k] + imu.gyro_B[k + 1]) - start.bias_gyro_B) * dt)
            accel = [R_k @ (imu.accel_B[j] - start.bias_accel_B) for R_k, j in ((R, k), (R_next, k + 1))]
            a = 0.5 * (accel[0] + accel[1]) + g_W
            R, p, v = R_next, p + v * dt + 0.5 * a * dt**2, v + a * dt
    assert np.linalg.norm(p - end.p_WB) < 0.1
    assert np.linalg.norm(so3.log(R.T @ end.R_WB)) < 2e-3


def test_window_and_seed(mh_05):
    whole = real_motion_sequence(mh_05, max_points=1)
    # 52 of the 2273 frames lie before or after the ground truth.
    assert len(whole.packets) == 2221
    part = real_motion_sequence(mh_05, start_s=10.0, duration_s=1.0, seed=1)
    assert len(part.packets) == 21
    assert part.ground_truth.t_ns[0] - whole.ground_truth.t_ns[0] == pytest.approx(10e9, abs=1e3)
    assert len(part.packets[0][0].t_ns) == 1
    again, other = (real_motion_sequence(mh_05, start_s=10.0, duration_s=1.0, seed=s) for s in (1, 2))
    assert np.array_equal(part.packets[7][1].xy, again.packets[7][1].xy)
    assert not np.array_equal(part.packets[7][1].xy, other.packets[7][1].xy)


def test_what_is_missing_is_named(tmp_path):
    def missing() -> str:
        with pytest.raises(DatasetError) as caught:
            real_motion_sequence(tmp_path)
        return str(caught.value)

    stamps = [k * 5_000_000 for k in range(1, 100)]
    assert "imu0/data.csv" in missing()
    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0/data.csv").write_text("".join(f"{t},0,0,0,0,0,9.81\n" for t in stamps))
    assert "cam0/data.csv" in missing()
    (tmp_path / "cam0").mkdir()
    (tmp_path / "cam0/data.csv").write_text("#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in stamps))
    assert "state_groundtruth_estimate0" in missing()
    (tmp_path / "state_groundtruth_estimate0").mkdir()
    rows = "".join(f"{t},0,0,0,1,0,0,0\n" for t in stamps)
    (tmp_path / "state_groundtruth_estimate0/data.csv.gz").write_bytes(gzip.compress(rows.encode()))
    assert len(real_motion_sequence(tmp_path / "imu0/data.csv").packets) == len(stamps)


def test_no_frame_in_the_window_is_an_error(mh_05):
    with pytest.raises(DatasetError, match="start earlier"):
        real_motion_sequence(mh_05, start_s=1e4)
