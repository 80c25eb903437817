"""Reprojection factors, compiled: residuals, Jacobians and normal equations of all landmarks of a window.

A landmark m = [x y rho] of the host h is seen from the frame f at the direction of

    X = R_BC^T (R_fh q + rho t_fh - rho p_BC),   q = R_BC [x y 1]^T + rho p_BC,

with R_fh = R_WBf^T R_WBh and t_fh = R_WBf^T (p_WBh - p_WBf): rho times its position in the camera. Being polynomial in
rho, it holds for points as far as one likes. Residuals are evaluated at the estimate, Jacobians at the first estimates
of poses that are in the prior. Derivation: ``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.types import Float
from vioframe_sliding_window import reprojection_kernels as kernels


@dataclass(frozen=True, slots=True)
class Poses:
    """Of the body in every frame, R_WB (K, 3, 3) and p_WB (K, 3), and what takes one frame's body to another's.

    ``R_fh`` (K, K, 3, 3) and ``t_fh`` (K, K, 3) by [frame, host].
    """

    R_WB: Float
    R_fh: Float
    t_fh: Float

    @staticmethod
    def of(R_WB: Float, p_WB: Float) -> Poses:
        R_BW = np.swapaxes(R_WB, -1, -2)
        R_fh = R_BW[:, None] @ R_WB[None]
        t_fh = (R_BW[:, None] @ (p_WB[None] - p_WB[:, None])[..., None])[..., 0]
        return Poses(np.ascontiguousarray(R_WB), R_fh, t_fh)


@dataclass(frozen=True, slots=True)
class Sightings:
    """What was seen of L landmarks in K frames, as in the track table, with its noise and robust loss.

    ``to_px`` (L, K, 2, 2) turns residuals into pixels, in which ``sigma`` is the standard deviation; ``cauchy`` is the
    scale of the robust loss, in standard deviations.
    """

    seen: NDArray[np.bool_]
    xy: Float
    velocity: Float
    to_px: Float
    sigma: float
    cauchy: float
    on_sphere: bool

    def cost(self, poses: Poses, R_BC: Float, p_BC: Float, offset_s: float, landmarks: Float) -> float:
        """Half the robust sum of squares."""
        return float(
            kernels.cost(
                poses.R_fh,
                poses.t_fh,
                R_BC,
                p_BC,
                offset_s,
                self.seen,
                self.xy,
                self.velocity,
                self.to_px,
                landmarks,
                self.sigma,
                self.cauchy,
                self.on_sphere,
            )
        )

    def errors(self, poses: Poses, R_BC: Float, p_BC: Float, offset_s: float, landmarks: Float) -> Float:
        """(L,) root mean square residual of each landmark, standard deviations; infinite behind a camera."""
        return kernels.errors(
            poses.R_fh,
            poses.t_fh,
            R_BC,
            p_BC,
            offset_s,
            self.seen,
            self.xy,
            self.velocity,
            self.to_px,
            landmarks,
            self.sigma,
            self.on_sphere,
        )

    def linearise(
        self, poses: Poses, first: Poses, R_BC: Float, p_BC: Float, offset_s: float, landmarks: Float
    ) -> tuple[Float, Float, Float, Float, Float]:
        """H (n, n), b (n,) of poses and calibration, and V (L, 3, 3), W (L, 3, n), c (L, 3) of the landmarks.

        n = 6 K + 7: [dtheta dp] of every frame, then the calibration. The gradient is [b c], the Gauss-Newton matrix
        [H W^T; W V], with the robust weights in them.
        """
        return kernels.linearise(
            poses.R_fh,
            poses.t_fh,
            first.R_WB,
            first.R_fh,
            first.t_fh,
            R_BC,
            p_BC,
            offset_s,
            self.seen,
            self.xy,
            self.velocity,
            self.to_px,
            landmarks,
            self.sigma,
            self.cauchy,
            self.on_sphere,
        )
