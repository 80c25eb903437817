"""One table of a report, rendered as CSV, Markdown and LaTeX."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import pandas as pd

UNKNOWN = "–"


@dataclass(frozen=True, slots=True)
class Entry:
    """``shown`` is rounded, for reading; ``value`` is exact, for sorting and CSV, and None where there is none."""

    shown: str
    value: float | str | None


@dataclass(frozen=True, slots=True)
class TableRow:
    """Entries by heading, which ends with the unit in brackets.

    ``links`` are the folders that the row's figures come from, by label, relative to the results folder. ``detector``
    and ``backend`` are whose it is.
    """

    entries: Mapping[str, Entry]
    links: tuple[tuple[str, str], ...] = ()
    detector: str | None = None
    backend: str | None = None


@dataclass(frozen=True)
class Table:
    """``name`` is that of its files. The caption says what the data was. Columns without any value are left out.

    ``code`` is the heading of a column that is text to copy as it stands.
    """

    name: str
    title: str
    caption: str
    rows: tuple[TableRow, ...]
    code: str = ""

    @cached_property
    def values(self) -> pd.DataFrame:
        """Exact values by heading."""
        exact = [{heading: entry.value for heading, entry in row.entries.items()} for row in self.rows]
        return pd.DataFrame(exact, dtype=object).dropna(axis="columns", how="all")

    @property
    def headings(self) -> list[str]:
        return list(self.values.columns)

    def is_text(self, heading: str) -> bool:
        return bool(self.values[heading].dropna().map(lambda value: isinstance(value, str)).all())

    @property
    def has_links(self) -> bool:
        return any(row.links for row in self.rows)

    @property
    def cells(self) -> pd.DataFrame:
        """The entries as they are shown."""
        shown = [{heading: entry.shown for heading, entry in row.entries.items()} for row in self.rows]
        return pd.DataFrame(shown, columns=self.headings).fillna(UNKNOWN)

    def upright(self, names: Sequence[str]) -> pd.DataFrame:
        """The cells for :func:`vioframe.report.tables.to_rich`: a column a row, called by its ``names``."""
        shown = self.cells
        cells = shown.drop(columns=[*names]).T.set_axis(shown[[*names]].agg("\n".join, axis="columns"), axis="columns")
        return cells.set_axis(pd.MultiIndex.from_product([[self.title], cells.index]))

    def to_csv(self) -> str:
        """Exact values, empty where there is none, and the folders behind each row."""
        links = {"runs": [" ".join(path for _, path in row.links) for row in self.rows]} if self.has_links else {}
        return str(self.values.assign(**links).to_csv(index=False, lineterminator="\n"))

    def to_markdown(self, to_results: str) -> str:
        """``to_results`` leads from the folder of the Markdown file to the results, for the links."""
        cells = self.cells.map(_escape_markdown).rename(columns=_escape_markdown)
        rules = ["---" if self.is_text(heading) else "---:" for heading in self.headings]
        if self.code in self.headings:
            cells[self.code] = [shown if shown == UNKNOWN else f"`{shown}`" for shown in self.cells[self.code]]
        if self.has_links:
            rules.append("---")
            cells["runs"] = [
                " ".join(f"[{_escape_markdown(label)}]({to_results}/{path})" for label, path in row.links)
                for row in self.rows
            ]
        lines = [f"**{_escape_markdown(self.title)}**", "", *markdown(cells, rules), "", _escape_markdown(self.caption)]
        return "\n".join([*lines, ""])

    def to_latex(self) -> str:
        """A float for the package booktabs; the links stay behind."""
        cells = self.cells.map(_escape_latex)
        if self.code in cells:
            cells[self.code] = "\\texttt{" + cells[self.code] + "}"
        latex = (
            cells.rename(columns=_escape_latex)
            .style.hide(axis="index")
            .to_latex(
                column_format="".join("l" if self.is_text(heading) else "r" for heading in self.headings),
                position_float="centering",
                hrules=True,
                label=f"tab:{self.name}",
                caption=_escape_latex(f"{self.title}. {self.caption}"),
            )
        )
        return f"% needs \\usepackage{{booktabs}}\n{latex}"


def markdown(cells: pd.DataFrame, rules: Iterable[str]) -> list[str]:
    """The lines of a GitHub table of what is escaped already; ``rules`` say how its columns are aligned."""
    return ["| " + " | ".join(row) + " |" for row in (cells.columns, rules, *cells.itertuples(index=False))]


def text(value: str | None) -> Entry:
    return Entry(value or UNKNOWN, value or None)


def number(value: float | None, spec: str, suffix: str = "") -> Entry:
    """Rounded by ``spec``; what is unknown, None or NaN, is shown as a dash."""
    return Entry(UNKNOWN, None) if pd.isna(value) else Entry(f"{value:{spec}}{suffix}", value)


def mean(values: pd.Series, spec: str, suffix: str = "") -> Entry:
    """The mean of those that there are, shown with the sample's standard deviation where there are several."""
    std = values.std()
    return number(values.mean(), spec, suffix if pd.isna(std) else f" ± {std:{spec}}{suffix}")


def _escape_markdown(value: str) -> str:
    for character in "\\|*_<`":
        value = value.replace(character, "\\" + character)
    return " ".join(value.split())


_LATEX = str.maketrans(
    {
        **{character: "\\" + character for character in "&%$#_{}"},
        "~": "\\textasciitilde{}",
        "^": "\\textasciicircum{}",
        "\\": "\\textbackslash{}",
        "<": "\\textless{}",
        ">": "\\textgreater{}",
        "|": "\\textbar{}",
        "±": "$\\pm$",
        "–": "--",
        "·": "$\\cdot$",
        "→": "$\\to$",
    }
)


def _escape_latex(value: str) -> str:
    return " ".join(value.split()).translate(_LATEX)
