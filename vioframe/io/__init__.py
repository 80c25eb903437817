"""Files in and out: calibrations, recordings, trajectories; and measurements put in order."""
