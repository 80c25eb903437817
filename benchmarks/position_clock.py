"""By how much the positions of a trajectory are late by the clock of the IMU, with no camera and no estimator in it.

Over a window of half-width h the second difference of position is the triangle-weighted mean of the acceleration:

    (p(t + h) - 2 p(t) + p(t - h)) / h^2 = sum_i w_i R_WB(t_i) (accel_B(t_i) - ba) + g_W,

linear in the constant bias ba and in gravity. Where positions are late, p(t + late) stands in the place of p(t), and a
few steps of Gauss and Newton find by how much. Nothing is differentiated: at h = 0.5 s a millimetre of position noise
counts as 10 mm/s^2, and a least-squares solution over the recording takes the mean of that.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.geometry.trajectory import Trajectory
from vioframe.simulation.scenario import linear
from vioframe.types import NS_PER_S, Float, Int

# Within shorter windows a truth that was smoothed with the IMU's help follows the IMU, whatever its positions do.
_HALF_WINDOW_S, _STEP_S = 0.5, 0.005
_LARGEST_S, _STEPS, _SETTLED_S = 0.1, 20, 1e-6


@dataclass(frozen=True, slots=True)
class PositionClock:
    """``late_s``: a position that is stamped t is that of t - late_s, with standard deviation ``sigma_s``.

    ``g_W`` (3,) m/s^2 is gravity as the readings have it in the world of the positions.
    """

    late_s: float
    sigma_s: float
    g_W: Float


def position_clock(truth: Trajectory, imu_ns: Int, accel_B: Float) -> PositionClock:
    """The clock of the positions of ``truth``, whose attitudes are on time, against readings at ``imu_ns`` (N,).

    ``accel_B`` (N, 3) m/s^2. Raises :class:`TrajectoryError` where they have less than two seconds in common, and where
    positions seem to be off by more than a tenth of a second: then something else is wrong.
    """
    half = round(_HALF_WINDOW_S / _STEP_S)
    margin_ns = round((_LARGEST_S + _STEP_S) * NS_PER_S)
    begin, end = max(truth.t_ns[0], imu_ns[0]) + margin_ns, min(truth.t_ns[-1], imu_ns[-1]) - margin_ns
    grid_ns = np.arange(begin, end, round(_STEP_S * NS_PER_S))
    if len(grid_ns) <= 4 * half:
        raise TrajectoryError(f"the clock of positions needs more than {4 * _HALF_WINDOW_S:g} s of motion")
    R_WB = truth.at(grid_ns).R_WB
    force_W = (R_WB @ linear(imu_ns, accel_B, grid_ns)[..., None])[..., 0]

    triangle = half - np.abs(np.arange(-half, half + 1.0))
    triangle /= triangle.sum()
    felt, turned = _weighted(force_W, triangle), _weighted(R_WB.reshape(-1, 9), triangle).reshape(-1, 3, 3)
    eye = np.broadcast_to(np.eye(3), turned.shape)
    late_s = 0.0
    for _ in range(_STEPS):
        p_W, before, after = (truth.at(_later(grid_ns, late_s + d)).p_WB for d in (0.0, -_STEP_S, _STEP_S))
        # seen + by_lateness step = felt - turned bias + gravity
        seen, by_lateness = (_second_difference(a, half) for a in (p_W, (after - before) / (2.0 * _STEP_S)))
        A = np.concatenate([-turned, eye, -by_lateness[..., None]], axis=2).reshape(-1, 7)
        b = (seen - felt).ravel()
        x = np.linalg.lstsq(A, b, rcond=None)[0]
        late_s += float(x[6])
        if not abs(late_s) <= _LARGEST_S:
            raise TrajectoryError(f"positions seem to be off by more than {_LARGEST_S:g} s: are stamps and axes right?")
        if abs(x[6]) < _SETTLED_S:
            break
    # Windows overlap: a residual is told again by all that begin within one.
    variance = float(((b - A @ x) ** 2).mean()) * 2 * half
    sigma_s = float(np.sqrt(variance * np.linalg.inv(A.T @ A)[6, 6]))
    return PositionClock(late_s, sigma_s, np.asarray(x[3:6]))


def _later(t_ns: Int, seconds: float) -> Int:
    return t_ns + round(seconds * NS_PER_S)


def _weighted(values: Float, weights: Float) -> Float:
    """Windowed sums (N - W + 1, D) of the columns of ``values`` (N, D) with ``weights`` (W,)."""
    return np.column_stack([np.convolve(column, weights, mode="valid") for column in values.T])


def _second_difference(values: Float, half: int) -> Float:
    """(N - 2 half, D) of the columns of ``values`` (N, D), per s^2."""
    difference: Float = (values[2 * half :] - 2.0 * values[half:-half] + values[: -2 * half]) / _HALF_WINDOW_S**2
    return difference


def with_positions_of_later(truth: Trajectory, late_s: float) -> Trajectory:
    """Each pose with the position of ``late_s`` after it in its place; those are gone that have none."""
    at_ns = _later(truth.t_ns, late_s)
    kept = truth.covers(at_ns)
    return replace(truth.select(kept), p_WB=truth.at(at_ns[kept]).p_WB)
