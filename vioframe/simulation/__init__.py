"""Flights, worlds and sensors whose truth is known: rendered recordings of a rig, and feature tracks without images."""

from vioframe.simulation.tracks import (
    REAL_MOTION_SEQUENCES,
    Packet,
    TrackOptions,
    TrackSequence,
    TrackSimulator,
    cut_segments,
    real_motion_sequence,
    simulated_sequence,
    simulated_stream,
)

__all__ = [
    "REAL_MOTION_SEQUENCES",
    "Packet",
    "TrackOptions",
    "TrackSequence",
    "TrackSimulator",
    "cut_segments",
    "real_motion_sequence",
    "simulated_sequence",
    "simulated_stream",
]
