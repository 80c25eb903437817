"""The figures that a suite's results have data for: those of its runs, contenders compared, speed, and trials."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from vioframe.evaluation.consistency import PARTS, AverageNees
from vioframe.report import style
from vioframe.report.figures import (
    BAND_COLOUR,
    FRAME,
    POINTS,
    ROW,
    Case,
    Course,
    Figure,
    Layout,
    Line,
    Trace,
    area,
    axis_name,
    category,
    figures_of_courses,
    panels,
    scatter,
    stage_bars,
    timing,
)
from vioframe.report.style import DASHES, TRUTH_COLOUR
from vioframe.report.suite.statistics import (
    CONTENDER,
    COURSE,
    SUCCESS_PERCENT,
    Study,
    condition_text,
    curves,
    data_caption,
    groups,
    median_flight,
    records,
    seeds_text,
    stage_means,
)
from vioframe.report.suite.tables import speed_caption
from vioframe.report.units import length
from vioframe.runs.results import CLEAR
from vioframe.types import NS_PER_S

_FILLS = (0.85, 0.25, 0.5, 0.1)
_SYMBOLS = ("circle", "square", "triangle-up", "diamond")
_POINTS_LEAST, _POINTS_IN_ALL = 300, 30_000
_LOGARITHMIC_FROM = 4.0
"""NEES that leaves its bounds by this factor makes the axis logarithmic."""
_ROOM = 1.8
"""Factor between the outermost errors and the end of a logarithmic axis."""
_LOG = {"type": "log", "dtick": "D2", "tickformat": "~g"}


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
        return style.colour(self.backends.index(backend) if one else self.detectors.index(detector))

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
        return detector if len(self.backends) < 2 else f"{detector}{style.SERIES}{backend}"

    def meta(self, detector: str, backend: str, **more: Any) -> dict[str, Any]:
        return {"series": self.name(detector, backend), "detector": detector, "backend": backend, **more}


def figures(study: Study) -> list[Figure]:
    """All that there is data for, with the numbers that somebody else has for them where the reference says so."""
    look, reference = Look.of(study), study.results.reference
    courses = figures_of_courses(_courses(study, look), reference.band.half_width_m if reference.band else 0.0)
    made = [_detector_fps(study), _stress(study, look), _ate_by_sequence(study, look), *courses, _timing(study, look)]
    made += [_nees_of_trials(study, look), _trials(study, look)]
    found = [figure for figure in made if figure is not None and figure.cases]
    quoted = reference.figures
    return [replace(f, title=f"{quoted[f.name].title}: {f.title}") if f.name in quoted else f for f in found]


def _courses(study: Study, look: Look) -> list[Course]:
    """All contenders on one recording and condition, where there is something to draw: each one's median flight."""
    flights = study.flights
    points = max(_POINTS_LEAST, min(POINTS, _POINTS_IN_ALL // max(1, flights.groupby([*COURSE, *CONTENDER]).ngroups)))
    several = flights[flights["condition"] == CLEAR].groupby(COURSE).ngroups > 1
    found = []
    for (data, sequence, condition, level), here in groups(flights, COURSE):
        lines, missing = [], []
        for contender, own in groups(here, CONTENDER):
            flight = median_flight(own)
            run = None if flight is None else study.evaluated(flight)
            if run is None or run.errors is None:
                missing.append(" with ".join(contender))
            else:
                dash, fill = look.line(*contender)["dash"], look.fill(*contender)
                repeats = [errors for each in records(own) if (errors := study.errors(each))]
                lines.append(Line(run, look.meta(*contender), look.colour(*contender), dash, fill, repeats, points))
        seeds = here.groupby(CONTENDER).size().max()
        of_two = "one with the larger" if seeds == 2 else "one with the median"
        notes = [_note(here)]
        notes += [f"Of {seeds} seeds the {of_two} error is drawn."] if seeds > 1 else []
        notes += [f"Without any pose to draw: {', '.join(missing)}."] if missing else []
        where = sequence if condition == CLEAR else f"{sequence}, {condition_text(condition, level).replace('_', ' ')}"
        files = None if study.is_stress else _file_name(f"{sequence}_{data}_") if several else ""
        if lines:
            found.append(Course(f"{where} ({data})", lines, " ".join(notes), files))
    return found


# Contenders compared --------------------------------------------------------------------------------------------------


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
        colour, meta = look.colour(detector, backend), look.meta(detector, backend)
        series = meta["series"]
        shared = {"offsetgroup": series, "name": series, "hovertemplate": f"%{{y:.3f}} m<extra>{series}</extra>"}
        means = own.groupby(where, sort=False)["ate_m"].mean().dropna()
        missing = (~own["evaluated"]).groupby(where, sort=False).sum().loc[lambda n: n > 0]
        dots = {"size": 8, "symbol": f"{look.symbol(backend)}-open", "color": colour, "line": {"width": 1.6}}
        bars = {"size": 16, "symbol": "line-ew", "color": colour, "line": {"width": 3, "color": colour}}
        traces.append(scatter(where.tolist(), own["ate_m"].tolist(), meta, 0, "markers", marker=dots, **shared))
        traces.append(scatter(list(means.index), means.tolist(), meta, 0, "markers", marker=bars, **shared))
        if len(missing):
            said = {"text": [f"✗{n}" for n in missing], "textfont": {"color": colour}, "hoverinfo": "skip"}
            traces.append(scatter(list(missing.index), [top] * len(missing), meta, 0, "text", **{**shared, **said}))
    layout = {
        "xaxis": category(recordings),
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
            layout = panels(("ATE [m]", "succeeded [%]"), "level", gap=0.09)
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
        ("ate_m", "low", "high"),
        ("success", "success_low", "success_high"),
    )
    colour, meta, traces = look.colour(detector, backend), look.meta(detector, backend), []
    for k, (value, low, high) in enumerate(columns):
        known = percent[percent[value].notna()]
        banded = known[known[low].notna()]
        if len(banded) > 1:
            faint = min(0.14, 0.4 / (len(look.detectors) * len(look.backends)))
            traces.append(area(banded["level"], banded[low], banded[high], meta, k, colour, faint))
        hollow = ["circle" if k or own["complete"].all() else "circle-open" for own in known["flights"]]
        says = [
            f"{f'{told:.0f} % succeeded' if k else f'ATE {length(told)}'}, seeds: {seeds_text(own)}"
            for told, own in zip(known[value], known["flights"], strict=True)
        ]
        more = {
            "line": look.line(detector, backend, width=2.2),
            "marker": {"size": 7, "color": colour, "symbol": hollow},
            "customdata": says,
            "hovertemplate": f"level %{{x:g}}: %{{customdata}}<extra>{look.name(detector, backend)}</extra>",
        }
        traces.append(scatter(known["level"].tolist(), known[value].tolist(), meta, k, "lines+markers", **more))
        if not k:
            single = pd.concat(list(known["flights"])).dropna(subset="ate_m")
            dots = {"marker": {"size": 4, "color": colour}, "opacity": 0.6, "hoverinfo": "skip"}
            traces.append(scatter(single["level"].tolist(), single["ate_m"].tolist(), meta, k, "markers", **dots))
    return traces


# Speed, and trials ----------------------------------------------------------------------------------------------------


def _detector_fps(study: Study) -> Figure | None:
    """Points by detector, the fastest on top: measured with its quartiles, and quoted."""
    measured = study.speeds[study.speeds["status"] == "ok"]
    if measured.empty:
        return None
    reference = study.results.reference.speed
    speeds = reference.detectors if reference else {}
    quoted = {name: speeds[base] for name in measured["detector"] if (base := name.partition(":")[0]) in speeds}
    blue = style.colour(0)
    ends = {"array": measured["fps_high"] - measured["fps"], "arrayminus": measured["fps"] - measured["fps_low"]}
    spans = {"type": "data", "color": blue, "thickness": 2, "width": 0, **{k: v.tolist() for k, v in ends.items()}}

    def points(series: str, fps: Iterable[float], names: Iterable[str], said: list[str], **more: Any) -> Trace:
        names = list(names)
        meta = {"series": series, "owners": [{"detector": name} for name in names]}
        hover = f"%{{x:.4g}} FPS, %{{customdata}}<extra>{series}</extra>"
        shown = list(fps), [_wrapped(name) for name in names]
        return scatter(*shown, meta, mode="markers", customdata=said, hovertemplate=hover, **more)

    traces = []
    if quoted:
        hollow = {"symbol": "diamond-open", "size": 12, "color": TRUTH_COLOUR, "line": {"width": 2.5}}
        sources = [quote.source for quote in quoted.values()]
        traces.append(points("quoted", [quote.fps for quote in quoted.values()], quoted, sources, marker=hollow))
    times = [f"{row.ms:.2f} ms on {row.on}" for row in measured.itertuples()]
    dots = {"error_x": spans, "marker": {"size": 12, "color": blue}}
    traces.append(points("measured here", measured["fps"], measured["detector"], times, **dots))
    names = [_wrapped(name) for name in measured["detector"][::-1]]
    layout = {
        "xaxis": {"title": {"text": "frames a second, logarithmic"}, **_LOG},
        "yaxis": {**category(names), "ticks": ""},
    }
    theirs = f" Quoted: {reference.title}; not measured on the same machine." if quoted and reference else ""
    about = f"{speed_caption(measured)} The line through a measured point spans its quartiles.{theirs}"
    height = FRAME + ROW * len(names)
    cases = {"all": Case([(traces, layout)])}
    return Figure("detector_fps", "Frames a second", cases, about, height=height)


def _timing(study: Study, look: Look) -> Figure | None:
    """A row a contender; a case for each kind of data."""
    means = stage_means(study.flights)
    if means.empty:
        return None
    cases, kinds = {}, means.index.get_level_values("data").unique()
    for kind in kinds:
        own = means.loc[kind]
        owners = [dict(zip(CONTENDER, contender, strict=True)) for contender in own.index]
        picture = stage_bars(own.set_axis([look.name(*contender) for contender in own.index]), owners)
        said = data_caption(study.flights[study.flights["data"] == kind])
        cases[str(kind)] = Case([picture], said, "" if len(kinds) == 1 else f"{kind}_")
    return timing(cases, int(means.groupby("data").size().max()))


def _nees_of_trials(study: Study, look: Look) -> Figure:
    """NEES over time, averaged over the trials, within the bounds of an honest filter."""

    def picture(here: pd.DataFrame) -> tuple[list[Trace], Layout] | None:
        found = {who: nees for who, own in groups(here, CONTENDER) if (nees := study.nees(own))}
        return _nees_picture(found, look, study.single_nees(here) if len(found) == 1 else ()) if found else None

    about = (
        "Mean of the trials at each instant. Shaded: where 95 % of honest filters' means are. Above it the filter is "
        "surer of itself than it should be."
    )
    heights: dict[str, Any] = {"height": 600, "narrow_height": 540}
    return Figure("nees_of_trials", "NEES of the trials over time", _by_flight(study, picture), about, **heights)


def _by_flight(study: Study, picture: Callable[[pd.DataFrame], tuple[list[Trace], Layout] | None]) -> dict[str, Case]:
    """A case for each flight that there is a picture of trials on."""
    several = study.trials["sequence"].nunique() > 1
    return {
        flight: Case([drawn], _note(here), _file_name(f"{flight}_") if several else "")
        for (flight,), here in groups(study.trials, ("sequence",))
        if (drawn := picture(here)) is not None
    }


def _nees_picture(
    found: Mapping[tuple[str, str], Mapping[str, AverageNees]], look: Look, single: Sequence[pd.DataFrame]
) -> tuple[list[Trace], Layout]:
    titles = [f"{part} (ideally {dof})" for part, dof in PARTS.items()]
    layout, traces = panels(titles, "time since the first frame [s]"), []
    for k, part in enumerate(PARTS):
        widest = max((each[part] for each in found.values()), key=lambda nees: int(nees.trials.max()))
        t_s, honest = widest.t_ns / NS_PER_S, {"series": "95 % if honest"}
        traces.append(area(t_s, widest.low, widest.high, honest, k, BAND_COLOUR))
        if single:
            gap = pd.DataFrame({"t_ns": [np.nan], part: [np.nan]})
            joined = pd.concat([each for trial in single for each in (trial[:: 1 + len(trial) // _POINTS_LEAST], gap)])
            at_s, values = (joined[column].to_numpy(np.float32) for column in ("t_ns", part))
            thin: Trace = {"line": {"color": TRUTH_COLOUR, "width": 0.6}, "opacity": 0.5, "hoverinfo": "skip"}
            traces.append(scatter(at_s / NS_PER_S, values, {"series": "single trials"}, k, **thin))
        for (detector, backend), parts in found.items():
            nees = parts[part]
            seconds, shown = (np.asarray(each, np.float32) for each in (nees.t_ns / NS_PER_S, nees.values))
            note = f"mean {nees.mean:.2f}"
            hover = f"%{{y:.2f}} at %{{x:.1f}} s, {note}<extra>{backend}</extra>"
            meta = {"series": backend, "backend": backend, "note": note}
            traces.append(scatter(seconds, shown, meta, k, line=look.line(detector, backend), hovertemplate=hover))
        highest = max(float(each[part].values.max()) for each in found.values())
        if highest > _LOGARITHMIC_FROM * widest.mean_band[1]:
            # The first pose is the gauge, where the error is nothing.
            ends = [np.log10(0.1 * widest.dof), np.log10(1.5 * highest)]
            layout[axis_name("y", k)] |= {"type": "log", "dtick": 1, "tickformat": "~g", "range": ends}
        else:
            layout[axis_name("y", k)] |= {"range": [0.0, 1.15 * max(highest, widest.mean_band[1])]}
    return traces, layout


def _trials(study: Study, look: Look) -> Figure:
    """Every trial's errors, by back-end; those without an estimate are counted below."""
    columns = {"ate_m": "ATE, position + yaw [m]", "orientation_deg": "orientation [deg]", "nees.pose": "pose NEES"}
    shown = {column: title for column, title in columns.items() if column in study.trials}

    def picture(here: pd.DataFrame) -> tuple[list[Trace], Layout] | None:
        layout, traces = panels(list(shown.values()), "", rangemode="tozero"), []
        for k, column in enumerate(shown):
            layout[axis_name("x", k)] |= category(list(here["backend"].unique()))
            for (detector, backend), own in groups(here, CONTENDER):
                dots = {"size": 8, "symbol": "circle-open", "color": look.colour(detector, backend)}
                hover = "%{y:.3f}, seed %{customdata}<extra></extra>"
                told = {"customdata": own["seed"].tolist(), "hovertemplate": hover}
                meta, values = {"series": backend, "backend": backend}, own[column].astype(float).tolist()
                traces.append(scatter(own["backend"].tolist(), values, meta, k, "markers", marker=dots, **told))
        return (traces, layout) if here["ate_m"].notna().any() else None

    missing = int(study.trials["ate_m"].isna().sum())
    counted = f" {missing} of {len(study.trials)} without an estimate to measure." if missing else ""
    return Figure("trials", "Errors of the trials", _by_flight(study, picture), f"A mark a trial.{counted}", height=560)


def _note(flights: pd.DataFrame) -> str:
    """What the data of one recording was."""
    return f"Data ({flights['data'].iloc[0]}): {flights['data_note'].max().rstrip('.')}."


def _wrapped(name: str) -> str:
    """A detector's name with each of its options on a line of its own."""
    return name.replace(":", ":<br>", 1).replace(",", ",<br>")


def _file_name(text: str) -> str:
    return re.sub(r"[^\w+-]+", "_", text)
