"""What tracks say about the rotation between two frames, whatever the translation: many pairs of frames at once.

For bearings f, g of one landmark in two cameras with rotation R, the normals n = f x R g of all epipolar planes are
perpendicular to the translation, whichever it is (Kneip, Lynen, "Direct Optimization of Frame-to-Frame Rotation", ICCV
2013). Works on planes and without parallax, where an essential matrix does not. Derivation:
``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.inertial.preintegration import Preintegrated
from vioframe.initialization.window import Bool
from vioframe.types import Float, Int


@dataclass(frozen=True, slots=True)
class RotationEquations:
    """Gauss-Newton equations of each pair's rotation, ``R_12 <- R_12 Exp(dtheta)``: ``H`` (P, 3, 3) dtheta = -``b`` (P, 3).

    ``weight`` (P, N) is for the next call, ``distance`` (P, N) how far each track is from its epipolar line in standard
    deviations, zero where the pair does not share it.
    """

    H: Float
    b: Float
    weight: Float
    distance: Float


@dataclass(frozen=True, slots=True)
class BearingPairs:
    """P pairs of frames with at most N tracks each: ``f`` (P, N, 3) in the first camera and ``g`` in the second, z = 1.

    Both are zero where the pair does not share the track, ``common`` (P, N).
    """

    f: Float
    g: Float
    common: Bool

    @staticmethod
    def of(xy_1: Float, xy_2: Float, common: Bool) -> BearingPairs:
        """From points (P, N, 2) on the z = 1 plane; what they hold where they are not ``common`` does not matter."""
        return BearingPairs(_bearings(xy_1, common), _bearings(xy_2, common), common)

    def linearise(self, R_12: Float, weight: Float, sigma: float, cauchy: float) -> RotationEquations:
        """At the rotations ``R_12`` (P, 3, 3) = R_C1C2, for noise ``sigma`` on the z = 1 plane.

        Each translation is the direction that the normals, weighed by ``weight`` (P, N), are most perpendicular to, and
        is eliminated from the equations. ``cauchy`` is the scale of the robust loss in standard deviations.
        """
        f, g = self.f, self.g
        y = g @ np.swapaxes(R_12, -1, -2)
        n = np.cross(f, y)
        t = np.linalg.eigh(np.swapaxes(n * weight[..., None], -1, -2) @ n)[1][:, :, 0]
        t_x_f = np.cross(t[:, None], f)
        by_g = t_x_f @ R_12

        # Sampson's distance: the residual n . t over the standard deviation that the noise of both points gives it.
        by_f = np.cross(y, t[:, None])
        scale = sigma * np.sqrt((by_f[..., :2] ** 2).sum(-1) + (by_g[..., :2] ** 2).sum(-1)) + ~self.common
        r = (n @ t[..., None])[..., 0] / scale
        robust = np.where(self.common, 1.0 / (1.0 + (r / cauchy) ** 2), 0.0)

        # The two angles of every pair's translation are eliminated; as a direction, they have a prior of 1 rad.
        J = np.concatenate([np.cross(g, by_g), n @ _tangent(t)], axis=2) / scale[..., None]
        weighted = np.swapaxes(J * robust[..., None], -1, -2)
        H, b = weighted @ J, (weighted @ r[..., None])[..., 0]
        gain = H[:, :3, 3:] @ np.linalg.inv(H[:, 3:, 3:] + np.eye(2))
        return RotationEquations(
            H[:, :3, :3] - gain @ H[:, 3:, :3],
            b[:, :3] - (gain @ b[:, 3:, None])[..., 0],
            robust / scale**2,
            np.abs(r),
        )


def relative_rotations(imu: Sequence[Preintegrated], bias: Float, first: Int, second: Int) -> tuple[Float, Float]:
    """R_BiBj of every pair at ``bias`` (P, 3, 3), and its derivative by the bias (P, 3, 3), right perturbation.

    ``imu`` holds the measurements between consecutive frames, ``first`` and ``second`` (P,) the frames of each pair.
    """
    R, J = [np.eye(3)], [np.zeros((3, 3))]
    for m in imu:
        correction = m.bias_jacobian[:3, :3] @ (bias - m.bias_gyro_B)
        step = m.dR @ so3.exp(correction)
        R.append(R[-1] @ step)
        J.append(step.T @ J[-1] + so3.right_jacobian(correction) @ m.bias_jacobian[:3, :3])
    R_0, J_0 = np.stack(R), np.stack(J)
    R_ij = np.swapaxes(R_0[first], -1, -2) @ R_0[second]
    return R_ij, J_0[second] - np.swapaxes(R_ij, -1, -2) @ J_0[first]


def _bearings(xy: Float, common: Bool) -> Float:
    return np.where(common[..., None], np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1), 0.0)


def _tangent(t: Float) -> Float:
    """(P, 3) unit vectors -> (P, 3, 2), an orthonormal basis of the plane perpendicular to each."""
    return np.linalg.svd(t[:, None, :])[2].swapaxes(-1, -2)[..., 1:]
