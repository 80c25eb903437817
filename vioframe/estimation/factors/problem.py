"""What the solver minimises: prior, readings, standstill and sightings over the states of a window, and calibration.

The error vector is [dtheta dp dv dbg dba] of every state, oldest first, then [dtheta_BC dp_BC d_offset d_readout
d_intrinsics(8)] of every camera; landmarks are eliminated before it is solved for (Triggs et al., "Bundle Adjustment:
A Modern Synthesis", 2000, section 6.1). A state that has to go leaves all that its factors say about the others behind
as the prior (Sibley, Matthies, Sukhatme, "Sliding window filter with application to planetary landing", J. Field
Robotics 2010). Derivation: ``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Bool, Float
from vioframe.estimation.factors import inertial
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays, States, linearise_reading, retract
from vioframe.estimation.factors.reprojection import (
    CALIBRATION_SIZE,
    OFFSET,
    READOUT,
    Calibrated,
    Poses,
    Sightings,
    eliminate,
    linearise,
    relative_poses,
)
from vioframe.estimation.standstill import Standstill
from vioframe.geometry.kernels import exp, log, product, set_matrix
from vioframe.jit import kernel
from vioframe.types import NavState

STATE_SIZE = 15
PriorArrays = tuple[Float, Float, States, Calibrated, Bool]
"""A :class:`Prior` as kernels take it."""
Eliminated = tuple[Float, Float, Float]
"""Y, z and inverse factors of :func:`eliminate`."""
INFINITELY_FAR = 1e-4
"""An inverse depth, 1/m, that no parallax tells from zero."""
# Eigenvalues below this part of the largest tell nothing: rounding made them.
_NULL = 1e-12


@dataclass(frozen=True, slots=True)
class Variables:
    """K states, the calibration of N cameras, and L landmarks [x y rho]."""

    states: StateArrays
    cameras: Calibrated
    landmarks: Float

    @property
    def poses(self) -> Poses:
        return Poses.of(self.states.R_WB, self.states.p_WB)

    def retract(self, step: Float, landmark_step: Float) -> Variables:
        """Moved by ``step`` (15 K + 16 N,) and ``landmark_step`` (L, 3), but no landmark beyond infinity.

        Behind it, seen from the other side, they would fit a body that flies the other way.
        """
        states, cameras = _moved(self.states.parts, self.cameras, step)
        landmarks = self.landmarks + landmark_step
        np.maximum(landmarks[:, 2], INFINITELY_FAR, out=landmarks[:, 2])
        return Variables(StateArrays(*states), cameras, landmarks)


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known from frames that have left the window: half dx^T H dx + b^T dx about first estimates.

    ``states`` and ``cameras`` are the first estimates; ``frozen`` (K,) are the states that the prior knows of, to which
    alone they matter. ``H`` (n, n) is zero for the others.
    """

    H: Float
    b: Float
    states: StateArrays
    cameras: Calibrated
    frozen: Bool

    @staticmethod
    def of(state: NavState, cameras: Calibrated, cov: Float) -> Prior:
        """On a single state with covariance, and on N cameras with ``cov`` (16 N, 16 N), zero where they are fixed."""
        assert state.cov is not None
        H = np.zeros((STATE_SIZE + len(cov), STATE_SIZE + len(cov)))
        H[:STATE_SIZE, :STATE_SIZE] = np.linalg.inv(state.cov)
        H[STATE_SIZE:, STATE_SIZE:] = calibration_information(cov)
        return Prior(H, np.zeros(len(H)), StateArrays.stack([state]), cameras, np.ones(1, dtype=bool))

    def with_state(self, states: StateArrays) -> Prior:
        """The same on the window ``states`` (K + 1), of which it does not know the newest."""
        at = STATE_SIZE * len(self.frozen)
        old = np.r_[0:at, at + STATE_SIZE : len(self.b) + STATE_SIZE]
        H, b = np.zeros((len(self.b) + STATE_SIZE, len(self.b) + STATE_SIZE)), np.zeros(len(self.b) + STATE_SIZE)
        H[np.ix_(old, old)], b[old] = self.H, self.b
        return Prior(H, b, self.first(states[:-1]).append(states[-1:]), self.cameras, np.append(self.frozen, False))

    def without_newest(self) -> Prior:
        """The same without the newest state, of which it must not know."""
        assert not self.frozen[-1]
        at = STATE_SIZE * (len(self.frozen) - 1)
        keep = np.r_[0:at, at + STATE_SIZE : len(self.b)]
        return Prior(self.H[np.ix_(keep, keep)], self.b[keep], self.states[:-1], self.cameras, self.frozen[:-1])

    def difference(self, x: Variables) -> Float:
        """``x`` beyond the first estimates, (n,); zero for states that the prior does not know."""
        return _difference(self._parts, x.states.parts, x.cameras)

    @property
    def _parts(self) -> PriorArrays:
        return self.H, self.b, self.states.parts, self.cameras, self.frozen

    def first(self, states: StateArrays) -> StateArrays:
        """``states``, with the first estimates of those that are frozen in their place."""
        return states.with_those_of(self.states, self.frozen)


@dataclass(frozen=True, slots=True)
class Problem:
    """``readings`` are between consecutive states, from the first on; ``still`` is standstill by state.

    With ``first_estimates`` Jacobians are taken at the prior's first estimates wherever there are any.
    """

    prior: Prior
    readings: ImuFactors
    still: Mapping[int, Standstill]
    sightings: Sightings
    first_estimates: bool

    def cost(self, x: Variables) -> float:
        """Half the sum of squares, robust for the sightings, up to a constant."""
        return self.evaluated(x)[0]

    def evaluated(self, x: Variables) -> tuple[float, Float]:
        """The :meth:`cost`, and the landmarks' errors as in :class:`Normal`: a third of the work of the equations."""
        d, of_readings = self.prior.difference(x), self.reading_residuals(x.states).ravel()
        of_sightings, errors = self.sightings.evaluated(x.poses, x.cameras, x.landmarks)
        cost = d @ (0.5 * self.prior.H @ d + self.prior.b) + 0.5 * of_readings @ of_readings + of_sightings
        return float(cost + sum(0.5 * r @ r for _, _, r in self._stillness(x))), errors

    def linearise(self, x: Variables) -> Normal:
        """The normal equations at ``x``, and the cost."""
        states = x.states.parts
        equations = _normal_equations(
            self.prior._parts, self.readings, self.sightings, self.first_estimates, states, x.cameras, x.landmarks
        )
        normal = Normal(*equations, self.sightings.seen, len(x.cameras.p_BC))
        for k, still, residual in self._stillness(x):
            first = self.prior.first(x.states) if self.first_estimates else x.states
            J = -still.jacobian(first.R_WB[k], first.v_WB[k]) / still.sigma[:, None]
            at = slice(STATE_SIZE * k, STATE_SIZE * (k + 1))
            normal.H[at, at] += J.T @ J
            normal.b[at] += J.T @ residual
            normal.cost += 0.5 * float(residual @ residual)
        return normal

    def _stillness(self, x: Variables) -> Iterator[tuple[int, Standstill, Float]]:
        """The states that stand still, and what speaks against it, whitened."""
        for k, still in self.still.items():
            parts = (part[k] for part in x.states.parts if part is not x.states.p_WB)
            yield k, still, still.residual(*parts) / still.sigma

    def reading_residuals(self, states: StateArrays) -> Float:
        """Of the readings between each state and the next, whitened, (count, 15)."""
        count = len(self.readings.dt_s)
        r = self.readings.residuals(states[:count], states[1 : count + 1])
        return np.asarray((self.readings.sqrt_information @ r[..., None])[..., 0])


@dataclass(slots=True)
class Normal:
    """Normal equations [H W^T; W V], gradients b and c; ``W`` (L, 3, m) has the columns ``columns`` (m,) of H.

    Of ``H`` (n, n) the upper half counts. ``cost`` is that of the problem, ``errors`` (L,) are the landmarks' root mean
    square residuals (:meth:`Sightings.errors`), which are ``seen`` (L, V) by N ``cameras``.
    """

    H: Float
    b: Float
    V: Float
    W: Float
    c: Float
    cost: float
    errors: Float
    columns: NDArray[np.intp]
    seen: Bool
    cameras: int

    def reduced(self, damping: float) -> tuple[Float, Float, Eliminated]:
        """Damped equations S (n, n) and gradient (n,) without the landmarks, and what :meth:`landmark_step` needs.

        Of S the upper half counts.
        """
        landmarks = self.V, self.W, self.c
        return _reduced(self.H, self.b, landmarks, self.columns, self.seen, self.cameras, damping)

    def landmark_step(self, step: Float, eliminated: Eliminated) -> Float:
        """(L, 3), given the ``step`` (n,) of the rest."""
        return _landmark_step(eliminated, step[self.columns])


@kernel
def _moved(states: States, cameras: Calibrated, step: Float) -> tuple[States, Calibrated]:
    """States and cameras moved by ``step`` (15 K + 16 N,)."""
    n = STATE_SIZE * len(states[0])
    R_BC, p_BC, intrinsics = cameras.R_BC.copy(), cameras.p_BC.copy(), cameras.intrinsics.copy()
    offset_s, readout_s = cameras.offset_s.copy(), cameras.readout_s.copy()
    for c in range(len(p_BC)):
        d = step[n + CALIBRATION_SIZE * c : n + CALIBRATION_SIZE * (c + 1)]
        set_matrix(R_BC[c], product(R_BC[c], exp(d[:3])))
        for k in range(3):
            p_BC[c, k] += d[3 + k]
        for k in range(8):
            intrinsics[c, k] += d[8 + k]
        offset_s[c] += d[OFFSET]
        readout_s[c] += d[READOUT]
    moved = Calibrated(R_BC, p_BC, offset_s, readout_s, intrinsics)
    return retract(states, step[:n].reshape(-1, STATE_SIZE)), moved


@kernel
def _difference(prior: PriorArrays, states: States, cameras: Calibrated) -> Float:
    """What :meth:`Prior.difference` says."""
    _, b, first, given, frozen = prior
    out = np.zeros(len(b))
    moved = inertial.difference(states, first)
    for k in range(len(frozen)):
        if frozen[k]:
            for m in range(STATE_SIZE):
                out[STATE_SIZE * k + m] = moved[k, m]
    for c in range(len(cameras.p_BC)):
        own = out[STATE_SIZE * len(frozen) + CALIBRATION_SIZE * c :]
        rotation = log(product(given.R_BC[c].T, cameras.R_BC[c]))
        for k in range(3):
            own[k], own[3 + k] = rotation[k], cameras.p_BC[c, k] - given.p_BC[c, k]
        own[OFFSET] = cameras.offset_s[c] - given.offset_s[c]
        own[READOUT] = cameras.readout_s[c] - given.readout_s[c]
        for k in range(8):
            own[8 + k] = cameras.intrinsics[c, k] - given.intrinsics[c, k]
    return out


@kernel
def _normal_equations(
    prior: PriorArrays,
    readings: ImuFactors,
    sightings: Sightings,
    first_estimates: bool,
    states: States,
    cameras: Calibrated,
    landmarks: Float,
) -> tuple[Float, Float, Float, Float, Float, float, Float, NDArray[np.intp]]:
    """All but standstill of :meth:`Problem.linearise`."""
    frozen = prior[4] if first_estimates else np.zeros(len(prior[4]), np.bool_)
    first = _with_those_of(prior[2], states, frozen)
    d = _difference(prior, states, cameras)
    H, b = prior[0].copy(), prior[0] @ d
    cost = 0.0
    for k in range(len(d)):
        cost += d[k] * (0.5 * b[k] + prior[1][k])
        b[k] += prior[1][k]
    cost += _add_readings(readings, states, first, frozen, H, b)
    poses = Poses(*relative_poses(states[0], states[1]))
    first_poses = Poses(*relative_poses(first[0], first[1]))
    H_visual, b_visual, V, W, c, visual_cost, errors = linearise(poses, first_poses, cameras, sightings, landmarks)
    columns = pose_columns(len(frozen), len(cameras.p_BC))
    for u in range(len(columns)):
        b[columns[u]] += b_visual[u]
        own, visual = H[columns[u]], H_visual[u]
        for v in range(u, len(columns)):
            own[columns[v]] += visual[v]
    return H, b, V, W, c, cost + visual_cost, errors, columns


@kernel(inlined=True)
def _with_those_of(others: States, states: States, where: Bool) -> States:
    """What :meth:`StateArrays.with_those_of` gives."""
    R_WB, p_WB, v_WB = states[0].copy(), states[1].copy(), states[2].copy()
    bias_gyro_B, bias_accel_B = states[3].copy(), states[4].copy()
    for k in range(len(where)):
        if where[k]:
            set_matrix(R_WB[k], others[0][k])
            for m in range(3):
                p_WB[k, m], v_WB[k, m] = others[1][k, m], others[2][k, m]
                bias_gyro_B[k, m], bias_accel_B[k, m] = others[3][k, m], others[4][k, m]
    return R_WB, p_WB, v_WB, bias_gyro_B, bias_accel_B


@kernel(inlined=True)
def _add_readings(readings: ImuFactors, states: States, first: States, frozen: Bool, H: Float, b: Float) -> float:
    """Add to the upper half of ``H`` and to ``b``; returns the cost. Jacobians are taken at ``first``."""
    cost = 0.0
    r, r_first, r_white = np.empty(15), np.empty(15), np.empty(15)
    J, J_white = np.empty((15, 30)), np.empty((15, 30))
    for k in range(len(readings.dt_s)):
        linearise_reading(readings, k, states, k, states, k + 1, r, J)
        if frozen[k] or frozen[k + 1]:
            linearise_reading(readings, k, first, k, first, k + 1, r_first, J)
        L = readings.sqrt_information[k]
        J_white[:] = 0.0
        for i in range(15):
            r_white[i] = 0.0
            own = J_white[i]
            for m in range(i + 1):
                r_white[i] += L[i, m] * r[m]
                a, row = L[i, m], J[m]
                for v in range(30):
                    own[v] += a * row[v]
            cost += 0.5 * r_white[i] * r_white[i]
        at = STATE_SIZE * k
        for i in range(15):
            row = J_white[i]
            for u in range(30):
                a, own = row[u], H[at + u, at : at + 30]
                b[at + u] += a * r_white[i]
                for v in range(u, 30):
                    own[v] += a * row[v]
    return cost


@kernel
def _reduced(
    H: Float,
    b: Float,
    landmarks: tuple[Float, Float, Float],
    columns: NDArray[np.intp],
    seen: Bool,
    cameras: int,
    damping: float,
) -> tuple[Float, Float, Eliminated]:
    S, g = H.copy(), b.copy()
    for u in range(len(b)):
        S[u, u] *= 1.0 + damping
    V, W, c = landmarks
    S_visual, g_visual, eliminated = eliminate(seen, cameras, V, W, c, damping)
    for u in range(len(columns)):
        g[columns[u]] -= g_visual[u]
        own, visual = S[columns[u]], S_visual[u]
        for v in range(u, len(columns)):
            own[columns[v]] -= visual[v]
    return S, g, eliminated


@kernel
def _landmark_step(eliminated: Eliminated, step: Float) -> Float:
    Y, z, inverse = eliminated
    out = np.zeros(z.shape)
    right = Y.reshape(-1, len(step)) @ step
    for i in range(len(z)):
        for k in range(3):
            right_k = z[i, k] + right[3 * i + k]
            for m in range(k + 1):
                out[i, m] -= inverse[i, k, m] * right_k
    return out


def calibration_information(cov: Float) -> Float:
    """The inverse of a covariance (16 N, 16 N), with one for what is known for sure and stays as it is."""
    return np.linalg.inv(cov + np.diag(np.where(np.diag(cov) > 0.0, 0.0, 1.0)))


@kernel
def pose_columns(K: int, N: int) -> NDArray[np.intp]:
    """Indices of [dtheta dp] of every state, and of the calibration, in the error vector of K states and N cameras."""
    out = np.empty(6 * K + CALIBRATION_SIZE * N, np.intp)
    for u in range(6 * K):
        out[u] = STATE_SIZE * (u // 6) + u % 6
    for u in range(CALIBRATION_SIZE * N):
        out[6 * K + u] = STATE_SIZE * K + u
    return out


def marginalise_oldest(problem: Problem, x: Variables) -> Prior:
    """The prior on all states but the first, and calibration, that replaces all of ``problem``.

    ``problem`` holds just the factors that touch the first state. Its landmarks go with it, robust weights as they are
    at ``x``. States it touches are frozen at ``x`` unless they were before.
    """
    S, b, _ = problem.linearise(x).reduced(0.0)
    H = symmetric(S)
    K = len(x.states)
    touched = (H[: STATE_SIZE * K].reshape(K, -1) != 0.0).any(axis=1)
    prior = problem.prior
    first = prior.first(x.states)
    # The gradient at the first estimates, from which the prior counts.
    b = b - H @ prior.difference(x)
    H, b = schur(H, b, STATE_SIZE)
    return Prior(H, b, first[1:], prior.cameras, (prior.frozen | touched)[1:])


def symmetric(S: Float) -> Float:
    """The whole of a matrix of which the upper half counts."""
    upper = np.triu(S)
    return upper + np.triu(S, 1).T


def schur(H: Float, b: Float, count: int) -> tuple[Float, Float]:
    """Equations without the first ``count`` unknowns, which are at their best for whatever the others are.

    Directions of which ``H`` knows nothing are left out by a pseudo-inverse.
    """
    m, r = slice(0, count), slice(count, None)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H)[m], 1e-12))
    values, U = np.linalg.eigh(H[m, m] * scale[:, None] * scale)
    good = values > _NULL * values[-1]
    half = (scale[:, None] * U[:, good]) / np.sqrt(values[good])
    Z = half.T @ H[m, r]
    reduced = H[r, r] - Z.T @ Z
    return 0.5 * (reduced + reduced.T), b[r] - Z.T @ (half.T @ b[m])
