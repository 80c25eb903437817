"""The page's first words: the question that the suite asks, answered with its own figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from vioframe.bench.detectors.quoted import TABLE_3_2
from vioframe.evaluation.consistency import Trials
from vioframe.report.suite.captions import WHAT
from vioframe.report.suite.page_blocks import Headline
from vioframe.report.suite.pooled import BAND_M, inside_band
from vioframe.report.suite.results import Kind, SuiteResults
from vioframe.report.suite.statistics import Average, Group, Spread, averages, flights, groups
from vioframe.report.suite.stress import baseline_of, duels, is_stress
from vioframe.report.suite.trials import outcomes

_OURS = ("keypointnet", "sliding_window")
"""What the thesis puts forward."""


def headline(results: SuiteResults) -> Headline:
    """An answer for each kind of suite; what there is nothing to say about is left out."""
    sentences = list(_answers(results)) or ["Nothing in this suite has a figure yet"]
    return Headline(f"{sentences[0]}.", [f"{each}." for each in sentences[1:]], _facts(results))


def _answers(results: SuiteResults) -> Iterator[str]:
    found = groups(results)
    if is_stress(found):
        yield from _robustness(found)
    elif means := [average for average in averages(found) if "ate_m" in average.spreads]:
        yield from _over_sequences(means)
    else:
        yield from _one_flight(found)
    yield from _speed(results)
    yield from _consistency(outcomes(results))


def _one_flight(found: Sequence[Group]) -> Iterator[str]:
    having = [group for group in found if group.evaluated]
    if not having:
        return
    ours = next((group for group in having if _is_ours(group)), min(having, key=_ate_m))
    several = len({group.cell.course for group in found}) > 1
    where = f" on {ours.cell.sequence} ({ours.cell.data})" if several else ""
    # Neither a contender on another recording is its rival, nor one that got out of a part of the flight.
    rivals = [g for g in having if g.cell.course == ours.cell.course and g.all_complete and g is not ours]
    if inside := [percent for flight in ours.flights if (percent := inside_band(flight))]:
        y, z = (Spread(tuple(percent[axis] for percent in inside)).mean for axis in "yz")
        yield (
            f"{_named(*ours.cell.contender)}{where}: y inside ±{100 * BAND_M:g} cm for {y:.0f} % of the estimated "
            f"time, altitude for {z:.0f} %"
        )
    spread = ours.spread("ate_m")
    assert spread is not None
    of_ours = "Its" if inside else f"{_named(*ours.cell.contender)}{where}: its"
    more = f"{of_ours} ATE is {_with_spread(spread)}"
    if not ours.all_complete:
        more += f" ({ours.seeds_text})"
    if rivals:
        rival = min(rivals, key=_ate_m)
        if _ate_m(rival) < _ate_m(ours):
            verb = "the lowest here is that of"
        else:
            verb = "the lowest here; next is" if ours.all_complete else "the lowest of a whole flight is that of"
        more += f", {verb} {_named(*rival.cell.contender)}, {_ate_m(rival):.3f} m"
    yield more


def _robustness(found: Sequence[Group]) -> Iterator[str]:
    degraded = [group for group in found if group.cell.level > 0.0]
    kinds = dict.fromkeys(group.cell.data for group in degraded)
    of_kind = {data: f" ({data})" if len(kinds) > 1 else "" for data in kinds}
    for data in kinds:
        rates = {
            detector: (sum(g.succeeded for g in own), sum(g.count for g in own))
            for detector in dict.fromkeys(group.cell.detector for group in degraded)
            if (own := [g for g in degraded if (g.cell.detector, g.cell.data) == (detector, data)])
        }
        shares = [f"{_title(name)} {100 * done / flown:.0f} %" for name, (done, flown) in _by_share(rates)]
        yield f"Flights that succeed under hard conditions{of_kind[data]}: {', '.join(shares)}"
    if (baseline := baseline_of(found)) is None:
        return
    for duel in duels(found, baseline):
        if duel.condition is None and duel.ratio is not None:
            yield (
                f"{_title(duel.detector)} with {_plain(duel.backend)} against {_title(baseline)}, flight by flight"
                f"{of_kind[duel.data]}: {duel.won} won, {duel.lost} lost, {duel.tied} tied; where both have an error, "
                f"{duel.ratio:.2f} times its ATE"
            )


def _over_sequences(means: Sequence[Average]) -> Iterator[str]:
    for data in dict.fromkeys(a.data for a in sorted(means, key=lambda a: -len(a.sequences))):
        own = sorted((a for a in means if a.data is data), key=lambda a: a.spreads["ate_m"].mean)
        best = own[0]
        number = len(best.sequences)
        yield (
            f"Lowest mean ATE on {number} {data} sequence{'s' if number != 1 else ''}: "
            f"{_named(best.detector, best.backend)}, {_with_spread(best.spreads['ate_m'], 'sequences')}"
        )


def _speed(results: SuiteResults) -> Iterator[str]:
    for task in results.of(Kind.DETECTOR_SPEED):
        rows = {row["detector"]: row for row in task.result["rows"]} if task.ok else {}
        if not rows:
            continue
        name = _OURS[0] if _OURS[0] in rows else max(rows, key=lambda each: float(rows[each]["measured"]["fps"]))
        measured, quoted = rows[name]["measured"], rows[name].get("quoted")
        against = f"; quoted: {quoted['fps']:.0f} ({quoted['source']})" if quoted else ""
        place = sorted((float(row["measured"]["fps"]) for row in rows.values()), reverse=True)
        yield f"{_title(name)} runs at {measured['fps']:.0f} frames a second on this machine{against}"
        yield (
            f"It is number {place.index(measured['fps']) + 1} of the {len(rows)} that were measured, between "
            f"{place[-1]:.0f} and {place[0]:.0f} frames a second"
        )


def _consistency(found: Sequence[Trials]) -> Iterator[str]:
    for outcome in found:
        if nees := outcome.nees("pose"):
            yield (
                f"{_sentence(_plain(outcome.backend))} on {_plain(outcome.flight)}: pose NEES {nees.per_axis:.1f} "
                f"times the ideal over {len(outcome.trials)} trials, {nees.verdict}"
            )


def _facts(results: SuiteResults) -> dict[str, str]:
    flown, facts = flights(results), {}
    if flown:
        complete = sum(flight.complete for flight in flown)
        facts["Flights complete"] = f"{complete} of {len(flown)}"
    failed = sum(not task.ok for task in results.tasks)
    facts["Tasks failed"] = f"{failed} of {len(results.tasks)}"
    # A trial has no images; its note says so.
    notes = [t.data_note if t.kind is Kind.TRIAL else WHAT[t.data] for t in results.tasks if t.data]
    if notes:
        facts["Data"] = "; ".join(dict.fromkeys(notes))
    machines = dict.fromkeys(
        f"{t.machine.get('cpu', '?')}, {t.machine.get('cpu_count', '?')} cores" for t in results.tasks
    )
    facts["Machine"] = "; ".join(machines)
    return facts


def _ate_m(group: Group) -> float:
    mean = group.mean("ate_m")
    return float("inf") if mean is None else mean


def _is_ours(group: Group) -> bool:
    return (group.cell.detector.partition(":")[0], group.cell.backend.partition(":")[0]) == _OURS


def _by_share(rates: dict[str, tuple[int, int]]) -> list[tuple[str, tuple[int, int]]]:
    return sorted(rates.items(), key=lambda item: -item[1][0] / item[1][1])


def _with_spread(spread: Spread, over: str = "seeds") -> str:
    if spread.std is None:
        return f"{spread.mean:.3f} m"
    return f"{spread.mean:.3f} ± {spread.std:.3f} m over {spread.n} {over}"


def _named(detector: str, backend: str) -> str:
    return f"{_title(detector)} with {_plain(backend)}"


def _title(detector: str) -> str:
    """As it is printed, with the options that it was given."""
    name, colon, options = detector.partition(":")
    title = TABLE_3_2[name].title if name in TABLE_3_2 else name
    return f"{title}{colon}{options}"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _plain(backend: str) -> str:
    """As one would say it: "the sliding window and loops" of ``sliding_window+loops``."""
    words = backend.replace("_", " ").replace("+", " and ")
    return words.replace("sliding window", "the sliding window").replace("msckf", "MSCKF")
