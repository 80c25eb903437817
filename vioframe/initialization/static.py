"""Initialisation at rest: gravity and the gyroscope's bias from the readings, once images and readings agree on rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vioframe.geometry import so3
from vioframe.inertial.preintegration import join_segments
from vioframe.initialization.attitude import level_rotation
from vioframe.initialization.estimate import InitialEstimate, Refused
from vioframe.initialization.options import InitializationOptions
from vioframe.initialization.window import Packet
from vioframe.types import DBA, DBG, DP, DTHETA, DV, GRAVITY_M_S2, Calibration, Float, ImuSegment, NavState, g_W

_MIN_COMMON = 10
# How well "at rest" fixes what it says, m and m/s; position and yaw are the origin by definition.
_VELOCITY_SIGMA = 0.01
_GAUGE_SIGMA = 1e-4
_LARGEST_RATE = 0.5  # rad/s, far beyond any bias


def initialise(packets: Sequence[Packet], calibration: Calibration, options: InitializationOptions) -> InitialEstimate:
    """Estimate from consecutive ``packets``, the newest last; raises :class:`Refused` unless they are at rest.

    At constant velocity an accelerometer sees what it sees at rest, hence the images must stand still too.
    """
    imu = join_segments([segment for segment, _ in packets[1:]])
    _check_readings(imu, options)
    _check_images(packets, options)

    gyro, accel = imu.gyro_B.mean(axis=0), imu.accel_B.mean(axis=0)
    norm = float(np.linalg.norm(accel))
    excess = norm - GRAVITY_M_S2
    if abs(excess) > 3.0 * options.bias_accel_sigma:
        raise Refused(f"the accelerometer's mean is {norm:.2f} m/s^2, too far from gravity's {GRAVITY_M_S2}")
    R_WB = level_rotation(accel)
    # Of all biases that explain the mean's length the smallest, which is the likeliest, points along gravity.
    bias_accel = excess * accel / norm
    cov = _covariance(imu, R_WB, calibration, options)
    states = [
        NavState(
            tracks.t_ns, R_WB, np.zeros(3), np.zeros(3), gyro, bias_accel, cov if tracks is packets[-1][1] else None
        )
        for _, tracks in packets
    ]
    return InitialEstimate("static", tuple(states))


def _check_readings(imu: ImuSegment, options: InitializationOptions) -> None:
    gyro_std, accel_std = imu.gyro_B.std(axis=0).max(), imu.accel_B.std(axis=0).max()
    if gyro_std > options.static_gyro_std:
        raise Refused(f"not at rest: the gyroscope varies by {gyro_std:.3f} rad/s")
    if accel_std > options.static_accel_std:
        raise Refused(f"not at rest: the accelerometer varies by {accel_std:.2f} m/s^2")
    rate = np.linalg.norm(imu.gyro_B.mean(axis=0))
    if rate > _LARGEST_RATE:
        raise Refused(f"not at rest: turning at {rate:.2f} rad/s")


def _check_images(packets: Sequence[Packet], options: InitializationOptions) -> None:
    """No frame's features may have moved from where the first frame, or the middle one, saw them."""
    frames = [tracks for _, tracks in packets]
    for reference in (frames[0], frames[len(frames) // 2]):
        for tracks in frames:
            _, a, b = np.intersect1d(reference.ids, tracks.ids, assume_unique=True, return_indices=True)
            if len(a) < _MIN_COMMON:
                raise Refused(f"only {len(a)} features were tracked through the standstill window")
            moved = float(np.median(np.linalg.norm(reference.xy[a] - tracks.xy[b], axis=1)))
            if moved > options.static_disparity_px:
                raise Refused(f"not at rest: features moved by {moved:.1f} px")


def _covariance(imu: ImuSegment, R_WB: Float, calibration: Calibration, options: InitializationOptions) -> Float:
    """(15, 15): the mean specific force ties tilt and accelerometer bias together, accel = R_WB' (-g_W) + bias.

    A bias across gravity cannot be told from a tilt: the two are each as uncertain as the prior of the bias and almost
    fully correlated.
    """
    duration = imu.duration_s
    gyro_variance = imu.gyro_B.var(axis=0) / len(imu.t_ns) + calibration.imu.gyro_walk**2 * duration
    accel_variance = imu.accel_B.var(axis=0) / len(imu.t_ns) + calibration.imu.accel_walk**2 * duration
    information = np.zeros((15, 15))
    J = np.zeros((3, 15))
    J[:, DTHETA] = so3.hat(R_WB.T @ -g_W)
    J[:, DBA] = np.eye(3)
    information += J.T @ np.diag(1.0 / accel_variance) @ J
    yaw = R_WB[2]
    information[DTHETA, DTHETA] += np.outer(yaw, yaw) / _GAUGE_SIGMA**2
    information[DP, DP] += np.eye(3) / _GAUGE_SIGMA**2
    information[DV, DV] += np.eye(3) / _VELOCITY_SIGMA**2
    information[DBG, DBG] += np.diag(1.0 / gyro_variance)
    information[DBA, DBA] += np.eye(3) / options.bias_accel_sigma**2
    cov: Float = np.linalg.inv(information)
    return 0.5 * (cov + cov.T)
