"""Reprojection factors: residuals, Jacobians and normal equations of all landmarks of a window, compiled.

A landmark m = [x y rho] of the host h is seen from the frame f at the direction of

    X = R_BC^T (R_fh q + rho t_fh - rho p_BC),   q = R_BC [x y 1]^T + rho p_BC,

with R_fh = R_WBf^T R_WBh and t_fh = R_WBf^T (p_WBh - p_WBf): rho times its position in the camera. Being polynomial in
rho, it holds for points as far as one likes. With a rolling shutter, a frame's camera is where the body's motion has
taken it by the time of the row: R_BC and p_BC in X, not in q, become Exp(w t) R_BC and Exp(w t) p_BC + v t. Other
intrinsics than a point was undistorted with move it in the image, to first order. Residuals are evaluated at the
estimate, Jacobians at the first estimates of poses that are in the prior. Derivation:
``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vioframe.arrays import Bool, Float
from vioframe.geometry.kernels import distort, exp, intrinsics_jacobian
from vioframe.jit import kernel

# Depth in a frame over depth in the host: a landmark nearer than this is beside the camera, and cannot be seen.
_LEAST_DEPTH_RATIO = 0.05
CALIBRATION_SIZE = 16
"""Error of the calibration: [dtheta_BC dp_BC d_offset d_readout d_intrinsics(8)]."""
OFFSET, READOUT, INTRINSICS = 6, 7, slice(8, 16)
"""Where in that error they are, behind the camera's pose on the body."""


Linearised = tuple[Float, Float, Float, Float, Float]


class Calibrated(NamedTuple):
    """What may be estimated: the camera on the body, what is left of the time offset, s, the readout, s, and the lens.

    ``intrinsics`` (8,) are fx fy cx cy px and the four distortion coefficients.
    """

    R_BC: Float
    p_BC: Float
    offset_s: float = 0.0
    readout_s: float = 0.0
    intrinsics: Float = np.zeros(8)


class Poses(NamedTuple):
    """Of the body in every frame, R_WB (K, 3, 3) and p_WB (K, 3), and what takes one frame's body to another's.

    ``R_fh`` (K, K, 3, 3) and ``t_fh`` (K, K, 3) by [frame, host].
    """

    R_WB: Float
    R_fh: Float
    t_fh: Float

    @staticmethod
    def of(R_WB: Float, p_WB: Float) -> Poses:
        R_BW = np.swapaxes(R_WB, -1, -2)
        R_fh = R_BW[:, None] @ R_WB[None]
        t_fh = (R_BW[:, None] @ (p_WB[None] - p_WB[:, None])[..., None])[..., 0]
        return Poses(np.ascontiguousarray(R_WB), R_fh, t_fh)


class Shutter(NamedTuple):
    """When the rows are read, and how the body moves meanwhile, which is constant while a window is solved for.

    ``row`` (L, K) is that of a sighting, from -1/2 for the first to 1/2 for the last; ``rate_B`` (K, 3) rad/s and
    ``velocity_B`` (K, 3) m/s are the body's in every frame, in its own axes. Where it is not ``rolling``, and stays so,
    nothing is asked of the rest.
    """

    rolling: bool
    row: Float
    rate_B: Float
    velocity_B: Float


GLOBAL_SHUTTER = Shutter(False, np.zeros((1, 1)), np.zeros((1, 3)), np.zeros((1, 3)))


class Lens(NamedTuple):
    """How sightings move with the intrinsics: ``px`` (L, K, 2, 8) by intrinsics, and ``at`` (K, 8), each frame's.

    The former is taken where the landmarks are, not where they were seen: the noise of a sighting would be in both the
    Jacobian and the residual, and pass for a longer focal length. The latter are those with which the points of a frame
    were undistorted. Where the lens is not ``varied``, nothing is asked of the rest.
    """

    varied: bool
    px: Float
    at: Float


FIXED_LENS = Lens(False, np.zeros((1, 1, 2, 8)), np.zeros((1, 8)))


class Sightings(NamedTuple):
    """What was seen of L landmarks in K frames, as in the table of tracks, with its noise and robust loss.

    ``seen`` (L, K); ``xy`` (L, K, 2) on the z = 1 plane, and how they move there, ``velocity`` (L, K, 2) 1/s.
    ``to_px`` (L, K, 2, 2) turns residuals into pixels, in which ``sigma`` is the standard deviation; ``cauchy`` is the
    scale of the robust loss, in standard deviations. Residuals are on the plane, or on the unit sphere.
    """

    seen: Bool
    xy: Float
    velocity: Float
    to_px: Float
    sigma: float
    cauchy: float
    on_sphere: bool = False
    shutter: Shutter = GLOBAL_SHUTTER
    lens: Lens = FIXED_LENS

    def cost(self, poses: Poses, camera: Calibrated, landmarks: Float) -> float:
        """Half the robust sum of squares."""
        return _evaluate(poses, camera, self, landmarks)[0]

    def errors(self, poses: Poses, camera: Calibrated, landmarks: Float) -> Float:
        """(L,) root mean square residual of each landmark, standard deviations; infinite behind a camera."""
        return _evaluate(poses, camera, self, landmarks)[1]

    def linearise(self, poses: Poses, first: Poses, camera: Calibrated, landmarks: Float) -> Linearised:
        """H (n, n), b (n,) of poses and calibration, and V (L, 3, 3), W (L, 3, n), c (L, 3) of the landmarks.

        n = 6 K + 16: [dtheta dp] of every frame, then the calibration. The gradient is [b c], the Gauss-Newton matrix
        [H W^T; W V], with the robust weights in them. Jacobians are taken at the poses ``first``.
        """
        return _linearise(poses, first, camera, self, landmarks)


@kernel
def pixels_by_residual(model: int, k: Float, xy: Float, on_sphere: bool) -> Float:
    """(N, 2, 2) px of the distorted image by the residual at points (N, 2) of the z = 1 plane."""
    out = np.empty((len(xy), 2, 2))
    T = np.empty((2, 3))
    for i in range(len(xy)):
        x, y = xy[i]
        _, J = distort(model, k, x, y)
        if on_sphere:
            # A step across the ray, seen on the plane: |m| (T_xy - m_xy T_z).
            _tangents(x, y, T)
            length = math.sqrt(1.0 + x * x + y * y)
            S = np.empty((2, 2))
            for j in range(2):
                S[0, j], S[1, j] = length * (T[j, 0] - x * T[j, 2]), length * (T[j, 1] - y * T[j, 2])
            J = J @ S
        out[i] = J
    return out


@kernel
def pixels_by_intrinsics(model: int, k: Float, xy: Float, seen: Bool) -> Float:
    """(L, K, 2, 8) px of the image by the intrinsics, where ``seen`` (L, K), at points (L, K, 2) of the z = 1 plane."""
    out = np.zeros((*seen.shape, 2, 8))
    for i in range(len(seen)):
        for f in range(seen.shape[1]):
            if seen[i, f]:
                out[i, f] = intrinsics_jacobian(model, k, xy[i, f, 0], xy[i, f, 1])
    return out


@kernel
def eliminate(V: Float, W: Float, c: Float, damping: float) -> tuple[Float, Float, Float]:
    """Y (L, 3, n), z (L, 3) and inverse factors (L, 3, 3) with Y^T Y = W^T V^-1 W, Y^T z = W^T V^-1 c, V damped."""
    count, _, n = W.shape
    Y = np.empty((count, 3, n))
    z = np.empty((count, 3))
    inverse = np.zeros((count, 3, 3))
    for i in range(count):
        # Cholesky's factor of V, inverted. The constant keeps a landmark without parallax solvable.
        a = V[i, 0, 0] * (1.0 + damping) + 1e-9
        b = V[i, 1, 1] * (1.0 + damping) + 1e-9
        d = V[i, 2, 2] * (1.0 + damping) + 1e-9
        l00 = math.sqrt(a)
        l10, l20 = V[i, 1, 0] / l00, V[i, 2, 0] / l00
        l11 = math.sqrt(b - l10 * l10)
        l21 = (V[i, 2, 1] - l20 * l10) / l11
        l22 = math.sqrt(max(d - l20 * l20 - l21 * l21, 1e-9))
        i00, i11, i22 = 1.0 / l00, 1.0 / l11, 1.0 / l22
        i10, i21 = -l10 * i00 * i11, -l21 * i11 * i22
        i20 = -(l20 * i00 + l21 * i10) * i22
        inverse[i, 0, 0], inverse[i, 1, 0], inverse[i, 1, 1] = i00, i10, i11
        inverse[i, 2, 0], inverse[i, 2, 1], inverse[i, 2, 2] = i20, i21, i22
        for j in range(n):
            w0, w1, w2 = W[i, 0, j], W[i, 1, j], W[i, 2, j]
            Y[i, 0, j] = i00 * w0
            Y[i, 1, j] = i10 * w0 + i11 * w1
            Y[i, 2, j] = i20 * w0 + i21 * w1 + i22 * w2
        z[i, 0] = i00 * c[i, 0]
        z[i, 1] = i10 * c[i, 0] + i11 * c[i, 1]
        z[i, 2] = i20 * c[i, 0] + i21 * c[i, 1] + i22 * c[i, 2]
    return Y, z, inverse


@kernel
def _in_body(R_BC: Float, p_BC: Float, m: Float, q: Float) -> None:
    """``q`` (3,): rho times the landmark's position in the host's body."""
    for i in range(3):
        q[i] = R_BC[i, 0] * m[0] + R_BC[i, 1] * m[1] + R_BC[i, 2] + m[2] * p_BC[i]


@kernel
def _in_camera(R_fh: Float, t_fh: Float, R_BC: Float, p_BC: Float, rho: float, q: Float, b: Float, X: Float) -> None:
    """``b`` and ``X`` (3,): rho times the landmark's position in the frame's body, and in its camera."""
    for i in range(3):
        b[i] = R_fh[i, 0] * q[0] + R_fh[i, 1] * q[1] + R_fh[i, 2] * q[2] + rho * t_fh[i]
    for i in range(3):
        X[i] = 0.0
        for k in range(3):
            X[i] += R_BC[k, i] * (b[k] - rho * p_BC[k])


@kernel
def camera_at_row(camera: Calibrated, shutter: Shutter, i: int, f: int, R_rowC: Float, p_rowC: Float) -> None:
    """``R_rowC`` (3, 3) and ``p_rowC`` (3,): the camera, seen from the body at frame f, when it saw landmark i."""
    late_s = camera.readout_s * shutter.row[i, f]
    turn = exp(late_s * shutter.rate_B[f])
    for j in range(3):
        p_rowC[j] = late_s * shutter.velocity_B[f, j]
        for k in range(3):
            p_rowC[j] += turn[j, k] * camera.p_BC[k]
            R_rowC[j, k] = (
                turn[j, 0] * camera.R_BC[0, k] + turn[j, 1] * camera.R_BC[1, k] + turn[j, 2] * camera.R_BC[2, k]
            )


@kernel
def _tangents(x: float, y: float, T: Float) -> None:
    """``T`` (2, 3): two orthonormal directions across the ray [x y 1]."""
    length = math.sqrt(1.0 + x * x)
    T[0, 0], T[0, 1], T[0, 2] = 1.0 / length, 0.0, -x / length
    # The ray times the first.
    across = math.sqrt(x * x + y * y + 1.0)
    T[1, 0] = y * T[0, 2] / across
    T[1, 1] = (T[0, 0] - x * T[0, 2]) / across
    T[1, 2] = -y * T[0, 0] / across


@kernel
def _residual(X: Float, x: float, y: float, to_px: Float, on_sphere: bool, T: Float, r: Float) -> None:
    """``r`` (2,) px between the direction ``X`` (3,) and the observation [x y 1]; across ``T`` on the sphere."""
    if on_sphere:
        length = math.sqrt(X[0] * X[0] + X[1] * X[1] + X[2] * X[2])
        _tangents(x, y, T)
        # The observation itself has no part across itself.
        u = (T[0, 0] * X[0] + T[0, 1] * X[1] + T[0, 2] * X[2]) / length
        v = (T[1, 0] * X[0] + T[1, 1] * X[1] + T[1, 2] * X[2]) / length
    else:
        depth = max(X[2], _LEAST_DEPTH_RATIO)
        u, v = X[0] / depth - x, X[1] / depth - y
    r[0], r[1] = to_px[0, 0] * u + to_px[0, 1] * v, to_px[1, 0] * u + to_px[1, 1] * v


@kernel
def _add_lens(lens: Lens, i: int, f: int, intrinsics: Float, r: Float) -> None:
    """To ``r`` (2,) px what other intrinsics than it was undistorted with move the sighting by."""
    for k in range(8):
        change = intrinsics[k] - lens.at[f, k]
        r[0] += lens.px[i, f, 0, k] * change
        r[1] += lens.px[i, f, 1, k] * change


@kernel
def _residual_jacobian(
    X: Float, vx: float, vy: float, to_px: Float, on_sphere: bool, T: Float, D: Float, by_offset: Float
) -> None:
    """``D`` (2, 3) by ``X``, and ``by_offset`` (2,) by the time offset, where the image moves by (vx, vy)."""
    if on_sphere:
        length = math.sqrt(X[0] * X[0] + X[1] * X[1] + X[2] * X[2])
        for i in range(2):
            along = (T[i, 0] * X[0] + T[i, 1] * X[1] + T[i, 2] * X[2]) / (length * length)
            for k in range(3):
                D[i, k] = (T[i, k] - along * X[k]) / length
            by_offset[i] = D[i, 0] * vx + D[i, 1] * vy
            by_offset[i] *= X[2]
    else:
        for i in range(2):
            for k in range(3):
                D[i, k] = 0.0
        if X[2] > _LEAST_DEPTH_RATIO:
            D[0, 0] = D[1, 1] = 1.0 / X[2]
            D[0, 2], D[1, 2] = -X[0] / (X[2] * X[2]), -X[1] / (X[2] * X[2])
        else:
            D[0, 0] = D[1, 1] = 1.0 / _LEAST_DEPTH_RATIO
        by_offset[0], by_offset[1] = vx, vy
    for k in range(3):
        u, v = D[0, k], D[1, k]
        D[0, k], D[1, k] = to_px[0, 0] * u + to_px[0, 1] * v, to_px[1, 0] * u + to_px[1, 1] * v
    u, v = by_offset[0], by_offset[1]
    by_offset[0], by_offset[1] = to_px[0, 0] * u + to_px[0, 1] * v, to_px[1, 0] * u + to_px[1, 1] * v


@kernel
def _times_transposed(A: Float, M: Float, out: Float) -> None:
    """``out`` = A M^T, (2, 3) times (3, 3)."""
    for i in range(2):
        for k in range(3):
            out[i, k] = A[i, 0] * M[k, 0] + A[i, 1] * M[k, 1] + A[i, 2] * M[k, 2]


@kernel
def _times(A: Float, M: Float, out: Float) -> None:
    """``out`` = A M, (2, 3) times (3, 3)."""
    for i in range(2):
        for k in range(3):
            out[i, k] = A[i, 0] * M[0, k] + A[i, 1] * M[1, k] + A[i, 2] * M[2, k]


@kernel
def _evaluate(poses: Poses, camera: Calibrated, s: Sightings, landmarks: Float) -> tuple[float, Float]:
    """Half the robust sum of squares, and each landmark's root mean square residual."""
    R_BC, p_BC, offset_s, _, intrinsics = camera
    seen, xy, velocity, to_px, sigma, cauchy, on_sphere, shutter, lens = s
    R_rowC, p_rowC = R_BC.copy(), p_BC.copy()
    q, b, X, r, T = np.empty(3), np.empty(3), np.empty(3), np.empty(2), np.empty((2, 3))
    count, frames = seen.shape
    cost, errors = 0.0, np.empty(count)
    for i in range(count):
        host, views, total = -1, 0, 0.0
        _in_body(R_BC, p_BC, landmarks[i], q)
        for f in range(frames):
            if not seen[i, f]:
                continue
            host = f if host < 0 else host
            x, y = xy[i, f, 0] - offset_s * velocity[i, f, 0], xy[i, f, 1] - offset_s * velocity[i, f, 1]
            if shutter.rolling:
                camera_at_row(camera, shutter, i, f, R_rowC, p_rowC)
            _in_camera(poses.R_fh[f, host], poses.t_fh[f, host], R_rowC, p_rowC, landmarks[i, 2], q, b, X)
            _residual(X, x, y, to_px[i, f], on_sphere, T, r)
            if lens.varied:
                _add_lens(lens, i, f, intrinsics, r)
            squared = r[0] * r[0] + r[1] * r[1]
            cost += 0.5 * cauchy * cauchy * math.log(1.0 + squared / (sigma * sigma * cauchy * cauchy))
            total += squared / (sigma * sigma)
            if X[2] <= _LEAST_DEPTH_RATIO:
                total = np.inf
            views += 1
        errors[i] = math.sqrt(0.5 * total / max(views, 1))
    return cost, errors


@kernel
def _linearise(poses: Poses, first: Poses, camera: Calibrated, s: Sightings, landmarks: Float) -> Linearised:
    R_BC, p_BC, offset_s, _, intrinsics = camera
    seen, xy, velocity, to_px, sigma, cauchy, on_sphere, shutter, lens = s
    rolling, size = shutter.rolling, CALIBRATION_SIZE
    R_rowC, p_rowC = R_BC.copy(), p_BC.copy()
    count, frames = seen.shape
    n = 6 * frames + size
    H, g = np.zeros((n, n)), np.zeros(n)
    V, W, c = np.zeros((count, 3, 3)), np.zeros((count, 3, n)), np.zeros((count, 3))
    q, b, X, r, T = np.empty(3), np.empty(3), np.empty(3), np.empty(2), np.empty((2, 3))
    D, A, B, C, E = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 3))
    A_row = np.empty((2, 3))
    by_offset, p_row = np.empty(2), np.empty(3)
    J = np.zeros((2, 12 + size))  # host, frame, calibration
    end = 12 + size if lens.varied else 12 + READOUT + 1
    J_m = np.empty((2, 3))
    columns = np.empty(12 + size, np.int64)
    for k in range(size):
        columns[12 + k] = 6 * frames + k
    ray = np.ones(3)
    for i in range(count):
        host = -1
        rho = landmarks[i, 2]
        ray[0], ray[1] = landmarks[i, 0], landmarks[i, 1]
        _in_body(R_BC, p_BC, landmarks[i], q)
        for f in range(frames):
            if not seen[i, f]:
                continue
            host = f if host < 0 else host
            vx, vy = velocity[i, f, 0], velocity[i, f, 1]
            x, y = xy[i, f, 0] - offset_s * vx, xy[i, f, 1] - offset_s * vy
            if rolling:
                camera_at_row(camera, shutter, i, f, R_rowC, p_rowC)
            _in_camera(poses.R_fh[f, host], poses.t_fh[f, host], R_rowC, p_rowC, rho, q, b, X)
            _residual(X, x, y, to_px[i, f], on_sphere, T, r)
            if lens.varied:
                _add_lens(lens, i, f, intrinsics, r)
            weight = 1.0 / (1.0 + (r[0] * r[0] + r[1] * r[1]) / (sigma * sigma * cauchy * cauchy))
            scale = math.sqrt(weight) / sigma

            _in_camera(first.R_fh[f, host], first.t_fh[f, host], R_rowC, p_rowC, rho, q, b, X)
            _residual_jacobian(X, vx, vy, to_px[i, f], on_sphere, T, D, by_offset)
            _times_transposed(D, R_rowC, A)
            _times_transposed(D, R_BC, A_row)
            _times(A, first.R_fh[f, host], B)
            _times(B, R_BC, C)
            _times(A, first.R_WB[f].T, E)
            moved = host != f
            # In the host itself a landmark is where it was seen, unless rows are read at different times.
            apart = moved or rolling
            for k in range(3):
                p_row[k] = rho * p_BC[k] + R_BC[k, 0] * X[0] + R_BC[k, 1] * X[1] + R_BC[k, 2] * X[2]
            for a in range(2):
                r[a] *= scale
                by_rho, by_readout = 0.0, 0.0
                for k in range(3):
                    i1, i2 = (k + 1) % 3, (k + 2) % 3  # a x b in its component k
                    by_host = q[i1] * B[a, i2] - q[i2] * B[a, i1]
                    by_frame = A[a, i1] * b[i2] - A[a, i2] * b[i1]
                    by_camera = D[a, i1] * X[i2] - D[a, i2] * X[i1] + ray[i1] * C[a, i2] - ray[i2] * C[a, i1]
                    J[a, k] = scale * by_host if moved else 0.0
                    J[a, 3 + k] = scale * rho * E[a, k] if moved else 0.0
                    J[a, 6 + k] = scale * by_frame if moved else 0.0
                    J[a, 9 + k] = -J[a, 3 + k]
                    J[a, 12 + k] = scale * by_camera if apart else 0.0
                    J[a, 15 + k] = scale * rho * (B[a, k] - A_row[a, k]) if apart else 0.0
                    by_rho += A[a, k] * first.t_fh[f, host, k] + (B[a, k] - A[a, k]) * p_BC[k]
                    by_rho -= A[a, k] * (p_rowC[k] - p_BC[k])
                J[a, 18] = scale * by_offset[a]
                if rolling:
                    rate, velocity_B = shutter.rate_B[f], shutter.velocity_B[f]
                    for k in range(3):
                        i1, i2 = (k + 1) % 3, (k + 2) % 3
                        by_readout -= A_row[a, k] * (rate[i1] * p_row[i2] - rate[i2] * p_row[i1])
                        by_readout -= rho * A[a, k] * velocity_B[k]
                    J[a, 19] = scale * by_readout * shutter.row[i, f]
                if lens.varied:
                    for k in range(8):
                        J[a, 20 + k] = scale * lens.px[i, f, a, k]
                J_m[a, 0], J_m[a, 1] = scale * C[a, 0], scale * C[a, 1]
                J_m[a, 2] = scale * by_rho if apart else 0.0
            for k in range(6):
                columns[k], columns[6 + k] = 6 * host + k, 6 * f + k

            begin = 0 if host != f else 12
            for u in range(begin, end):
                cu = columns[u]
                g[cu] += J[0, u] * r[0] + J[1, u] * r[1]
                # The host is the first that saw it: columns ascend, and the upper half will do.
                for v in range(u, end):
                    H[cu, columns[v]] += J[0, u] * J[0, v] + J[1, u] * J[1, v]
                for k in range(3):
                    W[i, k, cu] += J_m[0, k] * J[0, u] + J_m[1, k] * J[1, u]
            for k in range(3):
                c[i, k] += J_m[0, k] * r[0] + J_m[1, k] * r[1]
                for v in range(3):
                    V[i, k, v] += J_m[0, k] * J_m[0, v] + J_m[1, k] * J_m[1, v]
    for u in range(n):
        for v in range(u):
            H[u, v] = H[v, u]
    return H, g, V, W, c
