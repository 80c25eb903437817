"""Stress curves: error and success by level, a panel a condition and back-end, with confidence bands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import TYPE_CHECKING, Any

from vioframe.report.suite.captions import data_caption, runs_caption
from vioframe.report.suite.flights import SUCCESS_PERCENT
from vioframe.report.suite.look import Look, explain, legend, log_scale
from vioframe.report.suite.statistics import Group
from vioframe.report.suite.stress import Curve, Interval, Point

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MOST_COLUMNS = 4
_PANEL_INCH = (3.5, 3.1)
_APART = 0.03
"""Curves stand apart by this on the axis of levels, so that equal values do not hide one another."""


def error_curves(curves: Sequence[Curve], found: Sequence[Group]) -> Figure:
    """ATE by level on a logarithmic axis; every flight is a dot."""

    def draw(ax: Any, curve: Curve, shift: float, style: dict[str, Any], marker: str) -> None:
        known = [point for point in curve.points if point.ate_m is not None]
        levels = [point.level + shift for point in known]
        ax.plot(levels, [point.ate_m for point in known], lw=1.8, **style)
        _fill(ax, known, shift, lambda point: point.band, 1.0, style["color"])
        for point in known:
            # Hollow where the mean is not of whole flights alone.
            face = style["color"] if point.group.all_complete else "white"
            ax.plot(point.level + shift, point.ate_m, marker, ms=6, mfc=face, mec=style["color"], zorder=4)
            spread = point.group.spread("ate_m")
            values = spread.values if spread else ()
            ax.plot([point.level + shift] * len(values), values, ".", ms=3.5, color=style["color"], alpha=0.6)
        log_scale(ax)

    figure = _panels(curves, "ATE, position + yaw [m]", draw)
    explain(
        figure,
        "Lines: geometric mean over the seeds; small dots: every flight; bands: 95 % confidence (Student's t in the "
        "logarithm, spread pooled over the levels). Hollow: some flights are not complete, or have no error. "
        f"{_about(found)}",
    )
    return figure


def success_curves(curves: Sequence[Curve], found: Sequence[Group]) -> Figure:
    """Part of all flights that succeeded, by level."""

    def draw(ax: Any, curve: Curve, shift: float, style: dict[str, Any], marker: str) -> None:
        levels = [point.level + shift for point in curve.points]
        ax.plot(levels, [100.0 * point.success for point in curve.points], lw=1.8, **style)
        for point in curve.points:
            ax.plot(point.level + shift, 100.0 * point.success, marker, ms=6, color=style["color"], zorder=4)
            band = point.success_band
            ax.vlines(
                point.level + shift, 100.0 * band.low, 100.0 * band.high, color=style["color"], lw=1.0, alpha=0.45
            )
        ax.set_ylim(-4.0, 104.0)

    figure = _panels(curves, "flights that succeeded [%]", draw)
    explain(
        figure,
        f"Success: complete, with an ATE below {SUCCESS_PERCENT:g} % of the path; failed flights count. Vertical "
        f"lines: Wilson's 95 % interval. {_about(found)}",
    )
    return figure


def _panels(
    curves: Sequence[Curve], name: str, draw: Callable[[Any, Curve, float, dict[str, Any], str], None]
) -> Figure:
    from matplotlib.figure import Figure

    conditions = list(dict.fromkeys(curve.condition for curve in curves))
    look = Look.of([point.group for curve in curves for point in curve.points])
    columns = min(len(conditions), _MOST_COLUMNS)
    blocks = -(-len(conditions) // columns)
    rows = blocks * len(look.backends)
    size = (max(columns * _PANEL_INCH[0], 8.0) + 0.8, rows * _PANEL_INCH[1] + 1.4)
    figure = Figure(figsize=size, layout="constrained")
    panels: Any = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    levels = sorted({point.level for curve in curves for point in curve.points})
    for place, (condition, backend) in enumerate(product(conditions, look.backends)):
        block, column = divmod(place // len(look.backends), columns)
        ax = panels[block * len(look.backends) + place % len(look.backends), column]
        for curve in curves:
            if (curve.condition, curve.backend) == (condition, backend):
                shift = _APART * (look.detectors.index(curve.detector) - 0.5 * (len(look.detectors) - 1))
                style = {"color": look.colour(curve.detector), "ls": look.dashes(backend)}
                draw(ax, curve, shift, style, look.marker(backend))
        ax.set_title(f"{condition.replace('_', ' ')}, {backend}", fontsize=12)
        ax.set_xticks(levels, [f"{level:g}" if level else "clear" for level in levels])
    for ax in panels.flat:
        ax.set_visible(ax.has_data())
    for ax in panels[:, 0]:
        ax.set_ylabel(name)
    for ax in panels[-1]:
        ax.set_xlabel("level of the condition")
    legend(figure, look.handles())
    return figure


def _fill(
    ax: Any, points: Sequence[Point], shift: float, band: Callable[[Point], Interval | None], factor: float, face: str
) -> None:
    shown = [(point.level + shift, interval) for point in points if (interval := band(point)) is not None]
    if shown:
        low, high = ([factor * end for end in ends] for ends in zip(*((i.low, i.high) for _, i in shown), strict=True))
        ax.fill_between([level for level, _ in shown], low, high, color=face, alpha=0.14, lw=0)


def _about(found: Sequence[Group]) -> str:
    counts = sorted({group.count for group in found})
    seeds = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    return f"{seeds} flights a point; {runs_caption(found)} {data_caption(found)}"
