"""A Monte Carlo as a table for the terminal, and as a folder of files.

- ``montecarlo.json``: settings, machine, figures by back-end and by seed
- ``nees.csv``: averages over the trials, over time
- ``nees_FLIGHT.png``: the same, drawn with the bounds of an honest filter
- ``trials.png``: the errors of every trial
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation.consistency import PARTS, AverageNees, Trial, Trials
from vioframe.report.style import RC, caption, colour, legend_above, line
from vioframe.report.tables import UNKNOWN
from vioframe.types import NS_PER_S

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure
    from rich.text import Text

MARKER = "montecarlo.json"
"""The file by which a folder is known as that of a Monte Carlo."""

_COLOURS = {"consistent": "green", "overconfident": "red", "pessimistic": "yellow"}
_HONEST = "#009E73"
_LOGARITHMIC_FROM = 4.0
"""A curve that leaves the bounds by this factor makes the axis logarithmic."""
_LOGARITHMIC_SPAN = 30.0
_GOLDEN = 0.6180339887


def figures(cases: Sequence[Trials]) -> pd.DataFrame:
    """Cells for :func:`vioframe.report.tables.to_rich`: a row a figure by section and label, a column a case."""
    import pandas as pd

    rows: dict[tuple[str, str], Callable[[Trials], Text | str]] = {
        ("Trials", "flown"): lambda each: str(len(each.trials)),
        ("Trials", "failed"): _failures,
        ("Trials", "resets"): lambda each: str(each.total("resets")),
        ("Trials", "initialised after [s]"): lambda each: _number(each.mean("initialised_s"), ".2f"),
        ("Trials", "completion after that"): lambda each: _number(each.mean("completion"), ".1%"),
    }
    for label, key, spec in (
        ("position (ATE) [m]", "ate_m", ".3f"),
        ("position [% of path]", "percent", ".3f"),
        ("orientation [deg]", "orientation_deg", ".2f"),
    ):
        rows["RMSE, position + yaw aligned (worst)", label] = partial(_error, key, spec)
    for part, dof in PARTS.items():
        rows["NEES, mean [95 % if honest]", f"{part}, ideally {dof}"] = partial(_nees, part, _mean)
    for part in PARTS:
        rows["NEES over its ideal (instants in bounds)", part] = partial(_nees, part, _per_axis)
    rows["Time", "back-end, ms a frame"] = lambda each: _number(each.mean("cpu_ms"), ".1f")
    cells = [[cell(each) for each in cases] for cell in rows.values()]
    return pd.DataFrame(cells, pd.MultiIndex.from_tuples(rows), [f"{each.name}\n{each.flight}" for each in cases])


def write_files(cases: Sequence[Trials], folder: Path) -> None:
    """Write all but :data:`MARKER` into ``folder``, which exists."""
    import matplotlib as mpl

    nees_table(cases).to_csv(folder / "nees.csv", index=False, float_format="%.9g")
    with mpl.rc_context(dict(RC)):
        for flight in dict.fromkeys(each.flight for each in cases):
            judged = [each for each in cases if each.flight == flight and each.nees("pose")]
            if judged:
                name = re.sub(r"[^\w-]", "_", flight)
                nees_over_time(judged).savefig(folder / f"nees_{name}.png")
        if any(trial.figures for each in cases for trial in each.trials):
            trials(cases).savefig(folder / "trials.png")


def nees_table(cases: Sequence[Trials]) -> pd.DataFrame:
    """Average NEES over time: a row an instant of each case, with how many trials it is of."""
    import pandas as pd

    tables = []
    for each in cases:
        found = [nees for part in PARTS if (nees := each.nees(part))]
        if found:
            about = {"backend": each.name, "flight": each.flight, "t_s": found[0].t_ns / NS_PER_S}
            columns = {
                f"{nees.part}{bound}": values
                for nees in found
                for bound, values in (("", nees.values), ("_low", nees.low), ("_high", nees.high))
            }
            tables.append(pd.DataFrame({**about, "trials": found[0].trials, **columns}))
    return pd.concat(tables) if tables else pd.DataFrame()


def nees_over_time(cases: Sequence[Trials]) -> Figure:
    """Average NEES of orientation, position and pose of back-ends on one flight, with the bounds of an honest filter.

    A single back-end's trials are drawn behind it, one thin line each.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 8.5), layout="constrained")
    panels: Any = figure.subplots(3, 1, sharex=True)
    handles: dict[str, Any] = {}
    for ax, part in zip(panels, PARTS, strict=True):
        widest = max((nees for o in cases if (nees := o.nees(part))), key=lambda nees: nees.trials.max())
        handles["honest"] = ax.fill_between(
            widest.t_ns / NS_PER_S, widest.low, widest.high, color=_HONEST, alpha=0.22, lw=0, label="95 % if honest"
        )
        ax.axhline(widest.dof, color=_HONEST, lw=1.2)
        highest = 0.0
        if len(cases) == 1:
            for trial in cases[0].trials:
                if len(trial.t_ns):
                    thin = ax.plot(
                        trial.t_ns / NS_PER_S, trial.nees[part], color="#999999", lw=0.5, alpha=0.3, zorder=0.5
                    )[0]
                    thin.set_label("single trials")
                    handles["single"] = thin
        for i, case in enumerate(cases):
            nees = case.nees(part)
            if nees is None:
                continue
            handles[case.name] = ax.plot(nees.t_ns / NS_PER_S, nees.values, **line(i), label=case.name)[0]
            highest = max(highest, float(nees.values.max()))
        high = float(widest.mean_band[1])
        if highest > _LOGARITHMIC_FROM * high:
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter("{x:g}")
            ax.set_ylim(0.3 * widest.dof, 1.5 * highest)
        else:
            ax.set_ylim(0.0, 1.15 * max(highest, high))
        means = "   ".join(
            f"{nees.mean:.2f}" if len(cases) == 1 else f"{case.name}: {nees.mean:.2f}"
            for case in cases
            if (nees := case.nees(part))
        )
        ax.set_title(f"{part}, mean {means}", fontweight="normal")
        ax.set_ylabel(f"NEES (ideally {widest.dof})")
        ax.margins(x=0.0)
    panels[-1].set_xlabel("time since the first frame [s]")
    figure.align_ylabels(panels)
    legend_above(figure, list(handles.values()))
    counts = {len(case.trials) for case in cases}
    flown = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{counts.pop()}"
    caption(
        figure,
        f"{cases[0].flight}: mean of {flown} trials, position and yaw fixed at the first pose. "
        "Above the band: overconfident.",
    )
    return figure


def trials(cases: Sequence[Trials]) -> Figure:
    """Every trial as a point: position error, orientation error, mean NEES of the pose; a bar marks the median."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 2.4 + 1.1 * len(cases)), layout="constrained")
    panels: Any = figure.subplots(1, 3, sharey=True)
    titles = ("position RMSE [% of the path]", "orientation RMSE [deg]", "pose NEES over its ideal")
    for ax, title, read in zip(panels, titles, (_percent, _orientation_deg, _nees_per_axis), strict=True):
        found = [np.array([x for trial in o.trials if np.isfinite(x := read(trial))]) for o in cases]
        for row, values in enumerate(found):
            # Spread so that equal trials stay apart, the same way each time.
            across = row + 0.5 * (np.arange(len(values)) * _GOLDEN % 1.0 - 0.5)
            ax.scatter(values, across, s=22, color=colour(row), alpha=0.65, lw=0)
            if len(values):
                ax.vlines(np.median(values), row - 0.36, row + 0.36, color="black", lw=2)
        every = np.concatenate(found)
        if len(every) and every.min() > 0.0 and every.max() > _LOGARITHMIC_SPAN * every.min():
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter("{x:g}")
        else:
            ax.set_xlim(left=0.0)
        ax.set_xlabel(title)
        ax.grid(visible=False, axis="y")
    panels[2].axvline(1.0, color=_HONEST, lw=1.2)
    panels[0].set_yticks(range(len(cases)), [_row_label(case) for case in cases])
    panels[0].set_ylim(len(cases) - 0.4, -0.6)
    caption(figure, "A point a trial; the bar is the median. Green: an honest filter's mean.")
    return figure


def _percent(trial: Trial) -> float:
    value = trial.figures.get("percent")
    return np.nan if value is None else float(value)


def _orientation_deg(trial: Trial) -> float:
    return float(trial.figures.get("orientation_deg", np.nan))


def _nees_per_axis(trial: Trial) -> float:
    return float(trial.nees["pose"].mean()) / PARTS["pose"] if len(trial.t_ns) else np.nan


def _row_label(case: Trials) -> str:
    failed = sum(case.failures.values())
    name = case.name.replace(":", ":\n").replace(",", ",\n")
    return f"{name}\n{case.flight}" + (f"\n{failed} of {len(case.trials)} failed" if failed else "")


def _failures(case: Trials) -> Text | str:
    from rich.text import Text

    by_kind = [f"{count} {kind}" for kind, count in case.failures.items() if count]
    total = sum(case.failures.values())
    return Text(f"{total} ({', '.join(by_kind)})", style="bold red") if total else "0"


def _error(key: str, spec: str, case: Trials) -> str:
    rms, values = case.rms(key), case.values(key)
    return UNKNOWN if rms is None else f"{rms:{spec}} ({values.max():{spec}})"


def _nees(part: str, show: Callable[[AverageNees], str], case: Trials) -> Text | str:
    from rich.text import Text

    nees = case.nees(part)
    return UNKNOWN if nees is None else Text(show(nees), style=_COLOURS[nees.verdict])


def _mean(nees: AverageNees) -> str:
    low, high = nees.mean_band
    return f"{nees.verdict}  {nees.mean:.2f} [{low:.2f}, {high:.2f}]"


def _per_axis(nees: AverageNees) -> str:
    return f"{nees.per_axis:.2f} ({nees.inside:.0%})"


def _number(value: float | None, spec: str) -> str:
    return UNKNOWN if value is None else format(value, spec)
