"""Plots of single flights: the paths in 3-D, and the errors over time. A picture a recording and condition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation import ALIGNED_BY, TrajectoryErrors
from vioframe.report.suite.page_blocks import Case, Plot
from vioframe.report.suite.page_look import BAND_COLOUR, TRUTH_COLOUR, Look, axes, compact, panels, picture
from vioframe.report.suite.pooled import BAND_M
from vioframe.report.suite.statistics import CLEAR, Group, by_course
from vioframe.runs.evaluated import Evaluated
from vioframe.types import NS_PER_S, Float

if TYPE_CHECKING:
    from plotly.basedatatypes import BaseTraceType

_POINTS, _POINTS_LEAST, _POINTS_IN_ALL = 2000, 300, 30_000
_AXES = ("x", "y", "z (up)")
_ANGLES = ("roll", "pitch", "yaw")
_TIME = "time since the estimate begins [s]"


@dataclass(frozen=True)
class Line:
    """A group's flight as it is drawn: at the poses ``shown``, of which no line leads to those in ``breaks``."""

    group: Group
    errors: TrajectoryErrors
    shown: np.ndarray
    breaks: np.ndarray

    @classmethod
    def of(cls, group: Group, points: int) -> Line | None:
        """Of the flight with the median error; None where none has any."""
        flight = group.median_flight()
        if flight is None or (errors := flight.task.errors) is None or (run := flight.task.run) is None:
            return None
        whole = Evaluated(run.name, run, None, None, errors, segment_starts_ns=run.segment_starts_ns())
        count, breaks = len(errors.estimate), whole.breaks(errors.estimate.t_ns)
        # What is before and after a break stays, however few of the others do.
        evenly = np.linspace(0, count - 1, min(count, points)).astype(np.int64)
        shown = np.unique(np.concatenate([evenly, breaks, breaks - 1]))
        return cls(group, errors, shown, np.searchsorted(shown, breaks))

    def values(self, values: Float) -> Float:
        """``values`` (N, ...) at what is shown, with NaN where the line breaks."""
        return compact(np.insert(values[self.shown], self.breaks, np.nan, axis=0))

    def time_s(self, begin_ns: int) -> Float:
        return self.values((self.errors.estimate.t_ns - begin_ns) / NS_PER_S)


@dataclass(frozen=True)
class Course:
    """All contenders on one recording and condition: ``lines`` are those that can be drawn."""

    label: str
    groups: Sequence[Group]
    lines: Sequence[Line]

    @property
    def begin_ns(self) -> int:
        return min(int(line.errors.estimate.t_ns[0]) for line in self.lines)

    @property
    def data_note(self) -> str:
        """What the data was."""
        return self.groups[0].data_note.rstrip(".") + "."

    @property
    def note(self) -> str:
        """The same, which seed is drawn of how many, and who has no line."""
        seeds = max(group.count for group in self.groups)
        parts = [self.data_note]
        if seeds > 1:
            one = "one with the larger" if seeds == 2 else "one with the median"
            parts.append(f"Of {seeds} seeds the {one} error is drawn.")
        drawn = {line.group.cell for line in self.lines}
        if missing := [group.cell for group in self.groups if group.cell not in drawn]:
            names = ", ".join(f"{cell.detector} with {cell.backend}" for cell in missing)
            parts.append(f"Without any pose to draw: {names}.")
        return " ".join(parts)


def courses(groups: Sequence[Group]) -> list[Course]:
    """Those on which there is something to draw."""
    points = max(_POINTS_LEAST, min(_POINTS, _POINTS_IN_ALL // max(1, len(groups))))
    found = []
    for (data, sequence, condition, level), members in by_course(groups):
        lines = [line for group in members if (line := Line.of(group, points)) is not None]
        where = sequence if condition == CLEAR else f"{sequence}, {condition.replace('_', ' ')} {level:g}"
        if lines:
            found.append(Course(f"{where} ({data})", members, lines))
    return found


def paths(found: Sequence[Course], look: Look) -> Plot:
    """The estimates, aligned, above the broad grey line of the truth; to be turned by hand."""
    return Plot(
        "paths",
        "Trajectories",
        {course.label: _paths(course, look) for course in found},
        f"Each estimate is aligned with the ground truth by {_how(found)} over the whole flight, "
        "never scaled. Drag to turn; the toolbar has zoom and pan.",
        height=560,
        narrow_height=400,
        views=True,
    )


def translation_errors(found: Sequence[Course], look: Look) -> Plot:
    """Over time along each axis of the world, with the band of the thesis."""
    return Plot(
        "translation",
        "Translation error by axis",
        {course.label: _errors(course, look, lambda e: e.position_m, _AXES, "m", BAND_M) for course in found},
        f"Estimate minus ground truth in the world's axes, aligned by {_how(found)}. "
        f"The green band is ±{100 * BAND_M:g} cm.",
        height=560,
        narrow_height=520,
    )


def rotation_errors(found: Sequence[Course], look: Look) -> Plot:
    return Plot(
        "rotation",
        "Rotation error",
        {course.label: _errors(course, look, lambda e: e.rotation_rpy_deg, _ANGLES, "deg", None) for course in found},
        f"About the world's x, y and z axes, aligned by {_how(found)}.",
        height=560,
        narrow_height=520,
    )


def _paths(course: Course, look: Look) -> Case:
    import plotly.graph_objects as go

    longest = max(course.lines, key=lambda line: line.errors.truth.path_length_m)
    x, y, z = longest.values(longest.errors.truth.p_WB).T
    grey = {"color": TRUTH_COLOUR, "width": 9}
    traces: list[BaseTraceType] = [
        go.Scatter3d(
            x=x, y=y, z=z, mode="lines", line=grey, hoverinfo="skip", opacity=0.6, meta={"series": "ground truth"}
        )
    ]
    for line in course.lines:
        cell = line.group.cell
        x, y, z = line.values(line.errors.estimate.p_WB).T
        traces.append(
            go.Scatter3d(
                x=x,
                y=y,
                z=z,
                mode="lines",
                line=look.line(*cell.contender, width=4),
                customdata=line.time_s(course.begin_ns),
                hovertemplate="(%{x:.2f}, %{y:.2f}, %{z:.2f}) m at %{customdata:.1f} s"
                f"<extra>{look.name(*cell.contender)}</extra>",
                meta=look.meta(*cell.contender),
            )
        )
    scene = {"aspectmode": "data", **{f"{axis}axis": {"title": {"text": f"{axis} [m]"}} for axis in "xyz"}}
    return Case([picture(traces, {"scene": scene, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}})], course.note)


def _errors(
    course: Course,
    look: Look,
    series: Callable[[TrajectoryErrors], Float],
    names: Sequence[str],
    unit: str,
    band: float | None,
) -> Case:
    import plotly.graph_objects as go

    # The band's edges are in sight, however small the errors are.
    least: dict[str, Any] = {} if band is None else {"autorangeoptions": {"include": [-1.2 * band, 1.2 * band]}}
    layout: dict[str, Any] = panels([f"{name} [{unit}]" for name in names], _TIME, **least)
    if band is not None:
        layout["shapes"] = [_band(k, band) for k in range(len(names))]
    traces = []
    for line in course.lines:
        cell = line.group.cell
        time_s, values = line.time_s(course.begin_ns), line.values(series(line.errors))
        for k in range(len(names)):
            traces.append(
                go.Scatter(
                    x=None if k else time_s,
                    y=values[:, k],
                    mode="lines",
                    line=look.line(*cell.contender),
                    hovertemplate=f"%{{y:.3f}} {unit} at %{{x:.1f}} s<extra>{look.name(*cell.contender)}</extra>",
                    meta={**look.meta(*cell.contender), "x_back": k},
                    **axes(k),
                )
            )
    return Case([picture(traces, layout)], course.note)


def _band(k: int, half_width: float) -> dict[str, Any]:
    suffix = "" if k == 0 else str(k + 1)
    return {
        "type": "rect",
        "xref": f"x{suffix} domain",
        "yref": f"y{suffix}",
        "x0": 0,
        "x1": 1,
        "y0": -half_width,
        "y1": half_width,
        "fillcolor": BAND_COLOUR,
        "opacity": 0.13,
        "line": {"width": 0},
        "layer": "below",
    }


def _how(found: Sequence[Course]) -> str:
    names = dict.fromkeys(line.errors.alignment_name for course in found for line in course.lines)
    return " or ".join(ALIGNED_BY[name] for name in names)
