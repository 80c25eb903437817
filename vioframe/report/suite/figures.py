"""The figures that a suite's results have data for, each described once, in Plotly's terms.

The page draws them with Plotly (:mod:`.page`), files are drawn from the same traces and layouts with matplotlib
(:mod:`.drawing`). A trace's ``meta`` says whose it is: ``series`` is its entry in the legend, ``detector`` and
``backend`` by which the page's filters hide it and by which files have a column a back-end; or ``owners``, one of
those a point, where the points of a trace have several. ``note`` is a figure of the trace itself, such as its RMSE;
``x_back`` how many traces before it the one is that has its x, which is then not stored again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from vioframe.evaluation import ALIGNED_BY, TrajectoryErrors
from vioframe.evaluation.consistency import PARTS, AverageNees
from vioframe.evaluation.metrics import rotation_error_deg
from vioframe.evaluation.nees import band
from vioframe.report import style
from vioframe.report.suite.statistics import (
    CONTENDER,
    COURSE,
    SUCCESS_PERCENT,
    Study,
    condition_text,
    curves,
    data_caption,
    groups,
    inside_band,
    median_flight,
    relative_errors,
    seeds_text,
    stage_means,
)
from vioframe.report.suite.tables import speed_caption
from vioframe.runs.evaluated import Evaluated
from vioframe.runs.results import CLEAR
from vioframe.types import NS_PER_S, Float, Int

TRUTH_COLOUR = str(style.TRUTH["color"])
BAND_COLOUR = "#009e73"
"""Of the range that errors are meant to stay in: no detector's, as it is only ever drawn as an area."""
DASHES = ("solid", "dash", "dot", "dashdot")
_FILLS = (0.85, 0.25, 0.5, 0.1)
_SYMBOLS = ("circle", "square", "triangle-up", "diamond")
# Lightness tells the stages apart, the hue front-end from back-end.
_FRONT_END = ("#24415e", "#3f6a94", "#6f9bc4", "#a9c8e4", "#d3e3f2")
_BACK_END = (
    *("#7a4a12", "#c9873a", "#ecc48d", "#a0671f", "#dfa863", "#f6e3c9", "#8a6d4d", "#b59a7a", "#d8c6ad", "#5f4326"),
)
_POINTS, _POINTS_LEAST, _POINTS_IN_ALL = 2000, 300, 30_000
_ROW, _FRAME = 34, 90
"""Heights, px: of a row of bars, and of what is around them."""
_LOGARITHMIC_FROM = 4.0
"""NEES that leaves its bounds by this factor makes the axis logarithmic."""
_ROOM = 1.8
"""Factor between the outermost errors and the end of a logarithmic axis."""
_TIME = "time since the estimate begins [s]"
_LOG = {"type": "log", "dtick": "D2", "tickformat": "~g"}

Trace = dict[str, Any]
Layout = dict[str, Any]


@dataclass(frozen=True)
class Case:
    """One of the things that a figure can show: pictures, traces with their layout, side by side with one legend.

    ``files`` is what stands before the figure's name in those of its files, None where there are none.
    """

    pictures: Sequence[tuple[Sequence[Trace], Layout]]
    caption: str = ""
    files: str | None = ""


@dataclass(frozen=True)
class Figure:
    """A figure with a case for each choice of the reader. Heights are in px, ``narrow_height`` is for phones.

    ``views`` is for paths in 3-D, which are to be seen from above and from the side as well.
    """

    name: str
    title: str
    cases: Mapping[str, Case]
    caption: str = ""
    choice: str = "Flight"
    height: int = 460
    narrow_height: int = 0
    views: bool = False


@dataclass(frozen=True)
class Look:
    """Contenders in the order of the suite, and what tells them apart, in every figure alike.

    The colour says which detector it is, or which back-end where there is one detector alone; the kind of line, which
    back-end.
    """

    detectors: tuple[str, ...]
    backends: tuple[str, ...]

    @classmethod
    def of(cls, study: Study) -> Look:
        known = study.flights[study.flights["data"].notna()]
        known = study.trials if known.empty else known
        return cls(tuple(known["detector"].unique()), tuple(known["backend"].unique()))

    def colour(self, detector: str, backend: str) -> str:
        one = len(self.detectors) < 2
        return style.colour(self.backends.index(backend) if one else self.detectors.index(detector)).lower()

    def line(self, detector: str, backend: str, width: float = 1.8) -> dict[str, Any]:
        dash = DASHES[0 if len(self.detectors) < 2 else self.backends.index(backend) % len(DASHES)]
        return {"color": self.colour(detector, backend), "dash": dash, "width": width}

    def symbol(self, backend: str) -> str:
        return _SYMBOLS[self.backends.index(backend) % len(_SYMBOLS)]

    def fill(self, detector: str, backend: str) -> str:
        """A colour with an opacity, for areas that have no dashes to tell back-ends apart by."""
        opacity = _FILLS[self.backends.index(backend) % len(_FILLS)]
        return f"{self.colour(detector, backend)}{round(255 * opacity):02x}"

    def name(self, detector: str, backend: str) -> str:
        """In legends and tables; what all contenders share is left out."""
        if len(self.detectors) < 2:
            return backend
        return detector if len(self.backends) < 2 else f"{detector} · {backend}"

    def meta(self, detector: str, backend: str, **more: Any) -> dict[str, Any]:
        return {"series": self.name(detector, backend), "detector": detector, "backend": backend, **more}


def figures(study: Study) -> list[Figure]:
    """All that there is data for, with the numbers that somebody else has for them where the reference says so."""
    look, quoted = Look.of(study), study.results.reference.figures
    found = [figure for make in _FIGURES if (figure := make(study, look)) is not None and figure.cases]
    return [replace(f, title=f"{quoted[f.name].title}: {f.title}") if f.name in quoted else f for f in found]


# Flights: paths, and errors over time ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Line:
    """A contender's flight as it is drawn: that of the median ATE."""

    detector: str
    backend: str
    errors: TrajectoryErrors
    run: Evaluated
    points: int

    def shown(self, t_ns: Int, values: Float) -> Float:
        """``values`` (N, ...) at the stamps (N,), at no more than so many, with NaN wherever no line must be drawn."""
        breaks = self.run.breaks(t_ns)
        # What is before and after a break stays, however few of the others do.
        evenly = np.linspace(0, len(t_ns) - 1, min(len(t_ns), self.points)).astype(np.int64)
        kept = np.unique(np.concatenate([evenly, breaks, breaks - 1]))
        with_gaps = np.insert(np.asarray(values, float)[kept], np.searchsorted(kept, breaks), np.nan, axis=0)
        # As many digits as a screen can show, in half of the page's bytes.
        return np.asarray(with_gaps, np.float32)


@dataclass(frozen=True)
class _Course:
    """All contenders on one recording and condition; ``files`` as in :class:`Case`."""

    label: str
    lines: Sequence[_Line]
    note: str
    files: str | None

    @property
    def begin_ns(self) -> int:
        """The first estimate of any: whoever began later stays behind."""
        return min(int(line.errors.estimate.t_ns[0]) for line in self.lines)

    def case(self, traces: Sequence[Trace], layout: Layout, *, of_many: bool = False) -> Case:
        """``of_many`` is for what has files of each recording where there are several."""
        return Case([(traces, layout)], self.note, self.files if of_many or not self.files else None)


def _courses(study: Study) -> list[_Course]:
    """Those on which there is something to draw."""
    flights = study.flights
    points = max(_POINTS_LEAST, min(_POINTS, _POINTS_IN_ALL // max(1, flights.groupby([*COURSE, *CONTENDER]).ngroups)))
    several = flights[flights["condition"] == CLEAR].groupby(COURSE).ngroups > 1
    found = []
    for (data, sequence, condition, level), here in groups(flights, COURSE):
        lines, missing = [], []
        for (detector, backend), own in groups(here, CONTENDER):
            flight = median_flight(own)
            errors, run = (None, None) if flight is None else (study.errors(flight), study.run(flight))
            if errors is None or run is None:
                missing.append(f"{detector} with {backend}")
            else:
                whole = Evaluated(run.name, run, None, None, errors, segment_starts_ns=run.segment_starts_ns())
                lines.append(_Line(detector, backend, errors, whole, points))
        seeds = here.groupby(CONTENDER).size().max()
        of_two = "one with the larger" if seeds == 2 else "one with the median"
        notes = [_note(here)]
        notes += [f"Of {seeds} seeds the {of_two} error is drawn."] if seeds > 1 else []
        notes += [f"Without any pose to draw: {', '.join(missing)}."] if missing else []
        where = sequence if condition == CLEAR else f"{sequence}, {condition_text(condition, level).replace('_', ' ')}"
        files = None if study.is_stress else _file_name(f"{sequence}_{data}_") if several else ""
        if lines:
            found.append(_Course(f"{where} ({data})", lines, " ".join(notes), files))
    return found


def _trajectories_3d(study: Study, look: Look) -> Figure:
    cases = {}
    for course in _courses(study):
        longest = max(course.lines, key=lambda line: line.errors.truth.path_length_m)
        grey = {"color": TRUTH_COLOUR, "width": 9}
        traces = [_path(longest, longest.errors.truth.p_WB, grey, {"series": "ground truth"}, opacity=0.6)]
        for line in course.lines:
            meta = look.meta(line.detector, line.backend)
            t_ns = line.errors.estimate.t_ns
            hover = f"(%{{x:.2f}}, %{{y:.2f}}, %{{z:.2f}}) m at %{{customdata:.1f}} s<extra>{meta['series']}</extra>"
            time = {"customdata": line.shown(t_ns, (t_ns - course.begin_ns) / NS_PER_S), "hovertemplate": hover}
            own = look.line(line.detector, line.backend, width=4)
            traces.append(_path(line, line.errors.estimate.p_WB, own, meta, **time))
        scene = {"aspectmode": "data", **{f"{axis}axis": {"title": {"text": f"{axis} [m]"}} for axis in "xyz"}}
        layout = {"scene": scene, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}}
        cases[course.label] = course.case(traces, layout, of_many=True)
    about = f"Each estimate is aligned with the ground truth by {_how(study)} over the whole flight, never scaled."
    heights: dict[str, Any] = {"height": 560, "narrow_height": 400}
    return Figure("trajectories_3d", "Trajectories", cases, about, views=True, **heights)


def _path(line: _Line, p_W: Float, look: Mapping[str, Any], meta: Mapping[str, Any], **more: Any) -> Trace:
    x, y, z = line.shown(line.errors.estimate.t_ns, p_W).T
    more = {"hoverinfo": "skip"} | more if "hovertemplate" not in more else more
    return {"type": "scatter3d", "x": x, "y": y, "z": z, "mode": "lines", "line": look, "meta": meta, **more}


_Series = Callable[[TrajectoryErrors], Sequence[tuple[Int, Float, str]]]
"""Stamps (N,), values (N,) and a note of each panel; none where an estimate has none."""


def _over_time(
    study: Study, look: Look, name: str, panel_titles: Sequence[str], series: _Series, half_width: float = 0.0
) -> Figure:
    """What there is of each flight over time, a panel each; the ``half_width`` of a band about zero is shaded."""
    cases = {}
    for course in _courses(study):
        traces: list[Trace] = []
        for line in course.lines:
            found = series(line.errors)
            for k, (t_ns, values, note) in enumerate(found):
                meta = look.meta(line.detector, line.backend, note=note, x_back=k)
                time_s = line.shown(t_ns, (t_ns - course.begin_ns) / NS_PER_S)
                said = f"%{{y:.3f}} at %{{x:.1f}} s{f', {note}' if note else ''}<extra>{meta['series']}</extra>"
                own = {"line": look.line(line.detector, line.backend), "hovertemplate": said}
                shown = {"x": None if k else time_s, "y": line.shown(t_ns, values)}
                traces.append({"type": "scatter", "mode": "lines", **shown, **own, "meta": meta, **_axes(k)})
        # The band's edges are in sight, however small the errors are.
        least: dict[str, Any] = (
            {"autorangeoptions": {"include": [-1.2 * half_width, 1.2 * half_width]}} if half_width else {}
        )
        layout = _panels(panel_titles, _TIME, **least)
        if half_width:
            layout["shapes"] = [_shaded(k, -half_width, half_width) for k in range(len(panel_titles))]
        if traces:
            cases[course.label] = course.case(traces, layout, of_many=name == "translation_error_per_axis")
    return Figure(name, "", cases, height=180 * len(panel_titles) + 20, narrow_height=520)


def _translation_error(study: Study, look: Look) -> Figure:
    band = study.results.reference.band
    half_width = band.half_width_m if band else 0.0

    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        share = inside_band(errors, half_width)
        notes = [f"{share[axis]:.1f} % inside" if band else "" for axis in "xyz"]
        return [(errors.estimate.t_ns, errors.position_m[:, k], notes[k]) for k in range(3)]

    titles = [f"{axis} [m]" for axis in ("x", "y", "z (up)")]
    figure = _over_time(study, look, "translation_error_per_axis", titles, series, half_width)
    shaded = f" Shaded: ±{100 * half_width:g} cm, beside how much of the estimated time is inside." if band else ""
    about = f"Estimate minus ground truth in the world's axes, aligned by {_how(study)} over the whole path.{shaded}"
    return replace(figure, title="Translation error by axis", caption=about)


def _rotation_error(study: Study, look: Look) -> Figure:
    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        return [(errors.estimate.t_ns, errors.rotation_rpy_deg[:, k], "") for k in range(3)]

    figure = _over_time(study, look, "rotation_error", [f"{angle} [deg]" for angle in ("roll", "pitch", "yaw")], series)
    about = f"Roll, pitch, yaw about the world's x, y, z, aligned by {_how(study)} over the whole path."
    return replace(figure, title="Rotation error", caption=about)


def _comparison(study: Study, look: Look) -> Figure:
    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        t_ns, metres = errors.estimate.t_ns, np.asarray(np.linalg.norm(errors.position_m, axis=1))
        degrees = rotation_error_deg(errors.estimate, errors.truth)
        sizes = ((metres, errors.ate_m.rmse, "m"), (degrees, errors.orientation_deg.rmse, "deg"))
        return [(t_ns, values, f"RMSE {rmse:.3g} {unit}") for values, rmse, unit in sizes]

    titles = ("translation error [m]", "rotation error [deg]")
    figure = _over_time(study, look, "comparison", titles, series)
    about = f"Distance from the truth and angle to it, aligned by {_how(study)} over the whole path."
    return replace(figure, title="Size of the errors", caption=about)


def _nees_of_flights(study: Study, look: Look) -> Figure:
    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        # The first instants are the gauge's own, without error, and nothing to a logarithmic axis.
        notes = [f"mean {each.mean:.3g}, {100 * each.inside:.0f} % inside" for each in errors.nees]
        return [(n.t_ns, np.maximum(n.values, 1e-3), note) for n, note in zip(errors.nees, notes, strict=True)]

    titles = [f"{part} (ideally {dof})" for part, dof in PARTS.items()]
    figure = _over_time(study, look, "nees", titles, series)
    for case in figure.cases.values():
        layout = case.pictures[0][1]
        layout["shapes"] = [_shaded(k, *band(dof)) for k, dof in enumerate(PARTS.values())]
        for k, dof in enumerate(PARTS.values()):
            layout[_axis("y", k)] |= {"type": "log", "dtick": 1, "tickformat": "~g", "minallowed": np.log10(0.03 * dof)}
    about = (
        "Shaded: 95 % of the instants of an honest filter; above, the filter is surer of itself than it should be. "
        "Position and yaw fixed at the first pose. Errors within a flight hang together: no test at a level."
    )
    return replace(figure, title="NEES of the flights over time", caption=about)


def _how(study: Study) -> str:
    names = dict.fromkeys(each.alignment_name for each in study._errors.values() if each is not None)
    return " or ".join(ALIGNED_BY[name] for name in names) or ALIGNED_BY["posyaw"]


# Contenders compared --------------------------------------------------------------------------------------------------


def _relative_error(study: Study, look: Look) -> Figure:
    """Boxes by length of the stretch."""
    cases = {}
    for course, (_, here) in zip(_courses(study), _drawable(study), strict=True):
        stretches = relative_errors(study, here)
        if stretches.empty:
            continue
        of_path = bool(stretches["of_path"].iloc[0])
        names = {length: f"{100 * length if of_path else length:g}" for length in sorted(stretches["length"].unique())}
        titles = ("translation error [% of length]", "yaw error [deg]")
        unit = "% of the path" if of_path else "m"
        layout = _panels(titles, f"length of the stretch [{unit}]", rangemode="tozero")
        for k in range(2):
            layout[_axis("x", k)] |= _category(list(names.values()))
        traces = []
        for (detector, backend), own in groups(stretches, CONTENDER):
            for k, column in enumerate(("translation_percent", "yaw_deg")):
                five = own.groupby("length")[column].quantile(np.array([0.05, 0.25, 0.5, 0.75, 0.95])).unstack()
                keys = ("lowerfence", "q1", "median", "q3", "upperfence")
                series = look.name(detector, backend)
                colour = {"color": look.colour(detector, backend), "width": 1.6}
                box = {"type": "box", "x": [names[length] for length in five.index], "line": colour}
                box |= dict(zip(keys, five.to_numpy().T, strict=True)) | {"fillcolor": look.fill(detector, backend)}
                box |= {"name": series, "offsetgroup": series, "hoverinfo": "y+name"}
                traces.append({**box, "meta": look.meta(detector, backend), **_axes(k)})
        layout |= {"boxmode": "group", "boxgap": 0.25, "boxgroupgap": 0.3}
        cases[course.label] = course.case(traces, layout, of_many=True)
    about = (
        "Every pose of every seed starts a stretch, aligned at its first pose; stretches overlap. Boxes: quartiles and "
        "median; whiskers: 5 to 95 %."
    )
    heights: dict[str, Any] = {"height": 520, "narrow_height": 480}
    return Figure("relative_error", "Relative error by length of the stretch", cases, about, **heights)


def _drawable(study: Study) -> Iterator[tuple[Any, pd.DataFrame]]:
    for key, here in groups(study.flights, COURSE):
        if any(study.errors(f) is not None for _, own in groups(here, CONTENDER) if (f := median_flight(own))):
            yield key, here


def _ate_by_sequence(study: Study, look: Look) -> Figure | None:
    """ATE of every flight by recording, on a logarithmic axis."""
    found = study.flights[(study.flights["condition"] == CLEAR) & study.flights["data"].notna()]
    recordings = [f"{sequence}<br>{data}" for (data, sequence), _ in groups(found, ("data", "sequence"))]
    if study.is_stress or len(recordings) < 2 or not found["evaluated"].any():
        return None
    top = _ROOM * found["ate_m"].max()
    traces: list[Trace] = []
    for (detector, backend), own in groups(found, CONTENDER):
        where = own["sequence"] + "<br>" + own["data"].astype(str)
        series, colour = look.name(detector, backend), look.colour(detector, backend)
        shared = {"type": "scatter", "meta": look.meta(detector, backend), "offsetgroup": series, "name": series}
        means = own.groupby(where, sort=False)["ate_m"].mean().dropna()
        missing = (~own["evaluated"]).groupby(where, sort=False).sum().loc[lambda n: n > 0]
        dots = {"size": 8, "symbol": f"{look.symbol(backend)}-open", "color": colour, "line": {"width": 1.6}}
        bars = {"size": 16, "symbol": "line-ew", "color": colour, "line": {"width": 3, "color": colour}}
        hover = {"hovertemplate": f"%{{y:.3f}} m<extra>{series}</extra>"}
        traces += [
            {**shared, "x": where.tolist(), "y": own["ate_m"].tolist(), "mode": "markers", "marker": dots, **hover},
            {**shared, "x": list(means.index), "y": means.tolist(), "mode": "markers", "marker": bars, **hover},
        ]
        if len(missing):
            said = {"text": [f"✗{n}" for n in missing], "textfont": {"color": colour}, "hoverinfo": "skip"}
            traces.append({**shared, "x": list(missing.index), "y": [top] * len(missing), "mode": "text", **said})
    layout = {
        "xaxis": _category(recordings),
        "yaxis": {"title": {"text": "ATE, position + yaw [m]"}, **_LOG},
        "scattermode": "group",
    }
    about = "A mark a flight; the bar is their mean; ✗: flights without an error to show."
    return Figure("ate_by_sequence", "ATE by sequence", {"all": Case([(traces, layout)], data_caption(found))}, about)


def _stress(study: Study, look: Look) -> Figure | None:
    """A picture a condition: the error above, the share of flights that succeeded below, both by level."""
    if not study.is_stress:
        return None
    cases, points = {}, curves(study.flights)
    recordings = list(groups(points, ("sequence", "data")))
    for (sequence, data), here in recordings:
        known = here["ate_m"].dropna()
        pictures = []
        for condition, own in groups(here, ("condition",)):
            layout = _panels(("ATE [m]", "succeeded [%]"), "level", gap=0.09)
            layout["yaxis"] |= _LOG
            if len(known):
                # The same for every condition; bands may reach beyond.
                layout["yaxis"] |= {"range": [np.log10(known.min() / _ROOM), np.log10(known.max() * _ROOM)]}
            layout["yaxis2"] |= {"range": [-4, 104], "tickvals": [0, 50, 100]}
            layout["title"] = {"text": condition[0].replace("_", " "), "x": 0.01, "xanchor": "left"}
            traces = [trace for who, curve in groups(own, CONTENDER) for trace in _curve(curve, who, look)]
            pictures.append((traces, layout))
        files = "" if len(recordings) == 1 else _file_name(f"{sequence}_{data}_")
        cases[f"{sequence} ({data})"] = Case(pictures, _note(here["flights"].iloc[0]), files)
    about = (
        "Above: geometric mean of the ATE of the flights that have one, small dots, with its 95 % confidence band; a "
        "hollow point flatters as some of its flights have none or are not complete. Below: part of all "
        f"flights that succeeded, complete with an ATE below {SUCCESS_PERCENT:g} % of the path, failed ones counted, "
        "with Wilson's 95 % interval."
    )
    heights: dict[str, Any] = {"height": 520, "narrow_height": 460}
    return Figure("stress", "Error and success by level of the condition", cases, about, **heights)


def _curve(curve: pd.DataFrame, contender: tuple[str, str], look: Look) -> list[Trace]:
    detector, backend = contender
    percent = curve.assign(**{c: 100.0 * curve[c] for c in ("success", "success_low", "success_high")})
    columns = (
        ("ate_m", "low", "high", "ATE {:.3f} m"),
        ("success", "success_low", "success_high", "{:.0f} % succeeded"),
    )
    traces = []
    for k, (value, low, high, says) in enumerate(columns):
        known = percent[percent[value].notna()]
        shared = {"type": "scatter", "meta": look.meta(detector, backend), **_axes(k)}
        colour = look.colour(detector, backend)
        banded = known[known[low].notna()]
        if len(banded) > 1:
            faint = min(0.14, 0.4 / (len(look.detectors) * len(look.backends)))
            traces.append({**shared, **_area(banded["level"], banded[low], banded[high], colour, faint)})
        whole = [bool(own["complete"].all()) for own in known["flights"]]
        said = [
            f"{says.format(v)}, seeds: {seeds_text(own)}" for v, own in zip(known[value], known["flights"], strict=True)
        ]
        line = {"mode": "lines+markers", "line": look.line(detector, backend, width=2.2), "customdata": said}
        hollow = ["circle" if k or each else "circle-open" for each in whole]
        line |= {"x": known["level"].tolist(), "y": known[value].tolist()}
        line |= {"marker": {"size": 7, "color": colour, "symbol": hollow}}
        hover = f"level %{{x:g}}: %{{customdata}}<extra>{look.name(detector, backend)}</extra>"
        traces.append({**shared, **line, "hovertemplate": hover})
        if not k:
            single = pd.concat(list(known["flights"])).dropna(subset="ate_m")
            dots = {"x": single["level"].tolist(), "y": single["ate_m"].tolist(), "hoverinfo": "skip", "opacity": 0.6}
            traces.append({**shared, **dots, "mode": "markers", "marker": {"size": 4, "color": colour}})
    return traces


# Speed, and trials ----------------------------------------------------------------------------------------------------


def _detector_fps(study: Study, look: Look) -> Figure | None:
    """Points by detector, the fastest on top: measured with its quartiles, and quoted."""
    measured = study.speeds[study.speeds["status"] == "ok"]
    if measured.empty:
        return None
    reference = study.results.reference.speed
    speeds = reference.detectors if reference else {}
    quoted = {name: speeds[base] for name in measured["detector"] if (base := name.partition(":")[0]) in speeds}
    blue = style.colour(0).lower()
    ends = {"array": measured["fps_high"] - measured["fps"], "arrayminus": measured["fps"] - measured["fps_low"]}
    traces: list[Trace] = [
        {
            "type": "scatter",
            "mode": "markers",
            "x": measured["fps"].tolist(),
            "y": [_wrapped(name) for name in measured["detector"]],
            "error_x": {
                "type": "data",
                **{key: values.tolist() for key, values in ends.items()},
                "color": blue,
                "thickness": 2,
                "width": 0,
            },
            "marker": {"size": 12, "color": blue},
            "customdata": [f"{row.ms:.2f} ms on {row.on}" for row in measured.itertuples()],
            "hovertemplate": "%{x:.1f} FPS, %{customdata}<extra>measured here</extra>",
            "meta": {"series": "measured here", "owners": [{"detector": name} for name in measured["detector"]]},
        }
    ]
    if quoted:
        hollow = {"symbol": "diamond-open", "size": 12, "color": TRUTH_COLOUR, "line": {"width": 2.5}}
        traces.insert(
            0,
            {
                "type": "scatter",
                "mode": "markers",
                "marker": hollow,
                "x": [q.fps for q in quoted.values()],
                "y": [_wrapped(name) for name in quoted],
                "customdata": [q.source for q in quoted.values()],
                "hovertemplate": "%{x:.0f} FPS<br>%{customdata}<extra>quoted</extra>",
                "meta": {"series": "quoted", "owners": [{"detector": name} for name in quoted]},
            },
        )
    names = [_wrapped(name) for name in measured["detector"][::-1]]
    layout = {
        "xaxis": {"title": {"text": "frames a second, logarithmic"}, **_LOG},
        "yaxis": {**_category(names), "ticks": ""},
    }
    theirs = f" Quoted: {reference.title}; not measured on the same machine." if quoted and reference else ""
    about = f"{speed_caption(measured)} The line through a measured point spans its quartiles.{theirs}"
    height = _FRAME + _ROW * len(names)
    cases = {"all": Case([(traces, layout)])}
    return Figure("detector_fps", "Frames a second", cases, about, height=height)


def _timing(study: Study, look: Look) -> Figure | None:
    """Bars of milliseconds a frame by stage, a row a contender; a case for each kind of data."""
    means = stage_means(study.flights)
    if means.empty:
        return None
    cases, kinds = {}, means.index.get_level_values("data").unique()
    for kind in kinds:
        own = means.loc[kind]
        shades = {False: iter(_FRONT_END * 3), True: iter(_BACK_END * 3)}
        owners = [{"detector": detector, "backend": backend} for detector, backend in own.index]
        traces = [
            {
                "type": "bar",
                "orientation": "h",
                "x": own[stage].tolist(),
                "y": [look.name(*contender) for contender in own.index],
                "marker": {"color": next(shades[str(stage).startswith("backend")])},
                "text": [str(stage).removeprefix("backend.").replace("_", " ")] * len(own),
                "textposition": "inside",
                "insidetextanchor": "middle",
                "textangle": 0,
                "hovertemplate": "%{y}: %{x:.2f} ms" + f"<extra>{stage}</extra>",
                "meta": {"series": stage, "owners": owners},
            }
            for stage in own.columns
        ]
        layout = {
            "barmode": "stack",
            "bargap": 0.3,
            # A name that does not fit is left to the legend.
            "uniformtext": {"minsize": 11, "mode": "hide"},
            "xaxis": {"title": {"text": "mean time a frame [ms]"}, "rangemode": "tozero"},
            "yaxis": {"autorange": "reversed", "ticks": "", "ticksuffix": "  "},
        }
        said = data_caption(study.flights[study.flights["data"] == kind])
        cases[str(kind)] = Case([(traces, layout)], said, "" if len(kinds) == 1 else f"{kind}_")
    height = _FRAME + (_ROW + 8) * int(means.groupby("data").size().max())
    about = "Mean over all frames and flights, without reading and decoding images. Blue: front-end; brown: back-end."
    return Figure("timing", "Time a frame by stage", cases, about, "Recordings", height)


def _nees_of_trials(study: Study, look: Look) -> Figure:
    """NEES over time, averaged over the trials, within the bounds of an honest filter; a case a flight."""
    cases = {}
    for (flight,), here in groups(study.trials, ("sequence",)):
        found = {who: nees for who, own in groups(here, CONTENDER) if (nees := study.nees(own))}
        if found:
            several = study.trials["sequence"].nunique() > 1
            cases[flight] = Case([_nees_picture(found, look)], _note(here), _file_name(f"{flight}_") if several else "")
    about = (
        "Mean of the trials at each instant. Shaded: where 95 % of honest filters' means are. Above it the filter is "
        "surer of itself than it should be."
    )
    heights: dict[str, Any] = {"height": 600, "narrow_height": 540}
    return Figure("nees_of_trials", "NEES of the trials over time", cases, about, **heights)


def _nees_picture(found: Mapping[tuple[str, str], Mapping[str, AverageNees]], look: Look) -> tuple[list[Trace], Layout]:
    titles = [f"{part} (ideally {dof})" for part, dof in PARTS.items()]
    layout, traces = _panels(titles, "time since the first frame [s]"), []
    for k, part in enumerate(PARTS):
        widest = max((each[part] for each in found.values()), key=lambda nees: int(nees.trials.max()))
        bounds = _area(widest.t_ns / NS_PER_S, widest.low, widest.high, BAND_COLOUR)
        traces.append({"type": "scatter", **bounds, "meta": {"series": "95 % if honest"}, **_axes(k)})
        for (detector, backend), parts in found.items():
            time_s, values = (
                np.asarray(each, np.float32) for each in (parts[part].t_ns / NS_PER_S, parts[part].values)
            )
            shown = {"x": time_s, "y": values, "mode": "lines"}
            note = f"mean {parts[part].mean:.2f}"
            hover = f"%{{y:.2f}} at %{{x:.1f}} s, {note}<extra>{backend}</extra>"
            own = {"line": look.line(detector, backend), "hovertemplate": hover}
            meta = {"series": backend, "backend": backend, "note": note}
            traces.append({"type": "scatter", **shown, **own, "meta": meta, **_axes(k)})
        highest = max(float(each[part].values.max()) for each in found.values())
        if highest > _LOGARITHMIC_FROM * widest.mean_band[1]:
            # The first pose is the gauge, where the error is nothing.
            ends = [np.log10(0.1 * widest.dof), np.log10(1.5 * highest)]
            layout[_axis("y", k)] |= {"type": "log", "dtick": 1, "tickformat": "~g", "range": ends}
        else:
            layout[_axis("y", k)] |= {"rangemode": "tozero"}
    return traces, layout


def _trials(study: Study, look: Look) -> Figure | None:
    """Every trial's errors, by back-end; those without an estimate are counted below."""
    if not study.trials["ate_m"].notna().any():
        return None
    backends = list(study.trials["backend"].unique())
    layout, traces = _panels(("ATE, position + yaw [m]", "orientation [deg]"), "", rangemode="tozero"), []
    for k, column in enumerate(("ate_m", "orientation_deg")):
        layout[_axis("x", k)] |= _category(backends)
        for (detector, backend), own in groups(study.trials, CONTENDER):
            dots = {"size": 8, "symbol": "circle-open", "color": look.colour(detector, backend), "line": {"width": 1.4}}
            shown = {"x": own["backend"].tolist(), "y": own[column].astype(float).tolist(), "mode": "markers"}
            hover = {"customdata": own["seed"].tolist(), "hovertemplate": "%{y:.3f}, seed %{customdata}<extra></extra>"}
            meta = {"series": backend, "backend": backend}
            traces.append({"type": "scatter", **shown, **hover, "marker": dots, "meta": meta, **_axes(k)})
    missing = int(study.trials["ate_m"].isna().sum())
    about = (
        f"A mark a trial. {missing} of {len(study.trials)} without an estimate to measure."
        if missing
        else "A mark a trial."
    )
    return Figure("trials", "Errors of the trials", {"all": Case([(traces, layout)], _note(study.trials))}, about)


_FIGURES: tuple[Callable[[Study, Look], Figure | None], ...] = (
    *(_detector_fps, _stress, _ate_by_sequence, _trajectories_3d, _translation_error, _rotation_error, _comparison),
    *(_relative_error, _timing, _nees_of_flights, _nees_of_trials, _trials),
)


# Layouts and areas ----------------------------------------------------------------------------------------------------


def _panels(titles: Sequence[str], x_title: str, gap: float = 0.07, **y: Any) -> Layout:
    """Panels above each other that share their x axis; the k-th one's traces are on ``_axes(k)``."""
    height = (1.0 - gap * (len(titles) - 1)) / len(titles)
    layout: Layout = {}
    for k, title in enumerate(titles):
        bottom, last = (len(titles) - 1 - k) * (height + gap), k == len(titles) - 1
        domain = [max(0.0, bottom), min(1.0, bottom + height)]
        layout[_axis("y", k)] = {"domain": domain, "anchor": _axes(k)["xaxis"], "title": {"text": title}, **y}
        shared = {} if k == 0 else {"matches": "x"}
        about = {"showticklabels": last, "title": {"text": x_title if last else ""}}
        layout[_axis("x", k)] = {"anchor": _axes(k)["yaxis"], **about, **shared}
    return layout


def _axis(name: str, k: int) -> str:
    """What the layout calls an axis of the k-th of :func:`_panels`."""
    return f"{name}axis{k + 1 if k else ''}"


def _axes(k: int) -> dict[str, str]:
    """Which axes the traces of the k-th of :func:`_panels` belong to."""
    return {f"{name}axis": f"{name}{k + 1 if k else ''}" for name in "xy"}


def _category(names: Sequence[str]) -> dict[str, Any]:
    return {"type": "category", "categoryorder": "array", "categoryarray": list(names)}


def _shaded(k: int, low: float, high: float) -> dict[str, Any]:
    """All along the k-th panel."""
    axes = _axes(k)
    where = {"type": "rect", "xref": f"{axes['xaxis']} domain", "yref": axes["yaxis"], "x0": 0, "x1": 1}
    return {
        **where,
        "y0": low,
        "y1": high,
        "fillcolor": BAND_COLOUR,
        "opacity": 0.13,
        "line": {"width": 0},
        "layer": "below",
    }


def _area(x: Any, low: Any, high: Any, colour: str, opacity: float = 0.18) -> Trace:
    outline = {"x": [*x, *x[::-1]], "y": [*high, *low[::-1]], "mode": "lines", "line": {"width": 0, "color": colour}}
    outline = {key: np.asarray(value, np.float32) if key in "xy" else value for key, value in outline.items()}
    return {**outline, "fill": "toself", "fillcolor": colour, "opacity": opacity, "hoverinfo": "skip"}


def _note(flights: pd.DataFrame) -> str:
    """What the data of one recording was."""
    return f"Data ({flights['data'].iloc[0]}): {flights['data_note'].max().rstrip('.')}."


def _wrapped(name: str) -> str:
    """A detector's name with each of its options on a line of its own."""
    return name.replace(":", ":<br>", 1).replace(",", ",<br>")


def _file_name(text: str) -> str:
    return re.sub(r"[^\w+-]+", "_", text)
