"""Initialisation by a rig whose cameras see the same: depth, and with it scale, without waiting for parallax.

    choose keyframes -> gyro bias -> places in metres -> alignment -> bundle adjustment -> look ahead -> add the newest

It serves at rest and in motion alike, and whether cameras are exposed at once or take turns. Being over before much of
the calibration could show, it takes it as given, and leaves it to the slower methods where anything speaks against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, permutations

import numpy as np

from vioframe.arrays import Bool, Float
from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.landmarks import in_hosts
from vioframe.estimation.factors.problem import Variables
from vioframe.estimation.factors.reprojection import Calibrated
from vioframe.estimation.initialization.bundle_adjustment import adjusted, adjustment, covariance, variance_of
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
from vioframe.types import NS_PER_S, Calibration, CameraOnBody

# Frames of the window that are estimated, most tracks that are used, views each of them needs.
_KEYFRAMES, _MOST_LANDMARKS, _MIN_VIEWS = 8, 80, 4
# Frames that there must be, and those at the end that the rest has to predict.
_FEWEST_FRAMES, _HELD_OUT = 6, 2
_FARTHEST_M = 50.0
# Times what a start in motion must know velocity and gravity to: what follows has the depth to find the rest soon.
_LESS_SURE = 2.0
# Steps of the search for a frame's place, and where a landmark begins to be discounted, times the noise.
_STEPS, _WIDTH = 6, 5.0
# Rounds in which cameras that take turns find how far they have moved between their images, and to what.
_ROUNDS, _AGREED_M = 8, 1e-3


def initialise(packets: Sequence[Packet], calibration: Calibration, known: Float, doubted: Float) -> InitialEstimate:
    """Estimate from consecutive ``packets``, the newest last; raises :class:`RefusalError`.

    ``known`` (16 N, 16 N) is the covariance of the ``calibration``'s cameras if that is right, ``doubted`` if it may
    not be.
    """
    refuse_unless(len(packets) >= _FEWEST_FRAMES, f"{len(packets)} frames, {_FEWEST_FRAMES} are needed")
    cameras, noise = calibration.cameras, PIXEL_SIGMA / calibration.cameras[0].model.focal_px
    window = build_window(packets, _keyframes(packets), _MIN_VIEWS, _MOST_LANDMARKS, len(cameras))
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
    problem = adjustment(window.without_last(), imu[:-1], x, cameras, known)
    x = adjusted(problem, x, known, roughly=True).variables
    window, problem, solution = refined(window, problem, x, packets[-_HELD_OUT:], calibration, known)
    x = solution.variables
    _, other = adjusted_window(window, x, calibration, doubted, problem.sightings.sigma)
    contradicted = not solution.cost < other.cost + CONTRADICTED * variance_of(problem, x)
    refuse_unless(not contradicted, "images and readings contradict the calibration")
    cov = covariance(problem, solution, known)
    check_uncertainty(x.states, cov, np.inf, _LESS_SURE)
    keep = explained(problem, x)
    states, p_WF = from_zero(window.t_ns, x, cov, landmark_positions(problem, x)[keep])
    return InitialEstimate("stereo", states, window.ids[keep], p_WF)


def _keyframes(packets: Sequence[Packet]) -> list[int]:
    """Which of the ``packets``: some, spread over time, the newest, and after one camera's turn the next one's."""
    earlier = packets[:-_HELD_OUT]
    spread = spread_indices(np.array([tracks.t_ns for _, tracks in earlier]), _KEYFRAMES)
    turns = [k for k in spread if len(np.unique(earlier[k][1].camera)) == 1]
    return [*sorted({*spread, *(k + 1 for k in turns if k + 1 < len(earlier))}), len(packets) - 1]


def _placed(window: Window, R_B0B: Float, cameras: Sequence[CameraOnBody], sigma: float) -> tuple[Float, Float, Bool]:
    """p_B0B (K, 3), landmarks p_B0F (L, 3), and which of these two cameras saw (L,), given R_B0B (K, 3, 3).

    Cameras that take turns see what they share from two places. How far apart these are the path tells that follows
    from it: once more, then, until both agree.
    """
    v_B0, t_s = np.zeros(3), (window.t_ns - window.t_ns[0]) / NS_PER_S
    for _ in range(_ROUNDS):
        p_B0B, p_F, known, first = _walked(window, R_B0B, cameras, sigma, v_B0 * t_s[:, None])
        before, v_B0 = v_B0, p_B0B[first] / t_s[first]
        if not np.linalg.norm(v_B0 - before) * t_s[first - 1] > _AGREED_M:
            break
    return p_B0B, p_F, known


def _walked(
    window: Window, R_B0B: Float, cameras: Sequence[CameraOnBody], sigma: float, p_B0B: Float
) -> tuple[Float, Float, Bool, int]:
    """The same if the body is at ``p_B0B`` (K, 3) until two cameras have seen something; and the first frame after.

    One frame after another: its place is where the landmarks known by then are seen, and those new in it get their
    depth from two cameras, both in it, or one in that before.
    """
    N, L = len(cameras), len(window.ids)
    p_B0B, p_F, known, first = p_B0B.copy(), np.zeros((L, 3)), np.zeros(L, bool), 0
    for k, R in enumerate(R_B0B):
        seen, xy = window.seen[N * k : N * (k + 1)], window.xy[N * k : N * (k + 1)]
        if known.any():
            first = first or k
            p_B0B[k] = _place(R, p_B0B[k - 1], seen & known, xy, p_F, cameras, sigma)
        pairs = [(k, a, b) for a, b in combinations(range(N), 2)]
        pairs += [(k - 1, a, b) for a, b in permutations(range(N), 2) if k]
        for i, a, b in pairs:
            rows = np.flatnonzero(window.seen[N * i + a] & seen[b] & ~known)
            (R_1, p_1), (R_2, p_2) = (cameras[c].pose(R_B0B[j], p_B0B[j]) for c, j in ((a, i), (b, k)))
            xy_1 = window.xy[N * i + a, rows]
            rho = inverse_depths(xy_1, xy[b, rows], R_2.T @ R_1, R_2.T @ (p_1 - p_2))
            near = rho > 1.0 / _FARTHEST_M
            p_F[rows[near]] = rays(xy_1[near]) / rho[near, None] @ R_1.T + p_1
            known[rows[near]] = True
    refuse_unless(first, "nothing is seen by two cameras")
    return p_B0B, p_F, known, first


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
