"""The gyroscope's bias from images alone: the one that lets every pair of frames agree with *some* translation.

For a pair with rotation R and bearings f, f', the normals n = f x R f' of all epipolar planes are perpendicular to the
translation, whichever it is (Kneip, Lynen, "Direct Optimization of Frame-to-Frame Rotation", ICCV 2013). Rotations come
from the gyroscope, so that all pairs share three unknowns (He et al., "A Rotation-Translation-Decoupled Solution for
Robust and Efficient Visual-Inertial Initialization", CVPR 2023). Works on planes and without parallax, where an
essential matrix does not. Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.inertial.preintegration import Preintegrated
from vioframe.initialization.window import Bool, Window
from vioframe.types import Float, Int

_FEWEST_COMMON = 10
# Iterations, the longest pair used (s) and Cauchy's scale (standard deviations) of each stage. Short pairs lead near
# the minimum; long ones, which a wrong bias turns by tens of pixels, then determine it.
_STAGES = ((4, 0.5, 50.0), (4, 1.0, 20.0), (8, np.inf, 5.0), (8, np.inf, 2.0))
_CONVERGED = 1e-5  # rad/s


def estimate_gyro_bias(
    window: Window, imu: Sequence[Preintegrated], R_BC: Float, sigma: float, bias_sigma: float
) -> tuple[Float, Float]:
    """The bias (3,) rad/s, and each track's median distance to its epipolar lines (L,) in units of ``sigma``.

    ``imu`` holds the K - 1 measurements between the keyframes; ``sigma`` is the noise of an observation on the z = 1
    plane, ``bias_sigma`` the prior of the bias about zero, rad/s. A track in no pair has distance NaN.
    """
    bias = imu[0].bias_gyro_B
    for iterations, longest_s, cauchy in _STAGES:
        pairs = _Pairs.of(window, longest_s, R_BC)
        weight = pairs.common.astype(np.float64)
        for _ in range(iterations):
            step, weight, distance = pairs.step(imu, bias, weight, sigma, bias_sigma, cauchy)
            bias = bias + step
            if np.linalg.norm(step) < _CONVERGED:
                break
    return bias, _median_over_pairs(np.where(pairs.common, distance, np.nan))


@dataclass(frozen=True, slots=True)
class _Pairs:
    """P pairs of frames with their bearings: ``f`` (P, L, 3) in the first camera, ``g_B`` (P, L, 3) in the second body.

    Both are zero where the pair does not share the track, ``common`` (P, L).
    """

    first: Int
    second: Int
    common: Bool
    f: Float
    g_B: Float
    R_BC: Float

    @staticmethod
    def of(window: Window, longest_s: float, R_BC: Float) -> _Pairs:
        """The pairs that share enough tracks and are at most ``longest_s`` apart, or neighbours."""
        i, j = np.triu_indices(len(window.t_ns), 1)
        near = ((window.t_ns[j] - window.t_ns[i]) * 1e-9 <= longest_s) | (j == i + 1)
        use = near & ((window.seen[i] & window.seen[j]).sum(axis=1) >= _FEWEST_COMMON)
        i, j = i[use], j[use]
        common = window.seen[i] & window.seen[j]
        f, g = _bearings(window.xy[i], common), _bearings(window.xy[j], common)
        return _Pairs(i, j, common, f, g @ R_BC.T, R_BC)

    def step(
        self, imu: Sequence[Preintegrated], bias: Float, weight: Float, sigma: float, bias_sigma: float, cauchy: float
    ) -> tuple[Float, Float, Float]:
        """One Gauss-Newton step of the bias, new weights (P, L), and distances in standard deviations (P, L)."""
        R, by_bias = _relative_rotations(imu, bias, self.first, self.second)
        R_to_C = self.R_BC.T @ R  # from the second body to the first camera
        y = self.g_B @ np.swapaxes(R_to_C, -1, -2)
        n = np.cross(self.f, y)
        t = np.linalg.eigh(np.swapaxes(n * weight[..., None], -1, -2) @ n)[1][:, :, 0]
        t_x_f = np.cross(t[:, None], self.f)

        # Sampson's distance: the residual n . t over the standard deviation that the noise of both points gives it.
        by_f = np.cross(y, t[:, None])[..., :2]
        by_g = (t_x_f @ (R_to_C @ self.R_BC))[..., :2]
        scale = sigma * np.sqrt((by_f**2).sum(-1) + (by_g**2).sum(-1)) + ~self.common
        r = (n @ t[..., None])[..., 0] / scale
        robust = np.where(self.common, 1.0 / (1.0 + (r / cauchy) ** 2), 0.0)

        # The two angles of every pair's translation are eliminated; as a direction, they have a prior of 1 rad.
        J_b = np.cross(self.g_B, t_x_f @ R_to_C) @ by_bias / scale[..., None]
        J = np.concatenate([J_b, n @ _tangent(t) / scale[..., None]], axis=2)
        weighted = np.swapaxes(J * robust[..., None], -1, -2)
        H, b = weighted @ J, (weighted @ r[..., None])[..., 0]
        gain = H[:, :3, 3:] @ np.linalg.inv(H[:, 3:, 3:] + np.eye(2))
        reduced = (H[:, :3, :3] - gain @ H[:, 3:, :3]).sum(axis=0) + np.eye(3) / bias_sigma**2
        gradient = (b[:, :3] - (gain @ b[:, 3:, None])[..., 0]).sum(axis=0) + bias / bias_sigma**2
        return np.linalg.solve(reduced, -gradient), robust / scale**2, np.abs(r)


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
