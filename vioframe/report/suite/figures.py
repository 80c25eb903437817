"""The figures that a suite's results have data for, and writing them to files."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vioframe.report.style import RC
from vioframe.report.suite import figures_cost, figures_flights, figures_spread, figures_stress, statistics
from vioframe.report.suite.figures_flights import Course
from vioframe.report.suite.look import explain
from vioframe.report.suite.pooled import pool_relative
from vioframe.report.suite.results import Kind, SuiteResults
from vioframe.report.suite.statistics import CLEAR, Group
from vioframe.report.suite.stress import curves, is_stress
from vioframe.report.suite.trials import outcomes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("png", "svg")
_DPI = 200
"""Twice what a figure is laid out for."""
_THESIS_FLIGHT = "MH_05_difficult"
_THESIS = {
    "trajectories_3d": "fig_3_09_",
    "translation_error_per_axis": "fig_3_10_",
    "rotation_error": "fig_3_11_",
    "comparison": "fig_3_12_",
    "top_view": "fig_3_13_",
    "side_view": "fig_3_14_",
}
"""What the thesis shows of :data:`_THESIS_FLIGHT`, with the numbers of its figures."""

_OF_MANY = ("translation_error_per_axis", "top_view", "relative_error")
"""What is drawn of each recording where there are several."""


def write_figures(results: SuiteResults, folder: Path) -> list[Path]:
    """``NAME.png`` and ``NAME.svg`` in ``folder`` for each of :func:`figures`."""
    import matplotlib as mpl

    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with mpl.rc_context(dict(RC)):
        for name, figure in figures(results):
            for ending in FORMATS:
                written.append(folder / f"{name}.{ending}")
                # Without its date an SVG is the same file for the same results.
                figure.savefig(written[-1], dpi=_DPI, metadata={"Date": None} if ending == "svg" else None)
    return written


def figures(results: SuiteResults) -> Iterator[tuple[str, Figure]]:
    """Names and figures, each drawn when its turn comes."""
    for task in results.of(Kind.DETECTOR_SPEED):
        if task.ok:
            yield "detector_fps", figures_cost.detector_speed(task)
    groups = statistics.groups(results)
    if is_stress(groups):
        yield from _stress(groups)
    else:
        yield from _recordings(groups)
    if (timing := figures_cost.timing(groups)) is not None:
        yield "timing", timing
    yield from _trials(results)


def _recordings(groups: Sequence[Group]) -> Iterator[tuple[str, Figure]]:
    by_course = list(statistics.by_course(group for group in groups if group.cell.condition == CLEAR))
    of_thesis = [sequence for (_, sequence, _, _), _ in by_course] == [_THESIS_FLIGHT]
    for (data, sequence, _, _), own in by_course:
        if (course := Course.of(own)) is None:
            continue
        before = "" if len(by_course) == 1 else _file_name(f"{sequence}_{data}_")
        for name, draw in _of_recording(own).items():
            if len(by_course) > 1 and name not in _OF_MANY:
                continue
            if (figure := draw(course)) is not None:
                yield (_THESIS.get(name, "") if of_thesis else before) + name, figure
    if len(by_course) > 1:
        yield "ate_by_sequence", figures_spread.ate_by_sequence([group for _, own in by_course for group in own])


def _of_recording(own: Sequence[Group]) -> dict[str, Callable[[Course], Figure | None]]:
    def relative_error(_: Course) -> Figure | None:
        pools = pool_relative(own)
        return figures_spread.relative_error(pools) if pools else None

    return {
        "trajectories_3d": figures_flights.trajectories_3d,
        "translation_error_per_axis": figures_flights.translation_error,
        "rotation_error": figures_flights.rotation_error,
        "comparison": figures_flights.comparison,
        "top_view": figures_flights.top_view,
        "side_view": figures_flights.side_view,
        "relative_error": relative_error,
        "nees": figures_spread.nees_over_time,
    }


def _stress(groups: Sequence[Group]) -> Iterator[tuple[str, Figure]]:
    recordings = dict.fromkeys((group.cell.data, group.cell.sequence) for group in groups)
    for data, sequence in recordings:
        own = [group for group in groups if (group.cell.data, group.cell.sequence) == (data, sequence)]
        if found := curves(own):
            before = "" if len(recordings) == 1 else _file_name(f"{sequence}_{data}_")
            yield f"{before}stress_error", figures_stress.error_curves(found, own)
            yield f"{before}stress_success", figures_stress.success_curves(found, own)


def _trials(results: SuiteResults) -> Iterator[tuple[str, Figure]]:
    from vioframe.report import montecarlo

    found = outcomes(results)
    for flight in dict.fromkeys(outcome.flight for outcome in found):
        judged = [outcome for outcome in found if outcome.flight == flight and outcome.nees("pose")]
        if judged:
            yield _file_name(f"nees_{flight}"), _of_tracks(montecarlo.nees_over_time(judged))
    if any(trial.figures for outcome in found for trial in outcome.trials):
        yield "trials", _of_tracks(montecarlo.trials(found))


def _of_tracks(figure: Figure) -> Figure:
    explain(figure, f"{figure.get_supxlabel()} Data (simulated): tracks and IMU, no images.")
    return figure


def _file_name(text: str) -> str:
    return re.sub(r"[^\w+-]+", "_", text)
