"""A small visual-inertial bundle adjustment: the most likely states and landmarks of a window, and how sure they are.

Levenberg-Marquardt over K states and L landmarks in inverse depth, with Cauchy's robust loss on the observations,
pre-integrated readings between the states, and priors on the biases. The landmarks are eliminated by the Schur
complement (Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, section 6.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.initialization import landmarks as lm
from vioframe.estimation.initialization.landmarks import Observations
from vioframe.types import DBA, DBG, DP, Calibration, Float

_CAUCHY = 2.0  # standard deviations
_FIRST_DAMPING, _LARGEST_DAMPING = 1e-4, 1e6
_MAX_ITERATIONS = 20
_RELATIVE_DECREASE = 1e-5
# Holds the four directions that nothing measures, 1/m^2 and 1/rad^2.
_GAUGE_INFORMATION = 1e8
_YAW_W = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Problem:
    """What is known: observations with noise ``sigma`` on the z = 1 plane, readings, the biases' priors about zero."""

    observations: Observations
    factors: ImuFactors
    calibration: Calibration
    sigma: float
    bias_gyro_sigma: float
    bias_accel_sigma: float


@dataclass(frozen=True, slots=True)
class Solution:
    """``landmarks`` (L, 3) are [x y rho] in their hosts; ``cost`` is half the robust sum of squares."""

    states: StateArrays
    landmarks: Float
    cost: float
    converged: bool


def solve(problem: Problem, states: StateArrays, landmarks: Float) -> Solution:
    """Minimise from the given states and landmarks; the first state keeps its position and its turn about gravity."""
    cost = _cost(problem, states, landmarks)
    damping = _FIRST_DAMPING
    for _ in range(_MAX_ITERATIONS):
        normal = _normal_equations(problem, states, landmarks)
        _hold_gauge(normal.H, states, 0)
        while True:
            step, landmark_step = normal.solve(damping)
            trial = states.retract(step.reshape(-1, 15)), landmarks + landmark_step
            trial_cost = _cost(problem, *trial)
            if trial_cost < cost or damping > _LARGEST_DAMPING:
                break
            damping *= 10.0
        if not trial_cost < cost:
            # No downhill step is left: a minimum to rounding.
            return Solution(states, landmarks, cost, True)
        decrease = 1.0 - trial_cost / cost
        (states, landmarks), cost, damping = trial, trial_cost, 0.1 * damping
        if decrease < _RELATIVE_DECREASE:
            return Solution(states, landmarks, cost, True)
    return Solution(states, landmarks, cost, False)


def covariance(problem: Problem, solution: Solution) -> Float:
    """Of all states (15 K, 15 K), with the four unobservable directions pinned at the *newest* state."""
    normal = _normal_equations(problem, solution.states, solution.landmarks)
    _hold_gauge(normal.H, solution.states, len(solution.states) - 1)
    S, _ = normal.reduced(0.0)
    out = np.asarray(np.linalg.inv(S), np.float64)
    return 0.5 * (out + out.T)


@dataclass(frozen=True, slots=True)
class _Normal:
    """Normal equations [H W'; W V] over [states, landmarks], and gradients b, c.

    ``W`` (L, 3, 6 K) has columns for the poses only.
    """

    H: Float
    W: Float
    V: Float
    b: Float
    c: Float

    def reduced(self, damping: float) -> tuple[Float, Float]:
        """The damped equations of the states alone, (15 K, 15 K), and their gradient (15 K,)."""
        pose = _pose_columns(len(self.H) // 15)
        W = self.W.reshape(-1, len(pose))
        Y = (self._inverse_V(damping) @ self.W).reshape(W.shape)
        S = self.H.copy()
        S[np.diag_indices_from(S)] *= 1.0 + damping
        S[np.ix_(pose, pose)] -= W.T @ Y
        rhs = self.b.copy()
        rhs[pose] -= Y.T @ self.c.ravel()
        return S, rhs

    def solve(self, damping: float) -> tuple[Float, Float]:
        """The step of the states (15 K,) and of the landmarks (L, 3)."""
        S, rhs = self.reduced(damping)
        dx = np.asarray(np.linalg.solve(S, -rhs), np.float64)
        along = self.c + self.W @ dx[_pose_columns(len(self.H) // 15)]
        return dx, -(self._inverse_V(damping) @ along[..., None])[..., 0]

    def _inverse_V(self, damping: float) -> Float:
        # The constant keeps a landmark without parallax solvable; it is far below one pixel's information.
        return np.asarray(np.linalg.inv(self.V + (damping * self.V + 1e-6) * np.eye(3)), np.float64)


def _normal_equations(problem: Problem, states: StateArrays, landmarks: Float) -> _Normal:
    obs, K, L = problem.observations, len(states), len(landmarks)
    r, J_frame, J_host, J_landmark = lm.linearise(states, landmarks, obs, problem.calibration)
    weight = np.sqrt(_robust_weight(r, problem.sigma)) / problem.sigma
    r = r * weight[:, None]
    J_landmark = J_landmark * weight[:, None, None]
    M = np.arange(len(r))
    J = np.zeros((len(r), 2, K, 6))
    J[M, :, obs.frame] = J_frame * weight[:, None, None]
    J[M, :, obs.host] += J_host * weight[:, None, None]
    by_pose: Float = J.reshape(-1, 2, 6 * K)

    H, b = _inertial(problem, states)
    pose = _pose_columns(K)
    flat = by_pose.reshape(-1, 6 * K)
    H[np.ix_(pose, pose)] += flat.T @ flat
    b[pose] += flat.T @ r.ravel()
    transposed = np.swapaxes(J_landmark, -1, -2)
    W = np.add.reduceat(transposed @ by_pose, obs.start)
    V = np.add.reduceat(transposed @ J_landmark, obs.start)
    c = np.add.reduceat((transposed @ r[..., None])[..., 0], obs.start)
    return _Normal(H, W.reshape(L, 3, 6 * K), V, b, c)


def _inertial(problem: Problem, states: StateArrays) -> tuple[Float, Float]:
    """Normal matrix (15 K, 15 K) and gradient (15 K,) of the readings and the priors."""
    K = len(states)
    r, J_i, J_j = problem.factors.linearise(states[:-1], states[1:])
    L = problem.factors.sqrt_information
    r, J_i, J_j = (L @ r[..., None])[..., 0], L @ J_i, L @ J_j
    H, b = np.zeros((K, 15, K, 15)), np.zeros((K, 15))
    for k in range(K - 1):
        J = np.concatenate([J_i[k], J_j[k]], axis=1)
        H[k : k + 2, :, k : k + 2] += (J.T @ J).reshape(2, 15, 2, 15)
        b[k : k + 2] += (J.T @ r[k]).reshape(2, 15)
    for part, bias, sigma in _priors(problem, states):
        H[0, part, 0, part] += np.eye(3) / sigma**2
        b[0, part] += bias / sigma**2
    return H.reshape(15 * K, 15 * K), b.ravel()


def _priors(problem: Problem, states: StateArrays) -> tuple[tuple[slice, Float, float], ...]:
    return (
        (DBG, states.bias_gyro_B[0], problem.bias_gyro_sigma),
        (DBA, states.bias_accel_B[0], problem.bias_accel_sigma),
    )


def _cost(problem: Problem, states: StateArrays, landmarks: Float) -> float:
    r, _ = lm.project(states, landmarks, problem.observations, problem.calibration)
    squared = (r**2).sum(axis=1) / problem.sigma**2
    visual = _CAUCHY**2 * np.log1p(squared / _CAUCHY**2).sum()
    readings = problem.factors.residuals(states[:-1], states[1:])
    inertial = ((problem.factors.sqrt_information @ readings[..., None]) ** 2).sum()
    prior = sum(float(bias @ bias) / sigma**2 for _, bias, sigma in _priors(problem, states))
    return 0.5 * float(visual + inertial + prior)


def _robust_weight(r: Float, sigma: float) -> Float:
    return np.asarray(1.0 / (1.0 + (r**2).sum(axis=1) / (sigma * _CAUCHY) ** 2))


def _pose_columns(K: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Indices of [dtheta dp] of every state among the 15 K."""
    return (15 * np.arange(K)[:, None] + np.arange(6)).ravel()


def _hold_gauge(H: Float, states: StateArrays, k: int) -> None:
    """Add to ``H`` that state ``k`` neither moves nor turns about gravity; in place."""
    yaw = states.R_WB[k].T @ _YAW_W  # right perturbation of a rotation about the world's vertical
    at = 15 * k
    H[at : at + 3, at : at + 3] += _GAUGE_INFORMATION * np.outer(yaw, yaw)
    position = slice(at + DP.start, at + DP.stop)
    H[position, position] += _GAUGE_INFORMATION * np.eye(3)
