"""Figures, each described once, in Plotly's terms: those of runs, and what those of suites are made of.

The page of a report draws them with Plotly (:mod:`.suite.page`); files are drawn from the same traces and layouts with
matplotlib (:mod:`.drawing`). A trace's ``meta`` says whose it is: ``series`` is its entry in the legend, ``detector``
and ``backend`` by which the page's filters hide it and by which files have a column a back-end; or ``owners``, one of
those a point, where the points of a trace have several. ``note`` is a figure of the trace itself, such as its RMSE;
``x_back`` how many traces before it the one is that has its x, which is then not stored again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from vioframe.evaluation import ALIGNED_BY, TrajectoryErrors
from vioframe.evaluation.consistency import PARTS
from vioframe.evaluation.metrics import rotation_error_deg
from vioframe.evaluation.nees import band
from vioframe.report.style import TRUTH_COLOUR, looks
from vioframe.report.units import length, length_unit
from vioframe.runs.evaluated import Evaluated
from vioframe.types import DP, DTHETA, NS_PER_S, Float, Int

BAND_COLOUR = "#009e73"
"""Of the range that errors are meant to stay in: no run's, as it is only ever drawn as an area."""
ROW, FRAME = 34, 90
"""Heights, px: of a row of bars, and of what is around them."""
POINTS = 2000
_FAR, _FAR_PART = 10.0, 0.2
_SIGMAS = 3.0
_VISIBLE = 0.02
"""Of the longest bar."""
# Lightness tells the stages apart, the hue front-end from back-end.
_FRONT_END = ("#24415e", "#3f6a94", "#6f9bc4", "#a9c8e4", "#d3e3f2")
_BACK_END = (
    *("#7a4a12", "#c9873a", "#ecc48d", "#a0671f", "#dfa863", "#f6e3c9", "#8a6d4d", "#b59a7a", "#d8c6ad", "#5f4326"),
)
_LOOP_CLOSURE = "#3c8d5a"

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
class Line:
    """A run as it is drawn, and whose it is. ``repeats`` are the errors of all runs that it stands for, its own too."""

    run: Evaluated
    meta: Mapping[str, Any]
    colour: str
    dash: str
    fill: str
    repeats: Sequence[TrajectoryErrors]
    points: int = POINTS

    def style(self, width: float = 1.8) -> dict[str, Any]:
        return {"color": self.colour, "dash": self.dash, "width": width}

    @property
    def series(self) -> str:
        return str(self.meta["series"])

    def shown(self, t_ns: Int, values: Float) -> Float:
        """``values`` (N, ...) at the stamps (N,), at no more than so many, with NaN wherever no line must be drawn."""
        return _thinned(values, self.run.breaks(t_ns), self.points)

    def seconds(self, t_ns: Int) -> Float:
        """Stamps (N,) as they are shown, since the ground truth begins, or the estimate where there is none."""
        return self.shown(t_ns, self.since_begin(t_ns))

    def since_begin(self, t_ns: Int) -> Float:
        begin_ns = (self.run.ground_truth.t_ns if self.run.ground_truth else t_ns)[0]
        return np.asarray((t_ns - begin_ns) / NS_PER_S)


@dataclass(frozen=True)
class Course:
    """Runs to be drawn into one picture; ``files`` as in :class:`Case`."""

    label: str
    lines: Sequence[Line]
    note: str = ""
    files: str | None = ""

    @property
    def with_errors(self) -> list[tuple[Line, TrajectoryErrors]]:
        return [(line, line.run.errors) for line in self.lines if line.run.errors]

    def case(self, traces: Sequence[Trace], layout: Layout, *, of_many: bool = False) -> Case:
        """``of_many`` is for what has files of each recording where there are several."""
        return Case([(traces, layout)], self.note, self.files if of_many or not self.files else None)


def figures_of_runs(runs: Sequence[Evaluated], half_width_m: float = 0.0) -> list[Figure]:
    """All that ``runs`` have data for; plus or minus ``half_width_m`` is shaded in the translation errors."""
    lines = [
        Line(run, {"series": run.name}, colour, dash, f"{colour}bf", [run.errors] if run.errors else [])
        for run, (colour, dash) in zip(runs, looks(runs), strict=True)
    ]
    course = Course("all", lines)
    axes_m, angles = [f"{axis} [{{}}]" for axis in ("x", "y", "z (up)")], ("roll [deg]", "pitch [deg]", "yaw [deg]")
    found = [
        *figures_of_courses([course], half_width_m),
        _within_bounds(course, "translation_error_bounds", "Translation error within its bounds", axes_m, DP),
        _within_bounds(course, "rotation_error_bounds", "Rotation error within its bounds", angles, DTHETA),
        _timing(lines),
        _tracks(lines),
    ]
    return [figure for figure in found if figure.cases]


def figures_of_courses(courses: Sequence[Course], half_width_m: float = 0.0) -> list[Figure]:
    """Paths, and errors over time and by length, a case a course."""
    return [
        trajectories(courses),
        translation_error(courses, half_width_m),
        _rotation_error(courses),
        _comparison(courses),
        relative_error(courses),
        _nees(courses),
    ]


# Paths, and errors over time ------------------------------------------------------------------------------------------


def trajectories(courses: Sequence[Course]) -> Figure:
    """Paths in 3-D, each from its dot on."""
    cases = {}
    for course in courses:
        truths = {truth.t_ns.tobytes(): truth for line, _ in course.with_errors if (truth := line.run.ground_truth)}
        drawn = [(line, estimate) for line in course.lines if (estimate := line.run.aligned)]
        grey = {"line": {"color": TRUTH_COLOUR, "width": 9}, "opacity": 0.6, "hoverinfo": "skip"}
        traces = [
            {**_path(_thinned(truth.p_WB, [])), **grey, "meta": {"series": "ground truth"}} for truth in truths.values()
        ]
        far, p_near = _far_off(course), [truth.p_WB for truth in truths.values()]
        p_near += [estimate.p_WB for line, estimate in drawn if line.series not in far]
        box = _box(np.concatenate(p_near)) if far else None
        for line, estimate in drawn:
            hover = f"(%{{x:.2f}}, %{{y:.2f}}, %{{z:.2f}}) m at %{{customdata:.1f}} s<extra>{line.series}</extra>"
            path = {
                **_path(_within(line.shown(estimate.t_ns, estimate.p_WB), box)),
                "line": line.style(4),
                "meta": line.meta,
            }
            traces.append({**path, "customdata": line.seconds(estimate.t_ns), "hovertemplate": hover})
        for line, estimate in drawn:
            dot = {"mode": "markers", "marker": {"size": 5, "color": line.colour}, "hoverinfo": "skip"}
            traces.append({**_path(_within(estimate.p_WB[:1], box)), **dot, "meta": line.meta})
        scene = {"aspectmode": "data", **{f"{axis}axis": {"title": {"text": f"{axis} [m]"}} for axis in "xyz"}}
        layout = {"scene": scene, "margin": {"l": 0, "r": 0, "t": 0, "b": 0}}
        if drawn:
            cases[course.label] = _noted(course, far).case(traces, layout, of_many=True)
    how = _aligned_by(courses)
    about = f"Each estimate is aligned with the ground truth by {how}" if how else "Each estimate in its own frame"
    heights: dict[str, Any] = {"height": 560, "narrow_height": 400}
    return Figure("trajectories_3d", "Trajectories", cases, f"{about}. Dots mark the starts.", views=True, **heights)


def _box(p_W: Float) -> tuple[Float, Float]:
    """Corners (3,) of what is shown around the points (N, 3) m."""
    low, high = p_W.min(axis=0), p_W.max(axis=0)
    margin = 0.1 * (high - low).max()
    return low - margin, high + margin


def _within(p_W: Float, box: tuple[Float, Float] | None) -> Float:
    """Points (N, 3) m, NaN where they are out of the box."""
    if box is None:
        return p_W
    inside = np.asarray((p_W >= box[0]) & (p_W <= box[1])).all(axis=1, keepdims=True)
    return np.where(inside, p_W, np.nan)


def _path(p_W: Float) -> Trace:
    return {"type": "scatter3d", "mode": "lines", **dict(zip("xyz", p_W.T, strict=True))}


_Series = Callable[[TrajectoryErrors], Sequence[tuple[Int, Float, str]]]
"""Stamps (N,), values (N,) and a note of each panel; none where an estimate has none."""


def _over_time(
    courses: Sequence[Course],
    name: str,
    panel_titles: Sequence[str],
    series: _Series,
    bands: Sequence[tuple[float, float]] = (),
) -> dict[str, Case]:
    """What there is of each run over time, a panel each, with its band shaded.

    A title with ``{}`` is of a length, in metres: its unit is chosen by what there is to show.
    """
    cases = {}
    for course in courses:
        far, edge_m = _far_off(course), 1.2 * max((high for _, high in bands), default=0.0)
        scale, unit = length_unit(max(_largest_m(course, far), edge_m))
        scales = [scale if "{}" in title else 1.0 for title in panel_titles]
        traces: list[Trace] = []
        near: list[list[Float]] = [[] for _ in panel_titles]
        for line, errors in course.with_errors:
            for k, (t_ns, values, note) in enumerate(series(errors)):
                said = f"%{{y:.3f}} at %{{x:.1f}} s{f', {note}' if note else ''}<extra>{line.series}</extra>"
                time_s, meta = None if k else line.seconds(t_ns), {**line.meta, "note": note, "x_back": k}
                shown = line.shown(t_ns, scales[k] * values)
                traces.append(scatter(time_s, shown, meta, k, line=line.style(), hovertemplate=said))
                if line.series not in far:
                    near[k].append(shown)
        layout = panels([title.format(unit) for title in panel_titles], "time since the ground truth begins [s]")
        for k, (low, high) in enumerate(bands):
            layout.setdefault("shapes", []).append(_shaded(k, scales[k] * low, scales[k] * high))
        for k, kept in enumerate(near):
            # The band's edges are in sight, however small the errors are.
            edges = [1.2 * scales[k] * end for end in bands[k]] if bands and "{}" in panel_titles[k] else []
            if far and kept:
                layout[axis_name("y", k)] |= {"range": _around(np.concatenate([*kept, edges]))}
            elif edges:
                layout[axis_name("y", k)] |= {"autorangeoptions": {"include": edges}}
        if traces:
            noted = _noted(course, far)
            cases[course.label] = noted.case(traces, layout, of_many=name == "translation_error_per_axis")
    return cases


def _far_off(course: Course) -> dict[str, float]:
    """The runs, and how many metres, that would flatten all others: ten times as far from the truth as the next, and
    farther than a fifth of what the flight extends over."""
    worst = sorted((float(np.abs(errors.position_m).max()), line.series) for line, errors in course.with_errors)
    extent_m = max((float(np.ptp(errors.truth.p_WB, axis=0).max()) for _, errors in course.with_errors), default=0.0)
    for k in range(1, len(worst)):
        if worst[k][0] > max(_FAR * worst[k - 1][0], _FAR_PART * extent_m):
            return {series: error_m for error_m, series in worst[k:]}
    return {}


def _largest_m(course: Course, far: Collection[str]) -> float:
    near = [errors.position_m for line, errors in course.with_errors if line.series not in far]
    return max((float(np.abs(position_m).max()) for position_m in near), default=0.0)


def _noted(course: Course, far: Mapping[str, float]) -> Course:
    """It says who leaves the picture."""
    left = [f"{series} leaves the picture: it gets {length(error_m)} off." for series, error_m in far.items()]
    return replace(course, note=" ".join([*[course.note] * bool(course.note), *left]))


def _around(values: Float) -> list[float]:
    """An axis' range for them."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = 0.05 * (high - low)
    return [low - margin, high + margin]


def translation_error(courses: Sequence[Course], half_width_m: float = 0.0) -> Figure:
    """Position error along each axis of the world, and how much of it is within the band about zero."""

    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        share = errors.inside_band(half_width_m)
        notes = [f"{share[axis]:.1f} % inside" if half_width_m else "" for axis in "xyz"]
        return [(errors.estimate.t_ns, errors.position_m[:, k], notes[k]) for k in range(3)]

    name, titles = "translation_error_per_axis", [f"{axis} [{{}}]" for axis in ("x", "y", "z (up)")]
    bands = [(-half_width_m, half_width_m)] * 3 if half_width_m else []
    cases = _over_time(courses, name, titles, series, bands)
    shaded = f" Shaded: ±{100 * half_width_m:g} cm, beside how much of the estimated time is inside."
    about = f"Estimate minus ground truth in the world's axes, aligned by {_aligned_by(courses)} over the whole path."
    about += shaded if half_width_m else ""
    return Figure(name, "Translation error by axis", cases, about, height=560, narrow_height=520)


def _rotation_error(courses: Sequence[Course]) -> Figure:
    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        return [(errors.estimate.t_ns, errors.rotation_rpy_deg[:, k], "") for k in range(3)]

    cases = _over_time(courses, "rotation_error", [f"{angle} [deg]" for angle in ("roll", "pitch", "yaw")], series)
    about = f"Roll, pitch, yaw about the world's x, y, z, aligned by {_aligned_by(courses)} over the whole path."
    return Figure("rotation_error", "Rotation error", cases, about, height=560, narrow_height=520)


def _within_bounds(course: Course, name: str, title: str, titles: Sequence[str], part: slice) -> Figure:
    """Errors along three axes and the three standard deviations that the estimate states of them."""
    far = _far_off(course)
    # Stamps (N,), errors and bounds (N, 3) of the stretches of each run that states any.
    stated: list[tuple[Line, list[tuple[Int, Float, Float]]]] = []
    for line in course.lines:
        stretches = [bounded for errors in line.run.errors_by_stretch() if (bounded := _bounded(errors, part))]
        stated += [(line, stretches)] * bool(stretches)
    near = [each for line, own in stated if line.series not in far for each in own]
    scale, unit = (
        length_unit(max((float(np.abs(e).max()) for _, e, _ in near), default=0.0)) if part == DP else (1.0, "")
    )
    areas, lines = [], []
    for line, own in stated:
        inside = np.mean(np.concatenate([np.abs(values) <= bound for _, values, bound in own]), axis=0)
        for k in range(3):
            for number, (t_ns, values, bound) in enumerate(own):
                edge, time_s = _thinned(scale * bound[:, k], []), _thinned(line.since_begin(t_ns), [])
                areas.append(area(time_s, -edge, edge, line.meta, k, line.colour, 0.15))
                meta = {**line.meta, "note": "" if number else f"{100.0 * inside[k]:.0f} % inside"}
                drawn = line.shown(t_ns, scale * values[:, k])
                lines.append(scatter(line.seconds(t_ns), drawn, meta, k, line=line.style()))
    layout = panels([each.format(unit) for each in titles], "time since the ground truth begins [s]")
    for k in range(3) if near else ():
        error = scale * max(float(np.abs(values[:, k]).max()) for _, values, _ in near)
        widest = scale * max(float(bound[:, k].max()) for _, _, bound in near)
        # Bounds far beyond all errors, as right after a start, leave the picture.
        half = 1.05 * max(error, min(widest, _SIGMAS * error))
        layout[axis_name("y", k)] |= {"range": [-half, half]} if half else {}
    about = (
        "Position and yaw fixed at the first pose of each stretch, from where an estimate counts its covariance. "
        "Shaded: ±3 sigma as it says, beside how much of the time the error is inside: 99.7 % if that is honest."
    )
    case = _noted(course, far).case([*areas, *lines], layout)
    return Figure(name, title, {"all": case} if lines else {}, about)


def _bounded(errors: TrajectoryErrors, part: slice) -> tuple[Int, Float, Float] | None:
    """Stamps (N,), errors and bounds (N, 3) where the covariance is known; m, or deg about the world's axes."""
    if errors.estimate.cov_pose is None:
        return None
    cov, values = errors.estimate.cov_pose[:, part, part], errors.position_m
    if part == DTHETA:
        # R <- R Exp(dtheta) is along the body's axes: about the world's it is R P R^T.
        R_WB, values = errors.estimate.R_WB, errors.rotation_rpy_deg
        cov = np.degrees(np.degrees(R_WB @ cov @ R_WB.transpose(0, 2, 1)))
    variance = np.diagonal(cov, axis1=1, axis2=2)
    known = np.isfinite(variance).all(axis=1)
    if not known.any():
        return None
    return errors.estimate.t_ns[known], values[known], _SIGMAS * np.sqrt(np.maximum(variance[known], 0.0))


def _comparison(courses: Sequence[Course]) -> Figure:
    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        t_ns, metres = errors.estimate.t_ns, np.asarray(np.linalg.norm(errors.position_m, axis=1))
        degrees = rotation_error_deg(errors.estimate, errors.truth)
        sizes = ((metres, length(errors.ate_m.rmse)), (degrees, f"{errors.orientation_deg.rmse:.3g} deg"))
        return [(t_ns, values, f"RMSE {rmse}") for values, rmse in sizes]

    cases = _over_time(courses, "comparison", ("translation error [{}]", "rotation error [deg]"), series)
    about = f"Distance from the truth and angle to it, aligned by {_aligned_by(courses)} over the whole path."
    return Figure("comparison", "Size of the errors", cases, about, height=380, narrow_height=520)


def _nees(courses: Sequence[Course]) -> Figure:
    def series(errors: TrajectoryErrors) -> list[tuple[Int, Float, str]]:
        # The first instants are the gauge's own, without error, and nothing to a logarithmic axis.
        notes = [f"mean {each.mean:.3g}, {100 * each.inside:.0f} % inside" for each in errors.nees]
        return [(n.t_ns, np.maximum(n.values, 1e-3), note) for n, note in zip(errors.nees, notes, strict=True)]

    titles = [f"{part} (ideally {dof})" for part, dof in PARTS.items()]
    cases = _over_time(courses, "nees", titles, series, [band(dof) for dof in PARTS.values()])
    for case in cases.values():
        for k, dof in enumerate(PARTS.values()):
            logarithmic = {"type": "log", "dtick": 1, "tickformat": "~g", "minallowed": np.log10(0.03 * dof)}
            case.pictures[0][1][axis_name("y", k)] |= logarithmic
    about = (
        "Shaded: 95 % of the instants of an honest filter; above, the filter is surer of itself than it should be. "
        "Position and yaw fixed at the first pose. Errors within a flight hang together: no test at a level."
    )
    return Figure("nees", "NEES of the flights over time", cases, about, height=560, narrow_height=520)


def _aligned_by(courses: Sequence[Course]) -> str:
    names = dict.fromkeys(errors.alignment_name for course in courses for _, errors in course.with_errors)
    return " or ".join(ALIGNED_BY[name] for name in names)


def _thinned(values: Float, breaks: Sequence[int] | Int, points: int = POINTS) -> Float:
    """No more than so many of ``values`` (N, ...), with NaN ahead of each of ``breaks``."""
    # What is before and after a break stays, however few of the others do.
    at = np.asarray(breaks, np.int64)
    evenly = np.linspace(0, len(values) - 1, min(len(values), points)).astype(np.int64)
    kept = np.unique(np.concatenate([evenly, at, at - 1]))
    with_gaps = np.insert(np.asarray(values, float)[kept], np.searchsorted(kept, at), np.nan, axis=0)
    # As many digits as a screen can show, in half of the page's bytes.
    return np.asarray(with_gaps, np.float32)


# By length, and what it cost ------------------------------------------------------------------------------------------


def relative_error(courses: Sequence[Course]) -> Figure:
    """Boxes by length of the stretch, of all that a line stands for."""
    cases = {}
    for course in courses:
        stretches = stretches_of(course.lines)
        if stretches.empty:
            continue
        of_path = bool(stretches["of_path"].iloc[0])
        names = {length: f"{100 * length if of_path else length:g}" for length in sorted(stretches["length"].unique())}
        titles = ("translation error [% of length]", "yaw error [deg]")
        layout = panels(titles, f"length of the stretch [{'% of the path' if of_path else 'm'}]", rangemode="tozero")
        for k in range(2):
            layout[axis_name("x", k)] |= category(list(names.values()))
        traces, far = [], _far_off(course)
        tops: list[list[float]] = [[], []]
        for number, own in stretches.groupby("line"):
            line = course.lines[int(str(number))]
            for k, column in enumerate(("translation_percent", "yaw_deg")):
                five = own.groupby("length")[column].quantile(np.array([0.05, 0.25, 0.5, 0.75, 0.95])).unstack()
                keys = ("lowerfence", "q1", "median", "q3", "upperfence")
                outline = {"color": line.colour, "width": 1.6}
                box = {"type": "box", "x": [names[length] for length in five.index], "line": outline}
                box |= dict(zip(keys, five.to_numpy().T, strict=True)) | {"fillcolor": line.fill}
                box |= {"name": line.series, "offsetgroup": line.series, "hoverinfo": "y+name"}
                traces.append({**box, "meta": line.meta, **axes(k)})
                if line.series not in far:
                    tops[k] += five[0.95].tolist()
        for k, top in enumerate(tops):
            if far and top:
                layout[axis_name("y", k)] |= {"range": [0.0, 1.1 * max(top)]}
        layout |= {"boxmode": "group", "boxgap": 0.25, "boxgroupgap": 0.3}
        cases[course.label] = _noted(course, far).case(traces, layout, of_many=True)
    about = (
        "Every pose of every run starts a stretch, aligned at its first pose; stretches overlap. Boxes: quartiles and "
        "median; whiskers: 5 to 95 %."
    )
    heights: dict[str, Any] = {"height": 520, "narrow_height": 480}
    return Figure("relative_error", "Relative error by length of the stretch", cases, about, **heights)


def stretches_of(lines: Sequence[Line]) -> pd.DataFrame:
    """A row a stretch of all that the lines stand for: the number of its ``line``, its ``length`` and its errors.

    By length in metres where any path is long enough, else by fraction of the path, which ``of_path`` says.
    """
    by_length = any(errors.relative for line in lines for errors in line.repeats)
    tables = [
        pd.DataFrame({"translation_percent": each.translation_percent, "yaw_deg": each.yaw_deg}).assign(
            line=number, length=length, of_path=not by_length
        )
        for number, line in enumerate(lines)
        for errors in line.repeats
        for length, each in (errors.relative if by_length else errors.relative_by_fraction).items()
    ]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def _timing(lines: Sequence[Line]) -> Figure:
    # What loop closure made of a run has no times of its own.
    spent = {line.run.name: stage_ms for line in lines if (stage_ms := line.run.stage_ms())}
    means = pd.DataFrame.from_dict(spent, orient="index").fillna(0.0)
    return timing({"all": Case([stage_bars(means, [])])} if spent else {}, len(spent))


def timing(cases: Mapping[str, Case], rows: int) -> Figure:
    """Of what :func:`stage_bars` makes, with no more than so many ``rows``."""
    about = "Mean over all frames, without reading and decoding images. Blue: front-end, brown: back-end, green: loops."
    return Figure("timing", "Time a frame by stage", cases, about, "Recordings", FRAME + (ROW + 8) * rows)


def stage_bars(means: pd.DataFrame, owners: Sequence[Mapping[str, str]]) -> tuple[list[Trace], Layout]:
    """Bars of milliseconds a frame by stage, a column each: a row a run or a contender, by its name."""
    shades = {"backend": iter(_BACK_END * 3), "loop_closure": iter((_LOOP_CLOSURE,))}
    front_end, order = iter(_FRONT_END * 3), list(shades)

    def part(stage: str) -> str:
        return stage.partition(".")[0]

    def called(stage: str) -> str:
        """Whose it is, the colour says."""
        return {"backend.other": "rest of back-end"}.get(stage, stage.removeprefix("backend.").replace("_", " "))

    # Those of the back-end that nobody could see go into its rest.
    least_ms, rest = _VISIBLE * means.sum(axis=1).max(), "backend.other"
    small = [stage for stage in map(str, means) if part(stage) == "backend" and (means[stage] < least_ms).all()]
    if set(small) - {rest}:
        merged = [*small, *[rest] * (rest in means and rest not in small)]
        means = means.drop(columns=merged).assign(**{rest: means[merged].sum(axis=1)})
    # As a frame goes through them: the front-end's, of which the order knows nothing, are the first.
    stages = sorted(means.columns, key=lambda stage: order.index(part(stage)) if part(stage) in order else -1)
    traces = [
        {
            "type": "bar",
            "orientation": "h",
            "x": means[stage].tolist(),
            "y": list(means.index),
            "marker": {"color": next(shades.get(part(stage), front_end))},
            "text": [called(stage)] * len(means),
            "textposition": "inside",
            "insidetextanchor": "middle",
            "textangle": 0,
            "hovertemplate": "%{y}: %{x:.2f} ms" + f"<extra>{stage}</extra>",
            "meta": {"series": called(stage), "owners": owners},
        }
        for stage in stages
    ]
    layout = {
        "barmode": "stack",
        "bargap": 0.3,
        # A name that does not fit is left to the legend.
        "uniformtext": {"minsize": 11, "mode": "hide"},
        "xaxis": {"title": {"text": "mean time a frame [ms]"}, "rangemode": "tozero"},
        "yaxis": {"autorange": "reversed", "ticks": "", "ticksuffix": "  "},
    }
    return traces, layout


def _tracks(lines: Sequence[Line]) -> Figure:
    """Features tracked, and new among them, in each frame."""
    layout = panels(("features in the frame", "new among them"), "time since the first frame [s]", rangemode="tozero")
    traces = []
    for line in lines:
        if found := line.run.folder.tracks() if line.run.folder else None:
            time_s = (found.frames_ns - found.frames_ns[0]) / NS_PER_S
            # In the first frame every feature is new, which would hide all that follows.
            counts = (found.tracked, found.new[1:])
            traces += [scatter(time_s[k:], each, line.meta, k, line=line.style()) for k, each in enumerate(counts)]
    return Figure("tracks", "Features over time", {"all": Case([(traces, layout)])} if traces else {})


# Layouts and areas ----------------------------------------------------------------------------------------------------


def panels(titles: Sequence[str], x_title: str, gap: float = 0.07, **y: Any) -> Layout:
    """Panels above each other that share their x axis; the k-th one's traces are on ``axes(k)``."""
    height = (1.0 - gap * (len(titles) - 1)) / len(titles)
    layout: Layout = {}
    for k, title in enumerate(titles):
        bottom, last = (len(titles) - 1 - k) * (height + gap), k == len(titles) - 1
        domain = [max(0.0, bottom), min(1.0, bottom + height)]
        layout[axis_name("y", k)] = {"domain": domain, "anchor": axes(k)["xaxis"], "title": {"text": title}, **y}
        shared = {} if k == 0 else {"matches": "x"}
        about = {"showticklabels": last, "title": {"text": x_title if last else ""}}
        layout[axis_name("x", k)] = {"anchor": axes(k)["yaxis"], **about, **shared}
    return layout


def axis_name(name: str, k: int) -> str:
    """What the layout calls an axis of the k-th of :func:`panels`."""
    return f"{name}axis{k + 1 if k else ''}"


def axes(k: int) -> dict[str, str]:
    """Which axes the traces of the k-th of :func:`panels` belong to."""
    return {f"{name}axis": f"{name}{k + 1 if k else ''}" for name in "xy"}


def category(names: Sequence[str]) -> dict[str, Any]:
    return {"type": "category", "categoryorder": "array", "categoryarray": list(names)}


def scatter(x: Any, y: Any, meta: Mapping[str, Any], k: int = 0, mode: str = "lines", **more: Any) -> Trace:
    """Lines or markers in the k-th of :func:`panels`."""
    return {"type": "scatter", "mode": mode, "x": x, "y": y, "meta": meta, **axes(k), **more}


def area(x: Any, low: Any, high: Any, meta: Mapping[str, Any], k: int, colour: str, opacity: float = 0.18) -> Trace:
    """What is between ``low`` and ``high`` (N,), which may be pandas' or NumPy's."""
    around = np.asarray([*x, *x[::-1]], np.float32), np.asarray([*high, *low[::-1]], np.float32)
    look: Trace = {"line": {"width": 0, "color": colour}, "fill": "toself", "fillcolor": colour, "opacity": opacity}
    return scatter(*around, meta, k, **look, hoverinfo="skip")


def _shaded(k: int, low: float, high: float) -> dict[str, Any]:
    """All along the k-th panel."""
    where = {"type": "rect", "xref": f"{axes(k)['xaxis']} domain", "yref": axes(k)["yaxis"], "x0": 0, "x1": 1}
    look = {"fillcolor": BAND_COLOUR, "opacity": 0.13, "line": {"width": 0}, "layer": "below"}
    return {**where, "y0": low, "y1": high, **look}
