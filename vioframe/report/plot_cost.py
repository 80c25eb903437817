"""Figures of how a run went: time by stage, and features over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.report.style import PALETTE_SIZE, caption, colour, legend_above, line
from vioframe.runs.evaluated import Evaluated

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HATCHES = ("", "///", "...", "xx")


def timing(runs: Sequence[Evaluated]) -> Figure:
    """Mean milliseconds a frame, a bar a run, stacked by stage."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    # What loop closure made of a run has no times of its own.
    timed = [(run.name, stage_ms) for run in runs if (stage_ms := run.stage_ms())]
    spent = [stage_ms for _, stage_ms in timed]
    stages = list(dict.fromkeys(stage for each in spent for stage in each))
    figure = Figure(figsize=(10.0, 2.6 + 0.75 * len(timed) + 0.25 * (len(stages) // 3)), layout="constrained")
    ax: Any = figure.subplots()
    left = np.zeros(len(timed))
    handles = []
    for k, stage in enumerate(stages):
        hatch = _HATCHES[(k // PALETTE_SIZE) % len(_HATCHES)]
        look: dict[str, Any] = {"facecolor": colour(k), "hatch": hatch, "edgecolor": "white", "lw": 0.5}
        width = np.array([each.get(stage, 0.0) for each in spent])
        ax.barh(range(len(timed)), width, left=left, height=0.6, **look)
        left += width
        handles.append(Patch(**look, label=stage))
    for i, total in enumerate(left):
        ax.annotate(f"{total:.1f} ms", (total, i), xytext=(6, 0), textcoords="offset points", va="center")
    ax.set_yticks(range(len(timed)), [name for name, _ in timed])
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.12 * max(float(left.max()), 1e-3))
    ax.set_xlabel("mean time a frame [ms]")
    ax.grid(visible=False, axis="y")
    legend_above(figure, handles)
    caption(
        figure,
        "Without reading and decoding the images.",
    )
    return figure


def tracks(runs: Sequence[Evaluated]) -> Figure:
    """Features tracked, and new among them, in each frame."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.0), layout="constrained")
    panels: Any = figure.subplots(2, 1, sharex=True)
    handles = []
    for i, run in enumerate(runs):
        counts = run.folder.tracks() if run.folder else None
        if counts is None:
            continue
        time_s = (counts.frames_ns - counts.frames_ns[0]) * 1e-9
        handles += panels[0].plot(time_s, counts.tracked, **line(i), label=run.name)
        # In the first frame every feature is new, which would hide all that follows.
        panels[1].plot(time_s[1:], counts.new[1:], **{**line(i), "lw": 1.0})
    for ax, name in zip(panels, ("features in the frame", "new among them"), strict=True):
        ax.set_ylabel(name)
        ax.set_ylim(bottom=0)
        ax.margins(x=0.01)
    panels[1].set_xlabel("time since the first frame [s]")
    figure.align_ylabels(panels)
    legend_above(figure, handles)
    return figure
