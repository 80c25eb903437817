"""The tables that a suite's results have data for, and writing them to files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from vioframe.report.suite import statistics, stress, tables_about, tables_accuracy, tables_cost, tables_stress
from vioframe.report.suite.results import Kind, SuiteResults
from vioframe.report.suite.table import Table
from vioframe.report.suite.trials import campaigns

__all__ = ["Table", "tables", "write_tables"]


def tables(results: SuiteResults) -> list[Table]:
    """In the order in which a reader asks: the figures, what went wrong, how to check, where from."""
    return [table for table in _every(results) if table is not None]


def write_tables(every: Iterable[Table], folder: Path, to_results: str) -> list[Path]:
    """``NAME.csv``, ``.md`` and ``.tex`` in ``folder``; ``to_results`` leads from there to the results."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for table in every:
        texts = {"csv": table.to_csv(), "md": table.to_markdown(to_results), "tex": table.to_latex()}
        for ending, content in texts.items():
            written.append(folder / f"{table.name}.{ending}")
            written[-1].write_text(content, encoding="utf-8")
    return written


def _every(results: SuiteResults) -> Iterator[Table | None]:
    for task in results.of(Kind.DETECTOR_SPEED):
        if task.ok:
            yield tables_cost.detector_speed(task)
    groups, flights = statistics.groups(results), statistics.flights(results)
    if groups:
        if stress.is_stress(groups):
            yield tables_stress.levels(stress.curves(groups), groups)
            if (baseline := stress.baseline_of(groups)) is not None:
                yield tables_stress.against_baseline(stress.duels(groups, baseline), baseline, groups)
        yield tables_accuracy.accuracy(groups)
        if averages := statistics.averages(groups):
            yield tables_accuracy.averaged(averages)
        if published := results.suite.get("published"):
            yield tables_accuracy.beside_published(
                [g for g in groups if g.cell.condition == statistics.CLEAR], published
            )
        yield tables_accuracy.band(groups)
        yield tables_accuracy.metrics(groups)
        yield tables_cost.timing(groups)
        yield tables_about.flights_nees(groups)
    if trials := campaigns(results):
        yield tables_about.trials_nees(trials)
    yield tables_about.failures(flights, [task for task in results.tasks if task.kind is not Kind.FLIGHT])
    yield tables_about.evo_commands(flights)
    yield tables_about.provenance(results)
