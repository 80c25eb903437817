"""Figures of the errors: over time by axis, and how they grow with the distance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation import ALIGNED_BY, TrajectoryErrors
from vioframe.report.style import caption, colour, legend_above, line
from vioframe.runs.evaluated import Evaluated
from vioframe.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def translation_error(runs: Sequence[Evaluated], band_m: float | None = None) -> Figure:
    """Position error along each axis of the world over time; ``band_m`` shades the range within plus or minus it."""
    names = ("x error [m]", "y error [m]", "z (up) error [m]")
    figure = _over_time(runs, names, lambda errors: errors.position_m, band_m)
    about = f" Shaded: ±{100 * band_m:g} cm." if band_m else ""
    caption(figure, _caption(runs, "Estimate minus ground truth in the world's axes") + about)
    return figure


def rotation_error(runs: Sequence[Evaluated]) -> Figure:
    """Rotation error about each axis of the world over time."""
    names = ("roll error [deg]", "pitch error [deg]", "yaw error [deg]")
    figure = _over_time(runs, names, lambda errors: errors.rotation_rpy_deg, None)
    caption(figure, _caption(runs, "Roll, pitch, yaw about the world's x, y, z"))
    return figure


def relative_error(runs: Sequence[Evaluated]) -> Figure:
    """Boxes of the relative errors by length of the stretch: translation and yaw."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    fixed = any(run.errors.relative for run in runs if run.errors)
    found = [
        {} if run.errors is None else run.errors.relative if fixed else run.errors.relative_by_fraction for run in runs
    ]
    lengths = sorted(set().union(*found))
    figure = Figure(figsize=(10.0, 8.0), layout="constrained")
    panels: Any = figure.subplots(2, 1, sharex=True)
    width = 0.8 / len(runs)
    for i, by_length in enumerate(found):
        places = [k + (i - 0.5 * (len(runs) - 1)) * width for k, length in enumerate(lengths) if length in by_length]
        errors = [by_length[length] for length in lengths if length in by_length]
        for ax, series in zip(
            panels, ([e.translation_percent for e in errors], [e.yaw_deg for e in errors]), strict=True
        ):
            _boxes(ax, series, places, 0.85 * width, colour(i))
    panels[0].set_ylabel("translation error [% of length]")
    panels[1].set_ylabel("yaw error [deg]")
    unit = "length of the stretch [m]" if fixed else "length of the stretch [% of the path]"
    panels[1].set_xlabel(unit)
    panels[1].set_xticks(range(len(lengths)), [f"{length if fixed else 100 * length:g}" for length in lengths])
    for ax in panels:
        ax.set_ylim(bottom=0.0)
        ax.grid(visible=False, axis="x")
    legend_above(figure, [Patch(color=colour(i), label=run.name) for i, run in enumerate(runs) if found[i]])
    caption(figure, "Every pose starts a stretch, aligned at its first pose. Boxes: quartiles; whiskers: 5 to 95 %.")
    return figure


def _over_time(
    runs: Sequence[Evaluated],
    names: Sequence[str],
    series: Callable[[TrajectoryErrors], Float],
    band: float | None,
) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 8.0), layout="constrained")
    panels: Any = figure.subplots(3, 1, sharex=True)
    handles = {}
    for k, (ax, name) in enumerate(zip(panels, names, strict=True)):
        ax.axhline(0.0, color="black", lw=0.8)
        if band:
            ax.axhspan(-band, band, color="#56B4E9", alpha=0.15, lw=0)
        for i, run in enumerate(runs):
            if run.errors:
                # With a NaN at every break, so that no line is drawn where nothing was estimated.
                breaks = run.breaks(run.errors.estimate.t_ns)
                time_s = np.insert(_time_s(run, run.errors), breaks, np.nan)
                values = np.insert(series(run.errors)[:, k], breaks, np.nan)
                handles[i] = ax.plot(time_s, values, **line(i), label=run.name)[0]
        ax.set_ylabel(name)
        ax.margins(x=0.01)
    panels[-1].set_xlabel("time since the ground truth begins [s]")
    figure.align_ylabels(panels)
    legend_above(figure, list(handles.values()))
    return figure


def _time_s(run: Evaluated, errors: TrajectoryErrors) -> Float:
    begin_ns = errors.truth.t_ns[0] if run.ground_truth is None else run.ground_truth.t_ns[0]
    return np.asarray((errors.estimate.t_ns - begin_ns) * 1e-9)


def _boxes(ax: Any, series: list[Float], places: list[float], width: float, face: str) -> None:
    if not series:
        return
    ax.boxplot(
        series,
        positions=places,
        widths=width,
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": face, "edgecolor": face, "alpha": 0.75},
        medianprops={"color": "white", "lw": 2},
        whiskerprops={"color": face},
        capprops={"color": face},
    )


def _caption(runs: Sequence[Evaluated], what: str) -> str:
    how = next(ALIGNED_BY[run.errors.alignment_name] for run in runs if run.errors)
    return f"{what}, aligned by {how} over the whole path."
