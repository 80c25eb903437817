"""Motion: whether there is enough to begin, and from when on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from vioframe.arrays import Bool
from vioframe.diagnosis.findings import Finding, Severity
from vioframe.diagnosis.recording import Recording
from vioframe.types import NS_PER_S, Float, Int

_WINDOW_S = 0.5
# What a standing vehicle stays below with its rotors on, means over a window: rad/s and m/s^2.
_TURNING, _ACCELERATING = 0.03, 0.25
_LEAST_SHARE = 0.1


def look_at_motion(recording: Recording) -> Iterator[Finding]:
    """Too little motion while the camera looks, or a long wait for it."""
    t_s, moving = moving_windows(recording)
    if not len(moving):
        return
    share = float(moving.mean())
    if share < _LEAST_SHARE:
        where = "nowhere" if not moving.any() else f"only in {share:.0%} of it, first at {t_s[np.argmax(moving)]:.1f} s"
        yield Finding(
            "motion",
            f"the body moves {where} while the camera looks: it can be begun at rest, but nothing tells of offset, "
            "rotation or lens",
            "move it: turn it about two axes and carry it half a metre to and fro",
            Severity.WORTH_KNOWING,
            figures={"moving_share": share},
        )


def moving_windows(recording: Recording) -> tuple[Float, Bool]:
    """Windows of half a second while the camera looks: seconds after the first frame (W,), and which move (W,).

    Those with readings only: one wild stamp makes years of it.
    """
    imu, frames_ns = recording.imu.sorted(), recording.look.t_ns
    if not len(frames_ns) or len(imu.t_ns) < 10:
        return np.empty(0), np.empty(0, bool)
    begin, end = frames_ns.min(), frames_ns.max()
    inside: Int = np.flatnonzero((imu.t_ns >= begin) & (imu.t_ns <= end))
    if len(inside) < 10:
        return np.empty(0), np.empty(0, bool)
    number = ((imu.t_ns[inside] - begin) / NS_PER_S / _WINDOW_S).astype(int)
    windows, number, count = np.unique(number, return_inverse=True, return_counts=True)
    gyro = imu.gyro_B[inside] - np.median(imu.gyro_B[inside], axis=0)
    means = [
        np.stack([np.bincount(number, values[:, k]) / count for k in range(3)], axis=1)
        for values in (gyro, imu.accel_B[inside])
    ]
    length = np.linalg.norm(means[1], axis=1)
    turning = np.linalg.norm(means[0], axis=1) > _TURNING
    accelerating = np.abs(length - np.median(length)) > _ACCELERATING
    return np.asarray(windows * _WINDOW_S), np.asarray(turning | accelerating)
