"""Tables of a stress suite: every level of every condition, and the pairs against the baseline."""

from __future__ import annotations

from collections.abc import Sequence

from vioframe.report.suite.captions import condition_text, data_caption, links, runs_caption
from vioframe.report.suite.flights import SUCCESS_PERCENT
from vioframe.report.suite.statistics import Group
from vioframe.report.suite.stress import Curve, Duel, Interval
from vioframe.report.suite.table import Column, Entry, Row, Table, mean, number, text, without_empty
from vioframe.report.suite.tables_accuracy import span


def levels(curves: Sequence[Curve], found: Sequence[Group]) -> Table:
    """A row for each point of each curve."""
    columns = (
        Column("sequence", text=True),
        Column("data", text=True),
        Column("condition", text=True),
        Column("level"),
        Column("detector", text=True),
        Column("back-end", text=True),
        Column("flights", text=True),
        Column("success", "%"),
        Column("95 % from", "%"),
        Column("to", "%"),
        Column("ATE, position + yaw, geometric mean", "m"),
        Column("95 % from", "m"),
        Column("to", "m"),
        Column("ATE, mean", "m"),
        Column("std", "m"),
        Column("start offset", "s", text=True),
        Column("initialised after", "s"),
        Column("completion", "%"),
        Column("resets, all seeds"),
    )
    rows = []
    for curve in curves:
        for point in curve.points:
            group = point.group
            ate, resets, completion, start = (group.spread(key) for key in ("ate_m", "resets", "completion", "start_s"))
            entries = (
                text(curve.sequence),
                text(curve.data.value),
                text(curve.condition),
                number(point.level, "g"),
                text(curve.detector),
                text(curve.backend),
                text(group.seeds_text),
                number(100.0 * point.success, ".0f"),
                *_ends(point.success_band, 100.0, ".0f"),
                number(point.ate_m, ".3f"),
                *_ends(point.band, 1.0, ".3f"),
                number(ate.mean if ate else None, ".3f"),
                number(ate.std if ate else None, ".3f"),
                text("" if start is None else span(start)),
                mean(group.spread("initialised_after_s"), ".2f"),
                number(100.0 * completion.mean if completion else None, ".1f"),
                number(sum(resets.values) if resets else None, ".0f"),
            )
            rows.append(Row(entries, links(group.flights)))
    caption = (
        f"Success: complete, with an ATE below {SUCCESS_PERCENT:g} % of the path, of all flights, failed ones too, "
        "with Wilson's 95 % interval. ATE: of the flights that have one, so that it flatters where others failed, with "
        "Student's 95 % interval in the logarithm, its spread pooled over the levels of the curve. "
        f"Level 0 is the flight without degradation. {runs_caption(found)} {data_caption(found)}"
    )
    return Table("stress", "Hard conditions by level", caption, *without_empty(columns, rows))


def against_baseline(found: Sequence[Duel], baseline: str, own: Sequence[Group]) -> Table:
    """A row for each condition, level, detector and back-end; last, over all of them."""
    columns = (
        Column("data", text=True),
        Column("condition", text=True),
        Column("level"),
        Column("detector", text=True),
        Column("back-end", text=True),
        Column("won"),
        Column("lost"),
        Column("tied"),
        Column(f"ATE over that of {baseline}, geometric mean"),
        Column("of pairs"),
        Column("p, sign test"),
    )
    rows = [
        Row(
            (
                text(duel.data.value),
                text(duel.condition or "all degraded"),
                number(duel.level, "g"),
                text(duel.detector),
                text(duel.backend),
                number(duel.won, "d"),
                number(duel.lost, "d"),
                number(duel.tied, "d"),
                number(duel.ratio, ".2f"),
                number(duel.both, "d"),
                number(duel.p_value, ".3f"),
            ),
            _runs(duel),
        )
        for duel in found
    ]
    conditions = {condition_text(group.cell.condition, group.cell.level) for group in own}
    caption = (
        f"Flight by flight against {baseline}: same recording, condition, level, back-end and seed, {len(conditions)} "
        "conditions and levels. A complete flight wins against one that is not, an ATE against none, else the smaller "
        "one; tied: equal, or neither has one. The ratio is of the pairs in which both have an ATE; below 1 is better "
        f"than {baseline}. The two-sided sign test takes the pairs for independent, which flights of one recording are "
        "not quite. All degraded: the rows above together, but for the clear ones. "
        f"{data_caption(own)}"
    )
    return Table("duels", f"Against {baseline}", caption, columns, tuple(rows))


def _runs(duel: Duel) -> tuple[tuple[str, str], ...]:
    """None for a row that is over others, which have them."""
    if duel.condition is None:
        return ()
    every = links(flight for pair in duel.pairs for flight in pair)
    return tuple((f"{label}{', baseline' if k % 2 else ''}", path) for k, (label, path) in enumerate(every))


def _ends(interval: Interval | None, factor: float, spec: str) -> tuple[Entry, Entry]:
    if interval is None:
        return number(None, spec), number(None, spec)
    return number(factor * interval.low, spec), number(factor * interval.high, spec)
