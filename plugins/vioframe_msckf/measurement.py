"""Residuals and Jacobians of the image measurements, in pixels, with distortion.

A landmark seen from a cloned body pose: ``p_B = R_WB^T (p_WF - p_WB)``, ``p_C = R_BC^T (p_B - p_BC)``, pixel =
distort(p_C). With a rolling shutter the camera is where the body's motion at the clone has taken it by the time of the
pixel's row (Li, Kim, Mourikis, "Real-time motion tracking on a cellphone", ICRA 2013). Residuals are evaluated at the
estimate, Jacobians at the first estimates of pose and landmark. Derivation: ``docs/derivations/msckf.md``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vioframe.geometry.kernels import cross, distort, exp, hat, intrinsics_jacobian, product, turned, undistort
from vioframe.geometry.triangulation import triangulate
from vioframe.jit import kernel
from vioframe.types import Float
from vioframe_msckf.state import FilterState

ACCEPTED, NOT_TRIANGULATED, GATED = 0, 1, 2


class Window(NamedTuple):
    """What the kernels need of the filter: clones, where Jacobians are taken of them, and the camera."""

    R_WB: Float
    p_WB: Float
    R_WB_first: Float
    p_WB_first: Float
    rate_B: Float
    velocity_B: Float
    R_BC: Float
    p_BC: Float
    camera_model: int
    intrinsics: Float
    readout_s: float
    image_height: int
    calibrated: int
    """How many columns the calibration has."""

    @staticmethod
    def of(state: FilterState, first_estimates: bool) -> Window:
        c = state.clones
        first = (c.R_WB_first, c.p_WB_first) if first_estimates else (c.R_WB, c.p_WB)
        camera = state.R_BC, state.p_BC, state.camera_model, state.intrinsics, state.readout_s, state.image_height
        calibrated = state.calibrated.stop - state.calibrated.start
        return Window(c.R_WB, c.p_WB, *first, c.rate_B, c.velocity_B, *camera, calibrated)


def landmark_blocks(state: FilterState, clone: int, xy: Float, first_estimates: bool) -> tuple[Float, Float]:
    """Measurements (M, 2) px of the state's landmarks from one clone: blocks (M, 2, 25) and residuals (2 M,)."""
    p_first = state.p_WF_first if first_estimates else state.p_WF
    blocks, residual = observations(Window.of(state, first_estimates), clone, state.p_WF, p_first, xy)
    return blocks, residual.ravel()


@kernel
def _row(w, y):
    """Where the row ``y`` px is between the first and the last, from -1/2 to 1/2: its part of the readout."""
    return (y + 0.5) / w.image_height - 0.5


@kernel
def _camera_at_row(w, c, y):
    """The camera as seen from the body at a clone, (3, 3) and (3,), at the time of the row ``y`` px."""
    if w.readout_s == 0.0:
        return w.R_BC, w.p_BC
    late_s = w.readout_s * _row(w, y)
    turn = exp(late_s * w.rate_B[c])
    return product(turn, w.R_BC), turned(turn, w.p_BC) + late_s * w.velocity_B[c]


@kernel
def _observe(w, c, p_WF, p_WF_first, xy, block, residual):
    """One observation: ``block`` (2, 25) over [calibration 16, clone 6, landmark 3] and ``residual`` (2,)."""
    R_rowC, p_rowC = _camera_at_row(w, c, xy[1])
    p_C = turned(R_rowC.T, turned(w.R_WB[c].T, p_WF - w.p_WB[c]) - p_rowC)
    drawn, _ = distort(w.camera_model, w.intrinsics, p_C[0] / p_C[2], p_C[1] / p_C[2])
    residual[0], residual[1] = xy[0] - drawn[0], xy[1] - drawn[1]

    R_first = w.R_WB_first[c]
    p_B = turned(R_first.T, p_WF_first - w.p_WB_first[c])
    p_C = turned(R_rowC.T, p_B - p_rowC)
    x, y = p_C[0] / p_C[2], p_C[1] / p_C[2]
    _, D = distort(w.camera_model, w.intrinsics, x, y)
    J = np.empty((2, 3))
    for i in range(2):
        J[i, 0], J[i, 1] = D[i, 0] / p_C[2], D[i, 1] / p_C[2]
        J[i, 2] = -(D[i, 0] * x + D[i, 1] * y) / p_C[2]
    J_B = product(J, R_rowC.T)
    J_W = product(J_B, R_first.T)
    # By the point as seen from the body at the time of the row.
    J_row = J_B if w.readout_s == 0.0 else product(J, w.R_BC.T)
    block[:, 0:3] = product(J, hat(p_C))
    block[:, 3:6] = -J_row
    block[:, 6] = 0.0  # the time offset acts through the clone
    block[:, 7:15] = intrinsics_jacobian(w.camera_model, w.intrinsics, x, y)
    if w.calibrated > 15:
        p_row = turned(w.R_BC, p_C) + w.p_BC
        block[:, 15] = -_row(w, xy[1]) * (turned(J_row, cross(w.rate_B[c], p_row)) + turned(J_B, w.velocity_B[c]))
    block[:, 16:19] = product(J_B, hat(p_B))
    block[:, 19:22] = -J_W
    block[:, 22:25] = J_W


@kernel
def observations(w, clone, p_WF, p_WF_first, xy):
    """Landmarks (M, 3) seen at (M, 2) px from one clone: blocks (M, 2, 25) and residuals (M, 2)."""
    m = len(xy)
    blocks = np.empty((m, 2, 25))
    residual = np.empty((m, 2))
    for i in range(m):
        _observe(w, clone, p_WF[i], p_WF_first[i], xy[i], blocks[i], residual[i])
    return blocks, residual


@kernel
def track_rows(w, xy, xy_normalised, seen, pixel_sigma):
    """One track (C,): whether it was triangulated, p_WF, H over [calibration, clones] and the landmark, residual."""
    C = len(seen)
    clones = np.flatnonzero(seen)
    m = len(clones)
    R_WC = np.empty((m, 3, 3))
    p_WC = np.empty((m, 3))
    points = np.empty((m, 2))
    for i in range(m):
        c = clones[i]
        R_rowC, p_rowC = _camera_at_row(w, c, xy[c, 1])
        R_WC[i] = product(w.R_WB[c], R_rowC)
        p_WC[i] = turned(w.R_WB[c], p_rowC) + w.p_WB[c]
        points[i, 0], points[i, 1] = undistort(
            w.camera_model, w.intrinsics, xy[c, 0], xy[c, 1], xy_normalised[c, 0], xy_normalised[c, 1]
        )
    ok, p_WF = triangulate(R_WC, p_WC, points, pixel_sigma / w.intrinsics[0])
    n = w.calibrated
    H = np.zeros((2 * m, n + 6 * C))
    H_f = np.empty((2 * m, 3))
    residual = np.empty(2 * m)
    if ok:
        block = np.empty((2, 25))
        for i in range(m):
            c = clones[i]
            _observe(w, c, p_WF, p_WF, xy[c], block, residual[2 * i : 2 * i + 2])
            H[2 * i : 2 * i + 2, 0:n] = block[:, 0:n]
            H[2 * i : 2 * i + 2, n + 6 * c : n + 6 * c + 6] = block[:, 16:22]
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
def mahalanobis(H, residual, P, variance):
    """residual^T (H P H^T + variance I)^-1 residual."""
    S = H @ P @ H.T
    for i in range(len(S)):
        S[i, i] += variance
    return residual @ np.linalg.solve(S, residual)


@kernel
def msckf_rows(w, xy, xy_normalised, seen, P, pixel_sigma, gate):
    """Triangulate (F, C) tracks, linearise them, project out the landmarks, and gate each at ``gate[dof]``.

    The stacked H and residual over [calibration, clones], whose covariance is ``P``; p_WF (F, 3); each one's verdict.
    """
    F, C = seen.shape
    n = w.calibrated + 6 * C
    H_all = np.empty((2 * seen.sum(), n))
    r_all = np.empty(2 * seen.sum())
    p_WF = np.empty((F, 3))
    verdict = np.empty(F, dtype=np.int64)
    rows = 0
    for f in range(F):
        ok, p_WF[f], H, H_f, residual = track_rows(w, xy[f], xy_normalised[f], seen[f], pixel_sigma)
        if not ok:
            verdict[f] = NOT_TRIANGULATED
            continue
        reduce_landmark(H, H_f, residual)
        H, residual = H[3:], residual[3:]
        if mahalanobis(H, residual, P, pixel_sigma**2) > gate[len(residual)]:
            verdict[f] = GATED
            continue
        verdict[f] = ACCEPTED
        H_all[rows : rows + len(residual)] = H
        r_all[rows : rows + len(residual)] = residual
        rows += len(residual)
    return H_all[:rows], r_all[:rows], p_WF, verdict
