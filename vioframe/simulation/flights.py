"""Flights known exactly: pose, velocity, acceleration and angular rate as functions of time.

A :class:`ShapedFlight` is two B-splines of degree five through time, for position and for yaw, pitch and roll, so that
accelerations and angular accelerations are smooth. The built-in flights are made of it, and anybody's may be.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vioframe.errors import ConfigError
from vioframe.interfaces import Flight
from vioframe.parts import registry
from vioframe.types import Float, Motion

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_DEGREE = 5

Shape = Callable[[Float], Float]
"""Times (N,) s, also a little before zero, to (N, 3)."""


def levelled(R_BC: Float) -> Float:
    """R_LB (3, 3): the body's attitude in the frame L (x ahead, y left, z up) of a camera that looks level ahead."""
    # Camera axes are right, down, ahead.
    R_LC = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return np.asarray(R_LC @ R_BC.T)


@dataclass(frozen=True)
class ShapedFlight:
    """A shape flown by a body whose camera looks ahead, level where pitch and roll are zero.

    ``position`` maps times (N,) s to (N, 3) m and ``attitude`` to (N, 3) yaw, pitch, roll rad. They give the splines'
    control points, one every ``control_interval_s``; what they do between those is smoothed away. ``R_LB`` (3, 3) is
    the body's fixed attitude in the levelled frame, see :func:`levelled`. Raises :class:`ConfigError` for a
    duration that is not positive.
    """

    duration_s: float
    position: Shape
    attitude: Shape
    R_LB: Float
    control_interval_s: float = 0.25

    def __post_init__(self) -> None:
        if not 0.0 < self.duration_s < np.inf:
            raise ConfigError(f"a flight must last longer than 0 s, not {self.duration_s:g}; choose another duration")

    @cached_property
    def _splines(self) -> list[tuple[BSpline, BSpline, BSpline]]:
        from scipy.interpolate import BSpline

        # Two spare intervals at either end keep every instant inside the knots.
        count = int(np.ceil(self.duration_s / self.control_interval_s)) + 2 * _DEGREE
        knots = (np.arange(count + _DEGREE + 1) - _DEGREE - 2) * self.control_interval_s
        # A control point acts where its basis function peaks (the Greville abscissa): straight lines stay as they are.
        centres = np.array([knots[i + 1 : i + 1 + _DEGREE].mean() for i in range(count)])
        curves = [BSpline(knots, shape(centres), _DEGREE) for shape in (self.position, self.attitude)]
        return [(curve, curve.derivative(1), curve.derivative(2)) for curve in curves]

    def at(self, t_s: Float) -> Motion:
        """The motion at times ``t_s`` (N,), 0 to ``duration_s``."""
        t_s = np.asarray(t_s, dtype=np.float64)
        position, attitude = self._splines
        angles, rates = attitude[0](t_s), attitude[1](t_s)
        R_WB = _from_euler(angles) @ self.R_LB
        omega_L = _euler_rates_to_omega(angles, rates)
        return Motion(R_WB, position[0](t_s), position[1](t_s), position[2](t_s), omega_L @ self.R_LB)


def flight(name: str, duration_s: float, R_BC: Float) -> Flight:
    """The installed flight ``name``, its options at their defaults, for a camera at ``R_BC`` (3, 3) in the body."""
    return registry.load().create_flight(name, duration_s, levelled(R_BC))


def _from_euler(angles: Float) -> Float:
    """R_WL = Rz(yaw) Ry(pitch) Rx(roll), (N, 3) -> (N, 3, 3)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles).T, np.sin(angles).T
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _euler_rates_to_omega(angles: Float, rates: Float) -> Float:
    """Angular rate (N, 3) in the levelled frame L from yaw, pitch, roll and their rates."""
    _, pitch, roll = angles.T
    d_yaw, d_pitch, d_roll = rates.T
    return np.column_stack(
        [
            d_roll - np.sin(pitch) * d_yaw,
            np.cos(roll) * d_pitch + np.cos(pitch) * np.sin(roll) * d_yaw,
            -np.sin(roll) * d_pitch + np.cos(pitch) * np.cos(roll) * d_yaw,
        ]
    )
