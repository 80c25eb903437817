"""Runs shown in three dimensions, and the map of one written for others to look at."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vioframe.errors import RunError
from vioframe.geometry.meshes import import_open3d, read_mesh
from vioframe.report.plot_paths import alignment_caption
from vioframe.report.scene import Scene, aligned_landmarks, scene_of
from vioframe.report.scene_grid import Grid, ground_grid
from vioframe.report.scene_view import View, best_azimuth_deg, view_of
from vioframe.runs.evaluated import Evaluated
from vioframe.runs.recorder import write_ply


def view_runs(
    runs: Sequence[Evaluated],
    save: Path | None = None,
    *,
    world: Path | None = None,
    size: tuple[int, int] = (1600, 1000),
    azimuth_deg: float | None = None,
    elevation_deg: float = 28.0,
) -> None:
    """Show ``runs`` in a window and return when it is closed, or write the PNG file ``save`` instead.

    ``world`` is a mesh in the ground truth's world; ``azimuth_deg`` None looks at the path broadside on. Raises
    :class:`~vioframe.errors.VioframeError` where Open3D, a display or a pose is missing.
    """
    import_open3d("vioframe view")
    if all(run.estimate is None for run in runs):
        raise RunError("there is nothing to show: no pose was estimated; the events in summary.json say why")
    scene = scene_of(runs, None if world is None else read_mesh(world))
    grid, view = choose_view(scene, size, azimuth_deg, elevation_deg)
    if save is None:
        from vioframe.report.scene_window import show

        show(scene, grid, view, "vioframe: " + ", ".join(flight.name for flight in scene.flights))
    else:
        from vioframe.report.scene_file import save_picture

        save_picture(scene, grid, view, save, alignment_caption(runs))


def choose_view(
    scene: Scene, size: tuple[int, int], azimuth_deg: float | None = None, elevation_deg: float = 28.0
) -> tuple[Grid, View]:
    """A view of all of ``scene`` that is of interest, and of the grid below it."""
    grid = ground_grid(scene)
    if azimuth_deg is None:
        azimuth_deg = best_azimuth_deg(scene.path, scene.landmarks)
    return grid, view_of(np.concatenate([scene.of_interest, grid.margin]), azimuth_deg, elevation_deg, size)


def export_map(run: Evaluated, path: Path) -> int:
    """Write the landmarks of ``run`` to a PLY file as ``map.ply`` is one, and return their number.

    Those that stand alone are left out; they are in the ground truth's world where the run has ground truth. Raises
    :class:`RunError` where the run has no landmarks or the file cannot be written.
    """
    landmarks = aligned_landmarks(run)
    if landmarks is None:
        raise RunError(f"{run.name} has no landmarks: only a run folder whose map.ply holds some has a map to write")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(path, landmarks.by_id())
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another name") from error
    return len(landmarks)
