"""``vioframe view``: runs in three dimensions and over time, in rerun's viewer or as its recording."""

from __future__ import annotations

from pathlib import Path

import click

_FILE = click.Path(path_type=Path)


@click.command("view")
@click.argument("runs", metavar="RUN...", type=_FILE, nargs=-1, required=True)
@click.option("--save", type=_FILE, metavar="FILE.rrd", help="Write a recording, for `rerun FILE.rrd`.")
@click.option(
    "--map", "map_", type=_FILE, metavar="FILE.ply", help="Write the landmarks of one RUN, without the outliers."
)
@click.option("--ground-truth", type=_FILE, help="TUM or EuRoC csv; a run folder's own is the default.")
@click.option("--world", type=_FILE, metavar="FILE.ply", help="Mesh of the world to show around the flight.")
def command(
    runs: tuple[Path, ...], save: Path | None, map_: Path | None, ground_truth: Path | None, world: Path | None
) -> None:
    """Show each RUN, a run folder or a trajectory file, in rerun's viewer.

    Paths, ground truth, cameras, images with tracks, landmarks, errors within their bounds, velocity, biases and times
    on one time line; aligned by position and yaw. --save and --map write a file instead.
    """
    from vioframe.parts import registry
    from vioframe.report.tables import notes
    from vioframe.report.view import view_runs
    from vioframe.runs.evaluated import evaluate_paths, export_map

    if save is not None and save.suffix.lower() != ".rrd":
        raise click.BadParameter(f"{save} does not end in .rrd", param_hint="'--save'")
    if map_ is not None and len(runs) > 1:
        raise click.BadParameter("is for a single RUN: each has a map of its own", param_hint="'--map'")
    evaluated = evaluate_paths(runs, ground_truth)
    for note in notes(evaluated):
        click.echo(f"note: {note}", err=True)
    if map_ is not None:
        click.echo(f"{map_}: {export_map(evaluated[0], map_)} landmarks")
    if save is not None or map_ is None:
        view_runs(evaluated, registry.load(), save, world=world)
    if save is not None:
        click.echo(save)
