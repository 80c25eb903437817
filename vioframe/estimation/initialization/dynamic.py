"""Initialisation in motion: from tracks and readings alone to states, gravity, scale and biases.

    choose keyframes -> gyro bias -> closed-form alignment -> bundle adjustment -> look ahead -> add the newest -> judge

Every step may refuse; nothing is believed that the data do not determine well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.factors.landmarks import positions
from vioframe.estimation.factors.problem import Problem, Variables
from vioframe.estimation.factors.reprojection import Calibrated
from vioframe.estimation.factors.solver import Solution
from vioframe.estimation.inertial.preintegration import Preintegrated, preintegrate
from vioframe.estimation.initialization.alignment import Alignment, align, rotations
from vioframe.estimation.initialization.attitude import level_rotation
from vioframe.estimation.initialization.bundle_adjustment import adjusted, adjustment, covariance
from vioframe.estimation.initialization.estimate import InitialEstimate, RefusalError
from vioframe.estimation.initialization.gyro_bias import estimate_gyro_bias
from vioframe.estimation.initialization.judgement import check_fit, check_lookahead, check_parallax, check_uncertainty
from vioframe.estimation.initialization.options import InitializationOptions
from vioframe.estimation.initialization.structure import Structure, solve_structure
from vioframe.estimation.initialization.window import Bool, Packet, Window, build_window, spread_indices
from vioframe.types import DP, DV, Calibration, Float, ImuSegment, NavState, g_W

_MIN_VIEWS = 4
# Tracks farther off than this are not noise: standard deviations, typical over all views.
_EPIPOLAR_LIMIT, _STRUCTURE_LIMIT, _ADJUSTED_LIMIT = 3.0, 10.0, 3.0
_FARTHEST_M = 200.0


def initialise(packets: Sequence[Packet], calibration: Calibration, options: InitializationOptions) -> InitialEstimate:
    """Estimate from consecutive ``packets``, the newest last; raises :class:`RefusalError`."""
    t_ns = np.array([tracks.t_ns for _, tracks in packets])
    held_out = int((t_ns > t_ns[-1] - options.lookahead_s * 1e9).sum())
    chosen = spread_indices(t_ns[:-held_out], options.keyframes)
    sigma = options.pixel_sigma / calibration.camera.focal_px

    window = build_window(packets, [*chosen, len(packets) - 1], _MIN_VIEWS, options.max_landmarks)
    _require(window, "tracks are long enough", options)
    window, bias_gyro = _with_gyro_bias(window, calibration, sigma, options)
    imu = _preintegrate(window, bias_gyro, np.zeros(3), calibration)
    R_B0B = rotations(imu)
    check_parallax(window, R_B0B, calibration, options)

    window, structure = _structure(window, R_B0B @ calibration.R_BC, sigma, options)
    alignment = align(structure.position, imu[:-1], calibration, options.bias_accel_sigma)
    if alignment.scale <= 0.0:
        raise RefusalError("the readings contradict the direction of the motion in the images")
    x = _start_of_adjustment(window.without_last(), structure, alignment, bias_gyro, calibration)
    problem, solution = _adjusted(window.without_last(), x, calibration, options)
    keep = _explained(problem, solution.variables)
    window = window.only(keep)
    _require(window, "tracks fit the bundle adjustment", options)
    x = replace(solution.variables, landmarks=solution.variables.landmarks[keep])
    problem, solution = _adjusted(window.without_last(), x, calibration, options)
    check_fit(problem, solution, options)

    x = solution.variables
    predicted = _predict(packets[-held_out:], x.states.unstack(window.t_ns[:-1])[-1], calibration)
    p_WF = _positions(problem, x)
    check_lookahead(predicted, [tracks for _, tracks in packets[-held_out:]], window.ids, p_WF, calibration, options)

    x = replace(x, states=x.states.append(StateArrays.stack(predicted[-1:])))
    problem, solution = _adjusted(window, x, calibration, options)
    check_fit(problem, solution, options)
    x = solution.variables
    cov = covariance(problem, x, options)
    check_uncertainty(x.states.p_WB, cov, options)
    keep = _explained(problem, x)
    return _estimate(window.only(keep), x.states, cov, _positions(problem, x)[keep])


def _require(window: Window, what: str, options: InitializationOptions) -> None:
    if len(window.ids) < options.min_landmarks:
        raise RefusalError(f"{len(window.ids)} {what}, {options.min_landmarks} are needed")


def _preintegrate(
    window: Window, bias_gyro_B: Float, bias_accel_B: Float, calibration: Calibration
) -> list[Preintegrated]:
    return [preintegrate(segment, bias_gyro_B, bias_accel_B, calibration.imu) for segment in window.segments]


def _with_gyro_bias(
    window: Window, calibration: Calibration, sigma: float, options: InitializationOptions
) -> tuple[Window, Float]:
    """The tracks that lie on their epipolar lines, and the gyroscope's bias (3,) that puts them there."""
    imu = _preintegrate(window, np.zeros(3), np.zeros(3), calibration)
    bias, distance = estimate_gyro_bias(window, imu, calibration.R_BC, sigma, options.bias_gyro_sigma)
    if np.linalg.norm(bias) > 3.0 * options.bias_gyro_sigma:
        raise RefusalError(f"gyroscope bias of {np.linalg.norm(bias):.2f} rad/s is not plausible")
    window = window.only(distance < _EPIPOLAR_LIMIT)
    _require(window, "tracks lie on their epipolar lines", options)
    return window, bias


def _structure(window: Window, R_B0C: Float, sigma: float, options: InitializationOptions) -> tuple[Window, Structure]:
    """The structure without the newest keyframe, from the tracks that fit it."""
    for _ in range(2):
        structure = solve_structure(window.without_last(), R_B0C[:-1], sigma)
        typical = np.nanmedian(structure.error, axis=0)
        keep = structure.good & (typical < _STRUCTURE_LIMIT * sigma)
        window = window.only(keep)
        _require(window, "tracks have parallax and fit the structure", options)
    return window, structure.only(keep)


def _start_of_adjustment(
    window: Window, structure: Structure, alignment: Alignment, bias_gyro_B: Float, calibration: Calibration
) -> Variables:
    """States in a world with z up, and landmarks [x y rho] in the first frame that sees them."""
    R_WB0 = level_rotation(-alignment.g_B0)
    count = len(window.t_ns)
    states = StateArrays(
        R_WB0 @ alignment.R_B0B,
        alignment.p_B0B @ R_WB0.T,
        alignment.v_B0B @ R_WB0.T,
        np.tile(bias_gyro_B, (count, 1)),
        np.tile(alignment.bias_accel_B, (count, 1)),
    )
    track = np.arange(len(window.ids))
    host = window.seen.argmax(axis=0)
    inverse_depth = 1.0 / (alignment.scale * structure.depth[host, track])
    landmarks = np.column_stack([window.xy[host, track], inverse_depth])
    return Variables(states, _camera(calibration), landmarks)


def _camera(calibration: Calibration) -> Calibrated:
    # Contiguous, as what the solver makes of it is: kernels are compiled for each layout that they meet.
    return Calibrated(np.ascontiguousarray(calibration.R_BC), np.ascontiguousarray(calibration.p_BC))


def _adjusted(
    window: Window, x: Variables, calibration: Calibration, options: InitializationOptions
) -> tuple[Problem, Solution]:
    """The adjustment of ``window`` from ``x``, its readings integrated at the biases there."""
    biases = zip(x.states.bias_gyro_B[:-1], x.states.bias_accel_B[:-1], strict=True)
    imu = [preintegrate(segment, *bias, calibration.imu) for segment, bias in zip(window.segments, biases, strict=True)]
    problem = adjustment(window, imu, x, calibration.camera.focal_px, options)
    return problem, adjusted(problem, x)


def _explained(problem: Problem, x: Variables) -> Bool:
    """(L,) whether a track's landmark lies in front of its cameras, at a finite depth, and near its observations."""
    errors = problem.sightings.errors(x.poses, x.camera, x.landmarks)
    return np.asarray((errors < _ADJUSTED_LIMIT) & (x.landmarks[:, 2] > 1.0 / _FARTHEST_M))


def _positions(problem: Problem, x: Variables) -> Float:
    """(L, 3) m of the landmarks in the world."""
    return positions(x.states, x.camera, problem.sightings.seen.argmax(axis=1), x.landmarks)


def _predict(packets: Sequence[Packet], last: NavState, calibration: Calibration) -> list[NavState]:
    """The state at each of ``packets``, of which the first follows ``last``, from readings alone."""
    out = []
    for imu, _ in packets:
        last = preintegrate(imu, last.bias_gyro_B, last.bias_accel_B, calibration.imu).predict(last)
        out.append(last)
    return out


def _estimate(window: Window, adjusted: StateArrays, cov: Float, p_WF: Float) -> InitialEstimate:
    """The world turned and moved so that yaw and position are zero at the first state."""
    R_0, p_0 = adjusted.R_WB[0], adjusted.p_WB[0]
    R_new = level_rotation(R_0[2]) @ R_0.T  # R_0[2] is the vertical in the body
    turn = np.eye(15)
    turn[DP, DP] = turn[DV, DV] = R_new
    states = StateArrays(
        R_new @ adjusted.R_WB,
        (adjusted.p_WB - p_0) @ R_new.T,
        adjusted.v_WB @ R_new.T,
        adjusted.bias_gyro_B,
        adjusted.bias_accel_B,
    ).unstack(window.t_ns)
    newest = turn @ cov[-15:, -15:] @ turn.T
    states[-1] = replace(states[-1], cov=0.5 * (newest + newest.T))
    return InitialEstimate("dynamic", tuple(states), window.ids, (p_WF - p_0) @ R_new.T)


def warm_up(calibration: Calibration) -> None:
    """Compile the kernels of the adjustment, or load them from the cache, so that the first attempt does not wait."""
    t_ns, half_ns = np.arange(4) * 100_000_000, np.arange(3) * 50_000_000
    xy = np.tile(np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2)), (4, 1, 1))
    segments = tuple(ImuSegment(t + half_ns, np.zeros((3, 3)), np.tile(-g_W, (3, 1))) for t in t_ns[:-1])
    window = Window(t_ns, segments, np.arange(20), xy, np.ones((4, 20), bool))
    state = NavState(0, np.eye(3), *np.zeros((4, 3)))
    x = Variables(StateArrays.stack([state] * 4), _camera(calibration), np.column_stack([xy[0], np.full(20, 0.2)]))
    problem, solution = _adjusted(window, x, calibration, InitializationOptions())
    _explained(problem, solution.variables)
