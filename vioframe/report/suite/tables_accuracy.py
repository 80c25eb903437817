"""Tables of errors: of every contender, beside what was published, averaged, and within the +-20 cm band."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from vioframe.evaluation import ALIGNED_BY
from vioframe.report.suite.captions import condition_text, data_caption, links, runs_caption
from vioframe.report.suite.flights import Flight
from vioframe.report.suite.pooled import BAND_M, ate_sim3_m, inside_band
from vioframe.report.suite.results import Data
from vioframe.report.suite.statistics import Average, Group, Spread
from vioframe.report.suite.table import Column, Entry, Row, Table, mean, number, text, without_empty

LABELS = (
    Column("sequence", text=True),
    Column("data", text=True),
    Column("condition", text=True),
    Column("detector", text=True),
    Column("back-end", text=True),
)
_CM = round(100 * BAND_M)


def accuracy(found: Sequence[Group]) -> Table:
    """A row a group, with all that a reader needs to know of an ATE beside it."""
    columns = (
        *LABELS,
        Column("seeds", text=True),
        Column("ATE, position + yaw", "m"),
        Column("std", "m"),
        Column("median", "m"),
        Column("min", "m"),
        Column("max", "m"),
        Column("ATE", "% of path"),
        Column("ATE, SE(3)", "m"),
        Column("orientation", "deg"),
        Column("yaw", "deg"),
        Column("scale by Sim(3)"),
        Column("start offset", "s", text=True),
        Column("initialised after", "s"),
        Column("completion", "%"),
        Column("resets, all seeds"),
        Column("loop closure", text=True),
    )
    rows = [Row((*labels(group), *_accuracy(group)), links(group.flights)) for group in found]
    caption = (
        "Mean over the seeds of each flight's RMSE, ± the sample standard deviation, and the range; aligned as the "
        "column says, over the whole path. Failed flights are counted under seeds and have no error. "
        f"{runs_caption(found)} {data_caption(found)}"
    )
    return Table("accuracy", "Accuracy", caption, *without_empty(columns, rows))


def averaged(found: Sequence[Average]) -> Table:
    """A row a contender and data kind."""
    columns = (
        Column("data", text=True),
        Column("condition", text=True),
        Column("detector", text=True),
        Column("back-end", text=True),
        Column("sequences", text=True),
        Column("ATE, position + yaw", "m"),
        Column("std over sequences", "m"),
        Column("ATE, SE(3)", "m"),
        Column("orientation", "deg"),
    )
    rows = []
    for average in found:
        ate, se3, turn = (average.spreads.get(key) for key in ("ate_m", "ate_se3_m", "orientation_deg"))
        entries = (
            text(average.data.value),
            text(condition_text(average.condition, average.level)),
            text(average.detector),
            text(average.backend),
            text(f"{len(average.sequences)} of {average.of}"),
            number(ate.mean if ate else None, ".3f"),
            number(ate.std if ate else None, ".3f"),
            mean(se3, ".3f"),
            mean(turn, ".2f"),
        )
        rows.append(Row(entries, tuple(link for group in average.groups for link in _named_links(group))))
    kinds = dict.fromkeys((average.data, average.sequences) for average in found)
    which = " ".join(f"{data}: {', '.join(names) or 'none'}." for data, names in kinds)
    caption = (
        "Means over the sequences on which every flight of every contender was complete; real, rendered and simulated "
        f"recordings are never averaged together. Start offsets and resets are in the table of accuracy. Averaged "
        f"over: {which}"
    )
    return Table("averages", "Averages over sequences", caption, columns, tuple(rows))


def beside_published(found: Sequence[Group], published: Sequence[Mapping[str, Any]]) -> Table:
    """ATE by sequence: what was published, then what was measured here; each row with its own alignment."""
    flown = list(dict.fromkeys((group.cell.sequence, group.cell.data) for group in found))
    names = [*flown, *_only_published(published, {name for name, _ in flown})]
    columns = (
        Column("system", text=True),
        Column("alignment", text=True),
        Column("source", text=True),
        *(Column(name if data in (Data.REAL, None) else f"{name} ({data})", "m") for name, data in names),
    )
    rows = []
    for system in published:
        values = [system["ate_m"].get(name) for name, _ in names]
        about = (
            text(system["system"]),
            text(ALIGNED_BY.get(system["alignment"], system["alignment"])),
            text(f"published: {system['source']}"),
        )
        rows.append(Row((*about, *(number(value, ".3f") for value in values))))
    figures = {"posyaw": _figure("ate_m"), "se3": _figure("ate_se3_m")}
    if any(system["alignment"] == "sim3" for system in published):
        figures["sim3"] = ate_sim3_m
    for detector, backend in dict.fromkeys(group.cell.contender for group in found):
        own: dict[tuple[str, Data | None], Group] = {
            (g.cell.sequence, g.cell.data): g for g in found if g.cell.contender == (detector, backend)
        }
        every = tuple(link for group in own.values() for link in _named_links(group))
        for alignment, figure in figures.items():
            about = (text(f"{detector} + {backend}"), text(ALIGNED_BY[alignment]), text("measured here"))
            rows.append(Row((*about, *(_over_seeds(own.get(name), figure) for name in names)), every))
    caption = (
        "Published ATE beside what was measured here, never averaged together. Alignments differ by row: compare only "
        "rows of the same one. Published rows are of the real recordings; in a column marked rendered or simulated the "
        "measured rows are of that stand-in, which is another recording. Measured: mean over the seeds, and of how "
        "many where some have no error; start offsets, completion and resets are in the table of accuracy. "
        f"{data_caption(found)}"
    )
    return Table("published", "ATE beside published systems", caption, columns, tuple(rows))


def band(found: Sequence[Group]) -> Table | None:
    """Percent of the time inside +-20 cm, with the spread over the seeds and the worst of them."""
    columns = (
        *LABELS,
        Column("seeds", text=True),
        *(Column(f"|{axis}| within {_CM} cm", "% of time") for axis in ("x", "y", "z")),
        Column(f"all within {_CM} cm", "% of time"),
        Column("y, worst seed", "% of time"),
        Column("z, worst seed", "% of time"),
    )
    rows = []
    for group in found:
        every = [inside for flight in group.flights if (inside := inside_band(flight))]
        if not every:
            continue
        by_axis = {axis: Spread(tuple(inside[axis] for inside in every)) for axis in ("x", "y", "z", "all")}
        shares = [mean(spread, ".1f") for spread in by_axis.values()]
        worst = [number(by_axis[axis].min, ".1f") for axis in ("y", "z")]
        rows.append(Row((*labels(group), text(group.seeds_text), *shares, *worst), links(group.flights)))
    if not rows:
        return None
    caption = (
        f"Part of the estimated time in which the position error stays within {_CM} cm along each axis of the truth's "
        "world (z is the altitude), after alignment by position and yaw; mean over the seeds. The thesis claims y and "
        f"altitude within {_CM} cm. Time that was not estimated is not in it: see completion. {data_caption(found)}"
    )
    return Table("band", f"Within ±{_CM} cm", caption, columns, tuple(rows))


def metrics(found: Sequence[Group]) -> Table | None:
    """What the metrics that the suite asked for say, a column a figure; None where it asked for none."""
    names = list(dict.fromkeys(name for group in found for name in group.means("metrics.")))
    left_out = _left_out(found)
    if not (names or left_out):
        return None
    rows = []
    for group in found:
        figures = (mean(group.spread(f"metrics.{name}"), ".4g") for name in names)
        entries = (*labels(group), text(group.seeds_text), *figures)
        rows.append(Row(entries, links(group.flights)))
    columns = (*LABELS, Column("seeds", text=True), *(Column(name) for name in names))
    caption = (
        "Mean over the seeds that have one, ± the standard deviation, of what the suite's metrics say of each flight. "
        f"{left_out}{data_caption(found)}"
    )
    return Table("metrics", "Metrics", caption, columns, tuple(rows))


def _left_out(found: Sequence[Group]) -> str:
    """Which metrics could not tell, of how many flights and why, in sentences; empty where all could."""
    reasons = Counter(
        reason
        for group in found
        for flight in group.flights
        for reason in flight.task.result.get("metrics_left_out", {}).items()
    )
    return "".join(f"No {name} ({count} of the flights): {why}. " for (name, why), count in reasons.items())


def labels(group: Group) -> tuple[Entry, ...]:
    """The entries of :data:`LABELS`."""
    cell = group.cell
    names = (cell.sequence, cell.data.value, condition_text(cell.condition, cell.level), cell.detector, cell.backend)
    return tuple(map(text, names))


def _accuracy(group: Group) -> tuple[Entry, ...]:
    ate, resets, start = (group.spread(key) for key in ("ate_m", "resets", "start_s"))
    closed = [flight.task.loop_closed for flight in group.flights if flight.evaluated]
    completion = group.mean("completion")
    return (
        text(group.seeds_text),
        number(ate.mean if ate else None, ".3f"),
        number(ate.std if ate else None, ".3f"),
        number(ate.median if ate else None, ".3f"),
        number(ate.min if ate else None, ".3f"),
        number(ate.max if ate else None, ".3f"),
        mean(group.spread("ate_percent"), ".2f"),
        mean(group.spread("ate_se3_m"), ".3f"),
        mean(group.spread("orientation_deg"), ".2f"),
        mean(group.spread("yaw_deg"), ".2f"),
        mean(group.spread("scale"), ".3f"),
        text("" if start is None else span(start)),
        mean(group.spread("initialised_after_s"), ".2f"),
        number(None if completion is None else 100.0 * completion, ".1f"),
        number(None if resets is None else sum(resets.values), ".0f"),
        text(("yes" if all(closed) else "some") if any(closed) else ""),
    )


def span(spread: Spread) -> str:
    return f"{spread.min:g}" if spread.min == spread.max else f"{spread.min:g} to {spread.max:g}"


def _figure(name: str) -> Callable[[Flight], float | None]:
    return lambda flight: flight.figures.get(name)


def _over_seeds(group: Group | None, figure: Callable[[Flight], float | None]) -> Entry:
    if group is None:
        return number(None, "")
    values = tuple(value for flight in group.flights if (value := figure(flight)) is not None)
    if not values:
        return text(group.seeds_text)
    spread = Spread(values)
    of = "" if spread.n == group.count else f" ({spread.n} of {group.count})"
    return number(spread.mean, ".3f", of if spread.std is None else f" ± {spread.std:.3f}{of}")


def _named_links(group: Group) -> list[tuple[str, str]]:
    return [(f"{group.cell.sequence}, {label}", path) for label, path in links(group.flights)]


def _only_published(published: Sequence[Mapping[str, Any]], flown: set[str]) -> list[tuple[str, None]]:
    names = dict.fromkeys(name for system in published for name in system["ate_m"])
    return [(name, None) for name in names if name not in flown]
