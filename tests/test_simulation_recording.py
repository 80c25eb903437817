"""Simulated recordings: the conditions do what they say, files hold what was simulated, and failure leaves nothing."""

import errno
import sqlite3
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from recordings import assert_same_rig
from rosbags.highlevel import AnyReader
from simulation_helpers import INSTALLED, drawn_textures, small_calibration, small_simulation

from vioframe.cli import main
from vioframe.errors import ConfigError, DatasetError, TrajectoryError
from vioframe.geometry import so3
from vioframe.io.calibration import packaged_calibration, sidecar_folder, write_calibration
from vioframe.io.trajectories import load_trajectory, true_values
from vioframe.io.writers import TRUE_VECTOR_TOPICS, AslWriter, McapWriter, Ros1Writer, Ros2Writer
from vioframe.simulation.conditions import CONDITIONS, OF_THE_FLIGHT, Conditions
from vioframe.simulation.config import MANIFEST, MESH, TRUTH, SimulationConfig, rig_of, simulation_folder
from vioframe.simulation.record import record
from vioframe.simulation.renderer import Renderer
from vioframe.simulation.world import MeshBuilder, write_mesh
from vioframe.types import Calibration, FrameSet, ImuSample

pytest.importorskip("open3d", exc_type=ImportError)


def content(recording) -> list[tuple]:
    """The measurements as plain values that compare exactly."""
    rows = []
    for m in recording.measurements():
        if isinstance(m, FrameSet):
            rows.append((m.t_ns, *(None if image is None else image.tobytes() for image in m.images)))
        else:
            rows.append((m.t_ns, m.gyro_B.tobytes(), m.accel_B.tobytes()))
    return rows


def images(recording) -> np.ndarray:
    return np.array([m.images[0] for m in recording.measurements() if isinstance(m, FrameSet)], np.float64)


def readings(recording) -> tuple[np.ndarray, np.ndarray]:
    samples = [m for m in recording.measurements() if isinstance(m, ImuSample)]
    return np.array([s.t_ns for s in samples]), np.array([[*s.gyro_B, *s.accel_B] for s in samples])


def under(tmp_path, condition: str, level: float = 1.0, **settings):
    return small_simulation(
        tmp_path, duration_s=settings.pop("duration_s", 0.5), conditions={condition: level}, **settings
    )


@pytest.fixture(scope="module")
def clear(tmp_path_factory):
    return small_simulation(tmp_path_factory.mktemp("clear"), duration_s=0.5)


@pytest.fixture(scope="module")
def clear_content(clear):
    return content(clear)


def test_a_seed_gives_the_same_recording_and_another_seed_another(tmp_path):
    settings = {"duration_s": 0.3, "conditions": {"noise": 0.2, "moving_objects": 0.3, "vibration": 0.1}}

    def made(seed):
        drawn_textures.cache_clear()
        return content(small_simulation(tmp_path, seed=seed, **settings))

    first, again, other = map(made, (3, 3, 4))
    assert first == again
    assert first != other


def test_measurements_are_complete_and_in_order(clear):
    measured = list(clear.measurements())
    stamps = [m.t_ns for m in measured]
    assert stamps == sorted(stamps)
    frames = [m for m in measured if isinstance(m, FrameSet)]
    assert len(frames) == clear.frame_count == 11
    assert frames[0].images[0].shape == (120, 188)
    assert len(measured) - len(frames) == clear.imu_count == 101
    assert clear.ground_truth.t_ns.tolist() == readings(clear)[0].tolist()


def test_every_condition_has_a_level_and_an_explanation():
    assert list(CONDITIONS) == list(Conditions().model_dump())
    assert all(CONDITIONS.values())


@pytest.mark.parametrize("name", list(CONDITIONS))
def test_level_zero_changes_nothing_and_a_level_changes_something(name, tmp_path, clear, clear_content):
    assert content(under(tmp_path, name, 0.0)) == clear_content
    changed = under(tmp_path, name, 0.8)
    assert content(changed) != clear_content or changed.calibration != clear.calibration


def sharpness(pictures: np.ndarray) -> float:
    return float(np.abs(np.diff(pictures, axis=2)).mean())


def test_blur_fog_and_plain_surfaces_take_detail_away(tmp_path):
    fast = {"flight": {"name": "aggressive"}, "duration_s": 0.5}
    clear = sharpness(images(small_simulation(tmp_path, **fast)))
    for name, most in (("motion_blur", 0.7), ("fog", 0.4), ("low_texture", 0.6)):
        levels = [sharpness(images(under(tmp_path, name, level, **fast))) for level in (0.5, 1.0)]
        assert clear > levels[0] > levels[1]
        assert levels[1] < most * clear


def test_brightness_jumps_and_saturates(tmp_path, clear):
    wild = images(under(tmp_path, "exposure", 1.0, duration_s=4.0, frame_rate_hz=5.0))
    means = wild.mean(axis=(1, 2))
    assert means.max() > 1.8 * means.min()
    assert (wild == 255).mean() > 3.0 * (images(clear) == 255).mean() + 0.01


def test_frames_are_dropped_and_readings_are_late(tmp_path, clear):
    dropped = under(tmp_path, "dropped_frames", 1.0, duration_s=10.0, frame_rate_hz=20.0)
    assert dropped.frame_count == pytest.approx(100, abs=20)
    stamps, values = readings(under(tmp_path, "time_offset", 0.5))
    expected, same = readings(clear)
    assert np.array_equal(stamps, expected + 25_000_000)
    assert np.array_equal(values, same)


def test_vibration_shakes_the_imu_and_not_the_camera(tmp_path, clear):
    shaken = under(tmp_path, "vibration", 0.5)
    difference = readings(shaken)[1] - readings(clear)[1]
    assert difference[:, :3].std() == pytest.approx(0.075, rel=0.3)
    assert difference[:, 3:].std() == pytest.approx(1.5, rel=0.3)
    assert np.array_equal(images(shaken), images(clear))


def test_a_wrong_calibration_is_wrong_by_the_amount_asked_for(tmp_path, clear):
    wrong = under(tmp_path, "wrong_calibration", 0.5)
    (told,), (true,) = wrong.calibration.cameras, wrong.true_calibration.cameras
    assert true.model == clear.calibration.cameras[0].model
    assert np.rad2deg(np.linalg.norm(so3.log(true.R_BC.T @ told.R_BC))) == pytest.approx(0.5)
    assert np.linalg.norm(told.p_BC - true.p_BC) == pytest.approx(0.01)
    off = [getattr(told.model, name) - getattr(true.model, name) for name in ("fx", "fy", "cx", "cy")]
    assert np.linalg.norm(off[:2]) == pytest.approx(5.0)
    assert np.linalg.norm(off[2:]) == pytest.approx(5.0)
    assert np.array_equal(images(wrong), images(clear))


def test_a_rolling_shutter_is_told_or_not(tmp_path, clear):
    told = small_simulation(tmp_path, duration_s=0.5, readout_ms=30.0)
    hidden = under(tmp_path, "rolling_shutter")
    assert [r.true_calibration.cameras[0].readout_s for r in (told, hidden, clear)] == [0.03, 0.03, 0.0]
    assert [r.calibration.cameras[0].readout_s for r in (told, hidden, clear)] == [0.03, 0.0, 0.0]
    assert np.array_equal(images(told), images(hidden))
    # The stamp is that of the middle row: there the picture is the one of a global shutter.
    apart = np.abs(images(told) - images(clear)).mean(axis=(0, 2))
    rows = len(apart)
    assert apart[rows // 2 - 1 : rows // 2 + 1].mean() < 0.2 * min(
        apart[: rows // 8].mean(), apart[-rows // 8 :].mean()
    )


def seen_at(recording, t_ns) -> np.ndarray:
    """What the first camera would see, sharp and all rows at once, at instants (N,): (N, H, W), 255 for white."""
    (on_body,) = recording.true_calibration.cameras
    renderer = Renderer(on_body.model, recording.world)
    R_WB, p_WB, _ = recording.scenario.motion(np.asarray(t_ns))
    poses = zip(R_WB @ on_body.R_BC, R_WB @ on_body.p_BC + p_WB, strict=True)
    return np.array([np.clip(255.0 * renderer.render(*pose), 0.0, 255.0) for pose in poses])


def frame_in_fast_flight(tmp_path, **settings):
    """A recording of few pixels, and the middle one of its three frames."""
    recording = small_simulation(tmp_path, divisor=8, duration_s=0.1, flight={"name": "aggressive"}, **settings)
    frames = [m for m in recording.measurements() if isinstance(m, FrameSet)]
    return recording, frames[1].t_ns, frames[1].images[0].astype(float)


def test_a_stamp_is_the_middle_of_the_exposure(tmp_path):
    recording, t_ns, blurred = frame_in_fast_flight(tmp_path, conditions={"motion_blur": 1.0})
    sharp = seen_at(recording, t_ns + 2_500_000 * np.arange(-12, 13))
    early, in_time, late = (np.abs(sharp[k : k + 17].mean(axis=0) - blurred).mean() for k in (0, 4, 8))
    assert in_time < 0.3 * min(early, late)


@pytest.mark.parametrize("readout_ms", [30.0, -30.0])
def test_rows_are_exposed_one_after_another_downwards_or_upwards(tmp_path, readout_ms):
    recording, t_ns, rolled = frame_in_fast_flight(tmp_path, readout_ms=readout_ms)
    for row in (5, 54):
        late_ns = round(1e6 * readout_ms * ((row + 0.5) / 60 - 0.5))
        still = seen_at(recording, [t_ns - late_ns, t_ns, t_ns + late_ns])
        *wrong, right = np.abs(still[:, row] - rolled[row]).mean(axis=1)
        assert right < 0.3 * min(wrong)


def test_the_imu_is_exact_or_as_wrong_as_asked(tmp_path, clear):
    exact = small_simulation(tmp_path, duration_s=0.5, exact_imu=True)
    assert not exact.ground_truth.values[:, 10:].any()
    scale = [0.1, 0.0, -0.05]
    scaled = readings(small_simulation(tmp_path, duration_s=0.5, exact_imu=True, imu={"accel_scale": scale}))[1]
    np.testing.assert_allclose(scaled[:, 3:], readings(exact)[1][:, 3:] * (1.0 + np.array(scale)), rtol=1e-12)
    noise = readings(clear)[1] - readings(exact)[1]
    assert noise[:, :3].std() == pytest.approx(1.6968e-4 * np.sqrt(200.0), rel=0.15)
    assert small_simulation(tmp_path, duration_s=0.5, imu_rate_hz=400.0).imu_count == 201


def test_a_known_time_offset_is_in_the_stamps_and_in_the_calibration(tmp_path):
    recording = small_simulation(
        tmp_path, duration_s=0.2, rig=small_calibration().with_camera(0, time_offset_ns=7_000_000)
    )
    assert recording.calibration.cameras[0].time_offset_ns == 7_000_000
    assert readings(recording)[0][0] == recording.ground_truth.t_ns[0] + 7_000_000


def test_a_real_sequence_keeps_its_readings_stamps_and_poses(shared_data, tmp_path):
    folder = shared_data / "euroc_imu_gt" / "MH_05_difficult"
    files = {"recorded": folder / "imu0" / "data.csv.gz", "start_s": 20.0, "duration_s": 0.5}
    recording = small_simulation(tmp_path, **files)
    stamps = np.loadtxt(folder / "cam0" / "timestamps_ns.txt.gz", dtype=np.int64)
    frames = np.array([m.t_ns for m in recording.measurements() if isinstance(m, FrameSet)])
    assert np.isin(frames, stamps).all()
    assert len(frames) == 11
    rows = np.loadtxt(folder / "imu0" / "data.csv.gz", delimiter=",")
    t_ns, values = readings(recording)
    nearest = np.abs(rows[:, 0, None] - t_ns).argmin(axis=0)
    assert np.array_equal(values, rows[nearest, 1:])
    truth = recording.ground_truth
    published = load_trajectory(folder / "state_groundtruth_estimate0" / "data.csv.gz")
    nearest = np.abs(published.t_ns[:, None] - truth.t_ns).argmin(axis=0)
    off_m = np.linalg.norm(published.p_WB[nearest] - truth.p_WB, axis=1)
    assert 0.0 < off_m.max() < 0.03


def rig(folder: Path, **settings):
    """Both of EuRoC's cameras, the second one smaller and with a clock of its own."""
    left, right = small_calibration(4, ("cam0", "cam1")).cameras
    smaller = small_calibration(8, ("cam1",)).cameras[0].model
    cameras = left, replace(right, model=smaller, time_offset_ns=left.time_offset_ns + 5_000_000)
    return small_simulation(folder, rig=Calibration(cameras, small_calibration().imu), duration_s=0.3, **settings)


def test_every_camera_of_a_rig_sees_the_world_from_where_it_is(tmp_path):
    both = rig(tmp_path)
    sets = [m for m in both.measurements() if isinstance(m, FrameSet)]
    assert [[image.shape for image in frames.images] for frames in sets] == 7 * [[(120, 188), (60, 94)]]
    # The first camera of a rig sees what it sees alone.
    alone = images(small_simulation(tmp_path, duration_s=0.3))
    np.testing.assert_array_equal([frames.images[0] for frames in sets], alone)
    # The second sees what a camera there sees alone, at the instant of its own clock.
    second = both.calibration.cameras[1]
    R_WB, p_WB, _ = both.scenario.motion(np.array([sets[3].t_ns + 5_000_000]))
    renderer = Renderer(second.model, both.world)
    light = renderer.render(R_WB[0] @ second.R_BC, R_WB[0] @ second.p_BC + p_WB[0])
    np.testing.assert_array_equal(sets[3].images[1], np.clip(np.round(255.0 * light), 0.0, 255.0).astype(np.uint8))


def test_conditions_are_the_same_for_all_cameras_and_the_noise_is_not(tmp_path):
    left, right = small_calibration(4, ("cam0", "cam1")).cameras
    # Two cameras in one place: but for their noise they see the same.
    twins = Calibration((left, replace(left, name="cam1")), small_calibration().imu)
    conditions = {"noise": 0.5, "exposure": 0.5, "motion_blur": 0.5, "wrong_calibration": 0.5, "moving_objects": 0.3}
    recording = small_simulation(tmp_path, rig=twins, duration_s=0.2, conditions=conditions)
    for frames in (m for m in recording.measurements() if isinstance(m, FrameSet)):
        first, second = (image.astype(float) for image in frames.images)
        difference = (first - second)[(first > 0) & (first < 255) & (second > 0) & (second < 255)]
        assert difference.std() == pytest.approx(np.sqrt(2.0) * 0.04 * 255, rel=0.1)
        assert abs(difference.mean()) < 1.0
    told = recording.calibration.cameras
    assert np.linalg.norm(told[0].p_BC - told[1].p_BC) > 0.001
    assert [camera.R_BC is right.R_BC for camera in told] == [False, False]


@pytest.fixture
def twins() -> Calibration:
    """Two cameras in one place."""
    left = small_calibration(8).cameras[0]
    return Calibration((left, replace(left, name="cam1")), small_calibration().imu)


def taken(recording) -> list[list[tuple[int, bytes]]]:
    """Of each camera the stamp and the image of all that it took."""
    sets = [m for m in recording.measurements() if isinstance(m, FrameSet)]
    cameras = range(len(recording.calibration.cameras))
    return [[(m.t_ns, m.images[c].tobytes()) for m in sets if m.images[c] is not None] for c in cameras]


def test_conditions_of_one_camera_are_those_of_all_for_it_and_none_for_the_others(tmp_path, twins):
    levels = {name: 0.3 for name in CONDITIONS if name not in (*OF_THE_FLIGHT, "time_offset", "dropped_frames")}
    levels |= {"exposure": 0.8, "blackout": 0.01}  # 0.1 s are black
    recordings = [
        small_simulation(tmp_path, rig=twins, duration_s=0.4, conditions=conditions)
        for conditions in (
            {},
            {f"cam1.{name}": level for name, level in levels.items()},
            levels,
            levels | {f"cam0.{name}": 0.0 for name in levels},
        )
    ]
    none, one, both, but = map(taken, recordings)
    assert one[0] == but[0] == none[0]
    assert one[1] == but[1] == both[1]
    assert not {image for _, image in one[1]} & {image for _, image in none[1]}
    dropped = taken(small_simulation(tmp_path, rig=twins, duration_s=0.4, conditions={"cam1.dropped_frames": 1.0}))
    assert dropped[0] == none[0]
    assert set(dropped[1]) < set(none[1])
    told = [recording.calibration.lenses for recording in recordings]
    assert told[1] == told[3] == (told[0][0], told[2][1]) != told[0]


def test_a_camera_may_be_late_alone(tmp_path, twins):
    """Then another instant is exposed than its calibration says; of all cameras it is the IMU that is late."""
    late, first, clear = (
        small_simulation(tmp_path, rig=twins, conditions=levels, frame_rate_hz=40.0, duration_s=0.2)
        for levels in ({"cam1.time_offset": 0.5}, {"cam0.time_offset": 0.5}, {})
    )
    assert [c.time_offset_ns for c in late.calibration.cameras] == [0, 0]
    assert [c.time_offset_ns for c in late.true_calibration.cameras] == [0, 25_000_000]
    # 25 ms are a frame.
    (left, right), (expected_left, expected_right) = taken(late), taken(clear)
    assert [image for _, image in right][:-1] == [image for _, image in expected_right][1:]
    assert left == expected_left
    assert readings(first)[0][0] - readings(clear)[0][0] == 25_000_000
    assert [c.time_offset_ns for c in first.true_calibration.cameras] == [0, -25_000_000]


def test_behind_a_cover_it_is_black_in_the_middle(tmp_path):
    covered = under(tmp_path, "blackout", 0.2, duration_s=4.0, frame_rate_hz=4.0)
    black = (images(covered) == 0.0).all(axis=(1, 2))
    at_s = np.arange(17) / 4.0
    np.testing.assert_array_equal(black, np.abs(at_s - 2.0) < 1.0)


def test_a_camera_with_stamps_of_its_own_comes_in_sets_of_one(tmp_path):
    rig = small_calibration(8, ("cam0", "cam1"))
    settings = {"rig": rig, "duration_s": 0.3, "conditions": {"cam0.noise": 0.1, "dropped_frames": 0.5}}
    together, apart = (small_simulation(tmp_path, **settings, delay_ms=delay) for delay in ({}, {"cam1": 20.0}))
    sets = [m for m in apart.measurements() if isinstance(m, FrameSet)]
    assert apart.frame_count == len(sets)
    assert [m.t_ns for m in sets] == sorted(m.t_ns for m in sets)
    assert {sum(image is not None for image in m.images) for m in sets} == {1}
    (left, right), (synchronised, triggered) = taken(apart), taken(together)
    assert left == synchronised
    # The last would come after the last frame, and perhaps after the last reading.
    stamps = [t_ns for t_ns, _ in right]
    assert stamps == [t_ns + 20_000_000 for t_ns, _ in triggered[:-1]]
    # Each image shows the world at the stamp that it bears.
    second = apart.calibration.cameras[1]
    R_WB, p_WB, _ = apart.scenario.motion(np.array([stamps[2]]))
    light = Renderer(second.model, apart.world).render(R_WB[0] @ second.R_BC, R_WB[0] @ second.p_BC + p_WB[0])
    expected = np.clip(np.round(255.0 * light), 0.0, 255.0).astype(np.uint8)
    assert right[2] == (stamps[2], expected.tobytes())
    for name in ("flight.bag", "flight"):
        record(apart, [tmp_path / name])
        assert taken(INSTALLED.open_dataset(tmp_path / name)) == [left, right]


def test_eurocs_rigs_by_name(tmp_path):
    assert SimulationConfig() == SimulationConfig(rig=["mono"])
    assert_same_rig(rig_of(SimulationConfig()), packaged_calibration("euroc", cameras=["cam0"]))
    assert_same_rig(rig_of(SimulationConfig(rig=["stereo"])), packaged_calibration("euroc"))
    done = simulate(tmp_path / "pair", "--rig", "stereo", "--duration", 0.1, "--workers", 1)
    assert done.exit_code == 0, done.output
    read = INSTALLED.open_dataset(tmp_path / "pair")
    assert_same_rig(read.calibration, packaged_calibration("euroc"))
    sets = [m for m in read.measurements() if isinstance(m, FrameSet)]
    assert [[image.shape for image in m.images] for m in sets] == 3 * [[(480, 752), (480, 752)]]


def test_a_real_sequence_is_seen_by_both_cameras(shared_data, tmp_path):
    """At the recorded stamps, which both of EuRoC's cameras share, each from where it is."""
    folder = shared_data / "euroc_imu_gt" / "MH_05_difficult"
    rig = small_calibration(8, ("cam0", "cam1"))
    recording = small_simulation(tmp_path, rig=rig, recorded=folder, start_s=20.0, duration_s=0.3)
    sets = [m for m in recording.measurements() if isinstance(m, FrameSet)]
    stamps = np.loadtxt(folder / "cam0" / "timestamps_ns.txt.gz", dtype=np.int64)
    assert len(sets) == 7
    assert np.isin([m.t_ns for m in sets], stamps).all()
    second = rig.cameras[1]
    R_WB, p_WB, _ = recording.scenario.motion(np.array([sets[3].t_ns]))
    light = Renderer(second.model, recording.world).render(R_WB[0] @ second.R_BC, R_WB[0] @ second.p_BC + p_WB[0])
    expected = np.clip(np.round(255.0 * light), 0.0, 255.0).astype(np.uint8)
    np.testing.assert_array_equal(sets[3].images[1], expected)


@pytest.mark.parametrize("name", ["flight.bag", "flight.ros2", "flight.mcap", "flight"])
def test_a_recording_holds_every_camera_of_its_rig_and_the_truth(tmp_path, name):
    recording = rig(tmp_path)
    record(recording, [tmp_path / name])
    read = INSTALLED.open_dataset(tmp_path / name)
    assert [camera.name for camera in read.calibration.cameras] == ["cam0", "cam1"]
    assert [camera.time_offset_ns for camera in read.calibration.cameras] == [0, 5_000_000]
    assert content(read) == content(recording)
    np.testing.assert_array_equal(true_values(read.ground_truth), recording.ground_truth.values)


def test_a_camera_that_nobody_knows_how_it_is_turned_cannot_be_rendered(tmp_path):
    with pytest.raises(ConfigError, match="how cam0 is turned"):
        small_simulation(tmp_path, rig=small_calibration().with_camera(0, rotation_known=False))


def test_twenty_seconds_of_bag_and_folder_hold_what_was_simulated(tmp_path):
    recording = small_simulation(tmp_path, duration_s=20.0, divisor=8, workers=2)
    bag, folder = tmp_path / "flight.bag", tmp_path / "flight"
    record(recording, [bag, folder])

    topics = {"/cam0/image_raw": 401, "/imu0": 4001, "/vioframe/ground_truth": 4001}
    topics |= dict.fromkeys(TRUE_VECTOR_TOPICS, 4001)
    # Of the tools that rosbags has, its releases of 0.11 install this one, which reads every message.
    tool = Path(sys.executable).with_name("rosbags-convert")
    subprocess.run([tool, "--src", bag, "--dst", tmp_path / "converted", "--dst-storage", "mcap"], check=True)
    for path in (bag, tmp_path / "converted"):
        with AnyReader([path]) as reader:
            assert {c.topic: c.msgcount for c in reader.connections} == topics

    expected = content(recording)
    assert len(expected) == 401 + 4001
    for path in (bag, folder):
        read = INSTALLED.open_dataset(path)
        assert content(read) == expected
        np.testing.assert_array_equal(read.ground_truth.t_ns, recording.ground_truth.t_ns)
        np.testing.assert_array_equal(read.ground_truth.p_WB, recording.ground_truth.p_WB)
        np.testing.assert_allclose(read.ground_truth.R_WB, recording.ground_truth.R_WB, atol=1e-15)
        assert read.calibration.cameras[0].model == recording.calibration.cameras[0].model
        assert {file.name for file in simulation_folder(path).iterdir()} == {MANIFEST, TRUTH, MESH}
    states = np.loadtxt(simulation_folder(bag) / TRUTH, delimiter=",")
    assert states.shape == (4001, 17)
    np.testing.assert_array_equal(states[:, 1:], recording.ground_truth.values)


def simulate(*arguments: object):
    return CliRunner().invoke(main, ["simulate", *map(str, arguments)])


@pytest.fixture
def small(tmp_path) -> Path:
    write_calibration(small_calibration(8), tmp_path / "small")
    return tmp_path / "small"


def test_a_manifest_makes_the_same_recording_again(tmp_path, small):
    chosen = ["--flight", "hover", "--duration", 0.5, "--seed", 7, "-c", "noise=0.3", "-c", "fog", "-o", "speed=1.5"]
    done = simulate(tmp_path / "one.bag", *chosen, "--rig", small, "--workers", 1)
    assert done.exit_code == 0, done.output
    assert "conditions: noise 0.3, fog 1" in done.output
    manifest = simulation_folder(tmp_path / "one.bag") / MANIFEST
    drawn_textures.cache_clear()
    again = simulate(tmp_path / "two.bag", "--config", manifest, "--workers", 1)
    assert again.exit_code == 0, again.output
    assert (tmp_path / "one.bag").read_bytes() == (tmp_path / "two.bag").read_bytes()
    assert manifest.read_text() == (simulation_folder(tmp_path / "two.bag") / MANIFEST).read_text()


def test_a_manifest_makes_the_same_recording_of_a_rig_again(tmp_path):
    write_calibration(small_calibration(8, ("cam0", "cam1")), tmp_path / "pair")
    chosen = ["--rig", tmp_path / "pair", "--duration", 0.4, "-c", "cam1.blackout=0.02", "-c", "noise=0.1"]
    chosen += ["-c", "cam0.noise=0", "-c", "cam1.dropped_frames=0.8", "-o", "cam1.delay_ms=12.5", "--workers", 1]
    done = simulate(tmp_path / "one.bag", *chosen)
    assert done.exit_code == 0, done.output
    assert "conditions: cam1.blackout 0.02, noise 0.1, cam1.dropped_frames 0.8" in done.output
    manifest = simulation_folder(tmp_path / "one.bag") / MANIFEST
    again = simulate(tmp_path / "two.bag", "--config", manifest, "--workers", 2)
    assert again.exit_code == 0, again.output
    assert (tmp_path / "one.bag").read_bytes() == (tmp_path / "two.bag").read_bytes()
    assert manifest.read_text() == (simulation_folder(tmp_path / "two.bag") / MANIFEST).read_text()


def test_the_list_shows_flights_worlds_and_conditions():
    listed = simulate("--list").output
    for name in ("figure_eight", "inspection", "hall", "mesh", "mono", "stereo", *CONDITIONS):
        assert name in listed


def box_world(tmp_path: Path, half_m: float) -> Path:
    builder = MeshBuilder()
    builder.box(np.full(3, -half_m), np.full(3, half_m), np.zeros(6, int), 1.0, np.zeros(2))
    write_mesh(builder.build(), tmp_path / "box.ply")
    return tmp_path / "box.ply"


def test_ones_own_mesh_is_a_world_and_its_walls_are_solid(tmp_path, small):
    room = box_world(tmp_path, 20.0)
    settings = ["--rig", small, "--duration", 3, "--rate", 2, "--workers", 1, "--world", "mesh"]
    done = simulate(tmp_path / "room", *settings, "-o", f"world.file={room}")
    assert done.exit_code == 0, done.output
    closet = box_world(tmp_path, 1.0)
    refused = simulate(tmp_path / "closet", *settings, "-o", f"world.file={closet}")
    assert refused.exit_code == 2
    assert "goes through a wall of the world" in refused.output
    assert not list(tmp_path.glob("*closet*"))


def jumping_file(tmp_path: Path) -> Path:
    rows = [f"{0.1 * k:.1f} {0.1 * k + 5.0 * (k > 20):.2f} 0 0 0 0 0 1" for k in range(50)]
    (tmp_path / "jump.tum").write_text("\n".join(rows) + "\n")
    return tmp_path / "jump.tum"


def repeating_file(tmp_path: Path) -> Path:
    rows = [f"{0.1 * min(k, 30):.1f} {0.1 * k:.2f} 0 0 0 0 0 1" for k in range(50)]
    (tmp_path / "repeat.tum").write_text("\n".join(rows) + "\n")
    return tmp_path / "repeat.tum"


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        (["-c", "fogg=0.5"], "did you mean 'fog'"),
        (["-c", "fog=1.5"], "conditions: fog: Input should be less than or equal to 1, got"),
        (["-c", "fog=nan"], "should be a finite number"),
        (["-c", "fog=much"], "should be a valid number"),
        (["--rig", "stereo", "-c", "cam1.fogg=0.5"], "did you mean 'fog'"),
        (["--rig", "stereo", "-c", "cam1.fog=1.5"], "conditions: fog: Input should be less than or equal to 1, got"),
        (["--rig", "stereo", "-c", "cam2.fog=0.5"], "the rig has no camera 'cam2'; its cameras: cam0, cam1"),
        (["-c", "cam1.fog"], "the rig has no camera 'cam1'; its cameras: cam0"),
        (["--rig", "stereo", "-c", "cam1.vibration"], "vibration is the same for all cameras; leave 'cam1' out"),
        (["--rig", "stereo", "-o", "delay_ms=5"], "write one of cam0.delay_ms, cam1.delay_ms"),
        (["--rig", "stereo", "-o", "cam2.delay_ms=5"], "there is no section 'cam2'"),
        (["--rig", "stereo", "-o", "cam1.delay_ms=-5"], "delay_ms.cam1: Input should be greater than or equal to 0"),
        (["--flight", "figure_ate"], "did you mean 'figure_eight'"),
        (["--flight", "missing.tum"], "no such trajectory file"),
        (["--flight", jumping_file], "jump"),
        (["--flight", repeating_file], "repeats"),
        (["--world", "hell"], "did you mean 'hall'"),
        (["--imu", "nowhere"], "does not exist"),
        (["--imu", "nowhere", "--exact-imu"], "taken as they are"),
        (["--duration", "-1"], "--duration: Input should be greater than 0"),
        (["--start", "3"], "a flight begins at its beginning"),
        (["-o", "colour=red"], "no part has such an option"),
        (["-o", "world.images=nowhere"], "is not a folder"),
        (["--rig", "nowhere"], "nowhere"),
        (["--config", "nowhere.yaml"], "cannot read the configuration"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(arguments, problem, tmp_path):
    given = [a(tmp_path) if callable(a) else a for a in arguments]
    before = set(tmp_path.iterdir())
    done = simulate(tmp_path / "out.bag", "--workers", 1, *given)
    assert done.exit_code == 2, done.output
    assert problem in done.output
    assert done.output.startswith("vioframe: error: ")
    assert done.output.count("\n") == 1
    assert set(tmp_path.iterdir()) == before


def test_destinations_are_checked_before_anything_is_rendered(tmp_path, small):
    assert "no destination given" in simulate().output
    assert "tells no format" in simulate(tmp_path / "flight.avi").output
    (tmp_path / "mine.bag").write_text("precious")
    assert "exists already" in simulate(tmp_path / "mine.bag").output
    assert "was not written by the simulator" in simulate(tmp_path / "mine.bag", "--overwrite").output
    assert (tmp_path / "mine.bag").read_text() == "precious"
    assert "named twice" in simulate(tmp_path / "a", tmp_path / "a").output
    assert "cannot be compressed by bz2" in simulate(tmp_path / "a.mcap", "--compression", "bz2").output


@pytest.mark.parametrize(
    ("name", "writer", "problem"),
    [
        ("a", AslWriter, OSError(errno.ENOSPC, "No space left on device")),
        ("a.bag", Ros1Writer, OSError(errno.ENOSPC, "No space left on device")),
        ("a.ros2", Ros2Writer, sqlite3.OperationalError("database or disk is full")),
        ("a.mcap", McapWriter, OSError(errno.ENOSPC, "No space left on device")),
    ],
)
def test_a_full_disk_leaves_no_half_written_recording(tmp_path, small, monkeypatch, name, writer, problem):
    written = []

    def write_frame(self, frame):
        written.append(frame)
        if len(written) > 2:
            raise problem

    monkeypatch.setattr(writer, "write_frame", write_frame)
    done = simulate(tmp_path / name, "--rig", small, "--duration", 1, "--workers", 1, "--quiet")
    assert done.exit_code == 2
    reason = getattr(problem, "strerror", None) or problem
    assert done.output == (
        f"vioframe: error: cannot write {tmp_path / name}: {reason}; check permissions and free space\n"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["small"]


def test_a_simulated_recording_is_replaced_only_by_a_complete_one(tmp_path, small, monkeypatch):
    settings = [tmp_path / "a.bag", "--rig", small, "--duration", 0.3, "--workers", 1]
    assert simulate(*settings).exit_code == 0
    first = (tmp_path / "a.bag").read_bytes()
    assert "exists already" in simulate(*settings).output

    with monkeypatch.context() as patched:
        patched.setattr(Ros1Writer, "write_frame", lambda self, frame: (_ for _ in ()).throw(OSError(5, "I/O error")))
        assert simulate(*settings, "--seed", 1, "--overwrite").exit_code == 2
    assert (tmp_path / "a.bag").read_bytes() == first

    assert simulate(*settings, "--seed", 1, "--overwrite").exit_code == 0
    assert (tmp_path / "a.bag").read_bytes() != first
    assert sidecar_folder(tmp_path / "a.bag").is_dir()


@pytest.mark.parametrize("name", ["a", "a.ros2"])
def test_what_others_put_into_a_recording_stays(tmp_path, small, name):
    settings = [tmp_path / name, "--rig", small, "--duration", 0.3, "--workers", 1, "--quiet"]
    assert simulate(*settings).exit_code == 0
    first = {path.relative_to(tmp_path) for path in tmp_path.rglob("*")}
    theirs = [tmp_path / name / "notes.txt", simulation_folder(tmp_path / name) / "notes.txt"]
    for path in theirs:
        path.write_text("precious")
    assert simulate(*settings, "--overwrite", "--rate", 10).exit_code == 0
    assert [path.read_text() for path in theirs] == ["precious"] * 2
    second = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path not in theirs}
    assert second < first if name == "a" else second == first  # images of the other rate are gone


def test_errors_of_the_library_have_their_types(tmp_path):
    with pytest.raises(ConfigError, match="fog"):
        Conditions.of({"fog": -0.1})
    with pytest.raises(TrajectoryError, match="jump"):
        small_simulation(tmp_path, trajectory=jumping_file(tmp_path), duration_s=4.0)
    with pytest.raises(DatasetError, match="exists already"):
        record(small_simulation(tmp_path, duration_s=0.1), [tmp_path])
