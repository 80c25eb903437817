import gzip

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from trajectory_helpers import PEERS, flight

from vioframe.errors import TrajectoryError
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import TrueTrajectory, load_trajectory, tum_line, write_euroc, write_tum

TUM = "1403636579.763555584 1 2 3 0 0 0 1\n1403636579.813555584 1 2 3 0 0 0 1\n"
EUROC_HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"


def write(folder, text, name="data.csv"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", ["trajectory.tum", "trajectory.tum.gz"])
def test_tum_round_trip_is_exact_in_time(tmp_path, name):
    truth = flight()
    write_tum(truth, tmp_path / name)
    again = load_trajectory(tmp_path / name)
    np.testing.assert_array_equal(again.t_ns, truth.t_ns)
    np.testing.assert_allclose(again.p_WB, truth.p_WB, atol=5.1e-10)
    np.testing.assert_allclose(again.R_WB, truth.R_WB, atol=5e-12)


def test_equal_trajectories_give_equal_files(tmp_path):
    for name in ("a.tum.gz", "b.tum.gz"):
        write_tum(flight(), tmp_path / name)
    assert (tmp_path / "a.tum.gz").read_bytes() == (tmp_path / "b.tum.gz").read_bytes()


@given(t_ns=st.integers(-(2**62), 2**62))
def test_any_stamp_survives_a_line(tmp_path_factory, t_ns):
    path = tmp_path_factory.mktemp("tum") / "one.tum"
    path.write_text(tum_line(t_ns, np.eye(3), np.zeros(3)))
    assert load_trajectory(path).t_ns.tolist() == [t_ns]


def test_evo_reads_what_is_written(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    truth = flight()
    write_tum(truth, tmp_path / "trajectory.tum")
    read = file_interface.read_tum_trajectory_file(str(tmp_path / "trajectory.tum"))
    np.testing.assert_allclose(read.positions_xyz, truth.p_WB, atol=5.1e-10)
    np.testing.assert_allclose(read.timestamps, truth.t_ns * 1e-9, atol=3e-7)
    for pose, R_WB in zip(read.poses_se3, truth.R_WB, strict=True):
        np.testing.assert_allclose(pose[:3, :3], R_WB, atol=5e-12)


@pytest.mark.parametrize(
    ("stamp", "t_ns"),
    [
        ("1.403637134538319111e+09", 1403637134538319111),
        ("1403638560.0778295994", 1403638560077829599),
        ("1403638522.827830", 1403638522827830000),
        ("1403715273", 1403715273000000000),
    ],
)
def test_stamps_are_read_digit_by_digit(tmp_path, stamp, t_ns):
    assert load_trajectory(write(tmp_path, f"{stamp} 1 2 3 0 0 0 1\n")).t_ns.tolist() == [t_ns]


@pytest.mark.parametrize("columns", [8, 11, 17])
def test_euroc_csv(tmp_path, columns):
    rest = ",".join(["0.5"] * (columns - 8))
    row = f"1403636579763555584,1,2,3,0.5,0.1,-0.7,0.5{',' + rest if rest else ''}"
    found = load_trajectory(write(tmp_path, f"#timestamp [ns], p, q, more\n{row}\n"))
    assert found.t_ns.tolist() == [1403636579763555584]
    np.testing.assert_array_equal(found.p_WB, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(found.quat_xyzw, [[0.1, -0.7, 0.5, 0.5]], atol=1e-14)


@pytest.mark.parametrize("columns", [8, 11, 17])
def test_euroc_round_trip_keeps_every_number(tmp_path, columns):
    """Velocity and biases too, and a quaternion that is rounded to six digits stays as it is."""
    rng = np.random.default_rng(columns)
    values = rng.normal(size=(5, columns - 1))
    values[:, 3:7] = np.round(values[:, 3:7] / np.linalg.norm(values[:, 3:7], axis=1, keepdims=True), 6)
    truth = TrueTrajectory.of(1403636579763555584 + np.arange(5), values)
    write_euroc(truth, tmp_path / "truth.csv")
    again = load_trajectory(tmp_path / "truth.csv")
    assert isinstance(again, TrueTrajectory)
    np.testing.assert_array_equal(again.t_ns, truth.t_ns)
    np.testing.assert_array_equal(again.values, values)
    np.testing.assert_array_equal(again.R_WB, truth.R_WB)


def test_a_velocity_that_is_not_known_everywhere_is_no_error(tmp_path):
    path = write(tmp_path, "10,1,2,3,1,0,0,0,0.1,0.2,0.3\n20,1,2,3,1,0,0,0,nan,,x\n")
    np.testing.assert_array_equal(load_trajectory(path).values[:, 7:], [[0.1, 0.2, 0.3], [np.nan] * 3])


def test_a_comma_at_the_line_end_and_a_header_without_a_hash_are_fine(tmp_path):
    found = load_trajectory(write(tmp_path, "t,x,y,z,qw,qx,qy,qz\n10,1,2,3,1,0,0,0,\n20,1,2,3,1,0,0,0,\n"))
    assert found.t_ns.tolist() == [10, 20]


BAD = {
    "repeats": (TUM + TUM.splitlines()[1], r"line 3: the stamp 1403636579.813555584 repeats that of line 2"),
    "goes back": (TUM + TUM.splitlines()[0], r"line 3: the stamp \S+ is before that of line 2"),
    "nan": (TUM + "1403636580 1 nan 3 0 0 0 1\n", r"line 3: the pose is not finite: 1 nan 3"),
    "words": ("# t\n" + TUM + "1403636580 1 oops 3 0 0 0 1\n", r"line 4: the pose is not finite: 1 oops 3"),
    "stamp": (TUM + "later 1 2 3 0 0 0 1\n", r"line 3: the stamp 'later' is not a number"),
    "infinite": (TUM + "inf 1 2 3 0 0 0 1\n", r"line 3: the stamp inf is not a time"),
    "short": (TUM + "1403636580 1 2\n", r"line 3: 3 columns where line 1 has 8"),
    "quaternion": ("1.0 1 2 3 0 0 0 0.5\n", r"line 1: the quaternion is not of unit norm"),
    "nanoseconds": ("1403636579763555584 1 2 3 0 0 0 1\n", r"line 1: .* are the stamps nanoseconds\?"),
    "seconds": ("1.5,1,2,3,1,0,0,0\n", r"line 1: the stamp 1.5 is not integer nanoseconds"),
    "layout": ("1,2,3,4,5\n", r"line 1: 5 columns are neither TUM \(8, blanks\) nor EuRoC \(8, 11 or 17, commas\)"),
    "empty": ("# nothing\n", r"data.csv: holds no poses"),
}


@pytest.mark.parametrize("problem", BAD)
def test_bad_lines_are_named(tmp_path, problem):
    text, message = BAD[problem]
    with pytest.raises(TrajectoryError, match=message) as caught:
        load_trajectory(write(tmp_path, text))
    assert "\n" not in str(caught.value)


def test_repeated_stamps_can_be_dropped(tmp_path):
    text = TUM + "1403636579.813555584 9 9 9 0 0 0 1\n1403636579.9 1 2 3 0 0 0 1\n"
    found = load_trajectory(write(tmp_path, text), keep_first_of_repeats=True)
    np.testing.assert_array_equal(found.p_WB, np.tile([1.0, 2.0, 3.0], (3, 1)))


def test_a_line_cut_short_can_be_ignored(tmp_path):
    path = write(tmp_path, TUM + "1403636579.863555584 1 2 3 0 0 0 0.9999")
    assert len(load_trajectory(path)) == 3
    assert len(load_trajectory(path, complete_lines_only=True)) == 2


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("leica0/data.csv", "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]\n1,2,3,4\n"),
        ("vicon0/data.csv", EUROC_HEADER + "\n1,2,3,4,1,0,0,0\n"),
        ("copy/positions.csv", "1,2,3,4\n"),
        ("copy/data.csv", EUROC_HEADER + "\n1,2,3,4,1,0,0,0\n"),
    ],
)
def test_raw_motion_capture_is_refused(tmp_path, name, text):
    path = tmp_path / name
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=r"raw Vicon or Leica .* use state_groundtruth_estimate0/data\.csv"):
        load_trajectory(path)


def test_files_that_are_no_trajectories(tmp_path):
    truncated = tmp_path / "cut.tum.gz"
    truncated.write_bytes(gzip.compress(TUM.encode())[:-12])
    binary = tmp_path / "image.png"
    binary.write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    for path, message in [
        (tmp_path / "missing.tum", "no such trajectory file"),
        (truncated, "cannot be read"),
        (binary, "not a text file"),
        (tmp_path, "a folder without"),
    ]:
        with pytest.raises(TrajectoryError, match=message):
            load_trajectory(path)


def test_every_shared_trajectory_reads(shared_data):
    for truth in set(PEERS.values()):
        found = load_trajectory(shared_data / "euroc_imu_gt" / truth)
        assert 70.0 < found.duration_s < 150.0
        assert 40.0 < found.path_length_m < 140.0
    for peer in set(PEERS) - {"V1_02_evo_example"}:
        assert len(load_trajectory(shared_data / "peer_trajectories" / f"{peer}.txt.gz")) > 1000
    with pytest.raises(TrajectoryError, match=r"line 433: the stamp 1.403715572212143183e\+09 repeats"):
        load_trajectory(shared_data / "peer_trajectories" / "V1_02_evo_example.txt.gz")


def test_the_first_pose_of_a_euroc_file(shared_data):
    found = load_trajectory(shared_data / "euroc_imu_gt/MH_05_difficult/state_groundtruth_estimate0/data.csv.gz")
    assert isinstance(found, Trajectory)
    assert found.t_ns[0] == 1403638519492829440
    np.testing.assert_array_equal(found.p_WB[0], [4.460675, -1.680515, 0.579614])
    np.testing.assert_allclose(found.quat_xyzw[0], [-0.757610, -0.348629, -0.497711, 0.238261], atol=1e-6)


@pytest.mark.parametrize("inside", ["mav0/state_groundtruth_estimate0/data.csv", "ground_truth.tum"])
def test_the_truth_is_found_in_its_folder(tmp_path, inside):
    file = tmp_path / "sequence" / inside
    file.parent.mkdir(parents=True)
    truth = Trajectory(np.array([1, 2]), np.array([np.eye(3)] * 2), np.zeros((2, 3)))
    (write_euroc if file.suffix == ".csv" else write_tum)(truth, file)
    for folder in {tmp_path / "sequence", file.parent}:
        np.testing.assert_array_equal(load_trajectory(folder).t_ns, [1, 2])


def test_a_folder_without_truth_is_refused_with_what_it_holds(tmp_path):
    (tmp_path / "mine.tum").touch()
    with pytest.raises(TrajectoryError, match=r"a folder without .* or ground_truth.tum; name one of its files: mine"):
        load_trajectory(tmp_path)
