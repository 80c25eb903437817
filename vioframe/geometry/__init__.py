"""Rotations, cameras and multiple-view geometry: pure functions of arrays."""
