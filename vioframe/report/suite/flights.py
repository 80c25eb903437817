"""A flight of a suite: how it ended, and all of its figures by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from vioframe.report.suite.results import TaskResult
from vioframe.types import NS_PER_S

COMPLETE_FROM = 0.95
"""A flight is complete where at least this part of its frames is tracked, from initialisation on."""
BEGUN_BY = 0.5
"""... and it was initialised before this part of its time was over."""
SUCCESS_PERCENT = 5.0
"""A complete flight succeeded where its ATE is below this part of its path."""


class Outcome(StrEnum):
    """How a flight ended; its text is what tables say."""

    COMPLETE = "complete"
    INCOMPLETE = "not complete"
    """Estimated, but begun late, lost for more than a twentieth of the frames, or cut short."""
    NOT_EVALUATED = "not evaluated"
    """Estimated, but there is no error to show: of too few poses, or without a ground truth."""
    NEVER_INITIALISED = "never initialised"
    FAILED = "failed"
    """Ended with an error, which the task keeps."""


@dataclass(frozen=True)
class Flight:
    """One task of kind flight. ``figures`` are its numbers by dotted name (:func:`figures_of`), those that it has."""

    task: TaskResult
    outcome: Outcome
    figures: Mapping[str, float]

    @classmethod
    def of(cls, task: TaskResult) -> Flight:
        figures = figures_of(task) if task.ok else {}
        return cls(task, _outcome(task, figures), figures)

    @property
    def seed(self) -> int:
        return self.task.labels.seed if self.task.labels else 0

    @property
    def evaluated(self) -> bool:
        return "ate_m" in self.figures

    @property
    def complete(self) -> bool:
        return self.outcome is Outcome.COMPLETE

    @property
    def succeeded(self) -> bool:
        """Complete, with an ATE below :data:`SUCCESS_PERCENT` of the path."""
        return self.complete and self.figures.get("ate_percent", np.inf) < SUCCESS_PERCENT

    @property
    def reason(self) -> str:
        """One line on what went wrong; empty where nothing did."""
        match self.outcome:
            case Outcome.FAILED:
                return self.task.error
            case Outcome.NEVER_INITIALISED:
                events = self.task.result.get("summary", {}).get("events", [])
                return f"never initialised; last: {events[-1]['event']}" if events else "never initialised"
            case Outcome.NOT_EVALUATED:
                return str(self.task.result.get("not_evaluated") or "there is no ground truth to compare with")
            case Outcome.INCOMPLETE if self.task.result["summary"].get("finished") is False:
                return "cut short"
            case Outcome.INCOMPLETE if _begun_late(self.task.result["summary"], self.figures):
                return f"initialised only after {self.figures['initialised_after_s']:.1f} s"
            case Outcome.INCOMPLETE:
                return f"tracked {100 * self.figures['completion']:.1f} % of its frames"
        return ""


def figures_of(task: TaskResult) -> dict[str, float]:
    """All numbers of a flight by dotted name; those that it does not have are left out.

    ``ate_m``, ``ate_percent`` (of the path), ``ate_se3_m``, ``scale``, ``orientation_deg``, ``yaw_deg``,
    ``path_length_m``, ``coverage``, ``completion``, ``resets``, ``start_s``, ``initialised_after_s``, ``frames``,
    ``frame_ms``, ``real_time_factor``, ``stage_ms.STAGE``, ``nees.PART`` (mean), ``relative.8m.translation_percent``
    (mean) and the like, ``metrics.METRIC.FIGURE``.
    """
    result = task.result
    summary, evaluation = result.get("summary") or {}, task.evaluation or {}
    named: dict[str, Any] = {key: summary.get(key) for key in _SUMMARY}
    named |= {key: evaluation.get(key) for key in ("ate_se3_m", "scale", "path_length_m", "coverage")}
    named |= {key: evaluation.get(key, {}).get("rmse") for key in ("ate_m", "orientation_deg", "yaw_deg")}
    if evaluation and evaluation["path_length_m"] > 0.0:
        named["ate_percent"] = 100.0 * evaluation["ate_m"]["rmse"] / evaluation["path_length_m"]
    named["frame_ms"] = summary.get("mean_frame_ms")
    named["real_time_factor"] = result.get("real_time_factor", summary.get("real_time_factor"))
    named |= {f"stage_ms.{stage}": ms for stage, ms in (result.get("stage_ms") or {}).items()}
    named |= {f"nees.{part}": nees["mean"] for part, nees in evaluation.get("nees", {}).items()}
    for stretch, errors in evaluation.get("relative", {}).items():
        for figure in ("translation_percent", "yaw_deg"):
            named[f"relative.{stretch}.{figure}"] = errors[figure]["mean"]
    for metric, values in (result.get("metrics") or {}).items():
        named |= {f"metrics.{metric}.{figure}": value for figure, value in values.items()}
    return {name: float(value) for name, value in named.items() if _is_number(value)}


_SUMMARY = ("completion", "resets", "start_s", "initialised_after_s", "frames")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))


def _outcome(task: TaskResult, figures: Mapping[str, float]) -> Outcome:
    summary = task.result.get("summary") or {}
    if not task.ok:
        return Outcome.FAILED
    if "initialised_after_s" not in figures:
        return Outcome.NEVER_INITIALISED
    if "ate_m" not in figures:
        return Outcome.NOT_EVALUATED
    done = summary.get("finished", True) and figures.get("completion", 0.0) >= COMPLETE_FROM
    return Outcome.COMPLETE if done and not _begun_late(summary, figures) else Outcome.INCOMPLETE


def _begun_late(summary: Mapping[str, Any], figures: Mapping[str, float]) -> bool:
    if not {"first_frame_t_ns", "last_frame_t_ns"} <= summary.keys():
        return False
    flown_s = (summary["last_frame_t_ns"] - summary["first_frame_t_ns"]) / NS_PER_S
    return bool(figures["initialised_after_s"] > BEGUN_BY * flown_s)
