"""The trials of a suite as the Monte Carlo that they are, for its statistics and drawings."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.evaluation.consistency import PARTS, Trial, Trials
from vioframe.report.suite.captions import condition_text, task_path
from vioframe.report.suite.results import Kind, Labels, SuiteResults, TaskResult
from vioframe.report.suite.statistics import listed_names
from vioframe.types import NS_PER_S

_NOT_FIGURES = ("seed", "failure", "detail", "nees")


@dataclass(frozen=True)
class Campaign:
    """One back-end on one flight; ``links`` lead to the folders of its trials, by seed, relative to the results."""

    outcome: Trials
    links: tuple[tuple[str, str], ...]


def campaigns(results: SuiteResults) -> list[Campaign]:
    """In the order of the suite's back-ends; a task that failed is a trial that crashed."""
    members: dict[tuple[str, str], list[tuple[Trial, TaskResult]]] = defaultdict(list)
    for task in results.of(Kind.TRIAL):
        if task.labels is not None:
            trial = _trial(task, task.labels)
            members[trial.backend, trial.flight].append((trial, task))
    listed = listed_names(results.suite, "backends")
    in_order = sorted(
        members.items(), key=lambda item: listed.index(item[0][0]) if item[0][0] in listed else len(listed)
    )
    return [
        _campaign(backend, flight, sorted(own, key=lambda pair: pair[0].seed)) for (backend, flight), own in in_order
    ]


def outcomes(results: SuiteResults) -> list[Trials]:
    """The same without the links."""
    return [campaign.outcome for campaign in campaigns(results)]


def _campaign(backend: str, flight: str, own: Sequence[tuple[Trial, TaskResult]]) -> Campaign:
    outcome = Trials(backend, backend, {}, {"flight": flight}, tuple(trial for trial, _ in own))
    return Campaign(outcome, tuple((f"seed {trial.seed}", task_path(task)) for trial, task in own))


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
