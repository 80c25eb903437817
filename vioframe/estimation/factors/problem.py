"""What the solver minimises: prior, readings, standstill and sightings over the states of a window, and calibration.

The error vector is [dtheta dp dv dbg dba] of every state, oldest first, then [dtheta_BC dp_BC d_offset d_readout
d_intrinsics(8)]; landmarks are eliminated before it is solved for (Triggs et al., "Bundle Adjustment:
A Modern Synthesis", 2000, section 6.1). A state that has to go leaves all that its factors say about the others behind
as the prior (Sibley, Matthies, Sukhatme, "Sliding window filter with application to planetary landing", J. Field
Robotics 2010). Derivation: ``docs/derivations/sliding_window.md``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.arrays import Bool, Float
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.reprojection import (
    CALIBRATION_SIZE,
    INTRINSICS,
    OFFSET,
    READOUT,
    Calibrated,
    Poses,
    Sightings,
    eliminate,
)
from vioframe.estimation.standstill import Standstill
from vioframe.geometry import so3
from vioframe.types import NavState

STATE_SIZE = 15
# Eigenvalues below this part of the largest tell nothing: rounding made them.
_NULL = 1e-12


@dataclass(frozen=True, slots=True)
class Variables:
    """K states, the calibration, and L landmarks [x y rho]."""

    states: StateArrays
    camera: Calibrated
    landmarks: Float

    @property
    def poses(self) -> Poses:
        return Poses.of(self.states.R_WB, self.states.p_WB)

    def retract(self, step: Float, landmark_step: Float) -> Variables:
        """Moved by ``step`` (15 K + 16,) and ``landmark_step`` (L, 3)."""
        n = STATE_SIZE * len(self.states)
        camera, d = self.camera, step[n:]
        camera = Calibrated(
            camera.R_BC @ so3.exp(d[:3]),
            camera.p_BC + d[3:6],
            float(camera.offset_s + d[OFFSET]),
            float(camera.readout_s + d[READOUT]),
            camera.intrinsics + d[INTRINSICS],
        )
        states = self.states.retract(step[:n].reshape(-1, STATE_SIZE))
        return Variables(states, camera, self.landmarks + landmark_step)


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known from frames that have left the window: half dx^T H dx + b^T dx about first estimates.

    ``states`` and ``camera`` are the first estimates; ``frozen`` (K,) are the states that the prior knows of, to which
    alone they matter. ``H`` (n, n) is zero for the others.
    """

    H: Float
    b: Float
    states: StateArrays
    camera: Calibrated
    frozen: Bool

    @staticmethod
    def of(state: NavState, camera: Calibrated, camera_cov: Float) -> Prior:
        """On a single state with covariance, and on the calibration with ``camera_cov`` (16, 16), zero where fixed."""
        assert state.cov is not None
        H = np.zeros((STATE_SIZE + CALIBRATION_SIZE, STATE_SIZE + CALIBRATION_SIZE))
        H[:STATE_SIZE, :STATE_SIZE] = np.linalg.inv(state.cov)
        H[STATE_SIZE:, STATE_SIZE:] = calibration_information(camera_cov)
        return Prior(H, np.zeros(len(H)), StateArrays.stack([state]), camera, np.ones(1, dtype=bool))

    def with_state(self, states: StateArrays) -> Prior:
        """The same on the window ``states`` (K + 1), of which it does not know the newest."""
        at = STATE_SIZE * len(self.frozen)
        old = np.r_[0:at, at + STATE_SIZE : len(self.b) + STATE_SIZE]
        H, b = np.zeros((len(self.b) + STATE_SIZE, len(self.b) + STATE_SIZE)), np.zeros(len(self.b) + STATE_SIZE)
        H[np.ix_(old, old)], b[old] = self.H, self.b
        return Prior(H, b, self.first(states[:-1]).append(states[-1:]), self.camera, np.append(self.frozen, False))

    def without_newest(self) -> Prior:
        """The same without the newest state, of which it must not know."""
        assert not self.frozen[-1]
        at = STATE_SIZE * (len(self.frozen) - 1)
        keep = np.r_[0:at, at + STATE_SIZE : len(self.b)]
        return Prior(self.H[np.ix_(keep, keep)], self.b[keep], self.states[:-1], self.camera, self.frozen[:-1])

    def difference(self, x: Variables) -> Float:
        """``x`` beyond the first estimates, (n,); zero for states that the prior does not know."""
        d = x.states.difference(self.states)
        d[~self.frozen] = 0.0
        first, now = self.camera, x.camera
        times = [now.offset_s - first.offset_s, now.readout_s - first.readout_s]
        rotation, lens = so3.log(first.R_BC.T @ now.R_BC), now.intrinsics - first.intrinsics
        return np.concatenate([d.ravel(), rotation, now.p_BC - first.p_BC, times, lens])

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
        d = self.prior.difference(x)
        total = 0.5 * d @ self.prior.H @ d + self.prior.b @ d
        total += self.sightings.cost(x.poses, x.camera, x.landmarks)
        r = self.reading_residuals(x.states)
        total += 0.5 * float((r * r).sum())
        for k, still in self.still.items():
            total += 0.5 * float(((_still_residual(still, x.states, k) / still.sigma) ** 2).sum())
        return float(total)

    def linearise(self, x: Variables) -> Normal:
        """The normal equations at ``x``."""
        K = len(x.states)
        first = self.prior.first(x.states) if self.first_estimates else x.states
        d = self.prior.difference(x)
        H, b = self.prior.H.copy(), self.prior.b + self.prior.H @ d
        self._add_readings(H, b, x.states, first)
        for k, still in self.still.items():
            residual = _still_residual(still, x.states, k) / still.sigma
            J = -still.jacobian(first.R_WB[k]) / still.sigma[:, None]
            at = slice(STATE_SIZE * k, STATE_SIZE * (k + 1))
            H[at, at] += J.T @ J
            b[at] += J.T @ residual
        poses = x.poses
        first_poses = Poses.of(first.R_WB, first.p_WB) if self.first_estimates else poses
        H_visual, b_visual, V, W, c = self.sightings.linearise(poses, first_poses, x.camera, x.landmarks)
        columns = pose_columns(K)
        H[np.ix_(columns, columns)] += H_visual
        b[columns] += b_visual
        return Normal(H, b, V, W, c, columns)

    def reading_residuals(self, states: StateArrays) -> Float:
        """Of the readings between each state and the next, whitened, (count, 15)."""
        count = len(self.readings.dt_s)
        r = self.readings.residuals(states[:count], states[1 : count + 1])
        return np.asarray((self.readings.sqrt_information @ r[..., None])[..., 0])

    def _add_readings(self, H: Float, b: Float, states: StateArrays, first: StateArrays) -> None:
        count = len(self.readings.dt_s)
        if not count:
            return
        r = self.reading_residuals(states)
        _, J_i, J_j = self.readings.linearise(first[:count], first[1 : count + 1])
        J = self.readings.sqrt_information @ np.concatenate([J_i, J_j], axis=2)
        J_T = np.swapaxes(J, -1, -2)
        blocks, gradients = J_T @ J, (J_T @ r[..., None])[..., 0]
        for k in range(count):
            at = slice(STATE_SIZE * k, STATE_SIZE * (k + 2))
            H[at, at] += blocks[k]
            b[at] += gradients[k]


@dataclass(frozen=True, slots=True)
class Normal:
    """Normal equations [H W^T; W V], gradients b and c; ``W`` (L, 3, m) has the columns ``columns`` (m,) of H."""

    H: Float
    b: Float
    V: Float
    W: Float
    c: Float
    columns: NDArray[np.intp]

    def reduced(self, damping: float) -> tuple[Float, Float, tuple[Float, Float, Float]]:
        """Damped equations S (n, n) and gradient (n,) without the landmarks, and what :meth:`landmark_step` needs."""
        Y, z, inverse = eliminate(self.V, self.W, self.c, damping)
        flat = Y.reshape(-1, len(self.columns))
        S, g = self.H.copy(), self.b.copy()
        S[np.diag_indices_from(S)] *= 1.0 + damping
        S[np.ix_(self.columns, self.columns)] -= flat.T @ flat
        g[self.columns] -= flat.T @ z.ravel()
        return S, g, (Y, z, inverse)

    def landmark_step(self, step: Float, eliminated: tuple[Float, Float, Float]) -> Float:
        """(L, 3), given the ``step`` (n,) of the rest."""
        Y, z, inverse = eliminated
        return -(np.swapaxes(inverse, -1, -2) @ (z + Y @ step[self.columns])[..., None])[..., 0]


def _still_residual(still: Standstill, states: StateArrays, k: int) -> Float:
    return still.residual(states.R_WB[k], states.v_WB[k], states.bias_gyro_B[k], states.bias_accel_B[k])


def calibration_information(cov: Float) -> Float:
    """The inverse of a covariance (16, 16), with one for what is known for sure and stays as it is."""
    return np.linalg.inv(cov + np.diag(np.where(np.diag(cov) > 0.0, 0.0, 1.0)))


def pose_columns(K: int) -> NDArray[np.intp]:
    """Indices of [dtheta dp] of every state, and of the calibration, in the error vector of K states."""
    poses = (STATE_SIZE * np.arange(K)[:, None] + np.arange(6)).ravel()
    return np.concatenate([poses, STATE_SIZE * K + np.arange(CALIBRATION_SIZE)])


def marginalise_oldest(problem: Problem, x: Variables) -> Prior:
    """The prior on all states but the first, and calibration, that replaces all of ``problem``.

    ``problem`` holds just the factors that touch the first state. Its landmarks go with it, robust weights as they are
    at ``x``. States it touches are frozen at ``x`` unless they were before.
    """
    normal = problem.linearise(x)
    H, b, _ = normal.reduced(0.0)
    K = len(x.states)
    touched = (H[: STATE_SIZE * K].reshape(K, -1) != 0.0).any(axis=1)
    prior = problem.prior
    first = prior.first(x.states)
    # The gradient at the first estimates, from which the prior counts.
    b = b - H @ prior.difference(x)
    H, b = schur(H, b, STATE_SIZE)
    return Prior(H, b, first[1:], prior.camera, (prior.frozen | touched)[1:])


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
