"""Which sightings to believe: those that the odometry's drift can explain, and that agree with one another.

A place may have a twin: shelves, windows, a texture laid out again and again. Its picture verifies as well as the place
itself, so the picture cannot tell; where it would put the body can.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vioframe.trajectory.alignment import rotation_z
from vioframe.types import NS_PER_S, Float, Int
from vioframe_pose_graph.drift import Odometry
from vioframe_pose_graph.recognition import Sighting

GATE = float(chi2.ppf(0.999, 4))
"""Squared Mahalanobis distance in [x y z yaw] that a correct sighting stays below in 999 of 1000 cases."""

_REPEAT_NS = 3 * NS_PER_S
# Points seen to a pixel place a camera to millimetres; but the points themselves were placed by the odometry, whose
# scale is off by some per cent.
_SIGMA_M, _SIGMA_PART, _SIGMA_YAW = 0.02, 0.02, np.radians(0.2)


def sighting_cov(sighting: Sighting) -> Float:
    """(4, 4) covariance of [position yaw] of the later keyframe's body seen from the earlier one."""
    relation = sighting.relation
    apart = np.linalg.norm(relation.z)
    variance = _SIGMA_M**2 + (_SIGMA_PART * apart) ** 2
    return relation.cov + np.diag([variance, variance, variance, _SIGMA_YAW**2])


def believable(sightings: Sequence[Sighting], odometry: Odometry, t_ns: Int) -> NDArray[np.bool_]:
    """(S,) whether a sighting lies within the drift, was repeated by another keyframe soon, and has no twin."""
    covs = [sighting_cov(sighting) for sighting in sightings]
    within = [_within_drift(s, odometry, cov) for s, cov in zip(sightings, covs, strict=True)]
    repeated, twin = np.zeros(len(sightings), bool), np.zeros(len(sightings), bool)
    for a, first in enumerate(sightings):
        for b in range(a + 1, len(sightings)):
            second = sightings[b]
            if t_ns[second.later] - t_ns[first.later] > _REPEAT_NS:
                break
            agree = _disagreement(first, second, odometry, covs[a], covs[b]) < GATE
            if first.later == second.later:
                twin[[a, b]] |= not agree
            elif within[a] and within[b]:
                repeated[[a, b]] |= agree
    return np.asarray(np.array(within, bool) & repeated & ~twin)


def _within_drift(sighting: Sighting, odometry: Odometry, cov: Float) -> bool:
    i, j = sighting.earlier, sighting.later
    e = np.append(sighting.relation.z - (odometry.p[j] - odometry.p[i]), sighting.relation.yaw)
    return bool(e @ np.linalg.solve(odometry.cov(i, j) + cov, e) < GATE)


def _disagreement(a: Sighting, b: Sighting, odometry: Odometry, cov_a: Float, cov_b: Float) -> float:
    """Squared Mahalanobis distance between where ``b`` puts its later body and where ``a`` says that it is.

    Both say how the world in which the later keyframe was placed lies to that of the earlier one; between the two later
    keyframes, and between the two earlier ones, these worlds drifted.
    """
    R = rotation_z(a.relation.yaw)
    moved = R @ (odometry.p[b.later] - odometry.p[a.later])
    p_a, p_b = odometry.p[a.earlier] + a.relation.z, odometry.p[b.earlier] + b.relation.z
    error = np.append(p_a + moved - p_b, a.relation.yaw - b.relation.yaw)
    error[3] = np.arctan2(np.sin(error[3]), np.cos(error[3]))
    later = odometry.cov(a.later, b.later)
    later[:3] = R @ later[:3]
    later[:, :3] = later[:, :3] @ R.T
    cov = _seen_from_afar(cov_a, moved) + cov_b + later
    first, last = sorted((a.earlier, b.earlier))
    cov += _seen_from_afar(odometry.cov(first, last), p_b - odometry.p[last])
    return float(error @ np.linalg.solve(cov, error))


def _seen_from_afar(cov: Float, lever: Float) -> Float:
    """The covariance of [position yaw] of a point rigidly ``lever`` (3,) m away."""
    G = np.eye(4)
    G[0, 3], G[1, 3] = -lever[1], lever[0]
    return np.asarray(G @ cov @ G.T)
