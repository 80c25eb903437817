"""What the rows of a results table say together: counts, means and spreads over the seeds, with nothing dropped.

A flight that failed stays where it belongs and is counted; it only has no error to average. Figures of real, rendered
and simulated recordings never meet in one average. How the statistics are meant: ``docs/report.md``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from vioframe.evaluation import TrajectoryErrors
from vioframe.evaluation.consistency import AverageNees, average_nees
from vioframe.runs.evaluated import Evaluated, evaluate_paths
from vioframe.runs.results import CELL, CLEAR, NEES_FILE, TASK_COLUMNS, Data, Results
from vioframe.types import NS_PER_S

COMPLETE_FROM = 0.95
"""A flight is complete where at least this part of its frames is tracked, from initialisation on."""
BEGUN_BY = 0.5
"""... and it was initialised before this part of its time was over."""
SUCCESS_PERCENT = 5.0
"""A complete flight succeeded where its ATE is below this part of its path."""
CONFIDENCE = 0.95
ENOUGH_TO_DRAW_FROM = 5
"""Fewer worlds than this, drawn again and again, would tell too narrow an interval."""

COURSE = list(CELL[:4])
"""What contenders, a detector with a back-end, are compared on: data, sequence, condition, level."""
CONTENDER = list(CELL[4:])
COMPLETE, INCOMPLETE = "complete", "not complete"
"""Incomplete is what was begun late, lost for more than a twentieth of the frames, or cut short."""
NOT_EVALUATED, NEVER_INITIALISED, FAILED = "not evaluated", "never initialised", "failed"

_DRAWS = 10_000
_SAME_M = 1e-9
"""ATEs closer than this are of one and the same estimate."""
_ALWAYS = (
    *("ate_m", "ate_percent", "ate_se3_m", "scale", "orientation_deg", "yaw_deg", "completion", "resets", "start_s"),
    *("initialised_after_s", "flown_s", "finished", "loop_closed", "frame_ms", "real_time_factor", "not_evaluated"),
    *("last_event", "metrics_left_out", "failure"),
)
"""Columns that are there, if empty, in every table."""


@dataclass(frozen=True)
class Study:
    """The tables behind a report, each in the order of the suite's own lists, and what is looked up for them.

    ``flown_nees`` is the NEES over time by task of trials that were flown just now and have no files.
    """

    results: Results
    flown_nees: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    _evaluated: dict[str, Evaluated | None] = field(default_factory=dict)

    @cached_property
    def flights(self) -> pd.DataFrame:
        """A row a flight, with its ``outcome`` and the ``reason`` for it in a line, empty where nothing went wrong."""
        frame = self._rows("flight")
        # One that failed early does not say what it was made on; its siblings do.
        siblings = frame.groupby(["sequence", "condition"])["data"].transform("first")
        frame["data"] = frame["data"].fillna(siblings)
        judged = [_outcome(row) for row in records(frame)]
        frame["outcome"], frame["reason"] = zip(*judged, strict=True) if judged else ((), ())
        frame["evaluated"] = frame["outcome"].isin([COMPLETE, INCOMPLETE])
        frame["complete"] = frame["outcome"] == COMPLETE
        frame["succeeded"] = frame["complete"] & (frame["ate_percent"] < SUCCESS_PERCENT)
        return frame

    @cached_property
    def trials(self) -> pd.DataFrame:
        """A row a trial; a task that failed is one that crashed."""
        frame = self._rows("trial")
        frame["failure"] = frame["failure"].mask(frame["status"] == FAILED, "crashed")
        return frame

    @cached_property
    def speeds(self) -> pd.DataFrame:
        """A row a detector that was timed, the fastest first, and then those that were not."""
        frame = self._rows("speed").reindex(columns=["detector", "status", "error", "folder", *_SPEED])
        return frame[frame["status"] != FAILED].sort_values("fps", ascending=False, kind="stable")

    @property
    def is_stress(self) -> bool:
        """Whether anything was flown under a condition other than clear."""
        return bool((self.flights["condition"] != CLEAR).any())

    @cached_property
    def baseline(self) -> str | None:
        """The detector to compare the others with, which is the suite's first; None without others."""
        names = self.flights["detector"].unique()
        return str(names[0]) if len(names) > 1 else None

    def errors(self, flight: Mapping[str, Any]) -> TrajectoryErrors | None:
        """Errors over time of a flight; None where there are none."""
        run = self.evaluated(flight)
        return None if run is None else run.errors

    def evaluated(self, flight: Mapping[str, Any]) -> Evaluated | None:
        """A flight, with loop closure where it has that; None where there is no error to show."""
        name = flight["task"]
        if name not in self._evaluated:
            path = self.results.path / flight["folder"] if flight["evaluated"] else None
            found = evaluate_paths([path]) if path and (path / "trajectory.tum").is_file() else [None]
            self._evaluated[name] = found[-1 if flight["loop_closed"] is True else 0]
        return self._evaluated[name]

    def nees(self, own: pd.DataFrame) -> dict[str, AverageNees]:
        """NEES over time by part of the pose, averaged over trials; empty where no trial has a covariance."""
        return average_nees(self.single_nees(own))

    def single_nees(self, own: pd.DataFrame) -> list[pd.DataFrame]:
        """The same of every trial that has one: ``t_ns``, and a column a part."""
        if self.flown_nees:
            return [self.flown_nees[task] for task in own["task"]]
        files = [self.results.path / folder / NEES_FILE for folder in own["folder"].dropna()]
        return [pd.read_csv(file) for file in files if file.is_file()]

    def nees_table(self) -> pd.DataFrame:
        """A row an instant of each back-end's trials on each flight, with how many trials it is of."""
        tables = [pd.DataFrame()]
        for (flight, backend), own in groups(self.trials, ("sequence", "backend")):
            if found := self.nees(own):
                nees = found["pose"]
                about = {"backend": backend, "flight": flight, "t_s": nees.t_ns / NS_PER_S, "trials": nees.trials}
                for part, each in found.items():
                    about |= {part: each.values, f"{part}_low": each.low, f"{part}_high": each.high}
                tables.append(pd.DataFrame(about))
        return pd.concat(tables)

    def _rows(self, kind: str) -> pd.DataFrame:
        rows = [row for row in self.results.rows if row["kind"] == kind]
        frame = pd.DataFrame(rows)
        frame = frame.reindex(columns=list(dict.fromkeys([*TASK_COLUMNS, *frame.columns, *_ALWAYS])))
        frame = frame.astype(dict.fromkeys(("data", "folder", "failure", "loop_closed"), object))
        frame = frame.where(frame.notna(), None) if frame.empty else frame
        for column in ("folder", "failure"):
            frame[column] = frame[column].where(frame[column].notna(), None)
        places = pd.DataFrame({key: self._places(key, frame[key]) for key in (*CELL, "seed")}, index=frame.index)
        return frame.loc[places.sort_values([*places], kind="stable").index].reset_index(drop=True)

    def _places(self, key: str, values: pd.Series) -> pd.Series:
        """By which to sort: as the suite lists things, and what it does not list after that, in alphabetical order."""
        if key in ("level", "seed"):
            return values.fillna(-1).astype(float)
        listed = [CLEAR, *(data.value for data in Data), *listed_names(self.results.suite, f"{key.replace('_', '')}s")]
        every = dict.fromkeys([*listed, *sorted(values.dropna().unique())])
        return values.map({name: place for place, name in enumerate(every)}).fillna(len(every)).astype(int)


_SPEED = (
    *("fps", "fps_low", "fps_high", "ms", "keypoints", "calls", "on", "images", "image_count", "rounds"),
    *("width", "height", "max_points", "devices"),
)


def listed_names(suite: Mapping[str, Any], key: str) -> list[str]:
    """What the table calls the entries of one of the suite's lists."""
    entries = suite.get(key) or ()
    return [str(each.get("label") or each["name"]) if isinstance(each, Mapping) else str(each) for each in entries]


def _outcome(row: Mapping[str, Any]) -> tuple[str, str]:
    if row["status"] == FAILED:
        return FAILED, row["error"]
    begun_s = row["initialised_after_s"]
    if pd.isna(begun_s):
        return NEVER_INITIALISED, "; last: ".join(filter(None, (NEVER_INITIALISED, row["last_event"])))
    if pd.isna(row["ate_m"]):
        why = row["not_evaluated"]
        return NOT_EVALUATED, why if isinstance(why, str) else "there is no ground truth to compare with"
    if row["finished"] is False:
        return INCOMPLETE, "cut short"
    if begun_s > BEGUN_BY * row["flown_s"]:
        return INCOMPLETE, f"initialised only after {begun_s:.1f} s"
    if not row["completion"] >= COMPLETE_FROM:
        return INCOMPLETE, f"tracked {100 * row['completion']:.1f} % of its frames"
    return COMPLETE, ""


def records(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """A mapping by column for each row."""
    return [{str(column): value for column, value in row.items()} for row in frame.to_dict("records")]


def groups(frame: pd.DataFrame, by: Iterable[str] = CELL) -> Iterator[tuple[Any, pd.DataFrame]]:
    """Rows with equal keys together, in the order in which the keys come up; rows without some key are in none."""
    yield from frame.groupby(list(by), sort=False)


def seeds_text(own: pd.DataFrame) -> str:
    """``3``, or ``2 of 3; 1 failed``: how many of the flights an error was measured of, and why not of the rest."""
    missing = [
        f"{n} {outcome}" for outcome, n in own["outcome"].value_counts().sort_index().items() if outcome != COMPLETE
    ]
    evaluated = own["evaluated"].sum()
    return "; ".join([str(len(own)) if evaluated == len(own) else f"{evaluated} of {len(own)}", *missing])


def median_flight(own: pd.DataFrame) -> Mapping[str, Any] | None:
    """The one to draw for a group: that of the median ATE, of two in the middle the worse."""
    found = records(own[own["evaluated"]].sort_values("ate_m", kind="stable"))
    return found[len(found) // 2] if found else None


class Average(NamedTuple):
    """A contender over sequences of one data kind; ``means`` are its figures, a row a sequence.

    Those are the sequences on which every flight of every contender was complete, ``of`` counts all of them: an average
    over other sequences for each contender would compare their luck. ``flights`` are the contender's own of those.
    """

    data: str
    condition: str
    level: float
    detector: str
    backend: str
    means: pd.DataFrame
    of: int
    flights: pd.DataFrame


def averages(flights: pd.DataFrame) -> list[Average]:
    """One for each contender, data kind, condition and level that has more than one sequence."""
    out = []
    for shared, here in groups(flights, ("data", "condition", "level")):
        contenders = here.groupby(CONTENDER, sort=False).ngroups
        by_sequence = here.groupby("sequence", sort=False)
        whole = by_sequence["complete"].all() & (
            by_sequence.apply(lambda s: s.groupby(CONTENDER).ngroups) == contenders
        )
        common = whole.index[whole]
        for contender, own in groups(here, CONTENDER) if len(whole) > 1 else ():
            own = own[own["sequence"].isin(common)]
            means = own.groupby("sequence", sort=False)[["ate_m", "ate_se3_m", "orientation_deg"]].mean()
            out.append(Average._make((*shared, *contender, means, len(whole), own)))
    return out


def curves(flights: pd.DataFrame) -> pd.DataFrame:
    """How contenders hold up as a condition gets harder: a row a point, the flights without a degradation at level 0.

    ``ate_m`` is the geometric mean of the flights that have an ATE, with its 95 % confidence interval ``low`` to
    ``high``, whose spread is pooled over the levels of the curve, in the logarithm, where it is about the same; NaN
    where no level has two flights to tell a spread from. ``success`` is the part of all flights, failed ones included,
    that succeeded, within ``success_low`` to ``success_high`` (Wilson). ``flights`` are those of the point.
    """
    from scipy.stats import binomtest, t

    line = ["data", "sequence", *CONTENDER]
    clear = dict(groups(flights[flights["condition"] == CLEAR], line))
    rows = []
    for key, hard in groups(flights[flights["condition"] != CLEAR], [*line, "condition"]):
        curve = pd.concat([clear[key[:4]], hard]) if key[:4] in clear else hard
        log_ate = curve["ate_m"].astype(float).map(np.log).groupby(curve["level"])
        freedom = int((log_ate.count() - 1).clip(lower=0).sum())
        squares = float(((log_ate.count() - 1).clip(lower=0) * log_ate.var().fillna(0.0)).sum())
        scatter = t.ppf(0.5 + 0.5 * CONFIDENCE, freedom) * np.sqrt(squares / freedom) if freedom else np.nan
        for level, own in curve.groupby("level"):
            middle, n = log_ate.mean()[level], log_ate.count()[level]
            half = scatter / np.sqrt(n) if n else np.nan
            success = binomtest(int(own["succeeded"].sum()), len(own)).proportion_ci(CONFIDENCE, "wilson")
            rows.append(
                {**dict(zip([*line, "condition"], key, strict=True)), "level": level, "ate_m": np.exp(middle)}
                | {"low": np.exp(middle - half), "high": np.exp(middle + half), "success": own["succeeded"].mean()}
                | {"success_low": success.low, "success_high": success.high, "flights": own}
            )
    return pd.DataFrame(rows)


class Duel(NamedTuple):
    """A detector against the baseline, flight by flight: same recording, condition, level, back-end and seed.

    A complete flight wins against one that is not, an ATE against none, and otherwise the smaller one: whoever is lost
    early has little time to be wrong in. Equal ones are ``tied``. It is over all levels of ``condition``, or over all
    degraded flights where that is None. ``pairs`` has what is the baseline's in columns with the suffix ``_baseline``.
    """

    data: str
    condition: str | None
    detector: str
    backend: str
    pairs: pd.DataFrame

    @property
    def won(self) -> int:
        return int(self.pairs["won"].sum())

    @property
    def lost(self) -> int:
        return int(self.pairs["lost"].sum())

    @property
    def tied(self) -> int:
        return len(self.pairs) - self.won - self.lost

    @property
    def both(self) -> int:
        """How many pairs there are in which both flights are complete."""
        return int(self.pairs["log_ratio"].count())

    @property
    def ratio(self) -> float:
        """The geometric mean of the ATE over the baseline's, of those pairs."""
        return float(np.exp(self.pairs["log_ratio"].mean()))

    @property
    def interval(self) -> tuple[float, float]:
        """Of the ratio, at 95 %: by the bootstrap over what was flown, all pairs of a sequence and seed together.

        They have the world and the path in common. NaN where there are fewer than ``ENOUGH_TO_DRAW_FROM`` of those.
        """
        both = self.pairs.dropna(subset="log_ratio")
        together = both.groupby(["sequence", "seed"])["log_ratio"].agg(["sum", "count"]).to_numpy()
        if len(together) < ENOUGH_TO_DRAW_FROM:
            return np.nan, np.nan
        drawn = np.random.default_rng(0).integers(len(together), size=(_DRAWS, len(together)))
        sums, counts = together[drawn].sum(axis=1).T
        low, high = np.exp(np.quantile(sums / counts, [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE]))
        return float(low), float(high)

    @property
    def p_value(self) -> float:
        """Of the two-sided sign test."""
        from scipy.stats import binomtest

        return float(binomtest(self.won, self.won + self.lost).pvalue) if self.won + self.lost else 1.0


def duels(flights: pd.DataFrame, baseline: str) -> list[Duel]:
    """By condition and contender, then over all degraded flights; recordings of one data kind together."""
    theirs = flights["detector"] == baseline
    pairs = flights[~theirs].merge(flights[theirs], on=[*COURSE, "backend", "seed"], suffixes=("", "_baseline")).copy()
    standing, other = (2 * pairs[f"complete{s}"].astype(int) + pairs[f"evaluated{s}"] for s in ("", "_baseline"))
    gap_m = (pairs["ate_m_baseline"] - pairs["ate_m"]).astype(float)
    pairs["won"] = (standing > other) | ((standing == other) & (gap_m > _SAME_M))
    pairs["lost"] = (standing < other) | ((standing == other) & (gap_m < -_SAME_M))
    # Of flights that were lost at different times, neither ATE is the other's measure.
    both = pairs["complete"] & pairs["complete_baseline"]
    pairs["log_ratio"] = np.log((pairs["ate_m"] / pairs["ate_m_baseline"]).where(both).astype(float))
    hard = groups(pairs[pairs["condition"] != CLEAR], ("data", *CONTENDER))
    return [
        *(Duel._make((*key, own)) for key, own in groups(pairs, ("data", "condition", *CONTENDER))),
        *(Duel._make((data, None, *contender, own)) for (data, *contender), own in hard),
    ]


def holm(p_values: Iterable[float]) -> list[float]:
    """Those of several tests at once, so that not one in twenty *suites* finds what is not there (Holm, 1979)."""
    p = np.array([*p_values])
    order = np.argsort(p)
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(np.minimum(p[order] * np.arange(len(p), 0, -1), 1.0))
    return [float(each) for each in adjusted]


def stage_means(flights: pd.DataFrame) -> pd.DataFrame:
    """Mean milliseconds a frame by stage, a column each, over the timed ``flights`` of each data kind and contender."""
    stages = [column for column in flights.columns if column.startswith("stage_ms.")]
    # A stage that did not take place in a flight took 0 there.
    means = timed(flights).fillna(dict.fromkeys(stages, 0.0)).groupby(["data", *CONTENDER], sort=False)[stages].mean()
    means = means.loc[:, (means > 0.0).any()] if len(means) else means
    return means.rename(columns=lambda column: str(column).removeprefix("stage_ms."))


def timed(flights: pd.DataFrame) -> pd.DataFrame:
    """Those whose times are those of whole estimating."""
    return flights[flights["frame_ms"].notna() & flights["initialised_after_s"].notna()]


# What is said of the data -------------------------------------------------------------------------------------------

WHAT = {
    Data.REAL: "real images and IMU",
    Data.RENDERED: "rendered images with the real IMU",
    Data.SIMULATED: "a simulated stand-in flight: images, IMU and motion",
}
_SPELT_OUT = 2
"""More notes than this, of as many recordings, would be longer than the table."""


def data_caption(flights: pd.DataFrame) -> str:
    """Which sequences are of which kind of data, and what is known about them, in sentences."""
    placed = flights[flights["data"].notna()]
    notes = (
        placed.sort_values("data_note", ascending=False).groupby(["data", "sequence"], sort=False)["data_note"].first()
    )
    spell_out = len(notes) <= _SPELT_OUT and bool(notes.fillna("").all())
    parts = []
    for data in (each for each in Data if each in set(placed["data"])):
        own = placed[placed["data"] == data]["sequence"].unique()
        told = "; ".join(str(notes[data, name]).rstrip(".") for name in own)
        parts.append(f"Data ({data}): {told if spell_out else ', '.join(own) + ': ' + WHAT[data]}.")
    return " ".join(parts)


def count_caption(flights: pd.DataFrame) -> str:
    """How many flights there are in all, and how many of them have no error to show."""
    missing = len(flights) - flights["evaluated"].sum()
    flown = f"{len(flights)} flight{'s' if len(flights) != 1 else ''}"
    return (
        f"{flown}; {missing} without an error to show." if missing else f"{flown}, all of them with an error to show."
    )


def machines(rows: pd.DataFrame) -> str:
    """On what it was computed, in a sentence."""
    names = dict.fromkeys(
        f"{m.get('cpu', 'an unknown processor')} ({m.get('cpu_count', '?')} cores)" for m in rows["machine"]
    )
    return f"Measured on {' and on '.join(names)}."


def condition_text(condition: str, level: float) -> str:
    return condition if not level else f"{condition} {level:g}"
