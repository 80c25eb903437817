"""The report's tables on the page: what can be left out there, what rows belong to, where their figures come from."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from vioframe.report.suite.captions import condition_text
from vioframe.report.suite.flights import Flight
from vioframe.report.suite.page_blocks import Cell, Command, Commands, Line, TableBlock
from vioframe.report.suite.results import SuiteResults, TaskResult
from vioframe.report.suite.table import Row, Table
from vioframe.report.suite.tables_about import evo_command

_SAID_BY_CAPTION = ("sequence", "data", "condition")
"""Columns that are left out where they say the same in every row."""


def blocks(every: Iterable[Table], results: SuiteResults, to_results: str) -> dict[str, TableBlock]:
    """By name of the table. Links begin with ``to_results``, so that they hold wherever the results are moved to."""
    tasks = {task.key: task for task in results.tasks}
    contenders = {
        f"{task.labels.detector} + {task.labels.backend}": (task.labels.detector, task.labels.backend)
        for task in results.tasks
        if task.labels
    }
    return {table.name: _block(table, tasks, contenders, to_results) for table in every}


def commands(flights: Iterable[Flight]) -> Commands:
    """The evo command of each flight that has an ATE by SE(3), with the figure that it prints."""
    return Commands([_command(flight) for flight in flights if "ate_se3_m" in flight.figures])


def _command(flight: Flight) -> Command:
    labels = flight.task.labels
    value = f"ATE {flight.figures['ate_se3_m']:.6f} m"
    if labels is None:
        return Command(f"{flight.task.key}: {value}", evo_command(flight))
    where = labels.sequence + (f", {condition_text(labels.condition, labels.level)}" if labels.level else "")
    about = f"{where}, {labels.detector} with {labels.backend}, seed {labels.seed}: {value}"
    return Command(about, evo_command(flight), labels.detector, labels.backend)


def _block(
    table: Table,
    tasks: Mapping[str, TaskResult],
    contenders: Mapping[str, tuple[str, str]],
    to_results: str,
) -> TableBlock:
    titles = [column.title for column in table.columns]
    shown = [k for k, title in enumerate(titles) if title not in _SAID_BY_CAPTION or _varies(table.rows, k)]
    lines = []
    for row in table.rows:
        cells = [Cell(entry.shown, _number(entry.value)) for entry in row.entries]
        detector, backend = _owner(dict(zip(titles, (cell.shown for cell in cells), strict=True)), tasks, contenders)
        runs = [(label, f"{to_results}/{path}/") for label, path in row.links]
        lines.append(Line([cells[k] for k in shown], runs, detector, backend, table.name == "failures"))
    return TableBlock(table, shown, lines)


def _varies(rows: Sequence[Row], column: int) -> bool:
    return len({row.entries[column].shown for row in rows}) > 1


def _number(value: float | str | None) -> float | None:
    return None if isinstance(value, str) else value


def _owner(
    texts: Mapping[str, str], tasks: Mapping[str, TaskResult], contenders: Mapping[str, tuple[str, str]]
) -> tuple[str | None, str | None]:
    """Detector and back-end that a row is of."""
    if (task := tasks.get(texts.get("task", ""))) is not None:
        return (task.labels.detector, task.labels.backend) if task.labels else (None, None)
    if texts.get("system") in contenders:
        return contenders[texts["system"]]
    return texts.get("detector"), texts.get("back-end")
