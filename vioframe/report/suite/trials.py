"""The trials of a suite as the Monte Carlo that they are, for its statistics and drawings."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from vioframe.bench.consistency import PARTS, Outcome, Trial
from vioframe.report.suite.captions import condition_text
from vioframe.report.suite.results import Kind, Labels, SuiteResults, TaskResult
from vioframe.types import NS_PER_S

_NOT_FIGURES = ("seed", "failure", "detail", "nees")


def outcomes(results: SuiteResults) -> list[Outcome]:
    """One for each back-end on each flight; a task that failed is a trial that crashed."""
    members: dict[tuple[str, str], list[Trial]] = defaultdict(list)
    for task in results.of(Kind.TRIAL):
        if task.labels is not None:
            trial = _trial(task, task.labels)
            members[trial.backend, trial.flight].append(trial)
    return [
        Outcome(backend, backend, {}, {"flight": flight}, tuple(sorted(trials, key=lambda trial: trial.seed)))
        for (backend, flight), trials in members.items()
    ]


def _trial(task: TaskResult, labels: Labels) -> Trial:
    flight = labels.sequence
    if labels.condition != "clear":
        flight = f"{flight}, {condition_text(labels.condition, labels.level)}"
    if not task.ok:
        return Trial(labels.seed, flight, labels.backend, "crashed", task.error)
    trial = task.result["trial"]
    return Trial(
        labels.seed,
        flight,
        labels.backend,
        trial["failure"],
        trial["detail"],
        {key: value for key, value in trial.items() if key not in _NOT_FIGURES},
        np.rint(np.asarray(task.result["t_s"], dtype=np.float64) * NS_PER_S).astype(np.int64),
        {part: np.asarray(task.result["nees"].get(part, ()), dtype=np.float64) for part in PARTS},
    )
