"""Are two keyframes views of one place, and how do their worlds lie to one another?

Two worlds share their vertical, as those do in which an odometry places a camera at two times:
``p_A = R_z(yaw) p_B + t``. Two points known in B and seen in A give yaw and t in closed form (Kukelova, Bujnak, Pajdla,
ACCV 2010); without gravity it takes three. No solution can disagree with gravity. RANSAC over such pairs finds where to
begin, least squares refines; ``docs/derivations/pose_graph.md``, section 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.jit import kernel
from vioframe.types import Float, Int
from vioframe_pose_graph.matching import match
from vioframe_pose_graph.place import Place, View

_MAX_DISTANCE, _RATIO = 64, 0.85
_APART_PX = 10.0
_HYPOTHESES = 300
# The pairs know nothing of tilt, so their support is counted more generously than that of the fit.
_COARSE = 2.0
_TILT_SIGMA, _MAX_TILT = np.radians(0.5), np.radians(2.0)
_LEAST_SIGMA = 0.2
_ITERATIONS, _CONVERGED = 10, 1e-6
_PARALLEL = 1e-6


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
    """How the world B, in which the later keyframe was placed, lies to that of the earlier one, A.

    ``z`` (3,) m leads from the earlier body to the later one, along the axes of A, and B is turned by ``yaw`` rad;
    ``cov`` (4, 4) is that of [z yaw], ``inliers`` the number of points that say so.
    """

    z: Float
    yaw: float
    cov: Float
    inliers: int


Seen = tuple[Place, View]


def relate(earlier: Seen, later: Seen, focal_px: float, reprojection_px: float, min_inliers: int) -> Relation | None:
    """The relation of two keyframes by the points they share, or None where those do not agree on one."""
    tolerance = reprojection_px / focal_px
    seen = correspondences(earlier, later, _APART_PX / focal_px)
    if len(np.unique(seen.pairs[:, 1])) < min_inliers:
        return None
    support, model = ransac(
        seen.points, seen.xy, seen.side, seen.R_WC, seen.p_WC, _draw_pairs(seen.side), _COARSE * tolerance
    )
    if support < min_inliers:
        return None
    return _refined(seen, model, earlier[0].p_WB_seen, later[0].p_WB_seen, tolerance, min_inliers)


def correspondences(earlier: Seen, later: Seen, apart: float) -> Correspondences:
    """Match what has a position in one keyframe with all that the other saw, both ways."""
    sides = []
    for source, target in ((later[1], earlier[1]), (earlier[1], later[1])):
        known = np.flatnonzero(np.isfinite(source.p_WF[:, 0]))
        xy = target.xy_normalised.astype(np.float64)
        found = match(source.descriptors[known], target.descriptors, xy, _MAX_DISTANCE, _RATIO, apart)
        known, found = known[found >= 0], found[found >= 0]
        sides.append((source.p_WF[known], target.xy_normalised[found], known, found))
    (p_0, xy_0, later_0, earlier_0), (p_1, xy_1, earlier_1, later_1) = sides
    return Correspondences(
        points=np.concatenate([p_0, p_1]).astype(np.float64),
        xy=np.concatenate([xy_0, xy_1]).astype(np.float64),
        side=np.repeat([0, 1], [len(p_0), len(p_1)]),
        R_WC=np.stack([earlier[0].R_WC, later[0].R_WC]),
        p_WC=np.stack([earlier[0].p_WC, later[0].p_WC]),
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


def residuals(seen: Correspondences, p_B: Float, p_AB: Float, R_AB: Float) -> tuple[Float, Float]:
    """(M, 2) on the z = 1 plane, and (M, 2, 6) their derivatives by [p_AB, rotation]; NaN for points behind the camera.

    ``p_A = R_AB (p - p_B) + p_AB``, with ``R_AB <- Exp(rotation) R_AB`` and ``p_B`` (3,) the later body in its world.
    """
    forward = (seen.side == 0)[:, None]
    turned = np.where(forward, (seen.points - p_B) @ R_AB.T, seen.points - p_AB)
    there = np.where(forward, turned + p_AB, turned @ R_AB + p_B)
    R_CW = np.swapaxes(seen.R_WC, 1, 2)[seen.side]
    p_C = np.einsum("mij,mj->mi", R_CW, there - seen.p_WC[seen.side])
    d_there = np.concatenate([np.broadcast_to(np.eye(3), (len(turned), 3, 3)), -so3.hat(turned)], axis=2)
    d_there[seen.side == 1] = -R_AB.T @ d_there[seen.side == 1]
    z = np.where(p_C[:, 2] > 0.0, p_C[:, 2], np.nan)
    xy = p_C[:, :2] / z[:, None]
    J_C = R_CW @ d_there
    J = (J_C[:, :2] - xy[:, :, None] * J_C[:, 2:]) / z[:, None, None]
    return xy - seen.xy, J


def _refined(
    seen: Correspondences, model: Float, p_A: Float, p_B: Float, tolerance: float, min_inliers: int
) -> Relation | None:
    """Iterate to the least-squares fit of what lies within ``tolerance``, which is decided anew each time.

    The tilt is free within what two attitudes of an odometry may disagree: forced to zero, half a degree of it would
    become several centimetres of position, as the points are metres away.
    """
    R_AB = rotation_z(float(model[0]))
    p_AB = R_AB @ p_B + model[1:]
    for _ in range(_ITERATIONS):
        r, J = residuals(seen, p_B, p_AB, R_AB)
        inlier = np.linalg.norm(r, axis=1) < tolerance
        if inlier.sum() < min_inliers:
            return None
        variance = max(float(np.mean(r[inlier] ** 2)), (_LEAST_SIGMA * tolerance) ** 2)
        tilt = so3.log(R_AB @ rotation_z(float(yaw_of(R_AB))).T)[:2]
        J_in = J[inlier].reshape(-1, 6)
        H, g = J_in.T @ J_in / variance, J_in.T @ r[inlier].ravel() / variance
        H[[3, 4], [3, 4]] += 1.0 / _TILT_SIGMA**2
        g[3:5] += tilt / _TILT_SIGMA**2
        step = np.linalg.solve(H, -g)
        p_AB, R_AB = p_AB + step[:3], so3.exp(step[3:]) @ R_AB
        if np.abs(step).max() < _CONVERGED:
            break
    supporting = len(np.unique(seen.pairs[inlier], axis=0))
    if supporting < min_inliers or np.linalg.norm(tilt) > _MAX_TILT:
        return None
    which = [0, 1, 2, 5]
    return Relation(p_AB - p_A, float(yaw_of(R_AB)), np.linalg.inv(H)[np.ix_(which, which)], supporting)


@kernel
def solve(p_1: Float, p_2: Float, ray_1: Float, ray_2: Float, centre: Float) -> tuple[int, Float]:
    """Two points (3,) in B, seen along the rays (3,) from ``centre`` (3,) in A -> number of solutions, (2, 4) [yaw t].

    Both points lie ahead along their rays in every solution.
    """
    out = np.zeros((2, 4))
    d = p_1 - p_2
    n = np.array(
        [
            ray_1[1] * ray_2[2] - ray_1[2] * ray_2[1],
            ray_1[2] * ray_2[0] - ray_1[0] * ray_2[2],
            ray_1[0] * ray_2[1] - ray_1[1] * ray_2[0],
        ]
    )
    # R_z(yaw) d lies in the plane of the rays: a cos(yaw) + b sin(yaw) + c = 0.
    a = n[0] * d[0] + n[1] * d[1]
    b = n[1] * d[0] - n[0] * d[1]
    c = n[2] * d[2]
    amplitude = math.sqrt(a * a + b * b)
    n2 = n[0] * n[0] + n[1] * n[1] + n[2] * n[2]
    if amplitude < _PARALLEL or n2 < _PARALLEL * _PARALLEL or abs(c) > amplitude:
        return 0, out
    middle, half = math.atan2(b, a), math.acos(-c / amplitude)
    count = 0
    for sign in (-1.0, 1.0):
        yaw = middle + sign * half
        cos, sin = math.cos(yaw), math.sin(yaw)
        x, y, z = cos * d[0] - sin * d[1], sin * d[0] + cos * d[1], d[2]
        # [x y z] = depth_1 ray_1 - depth_2 ray_2: depth_1 from the cross product with ray_2, and vice versa.
        depth_1 = (
            (y * ray_2[2] - z * ray_2[1]) * n[0]
            + (z * ray_2[0] - x * ray_2[2]) * n[1]
            + (x * ray_2[1] - y * ray_2[0]) * n[2]
        ) / n2
        depth_2 = (
            (y * ray_1[2] - z * ray_1[1]) * n[0]
            + (z * ray_1[0] - x * ray_1[2]) * n[1]
            + (x * ray_1[1] - y * ray_1[0]) * n[2]
        ) / n2
        if depth_1 <= 0.0 or depth_2 <= 0.0:
            continue
        out[count, 0] = yaw
        out[count, 1] = centre[0] + depth_1 * ray_1[0] - (cos * p_1[0] - sin * p_1[1])
        out[count, 2] = centre[1] + depth_1 * ray_1[1] - (sin * p_1[0] + cos * p_1[1])
        out[count, 3] = centre[2] + depth_1 * ray_1[2] - p_1[2]
        count += 1
    return count, out


@kernel
def reprojection(model: Float, p: Float, xy: Float, side: int, R_WC: Float, p_WC: Float) -> float:
    """Squared distance on the z = 1 plane of a point (3,) from where it was seen; infinite for a point behind.

    ``side`` 0: the point is in B and the camera, ``R_WC`` (3, 3) and ``p_WC`` (3,), in A; 1: the other way round.
    """
    cos, sin = math.cos(model[0]), math.sin(model[0])
    if side == 0:
        x = cos * p[0] - sin * p[1] + model[1] - p_WC[0]
        y = sin * p[0] + cos * p[1] + model[2] - p_WC[1]
        z = p[2] + model[3] - p_WC[2]
    else:
        dx, dy = p[0] - model[1], p[1] - model[2]
        x = cos * dx + sin * dy - p_WC[0]
        y = -sin * dx + cos * dy - p_WC[1]
        z = p[2] - model[3] - p_WC[2]
    depth = R_WC[0, 2] * x + R_WC[1, 2] * y + R_WC[2, 2] * z
    if depth <= 0.0:
        return np.inf
    u = (R_WC[0, 0] * x + R_WC[1, 0] * y + R_WC[2, 0] * z) / depth - xy[0]
    v = (R_WC[0, 1] * x + R_WC[1, 1] * y + R_WC[2, 1] * z) / depth - xy[1]
    return float(u * u + v * v)


@kernel
def ransac(
    points: Float, xy: Float, side: Int, R_WC: Float, p_WC: Float, pairs: Int, tolerance: float
) -> tuple[int, Float]:
    """Try each of ``pairs`` (P, 2), both of one side -> the largest support found and its [yaw t] (4,).

    ``points`` (M, 3) are those of side 0 in B and of side 1 in A, seen at ``xy`` (M, 2) in the camera of the other
    side; ``R_WC`` (2, 3, 3) and ``p_WC`` (2, 3) are the camera in A and the camera in B.
    """
    most = 0
    best = np.zeros(4)
    for k in range(len(pairs)):
        i, j = pairs[k]
        s = side[i]
        ray_i = R_WC[s] @ np.array([xy[i, 0], xy[i, 1], 1.0])
        ray_j = R_WC[s] @ np.array([xy[j, 0], xy[j, 1], 1.0])
        count, models = solve(points[i], points[j], ray_i, ray_j, p_WC[s])
        for c in range(count):
            model = models[c]
            if s == 1:  # it leads from A to B
                cos, sin = math.cos(model[0]), math.sin(model[0])
                x, y = -cos * model[1] - sin * model[2], sin * model[1] - cos * model[2]
                model = np.array([-model[0], x, y, -model[3]])
            support = 0
            for m in range(len(points)):
                error = reprojection(model, points[m], xy[m], side[m], R_WC[side[m]], p_WC[side[m]])
                support += error < tolerance * tolerance
            if support > most:
                most, best = support, model
    return most, best
