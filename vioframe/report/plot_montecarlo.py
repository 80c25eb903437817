"""Figures of a Monte Carlo: NEES over time within its bounds, and every trial's errors."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation.consistency import PARTS, Outcome, Trial
from vioframe.report.style import RC, caption, colour, legend_above, line
from vioframe.types import NS_PER_S

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HONEST = "#009E73"
_LOGARITHMIC_FROM = 4.0
"""A curve that leaves the bounds by this factor makes the axis logarithmic."""
_SINGLE = {"color": "#999999", "lw": 0.5, "alpha": 0.3, "zorder": 0.5}
_LOGARITHMIC_SPAN = 30.0
_GOLDEN = 0.6180339887


def write_figures(outcomes: Sequence[Outcome], folder: Path) -> None:
    """``nees_FLIGHT.png`` for each flight where there is a covariance to judge, and ``trials.png``."""
    import matplotlib as mpl

    with mpl.rc_context(dict(RC)):
        for flight in dict.fromkeys(outcome.flight for outcome in outcomes):
            judged = [o for o in outcomes if o.flight == flight and o.nees("pose")]
            if judged:
                name = re.sub(r"[^\w-]", "_", flight)
                nees_over_time(judged).savefig(folder / f"nees_{name}.png")
        if any(trial.figures for outcome in outcomes for trial in outcome.trials):
            trials(outcomes).savefig(folder / "trials.png")


def nees_over_time(outcomes: Sequence[Outcome]) -> Figure:
    """Average NEES of orientation, position and pose of back-ends on one flight, with the bounds of an honest filter.

    A single back-end's trials are drawn behind it, one thin line each.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 8.5), layout="constrained")
    panels: Any = figure.subplots(3, 1, sharex=True)
    handles: dict[str, Any] = {}
    for ax, part in zip(panels, PARTS, strict=True):
        widest = max((nees for o in outcomes if (nees := o.nees(part))), key=lambda nees: nees.trials.max())
        handles["honest"] = ax.fill_between(
            widest.t_ns / NS_PER_S, widest.low, widest.high, color=_HONEST, alpha=0.22, lw=0, label="95 % if honest"
        )
        ax.axhline(widest.dof, color=_HONEST, lw=1.2)
        highest = 0.0
        if len(outcomes) == 1:
            for trial in outcomes[0].trials:
                if len(trial.t_ns):
                    thin = ax.plot(
                        trial.t_ns / NS_PER_S, trial.nees[part], color="#999999", lw=0.5, alpha=0.3, zorder=0.5
                    )[0]
                    thin.set_label("single trials")
                    handles["single"] = thin
        for i, outcome in enumerate(outcomes):
            nees = outcome.nees(part)
            if nees is None:
                continue
            handles[outcome.name] = ax.plot(nees.t_ns / NS_PER_S, nees.values, **line(i), label=outcome.name)[0]
            highest = max(highest, float(nees.values.max()))
        high = float(widest.mean_band[1])
        if highest > _LOGARITHMIC_FROM * high:
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter("{x:g}")
            ax.set_ylim(0.3 * widest.dof, 1.5 * highest)
        else:
            ax.set_ylim(0.0, 1.15 * max(highest, high))
        means = "   ".join(
            f"{nees.mean:.2f}" if len(outcomes) == 1 else f"{outcome.name}: {nees.mean:.2f}"
            for outcome in outcomes
            if (nees := outcome.nees(part))
        )
        ax.set_title(f"{part}, mean {means}", fontweight="normal")
        ax.set_ylabel(f"NEES (ideally {widest.dof})")
        ax.margins(x=0.0)
    panels[-1].set_xlabel("time since the first frame [s]")
    figure.align_ylabels(panels)
    legend_above(figure, list(handles.values()))
    counts = {len(outcome.trials) for outcome in outcomes}
    flown = f"{min(counts)} to {max(counts)}" if len(counts) > 1 else f"{counts.pop()}"
    caption(
        figure,
        f"{outcomes[0].flight}: mean of {flown} trials, position and yaw fixed at the first pose. "
        "Above the band: overconfident.",
    )
    return figure


def trials(outcomes: Sequence[Outcome]) -> Figure:
    """Every trial as a point: position error, orientation error, mean NEES of the pose; a bar marks the median."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 2.4 + 1.1 * len(outcomes)), layout="constrained")
    panels: Any = figure.subplots(1, 3, sharey=True)
    titles = ("position RMSE [% of the path]", "orientation RMSE [deg]", "pose NEES over its ideal")
    for ax, title, read in zip(panels, titles, (_percent, _orientation_deg, _nees_per_axis), strict=True):
        found = [np.array([x for trial in o.trials if np.isfinite(x := read(trial))]) for o in outcomes]
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
    panels[0].set_yticks(range(len(outcomes)), [_row_label(outcome) for outcome in outcomes])
    panels[0].set_ylim(len(outcomes) - 0.4, -0.6)
    caption(figure, "A point a trial; the bar is the median. Green: an honest filter's mean.")
    return figure


def _percent(trial: Trial) -> float:
    value = trial.figures.get("percent")
    return np.nan if value is None else float(value)


def _orientation_deg(trial: Trial) -> float:
    return float(trial.figures.get("orientation_deg", np.nan))


def _nees_per_axis(trial: Trial) -> float:
    return float(trial.nees["pose"].mean()) / PARTS["pose"] if len(trial.t_ns) else np.nan


def _row_label(outcome: Outcome) -> str:
    failed = sum(outcome.failures.values())
    name = outcome.name.replace(":", ":\n").replace(",", ",\n")
    return f"{name}\n{outcome.flight}" + (f"\n{failed} of {len(outcome.trials)} failed" if failed else "")
