"""Plots that compare contenders: drift by length of the way, and what a condition does as it gets harder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.report.suite.page_blocks import Case, Plot
from vioframe.report.suite.page_flights import Course
from vioframe.report.suite.page_look import Look, axes, panels, picture
from vioframe.report.suite.pooled import RelativePool, pool_relative
from vioframe.report.suite.stress import Curve, Interval, Point
from vioframe.types import Float

if TYPE_CHECKING:
    from plotly.basedatatypes import BaseTraceType


_ROOM = 1.8
"""Factor between the outermost errors and the end of a logarithmic axis."""


def relative_errors(found: Sequence[Course], look: Look) -> Plot | None:
    """Boxes by length of the stretch; None where no flight is long enough for any."""
    pools = [(course, pool_relative(course.groups)) for course in found]
    cases = {course.label: _boxes(course, own, look) for course, own in pools if own}
    if not cases:
        return None
    return Plot(
        "relative",
        "Relative error by length of the stretch",
        cases,
        "Every pose of every seed starts a stretch, aligned at its first pose. "
        "Boxes: quartiles and median; whiskers: 5 to 95 %.",
        height=520,
        narrow_height=480,
    )


def stress_curves(found: Sequence[Curve], look: Look) -> Plot:
    """A picture a condition: the error above, the share of flights that succeeded below, both by level."""
    recordings = dict.fromkeys((curve.sequence, curve.data) for curve in found)
    cases = {}
    for sequence, data in recordings:
        own = [curve for curve in found if (curve.sequence, curve.data) == (sequence, data)]
        conditions = dict.fromkeys(curve.condition for curve in own)
        ate_m = [point.ate_m for curve in own for point in curve.points if point.ate_m is not None]
        pictures = [
            picture(*_stress([curve for curve in own if curve.condition == condition], condition, ate_m, look))
            for condition in conditions
        ]
        cases[f"{sequence} ({data})"] = Case(pictures, own[0].points[0].group.data_note.rstrip(".") + ".")
    return Plot(
        "stress-curves",
        "Error and success by level of the condition",
        cases,
        "Above: geometric mean of the ATE of the flights that have one, with its 95 % confidence band; the scale is "
        "logarithmic, a hollow point flatters as some of its flights have none or are not complete. Below: part of all "
        "flights that succeeded, failed ones counted, with Wilson's 95 % interval.",
        height=520,
        narrow_height=460,
    )


def _boxes(course: Course, pools: Sequence[RelativePool], look: Look) -> Case:
    import plotly.graph_objects as go

    of_path = pools[0].of_path
    unit = "% of the path" if of_path else "m"
    layout = panels(
        ("translation error [% of length]", "yaw error [deg]"), f"length of the stretch [{unit}]", rangemode="tozero"
    )
    lengths = sorted({length for pool in pools for length in pool.stretches})
    names = {length: f"{100 * length if of_path else length:g}" for length in lengths}
    for key in ("xaxis", "xaxis2"):
        layout[key] |= {"type": "category", "categoryorder": "array", "categoryarray": list(names.values())}
    traces: list[BaseTraceType] = []
    for pool in pools:
        contender = pool.group.cell.contender
        colour = look.colour(*contender)
        for k, values in enumerate(("translation_percent", "yaw_deg")):
            five = np.array(
                [np.quantile(getattr(s, values), (0.05, 0.25, 0.5, 0.75, 0.95)) for s in pool.stretches.values()]
            )
            low, first, median, third, high = five.T
            traces.append(
                go.Box(
                    x=[names[length] for length in pool.stretches],
                    lowerfence=low,
                    q1=first,
                    median=median,
                    q3=third,
                    upperfence=high,
                    line={"color": colour, "width": 1.6},
                    fillcolor=_transparent(colour, look.opacity(contender[1])),
                    name=look.name(*contender),
                    offsetgroup=look.name(*contender),
                    hoverinfo="y+name",
                    meta=look.meta(*contender),
                    **axes(k),
                )
            )
    return Case([picture(traces, {**layout, "boxmode": "group", "boxgap": 0.25, "boxgroupgap": 0.3})], course.data_note)


def _stress(
    curves: Sequence[Curve], condition: str, every_ate_m: Sequence[float], look: Look
) -> tuple[list[BaseTraceType], dict[str, Any]]:
    traces: list[BaseTraceType] = []
    for curve in curves:
        having = [point for point in curve.points if point.ate_m is not None]
        ate_m = np.array([point.ate_m for point in having], float)
        traces += _curve(curve, having, ate_m, [point.band for point in having], "ATE {:.3f} m", 0, look)
        success = np.array([100.0 * point.success for point in curve.points])
        bands = [Interval(100.0 * p.success_band.low, 100.0 * p.success_band.high) for p in curve.points]
        traces += _curve(curve, curve.points, success, bands, "{:.0f} % succeeded", 1, look)
    layout = panels(("ATE [m]", "succeeded [%]"), "level", gap=0.09)
    layout["yaxis"] |= {"type": "log", "dtick": "D2", "tickformat": "~g"}
    if every_ate_m:
        # The same for every condition; bands may reach beyond.
        layout["yaxis"] |= {"range": [np.log10(min(every_ate_m) / _ROOM), np.log10(max(every_ate_m) * _ROOM)]}
    layout["yaxis2"] |= {"range": [-4, 104], "tickvals": [0, 50, 100]}
    return traces, {**layout, "title": {"text": condition.replace("_", " "), "x": 0.01, "xanchor": "left"}}


def _curve(
    curve: Curve,
    points: Sequence[Point],
    values: Float,
    bands: Sequence[Interval | None],
    says: str,
    panel: int,
    look: Look,
) -> list[BaseTraceType]:
    import plotly.graph_objects as go

    contender = (curve.detector, curve.backend)
    level = [point.level for point in points]
    shared: dict[str, Any] = {"meta": look.meta(*contender), **axes(panel)}
    line = go.Scatter(
        x=level,
        y=values,
        mode="lines+markers",
        line=look.line(*contender, width=2.2),
        marker={
            "size": 7,
            "color": look.colour(*contender),
            # Hollow where some flights have no error or only that of a part, so that the point flatters.
            "symbol": ["circle" if panel or p.group.all_complete else "circle-open" for p in points],
        },
        customdata=[
            f"{says.format(value)}, seeds: {p.group.seeds_text}" for p, value in zip(points, values, strict=True)
        ],
        hovertemplate=f"level %{{x:g}}: %{{customdata}}<extra>{look.name(*contender)}</extra>",
        **shared,
    )
    known = [(x, band) for x, band in zip(level, bands, strict=True) if band is not None]
    if len(known) < 2:
        return [line]
    area = go.Scatter(
        x=[x for x, _ in known] + [x for x, _ in reversed(known)],
        y=[band.high for _, band in known] + [band.low for _, band in reversed(known)],
        mode="lines",
        fill="toself",
        fillcolor=look.colour(*contender),
        line={"width": 0, "color": look.colour(*contender)},
        opacity=min(0.14, 0.4 / (len(look.detectors) * len(look.backends))),
        hoverinfo="skip",
        **shared,
    )
    return [area, line]


def _transparent(colour: str, opacity: float) -> str:
    """With an alpha, as boxes have none of their own."""
    return f"{colour}{round(255 * opacity):02x}"
