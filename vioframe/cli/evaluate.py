"""``vioframe evaluate``: runs and trajectory files against the ground truth, as a table."""

from __future__ import annotations

from pathlib import Path

import click

from vioframe.cli.progress import print_table

_FILE = click.Path(path_type=Path)


@click.command("evaluate")
@click.argument("runs", metavar="RUN...", type=_FILE, nargs=-1, required=True)
@click.option("--ground-truth", type=_FILE, help="TUM or EuRoC csv; a run folder's own is the default.")
@click.option(
    "--alignment",
    type=click.Choice(["posyaw", "se3", "sim3", "first"]),
    default="posyaw",
    show_default=True,
    help="How the estimate is brought into the ground truth's frame.",
)
@click.option(
    "--world",
    type=_FILE,
    help="Mesh to measure the landmarks against.  [default: world.ply of the simulated recording]",
)
@click.option(
    "--metric",
    "metrics",
    metavar="NAME[:KEY=VALUE,...]",
    multiple=True,
    help="Measure this as well; repeatable. `vioframe plugins` lists them.",
)
@click.option(
    "--format",
    "format_",
    type=click.Choice(["table", "json", "csv", "markdown"]),
    default="table",
    show_default=True,
    help="What to print.",
)
def command(
    runs: tuple[Path, ...],
    ground_truth: Path | None,
    alignment: str,
    world: Path | None,
    metrics: tuple[str, ...],
    format_: str,
) -> None:
    """Compare each RUN, a run folder or a trajectory file, with the ground truth.

    The landmarks of a run on a simulated recording are measured against the
    surfaces of its world. What loop closure made of a run has a column of its
    own. The result is printed, and kept as `evaluation.json` (and
    `evaluation_loop.json`) in each run folder.
    """
    from vioframe.parts import registry
    from vioframe.report.map_quality import measure_maps
    from vioframe.report.tables import figures, notes, to_csv, to_json, to_markdown, to_rich
    from vioframe.runs.evaluated import evaluate_paths, measure_runs
    from vioframe.runs.metrics import create_metrics
    from vioframe.runs.recorder import write_json

    asked = create_metrics(metrics, registry.load()) if metrics else ()
    evaluated, on_maps = measure_maps(evaluate_paths(runs, ground_truth, alignment), world)
    if asked:
        evaluated = measure_runs(evaluated, asked)
    if format_ == "table":
        print_table(to_rich(figures(evaluated)))
    elif format_ == "markdown":
        click.echo(to_markdown(figures(evaluated)))
    else:
        click.echo({"json": to_json, "csv": to_csv}[format_](evaluated))
    for note in (*notes(evaluated), *on_maps):
        click.echo(f"note: {note}", err=True)
    # Last: what is read from a full or read-only disk is shown all the same.
    for run in evaluated:
        if run.kept_in is not None:
            write_json(run.kept_in, run.to_dict())
