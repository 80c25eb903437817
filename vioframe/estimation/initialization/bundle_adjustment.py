"""The visual-inertial bundle adjustment of a window: its most likely states and landmarks, and how sure they are.

The factors and the solver are those of :mod:`vioframe.estimation.factors`; what is particular is that position and yaw,
which nothing measures, are held at one of the states, and the priors on the biases.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.arrays import Float
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.problem import STATE_SIZE, Prior, Problem, Variables
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, Sightings
from vioframe.estimation.factors.solver import Solution, solve, solve_positive
from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.estimation.initialization.window import BIAS_ACCEL_SIGMA, BIAS_GYRO_SIGMA, PIXEL_SIGMA, Window
from vioframe.types import DBA, DBG, DP, DTHETA

_CAUCHY = 2.0  # standard deviations
_MAX_ITERATIONS = 20
_RELATIVE_DECREASE = 1e-5
# Holds the four directions that nothing measures, 1/m^2 and 1/rad^2: softly, so that it does not hinder the way to the
# minimum, where it is met exactly; and as good as fixed, for the covariance.
_HELD, _FIXED = 1e4, 1e8


def adjustment(window: Window, imu: list[Preintegrated], x: Variables, focal_px: float) -> Problem:
    """All factors of ``window``, whose readings are ``imu``, about the values ``x``; the first state is held."""
    seen = np.ascontiguousarray(window.seen.T)
    xy = np.ascontiguousarray(np.where(seen[..., None], np.swapaxes(window.xy, 0, 1), 0.0))
    to_px = np.tile(focal_px * np.eye(2), (*seen.shape, 1, 1))
    sightings = Sightings(seen, xy, np.zeros(xy.shape), to_px, PIXEL_SIGMA, _CAUCHY)
    return Problem(_prior(x, 0, _HELD), ImuFactors.stack(imu), {}, sightings, first_estimates=False)


def adjusted(problem: Problem, x: Variables) -> Solution:
    """Minimise from ``x``; the calibration stays."""
    return solve(problem, x, np.arange(STATE_SIZE * len(x.states)), _MAX_ITERATIONS, _RELATIVE_DECREASE)


def covariance(problem: Problem, x: Variables) -> Float:
    """Of all states (15 K, 15 K) at the minimum ``x``, with position and yaw pinned at the *newest* state."""
    K = len(x.states)
    prior = _prior(x, K - 1, _FIXED)
    S, _, _ = replace(problem, prior=prior).linearise(x).reduced(0.0)
    n = STATE_SIZE * K
    cov = solve_positive(S[:n, :n], np.eye(n))
    return 0.5 * (cov + cov.T)


def _prior(x: Variables, held: int, information: float) -> Prior:
    """The first state's biases about zero, and that state ``held`` neither moves nor turns about gravity."""
    states, K = x.states, len(x.states)
    H = np.zeros((STATE_SIZE * K + CALIBRATION_SIZE, STATE_SIZE * K + CALIBRATION_SIZE))
    first, own = H[:STATE_SIZE, :STATE_SIZE], H[STATE_SIZE * held :, STATE_SIZE * held :]
    first[DBG, DBG] = np.eye(3) / BIAS_GYRO_SIGMA**2
    first[DBA, DBA] = np.eye(3) / BIAS_ACCEL_SIGMA**2
    up_B = states.R_WB[held, 2]  # a turn about the world's vertical, as a right perturbation
    own[DTHETA, DTHETA] = information * np.outer(up_B, up_B)
    own[DP, DP] = information * np.eye(3)
    zero = np.zeros((K, 3))
    about = StateArrays(states.R_WB, states.p_WB, states.v_WB, zero, zero)
    return Prior(H, np.zeros(len(H)), about, x.camera, np.isin(np.arange(K), (0, held)))
