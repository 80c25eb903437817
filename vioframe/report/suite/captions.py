"""What captions say of the data: real, rendered or simulated, and how often flown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from vioframe.report.suite.flights import Flight
from vioframe.report.suite.results import RUN_FOLDER, TASKS_FOLDER, Data, TaskResult
from vioframe.report.suite.statistics import Group

WHAT = {
    Data.REAL: "real images and IMU",
    Data.RENDERED: "rendered images with the real IMU",
    Data.SIMULATED: "a simulated stand-in flight: images, IMU and motion",
}
_SPELT_OUT = 2
"""More notes than this, of as many recordings, would be longer than the table."""


def data_caption(found: Iterable[Group]) -> str:
    """Which sequences are of which kind of data, and what is known about them, in sentences."""
    sequences: dict[Data, dict[str, str]] = {}
    for group in found:
        sequences.setdefault(group.cell.data, {}).setdefault(group.cell.sequence, group.data_note)
    notes = [note for own in sequences.values() for note in own.values()]
    spell_out = all(notes) and len(notes) <= _SPELT_OUT
    parts = []
    for data in sorted(sequences, key=list(Data).index):
        own = sequences[data]
        text = "; ".join(note.rstrip(".") for note in own.values()) if spell_out else f"{', '.join(own)}: {WHAT[data]}"
        parts.append(f"Data ({data}): {text}.")
    return " ".join(parts)


def runs_caption(found: Sequence[Group]) -> str:
    """How many flights there are in all, and how many of them have no error to show."""
    total, evaluated = sum(group.count for group in found), sum(group.evaluated for group in found)
    flown = f"{total} flight{'s' if total != 1 else ''}"
    missing = total - evaluated
    return (
        f"{flown}; {missing} without an error to show." if missing else f"{flown}, all of them with an error to show."
    )


def links(flights: Iterable[Flight]) -> tuple[tuple[str, str], ...]:
    """(seed, folder relative to the results): the run folder, or that of the task where the flight never began."""
    return tuple((f"seed {flight.seed}", run_path(flight)) for flight in flights)


def run_path(flight: Flight) -> str:
    """The run folder of a flight, relative to the results; that of its task where it never began."""
    path = task_path(flight.task)
    return f"{path}/{RUN_FOLDER}" if (flight.task.folder / RUN_FOLDER).is_dir() else path


def task_path(task: TaskResult) -> str:
    return f"{TASKS_FOLDER}/{task.folder.name}"


def condition_text(condition: str, level: float) -> str:
    return condition if level == 0.0 else f"{condition} {level:g}"
