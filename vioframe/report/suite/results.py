"""Reads the folder that ``vioframe bench SUITE`` leaves, also where the sweep is unfinished.

``RESULTS/suite.yaml`` is the suite as it was run, ``RESULTS/tasks/KEY/task.json`` what came of a task. The folder of a
flight holds the run folder ``run`` as well, as ``vioframe run`` writes it, with ``ground_truth_matched.tum`` beside
its trajectory: the true pose at every stamp that was estimated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from vioframe.errors import RunError
from vioframe.evaluation import TrajectoryErrors, evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory
from vioframe.parts.config import read_tree
from vioframe.runs.evaluated import MATCHED_TRUTH
from vioframe.runs.folder import RunFolder

SUITE_FILE, TASKS_FOLDER, TASK_FILE, RUN_FOLDER = "suite.yaml", "tasks", "task.json", "run"


class Kind(StrEnum):
    """What a task does."""

    FLIGHT = "flight"
    """A detector and a back-end on a recording."""
    DETECTOR_SPEED = "detector_speed"
    """Frames a second of all detectors: a row each in ``result["rows"]``."""
    TRIAL = "trial"
    """A back-end on simulated tracks, for its NEES."""


class Data(StrEnum):
    """What a flight was made on; figures of different kinds never go into one average."""

    REAL = "real"
    """Recorded images and IMU."""
    RENDERED = "rendered"
    """The recorded IMU; images rendered along the recorded motion."""
    SIMULATED = "simulated"
    """A simulated flight that stands in for the one asked for: motion, IMU and images."""


@dataclass(frozen=True, slots=True)
class Labels:
    """Where a task stands in its suite's grid. ``condition`` is ``clear`` at level 0."""

    sequence: str
    condition: str
    level: float
    detector: str
    backend: str
    seed: int


@dataclass(frozen=True)
class TaskResult:
    """What came of a task. ``error`` is one line where ``ok`` is not so; ``result`` are its figures.

    ``fingerprint`` tells the ``code``, ``config`` and ``data`` that it depends on from others.

    Of a flight: ``summary`` (as in ``summary.json``), ``evaluation`` and ``evaluation_loop``
    (:meth:`TrajectoryErrors.to_dict`, None where there is nothing to evaluate), ``metrics`` by name, ``stage_ms`` and
    ``real_time_factor`` (seconds of flight by seconds of computing).
    """

    folder: Path
    key: str
    kind: Kind
    labels: Labels | None
    data: Data | None
    data_note: str
    fingerprint: Mapping[str, str]
    ok: bool
    error: str
    attempts: int
    seconds: float
    machine: Mapping[str, Any]
    result: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Raises :class:`RunError` where ``folder`` holds no result."""
        try:
            tree = json.loads((folder / TASK_FILE).read_text(encoding="utf-8"))
            return cls(
                folder,
                tree["key"],
                Kind(tree["kind"]),
                None if tree["labels"] is None else Labels(**tree["labels"]),
                None if tree["data"] is None else Data(tree["data"]),
                tree["data_note"],
                tree["fingerprint"],
                tree["status"] == "ok",
                tree["error"] or "",
                tree["attempts"],
                tree["seconds"],
                tree["machine"],
                tree["result"],
            )
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunError(f"{folder} holds no readable {TASK_FILE} ({error}); delete it and run again") from error

    @property
    def run(self) -> RunFolder | None:
        """The run folder of a flight; None where it never began."""
        path = self.folder / RUN_FOLDER
        return RunFolder.open(path) if (path / "trajectory.tum").is_file() else None

    @property
    def loop_closed(self) -> bool:
        """Whether its figures are those of the trajectory that loop closure corrected."""
        return self.result.get("evaluation_loop") is not None

    @property
    def evaluation(self) -> Mapping[str, Any] | None:
        """The figures of the trajectory that the parts gave in the end: the loop-closed one where there is one."""
        found: Mapping[str, Any] | None = self.result.get("evaluation_loop") or self.result.get("evaluation")
        return found

    @cached_property
    def errors(self) -> TrajectoryErrors | None:
        """Errors over time, of the trajectory that ``evaluation`` is about; None where there is none."""
        if self.run is None or self.evaluation is None:
            return None
        estimate = self.run.loop_closed() if self.loop_closed else self.run.trajectory()
        truth = self.run.ground_truth()
        return None if estimate is None or truth is None else evaluate(estimate, truth)

    def matched_truth(self) -> Trajectory | None:
        """The true pose at every stamp of the estimate."""
        path = self.folder / RUN_FOLDER / MATCHED_TRUTH
        return load_trajectory(path) if path.is_file() else None


@dataclass(frozen=True)
class SuiteResults:
    """All that is in a results folder; ``suite`` is the tree of ``suite.yaml``."""

    path: Path
    suite: Mapping[str, Any]
    tasks: tuple[TaskResult, ...]

    def of(self, kind: Kind) -> list[TaskResult]:
        return [task for task in self.tasks if task.kind is kind]


def load_results(path: str | Path) -> SuiteResults:
    """Raises :class:`RunError` where ``path`` is not a results folder, or none of its tasks is done."""
    path = Path(path)
    if not (path / SUITE_FILE).is_file():
        raise RunError(f"{path} holds no {SUITE_FILE}; give the folder that `vioframe bench SUITE --out` wrote")
    # A name that begins with a dot is a task under way, or one that was killed.
    folders = sorted(each for each in (path / TASKS_FOLDER).glob("[!.]*") if each.is_dir())
    if not folders:
        raise RunError(f"{path} holds no result yet; `vioframe bench` goes on where it was stopped")
    return SuiteResults(path, read_tree(path / SUITE_FILE), tuple(TaskResult.read(folder) for folder in folders))
