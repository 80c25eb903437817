"""Checks that a flight is one motion: that its velocities, accelerations and rates are the derivatives of its pose."""

from __future__ import annotations

from typing import Any

import numpy as np

from vioframe.arrays import Float
from vioframe.geometry import so3
from vioframe.interfaces import FlightFactory
from vioframe.testing.require import require
from vioframe.types import Motion

_DURATION_S = 12.0
_STEP_S = 1e-4
# Central differences over the step are off by its square times a third derivative: 1e-5 leaves room for 6000 m/s^5.
_TOLERANCE = 1e-5


def check_flight(factory: FlightFactory, **options: Any) -> None:
    """Check ``factory(duration_s, R_LB, **options)`` against :class:`vioframe.interfaces.Flight`.

    That it lasts as long as it is asked to, from exactly 0 to its end; shapes, rotations and finiteness; that every
    derivative is that of the pose; that asking at one time or at many gives the same; that ``R_LB`` is kept to.
    """
    flight = factory(_DURATION_S, np.eye(3), **options)
    require(flight.duration_s == _DURATION_S, f"asked for {_DURATION_S} s, it lasts {flight.duration_s} s")
    rng = np.random.default_rng(0)
    t_s = np.sort(np.concatenate([[0.0, _DURATION_S], rng.uniform(_STEP_S, _DURATION_S - _STEP_S, 200)]))
    here = flight.at(t_s)
    _check_shapes(here, len(t_s))
    inner = t_s[1:-1]
    before, at, after = (flight.at(inner + d) for d in (-_STEP_S, 0.0, _STEP_S))
    _check_derivative("v_WB", at.v_WB, after.p_WB - before.p_WB)
    _check_derivative("a_WB", at.a_WB, after.v_WB - before.v_WB)
    _check_derivative("omega_B", at.omega_B, so3.log(np.swapaxes(before.R_WB, 1, 2) @ after.R_WB))
    one = flight.at(t_s[7:8])
    require(np.allclose(one.p_WB[0], here.p_WB[7], atol=1e-12), "at() depends on how many times it is asked for")
    R_LB = so3.exp(np.array([0.3, -1.2, 0.7]))
    mounted = factory(_DURATION_S, R_LB, **options).at(t_s)
    require(
        np.allclose(mounted.R_WB, here.R_WB @ R_LB, atol=1e-9) and np.allclose(mounted.p_WB, here.p_WB, atol=1e-9),
        "R_WB must be R_WL @ R_LB, and the path the same however the body is mounted",
    )


def _check_shapes(motion: Motion, count: int) -> None:
    for name, shape in (("R_WB", (count, 3, 3)), *((n, (count, 3)) for n in ("p_WB", "v_WB", "a_WB", "omega_B"))):
        array = np.asarray(getattr(motion, name))
        require(array.shape == shape, f"{name} has the shape {array.shape}, expected {shape}")
        require(np.isfinite(array).all(), f"{name} is not finite everywhere from 0 to duration_s")
    gram = motion.R_WB @ np.swapaxes(motion.R_WB, 1, 2)
    require(
        np.abs(gram - np.eye(3)).max() < 1e-9 and (np.linalg.det(motion.R_WB) > 0.0).all(), "R_WB is not a rotation"
    )


def _check_derivative(name: str, given: Float, difference: Float) -> None:
    off = np.abs(given - difference / (2.0 * _STEP_S)).max()
    require(off < _TOLERANCE, f"{name} is off by {off:.2g} from the derivative by central differences")
