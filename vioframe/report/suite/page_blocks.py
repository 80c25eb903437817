"""What a page is made of: sections of plots, tables, commands and notes, as plain values that the template lays out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from vioframe.report.suite.table import Table


@dataclass(frozen=True)
class Picture:
    """Plotly's traces and layout.

    A trace's ``meta`` says whose it is: ``series``, its entry in the legend, and ``detector`` and ``backend``, by which
    the page's filters hide it; or ``owners``, one of those a point, where the points of a trace have several. Its
    ``x_back`` is how many traces before it the one is that has its x, which is then not stored again.
    """

    data: Sequence[Mapping[str, Any]]
    layout: Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """One of the things that a plot can show: pictures side by side, as far as there is room, with one legend."""

    pictures: Sequence[Picture]
    caption: str = ""


@dataclass(frozen=True)
class Plot:
    """A plot with a case for each choice of the reader. Heights are in px, ``narrow_height`` is for phones.

    ``views`` is for pictures in 3-D: adds buttons for the views from above and from the side.
    """

    kind: ClassVar[str] = "plot"

    id: str
    title: str
    cases: Mapping[str, Case]
    caption: str = ""
    choice: str = "Flight"
    height: int = 460
    narrow_height: int = 0
    views: bool = False


@dataclass(frozen=True)
class Cell:
    """``value`` is what it is sorted by, None where it is no number."""

    shown: str
    value: float | None


@dataclass(frozen=True)
class Line:
    """A row as the page shows it. ``runs`` are (label, address) of the folders that its figures come from."""

    cells: Sequence[Cell]
    runs: Sequence[tuple[str, str]]
    detector: str | None = None
    backend: str | None = None
    failed: bool = False


@dataclass(frozen=True)
class TableBlock:
    """A table of the report. ``columns`` are the places of those that are shown."""

    kind: ClassVar[str] = "table"

    table: Table
    columns: Sequence[int]
    lines: Sequence[Line]


@dataclass(frozen=True)
class Command:
    """A line for a shell, and what it is for."""

    label: str
    text: str
    detector: str | None = None
    backend: str | None = None


@dataclass(frozen=True)
class Commands:
    kind: ClassVar[str] = "commands"

    lines: Sequence[Command]


@dataclass(frozen=True)
class Notes:
    kind: ClassVar[str] = "notes"

    lines: Sequence[str]


Block = Plot | TableBlock | Commands | Notes


@dataclass(frozen=True)
class Section:
    """``lead`` is its first sentence, which says what to look for."""

    id: str
    title: str
    blocks: Sequence[Block]
    lead: str = ""


@dataclass(frozen=True)
class Filter:
    """Checkboxes of one kind; ``values`` are the names with their colour, if that is how plots tell them apart."""

    key: str
    label: str
    values: Mapping[str, str]


@dataclass(frozen=True)
class Headline:
    """The suite's question, answered; ``facts`` are the few figures that a reader asks for next."""

    answer: str
    more: Sequence[str] = ()
    facts: Mapping[str, str] = field(default_factory=dict)
