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

from vioframe.geometry.kernels import (
    camera_later,
    distort,
    intrinsics_jacobian,
    inverse_cholesky,
    product,
    set_matrix,
    set_vector,
    turned,
    undistort,
    whiten,
)
from vioframe.geometry.triangulation import triangulate
from vioframe.jit import kernel
from vioframe.types import Bool, Float, Int
from vioframe_msckf.covariance import add
from vioframe_msckf.state import FilterState

ACCEPTED, NOT_TRIANGULATED, GATED = 0, 1, 2

_Vector = tuple[float, float, float]


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
def _row(w: Window, c: int, y: float) -> float:
    """Where the row ``y`` px is between the first of camera ``c`` and its last, from -1/2 to 1/2."""
    place: float = (y + 0.5) / w.image_heights[c] - 0.5
    return place


@kernel
def _camera_at(w: Window, k: int, c: int, y: float, R_lateC: Float, p_lateC: Float) -> None:
    """Camera ``c`` as seen from the body at clone ``k`` when it saw a pixel at the height ``y``; fills (3, 3), (3,)."""
    late_s = w.offset_s[c] + w.readout_s[c] * _row(w, c, y)
    camera_later(w.R_BC[c], w.p_BC[c], late_s, w.rate_B[k], w.velocity_B[k], R_lateC, p_lateC)


# Vectors as tuples, for which nothing is allocated.


@kernel(inlined=True)
def _by(R: Float, v: _Vector) -> _Vector:
    """R v."""
    return (
        R[0, 0] * v[0] + R[0, 1] * v[1] + R[0, 2] * v[2],
        R[1, 0] * v[0] + R[1, 1] * v[1] + R[1, 2] * v[2],
        R[2, 0] * v[0] + R[2, 1] * v[1] + R[2, 2] * v[2],
    )


@kernel(inlined=True)
def _back(R: Float, a: Float | _Vector, b: Float) -> _Vector:
    """R^T (a - b)."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return (
        R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
        R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
        R[0, 2] * x + R[1, 2] * y + R[2, 2] * z,
    )


@kernel(inlined=True)
def _cross(a: Float | _Vector, b: _Vector) -> _Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(inlined=True)
def _dot(a: _Vector, b: Float | _Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _observe(
    w: Window,
    k: int,
    c: int,
    R_lateC: Float,
    p_lateC: Float,
    p_WF: Float,
    p_WF_first: Float,
    xy: Float,
    block: Float,
    residual: Float,
) -> None:
    """One sighting, by the camera ``R_lateC``, ``p_lateC`` (:func:`_camera_at`): ``residual`` (2,) px and ``block``.

    The latter (2, 25) is over [camera 16, clone 6, landmark 3].
    """
    model, intrinsics = w.camera_models[c], w.intrinsics[c]
    p_C = _back(R_lateC, _back(w.R_WB[k], p_WF, w.p_WB[k]), p_lateC)
    drawn, _ = distort(model, intrinsics, p_C[0] / p_C[2], p_C[1] / p_C[2])
    residual[0], residual[1] = xy[0] - drawn[0], xy[1] - drawn[1]

    R_first, R_BC, p_BC = w.R_WB_first[k], w.R_BC[c], w.p_BC[c]
    p_B = _back(R_first, p_WF_first, w.p_WB_first[k])
    p_C = _back(R_lateC, p_B, p_lateC)
    x, y = p_C[0] / p_C[2], p_C[1] / p_C[2]
    _, D = distort(model, intrinsics, x, y)
    # By the point as seen from the body when the camera saw it, and by how it moved there meanwhile.
    turned_C = _by(R_BC, p_C)
    p_late = turned_C[0] + p_BC[0], turned_C[1] + p_BC[1], turned_C[2] + p_BC[2]
    moved_late = _cross(w.rate_B[k], p_late)
    row = _row(w, c, xy[1])
    intrinsics_jacobian(model, intrinsics, x, y, block[:, 7:15])
    for i in range(2):
        J = D[i][0] / p_C[2], D[i][1] / p_C[2], -(D[i][0] * x + D[i][1] * y) / p_C[2]
        J_late, J_B = _by(R_BC, J), _by(R_lateC, J)
        J_W, by_turn_BC, by_turn_WB = _by(R_first, J_B), _cross(J, p_C), _cross(J_B, p_B)
        by_offset = -_dot(J_late, moved_late) - _dot(J_B, w.velocity_B[k])
        own = block[i]
        own[6], own[15] = by_offset, row * by_offset
        for m in range(3):
            own[m], own[3 + m] = by_turn_BC[m], -J_late[m]
            own[16 + m], own[19 + m], own[22 + m] = by_turn_WB[m], -J_W[m], J_W[m]


@kernel
def observations(w: Window, clone: int, cameras: Int, p_WF: Float, p_WF_first: Float, xy: Float) -> tuple[Float, Float]:
    """Landmarks (M, 3) seen by ``cameras`` (M,) at (M, 2) px from one clone: blocks (M, 2, 25), residuals (M, 2)."""
    m = len(xy)
    blocks = np.empty((m, 2, 25))
    residual = np.empty((m, 2))
    R_lateC, p_lateC = np.empty((3, 3)), np.empty(3)
    for i in range(m):
        c = cameras[i]
        _camera_at(w, clone, c, xy[i, 1], R_lateC, p_lateC)
        _observe(w, clone, c, R_lateC, p_lateC, p_WF[i], p_WF_first[i], xy[i], blocks[i], residual[i])
    return blocks, residual


@kernel(inlined=True)
def track_rows(
    w: Window, xy: Float, xy_normalised: Float, seen: Bool, pixel_sigma: float
) -> tuple[bool, Float, Float, Float, Float]:
    """One track (C,): whether it was triangulated, p_WF, H over [cameras, clones] and the landmark, residual."""
    K, N = len(w.p_WB), len(w.p_BC)
    views = np.flatnonzero(seen)
    m = len(views)
    R_WC, R_lateC = np.empty((m, 3, 3)), np.empty((m, 3, 3))
    p_WC, p_lateC = np.empty((m, 3)), np.empty((m, 3))
    points = np.empty((m, 2))
    for i in range(m):
        v = views[i]
        k, c = v // N, v % N
        _camera_at(w, k, c, xy[v, 1], R_lateC[i], p_lateC[i])
        set_matrix(R_WC[i], product(w.R_WB[k], R_lateC[i]))
        set_vector(p_WC[i], turned(w.R_WB[k], p_lateC[i]) + w.p_WB[k])
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
            _observe(w, k, c, R_lateC[i], p_lateC[i], p_WF, p_WF, xy[v], block, residual[2 * i : 2 * i + 2])
            set_matrix(H[2 * i : 2 * i + 2, n * c : n * c + n], block[:, 0:n])
            set_matrix(H[2 * i : 2 * i + 2, n * N + 6 * k : n * N + 6 * k + 6], block[:, 16:22])
            set_matrix(H_f[2 * i : 2 * i + 2], block[:, 22:25])
    return ok, p_WF, H, H_f, residual


@kernel(inlined=True)
def reduce_landmark(H: Float, H_f: Float, residual: Float) -> None:
    """Rotate the rows by the orthogonal Q with Q H_f = [T; 0], T (3, 3) upper triangular, in place.

    Householder reflections. The rows below the third are free of the landmark: Mourikis and Roumeliotis, eq. (22)-(24).
    """
    m, n = H.shape
    v, dots = np.empty(m), np.empty(n)
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
        dots[:] = 0.0
        for i in range(j, m):
            add(dots, v[i], H[i])
        for i in range(j, m):
            add(H[i], -scale * v[i], dots)
        dot = 0.0
        for i in range(j, m):
            dot += v[i] * residual[i]
        for i in range(j, m):
            residual[i] -= scale * dot * v[i]


@kernel(inlined=True)
def variance_ratio(left: Float, S_left: Float) -> float:
    """How errors of one landmark's sightings last: 1 where they are white, more where neighbours are alike.

    Mean square of sums over half of the sightings (Bartlett's window, as by Newey and West, "A simple, positive
    semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix", Econometrica 1987) over that of
    single ones, in units of what the covariance ``S_left`` of ``left`` (2 M,) would give.
    """
    m = len(left) // 2
    width = max(m // 2, 1)
    sums = expected_sums = single = expected = 0.0
    for i in range(m):
        for k in range(max(i - width + 1, 0), min(i + width, m)):
            weight = 1.0 - abs(i - k) / width
            for a in range(2 * i, 2 * i + 2):
                b = a + 2 * (k - i)
                sums += weight * left[a] * left[b]
                expected_sums += weight * S_left[a, b]
        for a in range(2 * i, 2 * i + 2):
            single += left[a] ** 2
            expected += S_left[a, a]
    return sums / single * expected / expected_sums if single > 0.0 else 1.0


@kernel(inlined=True)
def distance_and_variances(
    S: Float, H_f: Float, residual: Float, variance: float, cauchy: float
) -> tuple[float, Float, float]:
    """Of M sightings of one landmark their squared Mahalanobis distance, and (M,) variances to take them with, px^2.

    Of their ``residual`` (2 M,) the state leaves ``S`` (2 M, 2 M) unsure, the landmark anything along ``H_f`` (2 M, 3),
    and ``variance`` is that of the noise. What is left when the landmark is where all agree best may be off by e of its
    standard deviations; a sighting then has 1 + (e / ``cauchy``)^2 times the ``variance``: Cauchy's loss. Last comes
    the :func:`variance_ratio` of what is left.
    """
    m = len(residual)
    S = S.copy()
    for i in range(m):
        S[i, i] += variance
    # The landmark taken out by least squares, whose plane in the space of rows has the orthonormal basis U'.
    of_rows = np.zeros((3, 3))
    for row in range(m):
        for a in range(3):
            add(of_rows[a], H_f[row, a], H_f[row])
    U = product(inverse_cholesky(of_rows), H_f.T)
    U_r, U_S, U_S_U = np.zeros(3), np.zeros((3, m)), np.zeros((3, 3))
    for a in range(3):
        for row in range(m):
            U_r[a] += U[a, row] * residual[row]
            add(U_S[a], U[a, row], S[row])
        for row in range(m):
            add(U_S_U[a], U_S[a, row], U[:, row])
    # Of S what is across U: U_S becomes U S - U S U^T U / 2, with which both sides are taken off at once.
    left, S_left = residual.copy(), S.copy()
    for a in range(3):
        for b in range(3):
            add(U_S[a], -0.5 * U_S_U[a, b], U[b])
        add(left, -U_r[a], U[a])
    for row in range(m):
        for a in range(3):
            add(S_left[row], -U[a, row], U_S[a])
            add(S_left[row], -U_S[a, row], U[a])
    variances = np.empty(m // 2)
    for i in range(m // 2):
        a, b = 2 * i, 2 * i + 1
        squared, expected = left[a] ** 2 + left[b] ** 2, S_left[a, a] + S_left[b, b]
        variances[i] = variance * (1.0 + 2.0 * squared / expected / (cauchy * cauchy))
    # By S what the landmark explains is the projection onto three whitened columns.
    white = np.empty((m, 4))
    set_matrix(white[:, :3], H_f)
    set_vector(white[:, 3], residual)
    whiten(S, white)
    information = np.zeros((4, 4))
    for row in range(m):
        for a in range(4):
            add(information[a], white[row, a], white[row])
    along = information[:3, 3:].copy()
    whiten(information[:3, :3], along)
    distance = information[3, 3] - along[0, 0] ** 2 - along[1, 0] ** 2 - along[2, 0] ** 2
    return distance, variances, variance_ratio(left, S_left)


@kernel(inlined=True)
def reduced_track(
    w: Window, xy: Float, xy_normalised: Float, seen: Bool, P: Float, pixel_sigma: float, cauchy: float
) -> tuple[bool, Float, Float, Float, Float, float, float]:
    """One track (C,): whether it was triangulated, p_WF, H, H_f, residual, squared distance, :func:`variance_ratio`.

    Below the third row there is no landmark. ``P`` is the covariance of the columns of H, [cameras, clones]; the noise
    of all rows is white with ``pixel_sigma``, to which those of sightings that do not fit are scaled.
    """
    ok, p_WF, H, H_f, residual = track_rows(w, xy, xy_normalised, seen, pixel_sigma)
    distance = ratio = 0.0
    if ok:
        distance, variances, ratio = distance_and_variances(H @ P @ H.T, H_f, residual, pixel_sigma**2, cauchy)
        for i in range(len(variances)):
            scale = pixel_sigma / np.sqrt(variances[i])
            for row in range(2 * i, 2 * i + 2):
                for c in range(H.shape[1]):
                    H[row, c] *= scale
                for c in range(3):
                    H_f[row, c] *= scale
                residual[row] *= scale
        reduce_landmark(H, H_f, residual)
    return ok, p_WF, H, H_f, residual, distance, ratio


class TrackRows(NamedTuple):
    """What F tracks say, over [cameras, clones]: ``H`` (m, n) and ``residual`` (m,) of all, free of the landmarks.

    Of a landmark the rest is known by H_of e + T dp_WF = residual_of, up to the same white noise: ``H_of`` (F, 3, n),
    ``T`` (F, 3, 3), ``residual_of`` (F, 3). ``p_WF`` (F, 3) is where it was linearised; ``squares`` (F,) are squared
    Mahalanobis distances and ``ratios`` (F,) each track's :func:`variance_ratio`, zero where there are none. Only what
    is accepted by its ``verdict`` (F,) is in the rows.
    """

    H: Float
    residual: Float
    H_of: Float
    T: Float
    residual_of: Float
    p_WF: Float
    squares: Float
    ratios: Float
    verdict: Int


@kernel
def msckf_rows(
    w: Window, xy: Float, xy_normalised: Float, seen: Bool, P: Float, pixel_sigma: float, cauchy: float, gate: Float
) -> TrackRows:
    """Triangulate (F, C) tracks, linearise them, project out the landmarks, and gate each at ``gate[dof]``.

    ``P`` is the covariance of [cameras, clones].
    """
    F, n = len(seen), len(P)
    H_all = np.empty((2 * seen.sum(), n))
    r_all = np.empty(2 * seen.sum())
    H_of, T, residual_of = np.empty((F, 3, n)), np.empty((F, 3, 3)), np.empty((F, 3))
    p_WF = np.empty((F, 3))
    squares, ratios = np.zeros(F), np.zeros(F)
    verdict = np.empty(F, dtype=np.int64)
    rows = 0
    for f in range(F):
        ok, p, H, H_f, residual, squares[f], ratios[f] = reduced_track(
            w, xy[f], xy_normalised[f], seen[f], P, pixel_sigma, cauchy
        )
        set_vector(p_WF[f], p)
        if not ok:
            verdict[f] = NOT_TRIANGULATED
            continue
        free = len(residual) - 3
        if not squares[f] <= gate[free]:
            verdict[f] = GATED
            continue
        verdict[f] = ACCEPTED
        set_matrix(H_of[f], H[:3])
        set_matrix(T[f], H_f[:3])
        set_vector(residual_of[f], residual[:3])
        set_matrix(H_all[rows : rows + free], H[3:])
        set_vector(r_all[rows : rows + free], residual[3:])
        rows += free
    return TrackRows(H_all[:rows], r_all[:rows], H_of, T, residual_of, p_WF, squares, ratios, verdict)
