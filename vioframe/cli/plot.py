"""``vioframe plot``: figures of one or more runs, overlaid."""

from __future__ import annotations

from pathlib import Path

import click

_FILE = click.Path(path_type=Path)


@click.command("plot")
@click.argument("runs", metavar="RUN...", type=_FILE, nargs=-1, required=True)
@click.option("--ground-truth", type=_FILE, help="TUM or EuRoC csv; a run folder's own is the default.")
@click.option(
    "--alignment",
    type=click.Choice(["posyaw", "se3", "sim3", "first"]),
    default="posyaw",
    show_default=True,
    help="How the estimates are brought into the ground truth's frame.",
)
@click.option("--out", type=_FILE, help="Folder for the figures.  [default: RUN/plots of one run folder, else plots]")
@click.option(
    "--band", type=click.FloatRange(min=0.0, min_open=True), metavar="M", help="Shade ±M in the translation errors."
)
@click.option("--svg", is_flag=True, help="Write SVG beside PNG.")
def command(
    runs: tuple[Path, ...], ground_truth: Path | None, alignment: str, out: Path | None, band: float | None, svg: bool
) -> None:
    """Draw each RUN, a run folder or a trajectory file, into the same figures.

    Paths in 3-D, from above and from the side; translation and rotation errors over time; relative errors; time by
    stage; features over time: as far as the runs have what it takes.
    """
    from vioframe.report.figures import write_figures
    from vioframe.report.tables import notes
    from vioframe.runs.evaluated import evaluate_paths

    evaluated = evaluate_paths(runs, ground_truth, alignment)
    if out is None:
        out = runs[0] / "plots" if len(runs) == 1 and runs[0].is_dir() else Path("plots")
    for path in write_figures(evaluated, out, formats=("png", "svg") if svg else ("png",), band_m=band):
        click.echo(path)
    for note in notes(evaluated):
        click.echo(f"note: {note}", err=True)
