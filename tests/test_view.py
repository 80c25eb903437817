"""``vioframe view``: what is drawn, where, and what is said when it cannot be."""

import os
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from map_helpers import box, write_ply_mesh
from trajectory_helpers import disturbed, flight, moved, write_run

from vioframe.cli import main
from vioframe.evaluation.landmarks import read_landmarks
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.io.trajectories import write_tum
from vioframe.report.scene import Flight, Scene, scene_of
from vioframe.report.scene_drawing import TRUTH_RGB, cameras, draw, rgb
from vioframe.report.scene_grid import ground_grid
from vioframe.report.scene_picture import render
from vioframe.report.scene_shapes import balls, creases, dashes, facing, polyline, rods, thinned
from vioframe.report.scene_view import best_azimuth_deg, view_of
from vioframe.report.viewing import choose_view
from vioframe.runs.evaluated import evaluate_paths
from vioframe.runs.recorder import write_ply

SIZE = (480, 320)
YAW_M = so3.exp(np.array([0.0, 0.0, 0.7])), np.array([4.0, -3.0, 1.0])


@pytest.fixture(autouse=True)
def _no_display(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


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
    write_run(folder, moved(truth, *YAW_M), truth)
    write_ply(folder / "map.ply", {10 * i: YAW_M[0] @ p + YAW_M[1] for i, p in enumerate(landmarks)})
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


def picture(path):
    from matplotlib.image import imread

    return imread(path)[..., :3].astype(float)


def share_of_colour(image, xy, colour):
    """How many of the pixels (N, 2) hold ``colour``, which is darker where a shape is seen at a slant."""
    near = np.round(xy).astype(int)
    shades = np.linspace(0.55, 1.0, 46)[:, None, None] * np.asarray(colour)
    return np.mean(np.abs(image[near[:, 1], near[:, 0]] - shades).max(axis=2).min(axis=0) < 0.06)


def test_the_paths_are_where_they_project_to_in_their_colours(tmp_path):
    pytest.importorskip("open3d")
    first = flight()
    second = moved(first, np.eye(3), np.array([0.0, 0.0, 4.0]))
    for name, trajectory in (("first", first), ("second", second)):
        write_tum(trajectory, tmp_path / f"{name}.tum")
    files = [tmp_path / "first.tum", tmp_path / "second.tum"]
    result = view(*files, "--save", tmp_path / "out" / "picture.png", "--size", "480x320")
    assert result.stdout.splitlines() == [str(tmp_path / "out" / "picture.png")]
    image = picture(tmp_path / "out" / "picture.png")
    assert image.shape == (320, 480, 3)
    scene = scene_of(evaluate_paths(files))
    _, seen_from = choose_view(scene, SIZE)
    for number, trajectory in enumerate((first, second)):
        xy = seen_from.project(trajectory.p_WB)
        assert share_of_colour(image, xy, rgb(number)) > 0.9
        assert share_of_colour(image, xy, rgb(1 - number)) < 0.1


def test_estimate_and_dashed_truth_share_the_line(run, tmp_path):
    pytest.importorskip("open3d")
    view(run, "--save", tmp_path / "p.png", "--size", "480x320")
    scene = scene_of(evaluate_paths([run]))
    xy = choose_view(scene, SIZE)[1].project(flight().p_WB[10:])
    image = picture(tmp_path / "p.png")
    assert share_of_colour(image, xy, rgb(0)) > 0.3
    assert share_of_colour(image, xy, TRUTH_RGB) > 0.2
    assert share_of_colour(image, xy, (1.0, 1.0, 1.0)) < 0.01  # the estimate fills the gaps of the dashes


def test_equal_runs_give_equal_pictures(run, tmp_path):
    pytest.importorskip("open3d")
    for name in ("1.png", "2.png"):
        view(run, "--save", tmp_path / name, "--size", "240x160")
    assert (tmp_path / "1.png").read_bytes() == (tmp_path / "2.png").read_bytes()


def test_a_run_is_shown_in_the_world_of_the_ground_truth(run, landmarks):
    scene = scene_of(evaluate_paths([run]))
    (shown,) = scene.flights
    np.testing.assert_allclose(shown.estimate.p_WB, flight().p_WB[10:], atol=1e-6)
    np.testing.assert_allclose(shown.landmarks.p_WF, landmarks[:400], atol=1e-5)
    np.testing.assert_array_equal(shown.landmarks.ids, 10 * np.arange(400))
    assert len(scene.truths) == 1


def test_runs_of_one_flight_share_their_ground_truth(run, tmp_path):
    write_run(tmp_path / "b", disturbed(flight(), 0.05, 0.01), flight())
    scene = scene_of(evaluate_paths([run, tmp_path / "b"]))
    assert [flight.name for flight in scene.flights] == ["a run", "b"]
    assert len(scene.truths) == 1


def test_a_run_without_a_pose_keeps_the_colours_of_the_others(run, tmp_path):
    write_run(tmp_path / "never", flight(30), flight(30), waiting=30)
    assert [f.number for f in scene_of(evaluate_paths([tmp_path / "never", run])).flights] == [1]


def test_the_map_is_written_without_its_outliers(run, tmp_path, landmarks, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)  # which is not needed for this
    result = view(run, "--map", tmp_path / "maps" / "clean.ply")
    assert result.stdout.strip() == f"{tmp_path / 'maps' / 'clean.ply'}: 400 landmarks"
    written = read_landmarks(tmp_path / "maps" / "clean.ply")
    np.testing.assert_array_equal(written.ids, 10 * np.arange(400))
    np.testing.assert_allclose(written.p_WF, landmarks[:400], atol=1e-5)
    assert len(read_landmarks(run / "map.ply")) == 403


@pytest.mark.parametrize("azimuth", [-170.0, 0.0, 65.0])
@pytest.mark.parametrize("elevation", [-30.0, 0.0, 28.0, 89.0])
@pytest.mark.parametrize("size", [(400, 300), (300, 600)])
def test_everything_is_in_the_picture_and_fills_it(azimuth, elevation, size):
    points = flight().p_WB + np.array([50.0, -20.0, 3.0])
    seen_from = view_of(points, azimuth, elevation, size)
    np.testing.assert_allclose(seen_from.R_VW @ seen_from.R_VW.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(seen_from.R_VW) == pytest.approx(1.0)
    assert seen_from.depth(points).min() > 0.0
    xy = seen_from.project(points) + 0.5
    low, high = xy.min(axis=0) / size, 1.0 - xy.max(axis=0) / size
    assert min(low.min(), high.min()) == pytest.approx(0.04)
    np.testing.assert_allclose(low, high, atol=1e-4)  # in the middle
    up_V = seen_from.R_VW[:, 2]
    assert up_V[0] == pytest.approx(0.0)
    assert up_V[1] < 0.0


def test_rays_go_through_the_pixels_that_points_project_to():
    points = flight(50).p_WB
    seen_from = view_of(points, 30.0, 20.0, SIZE)
    ahead = seen_from.directions(seen_from.project(points)) * seen_from.depth(points)[:, None]
    np.testing.assert_allclose(seen_from.eye + ahead, points, atol=1e-9)


@pytest.mark.parametrize("behind", [-5.0, 5.0])
def test_a_path_is_looked_at_broadside_with_the_scenery_behind(behind):
    path = np.column_stack([np.linspace(-4.0, 4.0, 50), np.zeros(50), np.zeros(50)])
    scenery = path + np.array([0.0, behind, 0.0])
    azimuth = np.radians(best_azimuth_deg(path, scenery))
    assert np.sign(np.sin(azimuth)) == -np.sign(behind)
    assert abs(np.cos(azimuth)) < 0.5


def test_a_body_at_rest_can_be_seen(tmp_path):
    pytest.importorskip("open3d")
    still = flight(40)
    still = Trajectory(still.t_ns, still.R_WB, np.zeros((40, 3)))
    for name, trajectory in (("still", still), ("single", still.select(slice(0, 1)))):
        write_tum(trajectory, tmp_path / f"{name}.tum")
        view(tmp_path / f"{name}.tum", "--save", tmp_path / "p.png", "--size", "240x160")
        scene = scene_of(evaluate_paths([tmp_path / f"{name}.tum"]))
        xy = choose_view(scene, (240, 160))[1].project(np.zeros((1, 3)))
        assert share_of_colour(picture(tmp_path / "p.png"), xy, rgb(0)) == 1.0


def test_a_wall_before_the_flight_does_not_hide_it_and_one_behind_is_seen():
    pytest.importorskip("open3d")
    path = flight()
    scene = Scene([Flight(0, "a", path, None, None)], [], box((-9.0, -8.0, -3.0), (9.0, 8.0, 3.0)))
    grid, seen_from = choose_view(scene, SIZE)
    image = render(draw(scene, grid, seen_from), seen_from) / 255.0
    # One pane of glass at most lies before it.
    behind_glass = 0.95 * np.array(rgb(0)) + 0.05 * 0.88
    assert share_of_colour(image, seen_from.project(path.p_WB), behind_glass) > 0.9
    beyond = -seen_from.eye * [1.0, 1.0, 0.0]
    far_wall = np.array([[0.0, np.copysign(8.0, beyond[1]), 1.7]])
    assert 0.75 < image[tuple(np.round(seen_from.project(far_wall)[0]).astype(int)[::-1])].mean() < 0.95
    assert image[2, -3].mean() == 1.0


def test_the_cameras_look_where_the_camera_looked():
    calibration, path = packaged_calibration("euroc"), flight()
    corners = cameras(Flight(0, "a", path, None, calibration), calibration, 0.02).corners
    p_WC = path.p_WB + path.R_WB @ calibration.p_BC
    ahead_W = path.R_WB @ calibration.R_BC[:, 2]
    rods_each = 16 * 8
    assert 10 <= len(corners) / rods_each <= 23
    for camera in corners.reshape(-1, rods_each, 3, 3):
        # The first four of the eight rods come from the apex, the others are around the image.
        apex = camera[:64].reshape(4, 16, 9)[:, :, :3].mean(axis=(0, 1))
        base = camera[64:].reshape(-1, 3).mean(axis=0)
        nearest = np.argmin(np.linalg.norm(p_WC - apex, axis=1))
        assert np.linalg.norm(p_WC[nearest] - apex) < 0.02
        assert (base - apex) @ ahead_W[nearest] / np.linalg.norm(base - apex) > 0.98


def test_a_run_folder_without_calibration_is_shown_without_cameras(run, tmp_path):
    write_run(tmp_path / "b", flight(), flight())
    with_, without = (scene_of(evaluate_paths([path])).flights[0].calibration for path in (run, tmp_path / "b"))
    assert without is None
    np.testing.assert_allclose(with_.R_BC, packaged_calibration("euroc").R_BC, atol=1e-12)


def test_a_grid_has_round_lines_around_all_that_is_of_interest(run):
    scene = scene_of(evaluate_paths([run]))
    grid = ground_grid(scene)
    assert grid.step_m == 2.0
    for axis in (0, 1):
        np.testing.assert_allclose(grid.ticks(axis) % 2.0, 0.0, atol=1e-9)
        assert grid.ticks(axis)[0] <= scene.of_interest[:, axis].min()
        assert grid.ticks(axis)[-1] >= scene.of_interest[:, axis].max()
    assert grid.z_m <= scene.path[:, 2].min()


def test_landmarks_far_away_do_not_make_the_flight_small(run):
    scene = scene_of(evaluate_paths([run]))
    far = Scene(scene.flights, scene.truths)
    reach = np.linalg.norm(far.of_interest - scene.path.mean(axis=0), axis=1).max()
    assert reach < 2.0 * np.linalg.norm(scene.path - scene.path.mean(axis=0), axis=1).max()


def outward(corners, middle):
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return np.sum(normals * (corners.mean(axis=1) - middle), axis=1)


def test_shapes_turn_their_outside_outwards():
    for fine, facets in ((False, 20), (True, 320)):
        ball = balls(np.array([[1.0, 2.0, 3.0]]), 0.5, (1.0, 0.0, 0.0), fine=fine).corners
        assert len(ball) == facets
        assert (outward(ball, np.array([1.0, 2.0, 3.0])) > 0.0).all()
        np.testing.assert_allclose(np.linalg.norm(ball - [1.0, 2.0, 3.0], axis=2), 0.5)
    for end in np.concatenate([np.eye(3), -np.eye(3), [[1.0, -2.0, 0.5]]]):
        rod = rods(np.zeros((1, 3)), end[None], 0.1, (1.0, 0.0, 0.0)).corners
        middle = rod.mean(axis=1) @ end / (end @ end)
        assert (outward(rod, middle[:, None] * end) > 0.0).all()


def test_lines_keep_to_the_points():
    points = np.array([[0.0, 0.0, 0.0], [0.001, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    np.testing.assert_array_equal(thinned(points, 0.5), points[[0, 2, 3, 4]])
    tube = polyline(points, 0.1, (0.0, 0.0, 0.0)).corners.reshape(-1, 3)
    on_first, on_second = np.hypot(tube[:, 1], tube[:, 2]), np.hypot(tube[:, 0] - 1.0, tube[:, 2])
    assert np.minimum(on_first, on_second).max() <= 0.1 + 1e-12
    dash = dashes(np.array([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0]]), 0.1, 1.0, (0.0, 0.0, 0.0)).corners[..., 0]
    assert np.all(dash % 1.0 <= 0.5)


def test_a_box_has_twelve_edges():
    a, b = creases(box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)))
    assert sorted(np.linalg.norm(b - a, axis=1).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
    assert len(creases(box((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))[:2])[0]) == 4  # a lone sheet: what bounds it


def test_faces_are_turned_to_the_flight():
    hall = box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    assert (outward(facing(hall, np.zeros(3)), np.zeros(3)) < 0.0).all()


def test_the_window_shows_the_same(run):
    """Open3D's window, off screen, in a process of its own: a graphics driver may take its process with it."""
    pytest.importorskip("open3d")
    code = f"""
import sys
import numpy as np, open3d
from vioframe.runs.evaluated import evaluate_paths
from vioframe.report.scene import scene_of
from vioframe.report.scene_window import fill
from vioframe.report.viewing import choose_view
window = open3d.visualization.Visualizer()
if not window.create_window("test", 480, 320, visible=False):
    sys.exit(77)
scene = scene_of(evaluate_paths([{str(run)!r}]))
grid, view = choose_view(scene, (480, 320))
fill(window, scene, grid, view)
image = np.asarray(window.capture_screen_float_buffer(True))
xy = np.round(view.project(scene.flights[0].estimate.p_WB)).astype(int)
print("white", (image[xy[:, 1], xy[:, 0]].min(axis=1) > 0.9).mean(), (image.min(axis=2) > 0.9).mean())
"""
    code = code.replace(f"[{str(run)!r}]", f"[__import__('pathlib').Path({str(run)!r})]")
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.skip(f"no graphics driver that works here: {result.stderr[-200:]}")
    on_path, everywhere = map(float, result.stdout.splitlines()[-1].split()[1:])
    assert on_path < 0.05
    assert everywhere > 0.6


def test_without_a_display_the_remedy_is_named(run, monkeypatch):
    assert "no display" in (error := one_line(run))
    assert "--save FILE.png" in error
    # A display that is named and cannot be reached, as of a connection that is gone.
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-9")
    monkeypatch.setenv("XDG_RUNTIME_DIR", os.devnull)
    assert "--save FILE.png" in one_line(run)


def test_without_open3d_the_remedy_is_named(run, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    error = one_line(run, "--save", tmp_path / "p.png")
    assert "pip install 'vioframe[open3d]'" in error


def test_bad_input_is_one_line(run, tmp_path):
    pytest.importorskip("open3d")
    save = ("--save", tmp_path / "p.png", "--size", "240x160")
    write_run(tmp_path / "never", flight(30), flight(30), waiting=30)
    result = view(tmp_path / "never", *save, code=2)
    assert "nothing to show" in result.stderr.splitlines()[-1]
    write_tum(flight(), tmp_path / "bare.tum")
    assert "no landmarks" in view(tmp_path / "bare.tum", "--map", tmp_path / "m.ply", code=2).stderr
    assert "there is no mesh" in one_line(run, *save, "--world", tmp_path / "none.ply")
    flat = write_ply_mesh(tmp_path / "flat.ply", np.full((1, 3, 3), np.nan))
    assert "holds no triangles" in one_line(run, *save, "--world", flat)
    (tmp_path / "file").write_text("")
    assert "cannot write" in one_line(run, "--save", tmp_path / "file" / "p.png", "--size", "240x160")
    assert "cannot write" in one_line(run, "--map", tmp_path / "file" / "m.ply")
    assert "is not a run folder" in one_line(tmp_path, *save)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--size", "1600"], "not a size such as 1600x1000"),
        (["--size", "20x20"], "100 to 8000 pixels"),
        (["--save", "p.jpg"], "does not end in .png"),
        (["again", "--map", "m.ply"], "a single RUN"),
        (["--elevation", "120"], "-89.0<=x<=89.0"),
    ],
)
def test_bad_options_are_refused(run, arguments, says):
    assert says in view(run, *arguments, code=2).stderr
