"""``vioframe report``: the results of a benchmark suite as tables, figures and a page."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import click

_FILE = click.Path(path_type=Path)


@click.command("report")
@click.argument("results", type=_FILE)
@click.option("--out", type=_FILE, help="Folder for the report; an older one is replaced.  [default: RESULTS/report]")
@click.option("--no-page", is_flag=True, help="Tables and figures alone.")
def command(results: Path, out: Path | None, no_page: bool) -> None:
    """Write what RESULTS, the folder of a `vioframe bench SUITE`, amounts to.

    One page that needs no network (index.html), the same figures as PNG and SVG, and the tables as CSV, Markdown and
    LaTeX. Nothing is estimated again; a sweep that is still under way can be reported on too.
    """
    write_and_say(results, out, page=not no_page)


def write_and_say(results: Path, out: Path | None = None, *, page: bool = True) -> None:
    """Write the report, and say what was written."""
    from vioframe.report.suite.report import write_report
    from vioframe.runs.results import load_results

    written = write_report(load_results(results), out, page=page)
    counts = Counter((path.parent.as_posix(), path.suffix[1:]) for path in written.files if path.parent != Path())
    for (folder, ending), count in counts.items():
        click.echo(f"{written.folder / folder}: {count} {ending}")
    for path in written.files:
        if path.parent == Path():
            click.echo(written.folder / path)
    for note in written.notes:
        click.echo(f"note: {note}", err=True)
