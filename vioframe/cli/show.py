"""``vioframe evaluate``, ``plot`` and ``view`` show what came of runs, ``report`` what came of a suite."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import click

from vioframe.cli.common import FILE, PartName, ground_truth_option, print_notes, print_table, runs_argument


def _alignment_option(what: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    choice = click.Choice(["posyaw", "se3", "sim3", "first"])
    help = f"How the {what} brought into the ground truth's frame."
    return click.option("--alignment", type=choice, default="posyaw", show_default=True, help=help)


@click.command("evaluate")
@runs_argument
@ground_truth_option
@_alignment_option("estimate is")
@click.option(
    "--world",
    type=FILE,
    help="Mesh to measure the landmarks against.  [default: world.ply of the simulated recording]",
)
@click.option(
    "--metric",
    "metrics",
    metavar="NAME[:KEY=VALUE,...]",
    type=PartName("METRIC"),
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
def evaluate(
    runs: Sequence[Path],
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
    from vioframe.runs.evaluated import create_metrics, evaluate_paths, measure_runs
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
    print_notes((*notes(evaluated), *on_maps))
    # Last: what is read from a full or read-only disk is shown all the same.
    for run in evaluated:
        if run.kept_in is not None:
            write_json(run.kept_in, run.to_dict())


@click.command("plot")
@runs_argument
@ground_truth_option
@_alignment_option("estimates are")
@click.option("--out", type=FILE, help="Folder for the figures.  [default: RUN/plots of one run folder, else plots]")
@click.option(
    "--band", type=click.FloatRange(min=0.0, min_open=True), metavar="M", help="Shade ±M in the translation errors."
)
@click.option("--svg", is_flag=True, help="Write SVG beside PNG.")
def plot(
    runs: Sequence[Path], ground_truth: Path | None, alignment: str, out: Path | None, band: float | None, svg: bool
) -> None:
    """Draw each RUN, a run folder or a trajectory file, into the same figures.

    Paths in 3-D, from above and from the side; translation and rotation errors over time, aligned over the whole path,
    and within the ±3 sigma that the estimate states; NEES; relative errors; time by stage; features over time: as far
    as the runs have what it takes.
    """
    from vioframe.report.drawing import write_figures
    from vioframe.report.figures import figures_of_runs
    from vioframe.report.tables import notes
    from vioframe.runs.evaluated import evaluate_paths

    evaluated = evaluate_paths(runs, ground_truth, alignment)
    if out is None:
        out = runs[0] / "plots" if len(runs) == 1 and runs[0].is_dir() else Path("plots")
    figures = figures_of_runs(evaluated, band or 0.0)
    for path in write_figures(figures, out, formats=("png", "svg") if svg else ("png",)):
        click.echo(path)
    print_notes(notes(evaluated))


@click.command("view")
@runs_argument
@click.option("--save", type=FILE, metavar="FILE.rrd", help="Write a recording, for `rerun FILE.rrd`.")
@click.option(
    "--map", "map_", type=FILE, metavar="FILE.ply", help="Write the landmarks of one RUN, without the outliers."
)
@ground_truth_option
@click.option("--world", type=FILE, metavar="FILE.ply", help="Mesh of the world to show around the flight.")
def view(
    runs: Sequence[Path], save: Path | None, map_: Path | None, ground_truth: Path | None, world: Path | None
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
    print_notes(notes(evaluated))
    if map_ is not None:
        click.echo(f"{map_}: {export_map(evaluated[0], map_)} landmarks")
    if save is not None or map_ is None:
        view_runs(evaluated, registry.load(), save, world=world)
    if save is not None:
        click.echo(save)


@click.command("report")
@click.argument("results", type=FILE)
@click.option("--out", type=FILE, help="Folder for the report; an older one is replaced.  [default: RESULTS/report]")
@click.option("--no-page", is_flag=True, help="Tables and figures alone.")
def report(results: Path, out: Path | None, no_page: bool) -> None:
    """Write what RESULTS, the folder of a `vioframe bench SUITE`, amounts to.

    One page that needs no network (index.html), the same figures as PNG and SVG, and the tables as CSV, Markdown and
    LaTeX. Nothing is estimated again; a sweep that is still under way can be reported on too.
    """
    write_and_say(results, out, page=not no_page)


def write_and_say(results: Path, out: Path | None = None, *, page: bool = True, quiet: bool = False) -> None:
    """Write the report, and say what was written."""
    from vioframe.report.suite.report import write_report
    from vioframe.runs.results import load_results

    written = write_report(load_results(results), out, page=page)
    print_notes(written.notes)
    if quiet:
        return
    counts = Counter((path.parent.as_posix(), path.suffix[1:]) for path in written.files if path.parent != Path())
    for (folder, ending), count in counts.items():
        click.echo(f"{written.folder / folder}: {count} {ending}")
    for path in written.files:
        if path.parent == Path():
            click.echo(written.folder / path)
