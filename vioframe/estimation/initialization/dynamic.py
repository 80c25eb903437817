"""Initialisation in motion: from tracks and readings alone to states, gravity, scale and biases.

    choose keyframes -> gyro bias -> closed-form alignment -> bundle adjustment -> look ahead -> add the newest -> judge

Every step may refuse; nothing is believed that the data do not determine well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.landmarks import positions
from vioframe.estimation.factors.problem import Problem, Variables
from vioframe.estimation.factors.reprojection import CALIBRATION_SIZE, READOUT, Calibrated
from vioframe.estimation.factors.solver import Solution
from vioframe.estimation.hand_eye import HandEye, Turns
from vioframe.estimation.inertial.preintegration import Preintegrated, preintegrate
from vioframe.estimation.initialization.bundle_adjustment import (
    adjusted,
    adjustment,
    covariance,
    noise_px,
    variance_of,
    with_calibration,
)
from vioframe.estimation.initialization.closed_form import (
    Alignment,
    Structure,
    align,
    estimate_gyro_bias,
    rotations,
    solve_structure,
)
from vioframe.estimation.initialization.window import (
    BIAS_ACCEL_SIGMA,
    BIAS_GYRO_SIGMA,
    PIXEL_SIGMA,
    ContradictedError,
    InitialEstimate,
    Packet,
    UnsureError,
    Window,
    build_window,
    refuse_unless,
    spread_indices,
)
from vioframe.estimation.turns import turn_between
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.geometry.so3 import level_rotation
from vioframe.types import DP, DTHETA, DV, Calibration, FrameTracks, ImuSegment, NavState, g_W

_MIN_VIEWS = 4
# Tracks farther off than this are not noise: px, typical over all views.
_EPIPOLAR_LIMIT, _STRUCTURE_LIMIT, _ADJUSTED_LIMIT = 3.0, 10.0, 3.0
_FARTHEST_M = 200.0
# Frames of the window that are estimated, most tracks that are used, and how few refuse the attempt.
_KEYFRAMES, _MOST_LANDMARKS, _FEWEST_LANDMARKS = 14, 100, 20
# Where images are dropped there may be hardly any but the newest: so many must be older.
_FEWEST_FRAMES = 4
# The newest part of the window is predicted from the rest to test the estimate.
_LOOKAHEAD_S, _LARGEST_LOOKAHEAD_PX, _FEWEST_COMMON = 0.2, 4.0, 8
# Least median parallax, with the rotation taken out; most that the observations may disagree with the estimate (RMS).
_LEAST_PARALLAX_PX, _LARGEST_ERROR_PX = 5.0, 2.0
# The readings' residuals, per degree of freedom: vibration makes them larger than the data sheet's noise.
_MAX_INERTIAL = 9.0
_MAX_BIAS_ACCEL = 5.0 * BIAS_ACCEL_SIGMA
# Largest standard deviations that are accepted: of scale (relative), velocity on any axis (m/s, or as a part of the
# speed where that is more), and gravity's direction.
_SCALE_SIGMA, _VELOCITY_SIGMA, _SPEED_SIGMA, _TILT_SIGMA_DEG = 0.06, 0.05, 0.03, 1.0
# ... and of scale where the calibration had to be found, of which more may be wrong than was looked for.
_SCALE_SIGMA_FOUND = 0.05
# A calibration is wrong where the likeliest makes the rest so much likelier, as a difference of logarithms: far more
# than chance would, because the noise in many landmarks, each with few sightings, makes focal lengths seem longer.
CONTRADICTED = 20.0
# A readout is doubted where it can be found to this.
_READOUT_SIGMA_S, _READOUT = 0.0025, READOUT - CALIBRATION_SIZE
# Beyond so many times these an attempt is not gone on with, be it before the first adjustment or after it.
_HOPELESS = 1.5


def initialise(
    packets: Sequence[Packet],
    calibration: Calibration,
    known: Float,
    doubted: Float,
    bias_gyro_B: Float,
    *,
    found: bool,
) -> InitialEstimate:
    """Estimate from consecutive ``packets``, the newest last; raises :class:`RefusalError`.

    ``known`` (16, 16) is the covariance of the camera's ``calibration`` if that is right, ``doubted`` if it may not be;
    ``bias_gyro_B`` (3,) rad/s is about what the gyroscope's bias is; ``found``, whether the calibration had to be.
    """
    t_ns = np.array([tracks.t_ns for _, tracks in packets])
    held_out = int((t_ns > t_ns[-1] - _LOOKAHEAD_S * 1e9).sum())
    refuse_unless(len(t_ns) - held_out >= _FEWEST_FRAMES, f"{len(t_ns)} frames are too few")
    chosen = spread_indices(t_ns[:-held_out], _KEYFRAMES)
    noise = PIXEL_SIGMA / calibration.cameras[0].model.focal_px

    window = build_window(packets, [*chosen, len(packets) - 1], _MIN_VIEWS, _MOST_LANDMARKS)
    require_tracks(window, "tracks are long enough")
    window, bias_gyro = with_gyro_bias(window, bias_gyro_B, calibration, noise)
    imu = preintegrated(window, bias_gyro, np.zeros(3), calibration)
    R_B0B = rotations(imu)
    _check_parallax(window, R_B0B, calibration)

    window, structure = _structure(window, R_B0B @ calibration.cameras[0].R_BC, noise)
    alignment = align(structure.position, imu[:-1], calibration.cameras[0].p_BC, BIAS_ACCEL_SIGMA)
    refuse_unless(alignment.scale > 0.0, "the readings contradict the direction of the motion in the images")
    x = _start_of_adjustment(window.without_last(), structure, alignment, calibration)
    problem = adjustment(window.without_last(), imu[:-1], x, calibration.cameras, doubted)
    scale_sigma = _SCALE_SIGMA_FOUND if found else _SCALE_SIGMA
    guess = Solution(x, problem.linearise(x), iterations=0, converged=False)
    check_uncertainty(x.states, covariance(problem, guess, doubted), scale_sigma, _HOPELESS)
    solution = adjusted(problem, x, doubted, roughly=True)
    cov = covariance(problem, solution, doubted)
    x = solution.variables
    check_uncertainty(x.states, cov, scale_sigma, _HOPELESS)
    if not cov[_READOUT, _READOUT] <= _READOUT_SIGMA_S**2:
        # Only fast turns tell a readout; slow ones would have it make up for something else.
        doubted = doubted.copy()
        doubted[READOUT, READOUT] = known[READOUT, READOUT]
        x = replace(x, cameras=x.cameras._replace(readout_s=problem.prior.cameras.readout_s))
    window, problem, solution = refined(window, problem, x, packets[-held_out:], calibration, doubted)
    cov = covariance(problem, solution, doubted)
    check_uncertainty(solution.variables.states, cov, scale_sigma)
    problem, solution = _believed(problem, solution, calibration, known, cov)
    x, cov = solution.variables, covariance(problem, solution, known)
    keep = explained(problem, x)
    states, p_WF = from_zero(window.t_ns, x, cov, landmark_positions(problem, x)[keep])
    return InitialEstimate("dynamic", states, window.ids[keep], p_WF, x.cameras, _camera(cov))


def refined(
    window: Window,
    problem: Problem,
    x: Variables,
    held_out: Sequence[Packet],
    calibration: Calibration,
    known: Float,
) -> tuple[Window, Problem, Solution]:
    """What fits of ``window``, and its adjustment, from ``x``, to which all but the newest frame led roughly.

    That must predict what the first camera sees in the packets ``held_out`` behind it, of which the newest is the last.
    """
    keep, sigma = explained(problem, x), noise_px(problem, x)
    p_WF = landmark_positions(problem, x)[keep]
    window, x = window.only(keep), replace(x, landmarks=x.landmarks[keep])
    require_tracks(window, "tracks fit the bundle adjustment")
    predicted = _predicted_states(held_out, x.states.unstack(window.t_ns[:-1])[-1], calibration)
    _check_lookahead(predicted, held_out, x.cameras, window.ids, p_WF, calibration.cameras[0].model)
    x = replace(x, states=x.states.append(StateArrays.stack(predicted[-1:])))
    problem, solution = adjusted_window(window, x, calibration, known, sigma)
    _check_fit(problem, solution)
    return window, problem, solution


def _believed(
    problem: Problem, solution: Solution, calibration: Calibration, known: Float, cov: Float
) -> tuple[Problem, Solution]:
    """The adjustment where ``calibration`` is right, known to ``known`` (16, 16).

    Raises :class:`ContradictedError` where the ``solution`` that doubts it, of covariance ``cov``, is far likelier.
    """
    cameras, x = calibration.cameras, solution.variables
    problem = with_calibration(problem, x, cameras, known)
    believed = adjusted(problem, replace(x, cameras=Calibrated.of(*cameras)), known)
    if not believed.cost < solution.cost + CONTRADICTED * variance_of(problem, x):
        raise ContradictedError(x.cameras, _camera(cov))
    return problem, believed


def require_tracks(window: Window, what: str) -> None:
    refuse_unless(len(window.ids) >= _FEWEST_LANDMARKS, f"{len(window.ids)} {what}, {_FEWEST_LANDMARKS} are needed")


def preintegrated(
    window: Window, bias_gyro_B: Float, bias_accel_B: Float, calibration: Calibration
) -> list[Preintegrated]:
    return [preintegrate(segment, bias_gyro_B, bias_accel_B, calibration.imu) for segment in window.segments]


def with_gyro_bias(window: Window, about: Float, calibration: Calibration, sigma: float) -> tuple[Window, Float]:
    """The tracks on their epipolar lines, and the gyroscope's bias (3,) near ``about`` that puts them there."""
    imu = preintegrated(window, about, np.zeros(3), calibration)
    bias, distance = estimate_gyro_bias(window, imu, calibration.cameras[0].R_BC, sigma, BIAS_GYRO_SIGMA)
    rate = float(np.linalg.norm(bias))
    refuse_unless(rate <= 3.0 * BIAS_GYRO_SIGMA, f"gyroscope bias of {rate:.2f} rad/s is not plausible")
    window = window.only(distance < _EPIPOLAR_LIMIT)
    require_tracks(window, "tracks lie on their epipolar lines")
    return window, bias


def _structure(window: Window, R_B0C: Float, sigma: float) -> tuple[Window, Structure]:
    """The structure without the newest keyframe, from the tracks that fit it."""
    for _ in range(2):
        structure = solve_structure(window.without_last(), R_B0C[:-1], sigma)
        typical = np.nanmedian(structure.error, axis=0)
        keep = structure.good & (typical < _STRUCTURE_LIMIT * sigma)
        window = window.only(keep)
        require_tracks(window, "tracks have parallax and fit the structure")
        if keep.all():
            break
    return window, structure.only(keep)


def _start_of_adjustment(
    window: Window, structure: Structure, alignment: Alignment, calibration: Calibration
) -> Variables:
    """States in a world with z up, and landmarks [x y rho] in the first frame that sees them."""
    states = alignment.states.turned(level_rotation(-alignment.g_B0))
    track = np.arange(len(window.ids))
    host = window.seen.argmax(axis=0)
    inverse_depth = 1.0 / (alignment.scale * structure.depth[host, track])
    landmarks = np.column_stack([window.xy[host, track], inverse_depth])
    return Variables(states, Calibrated.of(*calibration.cameras), landmarks)


def adjusted_window(
    window: Window, x: Variables, calibration: Calibration, known: Float, sigma: float
) -> tuple[Problem, Solution]:
    """The adjustment of ``window`` from ``x``, its readings integrated at the biases there.

    ``known`` (16 N, 16 N) is the covariance of the ``calibration``'s cameras, ``sigma`` px the noise of a sighting.
    """
    biases = zip(x.states.bias_gyro_B[:-1], x.states.bias_accel_B[:-1], strict=True)
    imu = [preintegrate(segment, *bias, calibration.imu) for segment, bias in zip(window.segments, biases, strict=True)]
    problem = adjustment(window, imu, x, calibration.cameras, known, sigma)
    return problem, adjusted(problem, x, known)


def explained(problem: Problem, x: Variables) -> Bool:
    """(L,) whether a track's landmark lies in front of its cameras, at a finite depth, and near its observations."""
    errors_px = problem.sightings.sigma * problem.sightings.errors(x.poses, x.cameras, x.landmarks)
    return np.asarray((errors_px < _ADJUSTED_LIMIT) & (x.landmarks[:, 2] > 1.0 / _FARTHEST_M))


def landmark_positions(problem: Problem, x: Variables) -> Float:
    """(L, 3) m of the landmarks in the world."""
    return positions(x.states, x.cameras, problem.sightings.seen.argmax(axis=1), x.landmarks)


def _predicted_states(packets: Sequence[Packet], last: NavState, calibration: Calibration) -> list[NavState]:
    """The state at each of ``packets``, of which the first follows ``last``, from readings alone."""
    out = []
    for imu, _ in packets:
        last = preintegrate(imu, last.bias_gyro_B, last.bias_accel_B, calibration.imu).predict(last)
        out.append(last)
    return out


def from_zero(t_ns: Int, x: Variables, cov: Float, p_WF: Float) -> tuple[tuple[NavState, ...], Float]:
    """States and landmarks (L, 3) m in the world turned and moved so that yaw and position are zero at the first."""
    adjusted = x.states
    R_0, p_0 = adjusted.R_WB[0], adjusted.p_WB[0]
    R_new = level_rotation(R_0[2]) @ R_0.T  # R_0[2] is the vertical in the body
    turn = np.eye(15)
    turn[DP, DP] = turn[DV, DV] = R_new
    states = replace(adjusted, p_WB=adjusted.p_WB - p_0).turned(R_new).unstack(t_ns)
    newest = turn @ _newest(cov, len(states)) @ turn.T
    states[-1] = replace(states[-1], cov=0.5 * (newest + newest.T))
    return tuple(states), (p_WF - p_0) @ R_new.T


def _check_parallax(window: Window, R_B0B: Float, calibration: Calibration) -> None:
    """The median track must move by enough pixels that the rotations ``R_B0B`` (K, 3, 3) do not explain."""
    rays = np.concatenate([window.xy, np.ones((*window.xy.shape[:2], 1))], axis=2)
    rays_B0 = rays @ np.swapaxes(R_B0B @ calibration.cameras[0].R_BC, -1, -2)
    rays_B0 /= np.linalg.norm(rays_B0, axis=2, keepdims=True)
    first = rays_B0[window.seen.argmax(axis=0), np.arange(len(window.ids))]
    angle = np.nanmax(np.linalg.norm(rays_B0 - first, axis=2), axis=0)
    parallax = float(np.median(angle)) * calibration.cameras[0].model.focal_px
    refuse_unless(parallax >= _LEAST_PARALLAX_PX, f"parallax of {parallax:.1f} px, {_LEAST_PARALLAX_PX} px are needed")


def _check_fit(problem: Problem, solution: Solution) -> None:
    """Observations, readings and biases must be as the noise and the priors have them."""
    refuse_unless(solution.converged, "the bundle adjustment did not converge")
    x, sightings = solution.variables, problem.sightings
    errors = solution.normal.errors
    used = ~np.isinf(errors)  # what is behind a camera is let go of, and says nothing of the others
    views = sightings.seen.sum(axis=1)[used]
    rms = sightings.sigma * float(np.sqrt((views * errors[used] ** 2).sum() / views.sum()))
    refuse_unless(rms <= _LARGEST_ERROR_PX, f"reprojection error of {rms:.1f} px, {_LARGEST_ERROR_PX} px are allowed")
    inertial = float((problem.reading_residuals(x.states) ** 2).mean())
    refuse_unless(
        inertial <= _MAX_INERTIAL, f"readings and images disagree by {inertial:.1f} times the noise's variance"
    )
    bias = float(np.linalg.norm(x.states.bias_accel_B[-1]))
    refuse_unless(bias <= _MAX_BIAS_ACCEL, f"accelerometer bias of {bias:.2f} m/s^2 is not plausible")


def _check_lookahead(
    predicted: Sequence[NavState],
    packets: Sequence[Packet],
    cameras: Calibrated,
    ids: Int,
    p_WF: Float,
    given: Camera,
) -> None:
    """States predicted by the readings must see the landmarks ``ids`` (L,), ``p_WF`` (L, 3) where the frames do.

    Points were undistorted with the camera ``given``.
    """
    found = given.with_intrinsics(cameras.intrinsics[0])
    for state, (imu, tracks) in zip(predicted, packets, strict=True):
        if tracks.by_others_alone:
            continue
        seen = tracks.of_camera(0)
        _, a, b = np.intersect1d(ids, seen.ids, return_indices=True)
        refuse_unless(len(a) >= _FEWEST_COMMON, f"only {len(a)} landmarks were still tracked in the frames held back")
        turned = so3.exp((imu.gyro_B[-1] - state.bias_gyro_B) * cameras.offset_s[0])
        p_WB = state.p_WB + state.v_WB * cameras.offset_s[0]
        p_C = ((p_WF[a] - p_WB) @ (state.R_WB @ turned) - cameras.p_BC[0]) @ cameras.R_BC[0]
        z = np.where(p_C[:, 2] > 0.0, p_C[:, 2], np.nan)
        error = found.distort(p_C[:, :2] / z[:, None]) - given.distort(seen.xy_normalised[b])
        px = float(np.median(np.nan_to_num(np.linalg.norm(error, axis=1), nan=np.inf)))
        refuse_unless(px <= _LARGEST_LOOKAHEAD_PX, f"the prediction misses a later frame by {px:.1f} px")


def _newest(cov: Float, count: int) -> Float:
    """(15, 15) of the newest of ``count`` states."""
    return cov[15 * (count - 1) : 15 * count, 15 * (count - 1) : 15 * count]


def _camera(cov: Float) -> Float:
    """(16, 16) of the calibration."""
    return cov[-CALIBRATION_SIZE:, -CALIBRATION_SIZE:]


def check_uncertainty(states: StateArrays, cov: Float, scale_sigma: float, factor: float = 1.0) -> None:
    """Velocity, gravity's direction and scale must be determined well; ``cov`` is of all states and the calibration.

    The limits, ``scale_sigma`` among them, are ``factor`` times as wide.
    """
    newest = _newest(cov, len(states))
    velocity = float(np.sqrt(np.linalg.eigvalsh(newest[DV, DV])[-1]))
    tilt = float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(newest[DTHETA, DTHETA])[-1])))
    scale = 0.0 if np.isinf(scale_sigma) else path_scale_sigma(states.p_WB, cov)
    enough = max(_VELOCITY_SIGMA, _SPEED_SIGMA * float(np.linalg.norm(states.v_WB[-1])))
    by, what = max(
        (velocity / enough, f"velocity known to {velocity:.3f} m/s only"),
        (tilt / _TILT_SIGMA_DEG, f"gravity's direction known to {tilt:.2f} deg only"),
        (scale / scale_sigma, f"scale known to {100.0 * scale:.0f} % only"),
    )
    if not by <= factor:
        raise UnsureError(f"{what} (standard deviation)")


def path_scale_sigma(p_WB: Float, cov: Float) -> float:
    """Relative standard deviation of the path's size, sum q_k . dp_k / sum |q_k|^2 with q from the path's centre.

    Translations and rotations of the whole path have no part in it.
    """
    q = p_WB - p_WB.mean(axis=0)
    by_state = np.zeros((len(q), 15))
    by_state[:, DP] = q / (q**2).sum()
    a, n = by_state.ravel(), by_state.size
    return float(np.sqrt(a @ cov[:n, :n] @ a))


def warm_up(calibration: Calibration) -> None:
    """Compile the kernels of a start, or load them from the cache, so that the first attempt does not wait."""
    calibration = calibration.only(0)
    t_ns, half_ns = np.arange(4) * 100_000_000, np.arange(3) * 50_000_000
    xy = np.tile(np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2)), (4, 1, 1))
    segments = tuple(ImuSegment(t + half_ns, np.zeros((3, 3)), np.tile(-g_W, (3, 1))) for t in t_ns[:-1])
    window = Window(t_ns, segments, np.arange(20), xy, np.ones((4, 20), bool), np.zeros((4, 20, 2)))
    frames = [FrameTracks(int(t), window.ids, np.zeros_like(window.ids), xy[0], xy[0]) for t in t_ns]
    turns = [turn for a, b in pairwise(frames) if (turn := turn_between(a, b, 1e-3)) is not None]
    far_ns = np.arange(-10, 11) * 100_000_000
    Turns(turns, far_ns, np.zeros((21, 3))).fit(HandEye(np.zeros(3), np.eye(3)), ())
    with_gyro_bias(window, np.zeros(3), calibration, 1e-3)
    state, landmarks = NavState(0, np.eye(3), *np.zeros((4, 3))), np.column_stack([xy[0], np.full(20, 0.2)])
    x = Variables(StateArrays.stack([state] * 4), Calibrated.of(*calibration.cameras), landmarks)
    problem, solution = adjusted_window(window, x, calibration, 1e-4 * np.eye(CALIBRATION_SIZE), PIXEL_SIGMA)
    explained(problem, solution.variables)
    problem.reading_residuals(solution.variables.states)
