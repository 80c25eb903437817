"""Velocity, gravity, accelerometer bias and landmarks in closed form, given the rotations.

With known rotations every observation is linear in the landmark, the first velocity and gravity (Martinelli, "Closed-Form
Solution of Visual-Inertial Structure from Motion", IJCV 2014; Dong-Si, Mourikis, "Estimator Initialization in
Vision-aided Inertial Navigation with Unknown Camera-IMU Calibration", IROS 2012). No two-view geometry is involved, so a
planar scene is no special case, and the scale needs no second step. Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vioframe.inertial.preintegration import Preintegrated
from vioframe.initialization.window import Bool, Window
from vioframe.types import GRAVITY_M_S2, Calibration, Float

_NEAREST_M, _FARTHEST_M = 0.1, 100.0
_SOLVES = 3


@dataclass(frozen=True, slots=True)
class Alignment:
    """The motion in the first body frame B0: ``R_B0B`` (K, 3, 3), ``p_B0B`` (K, 3) m, ``v_B0B`` (K, 3) m/s.

    ``g_B0`` (3,) has the norm of gravity. ``p_B0F`` (L, 3) m; ``depth`` (K, L) m, in each camera.
    """

    R_B0B: Float
    p_B0B: Float
    v_B0B: Float
    g_B0: Float
    bias_accel_B: Float
    p_B0F: Float
    depth: Float

    def only(self, keep: Bool) -> Alignment:
        """The same motion with the landmarks ``keep`` (L,)."""
        return replace(self, p_B0F=self.p_B0F[keep], depth=self.depth[:, keep])


def align(
    window: Window, imu: Sequence[Preintegrated], calibration: Calibration, sigma: float, bias_sigma: float
) -> Alignment:
    """Least squares over observations with noise ``sigma`` (z = 1 plane) and the bias' prior ``bias_sigma``, m/s^2.

    The algebraic error of an observation is its true error times the depth; it is divided by the depth of the solution
    before, a few times. The bias is held at zero in the first, which has no depths yet.
    """
    t, R, p_imu, v_imu, p_by_bias, v_by_bias = _cumulate(imu)
    R_CB0 = np.swapaxes(R @ calibration.R_BC, -1, -2)
    camera = p_imu + R @ calibration.p_BC
    count = len(t)
    # Camera centre = camera + by_x @ x with x = [v_B0, g_B0, bias_accel].
    eye = np.eye(3)
    by_x = np.concatenate([t[:, None, None] * eye, 0.5 * t[:, None, None] ** 2 * eye, p_by_bias], axis=2)
    # Rows [1 0 -x; 0 1 -y] R_CB0 of every observation: perpendicular to its bearing.
    rows = np.zeros((count, len(window.ids), 2, 3))
    rows[..., 0, 0] = rows[..., 1, 1] = 1.0
    rows[..., 2] = -np.where(window.seen[..., None], window.xy, 0.0)
    rows = rows @ R_CB0[:, None]

    depth = np.ones((count, len(window.ids)))
    for solve in range(_SOLVES):
        weight = window.seen / (sigma * depth)
        A_f = rows * weight[..., None, None]
        A_x = -A_f @ by_x[:, None]
        rhs = (A_f @ camera[:, None, :, None])[..., 0]
        V = np.einsum("klai,klaj->lij", A_f, A_f)
        V_inv = np.linalg.inv(V + 1e-9 * np.trace(V, axis1=1, axis2=2)[:, None, None] * eye)
        W = np.einsum("klai,klaj->lij", A_f, A_x)
        s_f = np.einsum("klai,kla->li", A_f, rhs)
        WV = np.swapaxes(W, -1, -2) @ V_inv
        H = np.einsum("klai,klaj->ij", A_x, A_x) - (WV @ W).sum(0)
        s = np.einsum("klai,kla->i", A_x, rhs) - (WV @ s_f[..., None])[..., 0].sum(0)
        H[6:, 6:] += eye / (1e-9 if solve == 0 else bias_sigma**2)
        x = _solve_on_gravity_sphere(H, s)
        p_F = (V_inv @ (s_f - W @ x)[..., None])[..., 0]
        p_B0C = camera + by_x @ x
        raw_depth = np.einsum("ki,kli->kl", R_CB0[:, 2], p_F - p_B0C[:, None])
        depth = _plausible(raw_depth)

    v_0, g, bias = x[:3], x[3:6], x[6:]
    p = v_0 * t[:, None] + 0.5 * g * t[:, None] ** 2 + p_imu + p_by_bias @ bias
    v = v_0 + g * t[:, None] + v_imu + v_by_bias @ bias
    return Alignment(R, p, v, g, bias, p_F, raw_depth)


def _plausible(depth: Float) -> Float:
    """Depths fit to weigh with: the median where a track has too little parallax for its own, or a wrong one."""
    good = (depth > _NEAREST_M) & (depth < _FARTHEST_M)
    return np.where(good, depth, np.median(depth[good]) if good.any() else 1.0)


def _cumulate(imu: Sequence[Preintegrated]) -> tuple[Float, Float, Float, Float, Float, Float]:
    """Time, rotation, gravity-free position and velocity from the first frame to each, and the bias' effect on these."""
    t, R, p, v = [0.0], [np.eye(3)], [np.zeros(3)], [np.zeros(3)]
    p_b, v_b = [np.zeros((3, 3))], [np.zeros((3, 3))]
    for m in imu:
        t.append(t[-1] + m.dt_s)
        p.append(p[-1] + v[-1] * m.dt_s + R[-1] @ m.dp)
        v.append(v[-1] + R[-1] @ m.dv)
        p_b.append(p_b[-1] + v_b[-1] * m.dt_s + R[-1] @ m.bias_jacobian[3:6, 3:])
        v_b.append(v_b[-1] + R[-1] @ m.bias_jacobian[6:9, 3:])
        R.append(R[-1] @ m.dR)
    return np.array(t), np.stack(R), np.stack(p), np.stack(v), np.stack(p_b), np.stack(v_b)


def _solve_on_gravity_sphere(H: Float, s: Float) -> Float:
    """argmin x' H x - 2 s' x over x (9,) with |x[3:6]| = g: the others eliminated, then a secular equation in one unknown.

    The minimiser on a sphere solves (S + lambda I) g = r for the one lambda above minus the least eigenvalue of S at which
    the norm is right (Golub, Van Loan, "Matrix Computations", 6.2.1); the norm falls with lambda there, so bisection finds it.
    """
    others = np.r_[0:3, 6:9]
    inner = np.linalg.solve(H[np.ix_(others, others)], np.column_stack([s[others], H[np.ix_(others, range(3, 6))]]))
    S = H[3:6, 3:6] - H[np.ix_(range(3, 6), others)] @ inner[:, 1:]
    r = s[3:6] - H[np.ix_(range(3, 6), others)] @ inner[:, 0]
    eigenvalues, U = np.linalg.eigh(S)
    r_u = U.T @ r
    low = -eigenvalues[0]
    high = low + np.linalg.norm(r) / GRAVITY_M_S2 + 1e-12
    for _ in range(100):
        middle = 0.5 * (low + high)
        too_long = np.linalg.norm(r_u / (eigenvalues + middle)) > GRAVITY_M_S2
        low, high = (middle, high) if too_long else (low, middle)
    g = U @ (r_u / (eigenvalues + high))
    x = np.empty(9)
    x[3:6] = g * (GRAVITY_M_S2 / np.linalg.norm(g))
    x[others] = inner[:, 0] - inner[:, 1:] @ x[3:6]
    return x
