"""What many trials say together: errors, failures, and whether the covariance is as large as the errors are.

Statistics of the NEES after Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 5.4. How to read them: ``docs/montecarlo.md``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vioframe.evaluation.nees import band
from vioframe.types import Float, Int

PARTS: Mapping[str, int] = {"orientation": 3, "position": 3, "pose": 6}
"""Parts of the pose and their degrees of freedom, which is what their NEES should be on average."""

FAILURES = ("never initialised", "diverged", "crashed")


@dataclass(frozen=True, eq=False)
class Trial:
    """One flight of one back-end. ``failure`` is one of :data:`FAILURES` or None, ``detail`` a line about it.

    ``figures`` are empty where there is no estimate at all. ``nees`` (N,) is by part of the pose, at ``t_ns`` (N,)
    since the first frame.
    """

    seed: int
    flight: str
    backend: str
    failure: str | None
    detail: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)
    t_ns: Int = field(default_factory=lambda: np.empty(0, np.int64))
    nees: Mapping[str, Float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        means = {part: float(values.mean()) for part, values in self.nees.items() if len(values)}
        about = {"seed": self.seed, "failure": self.failure, "detail": self.detail}
        return about | dict(self.figures) | {"nees": means}


@dataclass(frozen=True, eq=False)
class AverageNees:
    """NEES averaged over trials at each instant: ``values`` (T,) of ``trials`` (T,) at ``t_ns`` (T,).

    ``low`` and ``high`` (T,) bound the 95 % in which the average of that many honest filters lies. ``mean`` is the
    average over trials of each one's mean over time, and ``mean_band`` the bounds for a single instant: errors within a
    flight hang together, so a whole flight counts as little more than one sample, and the mean as at least that good.
    """

    part: str
    dof: int
    t_ns: Int
    trials: Int
    values: Float
    low: Float
    high: Float
    mean: float
    mean_band: tuple[float, float]

    @property
    def per_axis(self) -> float:
        """The mean over its ideal value: above 1 the filter is too sure of itself, below 1 not sure enough."""
        return self.mean / self.dof

    @property
    def verdict(self) -> str:
        low, high = self.mean_band
        return "overconfident" if self.mean > high else "pessimistic" if self.mean < low else "consistent"

    @property
    def inside(self) -> float:
        """Part of the instants at which the average lies within its bounds, 0.95 on average for an honest filter."""
        return float(np.mean((self.low <= self.values) & (self.values <= self.high)))

    def to_dict(self) -> dict[str, Any]:
        return {
            "dof": self.dof,
            "mean": self.mean,
            "per_axis": self.per_axis,
            "band_95": list(self.mean_band),
            "verdict": self.verdict,
            "instants_inside_95": self.inside,
        }


@dataclass(frozen=True, eq=False)
class Trials:
    """All trials of one back-end, ``name`` with its ``options``, on one ``setup``, in the order of their seeds."""

    name: str
    backend: str
    options: Mapping[str, Any]
    setup: Mapping[str, Any]
    trials: tuple[Trial, ...]

    @property
    def flight(self) -> str:
        return str(self.setup["flight"])

    @property
    def failures(self) -> dict[str, int]:
        """Trials by kind of failure, all kinds listed."""
        counts = Counter(trial.failure for trial in self.trials)
        return {kind: counts[kind] for kind in FAILURES}

    def values(self, key: str) -> Float:
        """The figure ``key`` of every trial that has it: those that diverged too, not those without an estimate."""
        found = [trial.figures.get(key) for trial in self.trials]
        return np.array([value for value in found if value is not None], dtype=np.float64)

    def rms(self, key: str) -> float | None:
        """Root mean square of a figure over the trials."""
        values = self.values(key)
        return float(np.sqrt(np.mean(values**2))) if len(values) else None

    def mean(self, key: str) -> float | None:
        values = self.values(key)
        return float(values.mean()) if len(values) else None

    def total(self, key: str) -> int:
        return int(self.values(key).sum())

    def nees(self, part: str) -> AverageNees | None:
        """The average NEES of ``part``, or None where no trial has a covariance."""
        having = [(trial.t_ns, trial.nees[part]) for trial in self.trials if len(trial.t_ns)]
        if not having:
            return None
        t_ns, index = np.unique(np.concatenate([t for t, _ in having]), return_inverse=True)
        trials = np.bincount(index)
        values = np.bincount(index, np.concatenate([v for _, v in having])) / trials
        bands = {n: average_band(PARTS[part], n) for n in np.unique(trials).tolist()}
        low, high = np.array([bands[n] for n in trials.tolist()]).T
        mean = float(np.mean([v.mean() for _, v in having]))
        return AverageNees(
            part, PARTS[part], t_ns, trials, values, low, high, mean, average_band(PARTS[part], len(having))
        )

    def to_dict(self) -> dict[str, Any]:
        """Everything but the time series, ready for JSON; the time that trials took is ``cpu_ms`` and nothing else."""
        average = {part: self.nees(part) for part in PARTS}
        return {
            "name": self.name,
            "backend": self.backend,
            "options": dict(self.options),
            "setup": dict(self.setup),
            "trials": len(self.trials),
            "failures": self.failures,
            "completion": self.mean("completion"),
            "resets": self.total("resets"),
            "ate_m": self.rms("ate_m"),
            "percent": self.rms("percent"),
            "orientation_deg": self.rms("orientation_deg"),
            "initialised_s": self.mean("initialised_s"),
            "cpu_ms": self.mean("cpu_ms"),
            "nees": {part: found.to_dict() for part, found in average.items() if found},
            "by_seed": [trial.to_dict() for trial in self.trials],
        }

    def notes(self) -> Iterator[str]:
        """One line for each thing that a reader of the figures should know."""
        where = f"{self.name} on {self.flight}"
        for trial in self.trials:
            if trial.failure or trial.detail:
                what = f"{trial.failure or 'started again'}: {trial.detail or 'no reason given'}"
                yield f"{where}, seed {trial.seed} {what}"
        judged = self.values("judged")
        if len(judged) and judged.max() == 0.0:
            yield f"{where}: states no covariance, so there is no NEES"
        elif len(judged) and judged.min() < 0.95:
            yield f"{where}: at up to {1.0 - judged.min():.0%} of a trial's instants there is no covariance to judge"


def average_band(dof: int, trials: int) -> tuple[float, float]:
    """The two-sided 95 % interval of the mean of ``trials`` independent chi-squared values of ``dof`` each."""
    low, high = band(dof * trials)
    return low / trials, high / trials
