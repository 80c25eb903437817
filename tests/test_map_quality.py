"""Landmarks against the surfaces they were seen on, and landmarks that stand alone."""

import json
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from map_helpers import box, write_ply_mesh
from trajectory_helpers import disturbed, flight, moved, write_run

from vioframe.cli import main
from vioframe.errors import ConfigError, RunError
from vioframe.evaluation.landmarks import Landmarks, MapQuality, belonging, read_landmarks
from vioframe.geometry import so3
from vioframe.geometry.meshes import distances, read_mesh
from vioframe.io.trajectories import write_tum
from vioframe.report.map_quality import measure_maps, simulated_world
from vioframe.runs.evaluated import evaluate_paths
from vioframe.runs.folder import RunFolder
from vioframe.runs.recorder import write_ply

HALL = box((-9.0, -8.0, -3.0), (9.0, 8.0, 3.0))
FAR_M = np.array([0.0, 0.03, 0.08, 0.15, 0.4])
"""How far the five landmarks of ``PLACES`` lie from the hall's surfaces."""
PLACES = np.array([[9.0, 1.0, 0.0], [-8.97, 2.0, 1.0], [3.0, 8.08, 2.0], [-4.0, 5.0, -2.85], [9.4, 0.0, 1.0]])


@pytest.fixture(scope="module", autouse=True)
def _open3d():
    pytest.importorskip("open3d")


def evaluate(*arguments, code=0):
    result = CliRunner().invoke(main, ["evaluate", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result


def recorded(folder, p_WF=PLACES, yaw=0.0, config=None):
    """A run through the hall whose world, landmarks and all, is turned and shifted against the ground truth's."""
    R, p = so3.exp(np.array([0.0, 0.0, yaw])), yaw * np.array([3.0, -5.0, 1.0])
    truth = flight()
    write_run(folder, moved(truth, R, p), truth)
    write_ply(folder / "map.ply", Landmarks(np.arange(len(p_WF)), p_WF @ R.T + p))
    if config is not None:
        (folder / "config.yaml").write_text(f"dataset:\n  path: {config}\n")
    return folder


def test_distances_from_faces_edges_and_corners_are_exact():
    unit = box((100.0, 200.0, 0.0), (102.0, 202.0, 2.0))
    points = np.array([[1, 1, 1], [1, 1, 2.5], [1, 0.4, 1], [2.3, 2.4, 1], [-0.2, -0.3, 2.6], [2, 1, 1]])
    expected = [1.0, 0.5, 0.4, 0.5, 0.7, 0.0]
    np.testing.assert_allclose(distances(points + np.array([100.0, 200.0, 0.0]), unit), expected, atol=1e-6)


def test_the_figures_are_those_of_the_distances():
    quality = MapQuality.of(PLACES, HALL, "hall")
    assert quality.landmarks == 5
    assert quality.median_m == pytest.approx(0.08, abs=1e-6)
    assert quality.rmse_m == pytest.approx(np.sqrt(np.mean(FAR_M**2)), abs=1e-6)
    assert quality.q90_m == pytest.approx(0.3, abs=1e-6)  # 0.15 and 0.4 are the 75 and 100 % quantiles
    assert quality.within == {"5cm": 0.4, "10cm": 0.6, "20cm": 0.8}


@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_landmarks_are_moved_with_the_alignment_of_the_path(tmp_path, yaw):
    run = recorded(tmp_path / "run", yaw=yaw)
    (measured,), notes = measure_maps(evaluate_paths([run]), write_ply_mesh(tmp_path / "hall.ply", HALL))
    assert notes == []
    # What is left is the rounding of the files and of single precision.
    assert measured.map_quality.rmse_m == pytest.approx(np.sqrt(np.mean(FAR_M**2)), abs=1e-5)
    assert measured.map_quality.q90_m == pytest.approx(0.3, abs=1e-5)


def test_a_map_that_is_too_large_is_as_far_off_as_it_is(tmp_path):
    """A scale that the alignment may not mend."""
    surface = np.random.default_rng(0).uniform(-6.0, 6.0, (200, 2))
    floor = np.column_stack([surface, np.full(200, -3.0)])
    run = recorded(tmp_path / "run", p_WF=1.01 * floor)
    (measured,), _ = measure_maps(evaluate_paths([run]), write_ply_mesh(tmp_path / "hall.ply", HALL))
    assert measured.map_quality.median_m == pytest.approx(0.03, abs=1e-5)


@pytest.mark.parametrize(
    ("recording", "given", "world"),
    [
        ("flight.bag", "flight.bag", "flight.bag.simulation/world.ply"),
        ("flight/mav0/x", "flight", "flight/simulation/world.ply"),
        ("flight/mav0/x", "flight/mav0", "flight/simulation/world.ply"),
    ],
)
def test_the_world_beside_a_simulated_recording_is_found(tmp_path, recording, given, world):
    (tmp_path / recording).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / recording).touch()
    run = RunFolder.open(recorded(tmp_path / "run", config=tmp_path / given))
    assert simulated_world(run) is None
    write_ply_mesh(tmp_path / world, HALL)
    assert simulated_world(run) == tmp_path / world


def test_a_run_folder_without_its_configuration_has_no_world(tmp_path):
    assert simulated_world(RunFolder.open(recorded(tmp_path / "run"))) is None


def test_the_table_and_the_json_hold_the_map(tmp_path):
    write_ply_mesh(tmp_path / "f.bag.simulation" / "world.ply", HALL)
    run = recorded(tmp_path / "run", config=tmp_path / "f.bag")
    # The second run is not of a simulated recording.
    other = recorded(tmp_path / "other", config=tmp_path / "real.bag")
    table = evaluate(run, other).stdout
    rows = {line.split("│")[0].strip(): line.split("│")[1:] for line in table.splitlines() if "│" in line}
    assert [cell.strip() for cell in rows["90 % are within"]] == ["0.300 m", "–"]
    assert [cell.strip() for cell in rows["within 5, 10, 20 cm"]] == ["40.0%, 60.0%, 80.0%", "–"]
    figures = json.loads(evaluate(run, "--format", "json").stdout)[0]["map"]
    assert figures["landmarks"] == 5
    assert figures["median_m"] == pytest.approx(0.08, abs=1e-5)
    assert figures["within"] == {"5cm": 0.4, "10cm": 0.6, "20cm": 0.8}
    assert figures["world"] == str(tmp_path / "f.bag.simulation" / "world.ply")
    assert json.loads((run / "evaluation.json").read_text())["map"] == figures
    assert "map" not in json.loads((other / "evaluation.json").read_text())
    assert "map.q90_m" in evaluate(run, "--format", "csv").stdout


def test_a_world_that_cannot_be_used_is_one_line(tmp_path):
    run = recorded(tmp_path / "run")
    (tmp_path / "bad.ply").write_text("ply\nnothing\n")
    for world, says in (("none.ply", "there is no mesh"), ("bad.ply", "holds no triangles")):
        error = evaluate(run, "--world", tmp_path / world, code=2).stderr
        assert says in error
        assert len(error.splitlines()) == 1


def test_what_has_no_map_says_so(tmp_path):
    world = write_ply_mesh(tmp_path / "hall.ply", HALL)
    run = recorded(tmp_path / "run")
    write_tum(disturbed(flight(), 0.1, 0.01), tmp_path / "file.tum")
    truth = run / "ground_truth.tum"
    (tmp_path / "empty").mkdir()
    empty = recorded(tmp_path / "empty" / "run", p_WF=np.empty((0, 3)))
    for path in (tmp_path / "file.tum", empty):
        error = evaluate(path, "--world", world, "--ground-truth", truth, code=2).stderr
        assert "no landmarks were recorded" in error
        assert len(error.splitlines()) == 1
    # Beside a run that has one it is a note.
    result = evaluate(run, tmp_path / "file.tum", "--world", world, "--ground-truth", truth)
    assert "note: file: its map is not compared with the world: no landmarks" in result.stderr
    assert "0.300 m" in result.stdout
    truth.unlink()
    assert "pass --ground-truth" in evaluate(run, "--world", world, code=2).stderr


def test_without_open3d_only_what_was_asked_for_fails(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    world = write_ply_mesh(tmp_path / "f.bag.simulation" / "world.ply", HALL)
    run = recorded(tmp_path / "run", config=tmp_path / "f.bag")
    result = evaluate(run)
    assert "pip install 'vioframe[open3d]'" in result.stderr
    assert "Position error" in result.stdout
    error = evaluate(run, "--world", world, code=2).stderr
    assert "pip install 'vioframe[open3d]'" in error
    assert len(error.splitlines()) == 1


def test_a_mesh_is_read_as_it_was_written(tmp_path):
    np.testing.assert_allclose(read_mesh(write_ply_mesh(tmp_path / "hall.ply", HALL)), HALL, atol=1e-12)
    with pytest.raises(ConfigError, match="there is no mesh"):
        read_mesh(tmp_path / "other.ply")


def test_landmarks_are_read_as_the_recorder_writes_them(tmp_path):
    write_ply(tmp_path / "map.ply", Landmarks(np.array([3, 7]), np.array([[0.25, 0.0, -1e-6], [1.0, -2.0, 3.5]])))
    found = read_landmarks(tmp_path / "map.ply")
    np.testing.assert_array_equal(found.ids, [3, 7])
    np.testing.assert_array_equal(found.p_WF, [[0.25, 0.0, -1e-6], [1.0, -2.0, 3.5]])
    write_ply(tmp_path / "map.ply", Landmarks(np.empty(0, np.int64), np.empty((0, 3))))
    assert len(read_landmarks(tmp_path / "map.ply")) == 0


@pytest.mark.parametrize(
    ("old", "new"), [("vertex 2", "vertex 3"), ("3.5", "nan"), ("3.5", "x"), ("int id", "int number"), ("ply", "")]
)
def test_a_damaged_map_is_named(tmp_path, old, new):
    path = tmp_path / "map.ply"
    write_ply(path, Landmarks(np.array([3, 7]), np.array([[0.25, 0.0, -1e-6], [1.0, -2.0, 3.5]])))
    path.write_text(path.read_text().replace(old, new, 1) if old != "ply" else path.read_text()[:40])
    with pytest.raises(RunError, match=r"map\.ply is damaged"):
        read_landmarks(path)


def cloud_with_strays():
    rng = np.random.default_rng(3)
    walls = rng.uniform(-1.0, 1.0, (600, 3)) * [8.0, 8.0, 0.02]
    strays = rng.choice([-1.0, 1.0], (12, 3)) * rng.uniform(15.0, 40.0, (12, 3))
    return np.concatenate([walls, strays])


def test_what_stands_alone_is_removed_and_the_rest_is_kept():
    kept = belonging(cloud_with_strays())
    assert not kept[600:].any()
    assert kept[:600].all()


@pytest.mark.parametrize(("neighbours", "ratio"), [(20, 2.0), (8, 1.0), (30, 0.5)])
def test_outliers_are_those_of_open3d(neighbours, ratio):
    import open3d

    points = cloud_with_strays()
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    _, kept = cloud.remove_statistical_outlier(neighbours, ratio)
    np.testing.assert_array_equal(np.flatnonzero(belonging(points, neighbours, ratio)), kept)


@pytest.mark.parametrize("n", [0, 1, 2, 5])
def test_few_landmarks_are_all_kept(n):
    assert belonging(np.random.default_rng(n).normal(size=(n, 3))).all()
    assert belonging(np.zeros((n, 3))).all()
