"""Inertial segments from a whole recording at once, through the synchronisation that every data set goes through."""

from collections.abc import Iterable
from heapq import merge

import numpy as np

from vioframe.errors import DatasetError
from vioframe.incidents import Incidents
from vioframe.io.synchronise import synchronise
from vioframe.types import Float, Frame, ImuSample, ImuSegment, Int, Measurement

_NO_IMAGE = np.empty((0, 0), np.uint8)


def cut_segments(t_ns: Int, gyro_B: Float, accel_B: Float, frames_ns: Int) -> list[ImuSegment]:
    """One segment a frame, as :func:`vioframe.io.synchronise.synchronise` cuts them.

    ``t_ns`` (N,) ascending, ``gyro_B`` (N, 3) rad/s, ``accel_B`` (N, 3) m/s^2, ``frames_ns`` (M,) ascending and within
    the readings; raises :class:`DatasetError` where that is not so and a frame would be left without its segment.
    """
    samples: Iterable[Measurement] = (
        ImuSample(t, gyro, accel) for t, gyro, accel in zip(t_ns.tolist(), gyro_B, accel_B, strict=True)
    )
    frames: Iterable[Measurement] = (Frame(t, _NO_IMAGE) for t in frames_ns.tolist())
    incidents = Incidents()
    stream = merge(samples, frames, key=lambda measurement: measurement.t_ns)
    segments = [segment for segment, _ in synchronise(stream, incidents=incidents)]
    if len(segments) != len(frames_ns):
        raise DatasetError(f"frames lie outside the inertial readings or repeat: {dict(incidents.counts)}")
    return segments
