"""Results of detectors as tables for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from vioframe.bench.detectors.degradations import Degradation
from vioframe.bench.detectors.flight import SURVIVAL_FRAMES
from vioframe.bench.detectors.metrics import CORNERS_WITHIN_PX
from vioframe.bench.detectors.quoted import FROM_PAPER, FROM_THESIS, TABLE_3_2
from vioframe.bench.results import Row, reach

_NOTHING = "-"

_SWEPT = {
    "quality": {
        "repeatability": ("Repeatability", ".3f"),
        "distinct": ("Repeatability of distinct points", ".3f"),
    },
    "frontend": {
        **{f"survival.{n}": (f"Share of tracks alive after {n} frames", ".3f") for n in SURVIVAL_FRAMES},
        "median_life": ("Frames after which fewer than half of the tracks are alive", "d"),
        "alive": ("Tracks alive in a frame", ".0f"),
        "epipolar_inliers": ("Share of epipolar inliers", ".3f"),
        "coverage": ("Share of the grid's cells covered", ".3f"),
    },
}
"""What is shown at every level: key, title and format."""


def speed_table(rows: Sequence[Row], absent: Mapping[str, str], settings: Mapping[str, Any]) -> Group:
    """What was measured, beside what the thesis quotes; detectors known by quotation alone come last."""
    width, height = settings["resolution"]
    heading = (
        f"Frames a second at {width} x {height}, {settings['max_points']} keypoints, batch 1, decoding excluded. "
        f"Measured here: {'; '.join(settings['devices'])}; {settings['image_count']} images ({settings['images']}) in "
        f"{settings['rounds']} rounds; median, and quartiles in brackets"
    )
    table = _table()
    for column in ("detector", "thesis", "measured here", "ms", "points", "on"):
        table.add_column(column, justify="left" if column == "detector" else "right", no_wrap=True)
    caption = f"thesis, Table 3.2: * {FROM_PAPER}; the others: {FROM_THESIS}"
    for row in rows:
        measured = row["measured"]
        low, high = measured["fps_quartiles"]
        table.add_row(
            Text(row["detector"]),
            _quoted(row["detector"].partition(":")[0]),
            f"{measured['fps']:.1f} ({low:.1f}-{high:.1f})",
            f"{measured['ms']:.2f}",
            f"{measured['points']:.0f}",
            measured["on"],
        )
    table.add_section()
    for label in absent:
        table.add_row(Text(label), _quoted(label.partition(":")[0]), "does not take part", *(3 * [_NOTHING]))
    known = {label.partition(":")[0] for label in (*absent, *(row["detector"] for row in rows))}
    for name, quoted in TABLE_3_2.items():
        if name not in known:
            table.add_row(quoted.title, _quoted(name), *(4 * [_NOTHING]))
    return _group(heading, table, caption)


def quality_table(rows: Sequence[Row], settings: Mapping[str, Any]) -> Group:
    """All figures on images as they are."""
    width, height = settings["resolution"]
    heading = (
        f"Found again: {settings['pair_count']} pairs ({settings['pairs']}), {width} x {height}, the "
        f"{settings['top_k']} strongest in both views, within 3 px; mean and standard deviation over pairs"
    )
    table = _table()
    homography = [f"{px:g}px" for px in CORNERS_WITHIN_PX]
    titles = [
        "detector",
        "points",
        "repeatability",
        "of distinct points",
        "localisation px",
        *(f"H right {px}" for px in homography),
    ]
    for column in (*titles, "matching score"):
        table.add_column(column, justify="left" if column == "detector" else "right", no_wrap=True)
    for row in _of(rows, Degradation()):
        table.add_row(
            Text(row["detector"]),
            f"{row['points']:.0f}",
            _spread(row["repeatability"]),
            _spread(row["distinct"]),
            _spread(row["localisation_px"]),
            *(_number(reach(row, f"homography.{px}"), ".3f") for px in homography),
            _spread(row["matching_score"]),
        )
    return _group(heading, table)


def frontend_table(rows: Sequence[Row], settings: Mapping[str, Any]) -> Group:
    """All figures on images as they are."""
    heading = (
        f"Followed by the front-end: {settings['dataset']}, {settings['duration_s']:g} s after the first "
        f"{settings['start_s']:g} s; inliers within {settings['epipolar_inlier_px']:g} px of the true epipolar line "
        f"over {settings['epipolar_baseline_frames']} frames"
    )
    table = _table()
    columns = {
        "alive": ("points", ".0f"),
        "survival.5": ("alive after 5", ".1%"),
        "survival.10": ("10", ".1%"),
        "survival.20": ("20 frames", ".1%"),
        "median_life": ("median life", "d"),
        "epipolar_inliers": ("inliers", ".1%"),
        "epipolar_median_px": ("median px", ".3f"),
        "coverage": ("cells covered", ".1%"),
    }
    table.add_column("detector", no_wrap=True)
    for title, _ in columns.values():
        table.add_column(title, justify="right", no_wrap=True)
    for row in _of(rows, Degradation()):
        figures = (_number(reach(row, key), spec) for key, (_, spec) in columns.items())
        table.add_row(Text(row["detector"]), *figures)
    return _group(heading, table)


def sweep_tables(rows: Sequence[Row], degradations: Sequence[Degradation], question: str, baseline: str) -> list[Group]:
    """A table for each figure that matters to ``question`` (quality or frontend), if there is any degradation."""
    if len(degradations) < 2:
        return []
    return [
        _sweep(rows, degradations, key, _led_title(rows, key, title, baseline), spec)
        for key, (title, spec) in _SWEPT[question].items()
    ]


def _led_title(rows: Sequence[Row], key: str, title: str, baseline: str) -> str:
    led = any(reach(row, f"lead.{key}") for row in rows)
    return f"{title}, by degradation" + (f"; in brackets the lead over {baseline}" if led else "")


def _sweep(rows: Sequence[Row], degradations: Sequence[Degradation], key: str, heading: str, spec: str) -> Group:
    """The figure ``key`` of every detector at every level, with its lead where that is known."""
    table = _table()
    table.add_column("degradation", no_wrap=True)
    labels = list(dict.fromkeys(row["detector"] for row in rows))
    for label in labels:
        table.add_column(Text(label), justify="right", no_wrap=True)
    for degradation in degradations:
        cells = {row["detector"]: _led(row, key, spec) for row in _of(rows, degradation)}
        table.add_row(Text(degradation.label), *(cells[label] for label in labels))
    return _group(heading, table)


def _led(row: Row, key: str, spec: str) -> str:
    figure, lead = _number(_mean(row, key), spec), reach(row, f"lead.{key}")
    return figure if lead is None else f"{figure} ({lead['mean']:+.3f} {lead['verdict']})"


def _mean(row: Row, key: str) -> float | None:
    value = reach(row, key)
    mean: float | None = value["mean"] if isinstance(value, Mapping) else value
    return mean


def _of(rows: Sequence[Row], degradation: Degradation) -> list[Row]:
    return [r for r in rows if (r["degradation"], r["level"]) == (degradation.name, degradation.level)]


def _table() -> Table:
    return Table(box=None, pad_edge=False)


def _group(heading: str, table: Table, caption: str = "") -> Group:
    """Not as the table's own title, which would be folded at the width of the table."""
    return Group(Text(heading, style="bold"), table, Text(caption))


def _quoted(name: str) -> str:
    quoted = TABLE_3_2.get(name)
    return _NOTHING if quoted is None else f"{quoted.fps:.0f}{'*' if quoted.source == FROM_PAPER else ' '}"


def _spread(value: Mapping[str, float] | None) -> str:
    return _NOTHING if value is None else f"{value['mean']:.3f} ({value['sd']:.3f})"


def _number(value: float | None, spec: str) -> str:
    return _NOTHING if value is None else format(value, spec)
