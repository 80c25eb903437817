"""Lives of tracks, against a wall and a path that are known."""

import numpy as np

from vioframe.evaluation.tracks import track_lives
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.types import FrameTracks

CAMERA = packaged_calibration("euroc", cameras=["cam0"]).cameras[0]
WALL_M = 4.0
PERIOD_NS = 50_000_000
# Two triangles across z = 4 m of a world in which the first camera looks along z.
WALL = np.array([[[-50, -50, WALL_M], [50, -50, WALL_M], [50, 50, WALL_M]]] * 2, float)
WALL[1, 1] = [-50, 50, WALL_M]


def path(count: int) -> Trajectory:
    k = np.arange(count)
    R_WC = np.array([so3.exp(np.array([0.01, -0.02, 0.015]) * n) for n in k])
    p_WC = k[:, None] * np.array([0.05, -0.02, 0.08])
    R_WB = R_WC @ CAMERA.R_BC.T
    return Trajectory(k * PERIOD_NS, R_WB, p_WC - R_WB @ CAMERA.p_BC)


def seen(truth: Trajectory, p_WF: np.ndarray, k: int, off_px: np.ndarray) -> FrameTracks:
    R_WC, p_WC = truth.R_WB[k] @ CAMERA.R_BC, truth.p_WB[k] + truth.R_WB[k] @ CAMERA.p_BC
    xy = CAMERA.model.project((p_WF - p_WC) @ R_WC) + off_px
    count = len(p_WF)
    return FrameTracks(k * PERIOD_NS, np.arange(count), np.zeros(count, np.int64), xy, CAMERA.model.undistort(xy))


def test_drift_is_the_distance_from_the_landmark_and_life_the_images_after_the_first():
    truth = path(9)
    p_WF = np.array([[0.5, 0.2, WALL_M], [-0.8, 0.6, WALL_M], [1.0, -0.7, WALL_M], [0.0, 0.0, WALL_M]])
    steps = []
    for k in range(9):
        off_px = np.zeros((4, 2))
        off_px[1] = np.array([0.3, 0.4]) * k  # slides off by half a pixel an image
        off_px[2] = 0.6, 0.8  # was never elsewhere: found there
        step = seen(truth, p_WF, k, off_px)
        steps.append(step.only(np.array([True, True, k < 4, k == 0])))
    lives = track_lives(steps, truth, CAMERA, WALL)
    np.testing.assert_array_equal(lives.images, [8, 8, 3, 0])
    np.testing.assert_allclose(lives.drift_px[0], 0.0, atol=1e-3)
    np.testing.assert_allclose(lives.drift_px[1], 0.5 * np.sqrt(np.mean(np.arange(1, 9) ** 2.0)), atol=1e-3)
    assert lives.drift_px[2] < 0.1
    assert np.isnan(lives.drift_px[3])


def test_what_was_found_where_there_is_no_surface_is_left_out():
    truth = path(2)
    far = np.array([[0.5, 0.2, WALL_M], [60.0, 0.0, WALL_M + 60.0]])
    steps = [seen(truth, far, k, np.zeros((2, 2))) for k in range(2)]
    half = WALL - np.array([49.0, 0.0, 0.0])  # ends a metre to the right
    assert len(track_lives(steps, truth, CAMERA, half).images) == 1
