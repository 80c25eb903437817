"""Group laws of SO(3) over random, near-identity and near-pi rotations."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from vioframe.geometry import so3


def _rotation_vectors() -> np.ndarray:
    rng = np.random.default_rng(1)
    axes = rng.normal(size=(300, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = np.concatenate(
        [rng.uniform(0, 3.1, 100), 10.0 ** rng.uniform(-12, -3, 100), np.pi - 10.0 ** rng.uniform(-9, -3, 100)]
    )
    return axes * angles[:, None]


PHI = _rotation_vectors()


def test_exp_is_the_matrix_exponential():
    np.testing.assert_allclose(so3.exp(PHI), np.stack([expm(so3.hat(p)) for p in PHI]), atol=1e-13)


def test_log_inverts_exp():
    np.testing.assert_allclose(so3.log(so3.exp(PHI)), PHI, atol=1e-12)


def test_log_at_exactly_pi_is_a_half_turn():
    for axis in np.eye(3):
        np.testing.assert_allclose(so3.exp(so3.log(so3.exp(np.pi * axis))), so3.exp(np.pi * axis), atol=1e-12)


def test_quaternions_agree_with_scipy():
    R = so3.exp(PHI)
    expected = Rotation.from_matrix(R).as_quat(canonical=True)
    quat = so3.to_quat_xyzw(R)
    flip = np.sign((quat * expected).sum(axis=1, keepdims=True))  # q and -q are one rotation
    np.testing.assert_allclose(quat * flip, expected, atol=1e-9)
    assert (quat[:, 3] >= 0.0).all()
    np.testing.assert_allclose(so3.from_quat_xyzw(3.0 * quat), R, atol=1e-12)


def test_hat_is_the_cross_product():
    a, b = PHI[:100], PHI[100:200]
    np.testing.assert_allclose((so3.hat(a) @ b[..., None])[..., 0], np.cross(a, b), atol=1e-15)


def test_right_jacobian_is_the_derivative_of_exp():
    eps = 1e-6
    for phi in PHI[::10]:
        numeric = np.stack(
            [
                so3.log(so3.exp(phi).T @ so3.exp(phi + eps * e)) - so3.log(so3.exp(phi).T @ so3.exp(phi - eps * e))
                for e in np.eye(3)
            ],
            axis=1,
        ) / (2 * eps)
        np.testing.assert_allclose(so3.right_jacobian(phi), numeric, atol=1e-8)


def test_right_jacobian_inverse_is_the_inverse():
    product = so3.right_jacobian(PHI) @ so3.right_jacobian_inverse(PHI)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-9)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1.0])
def test_interpolation_is_a_geodesic(fraction):
    R_0, R_1 = so3.exp(PHI[:50]), so3.exp(PHI[50:100])
    angle = np.linalg.norm(so3.log(np.swapaxes(R_0, 1, 2) @ R_1), axis=1)
    R = so3.interpolate(R_0, R_1, np.full(50, fraction))
    np.testing.assert_allclose(
        np.linalg.norm(so3.log(np.swapaxes(R_0, 1, 2) @ R), axis=1), fraction * angle, atol=1e-12
    )


def test_projection_returns_the_nearest_rotation():
    rng = np.random.default_rng(2)
    R = so3.exp(PHI[:20])
    noisy = R + 1e-3 * rng.normal(size=R.shape)
    nearest = so3.project(noisy)
    np.testing.assert_allclose(nearest @ np.swapaxes(nearest, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(nearest), 1.0)
    assert (np.linalg.norm(noisy - nearest, axis=(1, 2)) <= np.linalg.norm(noisy - R, axis=(1, 2))).all()
