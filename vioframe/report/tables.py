"""Evaluations as text: a table for the terminal, Markdown, csv and JSON."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

from vioframe.report.rows import sections
from vioframe.runs.evaluated import Evaluated

if TYPE_CHECKING:
    from rich.table import Table


def to_rich(runs: Sequence[Evaluated]) -> Table:
    """A table with a column a run, for the terminal."""
    from rich.table import Table
    from rich.text import Text

    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("")
    for run in runs:
        table.add_column(Text(run.name), justify="right", overflow="fold")
    for title, rows in sections(runs):
        table.add_row(Text(title, style="bold"))
        for label, cells in rows:
            # As Text, because rich would read a unit in brackets as markup.
            table.add_row(Text(f"  {label}"), *map(Text, cells))
        table.add_section()
    return table


def to_markdown(runs: Sequence[Evaluated]) -> str:
    """The same as a GitHub table."""
    lines = [_markdown_row("", [run.name for run in runs]), _markdown_row("---", ["---:"] * len(runs))]
    for title, rows in sections(runs):
        lines.append(_markdown_row(f"**{title}**", [""] * len(runs)))
        lines += [_markdown_row(label, cells) for label, cells in rows]
    return "\n".join(lines)


def to_json(runs: Sequence[Evaluated]) -> str:
    """A list with one object a run, at full precision."""
    return json.dumps([run.to_dict() for run in runs], indent=2)


def to_csv(runs: Sequence[Evaluated]) -> str:
    """A row a run at full precision; nested figures become columns such as ``ate_m.rmse``."""
    flat = [dict(_flatten(run.to_dict())) for run in runs]
    out = StringIO()
    writer = csv.DictWriter(
        out, fieldnames=list(dict.fromkeys(key for row in flat for key in row)), lineterminator="\n"
    )
    writer.writeheader()
    writer.writerows(flat)
    return out.getvalue().rstrip("\n")


def _markdown_row(label: str, cells: Sequence[str]) -> str:
    escaped = (cell.replace("|", "\\|") for cell in (label, *cells))
    return "| " + " | ".join(escaped) + " |"


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", "; ".join(map(str, value)) if isinstance(value, list) else value
