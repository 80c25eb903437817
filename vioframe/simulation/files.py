"""Where a simulated recording keeps what it was made of."""

from pathlib import Path

MANIFEST, TRUTH, WORLD = "manifest.yaml", "ground_truth.csv", "world.ply"
"""Files of the folder: all settings, the exact states in EuRoC's format, and the mesh of the world in W."""


def simulation_folder(recording: Path) -> Path:
    """``flight.bag.simulation`` beside ``flight.bag``; an ASL folder holds it itself, as ``simulation``."""
    recording = recording.absolute()
    if (recording / "mav0").is_dir():
        return recording / "simulation"
    return recording.with_name(f"{recording.name}.simulation")
