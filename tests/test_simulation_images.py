"""Rendered images: geometry to a tenth of a pixel, light as asked for, and the same bytes every time."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from simulation_helpers import small_calibration

from vioframe.errors import ConfigError
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.geometry.meshes import ray_scene
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation.camera import Photographer, Shot, Studio, take_pictures
from vioframe.simulation.conditions import Conditions
from vioframe.simulation.renderer import Renderer
from vioframe.simulation.textures import SIZE, images_as_textures, procedural_textures
from vioframe.simulation.world import MeshBuilder, MeshWorld, draw_movers

open3d = pytest.importorskip("open3d", exc_type=ImportError)

EUROC = packaged_calibration("euroc", cameras=["cam0"]).cameras[0].model
SMALL = small_calibration().cameras[0].model
FISHEYE = Camera(230.0, 229.0, 370.0, 236.0, (-0.01, 0.03, -0.02, 0.004), (752, 480), "equidistant")
BLACK, WHITE = (np.full((8, 8), value, np.uint8) for value in (40, 220))
SQUARE_M = 0.3


def board(columns: int = 12, rows: int = 8) -> MeshWorld:
    """A chequerboard in the plane z = 0, its centre in the origin, each square a face of its own."""
    builder = MeshBuilder()
    for i in range(columns):
        for j in range(rows):
            corner = SQUARE_M * np.array([i - columns / 2, j - rows / 2, 0.0])
            x, y = SQUARE_M * np.eye(3)[:2]
            builder.quad(corner, x, y, (i + j) % 2, 1.0, np.zeros(2))
    return MeshWorld(builder.build(), (BLACK, WHITE))


OUTLINE = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(0.0, 2.0 * np.pi, 80, endpoint=False)])
OUTLINE /= np.abs(OUTLINE).max(axis=1, keepdims=True)  # of a square


def centroid(polygon: np.ndarray) -> np.ndarray:
    """Of the area of a polygon (N, 2)."""
    following = np.roll(polygon, -1, axis=0)
    cross = polygon[:, 0] * following[:, 1] - polygon[:, 1] * following[:, 0]
    return ((polygon + following) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum())


def vertices(half: float) -> tuple[MeshWorld, np.ndarray]:
    """A dark wall in the plane z = 0 with vertices (N, 3) m in it, four white squares of ``half`` m around each."""
    builder, points = MeshBuilder(), []
    builder.quad(np.array([-4.0, -4.0, 0.02]), *(8.0 * np.eye(3)[:2]), 0, 1.0, np.zeros(2))
    for i in range(-4, 5):
        for j in range(-3, 4):
            point = np.array([0.35 * i, 0.3 * j, 0.0])
            for dx in (-half, half):
                for dy in (-half, half):
                    builder.quad(point, np.array([dx, 0.0, 0.0]), np.array([0.0, dy, 0.0]), 1, 1.0, np.zeros(2))
            points.append(point)
    return MeshWorld(builder.build(), (BLACK, WHITE)), np.array(points)


@pytest.mark.parametrize("camera", [EUROC, FISHEYE], ids=["radtan", "equidistant"])
@pytest.mark.parametrize("seed", range(4))
def test_a_vertex_is_drawn_where_it_projects_to(camera, seed):
    """The four squares have their centre of light where their common vertex projects to."""
    rng = np.random.default_rng(seed)
    # Between four and six pixels to either side.
    half = 9.0 / camera.focal_px
    world, p_WF = vertices(half)
    R_WC = so3.exp(rng.normal(0.0, 0.2, 3))
    p_WC = R_WC @ np.append(rng.normal(0.0, 0.2, 2), rng.uniform(-2.2, -1.5))
    light = Renderer(camera, world).render(R_WC, p_WC)
    xy = camera.project((p_WF - p_WC) @ R_WC)
    seen = camera.contains(xy, border_px=20.0)
    assert seen.sum() > 20
    for (x, y), p in zip(xy[seen], p_WF[seen], strict=True):
        left, top = round(x) - 11, round(y) - 11
        patch = light[top : top + 23, left : left + 23].astype(float)
        patch -= np.median(patch)
        rows, columns = np.mgrid[top : top + 23, left : left + 23]
        drawn = np.array([(patch * columns).sum(), (patch * rows).sum()]) / patch.sum()
        # Perspective moves the centre of the outline away from the vertex by some hundredths of a pixel.
        outline = camera.project((p + half * OUTLINE - p_WC) @ R_WC)
        assert np.linalg.norm(drawn - centroid(outline)) < 0.1


@pytest.mark.parametrize("camera", [EUROC, FISHEYE], ids=["radtan", "equidistant"])
@pytest.mark.parametrize("rolling", [False, True], ids=["still", "rolling"])
def test_every_pixel_sees_what_its_ray_hits(camera, rolling):
    """White boxes and pipes in fog, on a floor, some of them around the camera: as bright as Open3D's hits are far."""
    rng, fog_per_m = np.random.default_rng(5), 0.1
    builder = MeshBuilder()
    builder.quad(np.array([-20.0, -20.0, -1.0]), *(40.0 * np.eye(3)[:2]), 0, 1.0, np.zeros(2))
    for low in rng.uniform(-6.0, 5.0, (60, 3)):
        builder.box(low, low + rng.uniform(0.2, 1.5, 3), np.zeros(6, int), 1.0, np.zeros(2))
    for start in rng.uniform(-6.0, 6.0, (10, 3)):
        builder.tube(start, start + rng.uniform(-8.0, 8.0, 3), 0.1, 0, 1.0, np.zeros(2))
    mesh = builder.build()
    movers = draw_movers(3, np.zeros(1), np.zeros((1, 1, 3)), 1, rng)
    p_WM, R_WC, p_WC = rng.uniform(-3.0, 3.0, (3, 3)), so3.exp(rng.normal(0.0, 1.0, 3)), rng.normal(0.0, 0.1, 3)
    white = MeshWorld(mesh, (np.full((8, 8), 255, np.uint8),))
    height = camera.resolution[1]
    pose = (np.tile(R_WC, (height, 1, 1)), np.tile(p_WC, (height, 1))) if rolling else (R_WC, p_WC)
    light = Renderer(camera, white, movers, fog_per_m=fog_per_m).render(*pose, p_WM)

    rays_C = np.column_stack([camera.undistort(np.argwhere(light.T >= 0.0)), np.ones(light.size)])
    rays = np.column_stack([np.tile(p_WC, (light.size, 1)), rays_C @ R_WC.T]).astype(np.float32)
    scene = ray_scene(np.concatenate([mesh.corners, movers.corners(p_WM)]))
    hits = scene.cast_rays(open3d.core.Tensor.from_numpy(rays))
    normal_W, triangle = hits["primitive_normals"].numpy(), hits["primitive_ids"].numpy().reshape(light.T.shape).T
    facing = np.sign((normal_W * rays[:, 3:]).sum(axis=1))
    brightness = 1.0 - facing * (normal_W @ [0.22, 0.11, 0.20])
    clear = np.exp(-fog_per_m * hits["t_hit"].numpy() * np.linalg.norm(rays_C, axis=1))
    at_all = np.isfinite(hits["t_hit"].numpy())  # a lens may have no ray for a pixel
    expected = np.where(at_all, clear * brightness + 0.5 * (1.0 - clear), 0.5).reshape(light.T.shape).T

    # Where a pixel's neighbours see another triangle, it may be a mean over several.
    around = sliding_window_view(triangle, (3, 3)).reshape(light.shape[0] - 2, -1, 9)
    alone = (around == around[..., :1]).all(axis=-1)
    assert 0.6 < alone.mean() < 0.99
    np.testing.assert_allclose(light[1:-1, 1:-1][alone], expected[1:-1, 1:-1][alone], atol=1e-4)


def test_light_is_that_of_the_texture_and_of_the_surface():
    """Straight on, a white wall is as bright everywhere; what is beyond it is grey."""
    renderer = Renderer(SMALL, board())
    light = renderer.render(np.eye(3), np.array([0.0, 0.0, -1.0]))
    levels = np.unique(np.round(light[40:80, 60:120], 3))
    assert levels[-1] / levels[0] == pytest.approx(220 / 40, rel=0.02)
    away = renderer.render(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, -1.0]))
    assert np.ptp(away) == 0.0


def test_far_textures_do_not_alias():
    """A texture of stripes finer than a pixel is seen as its mean."""
    stripes = np.tile(np.array([[0, 255]], np.uint8), (64, 32))
    builder = MeshBuilder()
    builder.quad(np.array([-20.0, -20.0, 0.0]), *(40.0 * np.eye(3)[:2]), 0, 0.5, np.zeros(2))
    renderer = Renderer(SMALL, MeshWorld(builder.build(), (stripes,)))
    light = renderer.render(np.eye(3), np.array([0.0, 0.0, -8.0]))
    assert light[30:90, 50:140].std() < 0.01 * light[30:90, 50:140].mean()


def test_fog_and_contrast():
    camera, pose = SMALL, (np.eye(3), np.array([0.0, 0.0, -2.0]))
    centre = np.s_[50:70, 80:110]
    clear = Renderer(camera, board()).render(*pose)[centre]
    foggy = Renderer(camera, board(), fog_per_m=0.5).render(*pose)[centre]
    # Two metres of air that loses a factor e each: Koschmieder's law.
    assert np.ptp(foggy) / np.ptp(clear) == pytest.approx(np.exp(-1.0), rel=0.02)
    plain = Renderer(camera, board(), contrast=0.0).render(*pose)[centre]
    np.testing.assert_allclose(plain, clear, atol=1e-6)  # these textures have nothing but their means
    textured = procedural_textures(np.random.default_rng(0), 1)
    world = MeshWorld(board().mesh, (*textured, *textured))
    spread = [Renderer(camera, world, contrast=c).render(*pose)[centre].std() for c in (1.0, 0.25)]
    assert spread[1] / spread[0] == pytest.approx(0.25, rel=0.05)


def shots(count: int, instants: int = 1) -> list[Shot]:
    R = np.stack([so3.exp([0.0, 0.02 * k, 0.0]) for k in range(instants)])
    return [Shot(0, R, np.tile([0.0, 0.1 * k, -2.0], (instants, 1)), None, 1.0, (1, k)) for k in range(count)]


def test_the_number_of_threads_makes_no_difference():
    studio = Studio((SMALL,), board(), conditions=(Conditions(noise=0.6),))
    alone, together = (list(take_pictures(studio, shots(11), workers)) for workers in (1, 2))
    assert len(alone) == len(together) == 11
    assert all(np.array_equal(a, b) for a, b in zip(alone, together, strict=True))
    assert not np.array_equal(alone[0], alone[1])


def test_noise_is_as_strong_as_asked_and_gain_saturates():
    grey = np.full((8, 8), 110, np.uint8)
    studio = Studio((SMALL,), MeshWorld(board().mesh, (grey, grey)))
    (shot,) = shots(1)
    inside = np.s_[40:80, 60:130]
    clean = Photographer(studio).take(shot)[inside].astype(float)
    noisy = Photographer(replace(studio, conditions=(Conditions(noise=0.6),))).take(shot)[inside].astype(float)
    assert (noisy - clean).std() == pytest.approx(0.048 * 255, rel=0.1)
    assert abs((noisy - clean).mean()) < 1.0
    dark = Photographer(replace(studio, conditions=(Conditions(low_light=1.0),))).take(shot)[inside].astype(float)
    assert dark.mean() == pytest.approx(clean.mean(), abs=2.0)
    assert (dark - clean).std() > 8.0
    assert (Photographer(studio).take(replace(shot, gain=8.0))[inside] == 255).all()


def test_blur_is_the_mean_over_the_exposure():
    studio = Studio((SMALL,), board())
    sharp = [Photographer(studio).take(replace(s, R_WC=R[None], p_WC=s.p_WC[:1])) for s in shots(1, 4) for R in s.R_WC]
    (blurred,) = take_pictures(studio, shots(1, 4), 1)
    np.testing.assert_allclose(blurred, np.mean(sharp, axis=0), atol=1.0)


def test_a_rolling_shutter_sees_every_row_from_its_own_pose():
    camera = SMALL
    height = camera.resolution[1]
    studio = Studio((camera,), board())
    R_rows = so3.exp(np.column_stack([np.zeros(height), np.linspace(-0.1, 0.1, height), np.zeros(height)]))
    p_rows = np.tile([0.0, 0.0, -2.0], (height, 1))
    (rolled,) = take_pictures(studio, [Shot(0, R_rows[None], p_rows[None], None, 1.0, (0,))], 1)
    for row in (10, 60, 110):
        still = Photographer(studio).take(Shot(0, R_rows[row][None], p_rows[row][None], None, 1.0, (0,)))
        # But for where surfaces meet: which pixels those are depends on the rows beside it.
        assert np.mean(rolled[row] != still[row]) < 0.2
        assert not np.array_equal(rolled[row], Photographer(studio).take(shots(1)[0])[row]) or row == 60


def test_moving_boxes_hide_what_is_behind_them_and_keep_clear_of_the_flight():
    rng, t_s = np.random.default_rng(2), np.linspace(0.0, 10.0, 200)
    path = np.column_stack([np.sin(t_s), np.cos(t_s), np.zeros(200)])
    movers = draw_movers(8, t_s, path[None], 2, rng)
    assert movers.centre_W.shape == (8, 3)
    places = movers.at(t_s)
    assert np.linalg.norm(places - path[:, None], axis=2).min() > 1.2
    assert np.ptp(places, axis=0).max() > 1.0

    camera, world = SMALL, board()
    renderer = Renderer(camera, world, movers)
    pose = np.eye(3), np.array([0.0, 0.0, -2.0])
    empty = renderer.render(*pose)
    np.testing.assert_array_equal(empty, Renderer(camera, world).render(*pose))
    near, behind = np.full((8, 3), 50.0), np.full((8, 3), 50.0)
    near[0], behind[0] = (0.0, 0.0, -1.0), (0.0, 0.0, 3.0)
    assert np.mean(renderer.render(*pose, near) != empty) > 0.02
    np.testing.assert_array_equal(renderer.render(*pose, behind)[30:90, 50:140], empty[30:90, 50:140])


def test_textures_are_the_same_for_the_same_seed_and_have_detail_at_every_scale():
    first, again, other = (procedural_textures(np.random.default_rng(seed), 4) for seed in (5, 5, 6))
    for a, b, c in zip(first, again, other, strict=True):
        assert np.array_equal(a, b)
        assert not np.array_equal(a, c)
        for _ in range(5):
            assert len(cv2.goodFeaturesToTrack(a, 500, 0.02, 5)) > 20
            a = cv2.resize(a, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def test_ones_own_images_are_textures_without_a_seam(tmp_path):
    ramp = np.tile(np.linspace(0, 255, 300).astype(np.uint8), (200, 1))
    cv2.imwrite(str(tmp_path / "ramp.png"), ramp)
    (tmp_path / "notes.txt").write_text("no image")
    (tmp_path / "broken.jpg").write_bytes(b"no image either")
    (texture,) = images_as_textures(tmp_path, np.random.default_rng(0), 16)
    assert texture.shape == (SIZE, SIZE)
    assert np.abs(texture[:, 0].astype(int) - texture[:, -1]).max() <= 1
    (tmp_path / "ramp.png").unlink()
    with pytest.raises(ConfigError, match="no image that can be read"):
        images_as_textures(tmp_path, np.random.default_rng(0), 16)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"textures": (BLACK, np.zeros((8, 4), np.uint8))}, "square"),
        ({"textures": (BLACK, np.zeros((12, 12), np.uint8))}, "power of two"),
        ({"textures": (BLACK,)}, "texture 1 of 1"),
        ({"textures": ()}, "square"),
    ],
)
def test_a_world_that_cannot_be_drawn_is_refused(change, problem):
    with pytest.raises(ConfigError, match=problem):
        replace(board(), **change)
    mesh = board().mesh
    with pytest.raises(ConfigError, match="not finite"):
        MeshWorld(replace(mesh, corners=np.full_like(mesh.corners, np.nan)), (BLACK, WHITE))
    with pytest.raises(ConfigError, match="arrays"):
        MeshWorld(replace(mesh, uv=mesh.uv[:1]), (BLACK, WHITE))
