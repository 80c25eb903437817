"""Pre-integration: an inertial segment reduced to one relative motion that does not depend on where it began.

Midpoint rule on the manifold, after Forster, Carlone, Dellaert, Scaramuzza, "On-Manifold Preintegration for Real-Time
Visual-Inertial Odometry" (T-RO 2017), numbers in brackets, and Qin, Li, Shen, "VINS-Mono" (T-RO 2018). The covariance
includes the biases' walk and its correlation with the motion. Derivation: ``docs/derivations/preintegration.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.estimation.inertial.error_transition import add_white, move, move_covariance
from vioframe.geometry import so3
from vioframe.geometry.kernels import exp, hat, product, right_jacobian, turned
from vioframe.jit import kernel
from vioframe.types import DP, DTHETA, DV, Float, ImuNoise, ImuSegment, NavState, g_W

EXACT: Float = np.zeros(9)
"""(9,) standard deviations of a motion that begins just at its first state."""


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Relative motion over ``dt_s`` seconds, gravity left out, at the biases it was integrated with.

    ``dR`` (3, 3) = R_BiBj; ``dp`` (3,) m and ``dv`` (3,) m/s in the first body frame [33]. ``cov`` (15, 15) covers
    [dtheta dp dv dbg dba] of the second state given the first, with right perturbation of ``dR``; its bias blocks are
    the walk. ``bias_jacobian`` (9, 6) is d [dtheta dp dv] / d [bias_gyro bias_accel] [44]. ``sigma_first`` (9,) are the
    standard deviations of [dtheta dp dv] of where the motion began, given the first state.
    """

    dt_s: float
    dR: Float
    dp: Float
    dv: Float
    cov: Float
    bias_jacobian: Float
    bias_gyro_B: Float
    bias_accel_B: Float
    imu: ImuSegment
    noise: ImuNoise
    sigma_first: Float

    def corrected(self, bias_gyro_B: Float, bias_accel_B: Float) -> tuple[Float, Float, Float]:
        """``dR``, ``dp``, ``dv`` at other biases, to first order [44]; good for changes of a few 0.01 rad/s."""
        change = np.concatenate([bias_gyro_B - self.bias_gyro_B, bias_accel_B - self.bias_accel_B])
        d = self.bias_jacobian @ change
        return self.dR @ so3.exp(d[DTHETA]), self.dp + d[DP], self.dv + d[DV]

    def repropagated(self, bias_gyro_B: Float, bias_accel_B: Float) -> Preintegrated:
        """The same readings integrated anew at other biases, for changes too large for :meth:`corrected`."""
        return preintegrate(self.imu, bias_gyro_B, bias_accel_B, self.noise, self.sigma_first)

    def predict(self, state: NavState) -> NavState:
        """Where ``state`` leads, with its biases; with covariance if it has one."""
        dR, dp, dv = self.corrected(state.bias_gyro_B, state.bias_accel_B)
        T = self.dt_s
        cov = None if state.cov is None else self._propagated(state.R_WB, dR, dp, dv, state.cov)
        return NavState(
            int(self.imu.t_ns[-1]),
            state.R_WB @ dR,
            state.p_WB + state.v_WB * T + 0.5 * g_W * T * T + state.R_WB @ dp,
            state.v_WB + g_W * T + state.R_WB @ dv,
            state.bias_gyro_B,
            state.bias_accel_B,
            cov,
        )

    def _propagated(self, R_WB: Float, dR: Float, dp: Float, dv: Float, cov: Float) -> Float:
        """``cov`` (15, 15) of the first state, moved to the second one, with the noise of the readings."""
        F, G = np.eye(15), np.eye(15)
        F[DTHETA, DTHETA] = dR.T
        F[DP, DTHETA], F[DV, DTHETA] = -R_WB @ so3.hat(dp), -R_WB @ so3.hat(dv)
        F[DP, DV] = self.dt_s * np.eye(3)
        F[0:9, 9:15] = self.bias_jacobian
        G[DP, DP] = G[DV, DV] = R_WB  # the measurement's errors are in the first body frame
        F[DP, 9:15], F[DV, 9:15] = R_WB @ F[DP, 9:15], R_WB @ F[DV, 9:15]
        out = F @ cov @ F.T + G @ self.cov @ G.T
        return 0.5 * (out + out.T)


def preintegrate(
    imu: ImuSegment, bias_gyro_B: Float, bias_accel_B: Float, noise: ImuNoise, sigma_first: Float = EXACT
) -> Preintegrated:
    """Integrate ``imu`` at the biases (3,) rad/s and (3,) m/s^2; ``noise`` gives continuous-time densities.

    ``sigma_first`` is that of :class:`Preintegrated`.
    """
    variance = np.square([noise.gyro_density, noise.accel_density, noise.gyro_walk, noise.accel_walk])
    gyro, accel = imu.gyro_B - bias_gyro_B, imu.accel_B - bias_accel_B
    dR, dp, dv, cov, bias_jacobian = _integrate(imu.dt, gyro, accel, variance, sigma_first)
    biases = bias_gyro_B.copy(), bias_accel_B.copy()
    return Preintegrated(imu.duration_s, dR, dp, dv, cov, bias_jacobian, *biases, imu, noise, sigma_first)


def join_segments(segments: Sequence[ImuSegment]) -> ImuSegment:
    """Consecutive segments as one: the reading at each border, which both sides hold, is kept once."""
    first, *rest = segments
    if not rest:
        return first
    return ImuSegment(
        np.concatenate([first.t_ns, *(s.t_ns[1:] for s in rest)]),
        np.concatenate([first.gyro_B, *(s.gyro_B[1:] for s in rest)]),
        np.concatenate([first.accel_B, *(s.accel_B[1:] for s in rest)]),
        max(s.largest_gap_s for s in segments),
    )


@kernel
def _integrate(
    dt: Float, gyro: Float, accel: Float, variance: Float, sigma_first: Float
) -> tuple[Float, Float, Float, Float, Float]:
    """Readings free of bias (N, 3); ``variance`` (4,) = squared densities of gyro, accel, gyro walk, accel walk.

    White noise averaged over an interval of h seconds has the variance density^2 / h. Taking the two readings of an
    interval as independent of those of the next would halve it, because neighbours share a reading.
    """
    R, p, v = np.eye(3), np.zeros(3), np.zeros(3)
    cov, bias_jacobian = np.zeros((15, 15)), np.zeros((15, 6))
    for k in range(6):
        bias_jacobian[9 + k, k] = 1.0
    for k in range(9):
        cov[k, k] = sigma_first[k] * sigma_first[k]
    by_theta, by_biases = np.zeros((6, 3)), np.zeros((9, 6))
    for i in range(len(dt)):
        h = dt[i]
        a_0, a_1 = accel[i], accel[i + 1]
        phi = 0.5 * h * (gyro[i] + gyro[i + 1])
        dR = exp(phi)
        R_next = product(R, dR)
        a = 0.5 * (turned(R, a_0) + turned(R_next, a_1))

        # Errors at the end of the interval by those at its start [A.9], with the midpoint's two rotations.
        theta_by_gyro = -h * right_jacobian(phi)
        a_by_theta_next = -0.5 * product(R_next, hat(a_1))
        a_by_theta = -0.5 * product(R, hat(a_0)) + product(a_by_theta_next, dR.T)
        a_by_gyro = product(a_by_theta_next, theta_by_gyro)
        a_by_accel = -0.5 * (R + R_next)
        for m in range(3):
            for n in range(3):
                by_theta[m, n], by_theta[3 + m, n] = 0.5 * h * h * a_by_theta[m, n], h * a_by_theta[m, n]
                by_biases[m, n] = theta_by_gyro[m, n]
                by_biases[3 + m, n], by_biases[6 + m, n] = 0.5 * h * h * a_by_gyro[m, n], h * a_by_gyro[m, n]
                by_biases[3 + m, 3 + n] = 0.5 * h * h * a_by_accel[m, n]
                by_biases[6 + m, 3 + n] = h * a_by_accel[m, n]

        move(dR, by_theta, by_biases, h, bias_jacobian)
        move_covariance(dR, by_theta, by_biases, h, cov)
        add_white(by_biases[:, 0:3], variance[0] / h, cov)
        add_white(by_biases[:, 3:6], variance[1] / h, cov)
        for k in range(3):
            cov[9 + k, 9 + k] += variance[2] * h
            cov[12 + k, 12 + k] += variance[3] * h

        p = p + v * h + 0.5 * h * h * a
        v = v + h * a
        R = R_next
    return R, p, v, 0.5 * (cov + cov.T), bias_jacobian[:9]
