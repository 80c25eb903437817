"""A recording reduced to what a back-end takes in, with the truth it is judged by."""

from __future__ import annotations

from dataclasses import dataclass

from vioframe.geometry.trajectory import Trajectory
from vioframe.types import Calibration, FrameTracks, ImuSegment, NavState

Packet = tuple[ImuSegment, FrameTracks]


@dataclass(frozen=True)
class TrackSequence:
    """Packets for :meth:`vioframe.interfaces.Backend.process`, one a frame, and the motion behind them.

    ``ground_truth`` holds a pose for each frame. ``true_states``, where they are known, hold velocity and biases too
    (one a frame, or none at all); those of a simulated flight are exact, a recording's are its publisher's estimate.
    """

    name: str
    calibration: Calibration
    packets: tuple[Packet, ...]
    ground_truth: Trajectory
    true_states: tuple[NavState, ...] = ()
