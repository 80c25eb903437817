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

    def shown(self, row: TableRow) -> list[str]:
        return [row.entries[heading].shown if heading in row.entries else UNKNOWN for heading in self.headings]

    def upright(self, names: Sequence[str]) -> pd.DataFrame:
        """The cells as shown, for :func:`vioframe.report.tables.to_rich`: a column a row, called by its ``names``."""
        shown = pd.DataFrame([self.shown(row) for row in self.rows], columns=self.headings)
        cells = shown.drop(columns=[*names]).T.set_axis(shown[[*names]].agg("\n".join, axis="columns"), axis="columns")
        return cells.set_axis(pd.MultiIndex.from_product([[self.title], cells.index]))

    def to_csv(self) -> str:
        """Exact values, empty where there is none, and the folders behind each row."""
        links = {"runs": [" ".join(path for _, path in row.links) for row in self.rows]} if self.has_links else {}
        return str(self.values.assign(**links).to_csv(index=False, lineterminator="\n"))

    def to_markdown(self, to_results: str) -> str:
        """``to_results`` leads from the folder of the Markdown file to the results, for the links."""
        runs = ["runs"] if self.has_links else []
        rules = ["---" if self.is_text(heading) else "---:" for heading in self.headings] + ["---"] * len(runs)
        lines = [_markdown(map(_escape_markdown, [*self.headings, *runs])), _markdown(rules)]
        for row in self.rows:
            cells = [
                f"`{shown}`" if heading == self.code and shown != UNKNOWN else _escape_markdown(shown)
                for heading, shown in zip(self.headings, self.shown(row), strict=True)
            ]
            links = " ".join(f"[{_escape_markdown(label)}]({to_results}/{path})" for label, path in row.links)
            lines.append(_markdown([*cells, links] if runs else cells))
        return "\n".join([f"**{_escape_markdown(self.title)}**", "", *lines, "", _escape_markdown(self.caption), ""])

    def to_latex(self) -> str:
        """A float for the package booktabs; the links stay behind."""
        rows = []
        for row in self.rows:
            cells = (_escape_latex(shown) for shown in self.shown(row))
            pairs = zip(self.headings, cells, strict=True)
            rows.append(_latex(f"\\texttt{{{cell}}}" if heading == self.code else cell for heading, cell in pairs))
        lines = [
            "% needs \\usepackage{booktabs}",
            "\\begin{table}",
            "  \\centering",
            f"  \\caption{{{_escape_latex(f'{self.title}. {self.caption}')}}}",
            f"  \\label{{tab:{self.name}}}",
            f"  \\begin{{tabular}}{{{''.join('l' if self.is_text(heading) else 'r' for heading in self.headings)}}}",
            "    \\toprule",
            _latex(map(_escape_latex, self.headings)),
            "    \\midrule",
            *rows,
            "    \\bottomrule",
            "  \\end{tabular}",
            "\\end{table}",
        ]
        return "\n".join(lines) + "\n"


def text(value: str | None) -> Entry:
    return Entry(value or UNKNOWN, value or None)


def number(value: float | None, spec: str, suffix: str = "") -> Entry:
    """Rounded by ``spec``; what is unknown, None or NaN, is shown as a dash."""
    return Entry(UNKNOWN, None) if pd.isna(value) else Entry(f"{value:{spec}}{suffix}", value)


def mean(values: pd.Series, spec: str, suffix: str = "") -> Entry:
    """The mean of those that there are, shown with the sample's standard deviation where there are several."""
    std = values.std()
    return number(values.mean(), spec, suffix if pd.isna(std) else f" ± {std:{spec}}{suffix}")


def _markdown(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |"


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
