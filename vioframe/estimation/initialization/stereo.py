"""Initialisation by a rig whose cameras see the same: depth, and with it scale, without waiting for parallax.

    choose keyframes -> gyro bias -> places in metres -> alignment -> bundle adjustment -> look ahead -> add the newest

It serves at rest and in motion alike. Being over before much of the calibration could show, it takes it as given, and
leaves it to the slower methods where anything speaks against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from vioframe.arrays import Bool, Float
from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.landmarks import in_hosts
from vioframe.estimation.factors.problem import Variables
from vioframe.estimation.factors.reprojection import Calibrated
from vioframe.estimation.initialization.bundle_adjustment import covariance
from vioframe.estimation.initialization.closed_form import align, rotations
from vioframe.estimation.initialization.dynamic import (
    CONTRADICTED,
    adjusted_window,
    check_uncertainty,
    explained,
    from_zero,
    landmark_positions,
    preintegrated,
    refined,
    require_tracks,
    variance_of,
    with_gyro_bias,
)
from vioframe.estimation.initialization.window import (
    BIAS_ACCEL_SIGMA,
    PIXEL_SIGMA,
    InitialEstimate,
    Packet,
    Window,
    build_window,
    refuse_unless,
    spread_indices,
)
from vioframe.geometry.so3 import level_rotation
from vioframe.geometry.two_view import inverse_depths, rays
from vioframe.types import Calibration, CameraOnBody

# Frames of the window that are estimated, tracks that are used, the longest first, views each of them needs.
_KEYFRAMES, _MOST_LANDMARKS, _MIN_VIEWS = 8, 80, 4
# Frames that there must be, and those at the end that the rest has to predict.
_FEWEST_FRAMES, _HELD_OUT = 6, 2
_FARTHEST_M = 50.0
# Times what a start in motion must know velocity and gravity to: what follows has the depth to find the rest soon.
_LESS_SURE = 2.0
# Steps of the search for a frame's place, and where a landmark begins to be discounted, times the noise.
_STEPS, _WIDTH = 6, 5.0


def initialise(packets: Sequence[Packet], calibration: Calibration, known: Float, doubted: Float) -> InitialEstimate:
    """Estimate from consecutive ``packets``, the newest last; raises :class:`RefusalError`.

    ``known`` (16 N, 16 N) is the covariance of the ``calibration``'s cameras if that is right, ``doubted`` if it may
    not be.
    """
    refuse_unless(len(packets) >= _FEWEST_FRAMES, f"{len(packets)} frames, {_FEWEST_FRAMES} are needed")
    t_ns = np.array([tracks.t_ns for _, tracks in packets])
    cameras, noise = calibration.cameras, PIXEL_SIGMA / calibration.cameras[0].model.focal_px
    chosen = [*spread_indices(t_ns[:-_HELD_OUT], _KEYFRAMES), len(packets) - 1]
    window = build_window(packets, chosen, _MIN_VIEWS, _MOST_LANDMARKS, len(cameras))
    require_tracks(window, "tracks are long enough")
    first, bias_gyro = with_gyro_bias(window.of_camera(0), np.zeros(3), calibration.only(0), noise)
    window = window.only(np.isin(window.ids, first.ids))

    imu = preintegrated(window, bias_gyro, np.zeros(3), calibration)
    R_B0B = rotations(imu)
    p_B0B, p_F, placed = _placed(window.without_last(), R_B0B[:-1], cameras, noise)
    window, p_F = window.only(placed), p_F[placed]
    require_tracks(window, "tracks were seen by two cameras, at a finite depth")
    arm = cameras[0].p_BC
    at_camera = p_B0B + R_B0B[:-1] @ arm - arm
    alignment = align(at_camera, imu[:-1], arm, BIAS_ACCEL_SIGMA, in_metres=True)
    hosts, calibrated = window.seen.argmax(axis=0), Calibrated.of(*cameras)
    path = StateArrays(R_B0B[:-1], p_B0B, *np.zeros((3, len(p_B0B), 3)))
    landmarks, ahead = in_hosts(path, calibrated, hosts, p_F)
    landmarks[:, :2] = window.xy[hosts, np.arange(len(hosts))]
    window, landmarks = window.only(ahead), landmarks[ahead]
    require_tracks(window, "tracks lie ahead")

    x = Variables(alignment.states.turned(level_rotation(-alignment.g_B0)), calibrated, landmarks)
    problem, solution = adjusted_window(window.without_last(), x, calibration, known, roughly=True)
    window, problem, solution = refined(window, problem, solution, packets[-_HELD_OUT:], calibration, known)
    x = solution.variables
    _, other = adjusted_window(window, x, calibration, doubted)
    contradicted = not solution.cost < other.cost + CONTRADICTED * variance_of(problem, x)
    refuse_unless(not contradicted, "images and readings contradict the calibration")
    cov = covariance(problem, x, known)
    check_uncertainty(x.states, cov, np.inf, _LESS_SURE)
    keep = explained(problem, x)
    states, p_WF = from_zero(window.t_ns, x, cov, landmark_positions(problem, x)[keep])
    return InitialEstimate("stereo", states, window.ids[keep], p_WF)


def _placed(window: Window, R_B0B: Float, cameras: Sequence[CameraOnBody], sigma: float) -> tuple[Float, Float, Bool]:
    """p_B0B (K, 3), landmarks p_B0F (L, 3), and which of these two cameras saw at once (L,), given R_B0B (K, 3, 3).

    One frame after another: its place is where the landmarks known by then are seen, and those new in it get their
    depth from two of its cameras.
    """
    N, L = len(cameras), len(window.ids)
    p_B0B, p_F, known = np.zeros((len(R_B0B), 3)), np.zeros((L, 3)), np.zeros(L, bool)
    for k, R in enumerate(R_B0B):
        views = slice(N * k, N * (k + 1))
        seen, xy = window.seen[views], window.xy[views]
        if k:
            p_B0B[k] = _place(R, p_B0B[k - 1], seen & known, xy, p_F, cameras, sigma)
        for a, b in combinations(range(N), 2):
            one, rows = cameras[a], np.flatnonzero(seen[a] & seen[b] & ~known)
            rho = inverse_depths(xy[a, rows], xy[b, rows], *one.seen_from(cameras[b]))
            near = rho > 1.0 / _FARTHEST_M
            p_C = rays(xy[a, rows[near]]) / rho[near, None]
            p_F[rows[near]] = (p_C @ one.R_BC.T + one.p_BC) @ R.T + p_B0B[k]
            known[rows[near]] = True
    return p_B0B, p_F, known


def _place(
    R_B0B: Float, p: Float, use: Bool, xy: Float, p_F: Float, cameras: Sequence[CameraOnBody], sigma: float
) -> Float:
    """p_B0B (3,) of a frame, near ``p``, whose cameras see the landmarks ``p_F`` (L, 3), ``use`` (N, L), at ``xy``.

    Robust least squares of the distances across the rays.
    """
    refuse_unless(use.sum() >= _MIN_VIEWS, "too few landmarks are seen by two cameras")
    for _ in range(_STEPS):
        H, b = np.zeros((3, 3)), np.zeros(3)
        for c, camera in enumerate(cameras):
            own = use[c]
            ray = rays(xy[c, own]) @ (R_B0B @ camera.R_BC).T
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            to_F = p_F[own] - p - R_B0B @ camera.p_BC
            off = to_F - (to_F * ray).sum(axis=1, keepdims=True) * ray
            squared = np.maximum((to_F * to_F).sum(axis=1), 1e-6)
            weight = 1.0 / (squared + (off * off).sum(axis=1) / (_WIDTH * sigma) ** 2)
            H += weight.sum() * np.eye(3) - (weight[:, None] * ray).T @ ray
            b += (weight[:, None] * off).sum(axis=0)
        p = p + np.linalg.solve(H, b)
    return p
