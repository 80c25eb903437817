"""What tracks say about the rotation between two frames, whatever the translation: many pairs of frames at once.

For bearings f, g of one landmark in two cameras with rotation R, the normals n = f x R g of all epipolar planes are
perpendicular to the translation, whichever it is (Kneip, Lynen, "Direct Optimization of Frame-to-Frame Rotation", ICCV
2013). Works on planes and without parallax, where an essential matrix does not. Derivation:
``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.arrays import Bool
from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.geometry import so3
from vioframe.types import Float, Int

CONVERGED = 1e-5
"""Steps of a refinement below this end a stage, rad and rad/s."""
_UNOBSERVED = 1e-6  # information, 1/rad^2, far below what any pair of frames brings


@dataclass(frozen=True, slots=True)
class RotationEquations:
    """Gauss-Newton equations ``H`` (P, 3, 3) dtheta = -``b`` (P, 3) of each pair's rotation, R_12 <- R_12 Exp(dtheta).

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
        t = _translation(_moments(n, weight), _noise_of_normals(f, y, R_12, weight * self.common))
        t_x_f = np.cross(t[:, None], f)
        by_g = t_x_f @ R_12

        # Sampson's distance: the residual n . t over the standard deviation that the noise of both points gives it.
        by_f = np.cross(y, t[:, None])
        scale = sigma * np.sqrt((by_f[..., :2] ** 2).sum(-1) + (by_g[..., :2] ** 2).sum(-1)) + ~self.common
        r = (n @ t[..., None])[..., 0] / scale
        robust = np.where(self.common, 1.0 / (1.0 + (r / cauchy) ** 2), 0.0)

        # Each translation is at its own minimum; its two angles, with a prior of 1 rad, are eliminated.
        tangent = _tangent(t)
        J = np.concatenate([np.cross(g, by_g), n @ tangent], axis=2) / scale[..., None]
        weighted = np.swapaxes(J * robust[..., None], -1, -2)
        H, b = weighted @ J, (weighted[:, :3] @ r[..., None])[..., 0]
        eliminated = H[:, :3, 3:] @ np.linalg.solve(H[:, 3:, 3:] + np.eye(2), H[:, 3:, :3])
        return RotationEquations(H[:, :3, :3] - eliminated, b, robust / scale**2, np.abs(r))


@dataclass(frozen=True, slots=True)
class Pairs:
    """P pairs of frames, ``first`` and ``second`` (P,), and their tracks."""

    first: Int
    second: Int
    bearings: BearingPairs


@dataclass(frozen=True, slots=True)
class Refined:
    """The gyroscope's bias (3,) rad/s and ``R_BC`` (3, 3), and how the last iteration left them.

    ``H`` is the information about [bias R_BC], or the bias alone; ``distance`` (P, N) that of each track of the last
    stage's pairs from its epipolar line, standard deviations; ``last_step`` the length of the last step.
    """

    bias_gyro_B: Float
    R_BC: Float
    H: Float
    distance: Float
    last_step: float


def refine(
    stages: Iterable[tuple[Pairs, int, float]],
    imu: Sequence[Preintegrated],
    bias: Float,
    R_BC: Float,
    sigma: float,
    bias_sigma: float,
    *,
    turn_camera: bool = False,
) -> Refined:
    """Turn all pairs together by the gyroscope's bias, and by R_BC where ``turn_camera``, until the tracks fit.

    Each stage is its pairs, its iterations at most and Cauchy's scale (standard deviations). ``imu`` holds the
    measurements between consecutive frames; ``sigma`` is the noise of an observation on the z = 1 plane, ``bias_sigma``
    the bias's prior about zero, rad/s.
    """
    for pairs, iterations, cauchy in stages:
        weight = pairs.bearings.common.astype(np.float64)
        for _ in range(iterations):
            R_B1B2, by_bias = relative_rotations(imu, bias, pairs.first, pairs.second)
            R_C1C2 = R_BC.T @ R_B1B2 @ R_BC
            equations = pairs.bearings.linearise(R_C1C2, weight, sigma, cauchy)
            # R_CB R_B1B2 Exp(dtheta_B) R_BC = R_C1C2 Exp(R_CB dtheta_B), and turning R_BC on the right by d turns
            # R_C1C2 into Exp(-d) R_C1C2 Exp(d) = R_C1C2 Exp((I - R_C2C1) d).
            A = R_BC.T @ by_bias
            if turn_camera:
                A = np.concatenate([A, np.eye(3) - np.swapaxes(R_C1C2, -1, -2)], axis=2)
            transposed = np.swapaxes(A, -1, -2)
            H = (transposed @ equations.H @ A).sum(axis=0)
            b = (transposed @ equations.b[..., None]).sum(axis=0)[:, 0]
            H[:3, :3] += np.eye(3) / bias_sigma**2
            b[:3] += bias / bias_sigma**2
            if turn_camera:
                H[3:, 3:] += np.eye(3) * _UNOBSERVED
            step = np.linalg.solve(H, -b)
            bias, weight = bias + step[:3], equations.weight
            if turn_camera:
                R_BC = R_BC @ so3.exp(step[3:])
            if np.linalg.norm(step) < CONVERGED:
                break
    return Refined(bias, R_BC, H, equations.distance, float(np.linalg.norm(step)))


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


def _moments(v: Float, weight: Float) -> Float:
    """Sums of weight v v' over the tracks: (P, N, 3), (P, N) -> (P, 3, 3)."""
    out: Float = np.swapaxes(v * weight[..., None], -1, -2) @ v
    return out


def _noise_of_normals(f: Float, y: Float, R_12: Float, weight: Float) -> Float:
    """What unit noise in both points adds to the moments (P, 3, 3) of the normals f x y, on average.

    Noise e across the optical axis z moves a normal by e x y, and the average of (e x y)(e x y)' over the plane is
    |y|^2 I - y y' - (z x y)(z x y)'. That of the second point lies across its own axis, R z.
    """
    across = so3.hat([0.0, 0.0, 1.0]), so3.hat(R_12[..., 2])
    out = np.zeros_like(R_12)
    for moments, z_x in zip((_moments(y, weight), _moments(f, weight)), across, strict=True):
        trace = np.trace(moments, axis1=-2, axis2=-1)
        out += trace[:, None, None] * np.eye(3) - moments - z_x @ moments @ np.swapaxes(z_x, -1, -2)
    return out


def _translation(moments: Float, noise: Float) -> Float:
    """(P, 3) unit vectors t that minimise t' moments t over t' noise t: the likeliest direction (Kanatani 2005).

    Plain eigenvectors are drawn to where noise hurts least, and the more so the smaller the parallax.
    """
    trace = np.trace(noise, axis1=-2, axis2=-1)[:, None, None]
    whitener = np.linalg.inv(np.linalg.cholesky(noise + 1e-6 * trace * np.eye(3)))
    transposed = np.swapaxes(whitener, -1, -2)
    t = (transposed @ np.linalg.eigh(whitener @ moments @ transposed)[1][..., :1])[..., 0]
    out: Float = t / np.linalg.norm(t, axis=1, keepdims=True)
    return out


def _tangent(t: Float) -> Float:
    """(P, 3) unit vectors -> (P, 3, 2), an orthonormal basis of the plane perpendicular to each."""
    return np.linalg.svd(t[:, None, :])[2].swapaxes(-1, -2)[..., 1:]
