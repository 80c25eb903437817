"""What an attempt in motion must show before it is believed. Each check raises :class:`RefusalError`.

Comparisons are written so that a figure that is not a number refuses too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vioframe.estimation.factors.problem import Problem
from vioframe.estimation.factors.solver import Solution
from vioframe.estimation.initialization.estimate import RefusalError
from vioframe.estimation.initialization.options import InitializationOptions
from vioframe.estimation.initialization.window import Window
from vioframe.types import DP, DTHETA, DV, Calibration, Float, FrameTracks, Int, NavState

# The readings' residuals, per degree of freedom: vibration makes them larger than the data sheet's noise.
_MAX_INERTIAL = 9.0
_MAX_BIAS_SIGMAS = 4.0
_MIN_COMMON = 8


def check_parallax(window: Window, R_B0B: Float, calibration: Calibration, options: InitializationOptions) -> None:
    """The median track must move by enough pixels that the rotations ``R_B0B`` (K, 3, 3) do not explain."""
    rays = np.concatenate([window.xy, np.ones((*window.xy.shape[:2], 1))], axis=2)
    rays_B0 = rays @ np.swapaxes(R_B0B @ calibration.R_BC, -1, -2)
    rays_B0 /= np.linalg.norm(rays_B0, axis=2, keepdims=True)
    first = rays_B0[window.seen.argmax(axis=0), np.arange(len(window.ids))]
    angle = np.nanmax(np.linalg.norm(rays_B0 - first, axis=2), axis=0)
    parallax = float(np.median(angle)) * calibration.camera.focal_px
    if not parallax >= options.min_parallax_px:
        raise RefusalError(f"parallax of {parallax:.1f} px, {options.min_parallax_px:.1f} px are needed")


def check_fit(problem: Problem, solution: Solution, options: InitializationOptions) -> None:
    """Observations, readings and biases must be as the noise and the priors have them."""
    if not solution.converged:
        raise RefusalError("the bundle adjustment did not converge")
    x, sightings = solution.variables, problem.sightings
    errors = sightings.errors(x.poses, x.camera, x.landmarks)
    used = ~np.isinf(errors)  # what is behind a camera is let go of, and says nothing of the others
    views = sightings.seen.sum(axis=1)[used]
    rms = sightings.sigma * float(np.sqrt((views * errors[used] ** 2).sum() / views.sum()))
    if not rms <= options.max_reprojection_px:
        raise RefusalError(f"reprojection error of {rms:.1f} px RMS, {options.max_reprojection_px:.1f} px are allowed")
    inertial = float((problem.reading_residuals(x.states) ** 2).mean())
    if not inertial <= _MAX_INERTIAL:
        raise RefusalError(f"the readings disagree with the images: {inertial:.1f} times their noise's variance")
    bias = float(np.linalg.norm(x.states.bias_accel_B[-1]))
    if not bias <= _MAX_BIAS_SIGMAS * options.bias_accel_sigma:
        raise RefusalError(f"accelerometer bias of {bias:.2f} m/s^2 is not plausible")


def check_lookahead(
    predicted: Sequence[NavState],
    seen: Sequence[FrameTracks],
    ids: Int,
    p_WF: Float,
    calibration: Calibration,
    options: InitializationOptions,
) -> None:
    """States predicted by the readings must see the landmarks ``ids`` (L,), ``p_WF`` (L, 3) where the frames do."""
    for state, tracks in zip(predicted, seen, strict=True):
        _, a, b = np.intersect1d(ids, tracks.ids, return_indices=True)
        if len(a) < _MIN_COMMON:
            raise RefusalError(f"only {len(a)} landmarks were still tracked in the frames held back")
        p_C = ((p_WF[a] - state.p_WB) @ state.R_WB - calibration.p_BC) @ calibration.R_BC
        error = np.linalg.norm(p_C[:, :2] / p_C[:, 2:] - tracks.xy_normalised[b], axis=1)
        px = float(np.median(np.where(p_C[:, 2] > 0.0, error, np.inf))) * calibration.camera.focal_px
        if not px <= options.max_lookahead_px:
            raise RefusalError(f"the prediction misses a later frame by {px:.1f} px")


def check_uncertainty(p_WB: Float, cov: Float, options: InitializationOptions) -> None:
    """Velocity, gravity's direction and scale must be determined well; ``cov`` (15 K, 15 K) is of all states.

    ``p_WB`` (K, 3) is the path.
    """
    newest = cov[-15:, -15:]
    velocity = float(np.sqrt(np.linalg.eigvalsh(newest[DV, DV])[-1]))
    if not velocity <= options.max_velocity_sigma:
        raise RefusalError(f"velocity known to {velocity:.3f} m/s only (standard deviation)")
    tilt = float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(newest[DTHETA, DTHETA])[-1])))
    if not tilt <= options.max_tilt_sigma_deg:
        raise RefusalError(f"gravity's direction known to {tilt:.2f} deg only (standard deviation)")
    scale = scale_sigma(p_WB, cov)
    if not scale <= options.max_scale_sigma:
        raise RefusalError(f"scale known to {100.0 * scale:.0f} % only (standard deviation)")


def scale_sigma(p_WB: Float, cov: Float) -> float:
    """Relative standard deviation of the path's size, sum q_k . dp_k / sum |q_k|^2 with q from the path's centre.

    Translations and rotations of the whole path have no part in it.
    """
    q = p_WB - p_WB.mean(axis=0)
    by_state = np.zeros((len(q), 15))
    by_state[:, DP] = q / (q**2).sum()
    a = by_state.ravel()
    return float(np.sqrt(a @ cov @ a))
