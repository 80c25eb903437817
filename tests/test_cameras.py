"""Cameras against OpenCV, against numeric derivatives and against their own inverse; the compiled twins likewise."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from vioframe.errors import CalibrationError
from vioframe.geometry import kernels, so3
from vioframe.geometry.cameras import Camera, intrinsics_of

CAMERAS = {
    "radtan": Camera(458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05), (752, 480)),
    "equidistant": Camera(380.0, 379.0, 367.0, 248.0, (0.01, -0.02, 0.005, -0.001), (752, 480), "equidistant"),
}
CASES = pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())


def _pixels(camera: Camera) -> np.ndarray:
    width, height = camera.resolution
    return np.stack(np.meshgrid(np.arange(0, width, 25.0), np.arange(0, height, 25.0)), axis=-1).reshape(-1, 2)


@CASES
def test_undistort_inverts_distort_over_the_whole_image(camera):
    xy = _pixels(camera)
    np.testing.assert_allclose(camera.distort(camera.undistort(xy)), xy, atol=1e-8)


@CASES
def test_what_is_undistorted_lies_before_the_fold_of_the_distortion(camera):
    folded, eps = replace(camera, distortion=(-0.4, 0.0, 1e-3, -2e-3)), 1e-6
    xy = np.random.default_rng(0).uniform(-1.0, 2.0, (5000, 2)) * camera.resolution
    n = folded.undistort(xy)
    found = np.isfinite(n).all(axis=1)
    assert 100 < found.sum() < 4000
    np.testing.assert_allclose(folded.distort(n[found]), xy[found], atol=1e-8)
    J = np.stack([(folded.distort(n + eps * e) - folded.distort(n - eps * e)) / (2 * eps) for e in np.eye(2)], axis=-1)
    assert (np.linalg.det(J[found]) > 0.0).all()


@CASES
def test_projection_agrees_with_opencv(camera):
    rng = np.random.default_rng(0)
    p_C = rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 6.0], (100, 3))
    d, zero = np.array(camera.distortion), np.zeros(3)
    if camera.distortion_model == "radtan":
        expected, _ = cv2.projectPoints(p_C, zero, zero, camera.K, d)
    else:
        expected, _ = cv2.fisheye.projectPoints(p_C[:, None], zero, zero, camera.K, d)
    np.testing.assert_allclose(camera.project(p_C), expected.reshape(-1, 2), atol=1e-9)


@CASES
def test_in_a_smaller_image_points_are_in_the_pixels_that_theirs_went_into(camera):
    p_C = np.random.default_rng(1).uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 6.0], (100, 3))
    small = camera.shrunk(4)
    np.testing.assert_allclose(small.project(p_C) + 0.5, (camera.project(p_C) + 0.5) / 4, atol=1e-9)
    assert small.resolution == (camera.resolution[0] // 4, camera.resolution[1] // 4)


@CASES
def test_compiled_twins_agree(camera):
    (model, k), eps = intrinsics_of(camera), 1e-6
    n = camera.undistort(_pixels(camera))
    J = np.stack([(camera.distort(n + eps * e) - camera.distort(n - eps * e)) / (2 * eps) for e in np.eye(2)], axis=-1)
    for xy, n_i, J_i in zip(_pixels(camera), n, J, strict=True):
        drawn, drawn_J = kernels.distort(model, k, *n_i)
        np.testing.assert_allclose(drawn, xy, atol=1e-8)
        np.testing.assert_allclose(drawn_J, J_i, atol=1e-5)
        np.testing.assert_allclose(kernels.undistort(model, k, *xy, *(n_i + 0.01)), n_i, atol=1e-8)


@CASES
def test_compiled_intrinsics_jacobian_is_the_derivative(camera):
    model, k = intrinsics_of(camera)
    eps = 1e-6
    for n in camera.undistort(_pixels(camera))[::7]:

        def drawn(k, n=n):
            return np.array(kernels.distort(model, k, *n)[0])

        numeric = np.stack([(drawn(k + eps * e) - drawn(k - eps * e)) / (2 * eps) for e in np.eye(8)], axis=1)
        J = np.ones((2, 8))
        kernels.intrinsics_jacobian(model, k, *n, J)
        np.testing.assert_allclose(J, numeric, rtol=1e-6, atol=1e-5)


def test_compiled_rotations_agree():
    rng = np.random.default_rng(4)
    for phi in [*rng.normal(size=(20, 3)), *(1e-5 * rng.normal(size=(20, 3))), np.zeros(3)]:
        np.testing.assert_allclose(kernels.exp(phi), so3.exp(phi), atol=1e-12)
        np.testing.assert_allclose(kernels.right_jacobian(phi), so3.right_jacobian(phi), atol=1e-9)
        np.testing.assert_allclose(kernels.right_jacobian_inverse(phi), so3.right_jacobian_inverse(phi), atol=1e-9)
        np.testing.assert_allclose(kernels.hat(phi), so3.hat(phi))
    near_half_a_turn = [(np.pi - d) * axis for d in (0.0, 1e-9, 1e-3) for axis in so3.exp([0.3, -0.2, 0.9])]
    for phi in [*rng.normal(size=(20, 3)), *(1e-9 * rng.normal(size=(5, 3))), np.zeros(3), *near_half_a_turn]:
        np.testing.assert_allclose(so3.exp(kernels.log(so3.exp(phi))), so3.exp(phi), atol=1e-12)
        np.testing.assert_allclose(np.abs(kernels.log(so3.exp(phi))), np.abs(so3.log(so3.exp(phi))), atol=1e-12)


def test_points_beyond_the_fold_of_the_distortion_come_back_as_nan():
    # r (1 - 0.28 r^2) never exceeds 0.727: nothing is drawn 400 px from the centre.
    camera = Camera(458.0, 458.0, 367.0, 248.0, (-0.28, 0.0, 0.0, 0.0), (752, 480))
    undistorted = camera.undistort([[767.0, 248.0], [667.0, 248.0], [367.0, 248.0]])
    assert np.isnan(undistorted[0]).all()
    np.testing.assert_allclose(camera.distort(undistorted[1:]), [[667.0, 248.0], [367.0, 248.0]], atol=1e-9)


@pytest.mark.parametrize(
    "change", [{"fx": 0.0}, {"distortion": (0.1, 0.2)}, {"distortion": (np.nan, 0, 0, 0)}, {"distortion_model": "mei"}]
)
def test_impossible_cameras_are_refused(change):
    arguments = {"fx": 400.0, "fy": 400.0, "cx": 320.0, "cy": 240.0, "distortion": (0.0,) * 4, "resolution": (640, 480)}
    with pytest.raises(CalibrationError):
        Camera(**(arguments | change))
