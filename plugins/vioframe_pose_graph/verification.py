"""Are two keyframes views of one place, and how do their worlds lie to one another?

Two worlds share their vertical, as those do in which an odometry places a camera at two times:
``p_A = R_z(yaw) p_B + t``. Two points known in B and seen in A give yaw and t in closed form (Kukelova, Bujnak, Pajdla,
ACCV 2010); without gravity it takes three. No solution can disagree with gravity. RANSAC over such pairs finds where to
begin, least squares refines; ``docs/derivations/pose_graph.md``, section 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.resection import projected
from vioframe.geometry.so3 import rotation_z, yaw_of
from vioframe.geometry.two_view import rays
from vioframe.jit import kernel
from vioframe.types import Float, Int
from vioframe_pose_graph.matching import match
from vioframe_pose_graph.patches import Patches, Picture, laid_over
from vioframe_pose_graph.place import Place, View

REPROJECTION_PX = 3.0
"""Within which a point of one keyframe must be seen in the other to support a loop."""
# The same of a patch that was laid over the other's picture.
_ALIGNED_PX = 1.5
# Of the patches in sight, so many must say the same.
_LEAST_SHARE = 0.25
_MAX_DISTANCE, _RATIO = 64, 0.85
APART_PX = 10.0
_HYPOTHESES = 300
# The pairs know nothing of tilt, so their support is counted more generously than that of the fit.
_COARSE = 2.0
# As many standard deviations of where a point is seen are tolerated.
_TOLERATED = 3.0
_TILT_SIGMA, _MAX_TILT = np.radians(0.03), np.radians(2.0)
_LEAST_SIGMA = 0.1
# Degrees of freedom of Student's t, by which points and tilt are off.
_HEAVY = 4.0
_ITERATIONS, _CONVERGED = 10, 1e-4
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Points (M, 3) m of one keyframe and where the other saw them, ``xy`` (M, 2) on its z = 1 plane.

    ``depth_sigma`` (M,) is how well their distance in their own keyframe is known, as a part of it.
    ``side`` (M,): 0 for points of the later keyframe seen by the earlier one, 1 for the reverse. ``R_WC`` (2, 3, 3) and
    ``p_WC`` (2, 3) are the cameras that saw them, by side. ``pairs`` (M, 2) names them by their place in the earlier
    and the later keyframe: a match may occur on both sides.
    """

    points: Float
    depth_sigma: Float
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


def relate(earlier: Seen, later: Seen, focal_px: float, min_inliers: int) -> Relation | None:
    """The relation of two keyframes by the points they share, or None where those do not agree on one."""
    tolerance = REPROJECTION_PX / focal_px
    seen = correspondences(earlier, later, APART_PX / focal_px)
    if len(np.unique(seen.pairs[:, 1])) < min_inliers:
        return None
    support, yaw, t = ransac(seen, _draw_pairs(seen.side), _COARSE * tolerance)
    if support < min_inliers:
        return None
    R_AB, p_B = rotation_z(yaw), later[0].p_WB_seen
    return _refined(seen, R_AB, R_AB @ p_B + t, earlier[0].p_WB_seen, p_B, tolerance, min_inliers)


def aligned(
    relation: Relation, earlier: Seen, patches: Patches, later: Place, picture: Picture, min_inliers: int
) -> Relation:
    """``relation`` by the ``patches`` of the earlier keyframe found in the ``picture`` that the later one saw.

    The patches are of its known points. Where few of those in sight are found, the relation stays what corners say:
    from far elsewhere nothing looks as it did, and one in ten is found by chance.
    """
    place, view = earlier
    known = view.known
    points, xy = view.p_WF[known].astype(np.float64), view.xy_normalised[known].astype(np.float64)
    R_AB, p_AB, p_B = rotation_z(np.array(relation.yaw)), place.p_WB_seen + relation.z, later.p_WB_seen
    # Of the later camera in the world of the earlier one, and what that is from the earlier camera.
    R_AC, p_AC = R_AB @ later.R_WC, R_AB @ (later.p_WC - p_B) + p_AB
    inverse_depth = 1.0 / ((points - place.p_WC) @ place.R_WC[:, 2])
    guess, warp = laid_over(picture.model, xy, inverse_depth, R_AC.T @ place.R_WC, R_AC.T @ (place.p_WC - p_AC))
    again = patches.found_in(picture, guess, warp)
    found = np.flatnonzero(np.isfinite(again[:, 0]))
    seen = Correspondences(
        points=points[found],
        depth_sigma=view.depth_sigma[known[found]].astype(np.float64),
        xy=again[found],
        side=np.ones(len(found), np.int64),
        R_WC=np.stack([place.R_WC, later.R_WC]),
        p_WC=np.stack([place.p_WC, later.p_WC]),
        pairs=np.column_stack([known[found], found]),
    )
    tolerance = _ALIGNED_PX / picture.model.focal_px
    least = max(min_inliers, round(_LEAST_SHARE * np.count_nonzero(picture.model.contains(guess))))
    return _refined(seen, R_AB, p_AB, place.p_WB_seen, p_B, tolerance, least) or relation


def correspondences(earlier: Seen, later: Seen, apart: float) -> Correspondences:
    """Match what has a position in one keyframe with all that the other saw, both ways."""
    sides = []
    for source, target in ((later[1], earlier[1]), (earlier[1], later[1])):
        known = source.known
        xy = target.xy_normalised.astype(np.float64)
        found = match(source.descriptors[known], target.descriptors, xy, _MAX_DISTANCE, _RATIO, apart)
        known, found = known[found >= 0], found[found >= 0]
        sides.append((source.p_WF[known], source.depth_sigma[known], target.xy_normalised[found], known, found))
    (p_0, depth_0, xy_0, later_0, earlier_0), (p_1, depth_1, xy_1, earlier_1, later_1) = sides
    return Correspondences(
        points=np.concatenate([p_0, p_1]).astype(np.float64),
        depth_sigma=np.concatenate([depth_0, depth_1]).astype(np.float64),
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


def residuals(seen: Correspondences, p_B: Float, p_AB: Float, R_AB: Float) -> tuple[Float, Float, Float]:
    """(M, 2) on the z = 1 plane, their derivatives (M, 2, 6) by [p_AB, rotation], and where a standard deviation of its
    depth moves a point, (M, 2); NaN for points behind the camera.

    ``p_A = R_AB (p - p_B) + p_AB``, with ``R_AB <- Exp(rotation) R_AB`` and ``p_B`` (3,) the later body in its world.
    """
    forward = (seen.side == 0)[:, None]
    turned = np.where(forward, (seen.points - p_B) @ R_AB.T, seen.points - p_AB)
    there = np.where(forward, turned + p_AB, turned @ R_AB + p_B)
    R_CW = np.swapaxes(seen.R_WC, 1, 2)[seen.side]
    p_C = np.einsum("mij,mj->mi", R_CW, there - seen.p_WC[seen.side])
    d_there = np.concatenate([np.broadcast_to(np.eye(3), (len(turned), 3, 3)), -so3.hat(turned)], axis=2)
    d_there[seen.side == 1] = -R_AB.T @ d_there[seen.side == 1]
    away = seen.points - seen.p_WC[1 - seen.side]
    away = np.where(forward, away @ R_AB.T, away @ R_AB)
    xy, J = projected(p_C, R_CW @ np.concatenate([d_there, away[:, :, None]], axis=2))
    return xy - seen.xy, J[:, :, :6], J[:, :, 6] * seen.depth_sigma[:, None]


def _shortened(values: Float, along: Float, sigma: float) -> Float:
    """(M, 2, K) of errors of ``sigma``, whitened to it where a depth that is off adds more, ``along`` (M, 2)."""
    squared = np.sum(along**2, axis=1)
    rest = 1.0 / np.sqrt(1.0 + squared / sigma**2)
    part = np.einsum("mi,mik->mk", along, values) * ((1.0 - rest) / np.maximum(squared, _PARALLEL**2))[:, None]
    return np.asarray(values - along[:, :, None] * part[:, None, :])


def _refined(
    seen: Correspondences, R_AB: Float, p_AB: Float, p_A: Float, p_B: Float, tolerance: float, min_inliers: int
) -> Relation | None:
    """Iterate to the likeliest fit of what lies within ``tolerance``, which is decided anew each time.

    The tilt is free within what two attitudes of an odometry may disagree: forced to zero, half a degree of it would
    become several centimetres of position, as the points are metres away. A good odometry's agree to hundredths of a
    degree, and then the points need not say it. So points and tilt are off by Student's t: what most of them are off by
    weighs, and what is off by much more hardly (Lange, Little, Taylor, JASA 1989). Where attitudes disagree after all
    it is the earlier one that is wrong, as a rule: which way is down an odometry learns as it flies.

    How far away a point is is known to some per cent, so it counts less along the line on which a wrong depth would
    move it: the farther the two cameras are apart, the more.
    """
    sigma = tolerance / _TOLERATED
    for _ in range(_ITERATIONS):
        r, J, along = residuals(seen, p_B, p_AB, R_AB)
        off = _shortened(r[:, :, None], along, tolerance / _TOLERATED)[:, :, 0]
        inlier = np.linalg.norm(off, axis=1) < tolerance
        if inlier.sum() < min_inliers:
            return None
        white = _shortened(np.concatenate([r[:, :, None], J], axis=2)[inlier], along[inlier], sigma)
        squared = np.sum(white[:, :, 0] ** 2, axis=1)
        sigma = max(float(np.sqrt(np.mean(_weight(squared / sigma**2) * squared) / 2.0)), _LEAST_SIGMA * tolerance)
        white *= np.sqrt(_weight(squared / sigma**2))[:, None, None] / sigma
        tilt = so3.log(R_AB @ rotation_z(yaw_of(R_AB)).T)[:2]
        J_in = white[:, :, 1:].reshape(-1, 6)
        H, g = J_in.T @ J_in, J_in.T @ white[:, :, 0].ravel()
        upright = _weight(tilt @ tilt / _TILT_SIGMA**2) / _TILT_SIGMA**2
        H[[3, 4], [3, 4]] += upright
        g[3:5] += upright * tilt
        step = np.linalg.solve(H, -g)
        p_AB, R_AB = p_AB + step[:3], so3.exp(step[3:]) @ R_AB
        if np.abs(step).max() < _CONVERGED:
            break
    supporting = len(np.unique(seen.pairs[inlier], axis=0))
    if supporting < min_inliers or np.linalg.norm(tilt) > _MAX_TILT:
        return None
    which = [0, 1, 2, 5]
    cov = np.linalg.inv(H)[np.ix_(which, which)] * (_HEAVY + 4.0) / (_HEAVY + 2.0)  # weights say more than t does
    yaw = yaw_of(R_AB)
    z = rotation_z(yaw) @ R_AB.T @ (p_AB - p_A)  # by the later one's vertical
    return Relation(z, float(yaw), cov.astype(np.float64, copy=False), supporting)


def _weight(squared: Float) -> Float:
    """What two errors count for by Student's t that are together ``squared`` (...,) variances off."""
    return np.asarray((_HEAVY + 2.0) / (_HEAVY + squared))


def hypotheses(p_1: Float, p_2: Float, ray_1: Float, ray_2: Float, centre: Float) -> tuple[Float, Float]:
    """Pairs of points (H, 3) in B, seen along the rays (H, 3) from ``centre`` (H, 3) in A -> yaw (H, 2), t (H, 2, 3).

    Both points lie ahead along their rays in every solution; NaN where there is none.
    """
    n, d = np.cross(ray_1, ray_2), p_1 - p_2
    # R_z(yaw) d lies in the plane of the rays: a cos(yaw) + b sin(yaw) + c = 0.
    a, b, c = n[:, 0] * d[:, 0] + n[:, 1] * d[:, 1], n[:, 1] * d[:, 0] - n[:, 0] * d[:, 1], n[:, 2] * d[:, 2]
    amplitude, n2 = np.hypot(a, b), np.sum(n * n, axis=1)
    solvable = (amplitude > _PARALLEL) & (n2 > _PARALLEL**2) & (np.abs(c) <= amplitude)
    half = np.arccos(np.divide(-c, amplitude, out=np.full(len(c), np.nan), where=solvable))
    yaw = np.arctan2(b, a)[:, None] + half[:, None] * [-1.0, 1.0]
    R = rotation_z(yaw)
    # R d = depth_1 ray_1 - depth_2 ray_2: depth_1 from the cross product with ray_2, and vice versa.
    turned = (R @ d[:, None, :, None])[..., 0]
    depth_1, depth_2 = (
        np.sum(np.cross(turned, ray[:, None]) * n[:, None], axis=2) / np.where(solvable, n2, np.nan)[:, None]
        for ray in (ray_2, ray_1)
    )
    t = centre[:, None] + depth_1[..., None] * ray_1[:, None] - (R @ p_1[:, None, :, None])[..., 0]
    return np.where((depth_1 > 0.0) & (depth_2 > 0.0), yaw, np.nan), t


def ransac(seen: Correspondences, pairs: Int, tolerance: float) -> tuple[int, float, Float]:
    """The largest support that any of ``pairs`` (P, 2) finds, each of one side, and its yaw and t (3,).

    A point supports where it reprojects to within ``tolerance`` on the z = 1 plane.
    """
    i, j = pairs.T
    side = seen.side[i]
    rays_W = (seen.R_WC[seen.side] @ rays(seen.xy)[..., None])[..., 0]
    yaw, t = hypotheses(seen.points[i], seen.points[j], rays_W[i], rays_W[j], seen.p_WC[side])
    yaw, t = yaw.ravel(), t.reshape(-1, 3)
    from_A = np.repeat(side == 1, 2)  # these lead from A to B
    t[from_A] = _turned(-t[from_A], -yaw[from_A])
    yaw[from_A] *= -1.0
    support = supported(yaw, t, seen.points, seen.xy, seen.side, seen.R_WC, seen.p_WC, tolerance)
    best = int(np.argmax(support))
    return int(support[best]), float(yaw[best]), t[best]


@kernel
def supported(
    yaw: Float, t: Float, points: Float, xy: Float, side: Int, R_WC: Float, p_WC: Float, tolerance: float
) -> Int:
    """(H,) how many points reproject to within ``tolerance`` if the worlds lie to one another by yaw (H,) and t (H, 3).

    The points are those of :class:`Correspondences`.
    """
    support = np.zeros(len(yaw), np.int64)
    for h in range(len(yaw)):
        cos, sin = np.cos(yaw[h]), np.sin(yaw[h])
        for m in range(len(points)):
            x, y, z = points[m]
            if side[m] == 0:
                x, y, z = cos * x - sin * y + t[h, 0], sin * x + cos * y + t[h, 1], z + t[h, 2]
            else:
                x, y, z = x - t[h, 0], y - t[h, 1], z - t[h, 2]
                x, y = cos * x + sin * y, cos * y - sin * x
            R, p = R_WC[side[m]], p_WC[side[m]]
            x, y, z = x - p[0], y - p[1], z - p[2]
            depth = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
            off_x = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z - xy[m, 0] * depth
            off_y = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z - xy[m, 1] * depth
            support[h] += depth > 0.0 and off_x**2 + off_y**2 < (tolerance * depth) ** 2
    return support


def _turned(vectors: Float, yaw: Float) -> Float:
    """(N, 3), each turned by its ``yaw`` (N,) about z."""
    return np.asarray((rotation_z(yaw) @ vectors[..., None])[..., 0])
