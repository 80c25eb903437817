"""Scale, velocity, gravity and the accelerometer's bias, in closed form: the camera's path held against the readings.

With known rotations the readings give the path as a linear function of the first velocity, gravity and the bias; images
give it up to scale. Gravity's magnitude is known, and decides much where the motion is gentle (Dong-Si, Mourikis,
"Estimator Initialization in Vision-aided Inertial Navigation with Unknown Camera-IMU Calibration", IROS 2012).
Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.types import GRAVITY_M_S2, Calibration, Float

# What the path from images and the doubly integrated readings may differ by.
_POSITION_SIGMA_M = 0.01


@dataclass(frozen=True, slots=True)
class Alignment:
    """The motion in the first body frame B0: ``R_B0B`` (K, 3, 3), ``p_B0B`` (K, 3) m, ``v_B0B`` (K, 3) m/s.

    ``g_B0`` (3,) has the norm of gravity; ``scale`` is metres per unit of the path that was aligned, and may come out
    negative where the readings contradict it.
    """

    R_B0B: Float
    p_B0B: Float
    v_B0B: Float
    g_B0: Float
    bias_accel_B: Float
    scale: float


def rotations(imu: Sequence[Preintegrated]) -> Float:
    """R_B0B (K, 3, 3) of every keyframe from the K - 1 measurements between them."""
    R = [np.eye(3)]
    for m in imu:
        R.append(R[-1] @ m.dR)
    return np.stack(R)


def align(camera: Float, imu: Sequence[Preintegrated], calibration: Calibration, bias_sigma: float) -> Alignment:
    """``camera`` (K, 3) positions from the first camera in the axes of B0, in any unit; ``bias_sigma`` prior, m/s^2."""
    R = rotations(imu)
    t, p_imu, v_imu, p_by_bias, v_by_bias = _cumulate(imu, R)
    arm = R @ calibration.cameras[0].p_BC
    # scale camera_k = v t + g t^2 / 2 + p_imu + p_by_bias bias + arm_k - arm_0, unknown x = [v g bias scale].
    eye = np.eye(3)
    A = np.concatenate(
        [t[:, None, None] * eye, 0.5 * t[:, None, None] ** 2 * eye, p_by_bias, -camera[:, :, None]], axis=2
    ).reshape(-1, 10)
    b = -(p_imu + arm - arm[0]).ravel()
    H, s = A.T @ A, A.T @ b
    H[6:9, 6:9] += eye * (_POSITION_SIGMA_M / bias_sigma) ** 2
    x = _solve_on_gravity_sphere(H, s)
    v_0, g, bias = x[:3], x[3:6], x[6:9]
    p = v_0 * t[:, None] + 0.5 * g * t[:, None] ** 2 + p_imu + p_by_bias @ bias
    v = v_0 + g * t[:, None] + v_imu + v_by_bias @ bias
    return Alignment(R, p, v, g, bias, float(x[9]))


def _cumulate(imu: Sequence[Preintegrated], R: Float) -> tuple[Float, Float, Float, Float, Float]:
    """From the first frame to each: time, gravity-free position and velocity, and what the bias adds to both."""
    t, p, v = [0.0], [np.zeros(3)], [np.zeros(3)]
    p_b, v_b = [np.zeros((3, 3))], [np.zeros((3, 3))]
    for m, R_k in zip(imu, R[:-1], strict=True):
        t.append(t[-1] + m.dt_s)
        p.append(p[-1] + v[-1] * m.dt_s + R_k @ m.dp)
        v.append(v[-1] + R_k @ m.dv)
        p_b.append(p_b[-1] + v_b[-1] * m.dt_s + R_k @ m.bias_jacobian[3:6, 3:])
        v_b.append(v_b[-1] + R_k @ m.bias_jacobian[6:9, 3:])
    return np.array(t), np.stack(p), np.stack(v), np.stack(p_b), np.stack(v_b)


def _solve_on_gravity_sphere(H: Float, s: Float) -> Float:
    """argmin x' H x - 2 s' x over x (N,) with |x[3:6]| = g: the others eliminated, then a secular equation.

    The minimiser on a sphere solves (S + lambda I) g = r for the one lambda above minus the least eigenvalue of S at
    which the norm is right (Golub, Van Loan, "Matrix Computations", 4th ed., 6.2.1). The norm falls with lambda there,
    so that bisection finds it.
    """
    others = np.delete(np.arange(len(s)), np.s_[3:6])
    inner = np.linalg.solve(H[np.ix_(others, others)], np.column_stack([s[others], H[others, 3:6]]))
    S = H[3:6, 3:6] - H[3:6, others] @ inner[:, 1:]
    r = s[3:6] - H[3:6, others] @ inner[:, 0]
    eigenvalues, U = np.linalg.eigh(S)
    r_u = U.T @ r
    low = -eigenvalues[0]
    high = low + np.linalg.norm(r) / GRAVITY_M_S2
    for _ in range(100):
        middle = 0.5 * (low + high)
        too_long = np.linalg.norm(r_u / (eigenvalues + middle)) > GRAVITY_M_S2
        low, high = (middle, high) if too_long else (low, middle)
    g = U @ (r_u / (eigenvalues + high))
    x = np.empty(len(s))
    x[3:6] = g * (GRAVITY_M_S2 / np.linalg.norm(g))
    x[others] = inner[:, 0] - inner[:, 1:] @ x[3:6]
    return x
