"""What many trials say together: errors, failures, and whether the covariance is as large as the errors are.

Statistics of the NEES after Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, section 5.4. How to read them: ``docs/montecarlo.md``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vioframe.evaluation.nees import band
from vioframe.types import Float, Int

if TYPE_CHECKING:
    import pandas as pd

PARTS: Mapping[str, int] = {"orientation": 3, "position": 3, "pose": 6}
"""Parts of the pose and their degrees of freedom, which is what their NEES should be on average."""

FAILURES = ("never initialised", "diverged", "crashed")
_RMS = ("ate_m", "percent", "orientation_deg")
_MEANS = ("completion", "initialised_s", "cpu_ms")


@dataclass(frozen=True, eq=False)
class Trial:
    """One flight of one back-end. ``failure`` is one of :data:`FAILURES` or None, ``detail`` a line about it.

    ``figures`` are empty where there is no estimate at all. ``nees`` (N,) is by part of the pose, at ``t_ns`` (N,)
    since the first frame.
    """

    seed: int
    failure: str | None
    detail: str = ""
    figures: Mapping[str, Any] = field(default_factory=dict)
    t_ns: Int = field(default_factory=lambda: np.empty(0, np.int64))
    nees: Mapping[str, Float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """What a table has of it: the NEES, by part, as means over time."""
        means = {f"nees.{part}": float(values.mean()) for part, values in self.nees.items() if len(values)}
        return {"seed": self.seed, "failure": self.failure, "detail": self.detail, **self.figures, **means}

    def nees_over_time(self) -> pd.DataFrame:
        """A row an instant; none where there is no covariance."""
        import pandas as pd

        return pd.DataFrame({"t_ns": self.t_ns, **self.nees})


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


def average_nees(trials: Sequence[pd.DataFrame]) -> dict[str, AverageNees]:
    """By part of the pose, of the NEES over time of several trials; empty where none has a covariance."""
    import pandas as pd

    having = [trial for trial in trials if len(trial)]
    if not having:
        return {}
    at = pd.concat(having).groupby("t_ns")
    counts, t_ns = np.array(at.size(), np.int64), np.array(at.size().index, np.int64)
    found = {}
    for part, dof in PARTS.items():
        bands = {n: average_band(dof, n) for n in np.unique(counts).tolist()}
        low, high = np.array([bands[n] for n in counts.tolist()]).T
        mean = float(np.mean([trial[part].mean() for trial in having]))
        values = at[part].mean().to_numpy()
        found[part] = AverageNees(part, dof, t_ns, counts, values, low, high, mean, average_band(dof, len(having)))
    return found


def over_trials(trials: pd.DataFrame) -> dict[str, Any]:
    """What trials amount to, a row each as :meth:`Trial.to_dict` has it: root mean squares of errors, means of others.

    Trials that diverged are in it, those without an estimate only among the ``failures``; None is not known.
    """
    figures = trials.reindex(columns=[*_RMS, *_MEANS, "resets"]).astype(float)
    values = {**((figures[[*_RMS]] ** 2).mean() ** 0.5).to_dict(), **figures[[*_MEANS]].mean().to_dict()}
    return {
        "trials": len(trials),
        "failures": {kind: int((trials["failure"] == kind).sum()) for kind in FAILURES},
        "resets": int(figures["resets"].sum()),
        **{str(key): None if np.isnan(value) else value for key, value in values.items()},
    }


def notes(trials: pd.DataFrame) -> Iterator[str]:
    """One line for each thing that a reader of trials, of one ``backend`` on one ``sequence``, should know."""
    where = f"{trials['backend'].iloc[0]} on {trials['sequence'].iloc[0]}"
    for seed, failure, detail in trials[["seed", "failure", "detail"]].itertuples(index=False):
        if failure or detail:
            yield f"{where}, seed {seed} {failure or 'started again'}: {detail or 'no reason given'}"
    judged = trials.reindex(columns=["judged"])["judged"].astype(float)
    if judged.max() == 0.0:
        yield f"{where}: states no covariance, so there is no NEES"
    elif judged.min() < 0.95:
        yield f"{where}: at up to {1.0 - judged.min():.0%} of a trial's instants there is no covariance to judge"


def average_band(dof: int, trials: int) -> tuple[float, float]:
    """The two-sided 95 % interval of the mean of ``trials`` independent chi-squared values of ``dof`` each."""
    low, high = band(dof * trials)
    return low / trials, high / trials
