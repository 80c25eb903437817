"""Residuals and Jacobians of the image measurements, in pixels, with distortion.

A landmark seen from a cloned body pose: ``p_B = R_WB^T (p_WF - p_WB)``, ``p_C = R_BC^T (p_B - p_BC)``, pixel =
distort(p_C). The camera is where the body's motion at the clone has taken it by the time of the pixel, which its time
offset and the row of a rolling shutter make another than the stamp (Li, Kim, Mourikis, "Real-time motion tracking on a
cellphone", ICRA 2013). Residuals are evaluated at the estimate, Jacobians at the first estimates of pose and landmark.
A sighting is from one of C views: of K clones by N cameras, those of a clone together. Derivation:
``docs/derivations/msckf.md``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vioframe.geometry.kernels import cross, distort, exp, hat, intrinsics_jacobian, product, turned, undistort
from vioframe.geometry.triangulation import triangulate
from vioframe.jit import kernel
from vioframe.types import Float, Int
from vioframe_msckf.state import FilterState

ACCEPTED, NOT_TRIANGULATED, GATED = 0, 1, 2


class Window(NamedTuple):
    """What the kernels need of the filter: K clones, where Jacobians are taken of them, and N cameras."""

    R_WB: Float
    p_WB: Float
    R_WB_first: Float
    p_WB_first: Float
    rate_B: Float
    velocity_B: Float
    R_BC: Float
    p_BC: Float
    camera_models: Int
    intrinsics: Float
    offset_s: Float
    readout_s: Float
    image_heights: Int
    of_camera: int
    """How many columns a camera has."""

    @staticmethod
    def of(state: FilterState, first_estimates: bool) -> Window:
        c = state.clones
        first = (c.R_WB_first, c.p_WB_first) if first_estimates else (c.R_WB, c.p_WB)
        cameras = state.camera_models, state.intrinsics, state.offset_s, state.readout_s, state.image_heights
        return Window(c.R_WB, c.p_WB, *first, c.rate_B, c.velocity_B, state.R_BC, state.p_BC, *cameras, state.of_camera)


def landmark_blocks(
    state: FilterState, clone: int, landmarks: Int, cameras: Int, xy: Float, first_estimates: bool
) -> tuple[Float, Float]:
    """Sightings (M, 2) px from a clone, of the state's ``landmarks`` (M,) by ``cameras`` (M,).

    Blocks (M, 2, 25) over [camera 16, clone 6, landmark 3] and residuals (2 M,).
    """
    p_first = state.p_WF_first if first_estimates else state.p_WF
    window = Window.of(state, first_estimates)
    blocks, residual = observations(window, clone, cameras, state.p_WF[landmarks], p_first[landmarks], xy)
    return blocks, residual.ravel()


@kernel
def _row(w, c, y):
    """Where the row ``y`` px is between the first of camera ``c`` and its last, from -1/2 to 1/2."""
    return (y + 0.5) / w.image_heights[c] - 0.5


@kernel
def _camera_at(w, k, c, y):
    """Camera ``c`` as seen from the body at clone ``k``, (3, 3) and (3,), when it saw a pixel at the height ``y``."""
    late_s = w.offset_s[c] + w.readout_s[c] * _row(w, c, y)
    if late_s == 0.0:
        return w.R_BC[c], w.p_BC[c]
    turn = exp(late_s * w.rate_B[k])
    return product(turn, w.R_BC[c]), turned(turn, w.p_BC[c]) + late_s * w.velocity_B[k]


@kernel
def _observe(w, k, c, p_WF, p_WF_first, xy, block, residual):
    """One sighting: ``block`` (2, 25) over [camera 16, clone 6, landmark 3] and ``residual`` (2,)."""
    model, intrinsics = w.camera_models[c], w.intrinsics[c]
    R_lateC, p_lateC = _camera_at(w, k, c, xy[1])
    p_C = turned(R_lateC.T, turned(w.R_WB[k].T, p_WF - w.p_WB[k]) - p_lateC)
    drawn, _ = distort(model, intrinsics, p_C[0] / p_C[2], p_C[1] / p_C[2])
    residual[0], residual[1] = xy[0] - drawn[0], xy[1] - drawn[1]

    R_first = w.R_WB_first[k]
    p_B = turned(R_first.T, p_WF_first - w.p_WB_first[k])
    p_C = turned(R_lateC.T, p_B - p_lateC)
    x, y = p_C[0] / p_C[2], p_C[1] / p_C[2]
    _, D = distort(model, intrinsics, x, y)
    J = np.empty((2, 3))
    for i in range(2):
        J[i, 0], J[i, 1] = D[i, 0] / p_C[2], D[i, 1] / p_C[2]
        J[i, 2] = -(D[i, 0] * x + D[i, 1] * y) / p_C[2]
    J_B = product(J, R_lateC.T)
    J_W = product(J_B, R_first.T)
    # By the point as seen from the body when the camera saw it.
    J_late = product(J, w.R_BC[c].T)
    p_late = turned(w.R_BC[c], p_C) + w.p_BC[c]
    block[:, 0:3] = product(J, hat(p_C))
    block[:, 3:6] = -J_late
    block[:, 6] = -turned(J_late, cross(w.rate_B[k], p_late)) - turned(J_B, w.velocity_B[k])
    block[:, 7:15] = intrinsics_jacobian(model, intrinsics, x, y)
    block[:, 15] = _row(w, c, xy[1]) * block[:, 6]
    block[:, 16:19] = product(J_B, hat(p_B))
    block[:, 19:22] = -J_W
    block[:, 22:25] = J_W


@kernel
def observations(w, clone, cameras, p_WF, p_WF_first, xy):
    """Landmarks (M, 3) seen by ``cameras`` (M,) at (M, 2) px from one clone: blocks (M, 2, 25), residuals (M, 2)."""
    m = len(xy)
    blocks = np.empty((m, 2, 25))
    residual = np.empty((m, 2))
    for i in range(m):
        _observe(w, clone, cameras[i], p_WF[i], p_WF_first[i], xy[i], blocks[i], residual[i])
    return blocks, residual


@kernel
def track_rows(w, xy, xy_normalised, seen, pixel_sigma):
    """One track (C,): whether it was triangulated, p_WF, H over [cameras, clones] and the landmark, residual."""
    K, N = len(w.p_WB), len(w.p_BC)
    views = np.flatnonzero(seen)
    m = len(views)
    R_WC = np.empty((m, 3, 3))
    p_WC = np.empty((m, 3))
    points = np.empty((m, 2))
    for i in range(m):
        v = views[i]
        k, c = v // N, v % N
        R_lateC, p_lateC = _camera_at(w, k, c, xy[v, 1])
        R_WC[i] = product(w.R_WB[k], R_lateC)
        p_WC[i] = turned(w.R_WB[k], p_lateC) + w.p_WB[k]
        points[i, 0], points[i, 1] = undistort(
            w.camera_models[c], w.intrinsics[c], xy[v, 0], xy[v, 1], xy_normalised[v, 0], xy_normalised[v, 1]
        )
    ok, p_WF = triangulate(R_WC, p_WC, points, pixel_sigma / w.intrinsics[0, 0])
    n = w.of_camera
    H = np.zeros((2 * m, n * N + 6 * K))
    H_f = np.empty((2 * m, 3))
    residual = np.empty(2 * m)
    if ok:
        block = np.empty((2, 25))
        for i in range(m):
            v = views[i]
            k, c = v // N, v % N
            _observe(w, k, c, p_WF, p_WF, xy[v], block, residual[2 * i : 2 * i + 2])
            H[2 * i : 2 * i + 2, n * c : n * c + n] = block[:, 0:n]
            H[2 * i : 2 * i + 2, n * N + 6 * k : n * N + 6 * k + 6] = block[:, 16:22]
            H_f[2 * i : 2 * i + 2] = block[:, 22:25]
    return ok, p_WF, H, H_f, residual


@kernel
def reduce_landmark(H, H_f, residual):
    """Rotate the rows by the orthogonal Q with Q H_f = [T; 0], T (3, 3) upper triangular, in place.

    Householder reflections. The rows below the third are free of the landmark: Mourikis and Roumeliotis, eq. (22)-(24).
    """
    m, n = H.shape
    v = np.empty(m)
    for j in range(3):
        norm = 0.0
        for i in range(j, m):
            norm += H_f[i, j] * H_f[i, j]
        norm = np.sqrt(norm)
        if norm == 0.0:
            continue
        alpha = -norm if H_f[j, j] > 0.0 else norm
        scale = 0.0
        for i in range(j, m):
            v[i] = H_f[i, j] - (alpha if i == j else 0.0)
            scale += v[i] * v[i]
        scale = 2.0 / scale
        for c in range(j, 3):
            dot = 0.0
            for i in range(j, m):
                dot += v[i] * H_f[i, c]
            for i in range(j, m):
                H_f[i, c] -= scale * dot * v[i]
        dots = v[j:m] @ H[j:m]
        for i in range(j, m):
            weight = scale * v[i]
            for c in range(n):
                H[i, c] -= weight * dots[c]
        dot = 0.0
        for i in range(j, m):
            dot += v[i] * residual[i]
        for i in range(j, m):
            residual[i] -= scale * dot * v[i]


@kernel
def distance_and_variances(S, H_f, residual, variance, cauchy):
    """Of M sightings of one landmark their squared Mahalanobis distance, and (M,) variances to take them with, px^2.

    Of their ``residual`` (2 M,) the state leaves ``S`` (2 M, 2 M) unsure, the landmark anything along ``H_f`` (2 M, 3),
    and ``variance`` is that of the noise. What is left when the landmark is where all agree best may be off by e of its
    standard deviations; a sighting then has 1 + (e / ``cauchy``)^2 times the ``variance``: Cauchy's loss.
    """
    m = len(residual)
    S = S.copy()
    for i in range(m):
        S[i, i] += variance
    rows = np.column_stack((H_f, residual))
    information = rows.T @ np.linalg.solve(S, rows)
    along = information[3, :3]
    distance = information[3, 3] - along @ np.linalg.solve(information[:3, :3], along)
    # The landmark taken out by least squares.
    rest = np.eye(m) - H_f @ np.linalg.solve(H_f.T @ H_f, np.ascontiguousarray(H_f.T))
    left, expected = rest @ residual, ((rest @ S) * rest).sum(axis=1)
    variances = np.empty(m // 2)
    for i in range(m // 2):
        x, y = left[2 * i], left[2 * i + 1]
        squared = 2.0 * (x * x + y * y) / (expected[2 * i] + expected[2 * i + 1])
        variances[i] = variance * (1.0 + squared / (cauchy * cauchy))
    return distance, variances


@kernel
def reduced_track(w, xy, xy_normalised, seen, P, pixel_sigma, cauchy):
    """One track (C,): whether it was triangulated, p_WF, H, H_f, residual, and its squared Mahalanobis distance.

    Below the third row there is no landmark. ``P`` is the covariance of the columns of H, [cameras, clones]; the noise
    of all rows is white with ``pixel_sigma``, to which those of sightings that do not fit are scaled.
    """
    ok, p_WF, H, H_f, residual = track_rows(w, xy, xy_normalised, seen, pixel_sigma)
    distance = 0.0
    if ok:
        distance, variances = distance_and_variances(H @ P @ H.T, H_f, residual, pixel_sigma**2, cauchy)
        for i in range(len(variances)):
            scale = pixel_sigma / np.sqrt(variances[i])
            for row in range(2 * i, 2 * i + 2):
                H[row] *= scale
                H_f[row] *= scale
                residual[row] *= scale
        reduce_landmark(H, H_f, residual)
    return ok, p_WF, H, H_f, residual, distance


@kernel
def msckf_rows(w, xy, xy_normalised, seen, P, pixel_sigma, cauchy, gate):
    """Triangulate (F, C) tracks, linearise them, project out the landmarks, and gate each at ``gate[dof]``.

    The stacked H and residual over [cameras, clones], whose covariance is ``P``; p_WF (F, 3); each one's Mahalanobis
    distance, squared, zero where there is none; each one's verdict.
    """
    F = len(seen)
    H_all = np.empty((2 * seen.sum(), len(P)))
    r_all = np.empty(2 * seen.sum())
    p_WF = np.empty((F, 3))
    distances = np.zeros(F)
    verdict = np.empty(F, dtype=np.int64)
    rows = 0
    for f in range(F):
        ok, p_WF[f], H, _, residual, distances[f] = reduced_track(
            w, xy[f], xy_normalised[f], seen[f], P, pixel_sigma, cauchy
        )
        if not ok:
            verdict[f] = NOT_TRIANGULATED
            continue
        H, residual = H[3:], residual[3:]
        if distances[f] > gate[len(residual)]:
            verdict[f] = GATED
            continue
        verdict[f] = ACCEPTED
        H_all[rows : rows + len(residual)] = H
        r_all[rows : rows + len(residual)] = residual
        rows += len(residual)
    return H_all[:rows], r_all[:rows], p_WF, distances, verdict
