"""Which figures a set of runs can have, and writing them to files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.errors import RunError
from vioframe.report import plot_cost, plot_errors, plot_paths
from vioframe.report.style import RC
from vioframe.runs.evaluated import Evaluated

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Drawing = Callable[[Sequence[Evaluated]], "Figure"]


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


def _available(runs: Sequence[Evaluated], band_m: float | None) -> dict[str, _Drawing]:
    """Drawings by file name."""
    errors = [run.errors for run in runs if run.errors]
    drawings: dict[str, _Drawing] = {}
    if any(run.estimate for run in runs):
        drawings |= {
            "path_3d": plot_paths.path_3d,
            "path_top": plot_paths.path_top,
            "path_side": plot_paths.path_side,
        }
    if errors:
        drawings["translation_error"] = lambda runs: plot_errors.translation_error(runs, band_m)
        drawings["rotation_error"] = plot_errors.rotation_error
    if any(e.relative or e.relative_by_fraction for e in errors):
        drawings["relative_error"] = plot_errors.relative_error
    if any(run.stage_ms() for run in runs):
        drawings["timing"] = plot_cost.timing
    if any(run.folder and run.folder.tracks() for run in runs):
        drawings["tracks"] = plot_cost.tracks
    return drawings
