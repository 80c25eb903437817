"""What the flights of a suite say together: counts, means and spreads over the seeds, with nothing dropped.

A flight that failed stays in its group and is counted; it only has no error to average. Figures of real, rendered and
simulated recordings never meet in one average. How the statistics are meant: ``docs/report.md``.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from vioframe.report.suite.flights import Flight, Outcome
from vioframe.report.suite.results import Data, Kind, SuiteResults, TaskResult

_Key = TypeVar("_Key")

CLEAR = "clear"
"""The condition without any degradation, at level 0."""


@dataclass(frozen=True, slots=True, order=True)
class Cell:
    """What the flights of a group share: all of their labels but the seed, and what they were made on."""

    data: Data
    sequence: str
    condition: str
    level: float
    detector: str
    backend: str

    @property
    def contender(self) -> tuple[str, str]:
        return self.detector, self.backend

    @property
    def course(self) -> tuple[Data, str, str, float]:
        """All but the contender: what contenders are compared on."""
        return self.data, self.sequence, self.condition, self.level


@dataclass(frozen=True, slots=True)
class Spread:
    """Some values of one figure. ``std`` is the sample's (n - 1), None for a single value."""

    values: tuple[float, ...]

    @property
    def n(self) -> int:
        return len(self.values)

    @property
    def mean(self) -> float:
        return float(np.mean(self.values))

    @property
    def std(self) -> float | None:
        return float(np.std(self.values, ddof=1)) if self.n > 1 else None

    @property
    def median(self) -> float:
        return float(np.median(self.values))

    @property
    def min(self) -> float:
        return min(self.values)

    @property
    def max(self) -> float:
        return max(self.values)

    def to_dict(self) -> dict[str, Any]:
        return {"n": self.n, **{key: getattr(self, key) for key in ("mean", "std", "median", "min", "max")}}


@dataclass(frozen=True)
class Group:
    """All seeds of one cell, in their order."""

    cell: Cell
    flights: tuple[Flight, ...]

    @property
    def count(self) -> int:
        return len(self.flights)

    @property
    def evaluated(self) -> int:
        return sum(flight.evaluated for flight in self.flights)

    @property
    def all_complete(self) -> bool:
        return all(flight.complete for flight in self.flights)

    @property
    def succeeded(self) -> int:
        return sum(flight.succeeded for flight in self.flights)

    @cached_property
    def outcomes(self) -> Counter[Outcome]:
        return Counter(flight.outcome for flight in self.flights)

    @property
    def reasons(self) -> dict[str, int]:
        """What went wrong, with how often."""
        return dict(Counter(flight.reason for flight in self.flights if flight.reason))

    @property
    def seeds_text(self) -> str:
        """``3``, or ``2 of 3; 1 failed``: how many of the flights an error was measured of, and why not of the rest."""
        missing = [
            f"{number} {outcome}"
            for outcome, number in sorted(self.outcomes.items())
            if outcome is not Outcome.COMPLETE
        ]
        counted = str(self.count) if self.evaluated == self.count else f"{self.evaluated} of {self.count}"
        return "; ".join([counted, *missing])

    @property
    def data_note(self) -> str:
        return next((flight.task.data_note for flight in self.flights if flight.task.data_note), "")

    def spread(self, figure: str) -> Spread | None:
        """Of the flights that have ``figure``; None where none has."""
        values = tuple(flight.figures[figure] for flight in self.flights if figure in flight.figures)
        return Spread(values) if values else None

    def mean(self, figure: str) -> float | None:
        spread = self.spread(figure)
        return None if spread is None else spread.mean

    def means(self, prefix: str) -> dict[str, float]:
        """Means of all figures below ``prefix``, by the rest of their name, as of ``stage_ms.``."""
        names = dict.fromkeys(n for flight in self.flights for n in flight.figures if n.startswith(prefix))
        return {name.removeprefix(prefix): mean for name in names if (mean := self.mean(name)) is not None}

    def median_flight(self) -> Flight | None:
        """The one to draw for the group: that of the median ATE, of two in the middle the worse."""
        found = sorted((f for f in self.flights if f.evaluated), key=lambda f: f.figures["ate_m"])
        return found[len(found) // 2] if found else None


@dataclass(frozen=True)
class Average:
    """A contender's figures over sequences of one data kind; ``spreads`` are over the sequences' means.

    ``sequences`` are those on which every contender's every flight was complete, ``of`` counts all of them: an average
    over other sequences for each contender would compare their luck. ``groups`` are the contender's own of those.
    """

    data: Data
    condition: str
    level: float
    detector: str
    backend: str
    sequences: tuple[str, ...]
    of: int
    groups: tuple[Group, ...]
    spreads: Mapping[str, Spread]


def flights(results: SuiteResults) -> list[Flight]:
    return [Flight.of(task) for task in results.of(Kind.FLIGHT)]


def groups(results: SuiteResults) -> list[Group]:
    """By cell, in the order of the suite's own lists."""
    members: dict[Cell, list[Flight]] = defaultdict(list)
    data_of = _data_kinds(results)
    for flight in flights(results):
        if (cell := _cell(flight.task, data_of)) is not None:
            members[cell].append(flight)
    made = [Group(cell, tuple(sorted(found, key=lambda flight: flight.seed))) for cell, found in members.items()]
    return sorted(made, key=_suite_order(results.suite, [group.cell for group in made]))


def averages(
    found: Sequence[Group], figures: Iterable[str] = ("ate_m", "ate_se3_m", "orientation_deg")
) -> list[Average]:
    """A row a contender, for each data kind, condition and level that has more than one sequence."""
    out = []
    for shared, course in _by(found, lambda g: (g.cell.data, g.cell.condition, g.cell.level)):
        by_sequence = _by(course, lambda g: g.cell.sequence)
        contenders = list(dict.fromkeys(group.cell.contender for group in course))
        common = [
            name
            for name, here in by_sequence
            if len(here) == len(contenders) and all(group.all_complete for group in here)
        ]
        if len(by_sequence) < 2:
            continue
        for detector, backend in contenders:
            own = tuple(g for g in course if g.cell.contender == (detector, backend) and g.cell.sequence in common)
            means = {figure: [m for g in own if (m := g.mean(figure)) is not None] for figure in figures}
            spreads = {figure: Spread(tuple(values)) for figure, values in means.items() if values}
            out.append(Average(*shared, detector, backend, tuple(common), len(by_sequence), own, spreads))
    return out


def _data_kinds(results: SuiteResults) -> dict[tuple[str, str], Data]:
    """By sequence and condition: what those flights were made on that came far enough to say so."""
    return {
        (task.labels.sequence, task.labels.condition): task.data for task in results.tasks if task.labels and task.data
    }


def _cell(task: TaskResult, data_of: Mapping[tuple[str, str], Data]) -> Cell | None:
    """None where neither the task nor its siblings say what it was made on: :func:`unplaced` has those."""
    if (labels := task.labels) is None:
        return None
    data = task.data or data_of.get((labels.sequence, labels.condition))
    if data is None:
        return None
    return Cell(data, labels.sequence, labels.condition, labels.level, labels.detector, labels.backend)


def expected_tasks(suite: Mapping[str, Any]) -> int | None:
    """How many tasks a finished sweep has, or None where the suite does not say."""
    seeds = suite.get("seeds", 1)
    detectors, backends, sequences = (len(suite.get(key) or ()) for key in ("detectors", "backends", "sequences"))
    match suite.get("kind"):
        case "detector_speed":
            return 1
        case "trials":
            return int(seeds * backends)
        case "flights":
            levels = sum(len(each) for each in (suite.get("conditions") or {}).values()) + bool(
                suite.get("clear", True)
            )
            return int(seeds * backends * detectors * sequences * levels)
    return None


def unplaced(results: SuiteResults) -> list[Flight]:
    """Flights that are in none of the :func:`groups`, as their recording could not even be found."""
    data_of = _data_kinds(results)
    return [flight for flight in flights(results) if _cell(flight.task, data_of) is None]


def _suite_order(suite: Mapping[str, Any], cells: Sequence[Cell]) -> Callable[[Group], tuple[int | float | str, ...]]:
    """A sorting key: as the suite lists things, and what it does not list after that, in alphabetical order."""

    def places(key: str, own: Iterable[str]) -> dict[str, int]:
        listed = listed_names(suite, key)
        return {name: place for place, name in enumerate(dict.fromkeys([*listed, *sorted(own)]))}

    data = list(Data)
    sequences = places("sequences", {cell.sequence for cell in cells})
    conditions = places("conditions", {cell.condition for cell in cells})
    detectors = places("detectors", {cell.detector for cell in cells})
    backends = places("backends", {cell.backend for cell in cells})

    def key(group: Group) -> tuple[int | float | str, ...]:
        cell = group.cell
        clear_first = -1 if cell.condition == CLEAR else conditions[cell.condition]
        return (
            data.index(cell.data),
            sequences[cell.sequence],
            clear_first,
            cell.level,
            detectors[cell.detector],
            backends[cell.backend],
        )

    return key


def listed_names(suite: Mapping[str, Any], key: str) -> list[str]:
    """What the labels call the entries of one of the suite's lists."""
    entries = suite.get(key) or ()
    return [str(each.get("label") or each["name"]) if isinstance(each, Mapping) else str(each) for each in entries]


def _by(found: Iterable[Group], key: Callable[[Group], _Key]) -> list[tuple[_Key, list[Group]]]:
    """Groups with equal keys together, in the order in which the keys come up."""
    out: dict[_Key, list[Group]] = defaultdict(list)
    for group in found:
        out[key(group)].append(group)
    return list(out.items())


def by_course(found: Iterable[Group]) -> Iterator[tuple[tuple[Data, str, str, float], list[Group]]]:
    """All contenders on the same recording and condition, together."""
    yield from _by(found, lambda group: group.cell.course)
