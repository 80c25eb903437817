"""Plots of speed and of consistency: frames a second, time by stage, NEES over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation.consistency import PARTS, Trials
from vioframe.report.suite.page_blocks import Case, Plot
from vioframe.report.suite.page_look import BAND_COLOUR, TRUTH_COLOUR, Look, axes, compact, panels, picture
from vioframe.report.suite.results import Data, TaskResult
from vioframe.types import NS_PER_S

if TYPE_CHECKING:
    from plotly.basedatatypes import BaseTraceType

# Lightness tells the stages apart, the hue front-end from back-end.
_FRONT_END = ("#24415e", "#3f6a94", "#6f9bc4", "#a9c8e4", "#d3e3f2")
_BACK_END = (
    *("#7a4a12", "#c9873a", "#ecc48d", "#a0671f", "#dfa863", "#f6e3c9", "#8a6d4d", "#b59a7a", "#d8c6ad", "#5f4326"),
)
_MEASURED = "#0072b2"
_ROW, _FRAME = 34, 90
"""Heights, px: of a row of bars, and of what is around them."""
_LOGARITHMIC_FROM = 4.0
"""A curve that leaves the bounds by this factor makes the axis logarithmic."""


def frames_a_second(task: TaskResult) -> Plot:
    """Points by detector, the fastest on top: measured with its quartiles, and quoted."""
    import plotly.graph_objects as go

    rows = sorted(task.result["rows"], key=lambda row: -float(row["measured"]["fps"]))
    quoted = [row for row in rows if row.get("quoted")]
    fps = [row["measured"]["fps"] for row in rows]
    quartiles = [row["measured"]["fps_quartiles"] for row in rows]
    traces: list[BaseTraceType] = [
        go.Scatter(
            x=[row["quoted"]["fps"] for row in quoted],
            y=[_wrapped(row["detector"]) for row in quoted],
            mode="markers",
            marker={"symbol": "diamond-open", "size": 12, "color": TRUTH_COLOUR, "line": {"width": 2.5}},
            customdata=[row["quoted"]["source"] for row in quoted],
            hovertemplate="%{x:.0f} FPS<br>%{customdata}<extra>quoted</extra>",
            meta={"series": "quoted", "owners": [{"detector": row["detector"]} for row in quoted]},
        ),
        go.Scatter(
            x=fps,
            y=[_wrapped(row["detector"]) for row in rows],
            error_x={
                "type": "data",
                "array": [high - x for x, (_, high) in zip(fps, quartiles, strict=True)],
                "arrayminus": [x - low for x, (low, _) in zip(fps, quartiles, strict=True)],
                "color": _MEASURED,
                "thickness": 2,
                "width": 0,
            },
            mode="markers",
            marker={"size": 12, "color": _MEASURED},
            customdata=[f"{row['measured']['ms']:.2f} ms on {row['measured']['on']}" for row in rows],
            hovertemplate="%{x:.1f} FPS, %{customdata}<extra>measured here</extra>",
            meta={"series": "measured here", "owners": [{"detector": row["detector"]} for row in rows]},
        ),
    ]
    layout = {
        "xaxis": {"title": {"text": "frames a second, logarithmic"}, "type": "log", "dtick": "D2", "tickformat": "~g"},
        "yaxis": {
            "type": "category",
            "categoryorder": "array",
            "categoryarray": [_wrapped(row["detector"]) for row in reversed(rows)],
            "ticks": "",
        },
    }
    return Plot(
        "fps",
        "Frames a second",
        {"all": Case([picture(traces, layout)])},
        "The line through a measured point spans its quartiles. Quoted figures are from other machines.",
        height=_FRAME + _ROW * len(rows),
    )


def stages(means: Mapping[tuple[Data, str, str], Mapping[str, float]], look: Look) -> Plot:
    """Bars of milliseconds a frame by stage, a row a contender; a case for each kind of data."""
    kinds = dict.fromkeys(data for data, _, _ in means)
    by_kind = {
        kind: {(detector, backend): ms for (data, detector, backend), ms in means.items() if data is kind}
        for kind in kinds
    }
    return Plot(
        "stages",
        "Time a frame by stage",
        {str(kind): _stages(spent, look) for kind, spent in by_kind.items()},
        "Mean over all frames and flights. Blue: front-end; brown: back-end.",
        choice="Recordings",
        height=_FRAME + (_ROW + 8) * max(map(len, by_kind.values())),
    )


def nees(found: Sequence[Trials], look: Look, notes: Mapping[str, str]) -> Plot | None:
    """NEES over time, averaged over the trials, within the bounds of an honest filter; a case a flight."""
    judged = [outcome for outcome in found if outcome.nees("pose")]
    flights = dict.fromkeys(outcome.flight for outcome in judged)
    if not judged:
        return None
    return Plot(
        "nees-over-time",
        "NEES over time",
        {
            flight: Case([picture(*_nees([o for o in judged if o.flight == flight], look))], notes.get(flight, ""))
            for flight in flights
        },
        "Mean of the trials at each instant. Green: where 95 % of honest filters' means are. Above it the filter is "
        "surer of itself than it should be.",
        height=600,
        narrow_height=540,
    )


def _stages(spent: Mapping[tuple[str, str], Mapping[str, float]], look: Look) -> Case:
    import plotly.graph_objects as go

    owners = [{"detector": detector, "backend": backend} for detector, backend in spent]
    shades = {False: iter(_FRONT_END * 3), True: iter(_BACK_END * 3)}
    bars = [
        go.Bar(
            x=[each.get(stage, 0.0) for each in spent.values()],
            y=[look.name(*contender) for contender in spent],
            orientation="h",
            marker={"color": next(shades[stage.startswith("backend")])},
            text=[stage.removeprefix("backend.").replace("_", " ")] * len(spent),
            textposition="inside",
            insidetextanchor="middle",
            textangle=0,
            hovertemplate="%{y}: %{x:.2f} ms" + f"<extra>{stage}</extra>",
            meta={"series": stage, "owners": owners},
        )
        for stage in dict.fromkeys(stage for each in spent.values() for stage in each)
    ]
    layout = {
        "barmode": "stack",
        "bargap": 0.3,
        # A name that does not fit is left to the legend.
        "uniformtext": {"minsize": 11, "mode": "hide"},
        "xaxis": {"title": {"text": "time a frame [ms]"}, "rangemode": "tozero"},
        "yaxis": {"autorange": "reversed", "ticks": "", "ticksuffix": "  "},
    }
    return Case([picture(bars, layout)])


def _nees(outcomes: Sequence[Trials], look: Look) -> tuple[list[BaseTraceType], dict[str, Any]]:
    import plotly.graph_objects as go

    layout = panels([f"{part} (ideally {dof})" for part, dof in PARTS.items()], "time since the first frame [s]")
    traces: list[BaseTraceType] = []
    for k, part in enumerate(PARTS):
        averages = {outcome.backend: average for outcome in outcomes if (average := outcome.nees(part))}
        widest = max(averages.values(), key=lambda average: int(average.trials.max()))
        time_s = compact(widest.t_ns / NS_PER_S)
        edge = {"mode": "lines", "line": {"width": 0, "color": BAND_COLOUR}, "hoverinfo": "skip", "opacity": 0.9}
        for bound, fill in ((widest.low, "none"), (widest.high, "tonexty")):
            traces.append(
                go.Scatter(
                    x=time_s,
                    y=compact(bound),
                    fill=fill,
                    fillcolor=f"{BAND_COLOUR}2e",
                    meta={"series": "95 % if honest"} if fill != "none" else {},
                    **edge,
                    **axes(k),
                )
            )
        for backend, average in averages.items():
            traces.append(
                go.Scatter(
                    x=compact(average.t_ns / NS_PER_S),
                    y=compact(average.values),
                    mode="lines",
                    line=look.line(look.detectors[0], backend),
                    hovertemplate=f"%{{y:.2f}} at %{{x:.1f}} s<extra>{backend}</extra>",
                    meta={"series": backend, "backend": backend},
                    **axes(k),
                )
            )
        highest = max(float(average.values.max()) for average in averages.values())
        if highest > _LOGARITHMIC_FROM * widest.mean_band[1]:
            layout[f"yaxis{'' if k == 0 else k + 1}"] |= {
                "type": "log",
                "dtick": 1,
                "tickformat": "~g",
                # The first pose is the gauge, where the error is nothing.
                "range": [np.log10(0.1 * widest.dof), np.log10(1.5 * highest)],
            }
        else:
            layout[f"yaxis{'' if k == 0 else k + 1}"] |= {"rangemode": "tozero"}
    return traces, layout


def _wrapped(name: str) -> str:
    """A detector's name with each of its options on a line of its own."""
    return name.replace(":", ":<br>", 1).replace(",", ",<br>")
