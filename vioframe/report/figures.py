"""The figures of ``vioframe plot``: paths, errors over time and over distance, and what a run cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.errors import RunError
from vioframe.evaluation import ALIGNED_BY, TrajectoryErrors
from vioframe.report.style import PALETTE_SIZE, RC, TRUTH, caption, colour, legend_above, line
from vioframe.runs.evaluated import Evaluated
from vioframe.types import Float

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_AXES = "xyz"
_WIDTH_INCH = 10.0
_MARGIN = 0.06
_LONGER_SIDE_INCH = 8.5
_LABELS_INCH = np.array([0.9, 1.3])
_LEGEND_INCH = 7.5
_HATCHES = ("", "///", "...", "xx")


def write_figures(
    runs: Sequence[Evaluated], out: Path, *, formats: Sequence[str] = ("png",), band_m: float | None = None
) -> list[Path]:
    """Draw everything that ``runs`` have data for into the folder ``out``; returns the files written.

    ``formats`` are file endings that matplotlib knows; ``band_m`` shades plus or minus that in the translation errors.
    """
    import matplotlib as mpl

    written = []
    try:
        out.mkdir(parents=True, exist_ok=True)
        with mpl.rc_context(dict(RC)):
            for name, draw in _available(runs, band_m).items():
                figure = draw(runs)
                for ending in formats:
                    written.append(out / f"{name}.{ending}")
                    # Without its date an SVG is the same file for the same runs.
                    figure.savefig(written[-1], metadata={"Date": None} if ending == "svg" else None)
    except OSError as error:
        raise RunError(f"cannot write figures to {out}: {error.strerror}; choose another --out") from error
    return written


def _available(runs: Sequence[Evaluated], band_m: float | None) -> dict[str, Callable[[Sequence[Evaluated]], Figure]]:
    """Drawings by file name."""
    errors = [run.errors for run in runs if run.errors]
    drawings: dict[str, Callable[[Sequence[Evaluated]], Figure]] = {}
    if any(run.estimate for run in runs):
        drawings |= {"path_3d": path_3d, "path_top": path_top, "path_side": path_side}
    if errors:
        drawings["translation_error"] = lambda runs: translation_error(runs, band_m)
        drawings["rotation_error"] = rotation_error
    if any(e.relative or e.relative_by_fraction for e in errors):
        drawings["relative_error"] = relative_error
    if any(run.stage_ms() for run in runs):
        drawings["timing"] = timing
    if any(run.folder and run.folder.tracks() for run in runs):
        drawings["tracks"] = tracks
    return drawings


# Paths


def path_3d(runs: Sequence[Evaluated]) -> Figure:
    """All paths in perspective, to one scale on the three axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_INCH, 7.5), layout="constrained")
    ax: Any = figure.add_subplot(projection="3d", computed_zorder=False)
    low, high = _draw_paths(figure, ax, runs, (0, 1, 2))
    ax.set_zlim(low[2], high[2])
    ax.set_zlabel("z [m]", labelpad=8)
    ax.set_box_aspect(high - low, zoom=1.15)
    ax.locator_params(nbins=6)
    ax.locator_params(axis="z", nbins=4)
    ax.view_init(elev=28, azim=-58)
    return figure


def path_top(runs: Sequence[Evaluated]) -> Figure:
    """The paths from above, along gravity: y over x."""
    return _projection(runs, 0, 1)


def path_side(runs: Sequence[Evaluated]) -> Figure:
    """The paths from the side: height over x."""
    return _projection(runs, 0, 2)


def _projection(runs: Sequence[Evaluated], *axes: int) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    ax: Any = figure.add_subplot()
    low, high = _draw_paths(figure, ax, runs, axes)
    size = (high - low)[[*axes]]
    width, height = _LONGER_SIDE_INCH * size / size.max() + _LABELS_INCH
    figure.set_size_inches(max(width, _LEGEND_INCH), height)
    ax.set_aspect("equal")
    return figure


def _draw_paths(figure: Figure, ax: Any, runs: Sequence[Evaluated], axes: Sequence[int]) -> tuple[Float, Float]:
    """The ground truth of every flight below, the estimates above it; returns the corners (3,) of what is shown."""
    truths = {run.ground_truth.t_ns.tobytes(): run.ground_truth.p_WB for run in runs if run.errors and run.ground_truth}
    estimates = [_estimate(run) for run in runs]
    low, high = _bounds(np.concatenate([*truths.values(), *estimates]))
    handles = [ax.plot(*p_W[:, axes].T, **TRUTH, zorder=2)[0] for p_W in truths.values()]
    for i, (run, p_W) in enumerate(zip(runs, estimates, strict=True)):
        handles += ax.plot(*p_W[:, axes].T, **line(i), label=run.name, zorder=3 + i)
        ax.plot(*p_W[:1, axes].T, "o", ms=6, color=colour(i), zorder=10 + i)
    space = {"labelpad": 8} if len(axes) == 3 else {}
    ax.set_xlim(low[axes[0]], high[axes[0]])
    ax.set_ylim(low[axes[1]], high[axes[1]])
    ax.set_xlabel(f"{_AXES[axes[0]]} [m]", **space)
    ax.set_ylabel("z (up) [m]" if axes[1] == 2 else f"{_AXES[axes[1]]} [m]", **space)
    legend_above(figure, handles)
    how = next((ALIGNED_BY[run.errors.alignment_name] for run in runs if run.errors), None)
    frame = "No ground truth: each estimate in its own frame"
    caption(figure, f"{f'Estimates aligned with the ground truth by {how}' if how else frame}. Dots mark the starts.")
    return low, high


def _estimate(run: Evaluated) -> Float:
    """Positions (N, 3) in the ground truth's world where there is one; NaN between segments, so that no line joins
    them."""
    aligned = run.aligned
    return np.empty((0, 3)) if aligned is None else np.insert(aligned.p_WB, run.breaks(aligned.t_ns), np.nan, axis=0)


def _bounds(points: Float) -> tuple[Float, Float]:
    """Corners (3,) of a box around points (N, 3), with a margin, and not flat."""
    low, high = (np.nanmin(points, axis=0), np.nanmax(points, axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
    size = max(float((high - low).max()), 1e-3)
    thin = np.maximum(0.12 * size - (high - low), 0.0) / 2.0
    return low - thin - _MARGIN * size, high + thin + _MARGIN * size


# Errors


def translation_error(runs: Sequence[Evaluated], band_m: float | None = None) -> Figure:
    """Position error along each axis of the world over time; ``band_m`` shades the range within plus or minus it."""
    names = ("x error [m]", "y error [m]", "z (up) error [m]")
    about = f" Shaded: ±{100 * band_m:g} cm." if band_m else ""
    what = "Estimate minus ground truth in the world's axes"
    return _over_time(runs, names, lambda errors: errors.position_m, what, about, band_m)


def rotation_error(runs: Sequence[Evaluated]) -> Figure:
    """Rotation error about each axis of the world over time."""
    names = ("roll error [deg]", "pitch error [deg]", "yaw error [deg]")
    return _over_time(runs, names, lambda errors: errors.rotation_rpy_deg, "Roll, pitch, yaw about the world's x, y, z")


def _over_time(
    runs: Sequence[Evaluated],
    names: Sequence[str],
    series: Callable[[TrajectoryErrors], Float],
    what: str,
    about: str = "",
    band: float | None = None,
) -> Figure:
    figure, panels = _panels(3, 8.0)
    with_errors = [(i, run, run.errors) for i, run in enumerate(runs) if run.errors]
    handles: list[Any] = []
    for k, (ax, name) in enumerate(zip(panels, names, strict=True)):
        ax.axhline(0.0, color="black", lw=0.8)
        if band:
            ax.axhspan(-band, band, color="#56B4E9", alpha=0.15, lw=0)
        handles = []
        for i, run, errors in with_errors:
            # With a NaN at every break, so that no line is drawn where nothing was estimated.
            begin_ns = (run.ground_truth or errors.truth).t_ns[0]
            breaks = run.breaks(errors.estimate.t_ns)
            time_s = np.insert((errors.estimate.t_ns - begin_ns) * 1e-9, breaks, np.nan)
            values = np.insert(series(errors)[:, k], breaks, np.nan)
            handles += ax.plot(time_s, values, **line(i), label=run.name)
        ax.set_ylabel(name)
        ax.margins(x=0.01)
    panels[-1].set_xlabel("time since the ground truth begins [s]")
    figure.align_ylabels(panels)
    legend_above(figure, handles)
    how = ALIGNED_BY[with_errors[0][2].alignment_name]
    caption(figure, f"{what}, aligned by {how} over the whole path.{about}")
    return figure


def relative_error(runs: Sequence[Evaluated]) -> Figure:
    """Boxes of the relative errors by length of the stretch: translation and yaw."""
    from matplotlib.patches import Patch

    fixed = any(run.errors.relative for run in runs if run.errors)
    found = [
        {} if run.errors is None else run.errors.relative if fixed else run.errors.relative_by_fraction for run in runs
    ]
    lengths = sorted(set().union(*found))
    figure, panels = _panels(2, 8.0)
    width = 0.8 / len(runs)
    for i, by_length in enumerate(found):
        places = [k + (i - 0.5 * (len(runs) - 1)) * width for k, length in enumerate(lengths) if length in by_length]
        errors = [by_length[length] for length in lengths if length in by_length]
        for ax, values in (
            (panels[0], [each.translation_percent for each in errors]),
            (panels[1], [each.yaw_deg for each in errors]),
        ):
            if values:
                ax.boxplot(
                    values,
                    positions=places,
                    widths=0.85 * width,
                    whis=(5, 95),
                    showfliers=False,
                    patch_artist=True,
                    manage_ticks=False,
                    boxprops={"facecolor": colour(i), "edgecolor": colour(i), "alpha": 0.75},
                    medianprops={"color": "white", "lw": 2},
                    whiskerprops={"color": colour(i)},
                    capprops={"color": colour(i)},
                )
    panels[0].set_ylabel("translation error [% of length]")
    panels[1].set_ylabel("yaw error [deg]")
    panels[1].set_xlabel("length of the stretch [m]" if fixed else "length of the stretch [% of the path]")
    panels[1].set_xticks(range(len(lengths)), [f"{length if fixed else 100 * length:g}" for length in lengths])
    for ax in panels:
        ax.set_ylim(bottom=0.0)
        ax.grid(visible=False, axis="x")
    legend_above(figure, [Patch(color=colour(i), label=run.name) for i, run in enumerate(runs) if found[i]])
    caption(figure, "Every pose starts a stretch, aligned at its first pose. Boxes: quartiles; whiskers: 5 to 95 %.")
    return figure


# Cost


def timing(runs: Sequence[Evaluated]) -> Figure:
    """Mean milliseconds a frame, a bar a run, stacked by stage."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    # What loop closure made of a run has no times of its own.
    spent = {run.name: stage_ms for run in runs if (stage_ms := run.stage_ms())}
    stages = list(dict.fromkeys(stage for each in spent.values() for stage in each))
    height = 2.6 + 0.75 * len(spent) + 0.25 * (len(stages) // 3)
    figure = Figure(figsize=(_WIDTH_INCH, height), layout="constrained")
    ax: Any = figure.subplots()
    left = np.zeros(len(spent))
    handles = []
    for k, stage in enumerate(stages):
        hatch = _HATCHES[(k // PALETTE_SIZE) % len(_HATCHES)]
        look: dict[str, Any] = {"facecolor": colour(k), "hatch": hatch, "edgecolor": "white", "lw": 0.5}
        width = np.array([each.get(stage, 0.0) for each in spent.values()])
        ax.barh(range(len(spent)), width, left=left, height=0.6, **look)
        left += width
        handles.append(Patch(**look, label=stage))
    for i, total in enumerate(left):
        ax.annotate(f"{total:.1f} ms", (total, i), xytext=(6, 0), textcoords="offset points", va="center")
    ax.set_yticks(range(len(spent)), list(spent))
    ax.invert_yaxis()
    ax.set_xlim(0.0, 1.12 * max(float(left.max()), 1e-3))
    ax.set_xlabel("mean time a frame [ms]")
    ax.grid(visible=False, axis="y")
    legend_above(figure, handles)
    caption(figure, "Without reading and decoding the images.")
    return figure


def tracks(runs: Sequence[Evaluated]) -> Figure:
    """Features tracked, and new among them, in each frame."""
    figure, panels = _panels(2, 6.0)
    handles = []
    for i, run in enumerate(runs):
        found = run.folder.tracks() if run.folder else None
        if found is not None:
            time_s = (found.frames_ns - found.frames_ns[0]) * 1e-9
            handles += panels[0].plot(time_s, found.tracked, **line(i), label=run.name)
            # In the first frame every feature is new, which would hide all that follows.
            panels[1].plot(time_s[1:], found.new[1:], **{**line(i), "lw": 1.0})
    for ax, name in zip(panels, ("features in the frame", "new among them"), strict=True):
        ax.set_ylabel(name)
        ax.set_ylim(bottom=0)
        ax.margins(x=0.01)
    panels[1].set_xlabel("time since the first frame [s]")
    figure.align_ylabels(panels)
    legend_above(figure, handles)
    return figure


def _panels(rows: int, height_inch: float) -> tuple[Figure, Any]:
    """Panels one above the other that share their x axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(_WIDTH_INCH, height_inch), layout="constrained")
    return figure, figure.subplots(rows, 1, sharex=True)
