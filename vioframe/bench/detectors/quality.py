"""The HPatches protocol run for many detectors on many pairs, as they are and degraded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from vioframe.bench.detectors.degradations import Circumstances, Degradation
from vioframe.bench.detectors.entrants import detect
from vioframe.bench.detectors.images import Pair, Views
from vioframe.bench.detectors.metrics import CORNERS_WITHIN_PX, score_pair
from vioframe.bench.detectors.tables import BASELINE, CASE, CONFIDENCE
from vioframe.bench.processes import installed, map_in_processes, single_threaded
from vioframe.parts.config import LabelledPart
from vioframe.types import Image

RESOLUTION = (320, 240)
TOP_K = 300
LEADS = ("repeatability", "distinct")
"""The figures that leads are stated for."""

_SPREAD = (*LEADS, "localisation_px", "matching_score")
# Asked of a detector before those that only one view shows are left out.
_CANDIDATES = 4 * TOP_K
_LARGEST_JOB = 8


def score_detectors(
    entrants: Sequence[LabelledPart],
    pairs: Sequence[Pair],
    degradations: Sequence[Degradation],
    *,
    seed: int,
    workers: int,
    on_pairs: Callable[[int], None] = lambda count: None,
) -> pd.DataFrame:
    """Every entrant on every pair under every degradation, a row each, the same whatever the number of ``workers``.

    A row is a :class:`~vioframe.bench.detectors.metrics.PairScore` with its ``detector``, ``degradation``, ``level``
    and ``pair``. Both views are degraded, each by noise of its own and along a direction of its own; only the second
    changes its brightness. ``on_pairs`` is told how many pairs were done.
    """
    size = min(_LARGEST_JOB, -(-len(pairs) // workers))
    # Pairs go by their place among all, which noise is drawn by.
    numbered = list(enumerate(pairs))
    score = partial(_score, tuple(entrants), tuple(degradations), seed)
    jobs = [numbered[k : k + size] for k in range(0, len(pairs), size)]
    parts = map_in_processes(score, jobs, workers, lambda part: on_pairs(len({row["pair"] for row in part})))
    return pd.DataFrame([row for part in parts for row in part])


def _score(
    entrants: Sequence[LabelledPart], degradations: Sequence[Degradation], seed: int, pairs: Sequence[tuple[int, Pair]]
) -> list[dict[str, Any]]:
    ready = [(entrant, installed().create_detector(entrant.name, entrant.options)) for entrant in entrants]
    rows = []
    with single_threaded():
        for number, pair in pairs:
            views = pair(RESOLUTION)
            for degradation in degradations:
                images = _degraded(views, degradation, (seed, number))
                for entrant, detector in ready:
                    first, second = (detect(entrant, detector, image, _CANDIDATES) for image in images)
                    score = score_pair(first, second, views.H_21, RESOLUTION, TOP_K)
                    rows.append({"detector": entrant.called, **degradation.columns, "pair": number, **asdict(score)})
    return rows


def _degraded(views: Views, degradation: Degradation, seed: tuple[int, ...]) -> list[Image]:
    """Both views: noise and direction of each its own, brightness that of the first unchanged."""
    rng = np.random.default_rng((*seed, *degradation.name.encode()))
    return [
        degradation(image, Circumstances(rng, direction_rad=float(rng.uniform(0.0, np.pi)), phase=phase))
        for image, phase in ((views.first, 0.0), (views.second, 1.0))
    ]


def summary(scores: pd.DataFrame, baseline: str = BASELINE) -> pd.DataFrame:
    """A row a detector and degradation: means over the pairs, their deviations, shares of right homographies, leads.

    ``lead_X`` is that in X over the detector ``baseline`` on the same pairs, ``lead_X_half_width`` half its 95 %
    interval by the normal law; missing where there are no two pairs. What cannot be told, as without descriptors, is
    missing too.
    """
    scores = scores.astype(dict.fromkeys((*_SPREAD, "corner_error_px"), float))
    cases = scores.groupby(CASE, sort=False)
    out = cases.agg(pairs=("pair", "size"), points=("points", "mean"))
    for figure in _SPREAD:
        out[figure], out[f"{figure}_sd"] = cases[figure].mean(), cases[figure].std(ddof=0)
    error_px = scores["corner_error_px"]
    for px in CORNERS_WITHIN_PX:
        right = (error_px <= px).where(error_px.notna()).astype(float)
        out[f"homography_{px:g}px"] = right.groupby([scores[key] for key in CASE], sort=False).mean()
    for figure in LEADS:
        by_detector = scores.set_index([*CASE[1:], "pair", "detector"])[figure].unstack("detector")
        if baseline in by_detector:
            ahead = by_detector.drop(columns=baseline).sub(by_detector[baseline], axis=0).stack().groupby(CASE)
            out[f"lead_{figure}"], out[f"lead_{figure}_half_width"] = ahead.mean(), CONFIDENCE * ahead.sem()
    return out.reset_index()
