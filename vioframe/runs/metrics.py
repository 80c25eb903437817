"""The metrics that were asked for, which are plug-ins, put to work on an estimate.

metrics = create_metrics(["ate", "band:half_width_m=0.1"], registry.load())
measured = measure(metrics, Comparison.of(estimate, ground_truth))
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Real
from typing import Any

from vioframe.errors import PluginError, TrajectoryError, VioframeError
from vioframe.evaluation import Comparison
from vioframe.interfaces import Metric
from vioframe.parts.config import parse_part
from vioframe.parts.registry import METRIC, Part, Registry, describe


@dataclass(frozen=True, slots=True)
class AskedMetric:
    """A metric ready for use; ``label`` is what it was asked for with, name and options."""

    label: str
    part: Part
    metric: Metric


@dataclass(frozen=True, slots=True)
class Measured:
    """``figures`` by metric and name; ``left_out`` says in a line why a metric has none. Both by label, as asked."""

    figures: Mapping[str, Mapping[str, float]]
    left_out: Mapping[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        out: dict[str, Any] = {"metrics": {label: dict(figures) for label, figures in self.figures.items()}}
        return {**out, "metrics_left_out": dict(self.left_out)} if self.left_out else out


def create_metrics(specs: Sequence[str], installed: Registry) -> tuple[AskedMetric, ...]:
    """A metric for each of ``specs``, ``NAME`` or ``NAME:KEY=VALUE,...``; a repeated one counts once.

    Raises :class:`PluginError` or :class:`ConfigError` where one is unknown, lacks what it needs or has a wrong option.
    """
    asked = []
    for spec in dict.fromkeys(specs):
        part = parse_part(spec, METRIC, installed)
        asked.append(
            AskedMetric(spec, installed.find(METRIC, part.name), installed.create_metric(part.name, part.options))
        )
    return tuple(asked)


def measure(metrics: Sequence[AskedMetric], comparison: Comparison) -> Measured:
    """What each of ``metrics`` says; one that cannot tell leaves the others alone.

    Raises :class:`PluginError` naming the plug-in where one fails or returns something else than finite figures.
    """
    figures: dict[str, Mapping[str, float]] = {}
    left_out: dict[str, str] = {}
    for asked in metrics:
        try:
            figures[asked.label] = _checked(asked.part, asked.metric.measure(comparison))
        except TrajectoryError as error:
            left_out[asked.label] = " ".join(str(error).split())
        except VioframeError:
            raise
        except Exception as error:
            raise PluginError(f"{asked.part} failed: {describe(error)}; leave it out or repair it") from error
    return Measured(figures, left_out)


def _checked(part: Part, figures: Any) -> dict[str, float]:
    if not isinstance(figures, Mapping):
        raise PluginError(f"{part} returned a {type(figures).__name__}, not figures by name")
    for name, value in figures.items():
        if not isinstance(name, str) or not isinstance(value, Real) or not math.isfinite(value):
            raise PluginError(f"{part} returned {name!r}: {value!r}; a figure is a finite number by name")
    return {name: float(value) for name, value in figures.items()}
