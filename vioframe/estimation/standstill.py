"""Recognising standstill: what images and readings say when a body does not move.

The image decides, over half a second: a body that drifts slowly shows it in that time, while one that stands still but
shakes (motors, a hand nearby) does not, although its IMU reads far more than noise. The IMU must only not object.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.jit import kernel
from vioframe.quantiles import gate
from vioframe.types import DBA, DBG, DTHETA, DV, NS_PER_S, Float, FrameTracks, ImuNoise, ImuSegment, g_W

_MIN_COMMON_TRACKS = 10
_LOOK_BACK_NS = NS_PER_S // 2
SETTLED_NS = NS_PER_S // 6
"""A body that still shows the old picture stood still this long ago; since then it may have set off. At an even
acceleration it goes more than half of its first half second's way in the last sixth of a second. Longer waits would
leave a body that is shaken at rest without corrections for longer."""
_VELOCITY_SIGMA_M_S = 0.01
# A body that stands still may yet shake, so its readings scatter this many times more than the sensor's noise.
_SHAKING = 10.0
TREMBLE: Float = np.repeat([5e-4, 2e-3, 5e-3], 3)
"""(9,) [rad, m, m/s] by which a body that sets off may be off from where it came to rest: for a while a picture of
things a few metres away shows no more than that. Images say what way it took to a twentieth of it: were it thought to
have begun just where it came to rest, velocity and biases would answer for the difference."""


def standstill_gate() -> float:
    """Squared Mahalanobis distance, of nine degrees of freedom, below which the readings agree with standstill."""
    return gate(0.95, 9)


class StandstillDetector:
    """Tells from the tracks of the last half second whether the camera may be standing still."""

    def __init__(self, max_motion_px: float) -> None:
        self._max_motion_px = max_motion_px
        self._recent: deque[FrameTracks] = deque()

    def sees_standstill(self, tracks: FrameTracks) -> bool:
        """Take in a frame's tracks; whether it shows the same picture as the frame half a second before it."""
        recent = self._recent
        recent.append(tracks)
        while len(recent) > 1 and tracks.t_ns - recent[1].t_ns >= _LOOK_BACK_NS:
            recent.popleft()
        if tracks.t_ns - recent[0].t_ns < _LOOK_BACK_NS:
            return False
        return common_motion_px(recent[0], tracks) <= self._max_motion_px


def common_motion_px(before: FrameTracks, now: FrameTracks) -> float:
    """How far the picture of a camera has moved, turned and grown, px, the largest of all cameras'.

    By medians over the tracks that both frames have, so that it is neither what some of them do nor that all of them
    tremble. Infinite where no camera has enough to tell.
    """
    motions = []
    for camera in np.unique(now.camera):
        old, new = before.of_camera(camera), now.of_camera(camera)
        _, i, j = np.intersect1d(old.ids, new.ids, assume_unique=True, return_indices=True)
        if len(i) >= _MIN_COMMON_TRACKS:
            motions.append(_picture_motion_px(old.xy[i], new.xy[j]))
    return max(motions, default=float("inf"))


@kernel
def _picture_motion_px(before: Float, now: Float) -> float:
    """Of points (N, 2)."""
    flow = now - before
    shift_x, shift_y = np.median(flow[:, 0]), np.median(flow[:, 1])
    middle_x, middle_y = before[:, 0].mean(), before[:, 1].mean()
    growth, turn = np.empty(len(flow)), np.empty(len(flow))
    for k in range(len(flow)):
        x, y = before[k, 0] - middle_x, before[k, 1] - middle_y
        away = max(math.hypot(x, y), 1e-9)
        rest_x, rest_y = flow[k, 0] - shift_x, flow[k, 1] - shift_y
        growth[k], turn[k] = (rest_x * x + rest_y * y) / away, (rest_y * x - rest_x * y) / away
    return math.sqrt(shift_x**2 + shift_y**2 + np.median(growth) ** 2 + np.median(turn) ** 2)


@dataclass(frozen=True, slots=True)
class Standstill:
    """The readings of a body that stood still: means ``gyro_B`` (3,) and ``accel_B`` (3,) over ``duration_s``.

    They say: mean gyro = bias, mean accelerometer = -R_WB^T g + bias, velocity = 0, in the body's frame: in the world's
    it would be a compass to a state that moves. ``sigma`` (9,) are the standard deviations of the three.
    """

    gyro_B: Float
    accel_B: Float
    duration_s: float
    noise: ImuNoise

    @staticmethod
    def over(imu: ImuSegment, noise: ImuNoise) -> Standstill:
        return Standstill(imu.gyro_B.mean(axis=0), imu.accel_B.mean(axis=0), imu.duration_s, noise)

    def and_then(self, later: Standstill) -> Standstill:
        """Both, as one."""
        duration_s = self.duration_s + later.duration_s
        part = later.duration_s / duration_s
        gyro_B = (1.0 - part) * self.gyro_B + part * later.gyro_B
        return Standstill(gyro_B, (1.0 - part) * self.accel_B + part * later.accel_B, duration_s, self.noise)

    @property
    def sigma(self) -> Float:
        noise, T = self.noise, self.duration_s
        gyro, accel = _SHAKING * noise.gyro_density / np.sqrt(T), _SHAKING * noise.accel_density / np.sqrt(T)
        # The mean over a long time is that of a bias that walked.
        gyro, accel = (
            np.hypot(gyro, noise.gyro_walk * np.sqrt(T / 3)),
            np.hypot(accel, noise.accel_walk * np.sqrt(T / 3)),
        )
        return np.repeat([gyro, accel, _VELOCITY_SIGMA_M_S], 3)

    def residual(self, R_WB: Float, v_WB: Float, bias_gyro_B: Float, bias_accel_B: Float) -> Float:
        """(9,) the readings beyond what the state makes of them."""
        return np.concatenate([self.gyro_B - bias_gyro_B, self.accel_B - bias_accel_B + R_WB.T @ g_W, -R_WB.T @ v_WB])

    @staticmethod
    def jacobian(R_WB: Float, v_WB: Float) -> Float:
        """(9, 15) of what is measured, by the error of the state; minus that of the residual."""
        H = np.zeros((9, 15))
        H[0:3, DBG] = np.eye(3)
        H[3:6, DTHETA], H[3:6, DBA] = so3.hat(-R_WB.T @ g_W), np.eye(3)
        H[6:9, DTHETA], H[6:9, DV] = so3.hat(R_WB.T @ v_WB), R_WB.T
        return H

    def agrees(self, residual: Float, H: Float, cov: Float) -> bool:
        """Whether the readings bear standstill out, by ``residual`` (9,) and ``H`` (9, 15) of a state with ``cov``."""
        S = H @ cov @ H.T + np.diag(self.sigma**2)
        return bool(residual @ np.linalg.solve(S, residual) <= standstill_gate())
