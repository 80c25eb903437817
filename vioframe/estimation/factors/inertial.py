"""Pre-integrated readings as residuals between pairs of states, with Jacobians on the manifold; batched over the pairs.

Forster et al. (T-RO 2017), numbers in brackets. Shared by the initialisation and by sliding-window back-ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vioframe.arrays import Bool
from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.geometry.kernels import (
    exp,
    log,
    product,
    right_jacobian,
    right_jacobian_inverse,
    turned,
    turned_by,
    whiten,
)
from vioframe.jit import kernel
from vioframe.types import Float, Int, NavState, g_W

States = tuple[Float, Float, Float, Float, Float]
"""The arrays of :class:`StateArrays`, as kernels take them."""


@dataclass(frozen=True, slots=True)
class StateArrays:
    """K states side by side: ``R_WB`` (K, 3, 3), and ``p_WB``, ``v_WB``, ``bias_gyro_B``, ``bias_accel_B`` (K, 3)."""

    R_WB: Float
    p_WB: Float
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float

    @property
    def parts(self) -> States:
        return self.R_WB, self.p_WB, self.v_WB, self.bias_gyro_B, self.bias_accel_B

    @staticmethod
    def stack(states: Sequence[NavState]) -> StateArrays:
        return StateArrays(*(np.stack([getattr(s, name) for s in states]) for name in StateArrays.__slots__))

    def unstack(self, t_ns: Int) -> list[NavState]:
        """One by one again, with their stamps (K,)."""
        return [NavState(int(t), *state) for t, *state in zip(t_ns, *self.parts, strict=True)]

    def __len__(self) -> int:
        return len(self.R_WB)

    def __getitem__(self, part: slice) -> StateArrays:
        return StateArrays(*(values[part] for values in self.parts))

    def append(self, other: StateArrays) -> StateArrays:
        """These, then the ``other`` ones."""
        return StateArrays(*map(np.concatenate, zip(self.parts, other.parts, strict=True)))

    def with_those_of(self, other: StateArrays, where: Bool) -> StateArrays:
        """These, with the ``other`` ones in their place ``where`` (K,)."""
        rows = np.flatnonzero(where)
        out = StateArrays(*(values.copy() for values in self.parts))
        for values, others in zip(out.parts, other.parts, strict=True):
            values[rows] = others[rows]
        return out

    def turned(self, R: Float) -> StateArrays:
        """The same in a world turned by ``R`` (3, 3)."""
        return StateArrays(R @ self.R_WB, self.p_WB @ R.T, self.v_WB @ R.T, self.bias_gyro_B, self.bias_accel_B)

    def difference(self, other: StateArrays) -> Float:
        """(K, 15) by which :meth:`retract` moves the ``other`` ones here."""
        return difference(self.parts, other.parts)

    def retract(self, step: Float) -> StateArrays:
        """Moved by ``step`` (K, 15): rotations by right perturbation, the rest additively."""
        return StateArrays(*retract(self.parts, step))


class ImuFactors(NamedTuple):
    """K pre-integrated measurements, the k-th between the states i and j given for it.

    ``sqrt_information`` (K, 15, 15) whitens a residual: its squared norm is the Mahalanobis distance.
    """

    dt_s: Float
    dR: Float
    dp: Float
    dv: Float
    bias_gyro_B: Float
    bias_accel_B: Float
    bias_jacobian: Float
    sqrt_information: Float

    @staticmethod
    def stack(measurements: Sequence[Preintegrated]) -> ImuFactors:
        def stacked(name: str, *shape: int) -> Float:
            return np.array([getattr(m, name) for m in measurements]).reshape(-1, *shape)

        return ImuFactors(
            stacked("dt_s"),
            stacked("dR", 3, 3),
            stacked("dp", 3),
            stacked("dv", 3),
            stacked("bias_gyro_B", 3),
            stacked("bias_accel_B", 3),
            stacked("bias_jacobian", 9, 6),
            _whitening(stacked("cov", 15, 15)),
        )

    def residuals(self, i: StateArrays, j: StateArrays) -> Float:
        """(K, 15), [dtheta dp dv dbg dba] of state j beyond what state i and the readings predict [45]."""
        return self.linearise(i, j)[0]

    def linearise(self, i: StateArrays, j: StateArrays) -> tuple[Float, Float, Float]:
        """Residuals (K, 15) and their Jacobians (K, 15, 15) by the errors of states i and j [App. C]."""
        count = len(self.dt_s)
        r, J = np.empty((count, 15)), np.empty((count, 15, 30))
        for k in range(count):
            linearise_reading(self, k, i.parts, k, j.parts, k, r[k], J[k])
        return r, J[:, :, :15], J[:, :, 15:]


@kernel
def _whitening(cov: Float) -> Float:
    """(K, 15, 15) inverses of the Cholesky factors of covariances (K, 15, 15)."""
    out = np.zeros(cov.shape)
    for k in range(len(cov)):
        for i in range(15):
            out[k, i, i] = 1.0
        whiten(cov[k].copy(), out[k])
    return out


@kernel
def difference(states: States, others: States) -> Float:
    """(K, 15) by which :func:`retract` moves the ``others`` to ``states``."""
    count = len(states[0])
    out = np.empty((count, 15))
    for k in range(count):
        turn = log(product(others[0][k].T, states[0][k]))
        for m in range(3):
            out[k, m] = turn[m]
            out[k, 3 + m] = states[1][k, m] - others[1][k, m]
            out[k, 6 + m] = states[2][k, m] - others[2][k, m]
            out[k, 9 + m] = states[3][k, m] - others[3][k, m]
            out[k, 12 + m] = states[4][k, m] - others[4][k, m]
    return out


@kernel
def retract(states: States, step: Float) -> States:
    """``states`` moved by ``step`` (K, 15)."""
    p_WB, v_WB, bias_gyro_B, bias_accel_B = states[1].copy(), states[2].copy(), states[3].copy(), states[4].copy()
    for k in range(len(step)):
        for m in range(3):
            p_WB[k, m] += step[k, 3 + m]
            v_WB[k, m] += step[k, 6 + m]
            bias_gyro_B[k, m] += step[k, 9 + m]
            bias_accel_B[k, m] += step[k, 12 + m]
    return turned_by(states[0], step[:, 0:3]), p_WB, v_WB, bias_gyro_B, bias_accel_B


@kernel
def linearise_reading(
    factors: ImuFactors, k: int, states_i: States, i: int, states_j: States, j: int, r: Float, J: Float
) -> None:
    """``r`` (15,) of the k-th factor between two states, and ``J`` (15, 30) by the errors of both, neither whitened."""
    T, by_bias = factors.dt_s[k], factors.bias_jacobian[k]
    R_WBi, R_BiW = states_i[0][i], states_i[0][i].T
    p, v, change = np.empty(3), np.empty(3), np.empty(6)
    for m in range(3):
        v_W = states_i[2][i, m]
        p[m] = states_j[1][j, m] - states_i[1][i, m] - v_W * T - 0.5 * g_W[m] * T * T
        v[m] = states_j[2][j, m] - v_W - g_W[m] * T
        change[m] = states_i[3][i, m] - factors.bias_gyro_B[k, m]
        change[3 + m] = states_i[4][i, m] - factors.bias_accel_B[k, m]
        r[9 + m] = states_j[3][j, m] - states_i[3][i, m]
        r[12 + m] = states_j[4][j, m] - states_i[4][i, m]
    correction = np.zeros(9)
    for m in range(9):
        for n in range(6):
            correction[m] += by_bias[m, n] * change[n]
    R_BjBi = product(states_j[0][j].T, R_WBi)
    dR = product(factors.dR[k], exp(correction[0:3]))
    phi = log(product(dR.T, R_BjBi.T))
    p_i, v_i = turned(R_BiW, p), turned(R_BiW, v)  # relative position and velocity in Bi, free of gravity
    for m in range(3):
        r[m] = phi[m]
        r[3 + m] = p_i[m] - factors.dp[k, m] - correction[3 + m]
        r[6 + m] = v_i[m] - factors.dv[k, m] - correction[6 + m]

    Jr_inv = right_jacobian_inverse(phi)
    by_theta = product(Jr_inv, R_BjBi)
    by_gyro = product(product(Jr_inv, exp(-phi)), product(right_jacobian(correction[0:3]), by_bias[0:3, 0:3]))
    J[:] = 0.0
    for m in range(3):
        n1, n2 = (m + 1) % 3, (m + 2) % 3
        # The skew matrices of p_i and v_i.
        J[3 + m, n1], J[3 + m, n2] = -p_i[n2], p_i[n1]
        J[6 + m, n1], J[6 + m, n2] = -v_i[n2], v_i[n1]
        for n in range(3):
            J[m, n], J[m, 15 + n], J[m, 9 + n] = -by_theta[m, n], Jr_inv[m, n], -by_gyro[m, n]
            J[3 + m, 3 + n], J[3 + m, 18 + n] = -R_BiW[m, n], R_BiW[m, n]
            J[3 + m, 6 + n] = -T * R_BiW[m, n]
            J[6 + m, 6 + n], J[6 + m, 21 + n] = -R_BiW[m, n], R_BiW[m, n]
        for n in range(6):
            J[3 + m, 9 + n], J[6 + m, 9 + n] = -by_bias[3 + m, n], -by_bias[6 + m, n]
    for m in range(9, 15):
        J[m, m], J[m, 15 + m] = -1.0, 1.0
