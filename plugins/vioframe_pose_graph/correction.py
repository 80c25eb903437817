"""From corrected keyframes to every frame in between."""

from __future__ import annotations

import numpy as np

from vioframe.geometry import so3
from vioframe.types import Float, Int


def carry(
    frames: tuple[Int, Int, Float, Float], keys: tuple[Int, Int, Float], p_corrected: Float, yaw: Float
) -> tuple[Float, Float]:
    """R_WB (F, 3, 3) and p_WB (F, 3) of all frames, moved along with the keyframes of their segment.

    ``frames`` are the stamps, segments, attitudes and positions of all frames by the odometry, ``keys`` the stamps,
    segments and positions of the keyframes; ``p_corrected`` (N, 3) and ``yaw`` (N,) are what the graph made of those. A
    frame between two keyframes is where each of them would carry it, weighted by the time to the other, so that the
    corrected path is as continuous as the odometry's own.
    """
    t_ns, segment, R_WB, p_WB = frames
    key_t_ns, key_segment, key_p = keys
    left, right, fraction = _between(t_ns, segment, key_t_ns, key_segment)
    turn = np.arctan2(np.sin(yaw[right] - yaw[left]), np.cos(yaw[right] - yaw[left]))

    def carried(by: Int) -> Float:
        moved = np.einsum("fij,fj->fi", _rotations_z(yaw[by]), p_WB - key_p[by])
        return np.asarray(p_corrected[by] + moved)

    p = (1.0 - fraction)[:, None] * carried(left) + fraction[:, None] * carried(right)
    return _rotations_z(yaw[left] + fraction * turn) @ R_WB, p


def _between(t_ns: Int, segment: Int, key_t_ns: Int, key_segment: Int) -> tuple[Int, Int, Float]:
    """(F,) the keyframes before and after each frame in its own segment, and how far it is from one to the other."""
    first = np.searchsorted(key_segment, segment, side="left")
    last = np.searchsorted(key_segment, segment, side="right") - 1
    left = np.clip(np.searchsorted(key_t_ns, t_ns, side="right") - 1, first, last)
    right = np.clip(left + 1, first, last)
    span = np.maximum(key_t_ns[right] - key_t_ns[left], 1)
    return left, right, np.clip((t_ns - key_t_ns[left]) / span, 0.0, 1.0)


def _rotations_z(yaw: Float) -> Float:
    """(N,) rad -> (N, 3, 3)."""
    return so3.exp(np.column_stack([np.zeros((len(yaw), 2)), yaw]))
