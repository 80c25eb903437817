"""Results of detectors as text: one table of images as they are, and one of each figure by degradation.

A result is a table with a row a detector and degradation (:data:`CASE`). Beside a figure ``X`` there may be its
deviation, ``X_sd``, and its lead over another detector, ``lead_X``, with half the width of the 95 % interval of that.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import pandas as pd

from vioframe.bench.detectors.degradations import Degradation

CASE = ["detector", "degradation", "level"]
BASELINE = "shi_tomasi"
"""The detector that the others are held against."""
CONFIDENCE = 1.96
"""Half the width of a 95 % interval, in standard errors."""

Columns = Mapping[str, tuple[str, str]]
"""Figure -> title and format."""

SPEED: Columns = {
    "fps": ("frames/s", ".1f"),
    "fps_low": ("quartiles", ".1f"),
    "fps_high": ("", ".1f"),
    "ms": ("ms", ".2f"),
    "keypoints": ("points", ".0f"),
    "on": ("on", ""),
}
QUALITY: Columns = {
    "points": ("points", ".0f"),
    "repeatability": ("repeatability", ".3f"),
    "distinct": ("of distinct points", ".3f"),
    "localisation_px": ("localisation px", ".3f"),
    "homography_1px": ("H right 1px", ".3f"),
    "homography_3px": ("3px", ".3f"),
    "homography_5px": ("5px", ".3f"),
    "matching_score": ("matching score", ".3f"),
}
FRONTEND: Columns = {
    "alive": ("points", ".0f"),
    "survival_5": ("alive after 5", ".1%"),
    "survival_10": ("10", ".1%"),
    "survival_20": ("20 frames", ".1%"),
    "median_life": ("median life", ".0f"),
    "epipolar_inliers": ("inliers", ".1%"),
    "epipolar_median_px": ("median px", ".3f"),
    "coverage": ("cells covered", ".1%"),
}
_BY_DEGRADATION: Mapping[str, Columns] = {
    "quality": {"repeatability": ("Repeatability", ".3f"), "distinct": ("Repeatability of distinct points", ".3f")},
    "frontend": {
        **{f"survival_{n}": (f"Share of tracks alive after {n} frames", ".3f") for n in (5, 10, 20)},
        "median_life": ("Frames after which fewer than half of the tracks are alive", ".0f"),
        "alive": ("Tracks alive in a frame", ".0f"),
        "epipolar_inliers": ("Share of epipolar inliers", ".3f"),
        "coverage": ("Share of the grid's cells covered", ".3f"),
    },
}


def shown(question: str, heading: str, result: pd.DataFrame, baseline: str) -> list[str]:
    """Of speed a table a kind of images; else images as they are, and each figure that matters by degradation."""
    columns = {"speed": SPEED, "quality": QUALITY, "frontend": FRONTEND}[question]
    if question == "speed":
        of_each = result.groupby(["images", "image_count"], sort=False)
        return [heading, *(f"{count} images, {kind}\n{overview(own, columns)}" for (kind, count), own in of_each)]
    tables = [f"{heading}\n{overview(result[result['degradation'] == Degradation().name], columns)}"]
    if result["degradation"].nunique() > 1:
        for figure, (title, spec) in _BY_DEGRADATION[question].items():
            led = f"; in brackets the lead over {baseline}" if f"lead_{figure}" in result else ""
            tables.append(f"{title}, by degradation{led}\n{_text(by_degradation(result, figure, spec))}")
    return tables


def overview(result: pd.DataFrame, columns: Columns) -> str:
    """A row a detector: the figures in ``columns``, deviations in brackets."""
    table = result[["detector"]].copy()
    for figure, (title, spec) in columns.items():
        table[title] = result[figure].map(partial(_cell, spec=spec))
        if (deviation := f"{figure}_sd") in result:
            table[title] += result[deviation].map(lambda sd: "" if pd.isna(sd) else f" ({sd:.3f})")
    return _text(table)


def by_degradation(result: pd.DataFrame, figure: str, spec: str) -> pd.DataFrame:
    """A row a degradation, a column a detector: ``figure``, and in brackets its lead and what that amounts to."""
    cells = result[figure].map(partial(_cell, spec=spec))
    if (lead := f"lead_{figure}") in result:
        cells += [_lead(*each) for each in zip(result[lead], result[f"{lead}_half_width"], strict=True)]
    labels = [Degradation(*case).label for case in zip(result["degradation"], result["level"], strict=True)]
    table = pd.DataFrame({"degradation": labels, "detector": result["detector"], "cell": cells})
    out = table.pivot(index="degradation", columns="detector", values="cell")
    return out.reindex(index=list(dict.fromkeys(labels)), columns=list(dict.fromkeys(result["detector"]))).reset_index()


def verdict(lead: float, half_width: float) -> str:
    """Won, lost, or even within the interval."""
    return "even" if abs(lead) <= half_width else "won" if lead > 0.0 else "lost"


def _lead(lead: float, half_width: float) -> str:
    return "" if pd.isna(lead) or pd.isna(half_width) else f" ({lead:+.3f} {verdict(lead, half_width)})"


def _cell(value: Any, spec: str) -> str:
    return "-" if pd.isna(value) else format(value, spec)


def _text(table: pd.DataFrame) -> str:
    """The first column to the left, the others to the right."""
    first = str(table.columns[0])
    width = max(len(first), *table[first].str.len())
    table = table.assign(**{first: table[first].str.ljust(width)}).rename(columns={first: first.ljust(width)})
    return str(table.to_string(index=False))
