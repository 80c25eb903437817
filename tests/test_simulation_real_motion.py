"""Real motion: interpolation is accurate, and the recorded IMU agrees with the path that it felt."""

import gzip

import numpy as np
import pytest

from vioframe.errors import DatasetError, TrajectoryError
from vioframe.geometry import so3
from vioframe.simulation import REAL_MOTION_SEQUENCES, real_motion_sequence
from vioframe.simulation.felt import felt
from vioframe.simulation.flights import flight
from vioframe.simulation.scenario import interpolate_poses, load_euroc
from vioframe.simulation.tracks import EUROC_NOISE
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


def test_the_felt_path_has_none_of_the_published_steps(mh_05):
    """79.3 s after the first pose the machine hall's ground truth steps by 5 cm, which no velocity explains."""
    published = load_euroc(mh_05, start_s=76.0, duration_s=6.0)

    def steps(truth):
        dt, v = np.diff(truth.t_ns)[:, None] * 1e-9, truth.values[:, 7:10]
        return np.linalg.norm(np.diff(truth.p_WB, axis=0) - 0.5 * (v[1:] + v[:-1]) * dt, axis=1)

    path = felt(published, EUROC_NOISE)
    assert steps(published.truth).max() == pytest.approx(0.053, abs=3e-3)
    assert steps(path.truth).max() < 1e-4
    assert np.linalg.norm(published.motion(path.truth.t_ns)[1] - path.truth.p_WB, axis=1).max() < 0.06
    assert np.array_equal(path.imu_ns, published.imu_ns)


@pytest.mark.parametrize(("name", "start_s"), [("MH_02_easy", 60.0), ("MH_05_difficult", 30.0), ("V1_02_medium", 30.0)])
def test_true_states_predict_the_motion(shared_data, name, start_s):
    """Dead reckoning for a second, as good as the IMU's noise has it, of a path near the published one."""
    folder = shared_data / "euroc_imu_gt" / name
    sequence = real_motion_sequence(folder, max_points=1, start_s=start_s, duration_s=10.0)
    missed = []
    for first in range(0, 180, 20):
        start, end = sequence.true_states[first], sequence.true_states[first + 20]
        R, p, v = start.R_WB, start.p_WB, start.v_WB
        for imu, _ in sequence.packets[first + 1 : first + 21]:
            for k, dt in enumerate(imu.dt):
                R_next = R @ so3.exp((0.5 * (imu.gyro_B[k] + imu.gyro_B[k + 1]) - start.bias_gyro_B) * dt)
                accel = [R_k @ (imu.accel_B[j] - start.bias_accel_B) for R_k, j in ((R, k), (R_next, k + 1))]
                a = 0.5 * (accel[0] + accel[1]) + g_W
                R, p, v = R_next, p + v * dt + 0.5 * a * dt**2, v + a * dt
        missed.append([np.linalg.norm(p - end.p_WB), np.linalg.norm(so3.log(R.T @ end.R_WB))])
    position, rotation = np.sqrt(np.mean(np.square(missed), axis=0))
    assert position < 4e-3
    assert rotation < 1.5 * np.sqrt(3.0) * EUROC_NOISE.gyro_density
    published = load_euroc(folder, start_s=start_s, duration_s=10.0)
    truth = sequence.ground_truth
    far = np.linalg.norm(published.motion(truth.t_ns)[1] - truth.p_WB, axis=1)
    assert 1e-3 < np.sqrt(np.mean(far**2)) < 0.03


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
