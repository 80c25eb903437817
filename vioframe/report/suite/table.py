"""One table of a report, rendered as CSV, Markdown and LaTeX."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from io import StringIO
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vioframe.report.suite.statistics import Spread

UNKNOWN = "–"


@dataclass(frozen=True, slots=True)
class Column:
    """``unit`` is empty for what has none; ``text`` columns are set flush left, numbers flush right.

    ``code`` is text to copy as it stands.
    """

    title: str
    unit: str = ""
    text: bool = False
    code: bool = False

    @property
    def heading(self) -> str:
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True, slots=True)
class Entry:
    """``shown`` is rounded, for reading; ``value`` is exact, for sorting and CSV, and None where there is none."""

    shown: str
    value: float | str | None


@dataclass(frozen=True, slots=True)
class Row:
    """``links`` are the folders that the row's figures come from, by label, relative to the results folder."""

    entries: tuple[Entry, ...]
    links: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Table:
    """``name`` is that of its files. The caption says what the data was."""

    name: str
    title: str
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]

    @property
    def has_links(self) -> bool:
        return any(row.links for row in self.rows)

    def to_csv(self) -> str:
        """Exact values, empty where there is none, and the folders behind each row."""
        out = StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow([*(column.heading for column in self.columns), *(["runs"] if self.has_links else [])])
        for row in self.rows:
            folders = [" ".join(path for _, path in row.links)] if self.has_links else []
            writer.writerow(["" if entry.value is None else entry.value for entry in row.entries] + folders)
        return out.getvalue()

    def to_markdown(self, to_results: str) -> str:
        """``to_results`` leads from the folder of the Markdown file to the results, for the links."""
        headings = [column.heading for column in self.columns] + (["runs"] if self.has_links else [])
        rules = ["---" if column.text else "---:" for column in self.columns] + (["---"] if self.has_links else [])
        lines = [f"**{_escape_markdown(self.title)}**", "", _markdown(headings), _markdown(rules, escape=False)]
        for row in self.rows:
            cells = [
                f"`{entry.shown}`" if column.code and entry.value is not None else _escape_markdown(entry.shown)
                for column, entry in zip(self.columns, row.entries, strict=True)
            ]
            if self.has_links:
                cells.append(" ".join(f"[{_escape_markdown(label)}]({to_results}/{path})" for label, path in row.links))
            lines.append(_markdown(cells, escape=False))
        return "\n".join([*lines, "", _escape_markdown(self.caption), ""])

    def to_latex(self) -> str:
        """A float for the package booktabs; the links stay behind."""
        spec = "".join("l" if column.text else "r" for column in self.columns)
        lines = [
            "% needs \\usepackage{booktabs}",
            "\\begin{table}",
            "  \\centering",
            f"  \\caption{{{_escape_latex(f'{self.title}. {self.caption}')}}}",
            f"  \\label{{tab:{self.name}}}",
            f"  \\begin{{tabular}}{{{spec}}}",
            "    \\toprule",
            _latex(_escape_latex(column.heading) for column in self.columns),
            "    \\midrule",
            *(self._latex_row(row) for row in self.rows),
            "    \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
        ]
        return "\n".join(lines) + "\n"

    def _latex_row(self, row: Row) -> str:
        cells = (_escape_latex(entry.shown) for entry in row.entries)
        return _latex(
            f"\\texttt{{{cell}}}" if column.code else cell for column, cell in zip(self.columns, cells, strict=True)
        )


def text(value: str) -> Entry:
    return Entry(value or UNKNOWN, value or None)


def number(value: float | None, spec: str, suffix: str = "") -> Entry:
    """Rounded by ``spec``; what is unknown is shown as a dash."""
    return Entry(UNKNOWN, None) if value is None else Entry(f"{value:{spec}}{suffix}", value)


def mean(spread: Spread | None, spec: str) -> Entry:
    """The mean, shown with the standard deviation where there is one."""
    if spread is None:
        return number(None, spec)
    return number(spread.mean, spec, "" if spread.std is None else f" ± {spread.std:{spec}}")


def without_empty(columns: Sequence[Column], rows: Sequence[Row]) -> tuple[tuple[Column, ...], tuple[Row, ...]]:
    """Leave out the columns in which no row has a value."""
    keep = [k for k in range(len(columns)) if any(row.entries[k].value is not None for row in rows)]
    return tuple(columns[k] for k in keep), tuple(Row(tuple(row.entries[k] for k in keep), row.links) for row in rows)


def _markdown(cells: Iterable[str], escape: bool = True) -> str:
    return "| " + " | ".join(_escape_markdown(cell) if escape else cell for cell in cells) + " |"


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


def _latex(cells: Iterable[str]) -> str:
    return "    " + " & ".join(cells) + " \\\\"
