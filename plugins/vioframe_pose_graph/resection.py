"""Where a keyframe's camera was, as its own landmarks say.

A filter places a keyframe by what it knew then, and its landmarks by what it has learned in the second after that. Seen
from the keyframe's pose they lie off by several pixels, all to one side: at 8 m, 0.3 degrees are 4 cm, more than a loop
need be off by. The keyframe saw these landmarks itself: where it saw them says where its camera is to be put, and the
body with it. Without this three of four loops of a rendered V1_02 find too few points that agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry import so3
from vioframe.types import Float

_ITERATIONS = 5
_SIGMA_TURN, _SIGMA_M = np.radians(1.0), 0.03


def reprojection(p_WF: Float, xy: Float, R_WC: Float, p_WC: Float) -> tuple[Float, Float]:
    """(M, 2) on the z = 1 plane, and (M, 2, 6) their derivatives by [turn, p_WC]; NaN for points behind the camera.

    The camera is perturbed as ``R_WC <- R_WC Exp(turn)``.
    """
    p_C = (p_WF - p_WC) @ R_WC
    z = np.where(p_C[:, 2] > 0.0, p_C[:, 2], np.nan)
    projected = p_C[:, :2] / z[:, None]
    J_C = np.concatenate([so3.hat(p_C), np.broadcast_to(-R_WC.T, (len(p_C), 3, 3))], axis=2)
    return projected - xy, (J_C[:, :2] - projected[:, :, None] * J_C[:, 2:]) / z[:, None, None]


def resect(
    p_WF: Float, xy: Float, R_WC: Float, p_WC: Float, sigma: float, tolerance: float
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """The camera's pose that fits the landmarks (M, 3) seen at ``xy`` (M, 2), and (M,) which of them then fit.

    The pose given is the prior. A landmark is seen to ``sigma``, counts less the further it lies off (Cauchy), and fits
    if it lies within ``tolerance``; both are lengths on the z = 1 plane.
    """
    R, p = R_WC, p_WC
    prior = np.repeat([_SIGMA_TURN**-2, _SIGMA_M**-2], 3)
    for _ in range(_ITERATIONS):
        r, J = reprojection(p_WF, xy, R, p)
        r, J = np.nan_to_num(r), np.nan_to_num(J)
        w = 1.0 / (sigma**2 + np.sum(r**2, axis=1))
        off = np.concatenate([so3.log(R_WC.T @ R), p - p_WC])
        H = np.einsum("m,mki,mkj->ij", w, J, J) + np.diag(prior)
        step = np.linalg.solve(H, -np.einsum("m,mki,mk->i", w, J, r) - prior * off)
        R, p = R @ so3.exp(step[:3]), p + step[3:]
    error = np.linalg.norm(reprojection(p_WF, xy, R, p)[0], axis=1)
    return R, p, np.asarray(error < tolerance)
