"""The HPatches protocol run for many detectors on many pairs, as they are and degraded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vioframe.bench.detectors.degradations import Circumstances, Degradation
from vioframe.bench.detectors.entrants import Entrant, detect
from vioframe.bench.detectors.leads import BASELINE, lead_of_pairs
from vioframe.bench.detectors.metrics import CORNERS_WITHIN_PX, PairScore, score_pair
from vioframe.bench.detectors.pairs import Pair, Views
from vioframe.bench.processes import map_in_processes, single_threaded
from vioframe.bench.results import Row
from vioframe.parts import registry
from vioframe.types import Image

RESOLUTION = (320, 240)
TOP_K = 300
LEADS = ("repeatability", "distinct")
"""The figures that leads are stated for."""

# Asked of a detector before those that only one view shows are left out.
_CANDIDATES = 4 * TOP_K
_LARGEST_JOB = 8

Scores = Mapping[tuple[str, Degradation], Sequence[PairScore]]
"""By detector's label and degradation, in the order of the pairs."""


@dataclass(frozen=True, slots=True)
class _Job:
    """Some of the pairs, by their place among all, which noise is drawn by."""

    pairs: tuple[tuple[int, Pair], ...]
    entrants: tuple[Entrant, ...]
    degradations: tuple[Degradation, ...]
    seed: int


def score_detectors(
    entrants: Sequence[Entrant],
    pairs: Sequence[Pair],
    degradations: Sequence[Degradation],
    *,
    seed: int,
    workers: int,
    on_pairs: Callable[[int], None] = lambda count: None,
) -> Scores:
    """Every entrant on every pair under every degradation, the same whatever the number of ``workers``.

    Both views are degraded, each by noise of its own and along a direction of its own; only the second changes its
    brightness. ``on_pairs`` is told how many pairs were done.
    """
    size = min(_LARGEST_JOB, -(-len(pairs) // workers))
    numbered = list(enumerate(pairs))
    jobs = [
        _Job(tuple(numbered[k : k + size]), tuple(entrants), tuple(degradations), seed)
        for k in range(0, len(pairs), size)
    ]
    parts = map_in_processes(_score, jobs, workers, lambda part: on_pairs(len(next(iter(part.values())))))
    return {key: [score for part in parts for score in part[key]] for key in parts[0]}


def _score(job: _Job) -> dict[tuple[str, Degradation], list[PairScore]]:
    installed = registry.load()
    ready = [(entrant, installed.create_detector(entrant.name, entrant.options)) for entrant in job.entrants]
    scores: dict[tuple[str, Degradation], list[PairScore]] = {
        (entrant.label, degradation): [] for degradation in job.degradations for entrant in job.entrants
    }
    with single_threaded():
        for number, pair in job.pairs:
            views = pair.load(RESOLUTION)
            for degradation in job.degradations:
                first, second = _degraded(views, degradation, (job.seed, number))
                for entrant, detector in ready:
                    found = [detect(entrant, detector, image, _CANDIDATES) for image in (first, second)]
                    score = score_pair(found[0], found[1], views.H_21, RESOLUTION, TOP_K)
                    scores[entrant.label, degradation].append(score)
    return scores


def _degraded(views: Views, degradation: Degradation, seed: tuple[int, ...]) -> tuple[Image, Image]:
    """Both views: noise and direction of each its own, brightness that of the first unchanged."""
    rng = np.random.default_rng((*seed, *degradation.name.encode()))
    first, second = (
        degradation(image, Circumstances(rng, direction_rad=float(rng.uniform(0.0, np.pi)), phase=phase))
        for image, phase in ((views.first, 0.0), (views.second, 1.0))
    )
    return first, second


def quality_rows(scores: Scores, baseline: str = BASELINE) -> list[Row]:
    """A row a detector and degradation: means over the pairs, spreads, and leads over the label ``baseline``."""
    return [
        quality_row(label, degradation, of_it, None if label == baseline else scores.get((baseline, degradation)))
        for (label, degradation), of_it in scores.items()
    ]


def quality_row(
    label: str, degradation: Degradation, scores: Sequence[PairScore], baseline: Sequence[PairScore] | None
) -> Row:
    """Mean, standard deviation and number for each figure, shares of right homographies, and the lead.

    The leads over ``baseline``, on the same pairs, come with the half width of their 95 % confidence interval; ``won``
    and ``lost`` are leads that exceed it.
    """
    row: dict[str, Any] = {
        "detector": label,
        "degradation": degradation.name,
        "level": degradation.level,
        "pairs": len(scores),
        "points": float(np.mean([s.points for s in scores])),
        "repeatability": _spread([s.repeatability for s in scores]),
        "distinct": _spread([s.distinct for s in scores]),
        "localisation_px": _spread([s.localisation_px for s in scores]),
        "matching_score": _spread([s.matching_score for s in scores]),
    }
    errors = [s.corner_error_px for s in scores if s.corner_error_px is not None]
    if errors:
        row["homography"] = {f"{px:g}px": float(np.mean(np.array(errors) <= px)) for px in CORNERS_WITHIN_PX}
    if baseline is not None:
        row["lead"] = {
            figure: lead_of_pairs(*(np.array([getattr(s, figure) for s in of]) for of in (scores, baseline)))
            for figure in LEADS
        }
    return row


def _spread(values: Sequence[float | None]) -> dict[str, Any] | None:
    known = [value for value in values if value is not None]
    if not known:
        return None
    return {"mean": float(np.mean(known)), "sd": float(np.std(known)), "of": len(known)}
