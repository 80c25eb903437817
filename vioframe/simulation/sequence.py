"""A recording reduced to what a back-end takes in, with the truth it is judged by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Calibration, Float, FrameTracks, ImuSegment, Int, NavState

try:
    from vioframe.trajectory import Trajectory
except ImportError:  # TEMPORARY, until the trajectory package lands

    @dataclass(frozen=True)
    class Trajectory:  # type: ignore[no-redef]
        t_ns: Int
        R_WB: Float
        p_WB: Float


Packet = tuple[ImuSegment, FrameTracks]


@dataclass(frozen=True)
class TrackSequence:
    """Packets for :meth:`vioframe.interfaces.Backend.process`, one a frame, and the motion behind them.

    ``ground_truth`` holds a pose for each frame. ``true_states``, where they are known, hold velocity and biases too (one a
    frame, or none at all); those of a simulated flight are exact, those of a recording are its publisher's estimate.
    """

    name: str
    calibration: Calibration
    packets: tuple[Packet, ...]
    ground_truth: Trajectory
    true_states: tuple[NavState, ...] = ()

    @property
    def path_length_m(self) -> float:
        """Length of the true path."""

        return float(np.linalg.norm(np.diff(self.ground_truth.p_WB, axis=0), axis=1).sum())
