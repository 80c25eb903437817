"""Where a camera of known tilt is, by RANSAC over pairs of points; ``docs/derivations/pose_graph.md``, section 1.

Two worlds share their vertical, as those do in which an odometry places a camera at two times:
``p_A = R_z(yaw) p_B + t``. Two points known in B and seen in A give yaw and t in closed form (Kukelova, Bujnak, Pajdla,
ACCV 2010); without gravity it takes three. No solution can disagree with gravity.
"""

from __future__ import annotations

import math

import numpy as np

from vioframe.jit import kernel
from vioframe.types import Float, Int

_PARALLEL = 1e-6


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
