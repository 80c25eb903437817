"""Camera positions and landmarks up to scale, given the rotations: linear, from all frames at once.

With known rotations R_k an observation says that [1 0 -x; 0 1 -y] R_k' (p_F - c_k) = 0, which is linear in the landmark
p_F and the camera's position c_k (Rother, Carlsson, "Linear Multi View Reconstruction and Camera Recovery", ICCV 2001).
Landmarks are eliminated, and the positions are the eigenvector of the least eigenvalue. No two-view geometry is
involved, so that a planar scene is no special case.

Noise in x and y multiplies the unknown depth, hence plain least squares draws everything towards the cameras. The
expectation of what noise adds to the normal equations is known, and taken off (total least squares; Van Huffel,
Vandewalle, 1991). Derivation: ``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.estimation.initialization.estimate import RefusalError
from vioframe.estimation.initialization.window import Bool, Window
from vioframe.types import Float

# The error of an observation is weighed by the depth, which the solution before gives.
_SOLVES = 4
# A landmark's information along its ray over what noise alone would show: less is no parallax.
_LEAST_PARALLAX = 3.0
# Depths beyond these, in terms of the median, are not used for weighing.
_NEAR, _FAR = 0.02, 50.0


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
        if not parallax.any():
            raise RefusalError("no track has enough parallax")
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
    K, L = Q.shape[:2]
    V_inv = np.zeros((L, 3, 3))
    V_inv[use] = np.linalg.inv(Q[:, use].sum(axis=0))
    Q = Q * use[:, None, None]
    S = -np.einsum("klij,nljm->kinm", Q @ V_inv, Q)
    S[np.arange(K), :, np.arange(K)] += Q.sum(axis=1)
    S = S.reshape(3 * K, 3 * K)[3:, 3:]
    c = np.zeros((K, 3))
    c[1:] = np.linalg.eigh(S)[1][:, 0].reshape(K - 1, 3)
    return c, (V_inv @ np.einsum("klij,kj->li", Q, c)[..., None])[..., 0]
