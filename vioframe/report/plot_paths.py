"""Figures of the paths themselves: in three dimensions, from above and from the side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation import ALIGNED_BY
from vioframe.report.style import TRUTH, caption, legend_above, line
from vioframe.runs.evaluated import Evaluated
from vioframe.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AXES = "xyz"
_MARGIN = 0.06
_LONGER_SIDE_INCH = 8.5
_LABELS_INCH = np.array([0.9, 1.3])
_LEGEND_INCH = 7.5


def path_3d(runs: Sequence[Evaluated]) -> Figure:
    """All paths in perspective, to one scale on the three axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.5), layout="constrained")
    ax: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    handles = [ax.plot(*p_W.T, **style)[0] for p_W, style in _paths(runs)]
    low, high = _bounds(runs)
    for axis, lo, hi in zip(_AXES, low, high, strict=True):
        getattr(ax, f"set_{axis}lim")(lo, hi)
        getattr(ax, f"set_{axis}label")(f"{axis} [m]", labelpad=8)
    ax.set_box_aspect(high - low, zoom=1.15)
    ax.locator_params(nbins=6)
    ax.locator_params(axis="z", nbins=4)
    ax.view_init(elev=28, azim=-58)
    _mark_starts(ax, runs)
    legend_above(figure, handles)
    caption(figure, alignment_caption(runs))
    return figure


def path_top(runs: Sequence[Evaluated]) -> Figure:
    """The paths from above, along gravity: y over x."""
    return _projection(runs, 0, 1)


def path_side(runs: Sequence[Evaluated]) -> Figure:
    """The paths from the side: height over x."""
    return _projection(runs, 0, 2)


def _projection(runs: Sequence[Evaluated], across: int, up: int) -> Figure:
    from matplotlib.figure import Figure

    low, high = _bounds(runs)
    size = (high - low)[[across, up]]
    width, height = _LONGER_SIDE_INCH * size / size.max() + _LABELS_INCH
    figure = Figure(figsize=(max(width, _LEGEND_INCH), height), layout="constrained")
    ax: Any = figure.add_subplot()
    handles = [ax.plot(p_W[:, across], p_W[:, up], **style)[0] for p_W, style in _paths(runs)]
    ax.set_aspect("equal")
    ax.set_xlim(low[across], high[across])
    ax.set_ylim(low[up], high[up])
    ax.set_xlabel(f"{_AXES[across]} [m]")
    ax.set_ylabel("z (up) [m]" if up == 2 else f"{_AXES[up]} [m]")
    _mark_starts(ax, runs, across, up)
    legend_above(figure, handles)
    caption(figure, alignment_caption(runs))
    return figure


def alignment_caption(runs: Sequence[Evaluated]) -> str:
    """How the estimates were brought into the frame they are drawn in."""
    errors = [run.errors for run in runs if run.errors]
    if not errors:
        return "No ground truth: each estimate in its own frame. Dots mark the starts."
    return f"Estimates aligned with the ground truth by {ALIGNED_BY[errors[0].alignment_name]}. Dots mark the starts."


def _paths(runs: Sequence[Evaluated]) -> list[tuple[Float, dict[str, Any]]]:
    """Positions (N, 3) m and line style: the ground truth of every flight below, the estimates above it."""
    truths = {run.ground_truth.t_ns.tobytes(): run.ground_truth for run in runs if run.errors and run.ground_truth}
    below = [(truth.p_WB, {**TRUTH, "zorder": 2}) for truth in truths.values()]
    return below + [(_drawn(run), {**line(i), "label": run.name, "zorder": 3 + i}) for i, run in enumerate(runs)]


def _drawn(run: Evaluated) -> Float:
    """The whole estimate (N, 3), also where the ground truth does not reach; in its frame where there is one.

    NaN between segments, so that no line joins them.
    """
    if run.estimate is None:
        return np.empty((0, 3))
    drawn = run.errors.alignment.apply(run.estimate) if run.errors else run.estimate
    return np.insert(drawn.p_WB, run.breaks(drawn.t_ns), np.nan, axis=0)


def _bounds(runs: Sequence[Evaluated]) -> tuple[Float, Float]:
    """Corners (3,) of a box around everything, with a margin, and not flat."""
    points = np.concatenate([p_W for p_W, _ in _paths(runs)])
    low, high = (np.nanmin(points, axis=0), np.nanmax(points, axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    size = max(float((high - low).max()), 1e-3)
    thin = np.maximum(0.12 * size - (high - low), 0.0) / 2.0
    return low - thin - _MARGIN * size, high + thin + _MARGIN * size


def _mark_starts(ax: Any, runs: Sequence[Evaluated], *axes: int) -> None:
    for i, run in enumerate(runs):
        start = _drawn(run)[:1, axes or (0, 1, 2)]
        ax.plot(*start.T, "o", ms=6, color=line(i)["color"], zorder=10 + i)
