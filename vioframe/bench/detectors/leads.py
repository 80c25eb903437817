"""By how much one detector is better than another, and whether that is more than chance."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.types import Float

BASELINE = "shi_tomasi"
"""The detector that the others are held against."""

_CONFIDENCE = 1.96


def lead(mean: float, standard_error: float) -> dict[str, Any]:
    """A difference with the half width of its 95 % interval by the normal law: won, lost, or even within it."""
    half = _CONFIDENCE * standard_error
    verdict = "even" if abs(mean) <= half else "won" if mean > 0.0 else "lost"
    return {"mean": mean, "half_width": half, "verdict": verdict}


def lead_of_pairs(values: Float, baseline: Float) -> dict[str, Any] | None:
    """Of figures (N,) on the same N things; None of a single one, which has no spread."""
    if len(values) < 2:
        return None
    difference = values - baseline
    return lead(float(difference.mean()), float(difference.std(ddof=1) / np.sqrt(len(difference))))


def lead_of_shares(share: float, of: int, baseline: float, baseline_of: int) -> dict[str, Any]:
    """Of shares of ``of`` and ``baseline_of`` things, each of which went one way or the other by itself."""
    variance = share * (1.0 - share) / of + baseline * (1.0 - baseline) / baseline_of
    return lead(share - baseline, float(np.sqrt(variance)))
