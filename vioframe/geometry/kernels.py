"""Compiled scalar twins of :mod:`so3`, which tests hold equal to it, small matrices, and the lenses of :mod:`cameras`.

Importing this module loads numba.
"""

import math

import numpy as np

from vioframe.arrays import Float
from vioframe.jit import kernel

_Pair = tuple[float, float]

RADTAN, EQUIDISTANT = 0, 1
"""Numbers of the models, as :func:`cameras.intrinsics_of` gives them."""


# Kernels set parts of arrays by the next two: for ``out[:] = v`` numba compiles what writes a message about shapes that
# differ into each, which takes longer than all the rest.


@kernel(inlined=True)
def set_vector(out: Float, v: Float) -> None:
    """Fill ``out`` (n,) with ``v`` (n,)."""
    for i in range(len(out)):
        out[i] = v[i]


@kernel(inlined=True)
def set_matrix(out: Float, M: Float) -> None:
    """Fill ``out`` (m, n) with ``M`` (m, n)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = M[i, j]


@kernel
def hat(v: Float) -> Float:
    """(3,) -> (3, 3) skew matrix."""
    out = np.zeros((3, 3))
    out[0, 1], out[0, 2], out[1, 2] = -v[2], v[1], -v[0]
    out[1, 0], out[2, 0], out[2, 1] = v[2], -v[1], v[0]
    return out


@kernel
def cross(a: Float, b: Float) -> Float:
    """(3,) x (3,) -> (3,)."""
    out = np.empty(3)
    out[0], out[1], out[2] = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return out


@kernel
def product(A: Float, B: Float) -> Float:
    """(m, 3) x (3, n) -> (m, n), without the detour over BLAS that ``@`` makes."""
    out = np.empty((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]
    return out


@kernel
def turned(R: Float, v: Float) -> Float:
    """(m, 3) x (3,) -> (m,)."""
    out = np.empty(R.shape[0])
    for i in range(R.shape[0]):
        out[i] = R[i, 0] * v[0] + R[i, 1] * v[1] + R[i, 2] * v[2]
    return out


@kernel
def inverse_cholesky(A: Float) -> Float:
    """The inverse of the lower Cholesky factor of ``A`` (3, 3); where it is not positive definite, NaN or infinite."""
    l00 = math.sqrt(A[0, 0])
    l10, l20 = A[1, 0] / l00, A[2, 0] / l00
    l11 = math.sqrt(A[1, 1] - l10 * l10)
    l21 = (A[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(A[2, 2] - l20 * l20 - l21 * l21)
    out = np.zeros((3, 3))
    out[0, 0], out[1, 1], out[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    out[1, 0], out[2, 1] = -l10 * out[0, 0] * out[1, 1], -l21 * out[1, 1] * out[2, 2]
    out[2, 0] = -(l20 * out[0, 0] + l21 * out[1, 0]) * out[2, 2]
    return out


@kernel
def whiten(A: Float, B: Float) -> None:
    """``B`` (n, m) becomes L^-1 B, with L the lower Cholesky factor of ``A`` (n, n), which is used up.

    Where ``A`` is not positive definite, NaN.
    """
    n, m = B.shape
    for j in range(n):
        above, of_above = A[j], B[j]
        root = math.sqrt(above[j])
        for k in range(j, n):
            above[k] /= root
        for k in range(m):
            of_above[k] /= root
        for i in range(j + 1, n):
            factor, row, of_row = above[i], A[i], B[i]
            for k in range(i, n):
                row[k] -= factor * above[k]
            for k in range(m):
                of_row[k] -= factor * of_above[k]


@kernel
def exp(phi: Float) -> Float:
    """(3,) rad -> (3, 3) rotation."""
    a2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if a2 < 1e-8:
        sinc, cosc = 1.0 - a2 / 6.0, 0.5 - a2 / 24.0
    else:
        a = math.sqrt(a2)
        sinc, cosc = math.sin(a) / a, (1.0 - math.cos(a)) / a2
    x, y, z = phi[0], phi[1], phi[2]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - cosc * (y * y + z * z), cosc * x * y - sinc * z, cosc * x * z + sinc * y
    R[1, 0], R[1, 1], R[1, 2] = cosc * x * y + sinc * z, 1.0 - cosc * (x * x + z * z), cosc * y * z - sinc * x
    R[2, 0], R[2, 1], R[2, 2] = cosc * x * z - sinc * y, cosc * y * z + sinc * x, 1.0 - cosc * (x * x + y * y)
    return R


@kernel
def turned_by(R: Float, phi: Float) -> Float:
    """R_k Exp(phi_k) of (N, 3, 3) and (N, 3) rad."""
    out = np.empty((len(R), 3, 3))
    for k in range(len(R)):
        set_matrix(out[k], product(R[k], exp(phi[k])))
    return out


@kernel
def camera_later(
    R_BC: Float, p_BC: Float, late_s: float, rate_B: Float, velocity_B: Float, R_lateC: Float, p_lateC: Float
) -> None:
    """Fill ``R_lateC`` (3, 3) and ``p_lateC`` (3,) with a camera ``late_s`` after a stamp, seen from the body at it."""
    turn = exp(late_s * rate_B)
    for i in range(3):
        p_lateC[i] = turn[i, 0] * p_BC[0] + turn[i, 1] * p_BC[1] + turn[i, 2] * p_BC[2] + late_s * velocity_B[i]
        for j in range(3):
            R_lateC[i, j] = turn[i, 0] * R_BC[0, j] + turn[i, 1] * R_BC[1, j] + turn[i, 2] * R_BC[2, j]


@kernel
def log(R: Float) -> Float:
    """(3, 3) rotation -> (3,) rad with norm <= pi, exact near pi: of the quaternion the largest component divides."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    v, best = np.empty(3), 3
    for a in range(3):
        if R[a, a] > (trace if best == 3 else R[best, best]):
            best = a
    if best == 3:
        w = 1.0 + trace
        v[0], v[1], v[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        b, c = (best + 1) % 3, (best + 2) % 3
        w = R[c, b] - R[b, c]
        v[best], v[b], v[c] = 1.0 - trace + 2.0 * R[best, best], R[b, best] + R[best, b], R[c, best] + R[best, c]
        if w < 0.0:
            w, v = -w, -v
    n = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    q = n / math.sqrt(n * n + w * w)
    # 2 atan2(n, w) / n of the unit quaternion, which tends to 2.
    return v * (2.0 * math.atan2(n, w) / n if q > 1e-8 else 2.0 / w)


@kernel
def right_jacobian(phi: Float) -> Float:
    """(3,) rad -> (3, 3), J_r with Exp(phi + d) ~ Exp(phi) Exp(J_r d)."""
    a2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if a2 < 1e-8:
        cosc, sinc3 = 0.5 - a2 / 24.0, 1.0 / 6.0 - a2 / 120.0
    else:
        a = math.sqrt(a2)
        cosc, sinc3 = (1.0 - math.cos(a)) / a2, (a - math.sin(a)) / (a2 * a)
    x, y, z = phi[0], phi[1], phi[2]
    J = np.empty((3, 3))
    J[0, 0], J[0, 1], J[0, 2] = 1.0 - sinc3 * (y * y + z * z), sinc3 * x * y + cosc * z, sinc3 * x * z - cosc * y
    J[1, 0], J[1, 1], J[1, 2] = sinc3 * x * y - cosc * z, 1.0 - sinc3 * (x * x + z * z), sinc3 * y * z + cosc * x
    J[2, 0], J[2, 1], J[2, 2] = sinc3 * x * z + cosc * y, sinc3 * y * z - cosc * x, 1.0 - sinc3 * (x * x + y * y)
    return J


@kernel
def right_jacobian_inverse(phi: Float) -> Float:
    """(3,) rad -> (3, 3), J_r^-1 with Log(Exp(phi) Exp(d)) ~ phi + J_r^-1 d."""
    a2 = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    if a2 < 1e-8:
        c = 1.0 / 12.0 + a2 / 720.0
    else:
        half = 0.5 * math.sqrt(a2)
        c = (1.0 - half * math.cos(half) / math.sin(half)) / a2
    x, y, z = phi[0], phi[1], phi[2]
    J = np.empty((3, 3))
    J[0, 0], J[0, 1], J[0, 2] = 1.0 - c * (y * y + z * z), c * x * y - 0.5 * z, c * x * z + 0.5 * y
    J[1, 0], J[1, 1], J[1, 2] = c * x * y + 0.5 * z, 1.0 - c * (x * x + z * z), c * y * z - 0.5 * x
    J[2, 0], J[2, 1], J[2, 2] = c * x * z - 0.5 * y, c * y * z + 0.5 * x, 1.0 - c * (x * x + y * y)
    return J


@kernel
def distort(model: int, k: Float, x: float, y: float) -> tuple[_Pair, tuple[_Pair, _Pair]]:
    """A point on the z = 1 plane -> pixel and its Jacobian d px / d (x, y); for tuples nothing is allocated."""
    r2 = x * x + y * y
    if model == RADTAN:
        radial = 1.0 + r2 * (k[4] + k[5] * r2)
        slope = 2.0 * (k[4] + 2.0 * k[5] * r2)
        u = x * radial + 2.0 * k[6] * x * y + k[7] * (r2 + 2.0 * x * x)
        v = y * radial + k[6] * (r2 + 2.0 * y * y) + 2.0 * k[7] * x * y
        u_x = radial + slope * x * x + 2.0 * k[6] * y + 6.0 * k[7] * x
        v_y = radial + slope * y * y + 6.0 * k[6] * y + 2.0 * k[7] * x
        across = slope * x * y + 2.0 * k[6] * x + 2.0 * k[7] * y
    else:
        r = math.sqrt(r2)
        t = math.atan(r)
        t2 = t * t
        if r < 1e-6:
            scale, slope = 1.0, 2.0 * (k[4] - 1.0 / 3.0)
        else:
            scale = t * (1.0 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7])))) / r
            d_t = 1.0 + t2 * (3.0 * k[4] + t2 * (5.0 * k[5] + t2 * (7.0 * k[6] + t2 * 9.0 * k[7])))
            slope = (d_t / (1.0 + r2) - scale) / r2
        u, v = x * scale, y * scale
        u_x, v_y, across = scale + slope * x * x, scale + slope * y * y, slope * x * y
    px = k[0] * u + k[2], k[1] * v + k[3]
    return px, ((u_x * k[0], across * k[0]), (across * k[1], v_y * k[1]))


@kernel
def intrinsics_jacobian(model: int, k: Float, x: float, y: float, J: Float) -> None:
    """Fill ``J`` (2, 8) with d px / d [fx fy cx cy d1 d2 d3 d4] at a point of the z = 1 plane."""
    J[:] = 0.0
    r2 = x * x + y * y
    if model == RADTAN:
        radial = 1.0 + r2 * (k[4] + k[5] * r2)
        J[0, 0] = x * radial + 2.0 * k[6] * x * y + k[7] * (r2 + 2.0 * x * x)
        J[1, 1] = y * radial + k[6] * (r2 + 2.0 * y * y) + 2.0 * k[7] * x * y
        J[0, 4], J[1, 4] = k[0] * x * r2, k[1] * y * r2
        J[0, 5], J[1, 5] = k[0] * x * r2 * r2, k[1] * y * r2 * r2
        J[0, 6], J[1, 6] = k[0] * 2.0 * x * y, k[1] * (r2 + 2.0 * y * y)
        J[0, 7], J[1, 7] = k[0] * (r2 + 2.0 * x * x), k[1] * 2.0 * x * y
    else:
        r = math.sqrt(r2)
        t = math.atan(r)
        over_r = 1.0 if r < 1e-9 else 1.0 / r
        t2 = t * t
        scale = 1.0 if r < 1e-9 else t * (1.0 + t2 * (k[4] + t2 * (k[5] + t2 * (k[6] + t2 * k[7])))) / r
        J[0, 0], J[1, 1] = x * scale, y * scale
        power = t
        for i in range(4):
            power *= t2
            J[0, 4 + i], J[1, 4 + i] = k[0] * x * power * over_r, k[1] * y * power * over_r
    J[0, 2] = J[1, 3] = 1.0


@kernel
def undistort(model: int, k: Float, px: float, py: float, x: float, y: float) -> tuple[float, float]:
    """The point of the z = 1 plane that is drawn at pixel (px, py), by Newton's method from the guess (x, y)."""
    for _ in range(5):
        xy, J = distort(model, k, x, y)
        ex, ey = xy[0] - px, xy[1] - py
        if abs(ex) + abs(ey) < 1e-6:
            break
        det = J[0][0] * J[1][1] - J[0][1] * J[1][0]
        x -= (J[1][1] * ex - J[0][1] * ey) / det
        y -= (J[0][0] * ey - J[1][0] * ex) / det
    return x, y


@kernel
def distorted(model: int, k: Float, xy_normalised: Float) -> Float:
    """(N, 2) on the z = 1 plane -> (N, 2) px."""
    out = np.empty(xy_normalised.shape)
    for i in range(len(out)):
        px, _ = distort(model, k, xy_normalised[i, 0], xy_normalised[i, 1])
        out[i, 0], out[i, 1] = px
    return out


@kernel
def undistorted(model: int, k: Float, xy: Float) -> Float:
    """(N, 2) px -> (N, 2) on the z = 1 plane, by Newton's method; NaN where the model cannot be inverted."""
    plane = np.zeros(8)  # of a camera that draws on the z = 1 plane itself
    plane[0] = plane[1] = 1.0
    for i in range(4, 8):
        plane[i] = k[i]
    out = np.empty(xy.shape)
    for i in range(len(xy)):
        u, v = (xy[i, 0] - k[2]) / k[0], (xy[i, 1] - k[3]) / k[1]
        x, y = u, v
        if model == EQUIDISTANT:
            # The distorted radius is nearly the angle from the axis; start from the undistorted tangent.
            theta = math.sqrt(u * u + v * v)
            stretch = math.tan(min(theta, 1.5)) / theta if theta > 1e-9 else 1.0
            x, y = stretch * u, stretch * v
        for _ in range(20):
            uv, J = distort(model, plane, x, y)
            ex, ey = uv[0] - u, uv[1] - v
            det = J[0][0] * J[1][1] - J[0][1] * J[1][0]
            if abs(ex) < 1e-12 and abs(ey) < 1e-12:
                break
            x -= (J[1][1] * ex - J[0][1] * ey) / det
            y -= (J[0][0] * ey - J[1][0] * ex) / det
        # Past the fold of the distortion the image is mirrored: a solution there is not where the camera looks.
        solved = abs(ex) < 1e-6 and abs(ey) < 1e-6 and det > 0.0
        out[i, 0], out[i, 1] = (x, y) if solved else (math.nan, math.nan)
    return out
