"""The filter's analytic Jacobians against numeric ones on the manifold."""

import numpy as np
import pytest

from vioframe.geometry import kernels, so3
from vioframe.geometry.cameras import Camera

measurement = pytest.importorskip("vioframe_msckf.measurement")

CAMERAS = {
    "radtan": Camera(458.654, 457.296, 367.215, 248.375, (-0.283, 0.0740, 0.00019, 1.76e-05), (752, 480), "radtan"),
    "equidistant": Camera(380.0, 379.0, 367.0, 248.0, (0.01, -0.02, 0.005, -0.001), (752, 480), "equidistant"),
}


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS.keys())
def test_observation_jacobian_is_the_derivative_on_the_manifold(camera):
    rng = np.random.default_rng(3)
    model, k = kernels.intrinsics_of(camera)
    R_BC, p_BC = so3.exp(rng.normal(size=3)), 0.1 * rng.normal(size=3)
    R_WB, p_WB = so3.exp(rng.normal(size=3)), rng.normal(size=3)
    p_WF = p_WB + R_WB @ (R_BC @ np.array([0.7, -0.4, 3.0]) + p_BC)

    def predicted(d):
        """Pixel after perturbing [theta_BC p_BC offset k(8) | theta_WB p_WB | p_WF] by d (24,)."""
        R_C, p_C = R_BC @ so3.exp(d[0:3]), p_BC + d[3:6]
        R_B, p_B = R_WB @ so3.exp(d[15:18]), p_WB + d[18:21]
        point = R_C.T @ (R_B.T @ (p_WF + d[21:24] - p_B) - p_C)
        perturbed = k + d[7:15]
        return Camera(*perturbed[:4], tuple(perturbed[4:]), camera.resolution, camera.model).project(point[None])[0]

    xy = predicted(np.zeros(24)) + np.array([0.3, -0.2])
    blocks, residual = measurement._observations(
        R_WB[None],
        p_WB[None],
        R_WB[None],
        p_WB[None],
        R_BC,
        p_BC,
        model,
        k,
        np.array([0]),
        p_WF[None],
        p_WF[None],
        xy[None],
    )
    eps = 1e-6
    numeric = np.stack([(predicted(eps * e) - predicted(-eps * e)) / (2 * eps) for e in np.eye(24)], axis=1)
    np.testing.assert_allclose(residual[0], [0.3, -0.2], atol=1e-9)
    np.testing.assert_allclose(blocks[0], numeric, rtol=1e-6, atol=1e-5)
