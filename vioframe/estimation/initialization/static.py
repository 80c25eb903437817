"""Initialisation at rest: gravity and the gyroscope's bias, once images and readings agree that nothing moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce

import numpy as np

from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.estimation.initialization.window import BIAS_ACCEL_SIGMA, InitialEstimate, Packet, refuse_unless
from vioframe.geometry import so3
from vioframe.types import DBA, DBG, DP, DTHETA, DV, GRAVITY_M_S2, Float, ImuNoise, ImuSegment, NavState, g_W

_MIN_COMMON, _MIN_FRAMES = 10, 6
# Most that means over blocks of readings may vary, rad/s and m/s^2, and the median feature may move between the thirds
# of the window: what standing on the ground with spinning rotors (V1_01_easy) stays within, and no flight does.
_BLOCK_S, _GYRO_STD, _ACCEL_STD, _DISPARITY_PX = 0.1, 0.02, 0.2, 1.5
# How well "at rest" fixes what it says, m and m/s; position and yaw are the origin by definition.
_VELOCITY_SIGMA = 0.02
_GAUGE_SIGMA = 1e-4
_LARGEST_RATE = 0.5  # rad/s, far beyond any bias


def initialise(packets: Sequence[Packet], noise: ImuNoise) -> InitialEstimate:
    """Estimate from consecutive ``packets``, the newest last; refuses unless they are at rest.

    At constant velocity an accelerometer sees what it sees at rest, hence the images must stand still too.
    """
    _check_readings(packets)
    _check_images(packets)
    imu = join_segments([segment for segment, _ in packets[1:]])

    gyro, accel = imu.gyro_B.mean(axis=0), imu.accel_B.mean(axis=0)
    norm = float(np.linalg.norm(accel))
    excess = norm - GRAVITY_M_S2
    apart = f"the accelerometer's mean is {norm:.2f} m/s^2, too far from gravity's {GRAVITY_M_S2}"
    refuse_unless(abs(excess) <= 3.0 * BIAS_ACCEL_SIGMA, apart)
    R_WB = so3.level_rotation(accel)
    # Of all biases that explain the mean's length the smallest, which is the likeliest, points along gravity.
    bias_accel = excess * accel / norm
    cov = _covariance(imu, R_WB, noise)
    states = [NavState(tracks.t_ns, R_WB, np.zeros(3), np.zeros(3), gyro, bias_accel) for _, tracks in packets]
    states[-1] = replace(states[-1], cov=cov)
    return InitialEstimate("static", tuple(states))


def _check_readings(packets: Sequence[Packet]) -> None:
    """Means over a tenth of a second must be steady: rotors shake a standing vehicle, but do not carry it off."""
    blocks = _block_means([segment for segment, _ in packets[1:]])
    gyro_std, accel_std = blocks[:, :3].std(axis=0).max(), blocks[:, 3:].std(axis=0).max()
    refuse_unless(gyro_std <= _GYRO_STD, f"not at rest: the gyroscope varies by {gyro_std:.3f} rad/s")
    refuse_unless(accel_std <= _ACCEL_STD, f"not at rest: the accelerometer varies by {accel_std:.2f} m/s^2")
    rate = np.linalg.norm(blocks[:, :3].mean(axis=0))
    refuse_unless(rate <= _LARGEST_RATE, f"not at rest: turning at {rate:.2f} rad/s")


def _block_means(segments: Sequence[ImuSegment]) -> Float:
    """(N, 6) mean angular rate and specific force over consecutive stretches of at least ``_BLOCK_S``."""
    means, block = [], list[ImuSegment]()
    for segment in segments:
        block.append(segment)
        if sum(s.duration_s for s in block) >= _BLOCK_S - 1e-3:
            joined = join_segments(block)
            means.append(np.concatenate([joined.gyro_B.mean(axis=0), joined.accel_B.mean(axis=0)]))
            block = []
    return np.stack(means)


def _check_images(packets: Sequence[Packet]) -> None:
    """A feature's typical place must be the same in every third of the window: medians quieten noise and outliers."""
    frames = [tracks for _, tracks in packets]
    refuse_unless(len(frames) >= _MIN_FRAMES, f"only {len(frames)} frames in the standstill window")
    common = reduce(np.intersect1d, (tracks.ids for tracks in frames))
    refuse_unless(len(common) >= _MIN_COMMON, f"only {len(common)} features were tracked through the standstill window")
    xy = np.stack([t.xy[np.intersect1d(t.ids, common, return_indices=True)[1]] for t in frames])
    first, middle, last = (np.median(third, axis=0) for third in np.array_split(xy, 3))
    for a, b in ((first, middle), (middle, last), (first, last)):
        moved = float(np.median(np.linalg.norm(b - a, axis=1)))
        refuse_unless(moved <= _DISPARITY_PX, f"not at rest: features moved by {moved:.1f} px")


def _covariance(imu: ImuSegment, R_WB: Float, noise: ImuNoise) -> Float:
    """(15, 15): the mean specific force ties tilt and accelerometer bias together, accel = R_WB' (-g_W) + bias.

    A bias across gravity cannot be told from a tilt: the two are each as uncertain as the prior of the bias and almost
    fully correlated.
    """
    duration = imu.duration_s
    gyro_variance = imu.gyro_B.var(axis=0) / len(imu.t_ns) + noise.gyro_walk**2 * duration
    accel_variance = imu.accel_B.var(axis=0) / len(imu.t_ns) + noise.accel_walk**2 * duration
    information = np.zeros((15, 15))
    J = np.zeros((3, 15))
    J[:, DTHETA] = so3.hat(R_WB.T @ -g_W)
    J[:, DBA] = np.eye(3)
    information += J.T @ (J / accel_variance[:, None])
    yaw = R_WB[2]
    information[DTHETA, DTHETA] += np.outer(yaw, yaw) / _GAUGE_SIGMA**2
    information[DP, DP] += np.eye(3) / _GAUGE_SIGMA**2
    information[DV, DV] += np.eye(3) / _VELOCITY_SIGMA**2
    information[DBG, DBG] += np.diag(1.0 / gyro_variance)
    information[DBA, DBA] += np.eye(3) / BIAS_ACCEL_SIGMA**2
    cov = np.asarray(np.linalg.inv(information), np.float64)
    return 0.5 * (cov + cov.T)
