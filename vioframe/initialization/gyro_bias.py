"""The gyroscope's bias from images alone: the one that lets every pair of frames agree with *some* translation.

For a pair with rotation R and bearings f, f', the normals n = f x R f' of all epipolar planes are perpendicular to the
translation, whichever it is (Kneip, Lynen, "Direct Optimization of Frame-to-Frame Rotation", ICCV 2013). Rotations come
from the gyroscope, so that all pairs share three unknowns (He et al., "A Rotation-Translation-Decoupled Solution for
Robust and Efficient Visual-Inertial Initialization", CVPR 2023). Works on planes and without parallax, where an essential
matrix does not. Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vioframe.geometry import so3
from vioframe.inertial.preintegration import Preintegrated
from vioframe.initialization.window import Bool, Window
from vioframe.types import Float, Int

# Pairs up to this far apart: long enough that the bias shows, short enough that the tracks survive.
_LONGEST_PAIR_S = 0.7
_FEWEST_COMMON = 10
_ITERATIONS = 10
_CAUCHY = 2.0  # standard deviations


def estimate_gyro_bias(
    window: Window, imu: Sequence[Preintegrated], R_BC: Float, sigma: float, bias_sigma: float
) -> tuple[Float, Float]:
    """The bias (3,) rad/s, and each track's median distance to its epipolar lines (L,) in units of ``sigma``.

    ``imu`` holds the K - 1 measurements between the keyframes; ``sigma`` is the noise of an observation on the z = 1
    plane, ``bias_sigma`` the prior of the bias about zero, rad/s. A track in no pair has distance NaN.
    """
    first, second = _pairs(window)
    common = window.seen[first] & window.seen[second]
    f = _bearings(window.xy[first], common)
    g_B = _bearings(window.xy[second], common) @ R_BC.T
    bias = imu[0].bias_gyro_B
    weight = common.astype(float)
    for _ in range(_ITERATIONS):
        R, by_bias = _relative_rotations(imu, bias, first, second)
        R_to_C = R_BC.T @ R  # (P, 3, 3), from the second body to the first camera
        y = g_B @ np.swapaxes(R_to_C, -1, -2)
        n = np.cross(f, y)
        t = np.linalg.eigh(np.einsum("pl,pli,plj->pij", weight, n, n))[1][:, :, 0]
        t_x_f = np.cross(t[:, None], f)

        # Sampson's distance: the residual n . t over the standard deviation that the noise of both points gives it.
        by_f = np.cross(y, t[:, None])[..., :2]
        by_g = (t_x_f @ (R_to_C @ R_BC))[..., :2]
        scale = sigma * np.sqrt((by_f**2).sum(-1) + (by_g**2).sum(-1)) + ~common
        r = np.einsum("pli,pi->pl", n, t) / scale
        distance = np.where(common, np.abs(r), np.nan)
        robust = np.where(common, 1.0 / (1.0 + (r / _CAUCHY) ** 2), 0.0)
        weight = robust / scale**2

        # Gauss-Newton in the bias with the two angles of every pair's translation eliminated.
        J_b = np.cross(g_B, t_x_f @ R_to_C) @ by_bias / scale[..., None]
        J_t = n @ _tangent(t) / scale[..., None]
        A = np.einsum("pl,pli,plj->pij", robust, J_b, J_b)
        B = np.einsum("pl,pli,plj->pij", robust, J_b, J_t)
        C = np.einsum("pl,pli,plj->pij", robust, J_t, J_t) + np.eye(2)  # the translation is a direction: prior of 1 rad
        b = np.einsum("pl,pli,pl->pi", robust, J_b, r)
        c = np.einsum("pl,pli,pl->pi", robust, J_t, r)
        gain = B @ np.linalg.inv(C)
        H = (A - gain @ np.swapaxes(B, -1, -2)).sum(0) + np.eye(3) / bias_sigma**2
        gradient = (b - (gain @ c[..., None])[..., 0]).sum(0) + bias / bias_sigma**2
        step = np.linalg.solve(H, -gradient)
        bias = bias + step
        if np.linalg.norm(step) < 1e-5:
            break
    return bias, _median_over_pairs(distance)


def _pairs(window: Window) -> tuple[Int, Int]:
    """Indices of the frames of all pairs that are near in time and share enough tracks, and each of one's neighbours."""
    i, j = np.triu_indices(len(window.t_ns), 1)
    near = (window.t_ns[j] - window.t_ns[i]) * 1e-9 <= _LONGEST_PAIR_S
    enough = (window.seen[i] & window.seen[j]).sum(axis=1) >= _FEWEST_COMMON
    use = (near | (j == i + 1)) & enough
    return i[use], j[use]


def _bearings(xy: Float, common: Bool) -> Float:
    """(P, L, 3), zero where the pair does not share the track."""
    return np.where(common[..., None], np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1), 0.0)


def _relative_rotations(imu: Sequence[Preintegrated], bias: Float, first: Int, second: Int) -> tuple[Float, Float]:
    """R_BiBj of every pair at ``bias`` (P, 3, 3), and its derivative by the bias (P, 3, 3), right perturbation."""
    R, J = [np.eye(3)], [np.zeros((3, 3))]
    for m in imu:
        correction = m.bias_jacobian[:3, :3] @ (bias - m.bias_gyro_B)
        step = m.dR @ so3.exp(correction)
        R.append(R[-1] @ step)
        J.append(step.T @ J[-1] + so3.right_jacobian(correction) @ m.bias_jacobian[:3, :3])
    R_0, J_0 = np.stack(R), np.stack(J)
    R_ij = np.swapaxes(R_0[first], -1, -2) @ R_0[second]
    return R_ij, J_0[second] - np.swapaxes(R_ij, -1, -2) @ J_0[first]


def _tangent(t: Float) -> Float:
    """(P, 3) unit vectors -> (P, 3, 2), an orthonormal basis of the plane perpendicular to each."""
    return np.linalg.svd(t[:, None, :])[2].swapaxes(-1, -2)[..., 1:]


def _median_over_pairs(distance: Float) -> Float:
    """(P, L) -> (L,); NaN where a track is in no pair."""
    out = np.full(distance.shape[1], np.nan)
    known = ~np.isnan(distance).all(axis=0) if len(distance) else np.zeros(distance.shape[1], bool)
    out[known] = np.nanmedian(distance[:, known], axis=0)
    return out
