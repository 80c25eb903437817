"""The path that an IMU felt: a recorded one, made such that a body which flies it reads what was recorded.

A published path is itself an estimate. Where its batch solution corrects itself, that of EuRoC's machine hall steps by
up to 8 cm and 15 cm/s from one pose to the next, and images rendered along it show what no IMU felt. Found here are the
states that explain the readings and lie nearest to the published poses: the most likely ones of a chain with a node a
reading (Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017), by Gauss-Newton steps, each with one banded
Cholesky factorisation. It shares no code with the estimators, which are judged by what comes out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.arrays import Bool, Float, Int
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import TrueTrajectory, true_values
from vioframe.simulation.scenario import Scenario, motion_along
from vioframe.types import DBA, DBG, DP, DTHETA, DV, NS_PER_S, ImuNoise, g_W

# Of a published pose, rad and m, and for how long its error is about the same. Then what is left over of EuRoC's
# readings in a second is as large as the calibration's noise has it; poses trusted more would contradict them.
_ROTATION_SIGMA = 0.002
_POSITION_SIGMA = 0.005
_SAME_ERROR_S = 1.0
# A body is at rest where its published positions of a second lie within this, m; it then moves by so much, m/s.
_AT_REST_M, _AT_REST_SIGMA = 0.005, 0.001
# Between published poses farther apart than this nothing is known of the path but what was felt.
_LONGEST_GAP_S = 0.1
_MOST_STEPS, _SMALL_STEP = 10, 1e-6
_BIASES = slice(DBG.start, DBA.stop)
_DIM = DBA.stop


def felt(published: Scenario, noise: ImuNoise) -> Scenario:
    """The scenario along the path that its readings felt, which are as good as ``noise``.

    Its truth has a state for every reading between the first published pose and the last; frames before and after are
    left out. The readings stay as they are.
    """
    known = published.truth
    within = (published.imu_ns >= known.t_ns[0]) & (published.imu_ns <= known.t_ns[-1])
    t_ns, gyro_B, accel_B = published.imu_ns[within], published.gyro_B[within], published.accel_B[within]
    after = np.clip(np.searchsorted(known.t_ns, t_ns), 1, len(known) - 1)
    trusted = known.t_ns[after] - known.t_ns[after - 1] <= _LONGEST_GAP_S * NS_PER_S
    R_WB, p_WB, _ = published.motion(t_ns)
    R_WB, p_WB, *others = most_likely(t_ns, gyro_B, accel_B, R_WB, p_WB, trusted, _at_rest(t_ns, p_WB), noise)
    poses = Trajectory(t_ns, R_WB, p_WB)
    truth = TrueTrajectory(t_ns, R_WB, p_WB, values=np.hstack([true_values(poses), *others]))
    frames_ns = published.frames_ns
    frames_ns = frames_ns[(frames_ns >= t_ns[0]) & (frames_ns <= t_ns[-1])]
    return replace(published, frames_ns=frames_ns, truth=truth, motion=motion_along(truth))


def _at_rest(t_ns: Int, p_WB: Float) -> Bool:
    """(N,) whether the body stays, from half a second before to half a second after."""
    first, last = (np.searchsorted(t_ns, t_ns + sign * NS_PER_S // 2) for sign in (-1, 1))
    spread = [np.ptp(p_WB[begin:end], axis=0) for begin, end in zip(first, last, strict=True)]
    return np.asarray(np.linalg.norm(spread, axis=1) < _AT_REST_M)


def most_likely(
    t_ns: Int, gyro_B: Float, accel_B: Float, R_WB: Float, p_WB: Float, trusted: Bool, at_rest: Bool, noise: ImuNoise
) -> tuple[Float, Float, Float, Float]:
    """``R_WB`` (N, 3, 3), ``p_WB`` m, ``v_WB`` m/s (N, 3) and both biases (N, 6) at N readings, from poses there.

    Only the poses that are ``trusted`` (N,) hold it, and that it does not move where it is ``at_rest`` (N,).
    """
    from scipy.linalg import solveh_banded

    t_s = (t_ns - t_ns[0]) / NS_PER_S
    weight = np.zeros((len(t_s), _DIM))
    weight[:, :6] = 1.0 / np.repeat([_ROTATION_SIGMA, _POSITION_SIGMA], 3) ** 2
    weight[~trusted] = 0.0
    weight[at_rest, DV] = 1.0 / _AT_REST_SIGMA**2
    weight *= np.gradient(t_s)[:, None] / _SAME_ERROR_S
    known_R, known_p = R_WB, p_WB
    v_WB, biases = np.gradient(p_WB, t_s, axis=0), np.zeros((len(t_s), 6))
    for _ in range(_MOST_STEPS):
        off = np.zeros_like(weight)
        off[:, DTHETA], off[:, DP] = so3.log(np.swapaxes(known_R, 1, 2) @ R_WB), p_WB - known_p
        off[:, DV] = v_WB
        residual, before, after = between(np.diff(t_s), gyro_B, accel_B, R_WB, p_WB, v_WB, biases, noise)
        # The normal equations: a block on the diagonal a node, and one below it that ties it to the next.
        own, tie = np.zeros((len(t_s), _DIM, _DIM)), np.swapaxes(after, 1, 2) @ before
        own[:-1] += np.swapaxes(before, 1, 2) @ before
        own[1:] += np.swapaxes(after, 1, 2) @ after
        # Row i - j of the band holds, in column j, what entry (i, j) of the matrix does.
        band, right = np.zeros((2 * _DIM, len(t_s), _DIM)), -weight * off
        band[0] = weight
        for i, j in np.ndindex(_DIM, _DIM):
            if i >= j:
                band[i - j, :, j] += own[:, i, j]
            band[_DIM + i - j, :-1, j] += tie[:, i, j]
        right[:-1] -= np.einsum("nki,nk->ni", before, residual)
        right[1:] -= np.einsum("nki,nk->ni", after, residual)
        step = solveh_banded(band.reshape(2 * _DIM, -1), right.ravel(), lower=True).reshape(right.shape)
        R_WB = R_WB @ so3.exp(step[:, DTHETA])
        p_WB, v_WB, biases = p_WB + step[:, DP], v_WB + step[:, DV], biases + step[:, _BIASES]
        if np.abs(step).max() < _SMALL_STEP:
            break
    return R_WB, p_WB, v_WB, biases


def between(
    dt: Float, gyro_B: Float, accel_B: Float, R_WB: Float, p_WB: Float, v_WB: Float, biases: Float, noise: ImuNoise
) -> tuple[Float, Float, Float]:
    """What nodes ``dt`` (N-1,) s apart contradict the readings by, in standard deviations (N-1, 15).

    And its derivatives by the node before and by the one after, (N-1, 15, 15). A reading holds as the mean of two
    neighbours, with the bias of the earlier; the position follows the mean velocity, from which white noise of the
    accelerometer takes it by a variance of dt^3/12.
    """
    R, R_next = R_WB[:-1], R_WB[1:]
    turn = so3.exp((0.5 * (gyro_B[1:] + gyro_B[:-1]) - biases[:-1, :3]) * dt[:, None])
    accel, accel_next = accel_B[:-1] - biases[:-1, 3:], accel_B[1:] - biases[:-1, 3:]
    a_WB = 0.5 * (np.einsum("nij,nj->ni", R, accel) + np.einsum("nij,nj->ni", R_next, accel_next)) + g_W
    residual = np.empty((len(dt), _DIM))
    residual[:, DTHETA] = so3.log(np.swapaxes(R @ turn, 1, 2) @ R_next)
    residual[:, DP] = np.diff(p_WB, axis=0) - 0.5 * dt[:, None] * (v_WB[1:] + v_WB[:-1])
    residual[:, DV] = np.diff(v_WB, axis=0) - dt[:, None] * a_WB
    residual[:, _BIASES] = np.diff(biases, axis=0)

    before, after = (np.tile(sign * np.eye(_DIM), (len(dt), 1, 1)) for sign in (-1.0, 1.0))
    dt_I = dt[:, None, None] * np.eye(3)
    before[:, DTHETA, DTHETA] = -np.swapaxes(turn, 1, 2)
    before[:, DTHETA, DBG] = dt_I
    before[:, DP, DV] = after[:, DP, DV] = -0.5 * dt_I
    before[:, DV, DTHETA] = 0.5 * dt_I @ R @ so3.hat(accel)
    after[:, DV, DTHETA] = 0.5 * dt_I @ R_next @ so3.hat(accel_next)
    before[:, DV, DBA] = 0.5 * dt_I @ (R + R_next)

    densities = (
        noise.gyro_density,
        noise.accel_density * dt / np.sqrt(12.0),
        noise.accel_density,
        noise.gyro_walk,
        noise.accel_walk,
    )
    sigma = np.repeat(np.column_stack([density * np.sqrt(dt) for density in densities]), 3, axis=1)
    return residual / sigma, before / sigma[:, :, None], after / sigma[:, :, None]
