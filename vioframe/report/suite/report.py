"""The whole report of a suite: tables, figures and the page, written beside the results that they were made from."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from vioframe.errors import RunError
from vioframe.report.suite.figures import write_figures
from vioframe.report.suite.results import SuiteResults
from vioframe.report.suite.statistics import expected_tasks
from vioframe.report.suite.tables import tables, write_tables

REPORT_FOLDER = "report"
MARKERS = ("index.html", "tables/provenance.csv")
"""Either tells a report from other folders."""
_TABLES, _FIGURES = "tables", "figures"


@dataclass(frozen=True)
class Written:
    """What a report came to: files relative to ``folder``, and lines that its reader should know."""

    folder: Path
    files: tuple[Path, ...]
    notes: tuple[str, ...]


def write_report(results: SuiteResults, out: Path | None = None, *, page: bool = True) -> Written:
    """Write everything to ``out``, by default ``report`` in the results; what was there before is replaced as a whole.

    Without ``page`` it is tables and figures alone, which need no extra. Raises :class:`RunError` where ``out`` is some
    other folder, or cannot be written.
    """
    out = (results.path / REPORT_FOLDER if out is None else out).absolute()
    if out.exists() and not _replaceable(out):
        raise RunError(f"{out} is there and is no report, so it stays; choose another --out")
    to_results = Path(os.path.relpath(results.path.absolute(), out / _TABLES)).as_posix()
    try:
        with _appearing(out) as folder:
            files = write_tables(tables(results), folder / _TABLES, to_results)
            files += write_figures(results, folder / _FIGURES)
            if page:
                from vioframe.report.suite.page import write_page

                files.append(write_page(results, folder))
            relative = tuple(file.relative_to(folder) for file in files)
    except OSError as error:
        raise RunError(f"cannot write the report to {out}: {error.strerror}; choose another --out") from error
    return Written(out, relative, tuple(_notes(results)))


def _replaceable(out: Path) -> bool:
    return out.is_dir() and (not any(out.iterdir()) or any((out / marker).is_file() for marker in MARKERS))


@contextmanager
def _appearing(out: Path) -> Iterator[Path]:
    """A folder beside ``out``, so that links out of it hold as they are, which takes its place once it is complete."""
    unfinished = out.with_name(f".{out.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.mkdir(parents=True)
    try:
        yield unfinished
        if out.is_dir():
            shutil.rmtree(out)
        unfinished.replace(out)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _notes(results: SuiteResults) -> Iterator[str]:
    done, expected = len(results.tasks), expected_tasks(results.suite)
    if expected is not None and done < expected:
        yield f"the sweep is unfinished: {done} of {expected} tasks; `vioframe bench` goes on where it was stopped"
    failed = sum(not task.ok for task in results.tasks)
    if failed:
        yield f"{failed} of {done} tasks failed; tables/failures.md has their errors"
