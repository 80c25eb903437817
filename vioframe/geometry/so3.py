"""The rotation group SO(3): batched over leading axes, safe near the identity and near pi.

Perturbations act on the right, ``R <- R Exp(dtheta)``. Formulas follow Solà, Deray, Atchuthan, "A micro Lie theory for
state estimation in robotics" (2018), equation numbers in brackets.
"""

from itertools import permutations, product

import numpy as np
from numpy.typing import ArrayLike

from vioframe.arrays import Float

# Below this angle the Taylor series, cut after two terms, is exact to double precision.
_SMALL = 1e-4


def hat(phi: ArrayLike) -> Float:
    """(..., 3) -> (..., 3, 3), the skew matrix with ``hat(a) @ b == cross(a, b)``."""
    phi = np.asarray(phi, dtype=np.float64)
    out = np.zeros((*phi.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -phi[..., 2], phi[..., 1], -phi[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = phi[..., 2], -phi[..., 1], phi[..., 0]
    return out


def _coefficients(angle: Float) -> tuple[Float, Float, Float]:
    """sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3, by series where a is small."""
    small = angle < _SMALL
    a = np.where(small, 1.0, angle)
    a2 = angle * angle
    sinc = np.where(small, 1.0 - a2 / 6.0, np.sin(a) / a)
    cosc = np.where(small, 0.5 - a2 / 24.0, (1.0 - np.cos(a)) / a**2)
    sinc3 = np.where(small, 1.0 / 6.0 - a2 / 120.0, (a - np.sin(a)) / a**3)
    return sinc, cosc, sinc3


def exp(phi: ArrayLike) -> Float:
    """(..., 3) rad -> (..., 3, 3), Rodrigues' formula [132]."""
    phi = np.asarray(phi, dtype=np.float64)
    sinc, cosc, _ = _coefficients(np.linalg.norm(phi, axis=-1))
    K = hat(phi)
    out: Float = np.eye(3) + sinc[..., None, None] * K + cosc[..., None, None] * (K @ K)
    return out


def log(R: ArrayLike) -> Float:
    """(..., 3, 3) -> (..., 3) rad with norm <= pi [133]; through the quaternion, which keeps it exact near pi."""
    quat = to_quat_xyzw(R)
    vector, w = quat[..., :3], quat[..., 3]
    norm = np.linalg.norm(vector, axis=-1)
    small = norm < _SMALL
    # 2 atan2(n, w) / n, which tends to 2 + n^2 / 3.
    scale = np.where(small, 2.0 + norm**2 / 3.0, 2.0 * np.arctan2(norm, w) / np.where(small, 1.0, norm))
    out: Float = scale[..., None] * vector
    return out


def right_jacobian(phi: ArrayLike) -> Float:
    """J_r with ``Exp(phi + d) ~ Exp(phi) Exp(J_r(phi) d)`` [143], (..., 3, 3)."""
    phi = np.asarray(phi, dtype=np.float64)
    _, cosc, sinc3 = _coefficients(np.linalg.norm(phi, axis=-1))
    K = hat(phi)
    out: Float = np.eye(3) - cosc[..., None, None] * K + sinc3[..., None, None] * (K @ K)
    return out


def right_jacobian_inverse(phi: ArrayLike) -> Float:
    """J_r^-1 with ``Log(Exp(phi) Exp(d)) ~ phi + J_r^-1(phi) d`` [144], (..., 3, 3)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = np.linalg.norm(phi, axis=-1)
    small = angle < _SMALL
    a = np.where(small, 1.0, angle)
    half = 0.5 * a
    c = np.where(small, 1.0 / 12.0 + angle**2 / 720.0, (1.0 - half * np.cos(half) / np.sin(half)) / a**2)
    K = hat(phi)
    out: Float = np.eye(3) + 0.5 * K + c[..., None, None] * (K @ K)
    return out


def _quaternion_products() -> Float:
    """(9, 16) by which the entries of R, row by row, become 4 q q' - I, in the order x y z w."""
    P = np.zeros((3, 3, 4, 4))
    for i in range(3):
        P[i, i] = np.diag([-1.0, -1.0, -1.0, 1.0])
        P[i, i, i, i] = 1.0
        k, n = (i + 1) % 3, (i + 2) % 3
        P[k, n, k, n] = P[k, n, n, k] = P[n, k, k, n] = P[n, k, n, k] = 1.0
        P[n, k, i, 3] = P[n, k, 3, i] = 1.0
        P[k, n, i, 3] = P[k, n, 3, i] = -1.0
    return P.reshape(9, 16)


_PRODUCTS = _quaternion_products()


def to_quat_xyzw(R: ArrayLike) -> Float:
    """(..., 3, 3) -> (..., 4), Hamilton, unit norm, w >= 0 (Shepperd's method: the largest component is divided by)."""
    R = np.asarray(R, dtype=np.float64)
    Q = (R.reshape(-1, 9) @ _PRODUCTS).reshape(-1, 4, 4) + np.eye(4)
    # Each row is proportional to q, that of the largest diagonal entry most exactly.
    best = Q.reshape(-1, 16)[:, ::5].argmax(axis=1)
    quat = Q[np.arange(len(Q)), best]
    quat /= np.copysign(np.linalg.norm(quat, axis=1), quat[:, 3])[:, None]
    out: Float = quat.reshape(*R.shape[:-2], 4)
    return out


def from_quat_xyzw(quat: ArrayLike) -> Float:
    """(..., 4) Hamilton quaternions of any norm but zero -> (..., 3, 3)."""
    quat = np.asarray(quat, dtype=np.float64)
    q = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    K = hat(q[..., :3])
    out: Float = np.eye(3) + 2.0 * (q[..., 3, None, None] * K + K @ K)
    return out


def interpolate(R_0: ArrayLike, R_1: ArrayLike, fraction: ArrayLike) -> Float:
    """Geodesic from ``R_0`` (fraction 0) to ``R_1`` (fraction 1), (..., 3, 3)."""
    R_0 = np.asarray(R_0, dtype=np.float64)
    phi = log(np.swapaxes(R_0, -1, -2) @ np.asarray(R_1, dtype=np.float64))
    out: Float = R_0 @ exp(np.asarray(fraction, dtype=np.float64)[..., None] * phi)
    return out


def signed_permutations(determinant: int) -> Float:
    """(24, 3, 3): all rotations (1), or all rotoreflections (-1), that map axes to axes."""
    out = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        D = np.eye(3)[list(order)] * np.array(signs)[:, None]
        if round(float(np.linalg.det(D))) == determinant:
            out.append(D)
    return np.array(out)


def project(M: ArrayLike) -> Float:
    """The rotation nearest to ``M`` (..., 3, 3) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    U[..., :, 2] *= np.linalg.det(U @ Vt)[..., None]
    out: Float = U @ Vt
    return out


def yaw_of(R: Float) -> Float:
    """The angle (...,) rad about z of the z-rotation nearest to ``R`` (..., 3, 3): its twist in R = R_z(yaw) swing."""
    return np.asarray(np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1]))


def rotation_z(yaw: ArrayLike) -> Float:
    """(...,) rad -> (..., 3, 3), about z."""
    out = np.zeros((*np.shape(yaw), 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(yaw)
    out[..., 1, 0], out[..., 0, 1] = np.sin(yaw), -np.sin(yaw)
    out[..., 2, 2] = 1.0
    return out


def level_rotation(up_B: Float) -> Float:
    """R_WB (3, 3) of the body whose vertical is ``up_B`` (3,), any norm: the smallest rotation that puts it upright.

    It has no part about the vertical (its twist is zero), which is what yaw zero means here. An Euler yaw would not do:
    EuRoC's IMU flies with its x axis up, where Euler angles are singular.
    """
    up = up_B / np.linalg.norm(up_B)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine, cosine = np.linalg.norm(axis), up[2]
    if sine < 1e-12:
        return np.eye(3) if cosine > 0.0 else exp([np.pi, 0.0, 0.0])
    return exp(axis / sine * np.arctan2(sine, cosine))
