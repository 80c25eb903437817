"""Are two keyframes views of one place, and how do their worlds lie to one another?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.trajectory.alignment import rotation_z
from vioframe.types import Float, Int
from vioframe_pose_graph.hamming import match
from vioframe_pose_graph.place import Place
from vioframe_pose_graph.two_point import ransac

_MAX_DISTANCE, _RATIO = 64, 0.85
_APART_PX = 10.0
_HYPOTHESES = 300
_ITERATIONS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Points (M, 3) m of one keyframe and where the other saw them, ``xy`` (M, 2) on its z = 1 plane.

    ``side`` (M,): 0 for points of the later keyframe seen by the earlier one, 1 for the reverse. ``R_WC`` (2, 3, 3) and
    ``p_WC`` (2, 3) are the cameras that saw them, by side. ``pairs`` (M, 2) names them by their place in the earlier
    and the later keyframe: a match may occur on both sides.
    """

    points: Float
    xy: Float
    side: Int
    R_WC: Float
    p_WC: Float
    pairs: Int


@dataclass(frozen=True, slots=True, eq=False)
class Relation:
    """``p_A = R_z(yaw) p_B + t`` from the world B in which the later keyframe was placed to that of the earlier one.

    ``cov`` (4, 4) is that of [t yaw] with t taken at the later keyframe's body: ``p_AB`` (3,) m is that body in A.
    """

    yaw: float
    t: Float
    p_AB: Float
    cov: Float
    inliers: int


def relate(earlier: Place, later: Place, focal_px: float, reprojection_px: float, min_inliers: int) -> Relation | None:
    """The relation of two keyframes by the points they share, or None where those do not agree on one."""
    tolerance = reprojection_px / focal_px
    seen = correspondences(earlier, later, _APART_PX / focal_px)
    if len(np.unique(seen.pairs[:, 1])) < min_inliers:
        return None
    support, model = ransac(seen.points, seen.xy, seen.side, seen.R_WC, seen.p_WC, _draw_pairs(seen.side), tolerance)
    if support < min_inliers:
        return None
    return _refined(seen, model, later.p_WB, tolerance, min_inliers)


def correspondences(earlier: Place, later: Place, apart: float) -> Correspondences:
    """Match what has a position in one keyframe with all that the other saw, both ways."""
    sides = []
    for source, target in ((later, earlier), (earlier, later)):
        known = np.flatnonzero(np.isfinite(source.p_WF[:, 0]))
        found = match(source.descriptors[known], target.descriptors, target.xy_normalised, _MAX_DISTANCE, _RATIO, apart)
        known, found = known[found >= 0], found[found >= 0]
        sides.append((source.p_WF[known], target.xy_normalised[found], known, found))
    (p_0, xy_0, later_0, earlier_0), (p_1, xy_1, earlier_1, later_1) = sides
    return Correspondences(
        points=np.concatenate([p_0, p_1]),
        xy=np.concatenate([xy_0, xy_1]),
        side=np.repeat([0, 1], [len(p_0), len(p_1)]),
        R_WC=np.stack([earlier.R_WC, later.R_WC]),
        p_WC=np.stack([earlier.p_WC, later.p_WC]),
        pairs=np.concatenate([np.column_stack([earlier_0, later_0]), np.column_stack([earlier_1, later_1])]),
    )


def _draw_pairs(side: Int) -> Int:
    """(H, 2) pairs of different correspondences of one side: the same ones every time."""
    rng = np.random.default_rng(0)
    first = int(np.sum(side == 0))
    sizes = np.where(side == 0, first, len(side) - first)
    starts = np.where(side == 0, 0, first)
    i = rng.integers(len(side), size=_HYPOTHESES)
    i = i[sizes[i] > 1]
    step = 1 + rng.integers(0, sizes[i] - 1)
    return np.column_stack([i, starts[i] + (i - starts[i] + step) % sizes[i]])


def residuals(seen: Correspondences, yaw: float, t: Float) -> tuple[Float, Float]:
    """(M, 2) on the z = 1 plane, and (M, 2, 4) their derivatives by [t yaw]; NaN for points behind the camera."""
    R = rotation_z(yaw)
    dR = rotation_z(yaw + np.pi / 2)
    dR[2, 2] = 0.0
    forward = seen.side == 0
    there = np.where(forward[:, None], seen.points @ R.T + t, (seen.points - t) @ R)
    R_CW = np.swapaxes(seen.R_WC, 1, 2)[seen.side]
    p_C = np.einsum("mij,mj->mi", R_CW, there - seen.p_WC[seen.side])
    d_there = np.empty((len(forward), 3, 4))
    d_there[forward, :, :3], d_there[~forward, :, :3] = np.eye(3), -R.T
    d_there[:, :, 3] = np.where(forward[:, None], seen.points @ dR.T, (seen.points - t) @ dR)
    z = np.where(p_C[:, 2] > 0.0, p_C[:, 2], np.nan)
    xy = p_C[:, :2] / z[:, None]
    J_C = R_CW @ d_there
    J = (J_C[:, :2] - xy[:, :, None] * J_C[:, 2:]) / z[:, None, None]
    return xy - seen.xy, J


def _refined(seen: Correspondences, model: Float, p_B: Float, tolerance: float, min_inliers: int) -> Relation | None:
    """Iterate to the least-squares fit of what lies within ``tolerance``, which is decided anew each time."""
    yaw, t = float(model[0]), model[1:].copy()
    for _ in range(_ITERATIONS):
        r, J = residuals(seen, yaw, t)
        inlier = np.linalg.norm(r, axis=1) < tolerance
        if inlier.sum() < min_inliers:
            return None
        J_all = J[inlier].reshape(-1, 4)
        step = np.linalg.lstsq(J_all, -r[inlier].ravel(), rcond=None)[0]
        t, yaw = t + step[:3], yaw + float(step[3])
        if np.abs(step).max() < 1e-6:
            break
    supporting = len(np.unique(seen.pairs[inlier], axis=0))
    if supporting < min_inliers:
        return None
    # t is taken at the body, where it is not tied to the yaw by a lever as long as the body's way from the origin.
    lever = np.eye(4)
    lever[:3, 3] = rotation_z(yaw + np.pi / 2) @ np.append(p_B[:2], 0.0)
    variance = max(float(np.mean(r[inlier] ** 2)), (0.2 * tolerance) ** 2)
    cov = lever @ (variance * np.linalg.inv(J_all.T @ J_all)) @ lever.T
    return Relation(float(np.angle(np.exp(1j * yaw))), t, rotation_z(yaw) @ p_B + t, cov, supporting)
