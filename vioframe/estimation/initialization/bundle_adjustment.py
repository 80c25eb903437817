"""The visual-inertial bundle adjustment of a window: its most likely states and landmarks, and how sure they are.

The factors and the solver are those of :mod:`vioframe.estimation.factors`; what is particular is that position and yaw,
which nothing measures, are held at one of the states, and the priors on the biases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vioframe.arrays import Float, Int
from vioframe.estimation.factors import solver
from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.landmarks import image_velocities, in_images, motion_in_body
from vioframe.estimation.factors.problem import STATE_SIZE, Prior, Problem, Variables, calibration_information
from vioframe.estimation.factors.reprojection import (
    CALIBRATION_SIZE,
    GLOBAL_SHUTTER,
    READOUT,
    Calibrated,
    Lens,
    Shutter,
    Sightings,
    pixels_by_intrinsics,
    pixels_by_residual,
)
from vioframe.estimation.factors.solver import Solution, solve
from vioframe.estimation.inertial.preintegration import Preintegrated
from vioframe.estimation.initialization.window import BIAS_ACCEL_SIGMA, BIAS_GYRO_SIGMA, PIXEL_SIGMA, Window
from vioframe.geometry.cameras import intrinsics_of
from vioframe.types import DBA, DBG, DP, DTHETA, CameraOnBody

_CAUCHY = 2.0  # standard deviations
# Of a sighting: times what landmarks show, as a track's errors last, so that its sightings say the same again; and px,
# at least and at most.
_TIMES_SHOWN, _LEAST_PX = 3.0, 0.15
_MAX_ITERATIONS = 15
# The last steps are small and many, as robust weights settle: much less than chance moves the minimum by.
_RELATIVE_DECREASE, _ROUGH_DECREASE = 3e-4, 1e-2
# Holds the four directions that nothing measures, 1/m^2 and 1/rad^2: softly, so that it does not hinder the way to the
# minimum, where it is met exactly; and as good as fixed, for the covariance.
_HELD, _FIXED = 1e4, 1e8


def adjustment(
    window: Window,
    imu: Sequence[Preintegrated],
    x: Variables,
    cameras: Sequence[CameraOnBody],
    known: Float,
    sigma: float | None = None,
) -> Problem:
    """All factors of ``window``, whose readings are ``imu``, about the values ``x``; the first state is held.

    ``known`` (16 N, 16 N) is the covariance of the calibration of ``cameras``, zero in what is known for sure;
    ``sigma`` px the noise of a sighting, None for what ``x`` shows.
    """
    seen, N = np.ascontiguousarray(window.seen.T), len(cameras)
    gyro_B = np.stack([imu[0].imu.gyro_B[0], *(m.imu.gyro_B[-1] for m in imu)])
    rolling = bool(any(camera.readout_s for camera in cameras) or np.diag(known)[READOUT::CALIBRATION_SIZE].any())
    xy, row, to_px = np.zeros((*seen.shape, 2)), np.zeros(seen.shape), np.zeros((*seen.shape, 2, 2))
    models, intrinsics = zip(*(intrinsics_of(camera.model) for camera in cameras), strict=True)
    for c, camera in enumerate(cameras):
        px, own = np.swapaxes(window.xy_px[c::N], 0, 1), np.swapaxes(window.xy[c::N], 0, 1)
        if rolling:
            own = camera.model.undistort(px.reshape(-1, 2)).reshape(px.shape)
            row[:, c::N] = camera.row(px[..., 1])
        own = np.where(seen[:, c::N, None], own, 0.0)
        by_residual = pixels_by_residual(models[c], intrinsics[c], own.reshape(-1, 2), False)
        xy[:, c::N], to_px[:, c::N] = own, by_residual.reshape(*own.shape, 2)
    at, depth = in_images(x.states, x.cameras, seen.argmax(axis=1), x.landmarks)
    by_intrinsics = pixels_by_intrinsics(np.array(models), np.stack(intrinsics), at, seen)
    lens = Lens(True, by_intrinsics, np.tile(np.stack(intrinsics), (len(gyro_B), 1)))
    velocity = image_velocities(x.states, x.cameras, gyro_B, at, depth)
    shutter = Shutter(True, row, *motion_in_body(x.states, gyro_B)) if rolling else GLOBAL_SHUTTER
    sigma_px, share = PIXEL_SIGMA if sigma is None else sigma, np.ones(seen.shape)
    sightings = Sightings(seen, share, xy, velocity, to_px, sigma_px, _CAUCHY, shutter=shutter, lens=lens)
    prior = _prior(x, 0, _HELD, Calibrated.of(*cameras), known)
    problem = Problem(prior, ImuFactors.stack(imu), {}, sightings, first_estimates=False)
    if sigma is None:
        problem = replace(problem, sightings=sightings._replace(sigma=noise_px(problem, x)))
    return problem


def noise_px(problem: Problem, x: Variables) -> float:
    """Standard deviation that a sighting is to count with, px, by what the landmarks of ``x`` are off by."""
    shown_px = problem.sightings.sigma * float(np.sqrt(variance_of(problem, x)))
    return float(np.clip(_TIMES_SHOWN * shown_px, _LEAST_PX, PIXEL_SIGMA))


def variance_of(problem: Problem, x: Variables) -> float:
    """That of the sightings as the landmarks show it, over that which is assumed."""
    errors, views = problem.sightings.errors(x.poses, x.cameras, x.landmarks), problem.sightings.seen.sum(axis=1)
    return float(np.median(2.0 * views * errors**2 / (2.0 * views - 3.0)))


def adjusted(problem: Problem, x: Variables, known: Float, roughly: bool = False) -> Solution:
    """Minimise from ``x``; ``roughly``, to tell outliers and how sure the rest can be."""
    return solve(problem, x, _active(x, known), _MAX_ITERATIONS, _ROUGH_DECREASE if roughly else _RELATIVE_DECREASE)


def with_calibration(problem: Problem, x: Variables, cameras: Sequence[CameraOnBody], known: Float) -> Problem:
    """``problem`` with another prior on the calibration."""
    return replace(problem, prior=_prior(x, 0, _HELD, Calibrated.of(*cameras), known))


def covariance(problem: Problem, solution: Solution, known: Float) -> Float:
    """Of all states and the calibration (15 K + 16 N, 15 K + 16 N) at the ``solution``; zero where ``known`` is.

    Position and yaw are pinned at the *newest* state.
    """
    x, normal = solution.variables, solution.normal
    prior = _prior(x, len(x.states) - 1, _FIXED, problem.prior.cameras, known)
    normal = replace(normal, H=normal.H - problem.prior.H + prior.H)
    active = _active(x, known)
    cov = np.zeros(normal.H.shape)
    cov[np.ix_(active, active)] = solver.covariance(normal, active, len(active))
    return cov


def _active(x: Variables, known: Float) -> Int:
    """The entries of the error vector that are estimated: those of the calibration that are not known for sure."""
    return np.flatnonzero(np.append(np.ones(STATE_SIZE * len(x.states), bool), np.diag(known) > 0.0))


def _prior(x: Variables, held: int, information: float, given: Calibrated, known: Float) -> Prior:
    """The first state's biases about zero, the calibration about ``given`` with the covariance ``known`` (16 N, 16 N).

    And that state ``held`` neither moves nor turns about gravity.
    """
    states, K = x.states, len(x.states)
    H = np.zeros((STATE_SIZE * K + len(known), STATE_SIZE * K + len(known)))
    first, own = H[:STATE_SIZE, :STATE_SIZE], H[STATE_SIZE * held :, STATE_SIZE * held :]
    first[DBG, DBG] = np.eye(3) / BIAS_GYRO_SIGMA**2
    first[DBA, DBA] = np.eye(3) / BIAS_ACCEL_SIGMA**2
    up_B = states.R_WB[held, 2]  # a turn about the world's vertical, as a right perturbation
    own[DTHETA, DTHETA] = information * np.outer(up_B, up_B)
    own[DP, DP] = information * np.eye(3)
    zero = np.zeros((K, 3))
    about = StateArrays(states.R_WB, states.p_WB, states.v_WB, zero, zero)
    H[-len(known) :, -len(known) :] = calibration_information(known)
    return Prior(H, np.zeros(len(H)), about, given, np.isin(np.arange(K), (0, held)))
