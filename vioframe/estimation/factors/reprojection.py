"""Reprojection factors: residuals, Jacobians and normal equations of all landmarks of a window, compiled.

Of a rig of N cameras each frame f has N views, f N + c of its camera c. A landmark m = [x y rho] whose host is the
camera d in the frame h is seen by the camera c in the frame f at the direction of

    X = R_BC^T (R_fh q + rho t_fh - rho p_BC),   q = R_BD [x y 1]^T + rho p_BD,

with R_fh = R_WBf^T R_WBh and t_fh = R_WBf^T (p_WBh - p_WBf): rho times its position in the camera. Being polynomial in
rho, it holds for points as far as one likes. With a rolling shutter, a view's camera is where the body's motion has
taken it by the time of the row: R_BC and p_BC in X become Exp(w t) R_BC and Exp(w t) p_BC + v t. Other
intrinsics than a point was undistorted with move it in the image, to first order. Residuals are evaluated at the
estimate, Jacobians at the first estimates of poses that are in the prior. Derivation:
``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.geometry.cameras import intrinsics_of
from vioframe.geometry.kernels import camera_later, distort, intrinsics_jacobian, set_matrix, set_vector
from vioframe.jit import kernel
from vioframe.types import CameraOnBody

# Depth in a frame over depth in the host: a landmark nearer than this is beside the camera, and cannot be seen.
_LEAST_DEPTH_RATIO = 0.05
CALIBRATION_SIZE = 16
"""Error of a camera's calibration: [dtheta_BC dp_BC d_offset d_readout d_intrinsics(8)]."""
OFFSET, READOUT, INTRINSICS = 6, 7, slice(8, 16)
"""Where in that error they are, behind the camera's pose on the body."""


Linearised = tuple[Float, Float, Float, Float, Float, float, Float]
View = tuple[Float, Float, Float]


class Calibrated(NamedTuple):
    """What may be estimated of N cameras: where they are on the body, when they see it, and their lenses.

    ``R_BC`` (N, 3, 3), ``p_BC`` (N, 3) m, ``readout_s`` (N,); ``offset_s`` (N,) are the time offsets beyond the one
    that the readings were cut by; ``intrinsics`` (N, 8) are fx fy cx cy px and the four distortion coefficients.
    """

    R_BC: Float
    p_BC: Float
    offset_s: Float
    readout_s: Float
    intrinsics: Float

    @staticmethod
    def of(*cameras: CameraOnBody) -> Calibrated:
        """``cameras`` as they are given, the readings being cut by the time offset of the first."""
        return Calibrated(
            np.stack([camera.R_BC for camera in cameras]),
            np.stack([camera.p_BC for camera in cameras]),
            np.array([1e-9 * (camera.time_offset_ns - cameras[0].time_offset_ns) for camera in cameras]),
            np.array([camera.readout_s for camera in cameras]),
            np.stack([intrinsics_of(camera.model)[1] for camera in cameras]),
        )


class Poses(NamedTuple):
    """Of the body in every frame, R_WB (K, 3, 3) and p_WB (K, 3), and what takes one frame's body to another's.

    ``R_fh`` (K, K, 3, 3) and ``t_fh`` (K, K, 3) by [frame, host].
    """

    R_WB: Float
    R_fh: Float
    t_fh: Float

    @staticmethod
    def of(R_WB: Float, p_WB: Float) -> Poses:
        return Poses(*relative_poses(R_WB, p_WB))


class Shutter(NamedTuple):
    """When the rows are read, and how the body moves meanwhile, which is constant while a window is solved for.

    ``row`` (L, V) is that of a sighting, from -1/2 for the first to 1/2 for the last; ``rate_B`` (K, 3) rad/s and
    ``velocity_B`` (K, 3) m/s are the body's in every frame, in its own axes. Where it is not ``rolling``, and stays so,
    nothing is asked of the rest.
    """

    rolling: bool
    row: Float
    rate_B: Float
    velocity_B: Float


GLOBAL_SHUTTER = Shutter(False, np.zeros((1, 1)), np.zeros((1, 3)), np.zeros((1, 3)))


class Lens(NamedTuple):
    """How sightings move with the intrinsics: ``px`` (L, V, 2, 8) by intrinsics, and ``at`` (V, 8), each view's.

    The former is taken where the landmarks are, not where they were seen: the noise of a sighting would be in both the
    Jacobian and the residual, and pass for a longer focal length. The latter are those with which the points of a view
    were undistorted. Where the lens is not ``varied``, nothing is asked of the rest.
    """

    varied: bool
    px: Float
    at: Float


FIXED_LENS = Lens(False, np.zeros((1, 1, 2, 8)), np.zeros((1, 8)))


class Sightings(NamedTuple):
    """What was seen of L landmarks in V views, as in the table of tracks, with its noise and robust loss.

    ``seen`` (L, V); ``xy`` (L, V, 2) on the z = 1 plane, and how they move there, ``velocity`` (L, V, 2) 1/s.
    ``to_px`` (L, V, 2, 2) turns residuals into pixels, in which ``sigma`` is the standard deviation; ``cauchy`` is the
    scale of the robust loss, in standard deviations, and ``share`` (L, V) how much of each sighting counts. Residuals
    are on the plane, or on the unit sphere.
    """

    seen: Bool
    share: Float
    xy: Float
    velocity: Float
    to_px: Float
    sigma: float
    cauchy: float
    on_sphere: bool = False
    shutter: Shutter = GLOBAL_SHUTTER
    lens: Lens = FIXED_LENS

    def cost(self, poses: Poses, cameras: Calibrated, landmarks: Float) -> float:
        """Half the robust sum of squares."""
        return self.evaluated(poses, cameras, landmarks)[0]

    def errors(self, poses: Poses, cameras: Calibrated, landmarks: Float) -> Float:
        """(L,) root mean square residual of each landmark, standard deviations; infinite behind a camera."""
        return self.evaluated(poses, cameras, landmarks)[1]

    def evaluated(self, poses: Poses, cameras: Calibrated, landmarks: Float) -> tuple[float, Float]:
        """Both of these."""
        return _evaluate(poses, cameras, self, landmarks)

    def linearise(self, poses: Poses, first: Poses, cameras: Calibrated, landmarks: Float) -> Linearised:
        """H (n, n), b (n,) of poses and calibration, V (L, 3, 3), W (L, 3, n), c (L, 3) of the landmarks; cost, errors.

        n = 6 K + 16 N: [dtheta dp] of every frame, then the cameras'. The gradient is [b c], the Gauss-Newton matrix
        [H W^T; W V], with the robust weights in them; of ``H`` the upper half. Jacobians are taken at the poses
        ``first``. The last two are those of :meth:`cost` and :meth:`errors`.
        """
        return linearise(poses, first, cameras, self, landmarks)


@kernel
def relative_poses(R_WB: Float, p_WB: Float) -> tuple[Float, Float, Float]:
    """What :class:`Poses` holds of the poses of K frames."""
    count = len(R_WB)
    R_fh, t_fh = np.empty((count, count, 3, 3)), np.empty((count, count, 3))
    for f in range(count):
        R = R_WB[f]
        for h in range(count):
            x, y, z = p_WB[h, 0] - p_WB[f, 0], p_WB[h, 1] - p_WB[f, 1], p_WB[h, 2] - p_WB[f, 2]
            for i in range(3):
                t_fh[f, h, i] = R[0, i] * x + R[1, i] * y + R[2, i] * z
                for k in range(3):
                    R_fh[f, h, i, k] = R[0, i] * R_WB[h, 0, k] + R[1, i] * R_WB[h, 1, k] + R[2, i] * R_WB[h, 2, k]
    return R_WB, R_fh, t_fh


@kernel
def pixels_by_residual(model: int, k: Float, xy: Float, on_sphere: bool) -> Float:
    """(N, 2, 2) px of the distorted image by the residual at points (N, 2) of the z = 1 plane."""
    out = np.empty((len(xy), 2, 2))
    T = np.empty((2, 3))
    for i in range(len(xy)):
        x, y = xy[i]
        _, D = distort(model, k, x, y)
        if on_sphere:
            # A step across the ray, seen on the plane: |m| (T_xy - m_xy T_z).
            _tangents(x, y, T)
            length = math.sqrt(1.0 + x * x + y * y)
            for j in range(2):
                u, v = length * (T[j, 0] - x * T[j, 2]), length * (T[j, 1] - y * T[j, 2])
                for a in range(2):
                    out[i, a, j] = D[a][0] * u + D[a][1] * v
        else:
            for a in range(2):
                out[i, a, 0], out[i, a, 1] = D[a]
    return out


@kernel
def pixels_by_intrinsics(model: Int, k: Float, xy: Float, seen: Bool) -> Float:
    """(L, V, 2, 8) px of the image by the intrinsics, where ``seen`` (L, V), at points (L, V, 2) of the z = 1 plane.

    ``model`` (N,) and ``k`` (N, 8) are those of the cameras.
    """
    out = np.zeros((*seen.shape, 2, 8))
    for i in range(len(seen)):
        for v in range(seen.shape[1]):
            if seen[i, v]:
                c = v % len(k)
                intrinsics_jacobian(model[c], k[c], xy[i, v, 0], xy[i, v, 1], out[i, v])
    return out


@kernel(inlined=True)
def eliminate(
    seen: Bool, cameras: int, V: Float, W: Float, c: Float, damping: float
) -> tuple[Float, Float, tuple[Float, Float, Float]]:
    """What is known of the rest through the landmarks: W^T V^-1 W (n, n), the upper half, and W^T V^-1 c (n,).

    With them Y (L, 3, n), z (L, 3) and inverse factors (L, 3, 3) of V, which is damped: the former two are Y^T Y and
    Y^T z.
    """
    count, _, n = W.shape
    Y, z, inverse = np.empty((count, 3, n)), np.empty((count, 3)), np.zeros((count, 3, 3))
    S, g = np.zeros((n, n)), np.zeros(n)
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
        w_0, w_1, w_2, y_0, y_1, y_2 = W[i, 0], W[i, 1], W[i, 2], Y[i, 0], Y[i, 1], Y[i, 2]
        for j in range(n):
            y_0[j] = i00 * w_0[j]
            y_1[j] = i10 * w_0[j] + i11 * w_1[j]
            y_2[j] = i20 * w_0[j] + i21 * w_1[j] + i22 * w_2[j]
        z[i, 0] = i00 * c[i, 0]
        z[i, 1] = i10 * c[i, 0] + i11 * c[i, 1]
        z[i, 2] = i20 * c[i, 0] + i21 * c[i, 1] + i22 * c[i, 2]
    _add_squares(seen, cameras, Y, z, S, g)
    return S, g, (Y, z, inverse)


@kernel(inlined=True)
def _add_squares(seen: Bool, cameras: int, Y: Float, z: Float, S: Float, g: Float) -> None:
    """Add Y^T Y to the upper half of ``S`` (n, n) and Y^T z to ``g`` (n,), two landmarks at a time.

    These are neighbours in an order by which most have been seen by the same frames.
    """
    count, frames = len(seen), seen.shape[1] // cameras
    n, at_cameras = len(g), 6 * frames
    first, last = _ends(seen)
    first, last = first // cameras, last // cameras
    order, _ = _sorted(first * frames + last, frames * frames)
    for k in range(0, count, 2):
        i, j = order[k], order[min(k + 1, count - 1)]
        other = 1.0 if k + 1 < count else 0.0
        y_0, y_1, y_2, y_3, y_4, y_5 = Y[i, 0], Y[i, 1], Y[i, 2], Y[j, 0], Y[j, 1], Y[j, 2]
        begin, end = 6 * min(first[i], first[j]), 6 * max(last[i], last[j]) + 6
        for u in range(begin, n):
            if end <= u < at_cameras:
                continue
            a_0, a_1, a_2 = y_0[u], y_1[u], y_2[u]
            a_3, a_4, a_5 = other * y_3[u], other * y_4[u], other * y_5[u]
            g[u] += a_0 * z[i, 0] + a_1 * z[i, 1] + a_2 * z[i, 2] + a_3 * z[j, 0] + a_4 * z[j, 1] + a_5 * z[j, 2]
            own = S[u]
            for v in range(u, end):
                own[v] += (
                    a_0 * y_0[v] + a_1 * y_1[v] + a_2 * y_2[v] + a_3 * y_3[v] + a_4 * y_4[v] + a_5 * y_5[v]
                )  # fmt: skip
            for v in range(max(u, at_cameras), n):
                own[v] += (
                    a_0 * y_0[v] + a_1 * y_1[v] + a_2 * y_2[v] + a_3 * y_3[v] + a_4 * y_4[v] + a_5 * y_5[v]
                )  # fmt: skip


@kernel(inlined=True)
def _in_body(R_BC: Float, p_BC: Float, m: Float, q: Float) -> None:
    """``q`` (3,): rho times the landmark's position in the host's body."""
    for i in range(3):
        q[i] = R_BC[i, 0] * m[0] + R_BC[i, 1] * m[1] + R_BC[i, 2] + m[2] * p_BC[i]


@kernel
def _in_camera(R_fh: Float, t_fh: Float, R_BC: Float, p_BC: Float, rho: float, q: Float, b: Float, X: Float) -> None:
    """``b`` and ``X`` (3,): rho times the landmark's position in the frame's body, and in the view's camera."""
    for i in range(3):
        b[i] = R_fh[i, 0] * q[0] + R_fh[i, 1] * q[1] + R_fh[i, 2] * q[2] + rho * t_fh[i]
    for i in range(3):
        X[i] = 0.0
        for k in range(3):
            X[i] += R_BC[k, i] * (b[k] - rho * p_BC[k])


@kernel
def camera_at_row(cameras: Calibrated, shutter: Shutter, i: int, v: int, R_rowC: Float, p_rowC: Float) -> None:
    """``R_rowC`` (3, 3) and ``p_rowC`` (3,): the camera of view v, seen from the body, when it saw landmark i."""
    f, c = v // len(cameras.p_BC), v % len(cameras.p_BC)
    late_s = cameras.readout_s[c] * shutter.row[i, v]
    camera_later(cameras.R_BC[c], cameras.p_BC[c], late_s, shutter.rate_B[f], shutter.velocity_B[f], R_rowC, p_rowC)


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
def _add_lens(lens: Lens, i: int, v: int, intrinsics: Float, r: Float) -> None:
    """To ``r`` (2,) px what other intrinsics than it was undistorted with move the sighting by."""
    for k in range(8):
        change = intrinsics[k] - lens.at[v, k]
        r[0] += lens.px[i, v, 0, k] * change
        r[1] += lens.px[i, v, 1, k] * change


@kernel(inlined=True)
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
def _evaluate(poses: Poses, cameras: Calibrated, s: Sightings, landmarks: Float) -> tuple[float, Float]:
    """Half the robust sum of squares, and each landmark's root mean square residual."""
    seen, share, xy, velocity, to_px, sigma, cauchy, on_sphere, shutter, lens = s
    R_rowC, p_rowC = np.empty((3, 3)), np.empty(3)
    q, b, X, r, T = np.empty(3), np.empty(3), np.empty(3), np.empty(2), np.empty((2, 3))
    count, N = len(seen), len(cameras.p_BC)
    cost, errors = 0.0, np.empty(count)
    for i in range(count):
        host, views, total = -1, 0, 0.0
        for v in range(seen.shape[1]):
            if not seen[i, v]:
                continue
            f, c = v // N, v % N
            if host < 0:
                host = f
                _in_body(cameras.R_BC[c], cameras.p_BC[c], landmarks[i], q)
            x = xy[i, v, 0] - cameras.offset_s[c] * velocity[i, v, 0]
            y = xy[i, v, 1] - cameras.offset_s[c] * velocity[i, v, 1]
            R_C, p_C = cameras.R_BC[c], cameras.p_BC[c]
            if shutter.rolling:
                camera_at_row(cameras, shutter, i, v, R_rowC, p_rowC)
                R_C, p_C = R_rowC, p_rowC
            _in_camera(poses.R_fh[f, host], poses.t_fh[f, host], R_C, p_C, landmarks[i, 2], q, b, X)
            _residual(X, x, y, to_px[i, v], on_sphere, T, r)
            if lens.varied:
                _add_lens(lens, i, v, cameras.intrinsics[c], r)
            squared = r[0] * r[0] + r[1] * r[1]
            cost += share[i, v] * 0.5 * cauchy * cauchy * math.log(1.0 + squared / (sigma * sigma * cauchy * cauchy))
            total += squared / (sigma * sigma)
            if X[2] <= _LEAST_DEPTH_RATIO:
                total = np.inf
            views += 1
        errors[i] = math.sqrt(0.5 * total / max(views, 1))
    return cost, errors


@kernel
def linearise(poses: Poses, first: Poses, cameras: Calibrated, s: Sightings, landmarks: Float) -> Linearised:
    seen, share, xy, velocity, to_px, sigma, cauchy, on_sphere, shutter, lens = s
    rolling = shutter.rolling
    count, views = seen.shape
    N = len(cameras.p_BC)
    at_cameras = 6 * (views // N)
    n = at_cameras + CALIBRATION_SIZE * N
    H, g = np.zeros((n, n)), np.zeros(n)
    V, W, c = np.zeros((count, 3, 3)), np.zeros((count, 3, n)), np.zeros((count, 3))
    cost, squares, sightings, behind = 0.0, np.zeros(count), np.zeros(count), np.zeros(count, np.bool_)
    hosted, begins = _sorted(_ends(seen)[0], views)

    # Of all sightings of a view whose landmarks have the same host: by [dtheta_host dp_host dtheta_frame camera], and
    # where the host is another camera's by [dtheta_BD dp_BD] of that, the residual behind it. By dp_frame it is minus
    # that by dp_host.
    rows, own = np.zeros((2 * count + 2, 32)), np.empty((31, 32))
    D, J_m = np.empty((2, 3)), np.empty((2, 3))
    q, b, X, r, T = np.empty(3), np.empty(3), np.empty(3), np.empty(2), np.empty((2, 3))
    by_offset, p_row = np.empty(2), np.empty(3)
    R_rowC, p_rowC = np.empty((3, 3)), np.empty(3)
    now, then = _empty_view(), _empty_view()
    for host in range(views):
        h, d = host // N, host % N
        R_BD, p_BD, at_host = cameras.R_BC[d], cameras.p_BC[d], at_cameras + CALIBRATION_SIZE * d
        for view in range(host, views):
            f, of = view // N, view % N
            R_BC, p_BC, at_camera = cameras.R_BC[of], cameras.p_BC[of], at_cameras + CALIBRATION_SIZE * of
            offset_s = cameras.offset_s[of]
            moved, across = h != f, d != of
            width = 31 if across else 25
            # In the host itself a landmark is where it was seen, unless rows are read at different times.
            apart = moved or across or rolling
            filled = 0
            R_fh, t_fh, R_BW = first.R_fh[f, h], first.t_fh[f, h], first.R_WB[f].T
            set_matrix(R_rowC, R_BC)
            set_vector(p_rowC, p_BC)
            _view(poses.R_fh[f, h], poses.t_fh[f, h], R_rowC, p_rowC, R_BD, p_BD, now)
            _view(R_fh, t_fh, R_rowC, p_rowC, R_BD, p_BD, then)
            M, B, t = then
            for i in hosted[begins[host] : begins[host + 1]]:
                if not seen[i, view]:
                    continue
                m_x, m_y, rho = landmarks[i, 0], landmarks[i, 1], landmarks[i, 2]
                vx, vy = velocity[i, view, 0], velocity[i, view, 1]
                px = to_px[i, view]
                if rolling:
                    camera_at_row(cameras, shutter, i, view, R_rowC, p_rowC)
                    _view(poses.R_fh[f, h], poses.t_fh[f, h], R_rowC, p_rowC, R_BD, p_BD, now)
                    _view(R_fh, t_fh, R_rowC, p_rowC, R_BD, p_BD, then)
                _direction(now, m_x, m_y, rho, X)
                _residual(X, xy[i, view, 0] - offset_s * vx, xy[i, view, 1] - offset_s * vy, px, on_sphere, T, r)
                if lens.varied:
                    _add_lens(lens, i, view, cameras.intrinsics[of], r)
                squared = (r[0] * r[0] + r[1] * r[1]) / (sigma * sigma)
                cost += share[i, view] * 0.5 * cauchy * cauchy * math.log(1.0 + squared / (cauchy * cauchy))
                squares[i] += squared
                sightings[i] += 1.0
                behind[i] |= X[2] <= _LEAST_DEPTH_RATIO
                scale = math.sqrt(share[i, view] / (1.0 + squared / (cauchy * cauchy))) / sigma

                _direction(then, m_x, m_y, rho, X)
                _residual_jacobian(X, vx, vy, px, on_sphere, T, D, by_offset)
                for k in range(3):
                    q[k] = R_BD[k, 0] * m_x + R_BD[k, 1] * m_y + R_BD[k, 2] + rho * p_BD[k]
                    b[k] = R_rowC[k, 0] * X[0] + R_rowC[k, 1] * X[1] + R_rowC[k, 2] * X[2] + rho * p_rowC[k]
                for a in range(2):
                    J = rows[filled + a]
                    J[width] = scale * r[a]
                    d_0, d_1, d_2 = scale * D[a, 0], scale * D[a, 1], scale * D[a, 2]
                    # By the landmark's ray in its host, and by its points in the bodies of host and frame.
                    c_0 = d_0 * M[0, 0] + d_1 * M[1, 0] + d_2 * M[2, 0]
                    c_1 = d_0 * M[0, 1] + d_1 * M[1, 1] + d_2 * M[2, 1]
                    c_2 = d_0 * M[0, 2] + d_1 * M[1, 2] + d_2 * M[2, 2]
                    B_0 = d_0 * B[0, 0] + d_1 * B[1, 0] + d_2 * B[2, 0]
                    B_1 = d_0 * B[0, 1] + d_1 * B[1, 1] + d_2 * B[2, 1]
                    B_2 = d_0 * B[0, 2] + d_1 * B[1, 2] + d_2 * B[2, 2]
                    A_0 = d_0 * R_rowC[0, 0] + d_1 * R_rowC[0, 1] + d_2 * R_rowC[0, 2]
                    A_1 = d_0 * R_rowC[1, 0] + d_1 * R_rowC[1, 1] + d_2 * R_rowC[1, 2]
                    A_2 = d_0 * R_rowC[2, 0] + d_1 * R_rowC[2, 1] + d_2 * R_rowC[2, 2]
                    J_m[a, 0], J_m[a, 1] = c_0, c_1
                    if moved:
                        J[0], J[1], J[2] = q[1] * B_2 - q[2] * B_1, q[2] * B_0 - q[0] * B_2, q[0] * B_1 - q[1] * B_0
                        J[3] = rho * (A_0 * R_BW[0, 0] + A_1 * R_BW[1, 0] + A_2 * R_BW[2, 0])
                        J[4] = rho * (A_0 * R_BW[0, 1] + A_1 * R_BW[1, 1] + A_2 * R_BW[2, 1])
                        J[5] = rho * (A_0 * R_BW[0, 2] + A_1 * R_BW[1, 2] + A_2 * R_BW[2, 2])
                        J[6], J[7], J[8] = A_1 * b[2] - A_2 * b[1], A_2 * b[0] - A_0 * b[2], A_0 * b[1] - A_1 * b[0]
                    else:
                        for k in range(9):
                            J[k] = 0.0
                    if rolling:
                        a_0 = d_0 * R_BC[0, 0] + d_1 * R_BC[0, 1] + d_2 * R_BC[0, 2]
                        a_1 = d_0 * R_BC[1, 0] + d_1 * R_BC[1, 1] + d_2 * R_BC[1, 2]
                        a_2 = d_0 * R_BC[2, 0] + d_1 * R_BC[2, 1] + d_2 * R_BC[2, 2]
                    else:
                        a_0, a_1, a_2 = A_0, A_1, A_2
                    J_m[a, 2] = d_0 * t[0] + d_1 * t[1] + d_2 * t[2] if apart else 0.0
                    if across:
                        J[9], J[10], J[11] = d_1 * X[2] - d_2 * X[1], d_2 * X[0] - d_0 * X[2], d_0 * X[1] - d_1 * X[0]
                        J[12], J[13], J[14] = -rho * a_0, -rho * a_1, -rho * a_2
                        J[25], J[26], J[27] = m_y * c_2 - c_1, c_0 - m_x * c_2, m_x * c_1 - m_y * c_0
                        J[28], J[29], J[30] = rho * B_0, rho * B_1, rho * B_2
                    elif apart:
                        J[9] = d_1 * X[2] - d_2 * X[1] + m_y * c_2 - c_1
                        J[10] = d_2 * X[0] - d_0 * X[2] + c_0 - m_x * c_2
                        J[11] = d_0 * X[1] - d_1 * X[0] + m_x * c_1 - m_y * c_0
                        J[12], J[13], J[14] = rho * (B_0 - a_0), rho * (B_1 - a_1), rho * (B_2 - a_2)
                    else:
                        for k in range(9, 15):
                            J[k] = 0.0
                    J[15], J[16] = scale * by_offset[a], 0.0
                    if rolling:
                        for k in range(3):
                            p_row[k] = rho * p_BC[k] + R_BC[k, 0] * X[0] + R_BC[k, 1] * X[1] + R_BC[k, 2] * X[2]
                        rate, v_B = shutter.rate_B[f], shutter.velocity_B[f]
                        J[16] -= a_0 * (rate[1] * p_row[2] - rate[2] * p_row[1]) + rho * A_0 * v_B[0]
                        J[16] -= a_1 * (rate[2] * p_row[0] - rate[0] * p_row[2]) + rho * A_1 * v_B[1]
                        J[16] -= a_2 * (rate[0] * p_row[1] - rate[1] * p_row[0]) + rho * A_2 * v_B[2]
                        J[16] *= shutter.row[i, view]
                    if lens.varied:
                        for k in range(8):
                            J[17 + k] = scale * lens.px[i, view, a, k]

                J_0, J_1 = rows[filled], rows[filled + 1]
                filled += 2
                for k in range(3):
                    a_0, a_1 = J_m[0, k], J_m[1, k]
                    c[i, k] += a_0 * J_0[width] + a_1 * J_1[width]
                    for v in range(3):
                        V[i, k, v] += a_0 * J_m[0, v] + a_1 * J_m[1, v]
                    w = W[i, k]
                    for v in range(CALIBRATION_SIZE):
                        w[at_camera + v] += a_0 * J_0[9 + v] + a_1 * J_1[9 + v]
                    if across:
                        for v in range(6):
                            w[at_host + v] += a_0 * J_0[25 + v] + a_1 * J_1[25 + v]
                    if moved:
                        for v in range(6):
                            w[6 * h + v] += a_0 * J_0[v] + a_1 * J_1[v]
                        for v in range(3):
                            w[6 * f + v] += a_0 * J_0[6 + v] + a_1 * J_1[6 + v]
                            w[6 * f + 3 + v] -= a_0 * J_0[3 + v] + a_1 * J_1[3 + v]
            if filled:
                _squared(rows, filled, width, own)
                _add_own(own, h, f, at_host, at_camera, H, g)
    errors = np.empty(count)
    for i in range(count):
        errors[i] = np.inf if behind[i] else math.sqrt(0.5 * squares[i] / max(sightings[i], 1.0))
    return H, g, V, W, c, cost, errors


@kernel
def _ends(seen: Bool) -> tuple[Int, Int]:
    """(L,) and (L,): the first and the last frame that saw each landmark; K and 0 where none did."""
    count, frames = seen.shape
    first, last = np.full(count, frames), np.zeros(count, np.int64)
    for i in range(count):
        for f in range(frames):
            if seen[i, f]:
                first[i], last[i] = min(first[i], f), f
    return first, last


@kernel
def _sorted(keys: Int, most: int) -> tuple[Int, Int]:
    """The order of ``keys`` (N,), which lie within 0 and ``most``, and where in it each of them begins."""
    begins = np.zeros(most + 2, np.int64)
    for key in keys:
        begins[key + 1] += 1
    for key in range(most + 1):
        begins[key + 1] += begins[key]
    order, at = np.empty(len(keys), np.int64), begins.copy()
    for i in range(len(keys)):
        order[at[keys[i]]] = i
        at[keys[i]] += 1
    return order, begins


@kernel(inlined=True)
def _squared(rows: Float, count: int, width: int, out: Float) -> None:
    """Upper half of J^T [J r], J of ``width`` columns, of the first ``count`` rows, an even number, four at a time."""
    if count % 4:
        rows[count : count + 2] = 0.0
    out[:] = 0.0
    for k in range(0, count, 4):
        J_0, J_1, J_2, J_3 = rows[k], rows[k + 1], rows[k + 2], rows[k + 3]
        for u in range(width):
            own, a_0, a_1, a_2, a_3 = out[u], J_0[u], J_1[u], J_2[u], J_3[u]
            for v in range(u, width + 1):
                own[v] += a_0 * J_0[v] + a_1 * J_1[v] + a_2 * J_2[v] + a_3 * J_3[v]


@kernel
def _empty_view() -> View:
    return np.empty((3, 3)), np.empty((3, 3)), np.empty(3)


@kernel
def _view(R_fh: Float, t_fh: Float, R_rowC: Float, p_rowC: Float, R_BD: Float, p_BD: Float, view: View) -> None:
    """``view`` from the host: rotations from its camera and its body to the view's camera, and the translation."""
    R_CD, R_CB, t_C = view
    for i in range(3):
        for k in range(3):
            R_CB[i, k] = R_rowC[0, i] * R_fh[0, k] + R_rowC[1, i] * R_fh[1, k] + R_rowC[2, i] * R_fh[2, k]
    for i in range(3):
        t_C[i] = 0.0
        for k in range(3):
            R_CD[i, k] = R_CB[i, 0] * R_BD[0, k] + R_CB[i, 1] * R_BD[1, k] + R_CB[i, 2] * R_BD[2, k]
            t_C[i] += R_CB[i, k] * p_BD[k] + R_rowC[k, i] * (t_fh[k] - p_rowC[k])


@kernel
def _direction(view: View, x: float, y: float, rho: float, X: Float) -> None:
    """``X`` (3,): rho times the position in the view's camera of the landmark [x y rho]."""
    R_CD, _, t_C = view
    for i in range(3):
        X[i] = R_CD[i, 0] * x + R_CD[i, 1] * y + R_CD[i, 2] + rho * t_C[i]


@kernel(inlined=True)
def _add_own(own: Float, h: int, f: int, at_host: int, at_camera: int, H: Float, g: Float) -> None:
    """Add what :func:`_squared` makes of a view's sightings of a host's landmarks; of ``H`` the upper half.

    The entries of the cameras, that of the host and that of the view, begin at ``at_host`` and ``at_camera``.
    """
    at_h, at_f, across = 6 * h, 6 * f, at_host != at_camera
    width = 31 if across else 25
    if h != f:
        for u in range(9):
            row = at_h + u if u < 6 else at_f + u - 6
            g[row] += own[u, width]
            for v in range(u, 6):
                H[row, at_h + v] += own[u, v]
            for v in range(max(u, 6), 9):
                H[row, at_f + v - 6] += own[u, v]
            for v in range(9, 25):
                H[row, at_camera + v - 9] += own[u, v]
            for v in range(25, width):
                H[row, at_host + v - 25] += own[u, v]
            for v in range(3):  # dp_frame
                H[row, at_f + 3 + v] -= own[u, 3 + v] if u < 3 + v else own[3 + v, u]
        for u in range(3, 6):
            row = at_f + u
            g[row] -= own[u, width]
            for v in range(u, 6):
                H[row, at_f + v] += own[u, v]
            for v in range(9, 25):
                H[row, at_camera + v - 9] -= own[u, v]
            for v in range(25, width):
                H[row, at_host + v - 25] -= own[u, v]
    for u in range(9, 25):
        row = at_camera + u - 9
        g[row] += own[u, width]
        for v in range(u, 25):
            H[row, at_camera + v - 9] += own[u, v]
        for v in range(25, width):
            column = at_host + v - 25
            H[min(row, column), max(row, column)] += own[u, v]
    for u in range(25, width):
        row = at_host + u - 25
        g[row] += own[u, width]
        for v in range(u, width):
            H[row, at_host + v - 25] += own[u, v]
