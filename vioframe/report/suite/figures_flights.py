"""Figures 3.9 to 3.14 of the thesis: paths and errors of every detector on one recording, a column a back-end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation import TrajectoryErrors
from vioframe.evaluation.metrics import rotation_error_deg
from vioframe.report.style import TRUTH
from vioframe.report.suite.captions import data_caption
from vioframe.report.suite.look import Look, explain, legend
from vioframe.report.suite.pooled import BAND_M, inside
from vioframe.report.suite.statistics import Group
from vioframe.runs.evaluated import Evaluated
from vioframe.types import NS_PER_S, Float, Int

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLUMN_INCH = 5.6
_NARROWEST_INCH = 8.0
_SPREAD = 4.0
"""Columns whose errors differ by more than this factor each have a scale of their own."""
_BAND: dict[str, Any] = {"color": "#56B4E9", "alpha": 0.18, "lw": 0}
_START: dict[str, Any] = {"marker": "o", "ms": 7, "color": "black", "ls": "none", "label": "start", "zorder": 20}
_CM = round(100 * BAND_M)


@dataclass(frozen=True)
class Drawn:
    """The flight that stands for a group: that of the median ATE."""

    group: Group
    errors: TrajectoryErrors
    breaks: tuple[int, ...]
    seed: int

    def broken(self, values: Float) -> Float:
        """``values`` (N, ...) by pose, with NaN wherever a line must not be drawn."""
        return np.insert(values, self.breaks, np.nan, axis=0)


@dataclass(frozen=True)
class Course:
    """What is drawn of one recording; every detector and back-end that has an error."""

    look: Look
    drawn: tuple[Drawn, ...]

    @classmethod
    def of(cls, found: Sequence[Group]) -> Course | None:
        """``found`` are the groups of one recording; None where none of them has an error."""
        drawn = tuple(each for group in found if (each := _median(group)))
        return cls(Look.of([each.group for each in drawn]), drawn) if drawn else None

    def columns(self) -> Iterator[tuple[str, list[Drawn]]]:
        for backend in self.look.backends:
            yield backend, [each for each in self.drawn if each.group.cell.backend == backend]

    @property
    def truth(self) -> Float:
        """(N, 3) of the longest stretch that was compared."""
        return max((each.errors.truth.p_WB for each in self.drawn), key=len)

    def time_s(self, t_ns: Int) -> Float:
        """Of stamps, since the first estimate of any: whoever began later stays behind."""
        begin_ns = min(int(each.errors.estimate.t_ns[0]) for each in self.drawn)
        return np.asarray((t_ns - begin_ns) / NS_PER_S)

    def times(self, of: Drawn) -> Float:
        """That of the poses ``of`` a flight, broken as its values are."""
        return of.broken(self.time_s(of.errors.estimate.t_ns))

    def bounds(self) -> tuple[Float, Float]:
        """Corners (3,) of a box around the truth, and around the estimates as far as they stay near it."""
        low, high = self.truth.min(axis=0), self.truth.max(axis=0)
        size = float((high - low).max())
        every = np.concatenate([each.errors.estimate.p_WB for each in self.drawn])
        low, high = np.maximum(every.min(axis=0), low - 0.5 * size), np.minimum(every.max(axis=0), high + 0.5 * size)
        low, high = np.minimum(low, self.truth.min(axis=0)), np.maximum(high, self.truth.max(axis=0))
        thin = np.maximum(0.12 * size - (high - low), 0.0) / 2.0
        return low - thin - 0.05 * size, high + thin + 0.05 * size

    def explain(self, figure: Figure, text: str) -> None:
        counts = {each.group.evaluated for each in self.drawn}
        shown = "" if counts == {1} else " Shown: the seed of the median ATE, of two the worse."
        explain(figure, f"{text}{shown} {data_caption([each.group for each in self.drawn])}")


def trajectories_3d(course: Course) -> Figure:
    """Paths in perspective."""
    figure = _figure(course, 4.7)
    low, high = course.bounds()
    columns = list(course.columns())
    for k, (backend, drawn) in enumerate(columns):
        ax: Any = figure.add_subplot(1, len(columns), k + 1, projection="3d", computed_zorder=False)
        ax.plot(*course.truth.T, **{**TRUTH, "lw": 4.0})
        for each in drawn:
            ax.plot(*each.broken(each.errors.estimate.p_WB).T, color=_colour(course, each), lw=1.6)
        ax.plot(*course.truth[0], **_START)
        for axis, lo, hi in zip("xyz", low, high, strict=True):
            getattr(ax, f"set_{axis}lim")(lo, hi)
            getattr(ax, f"set_{axis}label")(f"{axis} [m]", labelpad=6 if axis != "z" else -2)
        ax.set_box_aspect(high - low, zoom=1.05)
        ax.locator_params(nbins=5)
        ax.locator_params(axis="z", nbins=3)
        ax.view_init(elev=28, azim=-58)
        ax.set_title(backend, loc="center")
    _legend(figure, course)
    course.explain(figure, "Estimates aligned with the ground truth by position + yaw.")
    return figure


def top_view(course: Course) -> Figure:
    """Paths from above: y over x."""
    return _projection(course, 0, 1, "y [m]", side_by_side=True)


def side_view(course: Course) -> Figure:
    """Paths from the side: the altitude over x."""
    return _projection(course, 0, 2, "z (up) [m]", side_by_side=False)


def translation_error(course: Course) -> Figure:
    """Position error by axis over time, the +-20 cm band shaded, and how much of the time is inside."""
    names = ("x error [m]", "y error [m]", "z (up) error [m]")
    figure, panels = _panels(course, 3, 8.6)
    for (backend, drawn), column in zip(course.columns(), panels.T, strict=True):
        shares = [inside(each.errors) for each in drawn]
        for k, (ax, axis) in enumerate(zip(column, "xyz", strict=True)):
            ax.axhspan(-BAND_M, BAND_M, **_BAND)
            ax.axhline(0.0, color="black", lw=0.8)
            for each, share in zip(drawn, shares, strict=True):
                _plot(ax, course, each, each.errors.position_m[:, k], f"{share[axis]:.1f} % inside")
            _legend_above(ax, drawn)
        column[0].set_title(backend, pad=24)
    _finish(figure, panels, names)
    sizes = [[each.errors.position_m for each in drawn] for _, drawn in course.columns()]
    _scale(panels, sizes, symmetric=True, least=1.2 * BAND_M)
    _legend(figure, course, truth=False, band=True)
    about = f"Estimate minus ground truth in the world's axes, aligned by position + yaw over the whole path; ±{_CM} cm"
    course.explain(figure, f"{about} shaded, beside how much of the estimated time is inside.")
    return figure


def rotation_error(course: Course) -> Figure:
    """Rotation error about each axis over time."""
    names = ("roll error [deg]", "pitch error [deg]", "yaw error [deg]")
    figure, panels = _panels(course, 3, 8.2)
    for (backend, drawn), column in zip(course.columns(), panels.T, strict=True):
        for k, ax in enumerate(column):
            ax.axhline(0.0, color="black", lw=0.8)
            for each in drawn:
                _plot(ax, course, each, each.errors.rotation_rpy_deg[:, k])
        column[0].set_title(backend)
    _finish(figure, panels, names)
    _scale(panels, [[each.errors.rotation_rpy_deg for each in drawn] for _, drawn in course.columns()], symmetric=True)
    _legend(figure, course, truth=False)
    course.explain(figure, "Roll, pitch, yaw about the world's x, y, z, aligned by position + yaw over the whole path.")
    return figure


def comparison(course: Course) -> Figure:
    """Both methods' translation and rotation error, as one size each."""
    names = ("translation error [m]", "rotation error [deg]")
    figure, panels = _panels(course, 2, 6.6)
    for (backend, drawn), column in zip(course.columns(), panels.T, strict=True):
        for ax, measure, unit in zip(column, _SIZES, ("m", "deg"), strict=True):
            for each in drawn:
                size = measure(each.errors)
                _plot(ax, course, each, size, f"RMSE {np.sqrt(np.mean(size**2)):.3g} {unit}")
            _legend_above(ax, drawn)
        column[0].set_title(backend, pad=24)
    _finish(figure, panels, names)
    for row, measure in zip(panels, _SIZES, strict=True):
        sizes = [[measure(each.errors)[:, None] for each in drawn] for _, drawn in course.columns()]
        _scale(row[None], sizes, symmetric=False)
    _legend(figure, course, truth=False)
    course.explain(figure, "Distance from the truth and angle to it, aligned by position + yaw over the whole path.")
    return figure


_SIZES: tuple[Callable[[TrajectoryErrors], Float], ...] = (
    lambda errors: np.asarray(np.linalg.norm(errors.position_m, axis=1)),
    lambda errors: rotation_error_deg(errors.estimate, errors.truth),
)


def _median(group: Group) -> Drawn | None:
    flight = group.median_flight()
    if flight is None or (errors := flight.task.errors) is None or (run := flight.task.run) is None:
        return None
    evaluated = Evaluated("", run, None, None, errors, segment_starts_ns=run.segment_starts_ns())
    return Drawn(group, errors, tuple(evaluated.breaks(errors.estimate.t_ns).tolist()), flight.seed)


def _colour(course: Course, each: Drawn) -> str:
    return course.look.colour(each.group.cell.detector)


def _plot(ax: Axes, course: Course, each: Drawn, values: Float, label: str | None = None) -> None:
    """``values`` (N,) of a flight over its time."""
    ax.plot(course.times(each), each.broken(values), color=_colour(course, each), lw=1.5, label=label)


def _legend_above(ax: Axes, drawn: Sequence[Drawn]) -> None:
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=len(drawn), fontsize=10.5, borderpad=0.1)


def _figure(course: Course, height: float) -> Figure:
    from matplotlib.figure import Figure

    width = max(_NARROWEST_INCH, _COLUMN_INCH * len(course.look.backends))
    return Figure(figsize=(width, height), layout="constrained")


def _panels(course: Course, rows: int, height: float) -> tuple[Figure, Any]:
    figure = _figure(course, height)
    return figure, figure.subplots(rows, len(course.look.backends), sharex=True, squeeze=False)


def _finish(figure: Figure, panels: Any, names: Sequence[str]) -> None:
    for row, name in zip(panels, names, strict=True):
        row[0].set_ylabel(name)
    for ax in panels[-1]:
        ax.set_xlabel("time since the first estimate [s]")
        ax.margins(x=0.01)
    figure.align_ylabels(panels[:, 0])


def _scale(panels: Any, columns: Sequence[Sequence[Float]], *, symmetric: bool, least: float = 0.0) -> None:
    """Limits (rows of ``panels``, by axis of the values): one for all columns, or one each where they differ much."""
    for k, row in enumerate(panels):
        tops = [max(least, *(1.08 * float(np.abs(values[:, k]).max()) for values in column)) for column in columns]
        if max(tops) <= _SPREAD * min(tops):
            tops = [max(tops)] * len(tops)
        for ax, top in zip(row, tops, strict=True):
            ax.set_ylim(-top if symmetric else 0.0, top)


def _projection(course: Course, across: int, up: int, name: str, *, side_by_side: bool) -> Figure:
    from matplotlib.figure import Figure

    low, high = course.bounds()
    width, height = (high - low)[[across, up]]
    count = len(course.look.backends)
    if side_by_side:
        size, shape = (
            (max(_NARROWEST_INCH, _COLUMN_INCH * count), min(_COLUMN_INCH * height / width, 9.0) + 1.3),
            (1, count),
        )
    else:
        size, shape = (10.0, count * (min(8.6 * height / width, 5.0) + 0.6) + 1.6), (count, 1)
    figure = Figure(figsize=size, layout="constrained")
    panels: Any = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    for (backend, drawn), ax in zip(course.columns(), panels.flat, strict=True):
        ax.plot(course.truth[:, across], course.truth[:, up], **{**TRUTH, "lw": 4.0})
        for each in drawn:
            p_W = each.broken(each.errors.estimate.p_WB)
            ax.plot(p_W[:, across], p_W[:, up], color=_colour(course, each), lw=1.5)
        ax.plot(*course.truth[0, [across, up]], **_START)
        ax.set_aspect("equal")
        ax.set_xlim(low[across], high[across])
        ax.set_ylim(low[up], high[up])
        ax.set_title(backend)
    for ax in panels[-1]:
        ax.set_xlabel("x [m]")
    for ax in panels[:, 0]:
        ax.set_ylabel(name)
    _legend(figure, course)
    course.explain(figure, "Estimates aligned with the ground truth by position + yaw.")
    return figure


def _legend(figure: Figure, course: Course, *, truth: bool = True, band: bool = False) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [Line2D([], [], **{**TRUTH, "lw": 4.0}), Line2D([], [], **_START)] if truth else []
    handles += course.look.handles(of_backends=False)
    legend(figure, [*handles, *([Patch(label=f"±{_CM} cm", **_BAND)] if band else [])])
