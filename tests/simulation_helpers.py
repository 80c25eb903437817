"""Simulated recordings small enough for tests."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.parts import registry
from vioframe.simulation.config import SimulationConfig, complete
from vioframe.simulation.recording import SimulatedRecording
from vioframe.simulation.textures import procedural_textures
from vioframe.types import Calibration, Image

INSTALLED = registry.load()


@cache
def small_calibration(divisor: int = 4, cameras: Sequence[str] = ("cam0",)) -> Calibration:
    """EuRoC's cameras, distortion included, at a fraction of their resolution."""
    rig = packaged_calibration("euroc", cameras=cameras)
    for index, camera in enumerate(rig.cameras):
        rig = rig.with_camera(index, model=camera.model.shrunk(divisor))
    return rig


def small_simulation(
    folder: Path, workers: int = 1, divisor: int = 4, rig: Calibration | None = None, **settings: Any
) -> SimulatedRecording:
    """A recording of 188 x 120 px, by one camera unless a ``rig`` is given; its calibration is kept in ``folder``."""
    files = folder / f"calibration_{len(list(folder.iterdir()))}"
    write_calibration(rig or small_calibration(divisor), files)
    config = SimulationConfig.model_validate({"duration_s": 1.0, "rig": [str(files)], **settings})
    return SimulatedRecording(complete(config, INSTALLED), INSTALLED, workers)


@lru_cache(maxsize=2)
def drawn_textures(state: str, count: int) -> tuple[tuple[Image, ...], Any]:
    """The textures that a generator in this ``state`` draws, and its state then."""
    rng = np.random.default_rng()
    rng.bit_generator.state = json.loads(state)
    return procedural_textures(rng, count), rng.bit_generator.state


def textures_drawn_once(rng: np.random.Generator, count: int) -> tuple[Image, ...]:
    """What :func:`procedural_textures` draws, which takes most of the time that a small recording takes: to stand in
    for it where the worlds of many recordings are of one seed."""
    textures, rng.bit_generator.state = drawn_textures(json.dumps(rng.bit_generator.state), count)
    return textures
