"""Landmarks from tracks, and their places in the world."""

from __future__ import annotations

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.reprojection import GLOBAL_SHUTTER, Calibrated, Shutter, camera_at_row
from vioframe.geometry.triangulation import MIN_DEPTH_M, triangulate
from vioframe.jit import kernel


def triangulate_tracks(
    states: StateArrays, camera: Calibrated, seen: Bool, xy: Float, sigma: float, shutter: Shutter = GLOBAL_SHUTTER
) -> tuple[Bool, Float]:
    """Which of F tracks, ``seen`` (F, K) at ``xy`` (F, K, 2), have a trustworthy landmark, and [x y rho] (F, 3)."""
    R_WC, p_WC = camera_poses(states, camera)
    return _triangulate_all(R_WC, p_WC, states.R_WB, states.p_WB, camera, shutter, seen, xy, sigma)


def positions(states: StateArrays, camera: Calibrated, hosts: Int, landmarks: Float) -> Float:
    """p_WF (L, 3) m of [x y rho] (L, 3) in the frames ``hosts`` (L,)."""
    R_WC, p_WC = camera_poses(states, camera)
    p_C = np.column_stack([landmarks[:, :2], np.ones(len(landmarks))]) / landmarks[:, 2:]
    return (R_WC[hosts] @ p_C[..., None])[..., 0] + p_WC[hosts]


def in_hosts(states: StateArrays, camera: Calibrated, hosts: Int, p_WF: Float) -> tuple[Float, Bool]:
    """[x y rho] (L, 3) of points (L, 3) m in the frames ``hosts`` (L,), and which of them lie well in front (L,)."""
    R_WC, p_WC = camera_poses(states, camera)
    p_C = (np.swapaxes(R_WC[hosts], -1, -2) @ (p_WF - p_WC[hosts])[..., None])[..., 0]
    in_front = p_C[:, 2] > MIN_DEPTH_M
    z = np.where(in_front, p_C[:, 2], 1.0)
    return np.column_stack([p_C[:, 0] / z, p_C[:, 1] / z, 1.0 / z]), in_front


def in_images(states: StateArrays, camera: Calibrated, hosts: Int, landmarks: Float) -> tuple[Float, Float]:
    """Where [x y rho] (L, 3) of the frames ``hosts`` (L,) are in every frame: (L, K, 2) on the z = 1 plane, depth m.

    Points that are not in front are at the centre, at an infinite depth.
    """
    R_WC, p_WC = camera_poses(states, camera)
    return _in_images(R_WC, p_WC, positions(states, camera, hosts, landmarks))


def image_velocities(states: StateArrays, camera: Calibrated, gyro_B: Float, xy: Float, depth: Float) -> Float:
    """(L, K, 2) 1/s: how points at ``xy`` (L, K, 2), ``depth`` (L, K) m, move on the z = 1 plane of every frame.

    ``gyro_B`` (K, 3) rad/s are the readings at the frames. A fixed point moves by p_C' = -w x p_C - v as seen from a
    camera that turns by w and flies at v. The difference of two observations would have their noise in it, and as it
    multiplies a residual with the same noise, would pass for a time offset. It is that at the stamp: until the row of a
    rolling shutter is read it hardly changes.
    """
    rate_B, velocity_B = motion_in_body(states, gyro_B)
    velocity_B = velocity_B + np.cross(rate_B, camera.p_BC)
    return _image_velocities(rate_B @ camera.R_BC, velocity_B @ camera.R_BC, xy, depth)


def motion_in_body(states: StateArrays, gyro_B: Float) -> tuple[Float, Float]:
    """(K, 3) rad/s and (K, 3) m/s: how the body turns and flies in every frame, where ``gyro_B`` (K, 3) was read."""
    return gyro_B - states.bias_gyro_B, np.einsum("kji,kj->ki", states.R_WB, states.v_WB)


def camera_poses(states: StateArrays, camera: Calibrated) -> tuple[Float, Float]:
    """R_WC (K, 3, 3) and p_WC (K, 3)."""
    return states.R_WB @ camera.R_BC, states.R_WB @ camera.p_BC + states.p_WB


@kernel
def _in_images(R_WC: Float, p_WC: Float, p_WF: Float) -> tuple[Float, Float]:
    """What :func:`in_images` gives, of landmarks at ``p_WF`` (L, 3) m."""
    count, frames = len(p_WF), len(p_WC)
    xy, depth = np.zeros((count, frames, 2)), np.full((count, frames), np.inf)
    for f in range(frames):
        R = R_WC[f]
        for i in range(count):
            x, y, z = p_WF[i, 0] - p_WC[f, 0], p_WF[i, 1] - p_WC[f, 1], p_WF[i, 2] - p_WC[f, 2]
            ahead = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
            if ahead > MIN_DEPTH_M:
                depth[i, f] = ahead
                xy[i, f, 0] = (R[0, 0] * x + R[1, 0] * y + R[2, 0] * z) / ahead
                xy[i, f, 1] = (R[0, 1] * x + R[1, 1] * y + R[2, 1] * z) / ahead
    return xy, depth


@kernel
def _image_velocities(rate_C: Float, velocity_C: Float, xy: Float, depth: Float) -> Float:
    """What :func:`image_velocities` gives, of cameras that turn and fly at so much (K, 3), in their own axes."""
    count, frames = depth.shape
    out = np.empty((count, frames, 2))
    for f in range(frames):
        w_0, w_1, w_2 = rate_C[f, 0], rate_C[f, 1], rate_C[f, 2]
        v_0, v_1, v_2 = velocity_C[f, 0], velocity_C[f, 1], velocity_C[f, 2]
        for i in range(count):
            x, y, nearness = xy[i, f, 0], xy[i, f, 1], 1.0 / depth[i, f]
            along = w_1 * x - w_0 * y - v_2 * nearness
            out[i, f, 0] = w_2 * y - w_1 - v_0 * nearness - x * along
            out[i, f, 1] = w_0 - w_2 * x - v_1 * nearness - y * along
    return out


@kernel
def _triangulate_all(
    R_WC: Float,
    p_WC: Float,
    R_WB: Float,
    p_WB: Float,
    camera: Calibrated,
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
                f = views[j]
                camera_at_row(camera, shutter, i, f, R_rowC, p_rowC)
                R_views[j], p_views[j] = R_WB[f] @ R_rowC, R_WB[f] @ p_rowC + p_WB[f]
        ok, p_WF = triangulate(R_views, p_views, xy[i][views], sigma)
        if ok:
            host = views[0]
            p_C = R_WC[host].T @ (p_WF - p_WC[host])
            known[i] = True
            landmarks[i, 0], landmarks[i, 1], landmarks[i, 2] = p_C[0] / p_C[2], p_C[1] / p_C[2], 1.0 / p_C[2]
    return known, landmarks
