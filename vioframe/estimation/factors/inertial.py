"""Pre-integrated readings as residuals between pairs of states, with Jacobians on the manifold; batched over the pairs.

Forster et al. (T-RO 2017), numbers in brackets. Shared by the initialisation and by sliding-window back-ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.arrays import Bool
from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, DV, Float, Int, NavState, g_W


@dataclass(frozen=True, slots=True)
class StateArrays:
    """K states side by side: ``R_WB`` (K, 3, 3), and ``p_WB``, ``v_WB``, ``bias_gyro_B``, ``bias_accel_B`` (K, 3)."""

    R_WB: Float
    p_WB: Float
    v_WB: Float
    bias_gyro_B: Float
    bias_accel_B: Float

    @property
    def parts(self) -> tuple[Float, Float, Float, Float, Float]:
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
        rotation = so3.log(np.swapaxes(other.R_WB, -1, -2) @ self.R_WB)
        return np.hstack([rotation, *(a - b for a, b in zip(self.parts[1:], other.parts[1:], strict=True))])

    def retract(self, step: Float) -> StateArrays:
        """Moved by ``step`` (K, 15): rotations by right perturbation, the rest additively."""
        return StateArrays(
            self.R_WB @ so3.exp(step[:, DTHETA]),
            self.p_WB + step[:, DP],
            self.v_WB + step[:, DV],
            self.bias_gyro_B + step[:, DBG],
            self.bias_accel_B + step[:, DBA],
        )


@dataclass(frozen=True, slots=True)
class ImuFactors:
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
            np.linalg.inv(np.linalg.cholesky(stacked("cov", 15, 15))),
        )

    def residuals(self, i: StateArrays, j: StateArrays) -> Float:
        """(K, 15), [dtheta dp dv dbg dba] of state j beyond what state i and the readings predict [45]."""
        r, *_ = self._evaluate(i, j)
        return r

    def linearise(self, i: StateArrays, j: StateArrays) -> tuple[Float, Float, Float]:
        """Residuals (K, 15) and their Jacobians (K, 15, 15) by the errors of states i and j [App. C]."""
        r, R_BiW, p_i, v_i, correction = self._evaluate(i, j)
        count = len(r)
        J_i, J_j = np.zeros((count, 15, 15)), np.zeros((count, 15, 15))
        Jr_inv = so3.right_jacobian_inverse(r[:, DTHETA])
        E_T = so3.exp(-r[:, DTHETA])
        R_BjBi = np.swapaxes(j.R_WB, -1, -2) @ i.R_WB
        by_bias = self.bias_jacobian
        eye = np.eye(3)

        J_i[:, DTHETA, DTHETA] = -Jr_inv @ R_BjBi
        J_j[:, DTHETA, DTHETA] = Jr_inv
        J_i[:, DTHETA, DBG] = -Jr_inv @ E_T @ so3.right_jacobian(correction[:, DTHETA]) @ by_bias[:, DTHETA, 0:3]
        J_i[:, DP, DTHETA], J_i[:, DV, DTHETA] = so3.hat(p_i), so3.hat(v_i)
        J_i[:, DP, DP], J_j[:, DP, DP] = -R_BiW, R_BiW
        J_i[:, DP, DV] = -R_BiW * self.dt_s[:, None, None]
        J_i[:, DV, DV], J_j[:, DV, DV] = -R_BiW, R_BiW
        J_i[:, DP, DBG], J_i[:, DP, DBA] = -by_bias[:, DP, 0:3], -by_bias[:, DP, 3:6]
        J_i[:, DV, DBG], J_i[:, DV, DBA] = -by_bias[:, DV, 0:3], -by_bias[:, DV, 3:6]
        J_i[:, DBG, DBG], J_i[:, DBA, DBA] = -eye, -eye
        J_j[:, DBG, DBG], J_j[:, DBA, DBA] = eye, eye
        return r, J_i, J_j

    def _evaluate(self, i: StateArrays, j: StateArrays) -> tuple[Float, Float, Float, Float, Float]:
        """Residuals, R_BiW, the two states' relative position and velocity in Bi free of gravity, bias correction."""
        T = self.dt_s[:, None]
        R_BiW = np.swapaxes(i.R_WB, -1, -2)
        p_i = (R_BiW @ (j.p_WB - i.p_WB - i.v_WB * T - 0.5 * g_W * T * T)[..., None])[..., 0]
        v_i = (R_BiW @ (j.v_WB - i.v_WB - g_W * T)[..., None])[..., 0]
        change = np.concatenate([i.bias_gyro_B - self.bias_gyro_B, i.bias_accel_B - self.bias_accel_B], axis=1)
        correction = (self.bias_jacobian @ change[..., None])[..., 0]
        dR = self.dR @ so3.exp(correction[:, DTHETA])
        r = np.empty((len(T), 15))
        r[:, DTHETA] = so3.log(np.swapaxes(dR, -1, -2) @ R_BiW @ j.R_WB)
        r[:, DP] = p_i - self.dp - correction[:, DP]
        r[:, DV] = v_i - self.dv - correction[:, DV]
        r[:, DBG] = j.bias_gyro_B - i.bias_gyro_B
        r[:, DBA] = j.bias_accel_B - i.bias_accel_B
        return r, R_BiW, p_i, v_i, correction
