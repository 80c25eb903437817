"""The report as one HTML file that needs nothing else: no network, no server. How to read it: ``docs/report.md``."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from vioframe.evaluation.consistency import PARTS
from vioframe.report.figures import Figure
from vioframe.report.style import TRUTH_COLOUR
from vioframe.report.suite.figures import Look
from vioframe.report.suite.statistics import (
    WHAT,
    Study,
    averages,
    duels,
    groups,
    records,
    seeds_text,
)
from vioframe.report.table import Table, TableRow
from vioframe.report.units import length
from vioframe.runs.results import CLEAR, Data

DARK = {
    "#0072b2": "#4aa3e0",
    "#d55e00": "#f07b2a",
    "#009e73": "#2fc294",
    "#cc79a7": "#e093bd",
    "#e69f00": "#f2b632",
    "#56b4e9": "#a4dcff",
    TRUTH_COLOUR: "#6b7480",
}
"""What the colours become on a dark page, where the same ones would be too dim to tell apart."""

_SAID_BY_CAPTION = ("sequence", "data", "condition")
"""Columns that are left out where they say the same in every row."""


class Section(NamedTuple):
    """``lead`` is its first sentence, which says what to look for; figures and tables are by name."""

    id: str
    title: str
    figures: Sequence[str] = ()
    tables: Sequence[str] = ()
    lead: str = ""


SECTIONS = (
    Section("speed", "Detector speed", ["detector_fps"], ["detector_fps"], "Frames a second, on this machine."),
    Section("duels", "Head to head", [], ["duels"], "The same flights by one detector and by another."),
    Section(
        *("stress", "Hard conditions", ["stress"], ["stress"]),
        "How much worse each contender gets as a condition gets harder, and when it gives up.",
    ),
    Section(
        *("accuracy", "Accuracy", ["ate_by_sequence"], ["averages", "accuracy", "published", "metrics"]),
        "Every figure is a mean over the seeds; the last column leads to the runs behind it.",
    ),
    Section("trajectories", "Trajectories", ["trajectories_3d"]),
    Section("translation-error", "Translation error", ["translation_error_per_axis"], ["band"]),
    Section("rotation-error", "Rotation error", ["rotation_error", "comparison"]),
    Section(
        *("relative-error", "Drift by length", ["relative_error"], []),
        "Errors over stretches of the way do not depend on where the estimate was aligned.",
    ),
    Section("timing", "Time a frame", ["timing"], ["timing"], "A real-time factor above 1 is faster than the camera."),
    Section(
        *("consistency", "Consistency", ["nees_of_trials", "trials", "nees"], ["nees", "nees_flights"]),
        "Whether the covariance is as large as the errors are.",
    ),
    Section("failures", "What went wrong", [], ["failures"]),
    Section("evo", "Check it with evo", [], ["evo"], "Each ATE after SE(3) alignment, re-derived by another's code."),
    Section("machine", "Machine and versions", [], ["provenance"]),
)


def write_page(study: Study, tables: Sequence[Table], figures: Sequence[Figure], path: Path, to_results: str) -> Path:
    """Write the page; its links begin with ``to_results``, so that the results can be moved along with it."""
    loader = PackageLoader(str(__package__))
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # Where a browser may fold what is one word to it: names with options, paths.
    environment.filters["foldable"] = lambda text: Markup("<wbr>").join(re.split(r"(?<=[,:/=])", text))
    suite, answers = study.results.suite, list(headline(study)) or ["Nothing in this suite has a figure yet."]
    html = environment.get_template("page.html.j2").render(
        title=suite.get("title") or suite.get("name") or study.results.path.resolve().name,
        description=suite.get("description") or "",
        answers=answers,
        facts=facts(study),
        sections=list(_sections(study, tables, figures)),
        tables={table.name: table for table in tables},
        figures={figure.name: figure for figure in figures},
        filters=_filters(study),
        plots={figure.name: _for_script(figure) for figure in figures},
        colours=DARK,
        columns=lambda table: list(_columns(table)),
        sorted_by=_sorted_by,
        links=lambda row: [(label, f"{quote(to_results)}/{quote(path)}/") for label, path in row.links],
        plotly=Markup(get_plotlyjs()),
        **{name: Markup(loader.get_source(environment, f"page.{name}")[0]) for name in ("css", "js")},
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(html, encoding="utf-8")
    return path


def _sections(study: Study, tables: Sequence[Table], figures: Sequence[Figure]) -> Iterator[Section]:
    """Those with something to show, led by what is claimed of it."""
    known = [{each.name for each in figures}, {each.name for each in tables}]
    band, speed = study.results.reference.band, study.results.reference.speed
    claims = {"translation-error": band.claim if band else "", "speed": speed.claim if speed else ""}
    for section in SECTIONS:
        shown = ([name for name in names if name in have] for names, have in zip(section[2:4], known, strict=True))
        drawn, tabled = shown
        if drawn or tabled:
            lead = " ".join(filter(None, (claims.get(section.id), section.lead)))
            yield section._replace(figures=drawn, tables=tabled, lead=lead)


def _columns(table: Table) -> Iterator[tuple[str, str, str, bool]]:
    """(heading, title, unit, whether it is of numbers) of those that say something that the caption does not."""
    for heading in table.headings:
        if heading not in _SAID_BY_CAPTION or table.values[heading].nunique(dropna=False) > 1:
            title, _, unit = heading.removesuffix("]").partition(" [")
            yield heading, title, unit, not table.is_text(heading)


def _sorted_by(row: TableRow, heading: str) -> float | None:
    value = row.entries[heading].value if heading in row.entries else None
    return None if isinstance(value, str) else value


def _filters(study: Study) -> dict[str, Mapping[str, str]]:
    """Names with their colour, if that is how figures tell them apart, of what there are several of."""
    look = Look.of(study)
    by_colour = len(look.detectors) > 1
    detectors = {name: look.colour(name, "") if by_colour else "" for name in look.detectors}
    backends = {name: "" if by_colour else look.colour("", name) for name in look.backends}
    both = {"detector": detectors or dict.fromkeys(study.speeds["detector"], ""), "backend": backends}
    return {key: names for key, names in both.items() if len(names) > 1}


def _for_script(figure: Figure) -> dict[str, Any]:
    """What the page's script reads: traces and layouts checked by Plotly, and encoded as it reads them fastest."""
    cases = []
    for case in figure.cases.values():
        pictures = []
        for traces, layout in case.pictures:
            tree = json.loads(str(go.Figure(list(traces), go.Layout(template="none", **layout)).to_json()))
            del tree["layout"]["template"]
            pictures.append({"data": tree["data"], "layout": tree["layout"]})
        cases.append({"pictures": pictures, "caption": case.caption})
    return {"cases": cases, "narrow_height": figure.narrow_height, "height": figure.height, "views": figure.views}


# The headline ---------------------------------------------------------------------------------------------------------


def headline(study: Study) -> Iterator[str]:
    """The suite's question, answered with its own figures, in sentences."""
    if study.is_stress:
        yield from _robustness(study)
    elif means := [each for each in averages(study.flights) if each.means["ate_m"].notna().any()]:
        for data in dict.fromkeys(each.data for each in sorted(means, key=lambda each: -len(each.means))):
            best = min(
                (each for each in means if each.data == data), key=lambda each: float(each.means["ate_m"].mean())
            )
            on, ate = len(best.means), _spread(best.means["ate_m"], "sequences")
            who = _named(study, best.detector, best.backend)
            yield f"Lowest mean ATE on {on} {data} sequence{'s' if on != 1 else ''}: {who}, {ate}."
    else:
        yield from _one_flight(study)
    yield from _speed(study)
    for (flight, backend), own in groups(study.trials, ("sequence", "backend")):
        if nees := study.nees(own).get("pose"):
            times = nees.mean / PARTS["pose"]
            said = f"pose NEES {times:.1f} times the ideal over {len(own)} trials, {nees.verdict}"
            yield f"{backend} on {flight}: {said}."


def _one_flight(study: Study) -> Iterator[str]:
    """The contender that somebody puts forward, else the best one, among those on the same recording."""
    having = {cell: own for cell, own in groups(study.flights) if own["evaluated"].any()}
    if not having:
        return
    subject, band = study.results.reference.subject, study.results.reference.band
    ate_m = {cell: float(own["ate_m"].mean()) for cell, own in having.items()}

    def is_subject(cell: tuple[Any, ...]) -> bool:
        names = [name.partition(":")[0] for name in cell[4:]]
        return names == [subject.get("detector"), subject.get("backend")]

    first = next(filter(is_subject, having), min(having, key=lambda cell: ate_m[cell]))
    own, who = having[first], _named(study, *first[4:])
    where = f" on {first[1]} ({first[0]})" if study.flights.groupby(["data", "sequence"]).ngroups > 1 else ""
    shares = [e.inside_band(band.half_width_m) for f in records(own) if band and (e := study.errors(f))]
    if band and shares:
        percent = pd.DataFrame(shares).mean()
        inside, *others = (f"{percent[axis]:.0f} %" for axis in band.axes)
        within, *called = (f"inside ±{100 * band.half_width_m:g} cm", *band.axes.values())
        said = [f"{called[0]} {within} for {inside} of the estimated time"]
        said += [f"{name} for {share}" for name, share in zip(called[1:], others, strict=True)]
        yield f"{who}{where}: {', '.join(said)}."
    more = f"Its ATE is {_spread(own['ate_m'])}" if shares else f"{who}{where}: its ATE is {_spread(own['ate_m'])}"
    more += "" if own["complete"].all() else f" ({seeds_text(own)})"
    # Neither a contender on another recording is its rival, nor one that got out of a part of the flight.
    rivals = [cell for cell in having if cell[:4] == first[:4] and cell != first and having[cell]["complete"].all()]
    if rivals:
        rival = min(rivals, key=lambda cell: ate_m[cell])
        whole = own["complete"].all()
        verb = "the lowest here; next is" if whole else "the lowest of a whole flight is that of"
        verb = "the lowest here is that of" if ate_m[rival] < ate_m[first] else verb
        more += f", {verb} {_named(study, *rival[4:])}, {length(ate_m[rival])}"
    yield f"{more}."


def _robustness(study: Study) -> Iterator[str]:
    hard = study.flights[study.flights["condition"] != CLEAR]
    kinds = hard["data"].nunique()
    for (data,), own in groups(hard, ("data",)):
        rates = own.groupby("detector", sort=False)["succeeded"].mean().sort_values(ascending=False, kind="stable")
        shares = ", ".join(f"{_titled(study, str(name))} {100 * rate:.0f} %" for name, rate in rates.items())
        yield f"Flights that succeed under hard conditions{f' ({data})' if kinds > 1 else ''}: {shares}."
    if (baseline := study.baseline) is None:
        return
    for duel in duels(study.flights, baseline):
        if duel.condition is None and duel.both:
            low, high = duel.interval
            yield (
                f"{_named(study, duel.detector, duel.backend)} against {_titled(study, baseline)}, flight by flight"
                f"{f' ({duel.data})' if kinds > 1 else ''}: {duel.won} won, {duel.lost} lost, {duel.tied} tied; where "
                f"both are complete, {duel.ratio:.2f} times its ATE"
                f"{f' (95 %: {low:.2f} to {high:.2f})' if low < high else ''}."
            )


def _speed(study: Study) -> Iterator[str]:
    rows = records(study.speeds[study.speeds["status"] == "ok"])
    if not rows:
        return
    reference = study.results.reference
    place = next((k for k, row in enumerate(rows) if row["detector"] == reference.subject.get("detector")), 0)
    name, fps = rows[place]["detector"], rows[place]["fps"]
    quoted = reference.speed.detectors.get(name) if reference.speed else None
    against = f"; {reference.called} has {quoted.fps:.0f} ({quoted.source})" if quoted else ""
    yield f"{_titled(study, name)} runs at {fps:.0f} frames a second on this machine{against}."
    yield (
        f"It is number {place + 1} of the {len(rows)} that were measured, between {rows[-1]['fps']:.0f} and "
        f"{rows[0]['fps']:.0f} frames a second."
    )


def facts(study: Study) -> dict[str, str]:
    """The few figures that a reader asks for next, by what they are called."""
    tasks = {row["task"]: row for row in study.results.rows}.values()
    flown = study.flights
    found = {"Flights complete": f"{flown['complete'].sum()} of {len(flown)}"} if len(flown) else {}
    found["Tasks failed"] = f"{sum(row['status'] == 'failed' for row in tasks)} of {len(tasks)}"
    # A trial has no images; its note says so.
    notes = [row["data_note"] if row["kind"] == "trial" else WHAT[Data(row["data"])] for row in tasks if row["data"]]
    found |= {"Data": "; ".join(dict.fromkeys(notes))} if notes else {}
    on = [row["machine"] or {} for row in tasks]
    machines = dict.fromkeys(f"{each.get('cpu', '?')}, {each.get('cpu_count', '?')} cores" for each in on)
    return found | {"Machine": "; ".join(machines)}


def _spread(values: pd.Series, over: str = "seeds") -> str:
    std, n = values.std(), values.count()
    return length(values.mean(), std) + ("" if pd.isna(std) else f" over {n} {over}")


def _named(study: Study, detector: str, backend: str) -> str:
    return f"{_titled(study, detector)} with {backend}"


def _titled(study: Study, detector: str) -> str:
    """As somebody else prints it, where the suite has a reference that does, with the options that it was given."""
    name, colon, options = detector.partition(":")
    speed = study.results.reference.speed
    return f"{speed.detectors[name].title}{colon}{options}" if speed and name in speed.detectors else detector
