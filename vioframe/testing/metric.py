"""Checks a metric on made-up estimates of a flight."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.evaluation import Alignment, Comparison
from vioframe.geometry import so3
from vioframe.geometry.so3 import rotation_z
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Metric, MetricFactory
from vioframe.testing.require import fail, require
from vioframe.types import NS_PER_S, Float

_POSES, _DURATION_S = 600, 60.0
_SIGMA_RAD, _SIGMA_M = 0.01, 0.05
_GAUGE_TOLERANCE = 1e-6
# A world that is turned about gravity and shifted.
_ELSEWHERE = Alignment(rotation_z(1.9), np.array([30.0, -7.0, 4.0]))


def check_metric(factory: MetricFactory, **options: Any) -> None:
    """Check ``factory(**options)`` against :class:`vioframe.interfaces.Metric`.

    That a flight of 100 m gives finite figures by name, the same when asked again and whatever the position and heading
    that the estimate started with; that its input is left alone; and that an estimate without error or covariance, a
    body at rest, a straight path and a single pose give figures, or a TrajectoryError of one line.
    """
    metric = factory(**options)
    truth = _flight()
    estimate = _disturbed(truth, with_cov=True)
    comparison = Comparison.of(estimate, truth)
    position_m = comparison.errors.position_m.copy()
    figures = _measure(metric, comparison, "a flight of 100 m")
    if not figures:
        fail("a flight of 100 m with covariance gave no figure")
    require(np.array_equal(comparison.errors.position_m, position_m), "measure() changed the errors it was given")
    require(_measure(metric, comparison, "a flight of 100 m") == figures, "the same flight gave other figures later")
    elsewhere = _measure(metric, Comparison.of(_ELSEWHERE.apply(estimate), truth), "a flight of 100 m from elsewhere")
    require(
        elsewhere is not None
        and figures.keys() == elsewhere.keys()
        and all(math.isclose(v, elsewhere[k], rel_tol=_GAUGE_TOLERANCE, abs_tol=1e-6) for k, v in figures.items()),
        f"{figures} became {elsewhere} where the estimate starts elsewhere with another heading, which means nothing",
    )
    rest = Trajectory(truth.t_ns, np.tile(np.eye(3), (_POSES, 1, 1)), np.zeros((_POSES, 3)))
    ahead = Trajectory(truth.t_ns, rest.R_WB, np.outer(np.linspace(0.0, 60.0, _POSES), [1.0, 0.0, 0.0]))
    for of, estimated, name in (
        (truth, truth, "an estimate without error"),
        (truth, _disturbed(truth, with_cov=False), "an estimate without covariance"),
        (rest, _disturbed(rest, with_cov=True), "a body at rest"),
        (ahead, ahead, "a straight path"),
        (truth, estimate.select(slice(0, 1)), "a single pose"),
    ):
        _measure(metric, Comparison.of(estimated, of), name)


def _measure(metric: Metric, comparison: Comparison, name: str) -> dict[str, float] | None:
    """The figures; None where the metric cannot tell and says why."""
    try:
        figures = metric.measure(comparison)
    except TrajectoryError as error:
        require(len(str(error).splitlines()) == 1, f"the TrajectoryError on {name} is not one line: {str(error)!r}")
        return None
    except Exception as error:
        fail(f"measure() raised on {name}: {error!r}")
    require(isinstance(figures, Mapping), f"measure() returned a {type(figures).__name__}, not figures by name")
    for key, value in figures.items():
        require(isinstance(key, str) and key.strip(), f"a figure is called {key!r}, expected a name")
        require(isinstance(value, Real) and math.isfinite(value), f"{key} is {value!r} on {name}, no finite number")
    return dict(figures)


def _flight() -> Trajectory:
    """A loop of 100 m in 60 s, up and down and turning about all axes."""
    s = np.linspace(0.0, 2.0 * np.pi, _POSES)
    t_ns = (np.linspace(0.0, _DURATION_S, _POSES) * NS_PER_S).astype(np.int64)
    p_WB = np.column_stack([15.0 * np.cos(s), 15.0 * np.sin(s), 2.0 * np.sin(3.0 * s)])
    phi = np.column_stack([0.2 * np.sin(2.0 * s), 0.2 * np.cos(3.0 * s), s])
    return Trajectory(t_ns, so3.exp(phi), p_WB)


def _disturbed(truth: Trajectory, *, with_cov: bool) -> Trajectory:
    """``truth`` with white noise, and the covariance of it."""
    rng = np.random.default_rng(5)
    R_WB = truth.R_WB @ so3.exp(rng.normal(0.0, _SIGMA_RAD, (len(truth), 3)))
    cov: Float = np.diag([_SIGMA_RAD**2] * 3 + [_SIGMA_M**2] * 3)
    p_WB = truth.p_WB + rng.normal(0.0, _SIGMA_M, (len(truth), 3))
    return Trajectory(truth.t_ns, R_WB, p_WB, np.tile(cov, (len(truth), 1, 1)) if with_cov else None)
