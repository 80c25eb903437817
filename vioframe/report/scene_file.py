"""A picture of a scene in a file: the image with its legend, its scale and a line that says how to read it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.errors import RunError
from vioframe.report.scene import Scene
from vioframe.report.scene_drawing import TRUTH_RGB, draw, height_colours, rgb
from vioframe.report.scene_grid import AXES_RGB, Grid
from vioframe.report.scene_picture import render
from vioframe.report.scene_view import View
from vioframe.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 100
_MAX_TICKS = 13
_TEXT = "#555555"


def save_picture(scene: Scene, grid: Grid, view: View, path: Path, caption: str) -> None:
    """Write ``scene`` as seen in ``view``, with the ``caption`` below, as the PNG file ``path`` of just that size."""
    figure = _figure(scene, grid, view, caption)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=_DPI, format="png")
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another name") from error


def _figure(scene: Scene, grid: Grid, view: View, caption: str) -> Figure:
    from matplotlib.figure import Figure

    drawing = draw(scene, grid, view)
    figure = Figure(figsize=(view.size[0] / _DPI, view.size[1] / _DPI), dpi=_DPI)
    figure.figimage(render(drawing, view), origin="upper")
    # Text grows with the picture: it is looked at as a whole.
    scale = view.scale
    _tick_labels(figure, grid, view, scale)
    _legend(figure, scene, scale)
    if drawing.heights is not None:
        _height_scale(figure, drawing.heights, scale)
    figure.text(0.012, 0.014, caption, fontsize=11 * scale, color=_TEXT)
    return figure


def _legend(figure: Figure, scene: Scene, scale: float) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=rgb(f.number), lw=4 * scale, label=f.name) for f in scene.flights]
    if scene.truths:
        truth = Line2D([], [], color=TRUTH_RGB, lw=4 * scale, ls=(0, (1.6, 1.6)), label="ground truth")
        handles.insert(0, truth)
    figure.legend(
        handles=handles,
        loc="upper left",
        fontsize=14 * scale,
        frameon=True,
        framealpha=0.85,
        edgecolor="none",
        handlelength=2.6,
        borderaxespad=0.8,
    )


def _tick_labels(figure: Figure, grid: Grid, view: View, scale: float) -> None:
    """Metres along the two edges of the grid that are nearest to the eye, and what they are."""
    corner = grid.nearest_corner(view.eye)
    away = np.sign(corner[:2] - 0.5 * (grid.low + grid.high))
    for axis, name in enumerate("xy"):
        ticks = grid.ticks(axis)
        for tick in ticks[:: 1 + (len(ticks) - 1) // _MAX_TICKS]:
            at = _beside(corner, axis, float(tick), 0.35 * grid.step_m * away[1 - axis])
            _text(figure, view, at, f"{tick:g}", fontsize=11 * scale, color=_TEXT)
        at = _beside(corner, axis, 0.5 * float(grid.low[axis] + grid.high[axis]), 0.9 * grid.step_m * away[1 - axis])
        _text(figure, view, at, f"{name} [m]", fontsize=13 * scale, color=AXES_RGB[name], weight="bold")


def _beside(corner: Float, axis: int, along: float, off: float) -> Float:
    """A point (3,) ``off`` metres beside the edge of the grid that runs along ``axis`` through ``corner``."""
    p = corner.copy()
    p[axis] = along
    p[1 - axis] += off
    return p


def _text(figure: Figure, view: View, p_W: Float, text: str, **look: Any) -> None:
    if view.depth(p_W[None])[0] <= 0.0:
        return
    x, y = view.project(p_W[None])[0] + 0.5
    width, height = view.size
    if 0.0 < x < width and 0.0 < y < height:
        figure.text(x / width, 1.0 - y / height, text, ha="center", va="center", **look)


def _height_scale(figure: Figure, heights: tuple[float, float], scale: float) -> None:
    ax: Any = figure.add_axes((0.76, 0.042, 0.2, 0.014), zorder=1)
    colours = height_colours(np.linspace(0.0, 1.0, 256))
    ax.imshow(colours[None], origin="lower", aspect="auto", extent=(*heights, 0.0, 1.0))
    ax.set_yticks([])
    ax.tick_params(axis="x", labelsize=10.5 * scale, colors=_TEXT)
    ax.set_title("height of the landmarks [m]", fontsize=11 * scale, color=_TEXT, pad=4 * scale)
    for spine in ax.spines.values():
        spine.set_visible(False)
