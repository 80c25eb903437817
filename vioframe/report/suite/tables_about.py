"""Tables that a reader needs to trust the others: consistency, failures, how to re-derive an ATE, where it is from."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from shlex import quote
from typing import Any

from vioframe.evaluation.consistency import PARTS
from vioframe.report.suite.captions import data_caption, links, run_path, task_path
from vioframe.report.suite.flights import Flight
from vioframe.report.suite.results import SuiteResults, TaskResult
from vioframe.report.suite.statistics import Group
from vioframe.report.suite.table import Column, Row, Table, mean, number, text
from vioframe.report.suite.tables_accuracy import LABELS, labels
from vioframe.report.suite.trials import Campaign
from vioframe.runs.evaluated import MATCHED_TRUTH

_FACTS = ("vioframe", "commit", "python", "platform", "cpu", "cpu_count", "memory_gib", "threads")


def flights_nees(found: Sequence[Group]) -> Table | None:
    """Mean NEES by part of the pose, of flights; None where no back-end stated a covariance."""
    columns = (*LABELS, Column("seeds", text=True), *(Column(f"{part}, ideally {dof}") for part, dof in PARTS.items()))
    rows = []
    for group in found:
        spreads = [group.spread(f"nees.{part}") for part in PARTS]
        if any(spreads):
            entries = (*labels(group), text(group.seeds_text), *(mean(spread, ".2f") for spread in spreads))
            rows.append(Row(entries, links(group.flights)))
    caption = (
        "Normalised estimation error squared, position and yaw fixed at the first pose: mean over time, then over the "
        "seeds. Above the ideal, the number of degrees of freedom, a filter is surer of itself than it should be. "
        f"Errors within a flight hang together, so a few flights are no test at a level. {data_caption(found)}"
    )
    return Table("nees_flights", "Consistency (NEES) of the flights", caption, columns, tuple(rows)) if rows else None


def trials_nees(found: Sequence[Campaign]) -> Table:
    """The same of simulated trials, with the bounds within which an honest filter's mean lies, and failures."""
    columns = (
        Column("flight", text=True),
        Column("back-end", text=True),
        Column("trials"),
        Column("failed", text=True),
        *(
            column
            for part, dof in PARTS.items()
            for column in (
                Column(f"{part} NEES, ideally {dof}"),
                Column(f"{part}, 95 % if honest", text=True),
                Column(f"{part}, verdict", text=True),
            )
        ),
        Column("ATE, position + yaw, RMS", "m"),
        Column("worst", "m"),
        Column("orientation, RMS", "deg"),
        Column("completion", "%"),
        Column("resets, all trials"),
    )
    rows = []
    for campaign in found:
        outcome = campaign.outcome
        failures = [f"{count} {kind}" for kind, count in outcome.failures.items() if count]
        entries = [
            text(outcome.flight),
            text(outcome.name),
            number(len(outcome.trials), "d"),
            text(", ".join(failures) or "none"),
        ]
        for part in PARTS:
            nees = outcome.nees(part)
            low, high = (None, None) if nees is None else nees.mean_band
            entries += [
                number(None if nees is None else nees.mean, ".2f"),
                text("" if low is None else f"{low:.2f} to {high:.2f}"),
                text("" if nees is None else nees.verdict),
            ]
        values = outcome.values("ate_m")
        completion = outcome.mean("completion")
        entries += [
            number(outcome.rms("ate_m"), ".3f"),
            number(values.max() if len(values) else None, ".3f"),
            number(outcome.rms("orientation_deg"), ".2f"),
            number(None if completion is None else 100.0 * completion, ".1f"),
            number(outcome.total("resets"), "d"),
        ]
        rows.append(Row(tuple(entries), campaign.links))
    caption = (
        "Simulated tracks and IMU with EuRoC's noise, true calibration, the back-end's own initialisation. NEES: mean "
        "over time, then over the trials, beside the 95 % bounds for the mean of that many independent samples. Trials "
        "that diverged are in the errors; those that never initialised or crashed have none, and are counted."
    )
    return Table("nees", "Consistency (NEES)", caption, columns, tuple(rows))


def failures(found: Iterable[Flight], others: Iterable[TaskResult]) -> Table | None:
    """A row for each flight that something went wrong in, and for each other task that failed."""
    columns = (
        Column("task", text=True),
        Column("outcome", text=True),
        Column("reason", text=True),
        Column("attempts"),
    )
    troubled = [(each.task, each.outcome.value, each.reason, run_path(each)) for each in found if each.reason]
    troubled += [(task, "failed", task.error, task_path(task)) for task in others if not task.ok]
    rows = [
        Row((text(task.key), text(outcome), text(reason), number(task.attempts, "d")), (("folder", path),))
        for task, outcome, reason, path in troubled
    ]
    caption = (
        "Every task that failed, never initialised, could not be evaluated or is not complete; all are counted in the "
        "other tables."
    )
    return Table("failures", "What went wrong", caption, columns, tuple(rows)) if rows else None


def evo_command(flight: Flight) -> str:
    """The command that re-derives ``ate_se3_m`` of a flight, to be run in the results folder."""
    run = run_path(flight)
    estimate = "trajectory_loop.tum" if flight.task.loop_closed else "trajectory.tum"
    return f"evo_ape tum {quote(f'{run}/{MATCHED_TRUTH}')} {quote(f'{run}/{estimate}')} --align"


def evo_commands(found: Iterable[Flight]) -> Table | None:
    """A row for each flight that has an ATE by SE(3)."""
    columns = (Column("task", text=True), Column("ATE, SE(3)", "m"), Column("command", text=True, code=True))
    rows = [
        Row(
            (text(flight.task.key), number(flight.figures["ate_se3_m"], ".6f"), text(evo_command(flight))),
            (("run", run_path(flight)),),
        )
        for flight in found
        if "ate_se3_m" in flight.figures
    ]
    caption = (
        f"Run in the results folder; evo prints the same as rmse. {MATCHED_TRUTH} is the truth interpolated at the "
        "stamps of trajectory.tum, because evo pairs the nearest stamps instead."
    )
    return Table("evo", "Every ATE re-derived with evo", caption, columns, tuple(rows)) if rows else None


def provenance(results: SuiteResults) -> Table:
    """Machine, versions and revision; a row for each value where the tasks differ."""
    seen: dict[str, Counter[str]] = defaultdict(Counter)
    for task in results.tasks:
        for fact, value in (*_facts(task.machine), ("digest of the code", task.fingerprint["code"])):
            seen[fact][value] += 1
    rows = [
        Row((text(fact), text(value), number(count, "d")))
        for fact, values in seen.items()
        for value, count in values.most_common()
    ]
    columns = (Column("what", text=True), Column("value", text=True), Column("tasks"))
    caption = f"What the {len(results.tasks)} tasks were computed with; several values of one thing where they differ."
    return Table("provenance", "Machine and versions", caption, columns, tuple(rows))


def _facts(machine: Mapping[str, Any]) -> Iterable[tuple[str, str]]:
    for fact in (*_FACTS, *(key for key in machine if key not in (*_FACTS, "versions"))):
        if machine.get(fact) is not None:
            value = machine[fact]
            yield fact, value if isinstance(value, str) else json.dumps(value).strip('{}"')
    yield from machine.get("versions", {}).items()
