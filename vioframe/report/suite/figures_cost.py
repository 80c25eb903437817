"""Figures of speed: detectors beside what the thesis quotes, and a frame's time by stage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.bench.detectors.quoted import TABLE_3_2
from vioframe.report.style import PALETTE_SIZE, colour
from vioframe.report.suite.captions import data_caption
from vioframe.report.suite.look import explain, legend
from vioframe.report.suite.results import TaskResult
from vioframe.report.suite.statistics import Group
from vioframe.report.suite.tables_cost import machines, pooled_stages

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_QUOTED, _MEASURED = "#999999", colour(0)
_HATCHES = ("", "///", "...", "xx")


def detector_speed(task: TaskResult) -> Figure:
    """Quoted and measured frames a second in two panels, because they are not like for like."""
    from matplotlib.figure import Figure

    rows = sorted(task.result["rows"], key=lambda row: -row["measured"]["fps"])
    names = [row["detector"] for row in rows]
    known = {name.partition(":")[0] for name in names}
    unmeasured = [name for name in TABLE_3_2 if name not in known]
    figure = Figure(figsize=(11.0, 0.42 * (len(rows) + len(unmeasured)) + 2.3), layout="constrained")
    panels: Any = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(rows))
    low, fps, high = np.array(
        [
            (row["measured"]["fps_quartiles"][0], row["measured"]["fps"], row["measured"]["fps_quartiles"][1])
            for row in rows
        ]
    ).T
    panels[1].barh(places, fps, color=_MEASURED, height=0.62)
    panels[1].errorbar(fps, places, xerr=(fps - low, high - fps), fmt="none", color="#222222", lw=1.2, capsize=3)
    for k, (value, end, row) in enumerate(zip(fps, high, rows, strict=True)):
        _label(panels[1], end, k, f"{value:.3g}  ({row['measured']['on']})")
    for place in range(len(rows), len(rows) + len(unmeasured)):
        _label(panels[1], 0.0, place, "not measured here")
    quoted = {place: TABLE_3_2[name] for place, name in enumerate(unmeasured, start=len(rows))}
    quoted |= {k: TABLE_3_2[row["detector"].partition(":")[0]] for k, row in enumerate(rows) if row["quoted"]}
    panels[0].barh(list(quoted), [each.fps for each in quoted.values()], color=_QUOTED, height=0.62)
    for place, each in quoted.items():
        _label(panels[0], each.fps, place, f"{each.fps:g}{'*' if 'another paper' in each.source else ''}")
    for place in set(range(len(names) + len(unmeasured))) - set(quoted):
        _label(panels[0], 0.0, place, "not quoted")
    panels[0].set_yticks(range(len(names) + len(unmeasured)), [_folded(name) for name in (*names, *unmeasured)])
    panels[0].invert_yaxis()
    settings = task.result["settings"]
    for ax, title in zip(panels, ("Quoted in the thesis, Table 3.2", "Measured here"), strict=True):
        ax.set_title(title)
        ax.set_xlabel("frames a second")
        ax.set_xlim(0.0, 1.32 * ax.dataLim.x1)
        ax.grid(visible=False, axis="y")
        ax.tick_params(axis="y", length=0)
    width, height = settings["resolution"]
    explain(
        figure,
        f"{width} x {height}, {settings['max_points']} keypoints asked for. Measured: median and quartiles of single "
        f"images ({settings['images']}), on {'; '.join(settings['devices'])}. Quoted: other machines, classics on a "
        "CPU beside networks on a GPU (* from another paper, hardware not stated).",
    )
    return figure


def timing(found: Sequence[Group]) -> Figure | None:
    """Mean milliseconds a frame, a bar a contender, stacked by stage; None where nothing was timed."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    means = pooled_stages(found)
    if not means:
        return None
    kinds = {data for data, _, _ in means}
    names = [f"{detector}\n{backend}" + (f" ({data})" if len(kinds) > 1 else "") for data, detector, backend in means]
    stages = list(dict.fromkeys(stage for each in means.values() for stage in each))
    figure = Figure(figsize=(11.0, 2.4 + 0.66 * len(means) + 0.22 * (len(stages) // 4)), layout="constrained")
    ax: Any = figure.subplots()
    left = np.zeros(len(means))
    handles = []
    for k, stage in enumerate(stages):
        hatch = _HATCHES[(k // PALETTE_SIZE) % len(_HATCHES)]
        look: dict[str, Any] = {"facecolor": colour(k), "hatch": hatch, "edgecolor": "white", "lw": 0.5}
        width = np.array([each.get(stage, 0.0) for each in means.values()])
        ax.barh(range(len(means)), width, left=left, height=0.64, **look)
        left += width
        handles.append(Patch(**look, label=stage))
    for place, total in enumerate(left):
        _label(ax, total, place, f"{total:.1f} ms")
    ax.set_yticks(range(len(means)), names)
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.12 * float(left.max()))
    ax.set_xlabel("mean time a frame [ms]")
    ax.grid(visible=False, axis="y")
    legend(figure, handles)
    explain(
        figure,
        "Mean over all flights that initialised; without reading and decoding images. "
        f"{machines(found)} {data_caption(found)}",
    )
    return figure


def _label(ax: Any, x: float, y: float, text: str) -> None:
    ax.annotate(text, (x, y), xytext=(6, 0), textcoords="offset points", va="center", fontsize=10.5, color="#333333")


def _folded(name: str) -> str:
    return name.replace(":", ":\n", 1).replace(",", ",\n")
