"""Draws figures into files: the traces and layouts that a report's page shows, with matplotlib.

A column a back-end, or one for each of several pictures side by side: on paper nothing can be hidden. Only what
:mod:`.figures` makes use of is drawn: lines, markers, areas, paths in 3-D, boxes and stacked bars.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import ceil
from pathlib import Path
from textwrap import fill
from types import MappingProxyType
from typing import Any

import numpy as np

from vioframe.errors import RunError
from vioframe.report.figures import Case, Figure, Layout, Trace
from vioframe.report.style import DASHES, RC, SERIES

_DPI = 200
"""Twice what a figure is laid out for."""
_COLUMN_INCH, _NARROWEST_INCH, _ROW_INCH = 5.0, 8.0, 2.5
_LETTERS_AN_INCH = 12.6
_SPATIAL = 0.45
"""Factor from the width of a line in space, which is drawn finer on paper."""
_SPREAD = 4.0
"""Columns whose errors differ by more than this factor each have a scale of their own."""
_DASHES = dict(zip(DASHES, ("-", (0, (5, 1.6)), (0, (1.5, 1.2)), (0, (6, 1.5, 1.5, 1.5))), strict=True))
_MARKERS = {"circle": "o", "square": "s", "triangle-up": "^", "diamond": "D", "line-ew": "_"}
_NO_COLOUR = "#555555"
"""Stands for all colours in a legend."""
_THICK = 2.5
"""Points; a line that is broader than this is the ground truth, below all others."""
_VIEWS = {"top_view": (0, 1), "side_view": (0, 2)}
"""What paths in 3-D are drawn from as well, by the axes that are seen."""


def write_figures(
    figures: Sequence[Figure],
    folder: Path,
    *,
    formats: Sequence[str] = ("png",),
    names: Mapping[str, str] = MappingProxyType({}),
) -> list[Path]:
    """``NAME.png`` or other ``formats`` in ``folder`` for each case that has files; ``names`` has other ones for some.

    Raises :class:`RunError` where they cannot be written.
    """
    import matplotlib as mpl

    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with mpl.rc_context(dict(RC)):
            for ending in formats:
                # Drawn anew for each: the layout of one leaves traces in the next.
                for name, drawn in drawings(figures, names):
                    written.append(folder / f"{name}.{ending}")
                    # Without its date an SVG is the same file for the same results.
                    drawn.savefig(written[-1], dpi=_DPI, metadata={"Date": None} if ending == "svg" else None)
    except OSError as error:
        raise RunError(f"cannot write figures to {folder}: {error.strerror}; choose another --out") from error
    return written


def drawings(figures: Sequence[Figure], names: Mapping[str, str]) -> Iterator[tuple[str, Any]]:
    """Names of files and what is in them, each drawn when its turn comes."""
    for figure in figures:
        for case in figure.cases.values():
            if case.files is not None:
                caption = f"{figure.caption} {case.caption}"
                views = {view: _seen_along(case, axes) for view, axes in _VIEWS.items()} if figure.views else {}
                for name, shown in {figure.name: case, **views}.items():
                    yield f"{case.files}{name}" if case.files else names.get(name, name), _draw(shown, caption)


def _seen_along(case: Case, axes: tuple[int, int]) -> Case:
    """Paths in 3-D as they are seen without perspective, along the axis that is not one of ``axes``."""
    across, up = ("xyz"[k] for k in axes)
    traces = []
    for trace in case.pictures[0][0]:
        line = {"line": {**trace["line"], "width": _SPATIAL * trace["line"]["width"]}} if "line" in trace else {}
        traces.append({**trace, **line, "type": "scatter", "x": trace[across], "y": trace[up]})
    titles = {"x": "x [m]", "y": "y [m]", "z": "z (up) [m]"}
    layout = {f"{axis}axis": {"title": {"text": titles[of]}} for axis, of in (("x", across), ("y", up))}
    return Case([(traces, {**layout, "equal": True})], case.caption)


def _draw(case: Case, caption: str) -> Any:
    """One figure: a column a picture or a back-end, a row a panel."""
    from matplotlib.figure import Figure as Canvas

    columns = list(_columns(case))
    rows = max(1, sum(key.startswith("yaxis") for key in columns[0][2]))
    spatial = any(trace["type"] == "scatter3d" for trace in columns[0][1])
    width = max(_NARROWEST_INCH, (_COLUMN_INCH if rows > 1 or spatial else 6.0) * len(columns))
    height = 6.2 if spatial else max(_ROW_INCH * rows, _categories(columns)) + 1.5
    equal = bool(columns[0][2].get("equal"))
    if equal:
        every = (np.concatenate([trace[axis] for trace in columns[0][1]]) for axis in "xy")
        across, up = (np.nanmax(values) - np.nanmin(values) for values in every)
        height = float(np.clip(6.0 * up / across, 1.2, 8.0)) + 1.6
    canvas = Canvas(figsize=(width, height), layout="constrained")
    how: dict[str, Any] = {"subplot_kw": {"projection": "3d", "computed_zorder": False}} if spatial else {}
    panels: Any = canvas.subplots(rows, len(columns), squeeze=False, **how)
    for k, (title, traces, layout) in enumerate(columns):
        for row, ax in enumerate(panels[:, k]):
            own = [trace for trace in traces if trace.get("yaxis", "y") == f"y{row + 1 if row else ''}"]
            noted = _panel(ax, own, layout, row, by_backend=bool(title))
            ax.set_ylabel("" if k and not spatial else ax.get_ylabel())
            if row == 0:
                ax.set_title(title or layout.get("title", {}).get("text", ""), pad=6 + 16 * noted)
    for row in () if spatial or equal else panels:
        _same_scale(row)
    canvas.align_ylabels(() if spatial else panels[:, 0])
    _legend(canvas, panels.flat)
    letters = int(_LETTERS_AN_INCH * width)
    canvas.supxlabel(fill(caption, letters), fontsize=10, color="#555555", x=0.01, ha="left")
    return canvas


def _columns(case: Case) -> Iterator[tuple[str, Sequence[Trace], Layout]]:
    """(back-end, traces, layout); what is nobody's is in all of them."""
    for traces, layout in case.pictures:
        traces = [{**t, "x": traces[k - t["meta"].get("x_back", 0)]["x"]} for k, t in enumerate(traces)]
        backends = list(dict.fromkeys(t["meta"]["backend"] for t in traces if "backend" in t["meta"]))
        detectors = {t["meta"]["detector"] for t in traces if "detector" in t["meta"]}
        apart = len(case.pictures) == 1 and len(backends) > 1 and len(detectors) > 1
        over_time = all(t["type"] in ("scatter", "scatter3d") and t["mode"] == "lines" for t in traces)
        if not (apart and over_time):
            yield "", traces, layout
            continue
        for backend in backends:
            yield backend, [t for t in traces if t["meta"].get("backend", backend) == backend], layout


def _panel(ax: Any, traces: Sequence[Trace], layout: Layout, row: int, *, by_backend: bool) -> int:
    """Draw it; returns in how many lines its notes stand above it."""
    from matplotlib.lines import Line2D

    scene = layout.get("scene")
    places: dict[str, dict[str, int]] = {}
    for name in () if scene else ("x", "y"):
        places[name] = _set_axis(ax, name, layout.get(f"{name}axis{row + 1 if row else ''}", {}), traces)
    groups = list(dict.fromkeys(trace["offsetgroup"] for trace in traces if "offsetgroup" in trace))
    left: dict[Any, float] = {}
    for trace in traces:
        shift = (groups.index(trace["offsetgroup"]) + 0.5) / len(groups) - 0.5 if "offsetgroup" in trace else 0.0
        shift, width = 0.82 * shift, 0.68 / max(1, len(groups))
        line = trace.get("line", {})
        style = {"color": line.get("color"), "lw": max(0.4, (_SPATIAL if scene else 1.0) * 0.8 * line.get("width", 0))}
        style["ls"] = _dashes(line, by_backend)
        meta = trace["meta"]
        label = meta["detector"] if by_backend and "detector" in meta else meta.get("series", "")
        if trace["type"] == "scatter3d":
            dot = {"marker": "o", "ms": 5, "color": trace["marker"]["color"]} if "marker" in trace else {}
            ax.plot(trace["x"], trace["y"], trace["z"], **style | dot, label="" if dot else label)
        elif trace["type"] == "box":
            _boxes(ax, trace, [places["x"][name] + shift for name in trace["x"]], width, label)
        elif trace["type"] == "bar":
            begins = [left.get(name, 0.0) for name in trace["y"]]
            where = [places["y"][name] for name in trace["y"]]
            ax.barh(where, trace["x"], left=begins, height=0.64, color=trace["marker"]["color"], label=label)
            left |= {name: begin + x for name, begin, x in zip(trace["y"], begins, trace["x"], strict=True)}
        else:
            x, y = (_numbers(trace[axis], places[axis]) for axis in "xy")
            _scatter(ax, trace, x + shift, y, {**style, "label": label})
    for name, total in left.items():
        ax.annotate(
            f"{total:.1f} ms", (total, places["y"][name]), xytext=(6, 0), textcoords="offset points", va="center"
        )
    ax.margins(x=0.12 if left else 0.02)
    for shape in layout.get("shapes", ()):
        if shape["yref"] == f"y{row + 1 if row else ''}":
            ax.axhspan(shape["y0"], shape["y1"], color=shape["fillcolor"], alpha=shape["opacity"], lw=0)
    notes = [(trace, note) for trace in traces if (note := trace["meta"].get("note"))]
    if notes:
        lines = ((trace["line"], note) for trace, note in notes)
        handles = [
            Line2D([], [], color=line["color"], ls=_dashes(line, by_backend), label=note) for line, note in lines
        ]
        panel_inch = ax.figure.get_figwidth() / ax.get_gridspec().ncols - 1.0
        columns = _columns_that_fit(panel_inch, [note for _, note in notes], letters_an_inch=13.0)
        ax.legend(handles=handles, loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=columns, fontsize=9.5)
    if scene:
        _space(ax, scene)
    if layout.get("equal"):
        ax.set_aspect("equal", adjustable="datalim")
    return ceil(len(notes) / columns) if notes else 0


def _dashes(line: Mapping[str, Any], by_backend: bool) -> Any:
    """Those of a line, where panels do not tell back-ends apart already."""
    return "-" if by_backend else _DASHES[line.get("dash", "solid")]


def _scatter(ax: Any, trace: Trace, x: Any, y: Any, style: Mapping[str, Any]) -> None:
    marker = trace.get("marker", {})
    colour = marker.get("color") or style["color"]
    if trace.get("fill") == "toself":
        ax.fill(x, y, color=trace["fillcolor"], alpha=trace["opacity"], lw=0, label=style["label"])
        return
    if "lines" in trace["mode"]:
        below = style["lw"] > _THICK or "opacity" in trace
        ax.plot(x, y, **style, alpha=trace.get("opacity"), zorder=1.5 if below else 2)
    if trace["mode"] == "text":
        for place, top, said in zip(x, y, trace["text"], strict=True):
            ax.annotate(said, (place, top), color=trace["textfont"]["color"], ha="center", va="top", fontsize=9)
            ax.update_datalim([(place, top)])
    if "error_x" in trace:
        spans = (trace["error_x"]["arrayminus"], trace["error_x"]["array"])
        ax.errorbar(x, y, xerr=spans, fmt="none", color=trace["error_x"]["color"], lw=1.6)
    if "markers" in trace["mode"]:
        symbols = marker.get("symbol", "circle")
        symbols = symbols if isinstance(symbols, list) else [symbols] * len(x)
        for across, up, symbol in zip(x, y, symbols, strict=True):
            face = "white" if symbol.endswith("-open") else colour
            shape = _MARKERS[symbol.removesuffix("-open")]
            look = {"ls": "none", "marker": shape, "ms": 0.75 * marker["size"], "mfc": face, "mec": colour, "mew": 1.5}
            ax.plot(across, up, **look, zorder=4, label="" if "lines" in trace["mode"] else style["label"])


def _boxes(ax: Any, trace: Trace, places: Sequence[float], width: float, label: str) -> None:
    keys = {"lowerfence": "whislo", "q1": "q1", "median": "med", "q3": "q3", "upperfence": "whishi"}
    boxes = [dict(zip(keys.values(), five, strict=True)) for five in zip(*(trace[key] for key in keys), strict=True)]
    edge = {"color": trace["line"]["color"], "lw": 1.2}
    look = {"medianprops": {"color": "black", "lw": 1.6}, "whiskerprops": edge, "capprops": edge}
    face = {"facecolor": trace["fillcolor"], "edgecolor": edge["color"], "lw": 0.8}
    how: dict[str, Any] = {"showfliers": False, "patch_artist": True, "manage_ticks": False, "boxprops": face}
    ax.bxp(boxes, positions=places, widths=width, **how, **look)["boxes"][0].set_label(label)


def _set_axis(ax: Any, name: str, axis: Mapping[str, Any], traces: Sequence[Trace]) -> dict[str, int]:
    """Set up one axis as the layout has it; returns the places of its categories."""
    from matplotlib.ticker import LogLocator, NullFormatter

    getattr(ax, f"set_{name}label")(axis.get("title", {}).get("text", ""))
    mine = getattr(ax, f"{name}axis")
    if axis.get("type") == "log":
        getattr(ax, f"set_{name}scale")("log")
        mine.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if axis["dtick"] == "D2" else (1.0,), numticks=12))
        mine.set_major_formatter("{x:g}")
        mine.set_minor_formatter(NullFormatter())
    if "range" in axis:
        ends = axis["range"] if axis.get("type") != "log" else [10.0**end for end in axis["range"]]
        getattr(ax, f"set_{name}lim")(*ends)
    if "minallowed" in axis:
        ends = [value for trace in traces for value in trace[name] if value > 10.0 ** axis["minallowed"]]
        getattr(ax, f"set_{name}lim")(10.0 ** axis["minallowed"], 1.5 * max(ends, default=1.0))
    if "include" in (least := axis.get("autorangeoptions", {})):
        ax.update_datalim([(np.nan, end) for end in least["include"]], updatex=False)
    if axis.get("rangemode") == "tozero":
        ax.update_datalim([(0.0, 0.0)], updatex=name == "x", updatey=name == "y")
    texts = [value for trace in traces for value in trace.get(name, ()) if isinstance(value, str)]
    places = {value: k for k, value in enumerate(axis.get("categoryarray") or dict.fromkeys(texts))}
    if places:
        getattr(ax, f"set_{name}ticks")(range(len(places)), [value.replace("<br>", "\n") for value in places])
        getattr(ax, f"set_{name}lim")(-0.6, len(places) - 0.4)
        ax.grid(visible=False, axis=name)
    if axis.get("autorange") == "reversed":
        getattr(ax, f"invert_{name}axis")()
    if axis.get("showticklabels") is False:
        ax.tick_params(axis=name, labelbottom=False)
    return places


def _numbers(values: Any, places: Mapping[str, int]) -> Any:
    return np.array([places[value] if isinstance(value, str) else value for value in values], float)


def _space(ax: Any, scene: Mapping[str, Any]) -> None:
    for axis in "xyz":
        getattr(ax, f"set_{axis}label")(scene[f"{axis}axis"]["title"]["text"], labelpad=6 if axis != "z" else 2)
    ax.set_aspect("equal")
    ax.locator_params(nbins=5)
    ax.locator_params(axis="z", nbins=3)
    ax.view_init(elev=28, azim=-58)


def _same_scale(row: Sequence[Any]) -> None:
    """One scale for all columns, unless they differ much."""
    ends = np.array([ax.get_ylim() for ax in row])
    sizes = np.abs(np.diff(ends, axis=1))
    inverted = ends[0, 0] > ends[0, 1]
    if sizes.max() <= _SPREAD * sizes.min() and not inverted:
        for ax in row:
            ax.set_ylim(ends.min(), ends.max())


def _categories(columns: Sequence[tuple[str, Sequence[Trace], Layout]]) -> float:
    """Inches that the categories along the y axis take."""
    every = (value for _, traces, _ in columns for trace in traces for value in trace.get("y", ()))
    names = {value for value in every if isinstance(value, str)}
    return sum(0.49 + 0.24 * name.count("<br>") for name in names)


def _legend(canvas: Any, panels: Iterable[Any]) -> None:
    """One legend for all panels, above them, in as few lines as fit."""
    from matplotlib.patches import Polygon

    handles: dict[str, Any] = {}
    for ax in panels:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            # A line says more of its series than the area about it.
            if label not in handles or isinstance(handles[label], Polygon):
                handles[label] = handle
    if handles := _apart(handles):
        how: dict[str, Any] = {"loc": "outside upper left", "borderaxespad": 0.2}
        how["ncols"] = _columns_that_fit(canvas.get_figwidth(), list(handles), letters_an_inch=11.0)
        for shown in canvas.legend(list(handles.values()), list(handles), **how).get_lines():
            shown.set(lw=max(2.0, shown.get_linewidth()), alpha=1.0)


def _apart(handles: dict[str, Any]) -> dict[str, Any]:
    """Detectors by colour and back-ends by dashes or shade, where each is drawn with each and this says it shorter."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import PathPatch

    both = {label: handle for label, handle in handles.items() if SERIES in label}
    detectors, backends = (list(dict.fromkeys(label.split(SERIES)[k] for label in both)) for k in (0, 1))
    told = all(
        isinstance(handle, PathPatch) or (isinstance(handle, Line2D) and handle.get_linestyle() != "None")
        for handle in both.values()
    )
    if not told or len(both) < len(detectors) * len(backends) or len(both) <= len(detectors) + len(backends):
        return handles
    return (
        {label: handle for label, handle in handles.items() if label not in both}
        | {name: _alone(both[f"{name}{SERIES}{backends[0]}"], colour=True) for name in detectors}
        | {name: _alone(both[f"{detectors[0]}{SERIES}{name}"], colour=False) for name in backends}
    )


def _alone(handle: Any, *, colour: bool) -> Any:
    """What in a legend stands for the colour of a line or box, or for its dashes or shade."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    if isinstance(handle, Line2D):
        line = Line2D([], [])
        line.update_from(handle)
        line.set(**({"linestyle": "-"} if colour else {"color": _NO_COLOUR}))
        return line
    if colour:
        return Patch(color=handle.get_edgecolor())
    return Patch(facecolor=(_NO_COLOUR, handle.get_facecolor()[-1]), edgecolor=_NO_COLOUR)


def _columns_that_fit(inch: float, labels: Sequence[str], letters_an_inch: float) -> int:
    """How many entries of a legend, each with the sample of its line, go side by side."""
    return max(1, min(len(labels), int(inch / (0.75 + max(map(len, labels)) / letters_an_inch))))
