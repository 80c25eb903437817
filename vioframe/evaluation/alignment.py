"""Bringing an estimate into the frame of the ground truth. Derivation: ``docs/derivations/alignment.md``.

Visual-inertial odometry cannot observe where it started nor its heading, so the honest gauge is position and yaw, four
degrees of freedom. SE(3) is given beside it because most published figures use it, Sim(3) to diagnose the scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import Float


@dataclass(frozen=True, eq=False)
class Alignment:
    """``p_G = scale * R_GW @ p_W + p_GW`` from the estimate's world W to the ground truth's world G."""

    R_GW: Float
    p_GW: Float
    scale: float = 1.0

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """``trajectory`` seen in G. Its rotation errors live in B and stay; its position errors turn with the world."""
        cov = trajectory.cov_pose
        if cov is not None:
            A = np.eye(6)
            A[3:, 3:] = self.scale * self.R_GW
            cov = A @ cov @ A.T
        return Trajectory(trajectory.t_ns, self.R_GW @ trajectory.R_WB, self.points(trajectory.p_WB), cov)

    def points(self, p_W: Float) -> Float:
        """Points (N, 3) m seen in G."""
        return np.asarray(self.scale * p_W @ self.R_GW.T + self.p_GW)


def align_posyaw(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """Position and yaw in closed form: the least-squares fit of the positions over R_z(yaw) and translation."""
    p_W, p_G, C = _centred_correlation(estimate, truth)
    R_GW = rotation_z(float(yaw_of(C)))
    return Alignment(R_GW, p_G - R_GW @ p_W)


def align_posyaw_by_attitude(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """Position and yaw with the yaw taken from the attitudes, for a body at rest, whose positions tell no heading."""
    p_W, p_G, _ = _centred_correlation(estimate, truth)
    R_GW = rotation_z(float(yaw_of((truth.R_WB @ estimate.R_WB.transpose(0, 2, 1)).mean(axis=0))))
    return Alignment(R_GW, p_G - R_GW @ p_W)


def align_first(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """Position and yaw of the first pose alone: the gauge in which a filter's covariance is meant."""
    R_GW = rotation_z(float(yaw_of(truth.R_WB[0] @ estimate.R_WB[0].T)))
    return Alignment(R_GW, truth.p_WB[0] - R_GW @ estimate.p_WB[0])


def align_se3(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """The rigid least-squares fit of the positions (Umeyama 1991)."""
    return _umeyama(estimate, truth, with_scale=False)


def align_sim3(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """The least-squares fit of the positions over rotation, translation and scale (Umeyama 1991)."""
    return _umeyama(estimate, truth, with_scale=True)


ALIGNMENTS: Mapping[str, Callable[[Trajectory, Trajectory], Alignment]] = {
    "posyaw": align_posyaw,
    "se3": align_se3,
    "sim3": align_sim3,
    "first": align_first,
}
"""By the names that the command line and :func:`vioframe.evaluation.evaluate` use."""

ALIGNED_BY = {"posyaw": "position + yaw", "se3": "SE(3)", "sim3": "Sim(3)", "first": "first pose"}
"""What each of them fits, in words."""


def _centred_correlation(estimate: Trajectory, truth: Trajectory) -> tuple[Float, Float, Float]:
    """Both mean positions (3,) and C (3, 3) = mean of (p_G - mean)(p_W - mean)^T, Umeyama (34), (35), (38)."""
    if len(estimate) != len(truth):
        raise TrajectoryError(f"align takes associated trajectories, got {len(estimate)} and {len(truth)} poses")
    p_W, p_G = estimate.p_WB.mean(axis=0), truth.p_WB.mean(axis=0)
    return p_W, p_G, (truth.p_WB - p_G).T @ (estimate.p_WB - p_W) / len(estimate)


def _umeyama(estimate: Trajectory, truth: Trajectory, *, with_scale: bool) -> Alignment:
    p_W, p_G, C = _centred_correlation(estimate, truth)
    U, d, Vt = np.linalg.svd(C)
    if d[1] <= np.finfo(np.float64).eps * len(estimate) * d[0]:
        raise TrajectoryError("the positions lie on one line, which leaves a rotation open; align by position and yaw")
    # (39), (43): a reflection is turned into the nearest rotation through the weakest axis.
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R_GW = (U * S) @ Vt
    scale = 1.0
    if with_scale:
        variance = float(np.mean(np.sum((estimate.p_WB - p_W) ** 2, axis=1)))  # (36)
        scale = float(d @ S) / variance  # (42)
    return Alignment(R_GW, p_G - scale * R_GW @ p_W, scale)  # (41)
