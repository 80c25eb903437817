"""Track sequences whose truth is known: simulated landmarks along real or exactly known motion."""

from vioframe.simulation.real_motion import REAL_MOTION_SEQUENCES, real_motion_sequence
from vioframe.simulation.sequence import Packet, TrackSequence
from vioframe.simulation.synthetic import simulated_sequence

__all__ = [
    "REAL_MOTION_SEQUENCES",
    "Packet",
    "TrackSequence",
    "real_motion_sequence",
    "simulated_sequence",
]
