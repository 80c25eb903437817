"""Complete inertial segments from a whole recording at once."""

import numpy as np

from vioframe.errors import DatasetError
from vioframe.types import Float, ImuSegment, Int


def cut_segments(t_ns: Int, gyro_B: Float, accel_B: Float, frames_ns: Int) -> list[ImuSegment]:
    """One segment a frame, both ends interpolated onto the frame stamps; the first holds a single reading.

    ``t_ns`` (N,) ascending, ``gyro_B`` (N, 3) rad/s, ``accel_B`` (N, 3) m/s^2, ``frames_ns`` (M,) ascending and within
    the readings, or :class:`DatasetError` is raised.
    """
    if frames_ns[0] < t_ns[0] or frames_ns[-1] > t_ns[-1]:
        raise DatasetError("frames lie outside the inertial readings; limit them to the stamps those cover")
    readings = np.hstack([gyro_B, accel_B])
    # Relative seconds keep the interpolation exact to a nanosecond, which float stamps would not.
    seconds = (t_ns - t_ns[0]) * 1e-9
    at_frames = np.column_stack([np.interp((frames_ns - t_ns[0]) * 1e-9, seconds, column) for column in readings.T])
    first_after = np.searchsorted(t_ns, frames_ns, side="right")
    last_before = np.searchsorted(t_ns, frames_ns, side="left")
    segments = [ImuSegment(frames_ns[:1].copy(), at_frames[:1, :3].copy(), at_frames[:1, 3:].copy())]
    for k in range(1, len(frames_ns)):
        inner = slice(first_after[k - 1], last_before[k])
        t = np.concatenate([frames_ns[k - 1 : k], t_ns[inner], frames_ns[k : k + 1]])
        x = np.concatenate([at_frames[k - 1 : k], readings[inner], at_frames[k : k + 1]])
        recorded = t_ns[first_after[k - 1] - 1 : last_before[k] + 1]
        gap_s = float(np.diff(recorded).max()) * 1e-9
        segments.append(ImuSegment(t, x[:, :3].copy(), x[:, 3:].copy(), gap_s))
    return segments
