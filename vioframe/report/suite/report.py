"""The whole report of a suite: tables, figures and the page, written beside the results that they were made from."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from vioframe.errors import PluginError, RunError
from vioframe.io.replace import appearing
from vioframe.runs.results import REPORT_FILES, REPORT_FOLDER, Results, task_count

MARKERS = ("index.html", "tables/provenance.csv")
"""Either tells a report from other folders."""


@dataclass(frozen=True)
class Written:
    """What a report came to: files relative to ``folder``, and lines that its reader should know."""

    folder: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def write_report(results: Results, out: Path | None = None, *, page: bool = True) -> Written:
    """Write everything to ``out``, by default ``report`` in the results; an older report there is replaced.

    Without ``page`` it is tables and figures alone. Raises :class:`RunError` where ``out`` is some other folder,
    :class:`DatasetError` where it cannot be written, and :class:`PluginError` where the extra that it needs is missing.
    """
    try:
        from vioframe.report.drawing import write_figures
        from vioframe.report.suite.figures import figures
        from vioframe.report.suite.page import write_page
        from vioframe.report.suite.statistics import Study
        from vioframe.report.suite.tables import tables, write_tables
    except ModuleNotFoundError as error:
        raise PluginError(f'reports need {error.name}: pip install "vioframe[bench]"') from None

    out = (results.path / REPORT_FOLDER if out is None else out).absolute()
    if out.exists() and not _replaceable(out):
        raise RunError(f"{out} is there and is no report, so it stays; choose another --out")
    to_results = Path(os.path.relpath(results.path.absolute(), out)).as_posix()
    study = Study(results)
    made, drawn = tables(study), figures(study)
    quoted = {name: figure.file for name, figure in results.reference.figures.items()}
    # Written beside ``out``, so that links out of it hold as they are.
    with appearing(out, replace=REPORT_FILES) as folder:
        files = write_tables(made, folder / "tables", f"../{to_results}")
        files += write_figures(drawn, folder / "figures", formats=("png", "svg"), names=quoted)
        if page:
            files.append(write_page(study, made, drawn, folder / "index.html", to_results))
        relative = tuple(file.relative_to(folder) for file in files)
    return Written(out, relative, tuple(_notes(results)))


def _replaceable(out: Path) -> bool:
    return out.is_dir() and (not any(out.iterdir()) or any((out / marker).is_file() for marker in MARKERS))


def _notes(results: Results) -> Iterator[str]:
    tasks = {row["task"]: row["status"] for row in results.rows}
    expected = task_count(results.suite)
    if expected is not None and len(tasks) < expected:
        done = f"{len(tasks)} of {expected} tasks"
        yield f"the sweep is unfinished: {done}; `vioframe bench` goes on where it was stopped"
    if failed := sum(status == "failed" for status in tasks.values()):
        yield f"{failed} of {len(tasks)} tasks failed; tables/failures.md has their errors"
