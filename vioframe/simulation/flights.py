"""Flights known exactly: pose, velocity, acceleration and angular rate as functions of time.

A flight is two B-splines of degree five through time, for position and for yaw, pitch and roll, so that accelerations
and angular accelerations are smooth. Their control points come from shapes of a few lines each, see ``FLIGHTS``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vioframe.errors import ConfigError
from vioframe.types import Float

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_DEGREE = 5
_CONTROL_INTERVAL_S = 0.25


@dataclass(frozen=True, slots=True)
class Motion:
    """Where a body is and how it moves at N instants.

    ``R_WB`` (N, 3, 3), ``p_WB`` (N, 3) m, ``v_WB`` (N, 3) m/s, ``a_WB`` (N, 3) m/s^2, ``omega_B`` (N, 3) rad/s.
    """

    R_WB: Float
    p_WB: Float
    v_WB: Float
    a_WB: Float
    omega_B: Float


@dataclass(frozen=True)
class Flight:
    """A shape flown by a body whose camera looks ahead, level where pitch and roll are zero.

    ``position`` maps times (N,) s to (N, 3) m and ``attitude`` to (N, 3) yaw, pitch, roll rad; ``R_LB`` is the body's
    fixed attitude in the levelled frame L (x ahead, y left, z up).
    """

    name: str
    duration_s: float
    position: Callable[[Float], Float]
    attitude: Callable[[Float], Float]
    R_LB: Float

    @cached_property
    def _splines(self) -> list[tuple[BSpline, BSpline, BSpline]]:
        from scipy.interpolate import BSpline

        # Two spare intervals at either end keep every instant inside the knots.
        count = int(np.ceil(self.duration_s / _CONTROL_INTERVAL_S)) + 2 * _DEGREE
        knots = (np.arange(count + _DEGREE + 1) - _DEGREE - 2) * _CONTROL_INTERVAL_S
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


def _waves(*terms: tuple[int, float, float, float]) -> Callable[[Float], Float]:
    """Sum of sines in three channels; a term is (channel, amplitude, period in s, phase in turns)."""

    def shape(t_s: Float) -> Float:
        out = np.zeros((len(t_s), 3))
        for channel, amplitude, period_s, phase in terms:
            out[:, channel] += amplitude * np.sin(2.0 * np.pi * (t_s / period_s + phase))
        return out

    return shape


def _still(t_s: Float) -> Float:
    return np.zeros((len(t_s), 3))


def _straight(t_s: Float) -> Float:
    return np.outer(t_s, [1.0, 0.0, 0.0])


def _stop_and_go(shape: Callable[[Float], Float]) -> Callable[[Float], Float]:
    """Rest for 4 s, fly along ``shape`` for 8 s, rest where that ended, and so on."""

    def paused(t_s: Float) -> Float:
        # Control points before time zero shape the beginning, which is at rest.
        cycle, phase = np.divmod(np.maximum(t_s, 0.0), 12.0)
        return shape(8.0 * cycle + np.clip(phase - 4.0, 0.0, 8.0)) - shape(np.zeros(1))

    return paused


Shape = Callable[[Float], Float]

FLIGHTS: dict[str, tuple[Shape, Shape]] = {
    "standstill": (_still, _still),
    "hover": (
        _waves((0, 0.06, 3.1, 0.0), (1, 0.05, 2.3, 0.2), (2, 0.04, 2.7, 0.6)),
        _waves((0, 0.04, 5.3, 0.1), (1, 0.03, 1.9, 0.4), (2, 0.03, 2.1, 0.7)),
    ),
    "figure_eight": (
        _waves((0, 3.0, 12.0, 0.0), (1, 2.0, 6.0, 0.0), (2, 0.5, 8.0, 0.0)),
        _waves((0, 0.6, 12.0, 0.1), (1, 0.10, 6.0, 0.2), (2, 0.15, 6.0, 0.0)),
    ),
    "aggressive": (
        _waves((0, 3.0, 5.0, 0.0), (1, 2.5, 4.1, 0.3), (2, 1.2, 3.3, 0.6), (0, 0.2, 1.1, 0.0)),
        _waves((0, 2.0, 7.0, 0.0), (1, 0.45, 2.9, 0.2), (2, 0.55, 2.3, 0.5), (0, 0.2, 1.3, 0.4)),
    ),
    "stop_and_go": (
        _stop_and_go(_waves((0, 2.0, 8.0, 0.0), (1, 1.5, 16.0, 0.0), (2, 0.5, 5.3, 0.0))),
        _stop_and_go(_waves((0, 0.5, 8.0, 0.0), (1, 0.15, 4.0, 0.0), (2, 0.15, 3.2, 0.0))),
    ),
    "pure_rotation": (_still, _waves((0, 0.8, 6.0, 0.0), (1, 0.3, 3.7, 0.0), (2, 0.3, 4.3, 0.0))),
    "constant_velocity": (_straight, _still),
}
"""Position and attitude by name: what each is for is in its name."""


def flight(name: str, duration_s: float, R_BC: Float) -> Flight:
    """The flight ``name`` of :data:`FLIGHTS` for a body whose camera sits at ``R_BC`` (3, 3) and looks ahead."""
    if name not in FLIGHTS:
        raise ConfigError(f"no flight is called {name!r}; there are {', '.join(FLIGHTS)}")
    position, attitude = FLIGHTS[name]
    # Camera axes (right, down, ahead) in the levelled frame (ahead, left, up).
    R_LC = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    return Flight(name, duration_s, position, attitude, R_LC @ R_BC.T)
