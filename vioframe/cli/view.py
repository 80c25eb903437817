"""``vioframe view``: runs in three dimensions, in a window or as a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from vioframe.runs.evaluated import Evaluated

_FILE = click.Path(path_type=Path)


def _size(ctx: click.Context, param: click.Parameter, value: str) -> tuple[int, int]:
    width, _, height = value.partition("x")
    if not (width.isdecimal() and height.isdecimal() and all(100 <= int(n) <= 8000 for n in (width, height))):
        raise click.BadParameter(f"{value!r} is not a size such as 1600x1000, of 100 to 8000 pixels a side")
    return int(width), int(height)


@click.command("view")
@click.argument("runs", metavar="RUN...", type=_FILE, nargs=-1, required=True)
@click.option("--save", type=_FILE, metavar="FILE.png", help="Write a picture; no display is needed.")
@click.option(
    "--map", "map_", type=_FILE, metavar="FILE.ply", help="Write the landmarks of one RUN, without the outliers."
)
@click.option("--ground-truth", type=_FILE, help="TUM or EuRoC csv; a run folder's own is the default.")
@click.option("--world", type=_FILE, metavar="FILE.ply", help="Mesh of the world to draw around the flight.")
@click.option(
    "--size",
    callback=_size,
    metavar="WxH",
    default="1600x1000",
    show_default=True,
    help="Of the picture or the window, pixels.",
)
@click.option(
    "--azimuth", type=float, metavar="DEG", help="Where to look from, counter-clockwise from x.  [default: broadside]"
)
@click.option(
    "--elevation",
    type=click.FloatRange(-89.0, 89.0),
    metavar="DEG",
    default=28.0,
    show_default=True,
    help="How far above the horizon to look from.",
)
def command(
    runs: tuple[Path, ...],
    save: Path | None,
    map_: Path | None,
    ground_truth: Path | None,
    world: Path | None,
    size: tuple[int, int],
    azimuth: float | None,
    elevation: float,
) -> None:
    """Show each RUN, a run folder or a trajectory file, in one scene.

    The paths and the ground truth, what the camera saw along the way and the
    landmarks, aligned by position and yaw. Opens a window unless --save or
    --map say what to write instead.
    """
    from vioframe.report.rows import notes
    from vioframe.report.scene_window import check_display
    from vioframe.report.viewing import export_map, view_runs
    from vioframe.runs.evaluated import evaluate_paths

    if save is not None and save.suffix.lower() != ".png":
        raise click.BadParameter(f"{save} does not end in .png", param_hint="'--save'")
    if map_ is not None and len(runs) > 1:
        raise click.BadParameter("is for a single RUN: each has a map of its own", param_hint="'--map'")
    if save is None and map_ is None:
        check_display()
    evaluated = evaluate_paths(runs, ground_truth)
    for note in notes(evaluated):
        click.echo(f"note: {note}", err=True)
    if map_ is not None:
        click.echo(f"{map_}: {export_map(evaluated[0], map_)} landmarks")
    if save is not None:
        view_runs(evaluated, save, world=world, size=size, azimuth_deg=azimuth, elevation_deg=elevation)
        click.echo(save)
    elif map_ is None:
        _legend(evaluated)
        view_runs(evaluated, world=world, size=size, azimuth_deg=azimuth, elevation_deg=elevation)


def _legend(runs: Sequence[Evaluated]) -> None:
    """The window has no room for names: they are said here, in their colours."""
    from vioframe.report.scene_drawing import rgb

    for number, run in enumerate(runs):
        red, green, blue = (round(255.0 * part) for part in rgb(number))
        click.echo(click.style("━━ ", fg=(red, green, blue)) + run.name)
    if any(run.errors for run in runs):
        click.echo("╍╍ ground truth")
