"""Tables of speed: Table 3.2 of the thesis, and the time of a flight by stage."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from vioframe.bench.detectors.quoted import TABLE_3_2
from vioframe.report.suite.captions import data_caption, run_path, task_path
from vioframe.report.suite.flights import Flight
from vioframe.report.suite.results import Data, TaskResult
from vioframe.report.suite.statistics import Group, Spread
from vioframe.report.suite.table import Column, Row, Table, mean, number, text

_NOT_THERE = "no such detector is installed"


def detector_speed(task: TaskResult) -> Table:
    """Frames a second as quoted and as measured here, apart; detectors that could not take part with the reason."""
    columns = (
        Column("detector", text=True),
        Column("quoted", "FPS"),
        Column("quoted from", text=True),
        Column("measured here", "FPS"),
        Column("quartiles", "FPS", text=True),
        Column("median", "ms"),
        Column("keypoints"),
        Column("calls"),
        Column("on", text=True),
    )
    rows = []
    link = (("task", task_path(task)),)
    for row in task.result["rows"]:
        measured, quoted = row["measured"], row.get("quoted") or {}
        low, high = measured["fps_quartiles"]
        entries = (
            text(row["detector"]),
            number(quoted.get("fps"), ".0f"),
            text(quoted.get("source", "")),
            number(measured["fps"], ".1f"),
            text(f"{low:.1f} to {high:.1f}"),
            number(measured["ms"], ".2f"),
            number(measured["points"], ".0f"),
            number(row["calls"], "d"),
            text(measured["on"]),
        )
        rows.append(Row(entries, link))
    nothing = number(None, "")
    taking_part = {row["detector"].partition(":")[0] for row in task.result["rows"]}
    absent = {name: _NOT_THERE for name in TABLE_3_2 if name not in taking_part} | task.result["absent"]
    for name, reason in absent.items():
        quoted_speed = TABLE_3_2.get(name)
        about = (
            text(name),
            number(quoted_speed.fps if quoted_speed else None, ".0f"),
            text(quoted_speed.source if quoted_speed else ""),
        )
        rows.append(Row((*about, nothing, text(f"not measured: {reason}"), *[nothing] * 4)))
    settings = task.result["settings"]
    width, height = settings["resolution"]
    caption = (
        f"At {width} x {height} pixels with {settings['max_points']} keypoints asked for. Quoted figures are not like "
        "for like: other machines, classics on a CPU beside networks on a GPU. Measured: one image at a time, median "
        f"of {settings['rounds']} rounds over {settings['image_count']} images ({settings['images']}), on "
        f"{'; '.join(settings['devices'])}."
    )
    return Table("detector_fps", "Detector speed (Table 3.2)", caption, columns, tuple(rows))


def timing(found: Sequence[Group]) -> Table | None:
    """Milliseconds a frame by stage, a row a contender and data kind; None where nothing was timed."""
    means = pooled_stages(found)
    if not means:
        return None
    stages = list(dict.fromkeys(stage for stage_ms in means.values() for stage in stage_ms))
    columns = (
        Column("data", text=True),
        Column("detector", text=True),
        Column("back-end", text=True),
        Column("flights"),
        Column("real-time factor"),
        Column("real-time factor, min"),
        Column("all", "ms a frame"),
        Column("std", "ms a frame"),
        *(Column(stage, "ms") for stage in stages),
    )
    rows = []
    for (data, detector, backend), stage_ms in means.items():
        own = _flights_of(found, (data, detector, backend))
        factor, frame = (Spread(_values(own, key)) for key in ("real_time_factor", "frame_ms"))
        entries = (
            text(data.value),
            text(detector),
            text(backend),
            number(frame.n, "d"),
            mean(factor, ".2f"),
            number(factor.min, ".2f"),
            number(frame.mean, ".1f"),
            number(frame.std, ".1f"),
            *(number(stage_ms.get(stage), ".2f") for stage in stages),
        )
        rows.append(Row(entries, tuple((flight.task.key, run_path(flight)) for flight in own)))
    caption = (
        "Mean over all flights of a contender that initialised; stages add up to the whole, without reading and "
        "decoding images. Real-time factor: seconds of flight by seconds of computing, in each flight's own process. "
        f"{machines(found)} {data_caption(found)}"
    )
    return Table("timing", "Time a frame", caption, columns, tuple(rows))


def pooled_stages(found: Sequence[Group]) -> dict[tuple[Data, str, str], dict[str, float]]:
    """Mean milliseconds a frame by stage, over all flights by data kind and contender."""
    keys = dict.fromkeys((group.cell.data, *group.cell.contender) for group in found)
    out = {}
    for key in keys:
        if not (own := _flights_of(found, key)):
            continue
        stages = dict.fromkeys(name for flight in own for name in flight.figures if name.startswith("stage_ms."))
        # A stage that did not take place in a flight took 0 there.
        out[key] = {
            name.removeprefix("stage_ms."): sum(flight.figures.get(name, 0.0) for flight in own) / len(own)
            for name in stages
        }
    return out


def machines(found: Iterable[Group]) -> str:
    """On what the flights were flown, in a sentence."""
    names = dict.fromkeys(_machine(flight.task.machine) for group in found for flight in group.flights)
    return f"Measured on {' and on '.join(names)}."


def _machine(machine: Mapping[str, Any]) -> str:
    return f"{machine.get('cpu', 'an unknown processor')} ({machine.get('cpu_count', '?')} cores)"


def _flights_of(found: Iterable[Group], key: tuple[Data, str, str]) -> list[Flight]:
    return [
        flight
        for group in found
        if (group.cell.data, *group.cell.contender) == key
        for flight in group.flights
        if "frame_ms" in flight.figures and "initialised_after_s" in flight.figures
    ]


def _values(flights: Iterable[Flight], figure: str) -> tuple[float, ...]:
    return tuple(flight.figures[figure] for flight in flights if figure in flight.figures)
