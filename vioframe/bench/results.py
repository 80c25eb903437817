"""Benchmark results: rows of plain values, kept as JSON with the machine they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from vioframe.runs import machine

Row = dict[str, Any]


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
