"""The results folder of a suite of benchmarks: one tidy table, and the run folders that its figures come from.

``RESULTS/suite.yaml`` is the suite as it was run. ``RESULTS/results.jsonl`` has a row, a JSON object, for each flight,
each trial on simulated tracks, and each detector that was timed. ``RESULTS/runs/TASK`` is the run folder of a flight,
as ``vioframe run`` writes it, with ``ground_truth_matched.tum`` beside its trajectory, or has the ``nees.csv`` of a
trial.

Every row has :data:`TASK_COLUMNS`; what came of the task stands beside them, by name, as far as there is any of it:

- a *flight*: ``ate_m``, ``ate_percent`` (of the path), ``ate_se3_m``, ``scale``, ``orientation_deg``, ``yaw_deg``,
  ``path_length_m``, ``coverage``, ``completion``, ``resets``, ``start_s``, ``initialised_after_s``, ``flown_s``,
  ``frames``, ``finished``, ``loop_closed``, ``frame_ms``, ``real_time_factor``, ``stage_ms.STAGE``, ``nees.PART``
  (mean), ``relative.8m.translation_percent`` (mean) and the like, ``metrics.METRIC.FIGURE``; ``not_evaluated``,
  ``last_event`` and ``metrics_left_out`` say why something is missing. With loop closure, errors are of the corrected
  trajectory;
- a *trial*: ``failure``, ``detail``, ``ate_m``, ``orientation_deg``, ``completion``, ``resets``, ``nees.PART`` (mean);
- a detector's *speed*: ``fps``, ``fps_low`` and ``fps_high`` (quartiles), ``ms``, ``keypoints``, ``calls``, ``on``, and
  the settings ``images``, ``image_count``, ``rounds``, ``width``, ``height``, ``max_points``, ``devices``.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from vioframe.errors import RunError
from vioframe.parts.config import Section, read_tree, validate
from vioframe.runs.recorder import RUN_FILES, write_whole

SUITE_FILE, TABLE_FILE, RUNS_FOLDER = "suite.yaml", "results.jsonl", "runs"
NEES_FILE = "nees.csv"
TASK_FILES = (*RUN_FILES, NEES_FILE)
REPORT_FOLDER = "report"
REPORT_FILES = ("index.html", "tables/*.csv", "tables/*.md", "tables/*.tex", "figures/*.png", "figures/*.svg")
RESULT_FILES = (
    *(SUITE_FILE, TABLE_FILE),
    *(f"{RUNS_FOLDER}/*/{file}" for file in TASK_FILES),
    *(f"{REPORT_FOLDER}/{file}" for file in REPORT_FILES),
)
"""What a results folder holds, as patterns: the files of the tasks, of the report, and all together."""

CLEAR = "clear"
"""The condition without any degradation, at level 0."""
CELL = ("data", "sequence", "condition", "level", "detector", "backend")
"""What flights that differ by their seed alone have in common."""
FINGERPRINT = ("code", "config", "inputs")
"""What a row depends on: digests of the code, of the configuration, and of the data."""
TASK_COLUMNS = (
    *("task", "kind", *CELL, "seed", "data_note", *FINGERPRINT),
    *("status", "error", "attempts", "seconds", "machine", "folder"),
)
"""``kind`` is flight, trial or speed; ``status`` ok, failed, or absent for a detector that lacks something."""

Row = Mapping[str, Any]


class Data(StrEnum):
    """What a flight was made on; figures of different kinds never go into one average."""

    REAL = "real"
    """Recorded images and IMU."""
    RENDERED = "rendered"
    """The recorded IMU; images rendered along the recorded motion."""
    SIMULATED = "simulated"
    """A simulated flight that stands in for the one asked for: motion, IMU and images."""


class Band(Section):
    """Errors of the position along ``axes``, by what they are called, are claimed to stay within ``half_width_m``."""

    half_width_m: float = Field(gt=0.0)
    axes: dict[Literal["x", "y", "z"], str]
    claim: str = ""


class QuotedSpeed(Section):
    """Frames a second of a detector as somebody else has them; ``source`` says what is known of how."""

    title: str
    fps: float
    source: str


class QuotedSpeeds(Section):
    """A table of frames a second, by name of the detector."""

    title: str
    claim: str = ""
    detectors: dict[str, QuotedSpeed]


class QuotedFigure(Section):
    """What somebody else calls a figure of the report: the name of its ``file``, and the beginning of its caption."""

    file: str
    title: str


class Reference(Section):
    """What somebody claims, quotes and shows, for the report of the suites that name it and of no other.

    ``subject`` is the detector and the back-end that it puts forward, and so whom a report speaks of first.
    """

    called: str = ""
    subject: dict[Literal["detector", "backend"], str] = Field(default_factory=dict)
    band: Band | None = None
    speed: QuotedSpeeds | None = None
    figures: dict[str, QuotedFigure] = Field(default_factory=dict)


@dataclass(frozen=True)
class Results:
    """All that is in a results folder; ``suite`` is the tree of ``suite.yaml``."""

    path: Path
    suite: Mapping[str, Any]
    reference: Reference
    rows: tuple[Row, ...]


def load_results(path: str | Path) -> Results:
    """Read a results folder, also where its sweep is unfinished.

    Raises :class:`RunError` where ``path`` is no results folder, or none of its tasks is done.
    """
    path = Path(path)
    if not (path / SUITE_FILE).is_file():
        raise RunError(f"{path} holds no {SUITE_FILE}; give the folder that `vioframe bench SUITE --out` wrote")
    rows = tuple(row for own in read_rows(path).values() for row in own)
    if not rows:
        raise RunError(f"{path} holds no result yet; `vioframe bench` goes on where it was stopped")
    suite = read_tree(path / SUITE_FILE)
    return Results(path, suite, validate(Reference, suite.get("reference") or {}, str(path / SUITE_FILE)), rows)


def read_rows(path: Path) -> dict[str, list[Row]]:
    """The rows of a results folder by task; none where there is no table yet. Raises :class:`RunError` for damage."""
    file = path / TABLE_FILE
    tasks: dict[str, list[Row]] = {}
    try:
        for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else ():
            row = json.loads(line)
            tasks.setdefault(row["task"], []).append({**dict.fromkeys(TASK_COLUMNS), **row})
    except (ValueError, KeyError, TypeError) as error:
        raise RunError(f"{file} is damaged ({error}); delete the line that is, and run again") from error
    return tasks


def write_rows(path: Path, tasks: Mapping[str, Sequence[Row]]) -> None:
    """Write the table anew and as a whole, sorted by task, so that nobody ever reads the half of it."""
    every = (row for task in sorted(tasks) for row in tasks[task])
    write_whole(path / TABLE_FILE, "".join(f"{json.dumps(row)}\n" for row in every))


def task_count(suite: Mapping[str, Any]) -> int | None:
    """How many tasks a finished sweep of ``suite`` has; None where it does not say."""
    if (kind := suite.get("kind")) not in ("flights", "trials", "detector_speed"):
        return None
    if kind == "detector_speed":
        return 1
    detectors, backends, sequences = (len(suite.get(key) or ()) for key in ("detectors", "backends", "sequences"))
    levels = sum(len(each) for each in (suite.get("conditions") or {}).values()) + bool(suite.get("clear", True))
    grid = backends if kind == "trials" else backends * detectors * sequences * levels
    return int(suite.get("seeds", 1) * grid)
