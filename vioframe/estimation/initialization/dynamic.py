"""Initialisation in motion: from tracks and readings alone to states, gravity, scale and biases.

    choose keyframes -> gyro bias -> closed-form alignment -> bundle adjustment -> look ahead -> add the newest -> judge

Every step may refuse; nothing is believed that the data do not determine well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.inertial.preintegration import Preintegrated, preintegrate
from vioframe.estimation.initialization import bundle_adjustment
from vioframe.estimation.initialization import landmarks as lm
from vioframe.estimation.initialization.alignment import Alignment, align, rotations
from vioframe.estimation.initialization.attitude import level_rotation
from vioframe.estimation.initialization.bundle_adjustment import Problem, Solution
from vioframe.estimation.initialization.estimate import InitialEstimate, RefusalError
from vioframe.estimation.initialization.gyro_bias import estimate_gyro_bias
from vioframe.estimation.initialization.judgement import check_fit, check_lookahead, check_parallax, check_uncertainty
from vioframe.estimation.initialization.landmarks import Observations
from vioframe.estimation.initialization.options import InitializationOptions
from vioframe.estimation.initialization.structure import Structure, solve_structure
from vioframe.estimation.initialization.window import Bool, Packet, Window, build_window, spread_indices
from vioframe.types import DP, DV, Calibration, Float, NavState

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
    states, landmarks = _start_of_adjustment(window.without_last(), structure, alignment, bias_gyro)
    problem = _problem(window.without_last(), states, calibration, sigma, options)
    solution = bundle_adjustment.solve(problem, states, landmarks)
    keep = _explained(problem, solution)
    window = window.only(keep)
    _require(window, "tracks fit the bundle adjustment", options)
    problem = _problem(window.without_last(), solution.states, calibration, sigma, options)
    solution = bundle_adjustment.solve(problem, solution.states, solution.landmarks[keep])
    check_fit(problem, solution, options)

    predicted = _predict(packets[-held_out:], solution.states.unstack(window.t_ns[:-1])[-1], calibration)
    p_WF = lm.positions(solution.states, solution.landmarks, problem.observations, calibration)
    check_lookahead(predicted, [tracks for _, tracks in packets[-held_out:]], window.ids, p_WF, calibration, options)

    states = StateArrays.stack([*solution.states.unstack(window.t_ns[:-1]), predicted[-1]])
    problem = _problem(window, states, calibration, sigma, options)
    solution = bundle_adjustment.solve(problem, states, solution.landmarks)
    check_fit(problem, solution, options)
    cov = bundle_adjustment.covariance(problem, solution)
    check_uncertainty(solution, cov, options)
    p_WF = lm.positions(solution.states, solution.landmarks, problem.observations, calibration)
    keep = _explained(problem, solution)
    return _estimate(window.only(keep), solution, cov, p_WF[keep])


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
    window: Window, structure: Structure, alignment: Alignment, bias_gyro_B: Float
) -> tuple[StateArrays, Float]:
    """States in a world with z up, and landmarks (L, 3) [x y rho] in the first frame that sees them."""
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
    return states, np.column_stack([window.xy[host, track], inverse_depth])


def _problem(
    window: Window, states: StateArrays, calibration: Calibration, sigma: float, options: InitializationOptions
) -> Problem:
    """The adjustment of ``window``, its readings integrated at the biases of ``states``."""
    imu = [
        preintegrate(segment, bias_gyro, bias_accel, calibration.imu)
        for segment, bias_gyro, bias_accel in zip(
            window.segments, states.bias_gyro_B[:-1], states.bias_accel_B[:-1], strict=True
        )
    ]
    return Problem(
        Observations.of(window),
        ImuFactors.stack(imu),
        calibration,
        sigma,
        options.bias_gyro_sigma,
        options.bias_accel_sigma,
    )


def _explained(problem: Problem, solution: Solution) -> Bool:
    """(L,) whether a track's landmark lies in front of its cameras, at a finite depth, and near its observations."""
    obs = problem.observations
    r, depth_ratio = lm.project(solution.states, solution.landmarks, obs, problem.calibration)
    views = np.diff(np.append(obs.start, len(obs.frame)))
    rms = np.sqrt(np.add.reduceat((r**2).sum(axis=1), obs.start) / (2 * views)) / problem.sigma
    in_front = np.minimum.reduceat(depth_ratio, obs.start) > 0.0
    keep: Bool = (rms < _ADJUSTED_LIMIT) & in_front & (solution.landmarks[:, 2] > 1.0 / _FARTHEST_M)
    return keep


def _predict(packets: Sequence[Packet], last: NavState, calibration: Calibration) -> list[NavState]:
    """The state at each of ``packets``, of which the first follows ``last``, from readings alone."""
    out = []
    for imu, _ in packets:
        last = preintegrate(imu, last.bias_gyro_B, last.bias_accel_B, calibration.imu).predict(last)
        out.append(last)
    return out


def _estimate(window: Window, solution: Solution, cov: Float, p_WF: Float) -> InitialEstimate:
    """The world turned and moved so that yaw and position are zero at the first state."""
    R_0, p_0 = solution.states.R_WB[0], solution.states.p_WB[0]
    R_new = level_rotation(R_0[2]) @ R_0.T  # R_0[2] is the vertical in the body
    turn = np.eye(15)
    turn[DP, DP] = turn[DV, DV] = R_new
    states = StateArrays(
        R_new @ solution.states.R_WB,
        (solution.states.p_WB - p_0) @ R_new.T,
        solution.states.v_WB @ R_new.T,
        solution.states.bias_gyro_B,
        solution.states.bias_accel_B,
    ).unstack(window.t_ns)
    newest = turn @ cov[-15:, -15:] @ turn.T
    states[-1] = replace(states[-1], cov=0.5 * (newest + newest.T))
    return InitialEstimate("dynamic", tuple(states), window.ids, (p_WF - p_0) @ R_new.T)
