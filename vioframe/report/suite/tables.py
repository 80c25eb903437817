"""The tables that a suite's results have data for, in the order in which a reader asks."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import groupby
from pathlib import Path
from shlex import quote
from typing import Any

import pandas as pd

from vioframe.evaluation import ALIGNED_BY
from vioframe.evaluation.consistency import PARTS, over_trials
from vioframe.report.suite.statistics import (
    COMPLETE,
    CONTENDER,
    ENOUGH_TO_DRAW_FROM,
    SUCCESS_PERCENT,
    Study,
    averages,
    condition_text,
    count_caption,
    curves,
    data_caption,
    duels,
    groups,
    holm,
    machines,
    records,
    seeds_text,
    stage_means,
    timed,
)
from vioframe.report.table import Entry, Table, TableRow, mean, number, text
from vioframe.runs.evaluated import MATCHED_TRUTH
from vioframe.runs.results import CLEAR, Data

Entries = dict[str, Entry]
_FACTS = ("vioframe", "commit", "python", "platform", "cpu", "cpu_count", "memory_gib", "threads")


def tables(study: Study) -> list[Table]:
    """All that have a row: the figures, what went wrong, how to check, where from."""
    return [table for make in _TABLES if (table := make(study)) is not None and table.rows]


def write_tables(every: Iterable[Table], folder: Path, to_results: str) -> list[Path]:
    """``NAME.csv``, ``.md`` and ``.tex`` in ``folder``; ``to_results`` leads from there to the results."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for table in every:
        texts = {"csv": table.to_csv(), "md": table.to_markdown(to_results), "tex": table.to_latex()}
        for ending, content in texts.items():
            written.append(folder / f"{table.name}.{ending}")
            written[-1].write_text(content, encoding="utf-8")
    return written


# Accuracy -----------------------------------------------------------------------------------------------------------


def _accuracy(study: Study) -> Table:
    """All that a reader needs to know of an ATE beside it."""

    def entries(own: pd.DataFrame) -> Entries:
        ate, closed = own["ate_m"], own.loc[own["evaluated"], "loop_closed"].eq(True)
        return {
            "seeds": text(seeds_text(own)),
            "ATE, position + yaw [m]": number(ate.mean(), ".3f"),
            **{f"{key} [m]": number(getattr(ate, key)(), ".3f") for key in ("std", "median", "min", "max")},
            "ATE [% of path]": mean(own["ate_percent"], ".2f"),
            "ATE, SE(3) [m]": mean(own["ate_se3_m"], ".3f"),
            "orientation [deg]": mean(own["orientation_deg"], ".2f"),
            "yaw [deg]": mean(own["yaw_deg"], ".2f"),
            "scale by Sim(3)": mean(own["scale"], ".3f"),
            **_circumstances(own),
            "loop closure": text(("yes" if closed.all() else "some") if closed.any() else ""),
        }

    caption = (
        "Mean over the seeds of each flight's RMSE, ± the sample standard deviation, and the range; aligned as the "
        "column says, over the whole path. Failed flights are counted under seeds and have no error. "
        f"{count_caption(study.flights)} {data_caption(study.flights)}"
    )
    return Table("accuracy", "Accuracy", caption, _by_cell(study, entries))


def _averages(study: Study) -> Table:
    rows, over = [], {}
    for average in averages(study.flights):
        names = list(average.means.index)
        over[average.data, tuple(names)] = f"{average.data}: {', '.join(names) or 'none'}."
        entries = {
            "data": text(average.data),
            "condition": text(condition_text(average.condition, average.level)),
            **_contender(average.detector, average.backend),
            "sequences": text(f"{len(names)} of {average.of}"),
            "ATE, position + yaw [m]": number(average.means["ate_m"].mean(), ".3f"),
            "std over sequences [m]": number(average.means["ate_m"].std(), ".3f"),
            "ATE, SE(3) [m]": mean(average.means["ate_se3_m"], ".3f"),
            "orientation [deg]": mean(average.means["orientation_deg"], ".2f"),
        }
        rows.append(TableRow(entries, links(average.flights, named=True), average.detector, average.backend))
    caption = (
        "Means over the sequences on which every flight of every contender was complete; real, rendered and simulated "
        f"recordings are never averaged together. Start offsets and resets are in the table of accuracy. Averaged "
        f"over: {' '.join(over.values())}"
    )
    return Table("averages", "Averages over sequences", caption, tuple(rows))


def _published(study: Study) -> Table | None:
    """ATE by sequence: what was published, then what was measured here; each row with its own alignment."""
    published = study.results.suite.get("published") or ()
    found = study.flights[study.flights["condition"] == CLEAR]
    flown = [key for key, _ in groups(found, ("sequence", "data"))]
    elsewhere = dict.fromkeys(name for system in published for name in system["ate_m"])
    names = [*flown, *((name, None) for name in elsewhere if name not in dict(flown))]
    headings = {at: f"{at[0]} [m]" if at[1] in (Data.REAL, None) else f"{at[0]} ({at[1]}) [m]" for at in names}

    def about(system: str, alignment: str, source: str) -> Entries:
        by = ALIGNED_BY.get(alignment, alignment)
        return {"system": text(system), "alignment": text(by), "source": text(source)}

    rows = []
    for system in published:
        values = {headings[at]: number(system["ate_m"].get(at[0]), ".3f") for at in names}
        entries = about(system["system"], system["alignment"], f"published: {system['source']}")
        rows.append(TableRow({**entries, **values}))
    alignments = ["posyaw", "se3", *(["sim3"] if any(each["alignment"] == "sim3" for each in published) else [])]
    for (detector, backend), own in groups(found, CONTENDER) if published else ():
        for alignment in alignments:
            values = {
                headings[at]: _over_seeds(study, here, alignment) for at, here in groups(own, ("sequence", "data"))
            }
            entries = about(f"{detector} + {backend}", alignment, "measured here")
            rows.append(TableRow({**entries, **values}, links(own, named=True), detector, backend))
    caption = (
        "Published ATE beside what was measured here, never averaged together. Alignments differ by row: compare only "
        "rows of the same one. Published rows are of the real recordings; in a column marked rendered or simulated the "
        "measured rows are of that stand-in, which is another recording. Measured: mean over the seeds, and of how "
        "many where some have no error; start offsets, completion and resets are in the table of accuracy. "
        f"{data_caption(found)}"
    )
    return Table("published", "ATE beside published systems", caption, tuple(rows))


def _over_seeds(study: Study, own: pd.DataFrame, alignment: str) -> Entry:
    if alignment == "sim3":
        errors = [study.errors(flight) for flight in records(own)]
        values = pd.Series([each.ate_sim3_m if each else None for each in errors], dtype=float)
    else:
        values = own["ate_m" if alignment == "posyaw" else "ate_se3_m"]
    if not values.count():
        return text(seeds_text(own))
    return mean(values, ".3f", "" if values.count() == len(own) else f" ({values.count()} of {len(own)})")


def _band(study: Study) -> Table | None:
    """Percent of the time inside the band that somebody claims, with the worst of the seeds."""
    if (claimed := study.results.reference.band) is None:
        return None
    cm = f"{100 * claimed.half_width_m:g} cm"

    def entries(own: pd.DataFrame) -> Entries | None:
        errors = filter(None, map(study.errors, records(own)))
        inside = pd.DataFrame([each.inside_band(claimed.half_width_m) for each in errors])
        if inside.empty:
            return None
        return {
            "seeds": text(seeds_text(own)),
            **{f"|{axis}| within {cm} [% of time]": mean(inside[axis], ".1f") for axis in "xyz"},
            f"all within {cm} [% of time]": mean(inside["all"], ".1f"),
            **{f"{axis}, worst seed [% of time]": number(inside[axis].min(), ".1f") for axis in claimed.axes},
        }

    caption = (
        f"Part of the estimated time in which the position error stays within {cm} along each axis of the truth's "
        f"world (z is the altitude), after alignment by position and yaw; mean over the seeds. {claimed.claim} Time "
        f"that was not estimated is not in it: see completion. {data_caption(study.flights)}"
    )
    return Table("band", f"Within ±{cm}", caption, _by_cell(study, entries))


def _metrics(study: Study) -> Table:
    """What the metrics that the suite asked for say, a column a figure."""
    names = [str(name) for name in study.flights.columns if str(name).startswith("metrics.")]
    left_out = Counter(
        reason for told in study.flights["metrics_left_out"] if isinstance(told, Mapping) for reason in told.items()
    )

    def entries(own: pd.DataFrame) -> Entries | None:
        figures = {name.removeprefix("metrics."): mean(own[name], ".4g") for name in names}
        return {"seeds": text(seeds_text(own)), **figures} if names or left_out else None

    why = "".join(f"No {name} ({n} of the flights): {reason}. " for (name, reason), n in left_out.items())
    caption = (
        "Mean over the seeds that have one, ± the standard deviation, of what the suite's metrics say of each flight. "
        f"{why}{data_caption(study.flights)}"
    )
    return Table("metrics", "Metrics", caption, _by_cell(study, entries))


# Hard conditions ----------------------------------------------------------------------------------------------------


def _levels(study: Study) -> Table:
    """A row for each point of each curve."""
    rows = []
    for point in records(curves(study.flights)):
        own, percent = point["flights"], 100.0
        entries = {
            **{key: text(point[key]) for key in ("sequence", "data", "condition")},
            "level": number(point["level"], "g"),
            **_contender(point["detector"], point["backend"]),
            "flights": text(seeds_text(own)),
            "success [%]": number(percent * point["success"], ".0f"),
            "95 % from [%]": number(percent * point["success_low"], ".0f"),
            "to [%]": number(percent * point["success_high"], ".0f"),
            "ATE, position + yaw, geometric mean [m]": number(point["ate_m"], ".3f"),
            "95 % from [m]": number(point["low"], ".3f"),
            "to [m]": number(point["high"], ".3f"),
            "ATE, mean [m]": number(own["ate_m"].mean(), ".3f"),
            "std [m]": number(own["ate_m"].std(), ".3f"),
            **_circumstances(own),
        }
        rows.append(TableRow(entries, links(own), point["detector"], point["backend"]))
    caption = (
        f"Success: complete, with an ATE below {SUCCESS_PERCENT:g} % of the path, of all flights, failed ones too, "
        "with Wilson's 95 % interval. ATE: of the flights that have one, so that it flatters where others failed, with "
        "Student's 95 % interval in the logarithm, its spread pooled over the levels of the curve. Level 0 is the "
        f"flight without degradation. {count_caption(study.flights)} {data_caption(study.flights)}"
    )
    return Table("stress", "Hard conditions by level", caption, tuple(rows))


def _duels(study: Study) -> Table | None:
    """Against the baseline: a row for each condition and contender; last, over all that are degraded."""
    if (baseline := study.baseline) is None:
        return None
    rows = []
    for _, family in groupby(duels(study.flights, baseline), key=lambda duel: duel.condition is None):
        members = list(family)
        for duel, p_of_all in zip(members, holm(duel.p_value for duel in members), strict=True):
            low, high = duel.interval
            entries = {
                "data": text(duel.data),
                "condition": text(duel.condition or "all degraded"),
                **_contender(duel.detector, duel.backend),
                **{key: number(getattr(duel, key), "d") for key in ("won", "lost", "tied")},
                f"ATE over that of {baseline}, geometric mean": number(duel.ratio, ".2f"),
                "95 % from": number(low, ".2f"),
                "to": number(high, ".2f"),
                "of pairs": number(duel.both, "d"),
                "p, sign test": number(duel.p_value, ".3f"),
                "p, Holm": number(p_of_all, ".3f"),
            }
            rows.append(TableRow(entries, (), duel.detector, duel.backend))
    caption = (
        f"Flight by flight against {baseline}: same recording, condition, level, back-end and seed, the levels of a "
        "condition together. A complete flight wins against one that is not, an ATE against none, else the smaller "
        "one; tied: equal, or neither has one. The ratio is of the pairs in which both are complete; below 1 is better "
        f"than {baseline}. Its interval is by the bootstrap over sequences and seeds, of which there must be "
        f"{ENOUGH_TO_DRAW_FROM}. The two-sided sign test takes the pairs for independent, which flights in one world "
        "are not quite; Holm's p counts that there are as many tests as rows, those over all degraded flights apart. "
        f"{'All degraded: the rows above together, but for the clear ones. ' if study.is_stress else ''}"
        f"{data_caption(study.flights)}"
    )
    return Table("duels", f"Against {baseline}", caption, tuple(rows))


# Speed --------------------------------------------------------------------------------------------------------------


def _detector_fps(study: Study) -> Table | None:
    """Frames a second as quoted and as measured here, apart; detectors that could not take part with the reason."""
    timed = study.speeds
    if timed.empty:
        return None
    quoted = study.results.reference.speed
    speeds = quoted.detectors if quoted else {}
    rows = []
    known = [*records(timed)]
    unknown = [name for name in speeds if name not in {row["detector"].partition(":")[0] for row in known}]
    known += [{"detector": name, "status": "absent", "error": "no such detector is installed"} for name in unknown]
    for row in known:
        speed = speeds.get(row["detector"].partition(":")[0])
        entries = {
            "detector": text(row["detector"]),
            "quoted [FPS]": number(speed.fps if speed else None, ".0f"),
            "quoted from": text(speed.source if speed else ""),
            "measured here [FPS]": number(row.get("fps"), ".1f"),
        }
        if row["status"] == "absent":
            entries["quartiles [FPS]"] = text(f"not measured: {row['error']}")
        else:
            entries |= {
                "quartiles [FPS]": text(f"{row['fps_low']:.1f} to {row['fps_high']:.1f}"),
                "median [ms]": number(row["ms"], ".2f"),
                "keypoints": number(row["keypoints"], ".0f"),
                "calls": number(int(row["calls"]), "d"),
                "on": text(row["on"]),
            }
        rows.append(TableRow(entries, (), row["detector"]))
    about = f" Quoted: {quoted.title}, which compares with nothing that was measured here." if quoted else ""
    title = f"Detector speed beside {quoted.title}" if quoted else "Detector speed"
    return Table("detector_fps", title, f"{speed_caption(timed)}{about}", tuple(rows))


def speed_caption(timed: pd.DataFrame) -> str:
    """How detectors were timed."""
    row = timed.iloc[0]
    return (
        f"At {row['width']:.0f} x {row['height']:.0f} pixels with {row['max_points']:.0f} keypoints asked for, one "
        f"image at a time: median of {row['rounds']:.0f} rounds over {row['image_count']:.0f} images "
        f"({row['images']}), on {'; '.join(row['devices'])}."
    )


def _timing(study: Study) -> Table:
    """Milliseconds a frame by stage, a row a contender and data kind."""
    rows = []
    times = timed(study.flights)
    for stages in records(stage_means(times).reset_index()):
        data, detector, backend = who = [stages.pop(key) for key in ("data", *CONTENDER)]
        own = times[(times[["data", *CONTENDER]] == who).all(axis="columns")]
        entries = {
            "data": text(data),
            **_contender(detector, backend),
            "flights": number(len(own), "d"),
            "real-time factor": mean(own["real_time_factor"], ".2f"),
            "real-time factor, min": number(own["real_time_factor"].min(), ".2f"),
            "all [ms a frame]": number(own["frame_ms"].mean(), ".1f"),
            "std [ms a frame]": number(own["frame_ms"].std(), ".1f"),
            **{f"{stage} [ms]": number(ms if ms > 0.0 else None, ".2f") for stage, ms in stages.items()},
        }
        rows.append(TableRow(entries, links(own, named=True), detector, backend))
    caption = (
        "Mean over all flights of a contender that initialised; stages add up to the whole, without reading and "
        "decoding images. Real-time factor: seconds of flight by seconds of computing, in each flight's own process. "
        f"{machines(study.flights)} {data_caption(study.flights)}"
    )
    return Table("timing", "Time a frame", caption, tuple(rows))


# What a reader needs to trust the others ----------------------------------------------------------------------------


def _nees_of_flights(study: Study) -> Table:
    """Mean NEES by part of the pose, where a back-end stated a covariance."""
    parts = {f"nees.{part}": f"{part}, ideally {dof}" for part, dof in PARTS.items() if f"nees.{part}" in study.flights}

    def entries(own: pd.DataFrame) -> Entries | None:
        figures = {title: mean(own[column], ".2f") for column, title in parts.items()}
        stated = any(entry.value is not None for entry in figures.values())
        return {"seeds": text(seeds_text(own)), **figures} if stated else None

    caption = (
        "Normalised estimation error squared, position and yaw fixed at the first pose: mean over time, then over the "
        "seeds. Above the ideal, the number of degrees of freedom, a filter is surer of itself than it should be. "
        f"Errors within a flight hang together, so a few flights are no test at a level. {data_caption(study.flights)}"
    )
    return Table("nees_flights", "Consistency (NEES) of the flights", caption, _by_cell(study, entries))


def nees_of_trials(study: Study) -> Table:
    """The same of simulated trials, with the bounds within which an honest filter's mean lies, and failures."""
    rows = []
    for (flight, backend), own in groups(study.trials, ("sequence", "backend")):
        whole = over_trials(own)
        failures = [f"{n} {kind}" for kind, n in whole["failures"].items() if n]
        entries = {
            "flight": text(flight),
            "back-end": text(backend),
            "trials": number(len(own), "d"),
            "failed": text(", ".join(failures) or "none"),
            "resets, all trials": number(whole["resets"], "d"),
            "initialised after [s]": number(whole["initialised_s"], ".2f"),
            "completion [%]": number(100.0 * own["completion"].mean(), ".1f"),
            "ATE, position + yaw, RMS [m]": number(whole["ate_m"], ".3f"),
            "worst [m]": number(own["ate_m"].max(), ".3f"),
            "ATE, RMS [% of path]": number(whole["percent"], ".3f"),
            "orientation, RMS [deg]": number(whole["orientation_deg"], ".2f"),
            "worst [deg]": number(own["orientation_deg"].max(), ".2f"),
        }
        for part, nees in study.nees(own).items():
            low, high = nees.mean_band
            entries |= {
                f"{part} NEES, ideally {nees.dof}": number(nees.mean, ".2f"),
                f"{part}, 95 % if honest": text(f"{low:.2f} to {high:.2f}"),
                f"{part}, verdict": text(nees.verdict),
                f"{part}, over its ideal": number(nees.per_axis, ".2f"),
                f"{part}, instants in bounds [%]": number(100.0 * nees.inside, ".0f"),
            }
        entries["back-end [ms a frame]"] = number(whole["cpu_ms"], ".1f")
        rows.append(TableRow(entries, links(own), None, backend))
    caption = (
        "Simulated tracks and IMU with EuRoC's noise, true calibration, the back-end's own initialisation. NEES: mean "
        "over time, then over the trials, beside the 95 % bounds for the mean of that many independent samples. Trials "
        "that diverged are in the errors; those that never initialised or crashed have none, and are counted."
    )
    return Table("nees", "Consistency (NEES)", caption, tuple(rows))


def _failures(study: Study) -> Table:
    """A row for each flight that something went wrong in, and for each other task that failed."""
    flown = records(study.flights[study.flights["outcome"] != COMPLETE])
    others = [row for row in study.results.rows if row["kind"] != "flight" and row["status"] == "failed"]
    rows = []
    for row in (*flown, *({**row, "outcome": "failed", "reason": row["error"]} for row in others)):
        about = {key: text(row[key]) for key in ("task", "outcome", "reason")}
        folder = (("folder", row["folder"]),) if row["folder"] else ()
        entries = {**about, "attempts": number(row["attempts"], ".0f")}
        rows.append(TableRow(entries, folder, row["detector"], row["backend"]))
    caption = (
        "Every task that failed, never initialised, could not be evaluated or is not complete; all are counted in the "
        "other tables."
    )
    return Table("failures", "What went wrong", caption, tuple(rows))


def _evo(study: Study) -> Table:
    """The commands that re-derive each ATE by SE(3), to be run in the results folder."""
    rows = []
    for flight in records(study.flights[study.flights["ate_se3_m"].notna()]):
        estimate = "trajectory_loop.tum" if flight["loop_closed"] is True else "trajectory.tum"
        truth, estimate = (quote(f"{flight['folder']}/{file}") for file in (MATCHED_TRUTH, estimate))
        entries = {
            "task": text(flight["task"]),
            "ATE, SE(3) [m]": number(flight["ate_se3_m"], ".6f"),
            "command": text(f"evo_ape tum {truth} {estimate} --align"),
        }
        rows.append(TableRow(entries, (("run", flight["folder"]),), flight["detector"], flight["backend"]))
    caption = (
        "Run in the results folder; rmse is the ATE after SE(3) alignment. ground_truth_matched.tum is the true pose "
        "at every estimated stamp, as `vioframe evaluate` pairs them. evo has no alignment by position and yaw."
    )
    return Table("evo", "Check it with evo", caption, tuple(rows), code="command")


def _provenance(study: Study) -> Table:
    """What everything was computed with; several values of one thing where they differ."""
    tasks = {row["task"]: row for row in study.results.rows}.values()
    counts: dict[str, Counter[str]] = {}
    for row in tasks:
        for what, value in _facts(row["machine"] or {}):
            counts.setdefault(what, Counter())[value] += 1
        if row["code"]:
            counts.setdefault("digest of the code", Counter())[row["code"]] += 1
    rows = [
        TableRow({"what": text(what), "value": text(value), "tasks": number(n, "d")})
        for what, values in counts.items()
        for value, n in values.items()
    ]
    caption = f"What the {len(tasks)} tasks were computed with; several values of one thing where they differ."
    return Table("provenance", "Machine and versions", caption, tuple(rows))


def _facts(machine: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for fact in dict.fromkeys((*_FACTS, *machine)):
        if (value := machine.get(fact)) is not None and fact != "versions":
            yield fact, value if isinstance(value, str) else json.dumps(value).strip('{}"')
    yield from machine.get("versions", {}).items()


_TABLES: tuple[Callable[[Study], Table | None], ...] = (
    *(_detector_fps, _levels, _duels, _accuracy, _averages, _published, _band, _metrics, _timing),
    *(_nees_of_flights, nees_of_trials, _failures, _evo, _provenance),
)


# What several tables have -------------------------------------------------------------------------------------------


def _by_cell(study: Study, entries: Callable[[pd.DataFrame], Entries | None]) -> tuple[TableRow, ...]:
    """A row for each group of flights that differ by their seed alone and of which there is something to say."""
    rows = []
    for cell, own in groups(study.flights):
        if (said := entries(own)) is not None:
            data, sequence, condition, level, detector, backend = cell
            about = {"sequence": sequence, "data": data, "condition": condition_text(condition, level)}
            labels = {**{key: text(value) for key, value in about.items()}, **_contender(detector, backend)}
            rows.append(TableRow({**labels, **said}, links(own), detector, backend))
    return tuple(rows)


def _contender(detector: str, backend: str) -> Entries:
    return {"detector": text(detector), "back-end": text(backend)}


def _circumstances(own: pd.DataFrame) -> Entries:
    """What no ATE can be read without."""
    low, high = own["start_s"].min(), own["start_s"].max()
    start = "" if pd.isna(low) else f"{low:g}" if low == high else f"{low:g} to {high:g}"
    return {
        "start offset [s]": text(start),
        "initialised after [s]": mean(own["initialised_after_s"], ".2f"),
        "completion [%]": number(100.0 * own["completion"].mean(), ".1f"),
        "resets, all seeds": number(own["resets"].sum(min_count=1), ".0f"),
    }


def links(own: pd.DataFrame, *, named: bool = False) -> tuple[tuple[str, str], ...]:
    """(seed, folder relative to the results) of flights or trials that left one, ``named`` by their sequence."""
    rows = records(own[own["folder"].notna()])
    return tuple((f"{row['sequence'] + ', ' if named else ''}seed {row['seed']}", row["folder"]) for row in rows)
