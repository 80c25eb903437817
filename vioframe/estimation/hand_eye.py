"""How camera and gyroscope belong together: time offset, the camera's rotation on the body, and its focal length.

A rotation R_BiBj of the body is R_BC R_CiCj R_BC' seen by the camera (Park, Martin, "Robot Sensor Calibration: Solving
AX = XB on the Euclidean Group", T-RA 1994). Of the camera's turns, which come from tracks alone
(:mod:`vioframe.estimation.turns`), and the readings of the gyroscope this makes equations for all that can keep the two
apart: a bias, the rotation between them, readings that are early or late (Li, Mourikis, "Online temporal calibration
for camera-IMU systems", IJRR 2014), and a focal length that makes turns look larger or smaller than they are.
Translation plays no part, so that neither scale, gravity nor the lever arm need be known. Derivation:
``docs/derivations/initialization.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.estimation.inertial.gyro_path import GyroPath
from vioframe.estimation.turns import Turn
from vioframe.geometry import kernels, so3
from vioframe.geometry.kernels import product, set_matrix, set_vector
from vioframe.jit import kernel
from vioframe.types import NS_PER_S

Part = Literal["offset", "rotation", "focal"]
"""What may be other than given."""

BIAS_SIGMA = 0.2
"""Prior of the gyroscope's bias about zero, rad/s; that of EuRoC's IMU is 0.08."""
LARGEST_OFFSET_S = 0.2
"""How far from the given one a time offset is looked for."""
_GRID_S = 0.01
# What turns are off by beside their noise, rad: distortion, rolling shutter, patches that creep.
_FLOOR = 1e-3
# Turns that are off by more than this many standard deviations begin to count less.
_CAUCHY = 3.0
_COLUMNS: dict[Part, slice] = {"rotation": slice(3, 6), "offset": slice(6, 7), "focal": slice(7, 8)}
_ITERATIONS, _GRID_ITERATIONS, _SETTLED = 15, 4, 1e-4
_LARGEST_STEP = np.array([np.inf] * 3 + [0.3] * 3 + [0.03, 0.05])
# The 24 rotations of a cube: none is farther than 62 deg from one of them. Tried with every so manieth offset.
_ANY_ROTATION = so3.signed_permutations(1)
_COARSE = 5
# The median of chi2 with three degrees of freedom.
_MEDIAN_CHI2 = 2.366


@dataclass(frozen=True, slots=True)
class HandEye:
    """What makes readings and turns agree: ``bias_gyro_B`` (3,) rad/s, ``R_BC`` (3, 3), and two that add to the given.

    ``offset_s`` is added to the time offset, so that ``t_imu = t_cam + offset``; the focal length is ``exp(log_focal)``
    times the given one. ``cov`` (8, 8) is of [bias rotation offset log_focal], zero where a part is as given.
    """

    bias_gyro_B: Float
    R_BC: Float
    offset_s: float = 0.0
    log_focal: float = 0.0
    cov: Float | None = None

    def sigma(self, part: Part) -> float:
        """Standard deviation of a part, s, rad or relative; of a rotation about the axis that is known worst."""
        assert self.cov is not None
        block = self.cov[_COLUMNS[part], _COLUMNS[part]]
        return float(np.sqrt(np.linalg.eigvalsh(block)[-1]))


class Turns:
    """P turns of a camera beside the readings of a gyroscope at ``t_ns`` (N,), ``gyro_B`` (N, 3) rad/s.

    Only turns are used whose readings are there whatever the offset. Of two that explain the tracks of a plane as well,
    the one counts that lies nearer to what the gyroscope has.
    """

    def __init__(self, turns: Sequence[Turn], t_ns: Int, gyro_B: Float) -> None:
        margin_ns = round(LARGEST_OFFSET_S * NS_PER_S)
        turns = [t for t in turns if t.t_ns[0] - margin_ns >= t_ns[0] and t.t_ns[1] + margin_ns <= t_ns[-1]]
        self._t_s, self._gyro_B = (t_ns - t_ns[0]) * 1e-9, gyro_B
        self._first, self._second = ((np.array([t.t_ns[k] for t in turns]) - t_ns[0]) * 1e-9 for k in (0, 1))
        self._dt = self._second - self._first
        either = [turns]
        if any(t.other for t in turns):
            either.append([t.other or t for t in turns])
        self._R_C1C2 = np.array([[t.R_C1C2 for t in some] for some in either]).reshape(len(either), -1, 3, 3)
        H = np.array([[t.H for t in some] for some in either]).reshape(len(either), -1, 4, 4)
        cov = np.linalg.inv(H[..., :3, :3])
        # A longer focal length turns R_C1C2 by this much.
        self._by_focal = -np.ascontiguousarray((cov @ H[..., :3, 3:])[..., 0])
        root = np.linalg.cholesky(np.linalg.inv(cov + _FLOOR**2 * np.eye(3)))
        self._whitener = np.ascontiguousarray(np.swapaxes(root, -1, -2))

    def __len__(self) -> int:
        return len(self._dt)

    def fit(self, start: HandEye, free: Sequence[Part]) -> tuple[HandEye, float]:
        """From ``start`` to where they agree best: the bias, and the parts that are ``free``; the variance they have.

        Variances are in terms of what the tracks' noise, a pixel, gives a turn.
        """
        active = np.r_[0:3, *(np.arange(8)[_COLUMNS[part]] for part in free)]
        x, variance = start, 1.0
        for _ in range(_ITERATIONS):
            r, J, _ = self._linearise(x)
            squared = (r * r).sum(axis=1)
            variance = max(float(np.median(squared)) / _MEDIAN_CHI2, 1e-4)
            weight = 1.0 / (1.0 + squared / (_CAUCHY**2 * variance)) / variance
            columns = J[:, :, active].reshape(-1, len(active))
            weighted = columns.T * np.repeat(weight, 3)
            H, g = weighted @ columns, weighted @ r.ravel()
            H[:3, :3] += np.eye(3) / BIAS_SIGMA**2
            g[:3] += x.bias_gyro_B / BIAS_SIGMA**2
            # Half a turn that nothing tells of is as likely as none.
            cov = np.linalg.inv(H + np.eye(len(H)) * 1e-6)
            step = np.zeros(8)
            step[active] = -cov @ g
            step *= min(1.0, float((_LARGEST_STEP / np.maximum(np.abs(step), 1e-12)).min()))
            x = HandEye(
                x.bias_gyro_B + step[:3], x.R_BC @ so3.exp(step[3:6]), x.offset_s + step[6], x.log_focal + step[7]
            )
            if np.abs(step).max() < _SETTLED:
                break
        full = np.zeros((8, 8))
        full[np.ix_(active, active)] = cov
        return replace(x, cov=full), variance

    def cost(self, x: HandEye, variance: float) -> float:
        """The robust sum of squares of what the turns are off by, in terms of ``variance``."""
        r, *_ = self._linearise(x)
        return float(_CAUCHY**2 * np.log1p((r * r).sum(axis=1) / (_CAUCHY**2 * variance)).sum())

    def unexplained(self, x: HandEye) -> float:
        """The typical turn that is left over with ``x``, over the typical turn beside a steady one."""
        r, _, which = self._linearise(x)
        turns = so3.log(self._R_C1C2[which])
        left = np.linalg.solve(self._whitener[which], r[..., None])[..., 0]
        size, beside = np.linalg.norm(left, axis=1), np.linalg.norm(turns - np.median(turns, axis=0), axis=1)
        return float(np.median(size) / max(np.median(beside), 1e-9))

    def nearest(self, start: HandEye, *, turned: bool) -> HandEye:
        """The best time offset within :data:`LARGEST_OFFSET_S`, to a grid, with the rotation of ``start`` or any.

        With each offset the bias is eliminated, which leaves an orthogonal Procrustes problem for the rotation.
        """
        offsets, beta = self._on_grid
        R_BC = start.R_BC[None]
        if turned and len(self._R_C1C2) > 1:
            # Which of two turns it was, only a rotation not too far from the right one tells.
            some = beta[::_COARSE]
            tried = np.tile(_ANY_ROTATION, (len(some), 1, 1))
            settled, _, typical = self._settled(np.repeat(some, len(_ANY_ROTATION), axis=0), tried, turned)
            R_BC = settled[[np.argmin(typical)]]
        R_BC, bias, typical = self._settled(beta, np.repeat(R_BC, len(offsets), axis=0), turned)
        best = int(np.argmin(typical))
        return HandEye(bias[best], R_BC[best], float(offsets[best]))

    def _settled(self, beta: Float, R_BC: Float, turned: bool) -> tuple[Float, Float, Float]:
        """From ``R_BC`` (G, 3, 3) and the gyroscope's turns (G, P, 3): R_BC, bias (G, 3) and typical distance (G,)."""
        gammas, dt = so3.log(self._R_C1C2), self._dt
        known = np.linalg.norm(self._whitener[0], axis=(1, 2))
        weight, bias = np.tile(known**2, (len(beta), 1)), np.zeros((len(beta), 3))
        for _ in range(_GRID_ITERATIONS):
            off = beta - dt[:, None] * bias[:, None] - np.einsum("gij,kpj->kgpi", R_BC, gammas)
            which = np.linalg.norm(off, axis=3).argmin(axis=0)
            gamma = gammas[which, np.arange(len(dt))]
            total = (weight * dt**2).sum(axis=1)[:, None]
            beta_dt, gamma_dt = (np.einsum("gp,p,gpi->gi", weight, dt, turns) for turns in (beta, gamma))
            if turned:
                moments = np.einsum("gp,gpi,gpj->gij", weight, beta, gamma)
                R_BC = so3.project(moments - beta_dt[:, :, None] * gamma_dt[:, None] / total[..., None])
            bias = (beta_dt - (R_BC @ gamma_dt[..., None])[..., 0]) / total
            off = beta - np.einsum("gij,gpj->gpi", R_BC, gamma) - dt[:, None] * bias[:, None]
            far = np.linalg.norm(off, axis=2) * known
            typical = np.median(far, axis=1)
            weight = known**2 / (1.0 + (far / np.maximum(1.5 * typical, 1e-3)[:, None]) ** 2)
        return R_BC, bias, typical

    @cached_property
    def _on_grid(self) -> tuple[Float, Float]:
        """Offsets (G,), and the gyroscope's turns (G, P, 3) with each, its bias left in them."""
        offsets = np.arange(-LARGEST_OFFSET_S, LARGEST_OFFSET_S + 1e-9, _GRID_S)
        path = GyroPath(self._t_s, self._gyro_B)
        R_1, R_2 = (path.at(t + offsets[:, None])[0] for t in (self._first, self._second))
        return offsets, so3.log(np.swapaxes(R_1, -1, -2) @ R_2)

    def _linearise(self, x: HandEye) -> tuple[Float, Float, tuple[Int, Int]]:
        """Whitened residuals (P, 3) and Jacobian (P, 3, 8) by [bias rotation offset log_focal], and which turns."""
        path = GyroPath(self._t_s, self._gyro_B - x.bias_gyro_B)
        seen = self._R_C1C2, self._by_focal, self._whitener
        r, J, which = _linearise(
            *path.at(self._first + x.offset_s),
            *path.at(self._second + x.offset_s),
            *seen,
            np.ascontiguousarray(x.R_BC),
            x.log_focal,
            self._dt,
        )
        return r, J, (which, np.arange(len(self)))


@kernel
def _linearise(
    R_1: Float,
    rate_1: Float,
    R_2: Float,
    rate_2: Float,
    R_C1C2: Float,
    by_focal: Float,
    whitener: Float,
    R_BC: Float,
    log_focal: float,
    dt: Float,
) -> tuple[Float, Float, Int]:
    """:meth:`Turns._linearise` with the body turned to ``R_1``, ``R_2`` (P, 3, 3), at ``rate_1``, ``rate_2`` (P, 3)."""
    n = len(dt)
    r, J, which = np.empty((n, 3)), np.empty((n, 3, 8)), np.zeros(n, np.int64)
    R_CB = np.ascontiguousarray(R_BC.T)
    D = np.empty((3, 8))
    for p in range(n):
        R_B2B1 = product(R_2[p].T, R_1[p])
        turned = product(product(R_CB, R_B2B1.T), R_BC)
        least = np.inf
        for k in range(len(R_C1C2)):
            beside = kernels.log(product(R_C1C2[k, p].T, turned)) - by_focal[k, p] * log_focal
            off = kernels.turned(whitener[k, p], beside)
            square = off[0] * off[0] + off[1] * off[1] + off[2] * off[2]
            if square < least:
                least, which[p] = square, k
                set_vector(r[p], off)
        R_CB1 = product(R_CB, R_B2B1)
        by_shift = kernels.turned(R_CB, rate_2[p] - kernels.turned(R_B2B1, rate_1[p]))
        for m in range(3):
            for n in range(3):
                D[m, n] = -0.5 * dt[p] * (R_CB[m, n] + R_CB1[m, n])
                D[m, 3 + n] = (1.0 if m == n else 0.0) - turned[n, m]
            D[m, 6], D[m, 7] = by_shift[m], -by_focal[which[p], p, m]
        set_matrix(J[p], product(whitener[which[p], p], D))
    return r, J, which


def top_beside(values: Float, best: int) -> float:
    """How far beside the largest of ``values`` (N,) the top of the parabola through its neighbours is, in places."""
    if not 0 < best < len(values) - 1:
        return 0.0
    before, at, after = values[best - 1 : best + 2]
    bend = before - 2.0 * at + after
    return float(0.5 * (before - after) / bend) if bend < 0.0 else 0.0
