"""Simulated recordings small enough for tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.parts import registry
from vioframe.simulation.config import SimulationConfig, complete
from vioframe.simulation.recording import SimulatedRecording
from vioframe.types import Calibration

INSTALLED = registry.load()


@cache
def small_calibration(divisor: int = 4) -> Calibration:
    """EuRoC's camera, distortion included, at a fraction of its resolution."""
    euroc = packaged_calibration("euroc")
    camera, (width, height) = euroc.camera, euroc.camera.resolution
    fx, fy = camera.fx / divisor, camera.fy / divisor
    cx, cy = (camera.cx + 0.5) / divisor - 0.5, (camera.cy + 0.5) / divisor - 0.5
    small = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, resolution=(width // divisor, height // divisor))
    return replace(euroc, camera=small)


def small_simulation(folder: Path, workers: int = 1, divisor: int = 4, **settings: Any) -> SimulatedRecording:
    """A recording of 188 x 120 px; its calibration is written to ``folder``."""
    files = folder / f"calibration_{divisor}"
    write_calibration(small_calibration(divisor), files)
    config = SimulationConfig.model_validate({"duration_s": 1.0, "calibration": [files], **settings})
    return SimulatedRecording(complete(config, INSTALLED), INSTALLED, workers)
