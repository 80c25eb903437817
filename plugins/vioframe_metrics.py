"""The built-in metrics: a choice of figures each, by :mod:`vioframe.evaluation`. Their meaning: ``docs/metrics.md``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field

from vioframe.errors import TrajectoryError
from vioframe.evaluation.evaluation import LENGTHS_M
from vioframe.evaluation.metrics import Stats, relative_errors
from vioframe.parts.hooks import hookimpl

if TYPE_CHECKING:
    from vioframe.evaluation import Comparison
    from vioframe.interfaces import MetricFactory


def _all_positive(lengths_m: tuple[float, ...]) -> tuple[float, ...]:
    if not all(length > 0.0 for length in lengths_m):
        raise ValueError("a length must be greater than 0")
    return lengths_m


class AbsoluteError:
    """Absolute trajectory error, RMSE: aligned by position and yaw, by SE(3), by Sim(3) with its scale."""

    def measure(self, comparison: Comparison) -> dict[str, float]:
        """The last three only where the path has the extent that their alignments need."""
        errors = comparison.errors
        figures = {"ate_m": errors.ate_m.rmse}
        others = {"ate_se3_m": errors.ate_se3_m, "ate_sim3_m": errors.ate_sim3_m, "scale": errors.scale}
        return figures | {name: value for name, value in others.items() if value is not None}


class RelativeError:
    """Drift over stretches of the path, mean: translation in percent of the way, yaw, rotation."""

    def __init__(
        self,
        *,
        lengths_m: Annotated[
            tuple[float, ...],
            Field(min_length=1, description="of the stretches, along the true path"),
            AfterValidator(_all_positive),
        ] = LENGTHS_M,
    ) -> None:
        self._lengths_m = lengths_m

    def measure(self, comparison: Comparison) -> dict[str, float]:
        """Three figures for each length that fits into the path."""
        errors = comparison.errors
        if errors.at_rest:
            raise TrajectoryError("the body is at rest, so that there is no path to measure drift along")
        found = relative_errors(errors.estimate, errors.truth, {length: length for length in self._lengths_m})
        if not found:
            raise TrajectoryError(
                f"no stretch of {min(self._lengths_m):g} m fits into the path of {errors.truth.path_length_m:.2f} m; "
                "ask for shorter ones: --metric relative:lengths_m=[1,2]"
            )
        return {
            f"{what}_{length:g}m_{unit}": Stats.of(values).mean
            for length, over in found.items()
            for what, unit, values in (
                ("translation", "percent", over.translation_percent),
                ("yaw", "deg", over.yaw_deg),
                ("rotation", "deg", over.rotation_deg),
            )
        }


class Band:
    """How much of the time the position error is inside a band about zero: along x, y, z, and along all at once."""

    def __init__(
        self,
        *,
        half_width_m: Annotated[
            float, Field(gt=0.0, allow_inf_nan=False, description="largest error that is inside, m")
        ] = 0.2,
    ) -> None:
        self._half_width_m = half_width_m

    def measure(self, comparison: Comparison) -> dict[str, float]:
        """Of the instants that were estimated; aligned by position and yaw, along the axes of the truth's world."""
        inside = comparison.errors.inside_band(self._half_width_m)
        return {f"inside_{axis}_percent": percent for axis, percent in inside.items()}


class Consistency:
    """NEES of orientation (3 degrees of freedom), position (3) and pose (6): mean, and inside the 95 % interval."""

    def measure(self, comparison: Comparison) -> dict[str, float]:
        """In the gauge of the first pose; the mean is the number of degrees of freedom where the filter is honest."""
        if not comparison.errors.nees:
            raise TrajectoryError(
                "the estimate brings no usable covariance; a run has one where its back-end gives it (states.csv)"
            )
        return {
            f"{nees.part}_{name}": value
            for nees in comparison.errors.nees
            for name, value in (("nees_mean", nees.mean), ("inside_95_percent", 100.0 * nees.inside))
        }


@hookimpl
def vioframe_metrics() -> Mapping[str, MetricFactory]:
    return {"ate": AbsoluteError, "relative": RelativeError, "band": Band, "nees": Consistency}
