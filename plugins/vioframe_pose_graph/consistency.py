"""Which sightings to believe: those that the odometry's drift can explain, and that agree with one another.

A place may have a twin: shelves, windows, a texture laid out again and again. Its picture verifies as well as the place
itself, so the picture cannot tell; where it would put the body can.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from vioframe.geometry import so3
from vioframe.types import NS_PER_S, Float, Int
from vioframe_pose_graph.drift import Odometry
from vioframe_pose_graph.recognition import Sighting

GATE = float(chi2.ppf(0.999, 4))
"""Squared Mahalanobis distance in [x y z yaw] that a correct sighting stays below in 999 of 1000 cases."""

_REPEAT_NS = 3 * NS_PER_S
# Points seen to a pixel place a camera to millimetres; but the points themselves were placed by the odometry, whose
# scale is off by some per cent.
_SIGMA_M, _SIGMA_PART, _SIGMA_YAW = 0.02, 0.02, np.radians(0.2)


def measured(sightings: Sequence[Sighting]) -> tuple[Int, Int, Float, Float, Float]:
    """Earlier and later keyframes (S,), z (S, 3) m, yaw (S,) rad and covariances (S, 4, 4) of [z yaw]."""
    relations = [sighting.relation for sighting in sightings]
    z = np.array([relation.z for relation in relations]).reshape(-1, 3)
    cov = np.array([relation.cov for relation in relations]).reshape(-1, 4, 4)
    variance = _SIGMA_M**2 + _SIGMA_PART**2 * np.sum(z**2, axis=1)
    cov[:, [0, 1, 2], [0, 1, 2]] += variance[:, None]
    cov[:, 3, 3] += _SIGMA_YAW**2
    return (
        np.array([sighting.earlier for sighting in sightings], np.int64),
        np.array([sighting.later for sighting in sightings], np.int64),
        z,
        np.array([relation.yaw for relation in relations]),
        cov,
    )


def within_drift(sightings: Sequence[Sighting], odometry: Odometry) -> NDArray[np.bool_]:
    """(S,) whether what a sighting says is as near to what the odometry says as its drift can explain."""
    i, j, z, yaw, cov = measured(sightings)
    error = np.column_stack([z - (odometry.p[j] - odometry.p[i]), yaw])
    return _squares(error, odometry.cov(i, j) + cov) < GATE


def agreed(sightings: Sequence[Sighting], odometry: Odometry, t_ns: Int) -> NDArray[np.bool_]:
    """(S,) whether another keyframe, soon before or after, says the same as a sighting, and its own nothing else."""
    later = np.array([sighting.later for sighting in sightings], np.int64)
    # The sightings come in the order of their later keyframes.
    ends = np.searchsorted(t_ns[later], t_ns[later] + _REPEAT_NS, side="right")
    a = np.repeat(np.arange(len(later)), ends - np.arange(len(later)) - 1)
    b = np.concatenate([np.empty(0, np.int64), *(np.arange(k + 1, end) for k, end in enumerate(ends))])
    agree = _disagreement(sightings, odometry, a, b) < GATE
    own = later[a] == later[b]
    repeated, contradicted = np.zeros(len(later), bool), np.zeros(len(later), bool)
    for side in (a, b):
        repeated[side[agree & ~own]] = True
        contradicted[side[~agree & own]] = True
    return np.asarray(repeated & ~contradicted)


def _disagreement(sightings: Sequence[Sighting], odometry: Odometry, a: Int, b: Int) -> Float:
    """(P,) squared Mahalanobis distances between where sightings ``b`` (P,) put their later bodies and where sightings
    ``a`` (P,), no later ones, say that these are.

    Both say how the world in which the later keyframe was placed lies to that of the earlier one; between the two later
    keyframes, and between the two earlier ones, these worlds drifted.
    """
    earlier, later, z, yaw, cov = measured(sightings)
    R = np.zeros((len(a), 4, 4))
    R[:, :3, :3] = so3.exp(np.column_stack([np.zeros((len(a), 2)), yaw[a]]))
    R[:, 3, 3] = 1.0
    moved = np.einsum("pij,pj->pi", R[:, :3, :3], odometry.p[later[b]] - odometry.p[later[a]])
    p_a, p_b = odometry.p[earlier[a]] + z[a], odometry.p[earlier[b]] + z[b]
    turned = np.arctan2(np.sin(yaw[a] - yaw[b]), np.cos(yaw[a] - yaw[b]))
    error = np.column_stack([p_a + moved - p_b, turned])
    between_later = R @ odometry.cov(later[a], later[b]) @ R.transpose(0, 2, 1)
    first, last = np.minimum(earlier[a], earlier[b]), np.maximum(earlier[a], earlier[b])
    between_earlier = _seen_from_afar(odometry.cov(first, last), p_b - odometry.p[last])
    return _squares(error, _seen_from_afar(cov[a], moved) + cov[b] + between_later + between_earlier)


def _seen_from_afar(cov: Float, lever: Float) -> Float:
    """The covariances (P, 4, 4) of [position yaw] of points rigidly ``lever`` (P, 3) m away."""
    G = np.broadcast_to(np.eye(4), cov.shape).copy()
    G[:, 0, 3], G[:, 1, 3] = -lever[:, 1], lever[:, 0]
    return np.asarray(G @ cov @ G.transpose(0, 2, 1))


def _squares(error: Float, cov: Float) -> Float:
    """(P,) squared Mahalanobis distances of (P, 4)."""
    return np.asarray(np.einsum("pi,pi->p", error, np.linalg.solve(cov, error[..., None])[..., 0]))
