"""Evaluations as text: a table for the terminal, Markdown, csv and JSON."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from io import StringIO
from typing import TYPE_CHECKING, Any

from vioframe.report.evaluated import Evaluated
from vioframe.trajectory import RelativeErrors, Stats, TrajectoryErrors

if TYPE_CHECKING:
    from rich.table import Table

ALIGNED_BY = {"posyaw": "position + yaw", "se3": "SE(3)", "sim3": "Sim(3)", "first": "first pose"}

_UNKNOWN = "–"
_Section = tuple[str, list[tuple[str, list[str]]]]


def sections(runs: Sequence[Evaluated]) -> list[_Section]:
    """(title, rows) by topic; each row is its label with unit and one cell a run. Rows that no run knows are left out."""
    groups = [
        ("Run", _run_rows(runs)),
        *_error_sections(runs),
        ("Time, ms a frame", _timing_rows(runs)),
    ]
    known = [(title, [row for row in rows if any(cell != _UNKNOWN for cell in row[1])]) for title, rows in groups]
    return [(title, rows) for title, rows in known if rows]


def to_rich(runs: Sequence[Evaluated]) -> Table:
    """A table with a column a run, for the terminal."""
    from rich.table import Table

    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("")
    for run in runs:
        table.add_column(run.name, justify="right", overflow="fold")
    for title, rows in sections(runs):
        table.add_row(f"[bold]{title}[/bold]", *[""] * len(runs))
        for label, cells in rows:
            table.add_row(f"  {label}", *cells)
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


def notes(runs: Sequence[Evaluated]) -> Iterator[str]:
    """One line for each thing a reader of the figures should know."""
    for run in runs:
        if run.folder and not run.summary.get("finished", False):
            yield f"{run.name}: the run was interrupted; these figures cover what it left"
        if run.estimate is None:
            yield f"{run.name}: never initialised, so there is no pose to evaluate"
        elif run.errors is None:
            yield f"{run.name}: no ground truth; pass --ground-truth to measure errors"
        else:
            yield from (f"{run.name}: {note}" for note in run.errors.notes)


def _run_rows(runs: Sequence[Evaluated]) -> list[tuple[str, list[str]]]:
    def errors(format_: Callable[[TrajectoryErrors], str]) -> list[str]:
        return _cells(runs, format_)

    def summary(key: str, spec: str, factor: float | None = None) -> list[str]:
        found = [run.summary.get(key) for run in runs]
        return [_UNKNOWN if x is None else format(x if factor is None else factor * x, spec) for x in found]

    return [
        ("detector", summary("detector", "")),
        ("back-end", summary("backend", "")),
        ("start offset [s]", summary("start_s", ".1f")),
        ("initialised after [s]", summary("initialised_after_s", ".2f")),
        ("completion after that [%]", summary("completion", ".1f", 100.0)),
        ("resets", summary("resets", "d")),
        ("evaluated poses", errors(lambda e: str(len(e.estimate)))),
        ("ground truth covered [%]", errors(lambda e: f"{100.0 * e.coverage:.1f}")),
        ("path length [m]", errors(lambda e: f"{e.truth.path_length_m:.2f}")),
    ]


def _error_sections(runs: Sequence[Evaluated]) -> list[_Section]:
    def cells(format_: Callable[[TrajectoryErrors], str]) -> list[str]:
        return _cells(runs, format_)

    how = next((ALIGNED_BY[run.errors.alignment_name] for run in runs if run.errors), "")
    position = [
        ("RMSE", cells(lambda e: f"{e.ate_m.rmse:.4f}")),
        ("mean", cells(lambda e: f"{e.ate_m.mean:.4f}")),
        ("median", cells(lambda e: f"{e.ate_m.median:.4f}")),
        ("max", cells(lambda e: f"{e.ate_m.max:.4f}")),
        ("max |x|, |y|, |z|", cells(lambda e: ", ".join(f"{x:.3f}" for x in e.max_position_m))),
        ("RMSE after SE(3) alignment", cells(lambda e: _or_unknown(e.ate_se3_m, ".4f"))),
        ("scale by Sim(3) [1]", cells(lambda e: _or_unknown(e.scale, ".4f"))),
    ]
    orientation = [
        ("RMSE", cells(lambda e: f"{e.orientation_deg.rmse:.3f}")),
        ("yaw RMSE", cells(lambda e: f"{e.yaw_deg.rmse:.3f}")),
        ("max |roll|, |pitch|, |yaw|", cells(lambda e: ", ".join(f"{x:.2f}" for x in e.max_rotation_deg))),
    ]
    return [
        (f"Position error, {how} aligned [m]", position),
        (f"Orientation error, {how} aligned [deg]", orientation),
        ("Relative error, mean: translation [%] / yaw [deg] / rotation [deg]", _relative_rows(runs)),
        ("NEES, mean (inside the 95 % band)", _nees_rows(runs)),
    ]


def _relative_rows(runs: Sequence[Evaluated]) -> list[tuple[str, list[str]]]:
    """Over fixed lengths where a path is long enough for any, over fractions of the path where none is."""
    lengths = sorted({relative.length_m for run in runs if run.errors for relative in run.errors.relative})
    if lengths:
        rows = [
            (f"{length:g} m", _cells(runs, lambda e, d=length: _relative_cell(e.relative, d))) for length in lengths
        ]  # type: ignore[misc]
        return rows
    return [
        (
            f"{percent} % of the path",
            _cells(
                runs, lambda e, part=percent: _relative_cell(e.relative_by_fraction, part / 100 * e.truth.path_length_m)
            ),
        )  # type: ignore[misc]
        for percent in (10, 20, 30, 40, 50)
    ]


def _relative_cell(relative: Sequence[RelativeErrors], length_m: float) -> str:
    for errors in relative:
        if abs(errors.length_m - length_m) < 1e-6:
            means = (Stats.of(x).mean for x in (errors.translation_percent, errors.yaw_deg, errors.rotation_deg))
            return " / ".join(f"{mean:.2f}" for mean in means)
    return _UNKNOWN


def _nees_rows(runs: Sequence[Evaluated]) -> list[tuple[str, list[str]]]:
    def cell(errors: TrajectoryErrors, part: str) -> str:
        found = [f"{n.mean:.2f} ({100.0 * n.inside:.0f} %)" for n in errors.nees if n.part == part]
        return found[0] if found else _UNKNOWN

    parts = {"orientation": 3, "position": 3, "pose": 6}
    return [
        (f"{part}, ideally {dof}", [cell(run.errors, part) if run.errors else _UNKNOWN for run in runs])
        for part, dof in parts.items()
    ]


def _timing_rows(runs: Sequence[Evaluated]) -> list[tuple[str, list[str]]]:
    spent = [run.stage_ms() for run in runs]
    stages = dict.fromkeys(stage for each in spent for stage in each)
    rows = [(stage, [_or_unknown(each.get(stage), ".2f") for each in spent]) for stage in stages]
    return [("all", [_or_unknown(sum(each.values()) if each else None, ".2f") for each in spent]), *rows]


def _cells(runs: Sequence[Evaluated], format_: Callable[[TrajectoryErrors], str]) -> list[str]:
    return [_UNKNOWN if run.errors is None else format_(run.errors) for run in runs]


def _or_unknown(value: float | None, spec: str) -> str:
    return _UNKNOWN if value is None else format(value, spec)


def _markdown_row(label: str, cells: Sequence[str]) -> str:
    escaped = (cell.replace("|", "\\|") for cell in (label, *cells))
    return "| " + " | ".join(escaped) + " |"


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for item in value:
                yield from _flatten(item, f"{prefix}{key}.{item['length_m']:g}m.")
        else:
            yield f"{prefix}{key}", "; ".join(map(str, value)) if isinstance(value, list) else value
