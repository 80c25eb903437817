"""Benchmark results: rows of plain values, shown as a table and kept as JSON with the machine they come from."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vioframe.bench.run import BackendRun
from vioframe.evaluation import evaluate
from vioframe.runs import machine
from vioframe.simulation import TrackSequence

if TYPE_CHECKING:
    from rich.table import Table

Row = Mapping[str, Any]


def backend_row(sequence: TrackSequence, run: BackendRun) -> Row:
    """What a back-end's run on ``sequence`` amounts to; without a single state, only that it failed.

    Errors are after alignment in position and yaw. ``percent`` is the root mean square error over the path flown from
    the first state on.
    """
    row: dict[str, Any] = {
        "sequence": sequence.name,
        "frames": len(run.estimates),
        "initialised_s": run.initialised_after_s,
        "completion": run.completion,
        "resets": run.resets,
    }
    if run.initialised_after_s is not None:
        errors = evaluate(run.trajectory, sequence.ground_truth)
        path_m = errors.truth.path_length_m
        row |= {
            "path_m": path_m,
            "ate_m": errors.ate_m.rmse,
            "percent": 100.0 * errors.ate_m.rmse / path_m if path_m > 0.0 else None,
            "ate_se3_m": errors.ate_se3_m,
            "scale": errors.scale,
            "yaw_deg": errors.yaw_deg.rmse,
            "orientation_deg": errors.orientation_deg.rmse,
            "nees": {nees.part: nees.mean for nees in errors.nees},
        }
    return row | {"cpu_ms": 1e3 * float(run.cpu_seconds.mean()), "stage_ms": run.stage_ms}


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
