"""Evaluations as text: a table for the terminal, Markdown, csv and JSON, and what a reader should know beside it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from string import Formatter
from typing import TYPE_CHECKING, Any

from vioframe.evaluation import ALIGNED_BY
from vioframe.evaluation.landmarks import WITHIN_CM
from vioframe.report.table import UNKNOWN, markdown
from vioframe.report.units import length
from vioframe.runs.evaluated import Evaluated

if TYPE_CHECKING:
    import pandas as pd
    from rich.table import Table

_STYLES = {"consistent": "green", "overconfident": "red", "pessimistic": "yellow"}

# Cells by section and label, as formats of what `Evaluated.to_dict` holds; `!m` is a length.
_RUN = {
    "detector": "{detector}",
    "back-end": "{backend}",
    "start offset [s]": "{start_s:.1f}",
    "initialised after [s]": "{initialised_after_s:.2f}",
    "completion after that": "{completion:.1%}",
    "resets": "{resets:d}",
    "evaluated poses": "{poses:d}",
    "ground truth covered": "{coverage:.1%}",
    "path length [m]": "{path_length_m:.2f}",
}
_POSITION = {
    "RMSE": "{ate_m[rmse]!m}",
    "mean": "{ate_m[mean]!m}",
    "median": "{ate_m[median]!m}",
    "max": "{ate_m[max]!m}",
    "max |x|, |y|, |z|": "{max_position_m[x]!m}, {max_position_m[y]!m}, {max_position_m[z]!m}",
    "RMSE after SE(3) alignment": "{ate_se3_m!m}",
    "scale by Sim(3) [1]": "{scale:.4f}",
}
_ORIENTATION = {
    "RMSE": "{orientation_deg[rmse]:.3f}",
    "yaw RMSE": "{yaw_deg[rmse]:.3f}",
    "max |roll|, |pitch|, |yaw|": (
        "{max_rotation_deg[roll]:.2f}, {max_rotation_deg[pitch]:.2f}, {max_rotation_deg[yaw]:.2f}"
    ),
}
_NEES = {
    f"{part}, ideally {dof}": f"{{nees[{part}][mean]:.2f}} ({{nees[{part}][inside_95]:.0%}})"
    for part, dof in {"orientation": 3, "position": 3, "pose": 6}.items()
}
_MAP = {
    "landmarks": "{map[landmarks]:d}",
    "median": "{map[median_m]!m}",
    "90 % are within": "{map[q90_m]!m}",
    "RMSE": "{map[rmse_m]!m}",
    f"within {', '.join(map(str, WITHIN_CM))} cm": ", ".join(f"{{map[within][{limit}cm]:.1%}}" for limit in WITHIN_CM),
}


def figures(runs: Sequence[Evaluated]) -> pd.DataFrame:
    """Cells of text, a row a figure by section and label and a column a run; what no run has is left out."""
    import pandas as pd

    found = [run.to_dict() for run in runs]
    how = next((ALIGNED_BY[run.errors.alignment_name] for run in runs if run.errors), "")
    # Over fixed lengths where a path is long enough for any, over fractions of the path where none is.
    stretches, of_path = ("relative", "") if _keys(found, "relative") else ("relative_by_fraction", " of the path")
    relative = {
        f"{stretch}{of_path}": " / ".join(
            f"{{{stretches}[{stretch}][{error}][mean]:.2f}}"
            for error in ("translation_percent", "yaw_deg", "rotation_deg")
        )
        for stretch in _keys(found, stretches)
    }
    sections: dict[str, Mapping[str, str]] = {
        "Run": _RUN,
        f"Position error, {how} aligned": _POSITION,
        f"Orientation error, {how} aligned [deg]": _ORIENTATION,
        "Relative error, mean: translation [%] / yaw [deg] / rotation [deg]": relative,
        "NEES, mean (inside the 95 % band)": _NEES,
        "Landmarks, distance from the simulated world's surfaces": _MAP,
    }
    rows = {
        (title, label): [_cell(template, each) for each in found]
        for title, templates in sections.items()
        for label, template in templates.items()
    }
    for metric in _keys(found, "metrics"):
        measured = [each.get("metrics", {}).get(metric, {}) for each in found]
        rows |= _plain(f"Metric {metric}", measured, "{:.4g}")
    spent = [{"all": sum(each["stage_ms"].values()), **each["stage_ms"]} if each["stage_ms"] else {} for each in found]
    rows |= _plain("Time, ms a frame", spent, "{:.2f}")
    cells = pd.DataFrame(list(rows.values()), pd.MultiIndex.from_tuples(rows), [run.name for run in runs])
    return cells[(cells != UNKNOWN).any(axis=1)]


def to_rich(cells: pd.DataFrame) -> Table:
    """Cells by section and label as a table for the terminal."""
    from rich.table import Table
    from rich.text import Text

    table = Table(show_edge=False, pad_edge=False, header_style="bold")
    table.add_column("")
    for name in cells.columns:
        table.add_column(Text(str(name)), justify="right", overflow="fold")
    for title, rows in cells.groupby(level=0, sort=False):
        table.add_row(Text(str(title), style="bold"))
        for label, row in rows.droplevel(0).iterrows():
            # As Text, because rich would read a unit in brackets as markup.
            table.add_row(Text(f"  {label}"), *(Text(cell, _STYLES.get(cell, "")) for cell in row))
        table.add_section()
    return table


def to_markdown(cells: pd.DataFrame) -> str:
    """The same as a GitHub table."""
    import pandas as pd

    blocks = []
    for title, rows in cells.groupby(level=0, sort=False):
        own = rows.droplevel(0)
        blocks += [pd.DataFrame("", [f"**{title}**"], own.columns), own]
    table = pd.concat(blocks).reset_index(names="").map(lambda text: text.replace("|", "\\|"))
    return "\n".join(markdown(table, ["---", *("---:" for _ in cells.columns)]))


def to_json(runs: Sequence[Evaluated]) -> str:
    """A list with one object a run, at full precision."""
    return json.dumps([run.to_dict() for run in runs], indent=2)


def to_csv(runs: Sequence[Evaluated]) -> str:
    """A row a run at full precision; nested figures become columns such as ``ate_m.rmse``."""
    import pandas as pd

    table = pd.json_normalize([run.to_dict() for run in runs])
    flat = table.map(lambda cell: "; ".join(map(str, cell)) if isinstance(cell, list) else cell)
    return flat.to_csv(index=False).rstrip("\n")


def notes(runs: Sequence[Evaluated]) -> Iterator[str]:
    """One line for each thing a reader of the figures should know."""
    for run in runs:
        if run.folder and not run.summary.get("finished", False):
            yield f"{run.name}: the run was interrupted; these figures cover what it left"
        if run.folder and run.segment_starts_ns:
            segments = len(run.segment_starts_ns) + 1
            yield f"{run.name}: {segments} segments between resets, measured as one trajectory"
        if run.estimate is None:
            yield f"{run.name}: never initialised, so there is no pose to evaluate"
        elif run.errors is None:
            yield f"{run.name}: no ground truth; pass --ground-truth to measure errors"
        else:
            yield from (f"{run.name}: {note}" for note in run.errors.notes)
        if run.measured is not None:
            yield from (f"{run.name}: metric {label}: {why}" for label, why in run.measured.left_out.items())


class _Cell(Formatter):
    """With ``!m`` for lengths in metres."""

    def convert_field(self, value: Any, conversion: str | None) -> Any:
        return length(value) if conversion == "m" else value


def _cell(template: str, found: Mapping[str, Any]) -> str:
    """``template`` filled in; unknown where any of its values is."""
    try:
        return _Cell().vformat(template, (), found)
    except (KeyError, TypeError):
        return UNKNOWN


def _keys(found: Sequence[Mapping[str, Any]], key: str) -> list[str]:
    """The names that any run has below ``key``, in order."""
    return list(dict.fromkeys(name for each in found for name in each.get(key, {})))


def _plain(title: str, found: Sequence[Mapping[str, float]], format_: str) -> dict[tuple[str, str], list[str]]:
    """Rows of a section whose figures are numbers by name."""
    names = dict.fromkeys(name for each in found for name in each)
    return {
        (title, name): [format_.format(each[name]) if name in each else UNKNOWN for each in found] for name in names
    }
