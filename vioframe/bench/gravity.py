"""Which way is down in a frame whose poses are known but whose vertical is not."""

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.simulation.scenario import interpolate_poses
from vioframe.types import Float, Int

_HALF_WINDOW_S = 0.5
_STEP_S = 0.005


def gravity_in_frame(poses: Trajectory, imu_ns: Int, accel_B: Float) -> Float:
    """Gravity (3,) m/s^2 in the frame A of ``poses`` (R_AB, p_AB), from the accelerometer's (N, 3) readings.

    Over a window of half-width h the second difference of position is the triangle-weighted mean of the acceleration:

        (p(t + h) - 2 p(t) + p(t - h)) / h^2 = sum_i w_i R_AB(t_i) (accel_B(t_i) - ba) + g_A,

    which is linear in the constant bias ``ba`` and in ``g_A``. Nothing is differentiated: at h = 0.5 s a millimetre of
    position noise counts as 10 mm/s^2, and a least-squares solution over the recording takes the mean of that.
    """
    half = round(_HALF_WINDOW_S / _STEP_S)
    begin, end = max(poses.t_ns[0], imu_ns[0]), min(poses.t_ns[-1], imu_ns[-1])
    grid_ns = np.arange(begin, end, round(_STEP_S * 1e9))
    if len(grid_ns) <= 4 * half:
        raise TrajectoryError(f"finding the vertical needs more than {4 * _HALF_WINDOW_S:g} s of motion")
    R_AB, p_AB = interpolate_poses(poses.t_ns, poses.R_WB, poses.p_WB, grid_ns)
    seconds = (imu_ns - imu_ns[0]) * 1e-9
    grid_s = (grid_ns - imu_ns[0]) * 1e-9
    accel = np.column_stack([np.interp(grid_s, seconds, column) for column in accel_B.T])

    weights = half - np.abs(np.arange(-half, half + 1.0))
    weights /= weights.sum()
    measured = (p_AB[2 * half :] - 2.0 * p_AB[half:-half] + p_AB[: -2 * half]) / _HALF_WINDOW_S**2
    mean_accel = _weighted(np.einsum("nij,nj->ni", R_AB, accel), weights)
    mean_R = _weighted(R_AB.reshape(-1, 9), weights).reshape(-1, 3, 3)
    # measured - mean_accel = -mean_R ba + g
    A = np.concatenate([-mean_R, np.tile(np.eye(3), (len(mean_R), 1, 1))], axis=2)
    solution = np.linalg.lstsq(A.reshape(-1, 6), (measured - mean_accel).ravel(), rcond=None)[0]
    return np.asarray(solution[3:])


def rotation_to_vertical(g_A: Float) -> Float:
    """The smallest rotation R_WA (3, 3) that brings gravity (3,) to W's -z."""
    down_A = g_A / np.linalg.norm(g_A)
    axis = np.cross(down_A, [0.0, 0.0, -1.0])
    sine, cosine = np.linalg.norm(axis), -down_A[2]
    unit = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])
    return so3.exp(unit * np.arctan2(sine, cosine))


def _weighted(values: Float, weights: Float) -> Float:
    """Running mean (N - K + 1, C) of ``values`` (N, C) under ``weights`` (K,)."""
    return np.column_stack([np.convolve(column, weights, "valid") for column in values.T])
