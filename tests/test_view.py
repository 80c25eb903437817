"""``vioframe view``: what is in the recording, where, and what is said when it cannot be."""

import sys

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from map_helpers import box, write_ply_mesh
from recordings import PAIR, pair_measurements
from trajectory_helpers import disturbed, flight, moved, write_run

from vioframe.cli import main
from vioframe.evaluation.landmarks import Landmarks, read_landmarks
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.io.convert import convert
from vioframe.io.trajectories import write_tum
from vioframe.report.style import colour
from vioframe.runs.recorder import write_ply
from vioframe.types import FrameSet

pytest.importorskip("rerun")
# rerun warns, and goes on, where it is given what it cannot take.
pytestmark = [pytest.mark.filterwarnings("error"), pytest.mark.usefixtures("no_display")]

YAW_M = so3.exp(np.array([0.0, 0.0, 0.7])), np.array([4.0, -3.0, 1.0])
SIGMA_M = 0.1


@pytest.fixture(scope="module")
def landmarks():
    """On a wall behind the flight, and three far away."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-7.0, 7.0, 400), np.full(400, 7.0), rng.uniform(-1.0, 2.0, 400)])
    return np.concatenate([wall, [[300.0, 0.0, 0.0], [0.0, -250.0, 40.0], [-200.0, 100.0, 0.0]]])


@pytest.fixture(scope="module")
def run(tmp_path_factory, landmarks):
    """A run folder in a world of its own, turned and shifted against the ground truth's."""
    folder = tmp_path_factory.mktemp("view") / "a run"
    truth = flight()
    cov = np.tile(np.diag([1e-4] * 3 + [SIGMA_M**2] * 3), (len(truth), 1, 1))
    estimate = moved(truth, *YAW_M)
    write_run(folder, Trajectory(estimate.t_ns, estimate.R_WB, estimate.p_WB, cov), truth)
    write_ply(folder / "map.ply", Landmarks(10 * np.arange(len(landmarks)), landmarks @ YAW_M[0].T + YAW_M[1]))
    write_calibration(packaged_calibration("euroc"), folder / "calibration")
    return folder


def view(*arguments, code=0):
    result = CliRunner().invoke(main, ["view", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result


def one_line(*arguments):
    error = view(*arguments, code=2).stderr
    assert len(error.splitlines()) == 1
    return error


def recorded(path):
    """Values by entity and component, a row a time, and the times in ns, of a recording."""
    from rerun.chunk import RrdReader

    values, times = {}, {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if ":" in name:
                values.setdefault((chunk.entity_path, name), []).extend(column.to_pylist())
            elif name == "time":
                times.setdefault(chunk.entity_path, []).extend(column.cast("int64").to_pylist())
    return values, times


def test_a_run_is_shown_in_the_world_of_the_ground_truth(run, tmp_path, landmarks):
    result = view(run, "--save", tmp_path / "out" / "v.rrd")
    assert result.stdout.splitlines() == [str(tmp_path / "out" / "v.rrd")]
    values, times = recorded(tmp_path / "out" / "v.rrd")
    at = r"/world/a\ run"
    body = np.array(values[f"{at}/body", "Transform3D:translation"])[:, 0]
    np.testing.assert_allclose(body, flight().p_WB[10:], atol=1e-5)
    assert times[f"{at}/body"] == (flight().t_ns[10:] - flight().t_ns[0]).tolist()
    truth = np.array(values[r"/world/ground\ truth/body", "Points3D:positions"])[:, 0]
    np.testing.assert_allclose(truth, flight().p_WB, atol=1e-5)
    (shown,) = values[f"{at}/landmarks", "Points3D:positions"]
    np.testing.assert_allclose(shown, landmarks[:400], atol=1e-4)
    # The features of frame k are called 3 k to 3 k + 119, the landmarks 0, 10, 20 ...
    np.testing.assert_allclose(
        values[f"{at}/landmarks\\ in\\ view", "Points3D:positions"][7], landmarks[3:15], atol=1e-4
    )
    half_sizes = np.array(values[f"{at}/3\\ sigma", "Ellipsoids3D:half_sizes"])
    np.testing.assert_allclose(half_sizes, 3.0 * SIGMA_M, rtol=1e-5)


def test_errors_stand_between_their_bounds(run, tmp_path):
    view(run, "--save", tmp_path / "v.rrd")
    values, _ = recorded(tmp_path / "v.rrd")
    for axis in "xyz":
        error, low, high = np.array(values[rf"/position/{axis}/a\ run", "Scalars:scalars"]).T
        np.testing.assert_allclose(error, 0.0, atol=1e-6)
        np.testing.assert_allclose([low, high], np.outer([-3.0 * SIGMA_M, 3.0 * SIGMA_M], np.ones(len(low))), rtol=1e-6)
        assert len(values[rf"/rotation/{axis}/a\ run", "Scalars:scalars"]) == 390
        assert (np.array(values[rf"/bias_gyro/{axis}/a\ run", "Scalars:scalars"]) == [0.0, -3.0, 3.0]).all()
    spent = values[r"/time/a\ run", "Scalars:scalars"][-1][0]
    stages = [rows[-1][0] for (path, name), rows in values.items() if "/stages/" in path and "scalars" in name]
    assert spent == pytest.approx(sum(stages))
    assert values[r"/features/a\ run/tracked", "Scalars:scalars"] == [[120.0]] * 400


def test_nothing_is_drawn_where_nothing_was_estimated(tmp_path):
    gap = flight().select(np.r_[0:100, 200:400])
    write_tum(gap, tmp_path / "gap.tum")
    write_tum(flight(), tmp_path / "truth.tum")
    view(tmp_path / "gap.tum", "--ground-truth", tmp_path / "truth.tum", "--save", tmp_path / "v.rrd")
    values, times = recorded(tmp_path / "v.rrd")
    assert [len(strip) for strip in values["/world/gap/path", "LineStrips3D:strips"][0]] == [100, 200]
    error = np.array(values["/position/x/gap", "Scalars:scalars"])[:, 0]
    assert np.flatnonzero(np.isnan(error)).tolist() == [100]
    assert np.all(np.diff(times["/position/x/gap"]) > 0)


def test_runs_of_one_flight_share_the_truth_and_keep_their_colours(run, tmp_path):
    write_run(tmp_path / "b", disturbed(flight(), 0.05, 0.01), flight())
    write_run(tmp_path / "never", flight(30), flight(30), waiting=30)
    view(tmp_path / "never", run, tmp_path / "b", "--save", tmp_path / "v.rrd")
    values, _ = recorded(tmp_path / "v.rrd")
    paths = {path: rows[0] for (path, name), rows in values.items() if name == "LineStrips3D:colors"}
    expected = {r"/world/a\ run/path": colour(1), "/world/b/path": colour(2), r"/world/ground\ truth": "#b0b0b0"}
    assert paths == {path: [int(f"{each[1:]}FF", 16)] for path, each in expected.items()}
    assert not any("never/body" in path and "Transform3D" in name for path, name in values)


def test_images_are_those_of_the_recording_while_it_is_there(tmp_path):
    """Of both cameras of a rig, each in its place and once for all runs."""
    sent = pair_measurements()
    convert(sent, PAIR, tmp_path / "flight", format="asl")
    frames = [m for m in sent if isinstance(m, FrameSet)][:4]
    t_ns = np.array([each.t_ns for each in frames])
    for name in ("first", "second"):
        write_run(tmp_path / name, Trajectory(t_ns, np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3))), waiting=1)
        (tmp_path / name / "config.yaml").write_text(f"dataset: {{path: {tmp_path / 'flight'}, reader: euroc}}\n")
        write_calibration(PAIR, tmp_path / name / "calibration")
    view(tmp_path / "first", tmp_path / "second", "--save", tmp_path / "v.rrd")
    values, times = recorded(tmp_path / "v.rrd")
    body = "/world/first/body"
    shown = {path: rows for (path, name), rows in values.items() if name == "EncodedImage:blob"}
    assert set(shown) == {f"{body}/{camera.name}/image" for camera in PAIR.cameras}
    for place, camera in enumerate(PAIR.cameras):
        path = f"{body}/{camera.name}/image"
        taken = [each for each in frames if each.images[place] is not None]
        assert times[path] == [each.t_ns - t_ns[0] for each in taken]
        for (jpeg,), each in zip(shown[path], taken, strict=True):
            image = cv2.imdecode(np.array(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
            assert np.corrcoef(image.ravel(), each.images[place].ravel())[0, 1] > 0.9
    for name in ("first", "second"):
        points = values[f"{body}/{PAIR.cameras[0].name}/tracks/{name}", "Points2D:positions"]
        assert [len(each) for each in points] == [120] * 4
    (tmp_path / "flight").rename(tmp_path / "gone")
    view(tmp_path / "first", "--save", tmp_path / "v.rrd")
    assert not any(name == "EncodedImage:blob" for _, name in recorded(tmp_path / "v.rrd")[0])


def test_the_cameras_are_where_the_calibration_has_them(run, tmp_path):
    view(run, "--save", tmp_path / "v.rrd")
    values, _ = recorded(tmp_path / "v.rrd")
    for camera in packaged_calibration("euroc").cameras:
        at = rf"/world/a\ run/body/{camera.name}"
        np.testing.assert_allclose(values[at, "Transform3D:translation"][0][0], camera.p_BC, rtol=1e-6)
        R_BC = np.reshape(values[at, "Transform3D:mat3x3"][0][0], (3, 3)).T
        np.testing.assert_allclose(R_BC, camera.R_BC, atol=1e-6)
        assert values[at, "Pinhole:resolution"][0][0] == [752.0, 480.0]


def test_a_world_is_shown_around_the_flight(run, tmp_path):
    pytest.importorskip("open3d")
    hall = box((-9.0, -8.0, -3.0), (9.0, 8.0, 3.0))
    view(run, "--save", tmp_path / "v.rrd", "--world", write_ply_mesh(tmp_path / "hall.ply", hall))
    (vertices,) = recorded(tmp_path / "v.rrd")[0]["/world/mesh", "Mesh3D:vertex_positions"]
    np.testing.assert_allclose(vertices, hall.reshape(-1, 3))


def test_a_body_at_rest_can_be_seen(tmp_path):
    still = flight(40)
    still = Trajectory(still.t_ns, still.R_WB, np.zeros((40, 3)))
    for name, trajectory in (("still", still), ("single", still.select(slice(0, 1)))):
        write_tum(trajectory, tmp_path / f"{name}.tum")
        view(tmp_path / f"{name}.tum", "--save", tmp_path / "v.rrd")
        values, _ = recorded(tmp_path / "v.rrd")
        assert len(values[f"/world/{name}/body", "Transform3D:translation"]) == len(trajectory)


def test_the_map_is_written_without_its_outliers(run, tmp_path, landmarks, monkeypatch):
    for module in ("open3d", "rerun"):
        monkeypatch.setitem(sys.modules, module, None)  # which are not needed for this
    result = view(run, "--map", tmp_path / "maps" / "clean.ply")
    assert result.stdout.strip() == f"{tmp_path / 'maps' / 'clean.ply'}: 400 landmarks"
    written = read_landmarks(tmp_path / "maps" / "clean.ply")
    np.testing.assert_array_equal(written.ids, 10 * np.arange(400))
    np.testing.assert_allclose(written.p_WF, landmarks[:400], atol=1e-5)
    assert len(read_landmarks(run / "map.ply")) == 403


def test_what_is_missing_is_said_with_its_remedy(run, tmp_path, monkeypatch):
    error = one_line(run)
    assert "no display" in error
    assert "--save FILE.rrd" in error
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "open3d", None)
        world = write_ply_mesh(tmp_path / "hall.ply", box((0, 0, 0), (1, 1, 1)))
        assert "pip install 'vioframe[open3d]'" in one_line(run, "--save", tmp_path / "v.rrd", "--world", world)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'vioframe[view]'" in one_line(run, "--save", tmp_path / "v.rrd")


def test_bad_input_is_one_line(run, tmp_path):
    save = ("--save", tmp_path / "v.rrd")
    write_run(tmp_path / "never", flight(30), flight(30), waiting=30)
    assert "nothing to show" in view(tmp_path / "never", *save, code=2).stderr.splitlines()[-1]
    write_tum(flight(), tmp_path / "bare.tum")
    assert "no landmarks" in view(tmp_path / "bare.tum", "--map", tmp_path / "m.ply", code=2).stderr
    assert "there is no mesh" in one_line(run, *save, "--world", tmp_path / "none.ply")
    (tmp_path / "file").write_text("")
    assert "cannot write" in one_line(run, "--save", tmp_path / "file" / "v.rrd")
    assert "cannot write" in one_line(run, "--map", tmp_path / "file" / "m.ply")
    assert "is not a run folder" in one_line(tmp_path, *save)
    assert not (tmp_path / "v.rrd").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [(["--save", "p.png"], "does not end in .rrd"), (["again", "--map", "m.ply"], "a single RUN")],
)
def test_bad_options_are_refused(run, arguments, says):
    assert says in view(run, *arguments, code=2).stderr
