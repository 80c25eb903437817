"""Flights along recorded trajectories: close to the poses, true to the recorded IMU, and one motion throughout."""

import numpy as np
import pytest
from simulated_imu import dead_reckoning_error_m

from vioframe.errors import ConfigError, TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory
from vioframe.simulation.flights import fit_flight, flight
from vioframe.testing import check_flight

EUROC = {
    name: f"euroc_imu_gt/{name}/state_groundtruth_estimate0/data.csv.gz" for name in ("MH_05_difficult", "V1_02_medium")
}


def angle_deg(R_0, R_1):
    return np.rad2deg(np.linalg.norm(so3.log(np.swapaxes(R_0, 1, 2) @ R_1), axis=1))


def recording(rate_hz=100.0, seconds=12.0, name="figure_eight", start_ns=1_403_638_000_000_000_000) -> Trajectory:
    t_s = np.arange(int(seconds * rate_hz) + 1) / rate_hz
    motion = flight(name, seconds, np.eye(3)).at(t_s)
    return Trajectory(start_ns + np.round(t_s * 1e9).astype(np.int64), motion.R_WB, motion.p_WB)


def without(trajectory, begin_s, end_s):
    t_s = (trajectory.t_ns - trajectory.t_ns[0]) * 1e-9
    return trajectory.select((t_s <= begin_s) | (t_s >= end_s))


def moved(trajectory, at_s, by_m=0.0, turned_rad=0.0):
    """``trajectory`` with a jump of the pose that lasts."""
    later = trajectory.t_ns >= trajectory.t_ns[0] + at_s * 1e9
    p_WB, R_WB = trajectory.p_WB.copy(), trajectory.R_WB.copy()
    p_WB[later, 1] += by_m
    R_WB[later] = R_WB[later] @ so3.exp(np.array([0.0, turned_rad, 0.0]))
    return Trajectory(trajectory.t_ns, R_WB, p_WB)


@pytest.mark.parametrize("name", ["figure_eight", "aggressive"])
def test_finds_back_the_flight_its_poses_came_from(name):
    original, fitted = flight(name, 12.0, np.eye(3)), fit_flight(recording(name=name))
    t_s = np.linspace(0.5, 11.5, 500)
    true, found = original.at(t_s), fitted.at(t_s)
    np.testing.assert_allclose(found.p_WB, true.p_WB, atol=1e-4)
    np.testing.assert_allclose(found.v_WB, true.v_WB, atol=2e-3)
    np.testing.assert_allclose(found.a_WB, true.a_WB, atol=0.1)
    np.testing.assert_allclose(found.omega_B, true.omega_B, atol=5e-3)
    assert angle_deg(true.R_WB, found.R_WB).max() < 0.01


def test_is_one_motion():
    turned = recording(seconds=14.0, name="aggressive")

    def factory(duration_s, R_LB):
        mounted = Trajectory(turned.t_ns, turned.R_WB @ R_LB, turned.p_WB)
        return fit_flight(mounted, 1.0, duration_s)

    check_flight(factory)


def test_a_turn_through_many_revolutions_stays_smooth():
    """Quaternions of either sign are one rotation: ten turns about a slanted axis at 3 rad/s."""
    t_s = np.arange(0.0, 20.0, 0.02)
    axis = np.array([0.6, 0.0, 0.8])
    spinning = Trajectory(
        np.round(t_s * 1e9).astype(np.int64), so3.exp(3.0 * t_s[:, None] * axis), np.zeros((len(t_s), 3))
    )
    motion = fit_flight(spinning).at(np.linspace(0.0, 19.9, 700))
    np.testing.assert_allclose(motion.omega_B, np.tile(3.0 * axis, (700, 1)), atol=1e-3)


def test_a_piece_is_the_same_motion_from_its_start_on():
    trajectory = recording()
    whole, piece = fit_flight(trajectory), fit_flight(trajectory, 3.0, 5.0)
    assert (whole.duration_s, piece.duration_s) == (12.0, 5.0)
    assert fit_flight(trajectory, 3.0, 100.0).duration_s == 9.0
    t_s = np.linspace(0.0, 5.0, 200)
    np.testing.assert_allclose(piece.at(t_s).p_WB, whole.at(3.0 + t_s).p_WB, atol=1e-5)
    np.testing.assert_allclose(piece.at(t_s).a_WB, whole.at(3.0 + t_s).a_WB, atol=0.02)


@pytest.mark.parametrize("rate_hz", [4.0, 10.0, 25.0])
def test_few_poses_a_second_give_a_smooth_flight_too(rate_hz):
    """A hover's slow path through few poses; the knots widen until there are two poses to each."""
    t_s = np.linspace(0.5, 11.5, 200)
    true, found = flight("figure_eight", 12.0, np.eye(3)).at(t_s), fit_flight(recording(rate_hz)).at(t_s)
    np.testing.assert_allclose(found.p_WB, true.p_WB, atol=0.01)
    assert np.linalg.norm(found.a_WB, axis=1).max() < 1.2 * np.linalg.norm(true.a_WB, axis=1).max()


def test_a_short_gap_is_bridged():
    motion = fit_flight(without(recording(), 4.0, 4.6)).at(np.linspace(3.5, 5.1, 100))
    true = flight("figure_eight", 12.0, np.eye(3)).at(np.linspace(3.5, 5.1, 100))
    np.testing.assert_allclose(motion.p_WB, true.p_WB, atol=0.01)


def test_a_step_in_the_recording_is_smoothed():
    """8 cm from one 5 ms sample to the next, as in the machine hall: flown through, within half the step."""
    stepped = moved(recording(200.0), 6.0, by_m=0.08)
    motion = fit_flight(stepped).at((stepped.t_ns - stepped.t_ns[0]) * 1e-9)
    assert np.linalg.norm(motion.p_WB - stepped.p_WB, axis=1).max() < 0.05
    assert np.linalg.norm(motion.a_WB, axis=1).max() < 40.0


@pytest.mark.parametrize(
    ("trajectory", "why"),
    [
        (recording(100.0, 0.1), "has 11 poses .*needs 12;"),
        (without(recording(), 4.0, 5.5), r"no pose from 4\.000 s to 5\.500 s .*--start"),
        (moved(recording(), 6.0, by_m=0.5), r"jumps at [45]\d m/s 5\.990 s after its first pose"),
        (moved(recording(), 6.0, turned_rad=0.5), r"jumps at \d+ rad/s 5\.990 s after"),
        (
            moved(recording(20.0), 6.0, by_m=1.3),
            r"asks for \d+ m/s\^2 \d\.\d+ s after its first pose.*smooth the recording",
        ),
    ],
)
def test_what_nothing_can_fly_is_refused_with_the_time(trajectory, why):
    with pytest.raises(TrajectoryError, match=why):
        fit_flight(trajectory)


def test_a_piece_beyond_the_end_is_refused():
    with pytest.raises(TrajectoryError, match=r"lasts 12 s and has 0 poses for a flight from 30 s on, .*start earlier"):
        fit_flight(recording(), 30.0)


@pytest.mark.parametrize("options", [{"start_s": -1.0}, {"duration_s": 0.0}, {"start_s": np.nan}])
def test_settings_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="begins at start_s"):
        fit_flight(recording(), **options)


@pytest.mark.parametrize("name", EUROC)
def test_a_real_flight_is_near_its_ground_truth_and_turns_as_its_gyroscope_says(shared_data, name):
    truth = load_trajectory(shared_data / EUROC[name])
    path = fit_flight(truth)
    motion = path.at((truth.t_ns - truth.t_ns[0]) * 1e-9)
    off_m, off_deg = np.linalg.norm(motion.p_WB - truth.p_WB, axis=1), angle_deg(motion.R_WB, truth.R_WB)
    assert off_m.max() < 0.03  # half of the step in MH_05
    assert np.quantile(off_m, 0.99) < 0.005
    assert np.quantile(off_deg, 0.998) < 0.5  # all but the shock of landing in MH_05, 0.3 s of 111
    assert off_deg.max() < 1.5

    imu = np.loadtxt(shared_data / f"euroc_imu_gt/{name}/imu0/data.csv.gz", delimiter=",", usecols=range(1, 4))
    imu_ns = np.loadtxt(shared_data / f"euroc_imu_gt/{name}/imu0/data.csv.gz", delimiter=",", usecols=0, dtype=np.int64)
    imu_s = (imu_ns - truth.t_ns[0]) * 1e-9
    inside = (imu_s > 0.0) & (imu_s < path.duration_s)
    gyro_B, omega_B = imu[inside], path.at(imu_s[inside]).omega_B
    # Averaged over 0.1 s: the rotors' vibration is in the readings and in no ground truth.
    window = np.ones(20) / 20
    gyro_B, omega_B = (np.array([np.convolve(x, window, "valid") for x in w.T]) for w in (gyro_B, omega_B))
    for read, turned in zip(gyro_B, omega_B, strict=True):
        assert np.corrcoef(read, turned)[0, 1] > 0.995
        assert (read - turned).std() < 0.015


@pytest.mark.parametrize(("name", "start_s"), [("MH_05_difficult", 20.0), ("V1_02_medium", 20.0)])
def test_exact_readings_integrate_back_to_a_recorded_flight(shared_data, name, start_s):
    assert dead_reckoning_error_m(fit_flight(load_trajectory(shared_data / EUROC[name]), start_s, 10.0)) < 1e-3
