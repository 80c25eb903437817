"""Landmarks from tracks, and their places in the world."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.reprojection import GLOBAL_SHUTTER, Calibrated, Shutter, camera_at_row
from vioframe.geometry.kernels import product, set_matrix, set_vector, turned
from vioframe.geometry.triangulation import MIN_DEPTH_M, triangulate
from vioframe.jit import kernel


def triangulate_tracks(
    states: StateArrays, cameras: Calibrated, seen: Bool, xy: Float, sigma: float, shutter: Shutter = GLOBAL_SHUTTER
) -> tuple[Bool, Float]:
    """Which of F tracks, ``seen`` (F, V) at ``xy`` (F, V, 2), have a trustworthy landmark, and [x y rho] (F, 3)."""
    R_WC, p_WC = camera_poses(states, cameras)
    return _triangulate_all(R_WC, p_WC, states.R_WB, states.p_WB, cameras, shutter, seen, xy, sigma)


def positions(states: StateArrays, cameras: Calibrated, hosts: Int, landmarks: Float) -> Float:
    """p_WF (L, 3) m of [x y rho] (L, 3) in the views ``hosts`` (L,)."""
    R_WC, p_WC = camera_poses(states, cameras)
    p_C = np.column_stack([landmarks[:, :2], np.ones(len(landmarks))]) / landmarks[:, 2:]
    return (R_WC[hosts] @ p_C[..., None])[..., 0] + p_WC[hosts]


def in_hosts(states: StateArrays, cameras: Calibrated, hosts: Int, p_WF: Float) -> tuple[Float, Bool]:
    """[x y rho] (L, 3) of points (L, 3) m in the views ``hosts`` (L,), and which of them lie well in front (L,)."""
    R_WC, p_WC = camera_poses(states, cameras)
    p_C = (np.swapaxes(R_WC[hosts], -1, -2) @ (p_WF - p_WC[hosts])[..., None])[..., 0]
    in_front = p_C[:, 2] > MIN_DEPTH_M
    z = np.where(in_front, p_C[:, 2], 1.0)
    return np.column_stack([p_C[:, 0] / z, p_C[:, 1] / z, 1.0 / z]), in_front


def in_images(states: StateArrays, cameras: Calibrated, hosts: Int, landmarks: Float) -> tuple[Float, Float]:
    """Where [x y rho] (L, 3) of the views ``hosts`` (L,) are in every view: (L, V, 2) on the z = 1 plane, depth m.

    Points that are not in front are at the centre, at an infinite depth.
    """
    R_WC, p_WC = camera_poses(states, cameras)
    return _in_images(R_WC, p_WC, positions(states, cameras, hosts, landmarks))


def image_velocities(states: StateArrays, cameras: Calibrated, gyro_B: Float, xy: Float, depth: Float) -> Float:
    """(L, V, 2) 1/s: how points at ``xy`` (L, V, 2), ``depth`` (L, V) m, move on the z = 1 plane of every view.

    ``gyro_B`` (K, 3) rad/s are the readings at the frames. A fixed point moves by p_C' = -w x p_C - v as seen from a
    camera that turns by w and flies at v. The difference of two observations would have their noise in it, and as it
    multiplies a residual with the same noise, would pass for a time offset. It is that at the stamp: until the row of a
    rolling shutter is read it hardly changes.
    """
    rate_B, velocity_B = motion_in_body(states, gyro_B)
    velocities_B = (velocity_B + np.cross(rate_B, p_BC) for p_BC in cameras.p_BC)
    rate_C = _by_view(rate_B @ R_BC for R_BC in cameras.R_BC)
    velocity_C = _by_view(v_B @ R_BC for v_B, R_BC in zip(velocities_B, cameras.R_BC, strict=True))
    return _image_velocities(rate_C, velocity_C, xy, depth)


def motion_in_body(states: StateArrays, gyro_B: Float) -> tuple[Float, Float]:
    """(K, 3) rad/s and (K, 3) m/s: how the body turns and flies in every frame, where ``gyro_B`` (K, 3) was read."""
    return gyro_B - states.bias_gyro_B, np.einsum("kji,kj->ki", states.R_WB, states.v_WB)


def camera_poses(states: StateArrays, cameras: Calibrated) -> tuple[Float, Float]:
    """R_WC (V, 3, 3) and p_WC (V, 3) of every view."""
    R_WC = _by_view(states.R_WB @ R_BC for R_BC in cameras.R_BC)
    return R_WC, _by_view(states.R_WB @ p_BC + states.p_WB for p_BC in cameras.p_BC)


def _by_view(of_cameras: Iterable[Float]) -> Float:
    """(V, ...) from (K, ...) of every camera."""
    stacked = np.stack(list(of_cameras), axis=1)
    return stacked.reshape(-1, *stacked.shape[2:])


@kernel
def _in_images(R_WC: Float, p_WC: Float, p_WF: Float) -> tuple[Float, Float]:
    """What :func:`in_images` gives, of landmarks at ``p_WF`` (L, 3) m."""
    count, views = len(p_WF), len(p_WC)
    xy, depth = np.zeros((count, views, 2)), np.full((count, views), np.inf)
    for v in range(views):
        R = R_WC[v]
        for i in range(count):
            x, y, z = p_WF[i, 0] - p_WC[v, 0], p_WF[i, 1] - p_WC[v, 1], p_WF[i, 2] - p_WC[v, 2]
            ahead = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
            if ahead > MIN_DEPTH_M:
                depth[i, v] = ahead
                xy[i, v, 0] = (R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) / ahead
                xy[i, v, 1] = (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) / ahead
    return xy, depth


@kernel
def _image_velocities(rate_C: Float, velocity_C: Float, xy: Float, depth: Float) -> Float:
    """What :func:`image_velocities` gives, of cameras that turn and fly at so much (V, 3), in their own axes."""
    count, views = depth.shape
    out = np.empty((count, views, 2))
    for v in range(views):
        w_0, w_1, w_2 = rate_C[v, 0], rate_C[v, 1], rate_C[v, 2]
        v_0, v_1, v_2 = velocity_C[v, 0], velocity_C[v, 1], velocity_C[v, 2]
        for i in range(count):
            x, y, nearness = xy[i, v, 0], xy[i, v, 1], 1.0 / depth[i, v]
            along = w_1 * x - w_0 * y - v_2 * nearness
            out[i, v, 0] = w_2 * y - w_1 - v_0 * nearness - x * along
            out[i, v, 1] = w_0 - w_2 * x - v_1 * nearness - y * along
    return out


@kernel
def _triangulate_all(
    R_WC: Float,
    p_WC: Float,
    R_WB: Float,
    p_WB: Float,
    cameras: Calibrated,
    shutter: Shutter,
    seen: Bool,
    xy: Float,
    sigma: float,
) -> tuple[Bool, Float]:
    R_rowC, p_rowC = np.empty((3, 3)), np.empty(3)
    count = len(seen)
    known = np.zeros(count, dtype=np.bool_)
    landmarks = np.zeros((count, 3))
    for i in range(count):
        views = np.flatnonzero(seen[i])
        R_views, p_views = R_WC[views], p_WC[views]
        if shutter.rolling:
            for j in range(len(views)):
                f = views[j] // len(cameras.p_BC)
                camera_at_row(cameras, shutter, i, views[j], R_rowC, p_rowC)
                set_matrix(R_views[j], product(R_WB[f], R_rowC))
                set_vector(p_views[j], turned(R_WB[f], p_rowC) + p_WB[f])
        ok, p_WF = triangulate(R_views, p_views, xy[i][views], sigma)
        if ok:
            host = views[0]
            p_C = turned(R_WC[host].T, p_WF - p_WC[host])
            known[i] = True
            landmarks[i, 0], landmarks[i, 1], landmarks[i, 2] = p_C[0] / p_C[2], p_C[1] / p_C[2], 1.0 / p_C[2]
    return known, landmarks
