"""Initialisation in motion up to the first complete guess, in closed form: gyroscope's bias, structure, alignment.

1. *The gyroscope's bias* from images alone: the one that lets every pair of frames agree with *some* translation.
   Rotations come from the gyroscope, so that all pairs share three unknowns (He et al., "A
   Rotation-Translation-Decoupled Solution for Robust and Efficient Visual-Inertial Initialization", CVPR 2023). What a
   pair says about its rotation is told in :mod:`vioframe.estimation.turns`.
2. *Structure*, camera positions and landmarks up to scale given the rotations: linear, from all frames at once. An
   observation says that [1 0 -x; 0 1 -y] R_k' (p_F - c_k) = 0, which is linear in the landmark p_F and the camera's
   position c_k (Rother, Carlsson, "Linear Multi View Reconstruction and Camera Recovery", ICCV 2001). Landmarks are
   eliminated, and the positions are the eigenvector of the least eigenvalue. No two-view geometry is involved, so that
   a planar scene is no special case. Noise in x and y multiplies the unknown depth, hence plain least squares draws
   everything towards the cameras. The expectation of what noise adds to the normal equations is known, and taken off
   (total least squares; Van Huffel, Vandewalle, 1991).
3. *Alignment*: scale, velocity, gravity and the accelerometer's bias. With known rotations the readings give the path
   as a linear function of the first velocity, gravity and the bias; images give it up to scale. Gravity's magnitude is
   known, and decides much where the motion is gentle (Dong-Si, Mourikis, "Estimator Initialization in Vision-aided
   Inertial Navigation with Unknown Camera-IMU Calibration", IROS 2012).

Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.estimation.initialization.window import Window, refuse_unless
from vioframe.estimation.turns import linearise_pairs
from vioframe.geometry.kernels import exp, product, right_jacobian, set_matrix, turned
from vioframe.jit import kernel
from vioframe.types import GRAVITY_M_S2

_FEWEST_COMMON = 10
# Iterations, the longest pair used (s) and Cauchy's scale (standard deviations) of each stage. Short pairs lead near
# the minimum; long ones, which a wrong bias turns by tens of pixels, then determine it.
_STAGES = ((4, 0.5, 50.0), (4, 1.0, 20.0), (8, np.inf, 5.0), (8, np.inf, 2.0))
_SETTLED = 1e-4  # rad/s
# The error of an observation is weighed by the depth, which the solution before gives.
_SOLVES = 4
# A landmark's information along its ray over what noise alone would show: less is no parallax.
_LEAST_PARALLAX = 3.0
# Depths beyond these, in terms of the median, are not used for weighing.
_NEAR, _FAR = 0.02, 50.0
# Information about the scale where it is known, far beyond what the alignment finds.
_SURE = 1e9
# What the path from images and the doubly integrated readings may differ by.
_POSITION_SIGMA_M = 0.01


def estimate_gyro_bias(
    window: Window, imu: Sequence[Preintegrated], R_BC: Float, sigma: float, bias_sigma: float
) -> tuple[Float, Float]:
    """The bias (3,) rad/s, and each track's median distance to its epipolar lines (L,) in units of ``sigma``.

    ``imu`` holds the K - 1 measurements between the keyframes; ``sigma`` is the noise of an observation on the z = 1
    plane, ``bias_sigma`` the prior of the bias about zero, rad/s. A track in no pair has distance NaN.
    """
    about = imu[0].bias_gyro_B
    bias, dR, by_bias = about, np.stack([m.dR for m in imu]), np.stack([m.bias_jacobian[:3, :3] for m in imu])
    for iterations, longest_s, cauchy in _STAGES:
        pairs = _Pairs.of(window, longest_s)
        weight, distance = pairs.common.astype(np.float64), np.full(pairs.common.shape, np.nan)
        for _ in range(iterations):
            R_B1B2, J = _relative_rotations(dR, by_bias, bias - about, pairs.first, pairs.second)
            H, b = linearise_pairs(
                pairs.f, pairs.g, pairs.common, R_BC.T @ R_B1B2 @ R_BC, weight, sigma, cauchy, distance
            )
            # R_CB R_B1B2 Exp(dtheta_B) R_BC = R_C1C2 Exp(R_CB dtheta_B)
            A = R_BC.T @ J
            transposed = np.swapaxes(A, -1, -2)
            information = (transposed @ H[:, :3, :3] @ A).sum(axis=0) + np.eye(3) / bias_sigma**2
            gradient = (transposed @ b[:, :3, None]).sum(axis=0)[:, 0] + bias / bias_sigma**2
            step = -np.linalg.solve(information, gradient)
            bias = bias + step
            if np.linalg.norm(step) < _SETTLED:
                break
    return bias, _median_over_pairs(distance)


@dataclass(frozen=True, slots=True)
class _Pairs:
    """P pairs of frames, ``first`` and ``second`` (P,), and the bearings (P, L, 3) of the tracks ``common`` (P, L)."""

    first: Int
    second: Int
    f: Float
    g: Float
    common: Bool

    @staticmethod
    def of(window: Window, longest_s: float) -> _Pairs:
        """The pairs that share enough tracks and are at most ``longest_s`` apart, or neighbours."""
        i, j = np.triu_indices(len(window.t_ns), 1)
        near = ((window.t_ns[j] - window.t_ns[i]) * 1e-9 <= longest_s) | (j == i + 1)
        use = near & ((window.seen[i] & window.seen[j]).sum(axis=1) >= _FEWEST_COMMON)
        i, j = i[use], j[use]
        bearings = np.concatenate([window.xy, np.ones((*window.seen.shape, 1))], axis=2)
        return _Pairs(i, j, bearings[i], bearings[j], window.seen[i] & window.seen[j])


@kernel
def _relative_rotations(dR: Float, by_bias: Float, change: Float, first: Int, second: Int) -> tuple[Float, Float]:
    """R_BiBj of P pairs (P, 3, 3), and its derivative by the bias (P, 3, 3), right perturbation.

    ``dR`` and ``by_bias`` (K - 1, 3, 3) are the turns between consecutive frames and their derivatives, at a bias that
    is now another by ``change`` (3,); ``first`` and ``second`` (P,) are the frames of each pair.
    """
    R_0, J_0 = np.zeros((len(dR) + 1, 3, 3)), np.zeros((len(dR) + 1, 3, 3))
    set_matrix(R_0[0], np.eye(3))
    for k in range(len(dR)):
        correction = turned(by_bias[k], change)
        step = product(dR[k], exp(correction))
        set_matrix(R_0[k + 1], product(R_0[k], step))
        set_matrix(J_0[k + 1], product(step.T, J_0[k]) + product(right_jacobian(correction), by_bias[k]))
    R, J = np.empty((len(first), 3, 3)), np.empty((len(first), 3, 3))
    for p in range(len(first)):
        i, j = first[p], second[p]
        set_matrix(R[p], product(R_0[i].T, R_0[j]))
        set_matrix(J[p], J_0[j] - product(R[p].T, J_0[i]))
    return R, J


def _median_over_pairs(distance: Float) -> Float:
    """(P, L) -> (L,); NaN where a track is in no pair."""
    out = np.full(distance.shape[1], np.nan)
    known = ~np.isnan(distance).all(axis=0) if len(distance) else np.zeros(distance.shape[1], bool)
    out[known] = np.nanmedian(distance[:, known], axis=0)
    return out


@dataclass(frozen=True, slots=True)
class Structure:
    """In the axes of the first body frame, from the first camera, in units of the median depth.

    ``position`` (K, 3) of the cameras, ``depth`` (K, L) of each landmark in each camera, ``error`` (K, L) the distance
    of its projection from the observation on the z = 1 plane, NaN where it is not seen. ``good`` (L,): with enough
    parallax and in front of all cameras that see it; the other columns mean nothing.
    """

    position: Float
    depth: Float
    error: Float
    good: Bool

    def only(self, keep: Bool) -> Structure:
        """The same path with the landmarks ``keep`` (L,)."""
        return Structure(self.position, self.depth[:, keep], self.error[:, keep], self.good[keep])


def solve_structure(window: Window, R_B0C: Float, sigma: float) -> Structure:
    """From rotations ``R_B0C`` (K, 3, 3) and observations with noise ``sigma`` on the z = 1 plane; may refuse."""
    K, L = window.seen.shape
    R_CB0 = np.swapaxes(R_B0C, -1, -2)
    rows = np.zeros((K, L, 2, 3))
    rows[..., 0, 0] = rows[..., 1, 1] = 1.0
    rows[..., 2] = -np.where(window.seen[..., None], window.xy, 0.0)
    rows = rows @ R_CB0[:, None]
    axis = R_CB0[:, 2]
    noise = 2.0 * sigma**2 * axis[:, None, :, None] * axis[:, None, None, :]
    information = np.swapaxes(rows, -1, -2) @ rows - noise

    depth = np.ones((K, L))
    for _ in range(_SOLVES):
        Q = information * (window.seen / depth**2)[..., None, None]
        parallax = _has_parallax(Q.sum(axis=0), (window.seen / depth**2).sum(axis=0) * 2.0 * sigma**2)
        refuse_unless(parallax.any(), "no track has enough parallax")
        c, p_F = _null_vector(Q, parallax)
        p_C = np.einsum("kij,klj->kli", R_CB0, p_F - c[:, None])
        if np.median(p_C[..., 2][window.seen & parallax]) < 0.0:
            c, p_C = -c, -p_C  # the equations are blind to the sign; landmarks lie in front
        in_front = ((p_C[..., 2] > 0.0) | ~window.seen).all(axis=0)
        good = parallax & in_front
        unit = float(np.median(p_C[..., 2][window.seen & good])) if good.any() else 1.0
        c, p_C = c / unit, p_C / unit
        plausible = good & (p_C[..., 2] > _NEAR) & (p_C[..., 2] < _FAR)
        depth = np.where(plausible, p_C[..., 2], 1.0)
    z = np.where(good, p_C[..., 2], 1.0)
    error = np.linalg.norm(p_C[..., :2] / z[..., None] - window.xy, axis=-1)
    return Structure(c, p_C[..., 2], error, good)


def _has_parallax(V: Float, noise: Float) -> Bool:
    """(L,) whether the information V (L, 3, 3) about a landmark is well above the ``noise`` (L,) in every direction."""
    enough: Bool = np.linalg.eigvalsh(V)[:, 0] > _LEAST_PARALLAX * noise
    return enough


def _null_vector(Q: Float, use: Bool) -> tuple[Float, Float]:
    """Positions c (K, 3), c_0 = 0, and landmarks (L, 3) that minimise sum (p_l - c_k)' Q_kl (p_l - c_k) over |c| = 1.

    ``Q`` (K, L, 3, 3); only the landmarks ``use`` (L,) take part, the others come out as zero.
    """
    from scipy.linalg import eigh

    K, L = Q.shape[:2]
    V_inv = np.zeros((L, 3, 3))
    V_inv[use] = np.linalg.inv(Q[:, use].sum(axis=0))
    Q = Q * use[:, None, None]
    # By camera and its axes, by landmark and its axes.
    left, right = ((M.swapaxes(1, 2)).reshape(3 * K, 3 * L) for M in (Q @ V_inv, Q))
    S = -(left @ right.T).reshape(K, 3, K, 3)
    S[np.arange(K), :, np.arange(K)] += Q.sum(axis=1)
    S = S.reshape(3 * K, 3 * K)[3:, 3:]
    c = np.zeros((K, 3))
    c[1:] = eigh(S, subset_by_index=(0, 0))[1].reshape(K - 1, 3)
    return c, (V_inv @ (right.T @ c.ravel()).reshape(L, 3, 1))[..., 0]


@dataclass(frozen=True, slots=True)
class Alignment:
    """The motion in the first body frame B0, as ``states`` of that world with the biases that go with it.

    ``g_B0`` (3,) has the norm of gravity; ``scale`` is metres per unit of the path that was aligned, and may come out
    negative where the readings contradict it.
    """

    states: StateArrays
    g_B0: Float
    scale: float


def rotations(imu: Sequence[Preintegrated]) -> Float:
    """R_B0B (K, 3, 3) of every keyframe from the K - 1 measurements between them."""
    R = [np.eye(3)]
    for m in imu:
        R.append(R[-1] @ m.dR)
    return np.stack(R)


def align(
    camera: Float, imu: Sequence[Preintegrated], p_BC: Float, bias_sigma: float, *, in_metres: bool = False
) -> Alignment:
    """``camera`` (K, 3) positions from the first camera in the axes of B0, in any unit; ``bias_sigma`` prior, m/s^2."""
    R = rotations(imu)
    t, p_imu, v_imu, p_by_bias, v_by_bias = _cumulate(imu, R)
    arm = R @ p_BC
    # scale camera_k = v t + g t^2 / 2 + p_imu + p_by_bias bias + arm_k - arm_0, unknown x = [v g bias scale].
    eye = np.eye(3)
    A = np.concatenate(
        [t[:, None, None] * eye, 0.5 * t[:, None, None] ** 2 * eye, p_by_bias, -camera[:, :, None]], axis=2
    ).reshape(-1, 10)
    b = -(p_imu + arm - arm[0]).ravel()
    H, s = A.T @ A, A.T @ b
    H[6:9, 6:9] += eye * (_POSITION_SIGMA_M / bias_sigma) ** 2
    if in_metres:
        H[9, 9] += _SURE
        s[9] += _SURE
    x = _solve_on_gravity_sphere(H, s)
    v_0, g, bias = x[:3], x[3:6], x[6:9]
    p = v_0 * t[:, None] + 0.5 * g * t[:, None] ** 2 + p_imu + p_by_bias @ bias
    v = v_0 + g * t[:, None] + v_imu + v_by_bias @ bias
    biases = np.tile(imu[0].bias_gyro_B, (len(R), 1)), np.tile(bias, (len(R), 1))
    return Alignment(StateArrays(R, p, v, *biases), g, float(x[9]))


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
