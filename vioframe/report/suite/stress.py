"""How contenders hold up as a condition gets harder: curves over its level, and pairs against a baseline."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import comb
from typing import Any

import numpy as np

from vioframe.report.suite.flights import Flight
from vioframe.report.suite.results import Data
from vioframe.report.suite.statistics import CLEAR, Group

CONFIDENCE = 0.95
_Z = 1.959963984540054
_SAME = 1e-9
"""ATEs closer than this, m, are of one and the same estimate."""


@dataclass(frozen=True, slots=True)
class Interval:
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Point:
    """One level of a curve. ``ate_m`` is the geometric mean over the flights that have an ATE, None where none has.

    ``band`` is its 95 % confidence interval, None where no level of the curve has two flights to tell a spread from.
    ``success`` is the part of all flights, failed ones included, that succeeded, within ``success_band`` (Wilson).
    """

    level: float
    group: Group
    ate_m: float | None
    band: Interval | None
    success: float
    success_band: Interval


@dataclass(frozen=True, slots=True)
class Curve:
    """A contender under one condition by level; the flights without a degradation are its level 0."""

    data: Data
    sequence: str
    condition: str
    detector: str
    backend: str
    points: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class Duel:
    """A detector against the baseline, flight by flight: same recording, condition, level, back-end and seed.

    A complete flight wins against one that is not, an ATE against none, and otherwise the smaller one: whoever is lost
    early has little time to be wrong in. Equal ones are ``tied``. ``ratio`` is the geometric mean of the ATE over the
    baseline's, of the ``both`` pairs in which both have one. ``p_value`` is that of the two-sided sign test.
    ``condition`` and ``level`` are None where the row is over all of them. ``pairs`` are the flights, the baseline's
    second.
    """

    data: Data
    condition: str | None
    level: float | None
    detector: str
    backend: str
    won: int
    lost: int
    tied: int
    both: int
    ratio: float | None
    pairs: tuple[tuple[Flight, Flight], ...]

    @property
    def p_value(self) -> float:
        n, k = self.won + self.lost, min(self.won, self.lost)
        return min(1.0, sum(comb(n, i) for i in range(k + 1)) / 2.0 ** (n - 1))


def is_stress(found: Iterable[Group]) -> bool:
    """Whether anything was flown under a condition other than clear."""
    return any(group.cell.condition != CLEAR for group in found)


def curves(found: Sequence[Group]) -> list[Curve]:
    """A curve for each recording, condition and contender, in the order of ``found``."""
    clear = {_line(group): group for group in found if group.cell.condition == CLEAR}
    members: dict[tuple[Any, ...], list[Group]] = defaultdict(list)
    for group in found:
        if group.cell.condition != CLEAR:
            members[*_line(group), group.cell.condition].append(group)
    out = []
    for (data, sequence, detector, backend, condition), own in members.items():
        start = [clear[data, sequence, detector, backend]] if (data, sequence, detector, backend) in clear else []
        points = _points(sorted([*start, *own], key=lambda group: group.cell.level))
        out.append(Curve(data, sequence, condition, detector, backend, points))
    return out


def wilson(successes: int, n: int) -> Interval:
    """The 95 % score interval of a proportion (Wilson, 1927): never beyond 0 and 1."""
    rate, shrink = successes / n, 1.0 + _Z**2 / n
    middle = (rate + _Z**2 / (2 * n)) / shrink
    half = _Z * np.sqrt(rate * (1.0 - rate) / n + _Z**2 / (4 * n**2)) / shrink
    return Interval(max(0.0, float(middle - half)), min(1.0, float(middle + half)))


def baseline_of(found: Sequence[Group]) -> str | None:
    """The detector to compare with: shi_tomasi, which is the thesis' own, else the first; None without others."""
    names = list(dict.fromkeys(group.cell.detector for group in found))
    if len(names) < 2:
        return None
    return "shi_tomasi" if "shi_tomasi" in names else names[0]


def duels(found: Sequence[Group], baseline: str) -> list[Duel]:
    """By condition, level and back-end, then over all degraded flights; recordings of one data kind together."""
    theirs = {(group.cell.course, group.cell.backend): group for group in found if group.cell.detector == baseline}
    single: dict[tuple[Any, ...], list[tuple[Flight, Flight]]] = defaultdict(list)
    overall: dict[tuple[Any, ...], list[tuple[Flight, Flight]]] = defaultdict(list)
    for group in found:
        cell, other = group.cell, theirs.get((group.cell.course, group.cell.backend))
        if cell.detector == baseline or other is None:
            continue
        by_seed = {flight.seed: flight for flight in other.flights}
        pairs = [(flight, by_seed[flight.seed]) for flight in group.flights if flight.seed in by_seed]
        single[cell.data, cell.condition, cell.level, cell.detector, cell.backend] += pairs
        if cell.condition != CLEAR:
            overall[cell.data, None, None, cell.detector, cell.backend] += pairs
    return [_duel(key, pairs) for key, pairs in (*single.items(), *overall.items())]


def _line(group: Group) -> tuple[Data, str, str, str]:
    cell = group.cell
    return cell.data, cell.sequence, cell.detector, cell.backend


def _points(own: Sequence[Group]) -> tuple[Point, ...]:
    """The spread is pooled over the levels of the curve, in the logarithm of the ATE, where it is about the same."""
    from scipy.special import stdtrit

    logs = [np.log(spread.values) if (spread := group.spread("ate_m")) else np.empty(0) for group in own]
    freedom = sum(max(len(each) - 1, 0) for each in logs)
    squares = sum(float(((each - each.mean()) ** 2).sum()) for each in logs if len(each) > 1)
    out = []
    for group, each in zip(own, logs, strict=True):
        centre = float(each.mean()) if len(each) else None
        band = None
        if centre is not None and freedom:
            half = float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE)) * np.sqrt(squares / freedom / len(each))
            band = Interval(float(np.exp(centre - half)), float(np.exp(centre + half)))
        ate_m = None if centre is None else float(np.exp(centre))
        rate = group.succeeded / group.count
        out.append(Point(group.cell.level, group, ate_m, band, rate, wilson(group.succeeded, group.count)))
    return tuple(out)


def _duel(key: tuple[Any, ...], pairs: Sequence[tuple[Flight, Flight]]) -> Duel:
    won = sum(_beats(own, other) for own, other in pairs)
    lost = sum(_beats(other, own) for own, other in pairs)
    both = [(own, other) for own, other in pairs if own.evaluated and other.evaluated]
    ratios = [own.figures["ate_m"] / other.figures["ate_m"] for own, other in both]
    ratio = float(np.exp(np.mean(np.log(ratios)))) if ratios else None
    data, condition, level, detector, backend = key
    tied = len(pairs) - won - lost
    return Duel(data, condition, level, detector, backend, won, lost, tied, len(ratios), ratio, tuple(pairs))


def _beats(one: Flight, other: Flight) -> bool:
    standing = [(not flight.complete, not flight.evaluated) for flight in (one, other)]
    if standing[0] != standing[1]:
        return standing[0] < standing[1]
    return one.evaluated and one.figures["ate_m"] < other.figures["ate_m"] - _SAME
