"""What needs a flight's errors over time: the +-20 cm band, the ATE by Sim(3), and relative errors over the seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.evaluation import RelativeErrors, TrajectoryErrors
from vioframe.evaluation.alignment import align_sim3
from vioframe.evaluation.metrics import position_error_W
from vioframe.report.suite.flights import Flight
from vioframe.report.suite.statistics import Group
from vioframe.types import Float

BAND_M = 0.2
"""The thesis' claim for Figure 3.10: the errors of y and of the altitude stay within this."""
_AS_METRIC = ("band", f"band:half_width_m={BAND_M:g}")


@dataclass(frozen=True)
class Stretches:
    """Relative errors over stretches of one length, of all flights of a group: (M,) each."""

    translation_percent: Float
    yaw_deg: Float
    rotation_deg: Float


@dataclass(frozen=True)
class RelativePool:
    """By length in metres, or ``of_path`` by fraction of the path; of ``flights`` flights."""

    group: Group
    of_path: bool
    stretches: Mapping[float, Stretches]
    flights: int


def pool_relative(found: Sequence[Group]) -> list[RelativePool]:
    """One for each group that has errors: by length where any flight's path is long enough, else by fraction."""
    errors = {id(group): [e for f in group.flights if (e := f.task.errors)] for group in found}
    by_length = any(each.relative for own in errors.values() for each in own)
    out = []
    for group in found:
        own = [each.relative if by_length else each.relative_by_fraction for each in errors[id(group)]]
        lengths = sorted(set().union(*own))
        stretches = {length: _pool([each[length] for each in own if length in each]) for length in lengths}
        if stretches:
            out.append(RelativePool(group, not by_length, stretches, len(own)))
    return out


def inside_band(flight: Flight) -> dict[str, float]:
    """Percent of the instants at which |x|, |y|, |z| and all three are within :data:`BAND_M`; empty without errors.

    As the metric ``band`` has it where the suite asked for that one.
    """
    metrics = flight.task.result.get("metrics") or {}
    if (measured := next((metrics[name] for name in _AS_METRIC if name in metrics), None)) is not None:
        return {key: float(measured[f"inside_{key}_percent"]) for key in ("x", "y", "z", "all")}
    return {} if flight.task.errors is None else inside(flight.task.errors)


def inside(errors: TrajectoryErrors) -> dict[str, float]:
    """The same, of errors."""
    within = np.abs(errors.position_m) <= BAND_M
    percent = dict(zip("xyz", (100.0 * within.mean(axis=0)).tolist(), strict=True))
    return {**percent, "all": 100.0 * float(within.all(axis=1).mean())}


def ate_sim3_m(flight: Flight) -> float | None:
    """RMSE of the position after alignment by Sim(3), as many published figures have it; None where it is open."""
    errors = flight.task.errors
    if errors is None or errors.scale is None:
        return None
    # Whatever the estimate was aligned by before, the best of all similarities leaves the same.
    scaled = align_sim3(errors.estimate, errors.truth).apply(errors.estimate)
    return float(np.sqrt(np.mean(np.sum(position_error_W(scaled, errors.truth) ** 2, axis=1))))


def _pool(same_length: Sequence[RelativeErrors]) -> Stretches:
    return Stretches(
        np.concatenate([each.translation_percent for each in same_length]),
        np.concatenate([each.yaw_deg for each in same_length]),
        np.concatenate([each.rotation_deg for each in same_length]),
    )
