"""Box plots of relative errors by length of the stretch, and NEES over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from vioframe.report.suite.captions import data_caption
from vioframe.report.suite.figures_flights import Course
from vioframe.report.suite.look import Look, explain, legend, log_scale
from vioframe.report.suite.pooled import RelativePool
from vioframe.report.suite.statistics import Group
from vioframe.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HONEST = "#009E73"
_PARTS = ("orientation", "position", "pose")
_HATCHES = ("", "////", "....", "xxxx")


def relative_error(pools: Sequence[RelativePool]) -> Figure:
    """Translation and yaw error by length, a box a contender; the boxes of a detector share its colour."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    look = Look.of([pool.group for pool in pools])
    lengths = sorted(set().union(*(pool.stretches for pool in pools)))
    figure = Figure(figsize=(max(10.0, 0.42 * len(lengths) * len(pools) + 2.0), 8.2), layout="constrained")
    panels: Any = figure.subplots(2, 1, sharex=True)
    width = 0.82 / len(pools)
    handles = []
    for i, pool in enumerate(pools):
        cell = pool.group.cell
        face, hatch = look.colour(cell.detector), _HATCHES[look.backends.index(cell.backend) % len(_HATCHES)]
        for k, length in enumerate(lengths):
            if (found := pool.stretches.get(length)) is None:
                continue
            place = k + (i - 0.5 * (len(pools) - 1)) * width
            _box(panels[0], found.translation_percent, place, 0.82 * width, face, hatch)
            _box(panels[1], found.yaw_deg, place, 0.82 * width, face, hatch)
        label = f"{cell.detector}, {cell.backend}"
        handles.append(Patch(facecolor=face, edgecolor="white", hatch=hatch, label=label))
    of_path = pools[0].of_path
    panels[0].set_ylabel("translation error [% of length]")
    panels[1].set_ylabel("yaw error [deg]")
    panels[1].set_xlabel("length of the stretch [% of the path]" if of_path else "length of the stretch [m]")
    panels[1].set_xticks(range(len(lengths)), [f"{100 * d if of_path else d:g}" for d in lengths])
    for ax in panels:
        ax.set_ylim(bottom=0.0)
        ax.set_xlim(-0.5, len(lengths) - 0.5)
        ax.grid(visible=False, axis="x")
        for k in range(1, len(lengths)):
            ax.axvline(k - 0.5, color="#dddddd", lw=0.8)
    figure.align_ylabels(panels)
    legend(figure, handles)
    counts = sorted({pool.flights for pool in pools})
    flown = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
    explain(
        figure,
        "Every pose starts a stretch, aligned at its first pose; stretches overlap. Boxes: quartiles; whiskers: 5 to "
        f"95 %. Pooled over the {flown} flights of a contender. {data_caption([pool.group for pool in pools])}",
    )
    return figure


def ate_by_sequence(found: Sequence[Group]) -> Figure:
    """ATE of every flight by recording, on a logarithmic axis; a bar marks the mean, a number the flights without."""
    from matplotlib.figure import Figure

    look = Look.of(found)
    recordings = list(dict.fromkeys((group.cell.sequence, group.cell.data) for group in found))
    contenders = list(dict.fromkeys(group.cell.contender for group in found))
    figure = Figure(figsize=(max(10.0, 0.22 * len(recordings) * len(contenders) + 2.0), 6.2), layout="constrained")
    ax: Any = figure.subplots()
    width = 0.8 / len(contenders)
    for group in found:
        cell = group.cell
        across = contenders.index(cell.contender) - 0.5 * (len(contenders) - 1)
        place = recordings.index((cell.sequence, cell.data)) + across * width
        shade, marker = look.colour(cell.detector), look.marker(cell.backend)
        if (ate := group.spread("ate_m")) is not None:
            ax.plot([place] * ate.n, ate.values, marker, ms=6, mfc="none", mec=shade, mew=1.4, ls="none")
            ax.plot([place - 0.4 * width, place + 0.4 * width], [ate.mean] * 2, color=shade, lw=2.4)
        if missing := group.count - group.evaluated:
            where = {"xytext": (0, -2), "textcoords": "offset points", "xycoords": ax.get_xaxis_transform()}
            ax.annotate(f"✗{missing}", (place, 1.0), color=shade, ha="center", va="top", fontsize=10, **where)
    for k in range(1, len(recordings)):
        ax.axvline(k - 0.5, color="#dddddd", lw=0.8)
    log_scale(ax)
    ax.margins(y=0.1)
    ax.set_xlim(-0.5, len(recordings) - 0.5)
    ax.set_xticks(range(len(recordings)), [f"{name}\n{data}" for name, data in recordings], fontsize=10.5)
    ax.tick_params(axis="x", length=0)
    ax.set_ylabel("ATE, position + yaw [m]")
    ax.grid(visible=False, axis="x")
    legend(figure, look.handles())
    explain(
        figure, f"A mark a flight; the bar is their mean; ✗: flights without an error to show. {data_caption(found)}"
    )
    return figure


def nees_over_time(course: Course) -> Figure | None:
    """NEES by part of the pose with the 95 % band of a single instant, a column a back-end; None without any."""
    from matplotlib.figure import Figure

    columns = [(name, own) for name, all_ in course.columns() if (own := [d for d in all_ if d.errors.nees])]
    if not columns:
        return None
    figure = Figure(figsize=(max(8.0, 5.6 * len(columns)), 8.4), layout="constrained")
    panels: Any = figure.subplots(3, len(columns), sharex=True, sharey="row", squeeze=False)
    for (backend, drawn), column in zip(columns, panels.T, strict=True):
        for ax, part in zip(column, _PARTS, strict=True):
            for each in drawn:
                nees = next(n for n in each.errors.nees if n.part == part)
                label = f"mean {nees.mean:.3g}, {100 * nees.inside:.0f} % inside"
                shade = course.look.colour(each.group.cell.detector)
                ax.plot(course.time_s(nees.t_ns), nees.values, lw=1.3, color=shade, label=label)
                ax.axhspan(*nees.band, color=_HONEST, alpha=0.2 / len(drawn), lw=0)
                dof = nees.dof
            ax.axhline(dof, color=_HONEST, lw=1.2)
            ax.set_yscale("log")
            # The first instants are the gauge's own, without error.
            ax.set_ylim(bottom=0.3 * nees.band[0])
            ax.yaxis.set_major_formatter("{x:g}")
            ax.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=len(drawn), fontsize=10, borderpad=0.1)
            if ax in panels[:, 0]:
                ax.set_ylabel(f"{part}\nNEES (ideally {dof})")
        column[0].set_title(backend, pad=24)
        column[-1].set_xlabel("time since the first estimate [s]")
    figure.align_ylabels(panels[:, 0])
    legend(figure, course.look.handles(of_backends=False))
    course.explain(
        figure,
        "Green: 95 % of the instants of an honest filter, and its mean; above, the filter is surer of itself than it "
        "should be. Position and yaw fixed at the first pose.",
    )
    return figure


def _box(ax: Any, values: Float, place: float, width: float, face: str, hatch: str) -> None:
    ax.boxplot(
        [values],
        positions=[place],
        widths=width,
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        manage_ticks=False,
        boxprops={"facecolor": face, "edgecolor": "white", "hatch": hatch, "lw": 0.6},
        medianprops={"color": "black", "lw": 2},
        whiskerprops={"color": face, "lw": 1.4},
        capprops={"color": face, "lw": 1.4},
    )
