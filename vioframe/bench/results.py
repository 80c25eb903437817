"""Benchmark results: rows of plain values, shown as a table and kept as JSON with the machine they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vioframe.runs import machine

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]


def table(title: str, rows: Sequence[Row], columns: Mapping[str, str]) -> Table:
    """A rich table; ``columns`` maps keys (``stage_ms.total`` reaches into ``stage_ms``) to format specifications."""
    from rich.table import Table

    out = Table(title=title)
    for key in columns:
        out.add_column(key, justify="left" if columns[key] == "" else "right", no_wrap=True)
    for row in rows:
        out.add_row(*(_format(reach(row, key), spec) for key, spec in columns.items()))
    return out


def record(path: Path, rows: Sequence[Row], settings: Mapping[str, Any]) -> None:
    """Write ``rows`` with what they were made with and on."""
    content = {
        "recorded": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": dict(settings),
        "machine": machine.describe(),
        "results": [dict(row) for row in rows],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def reach(row: Row, key: str) -> Any:
    """The value at ``key``, as ``ms.total``; None where there is none."""
    value: Any = row
    for part in key.split("."):
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _format(value: Any, spec: str) -> str:
    return "-" if value is None else format(value, spec)
