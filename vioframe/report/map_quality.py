"""Comparing the landmarks of runs with the surfaces of the world that they were seen on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.errors import ConfigError, RunError
from vioframe.evaluation.landmarks import MapQuality
from vioframe.geometry.meshes import read_mesh
from vioframe.types import Float

if TYPE_CHECKING:
    from vioframe.runs.evaluated import Evaluated
    from vioframe.runs.folder import RunFolder

_NO_MAP = "no landmarks were recorded (map.ply)"


def simulated_world(folder: RunFolder) -> Path | None:
    """The mesh beside the simulated recording that a run was made on; None where that is not simulated, or gone."""
    # Here, because the simulator comes along: evaluating a recorded flight has no need of it.
    from vioframe.simulation.config import MESH, simulation_folder

    path = folder.dataset_config().path
    if path is None:
        return None
    world = simulation_folder(path.parent if path.name == "mav0" else path) / MESH
    return world if world.is_file() else None


def measure_maps(runs: Sequence[Evaluated], world: Path | None = None) -> tuple[list[Evaluated], list[str]]:
    """``runs`` with their ``map_quality`` where it can be told, and a line on each of which it cannot though it might.

    The landmarks are moved with the alignment of the trajectory. ``world`` is the mesh, in the ground truth's world;
    without it each run's own :func:`simulated_world`. Raises :class:`ConfigError` where ``world`` cannot be read, and
    :class:`RunError` where no run can be compared with it.
    """
    out, notes = [], []
    meshes: dict[Path, Float] = {}
    for run in runs:
        mesh = world or (simulated_world(run.folder) if run.folder else None)
        quality: MapQuality | str | None = None
        if mesh is not None:
            try:
                quality = _measure(run, mesh, meshes)
            except ConfigError as error:
                # Nobody asked for the world beside the recording: the rest of the evaluation stands without it.
                if world is not None:
                    raise
                quality = str(error)
        if isinstance(quality, str):
            notes.append(f"{run.name}: its map is not compared with the world: {quality}")
        out.append(replace(run, map_quality=quality) if isinstance(quality, MapQuality) else run)
    if world is not None and len(notes) == len(runs):
        raise RunError("; ".join(notes))
    return out, notes


def _measure(run: Evaluated, mesh: Path, meshes: dict[Path, Float]) -> MapQuality | str:
    """Of one run, or why there is none; ``meshes`` are those read so far."""
    landmarks = run.folder.landmarks() if run.folder else None
    if landmarks is None or not len(landmarks):
        return _NO_MAP
    if run.errors is None:
        return "there is no ground truth to align it by; pass --ground-truth"
    corners = meshes[mesh] if mesh in meshes else meshes.setdefault(mesh, read_mesh(mesh))
    return MapQuality.of(run.errors.alignment.points(landmarks.p_WF), corners, mesh)
