"""Strap-down integration of an inertial segment, with the error-state transition and process noise that filters need.

Between two readings the angular rate and specific force are taken as linear in time. The rotation is the fourth-order
Magnus expansion of that motion, velocity and position are Simpson's rule on it, so that the integration error is far
below the noise even at 100 Hz. Derivation: ``docs/derivations/propagation.md``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.estimation.inertial.error_transition import move, move_covariance
from vioframe.geometry.kernels import cross, exp, hat, product, right_jacobian, turned
from vioframe.jit import kernel
from vioframe.types import Float, ImuNoise, ImuSegment, g_W


@dataclass(frozen=True, slots=True)
class Propagation:
    """Where a segment leads: the pose and velocity at its end, and how errors at its start get there.

    ``transition`` (15, 15) and ``noise`` (15, 15) are over [dtheta dp dv dbg dba] with right perturbation.
    """

    R_WB: Float
    p_WB: Float
    v_WB: Float
    transition: Float
    noise: Float


def propagate(
    imu: ImuSegment, R_WB: Float, p_WB: Float, v_WB: Float, bias_gyro_B: Float, bias_accel_B: Float, noise: ImuNoise
) -> Propagation:
    """Integrate ``imu`` from the given state, (3, 3) and (3,) arrays, under gravity ``g_W``.

    ``noise`` gives continuous-time densities; they become process noise over each interval between readings.
    """
    densities = np.array([noise.gyro_density, noise.accel_density, noise.gyro_walk, noise.accel_walk])
    R, p, v, Phi, Q = _integrate(
        imu.dt, imu.gyro_B - bias_gyro_B, imu.accel_B - bias_accel_B, R_WB, p_WB, v_WB, g_W, densities**2
    )
    return Propagation(R, p, v, Phi, Q)


def yaw_consistent_transition(
    transition: Float, start: tuple[Float, Float, Float], end: tuple[Float, Float, Float], dt: float
) -> Float:
    """``transition`` with its orientation columns evaluated at the given (R_WB, p_WB, v_WB) of start and end.

    First-estimate Jacobians (Huang, Mourikis, Roumeliotis 2010) evaluate them at the *propagated* states of both ends,
    so that a rotation about gravity stays in the null space: Phi N(start) = N(end).
    """
    R_0, p_0, v_0 = start
    R_1, p_1, v_1 = end
    out = transition.copy()
    out[0:3, 0:3] = R_1.T @ R_0
    out[3:6, 0:3] = -hat(p_1 - p_0 - v_0 * dt - 0.5 * g_W * dt * dt) @ R_0
    out[6:9, 0:3] = -hat(v_1 - v_0 - g_W * dt) @ R_0
    return out


@kernel
def _integrate(
    dt: Float, gyro: Float, accel: Float, R: Float, p: Float, v: Float, g: Float, variance: Float
) -> tuple[Float, Float, Float, Float, Float]:
    """Readings already free of bias; ``variance`` (4,) = squared densities of gyro, accel, gyro walk, accel walk."""
    R, p, v = R.copy(), p.copy(), v.copy()
    Phi = np.eye(15)
    Q = np.zeros((15, 15))
    by_theta, by_biases = np.zeros((6, 3)), np.zeros((9, 6))
    for i in range(len(dt)):
        h = dt[i]
        w_0, w_1 = gyro[i], gyro[i + 1]
        a_0, a_1 = accel[i], accel[i + 1]
        w_m, a_m = 0.5 * (w_0 + w_1), 0.5 * (a_0 + a_1)
        # Magnus expansion to fourth order for a rate linear in time: over the first half, and over the whole interval.
        phi_half = 0.25 * h * (w_0 + w_m) + (h * h / 48.0) * cross(w_0, w_m)
        phi = h * w_m + (h * h / 12.0) * cross(w_0, w_1)
        R_half = product(R, exp(phi_half))
        dR = exp(phi)
        R_next = product(R, dR)
        f_0, f_m, f_1 = turned(R, a_0), turned(R_half, a_m), turned(R_next, a_1)
        dv = (h / 6.0) * (f_0 + 4.0 * f_m + f_1)
        dp = (h * h / 6.0) * (f_0 + 2.0 * f_m)

        # Error transition over the interval, with the errors of the biases constant in it.
        cross_dp, cross_dv = product(hat(dp), R), product(hat(dv), R)
        force, J_r = product(R_half, hat(a_m)), right_jacobian(phi)
        for m in range(3):
            for n in range(3):
                by_theta[m, n], by_theta[3 + m, n] = -cross_dp[m, n], -cross_dv[m, n]
                by_biases[m, n] = -h * J_r[m, n]
                by_biases[3 + m, n], by_biases[6 + m, n] = (h**3 / 6.0) * force[m, n], (h**2 / 2.0) * force[m, n]
                by_biases[3 + m, 3 + n] = -(h**2 / 2.0) * R_half[m, n]
                by_biases[6 + m, 3 + n] = -h * R_half[m, n]
        move(dR, by_theta, by_biases, h, Phi)
        move_covariance(dR, by_theta, by_biases, h, Q)
        for k in range(3):
            Q[k, k] += variance[0] * h
            Q[3 + k, 3 + k] += variance[1] * h**3 / 3.0
            Q[3 + k, 6 + k] += variance[1] * h**2 / 2.0
            Q[6 + k, 3 + k] += variance[1] * h**2 / 2.0
            Q[6 + k, 6 + k] += variance[1] * h
            Q[9 + k, 9 + k] += variance[2] * h
            Q[12 + k, 12 + k] += variance[3] * h

        p += v * h + dp + 0.5 * g * h * h
        v += dv + g * h
        R = R_next
    return R, p, v, Phi, Q
