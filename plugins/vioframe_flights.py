"""The built-in flights: shapes of a few lines each, and what each is for is in its name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from vioframe.arrays import Float
from vioframe.parts.hooks import hookimpl
from vioframe.types import GRAVITY_M_S2

if TYPE_CHECKING:
    from vioframe.interfaces import FlightFactory
    from vioframe.simulation.flights import Shape, ShapedFlight

# Between the control points of a path; of one that shakes with every step.
_CONTROL_INTERVAL_S, _STEP_INTERVAL_S = 0.25, 0.08

Size = Annotated[float, Field(gt=0.0, le=10.0, description="how many times as large the path is")]
Speed = Annotated[float, Field(gt=0.0, le=10.0, description="how many times as fast everything happens")]


def standstill(duration_s: float, R_LB: Float) -> ShapedFlight:
    """At rest and level."""
    return _scaled(duration_s, R_LB, _waves(), _waves(), 1.0, 1.0)


def hover(duration_s: float, R_LB: Float, *, size: Size = 1.0, speed: Speed = 1.0) -> ShapedFlight:
    """Held in place as well as a multirotor can be: a few centimetres and degrees to and fro."""
    position = _waves((0, 0.06, 3.1, 0.0), (1, 0.05, 2.3, 0.2), (2, 0.04, 2.7, 0.6))
    attitude = _waves((0, 0.04, 5.3, 0.1), (1, 0.03, 1.9, 0.4), (2, 0.03, 2.1, 0.7))
    return _scaled(duration_s, R_LB, position, attitude, size, speed)


def figure_eight(duration_s: float, R_LB: Float, *, size: Size = 1.0, speed: Speed = 1.0) -> ShapedFlight:
    """An eight of 6 x 4 m in 12 s, up and down by half a metre, the camera ahead."""
    position = _waves((0, 3.0, 12.0, 0.0), (1, 2.0, 6.0, 0.0), (2, 0.5, 8.0, 0.0))
    attitude = _waves((0, 0.6, 12.0, 0.1), (1, 0.10, 6.0, 0.2), (2, 0.15, 6.0, 0.0))
    return _scaled(duration_s, R_LB, position, attitude, size, speed)


def aggressive(duration_s: float, R_LB: Float, *, size: Size = 1.0, speed: Speed = 1.0) -> ShapedFlight:
    """Racing in three dimensions: accelerations beyond 1 g, 30 deg of tilt, fast turns."""
    position = _waves((0, 3.0, 5.0, 0.0), (1, 2.5, 4.1, 0.3), (2, 1.2, 3.3, 0.6), (0, 0.2, 1.1, 0.0))
    attitude = _waves((0, 2.0, 7.0, 0.0), (1, 0.45, 2.9, 0.2), (2, 0.55, 2.3, 0.5), (0, 0.2, 1.3, 0.4))
    return _scaled(duration_s, R_LB, position, attitude, size, speed)


def stop_and_go(duration_s: float, R_LB: Float, *, size: Size = 1.0, speed: Speed = 1.0) -> ShapedFlight:
    """Standstill for 4 s, motion for 8 s, standstill, and so on."""
    position = _stop_and_go(_waves((0, 2.0, 8.0, 0.0), (1, 1.5, 16.0, 0.0), (2, 0.5, 5.3, 0.0)))
    attitude = _stop_and_go(_waves((0, 0.5, 8.0, 0.0), (1, 0.15, 4.0, 0.0), (2, 0.15, 3.2, 0.0)))
    return _scaled(duration_s, R_LB, position, attitude, size, speed)


def inspection(duration_s: float, R_LB: Float, *, size: Size = 1.0, speed: Speed = 1.0) -> ShapedFlight:
    """A multirotor inspecting a tank: rests, takes off, then looks at it from stop after stop around it and up it."""

    def position(t_s: Float) -> Float:
        angle, height = _round_the_tank(t_s)
        drift = _waves((0, 0.03, 3.1, 0.0), (1, 0.03, 2.3, 0.2), (2, 0.02, 2.7, 0.6))(t_s)
        arc = np.column_stack([_TANK_M * (1.0 - np.cos(angle)), _TANK_M * np.sin(angle), height])
        return np.asarray(arc + _smooth((t_s - _TAKE_OFF_S) / _CLIMB_S)[:, None] * drift)

    def attitude(t_s: Float) -> Float:
        return _leaning(-_round_the_tank(t_s)[0], position, t_s, size, speed)

    return _scaled(duration_s, R_LB, position, attitude, size, speed)


def tour(
    duration_s: float,
    R_LB: Float,
    *,
    route: Annotated[int, Field(ge=0, description="which of the many ways to go")] = 0,
    mean_speed_m_s: Annotated[float, Field(gt=0.0, le=3.0, description="how fast on average")] = 0.8,
    width_m: Annotated[float, Field(gt=0.0, le=50.0, description="size of the place, x and y")] = 8.0,
    height_m: Annotated[float, Field(ge=0.0, le=10.0, description="how far up and down")] = 2.0,
) -> ShapedFlight:
    """A multirotor that rests, takes off and flies about a place without repeating itself, looking here and there."""
    rng = np.random.default_rng(route)
    phase, period = rng.random((3, 3)), rng.uniform([12.0, 7.0, 4.0], [18.0, 10.0, 6.0], (3, 3))
    along = [(axis, 0.5 * share, period[axis, k], phase[axis, k]) for axis in range(3) for k, share in enumerate(_TOUR)]
    path = _waves(*along)
    looks = _waves((0, 1.2, 1.5 * period[0, 0], phase[1, 1]), (0, 0.6, period[1, 1], phase[2, 2]))
    extent = np.array([width_m, width_m, height_m])
    # The mean speed over so long a way that its ends do not matter.
    u = np.arange(0.0, 1000.0, 0.1)
    pace = mean_speed_m_s / (np.linalg.norm(np.diff(extent * path(u), axis=0), axis=1).mean() / 0.1)

    def gone(t_s: Float) -> Float:
        """How far along the way at time ``t_s``: from rest to the full pace."""
        s = np.maximum(t_s - _TAKE_OFF_S, 0.0)
        # The integral of the smooth step x^2 (3 - 2 x) over the time of the climb, then on at full pace.
        x = np.minimum(s / _CLIMB_S, 1.0)
        return np.asarray(pace * (_CLIMB_S * (x**3 - 0.5 * x**4) + np.maximum(s - _CLIMB_S, 0.0)))

    def position(t_s: Float) -> Float:
        return np.asarray(extent * path(gone(t_s)))

    def attitude(t_s: Float) -> Float:
        return _leaning(looks(gone(t_s))[:, 0], position, t_s, 1.0, 1.0)

    return _scaled(duration_s, R_LB, position, attitude, 1.0, 1.0)


def walk(duration_s: float, R_LB: Float, *, size: Size = 1.0, speed: Speed = 1.0) -> ShapedFlight:
    """A camera carried in the hand round a room: steps that shake it twice a second, looks to either side."""
    steps = (1, 0.012, 1.06, 0.1), (2, 0.022, 0.53, 0.0)
    position = _waves((0, 2.0, 17.0, 0.0), (1, 1.5, 11.0, 0.2), (2, 0.08, 5.1, 0.4), *steps)
    shake = (0, 0.012, 1.06, 0.3), (1, 0.015, 0.53, 0.2), (2, 0.012, 1.06, 0.6)
    attitude = _waves((0, 0.7, 8.0, 0.0), (0, 0.2, 2.7, 0.4), (1, 0.12, 3.3, 0.1), (2, 0.08, 2.9, 0.7), *shake)
    return _scaled(duration_s, R_LB, position, attitude, size, speed, _STEP_INTERVAL_S)


def pure_rotation(duration_s: float, R_LB: Float, *, speed: Speed = 1.0) -> ShapedFlight:
    """Turning on the spot, without any translation of the body."""
    attitude = _waves((0, 0.8, 6.0, 0.0), (1, 0.3, 3.7, 0.0), (2, 0.3, 4.3, 0.0))
    return _scaled(duration_s, R_LB, _waves(), attitude, 1.0, speed)


def constant_velocity(duration_s: float, R_LB: Float, *, speed: Speed = 1.0) -> ShapedFlight:
    """Straight ahead at 1 m/s without turning: nothing that an accelerometer could tell from rest."""
    return _scaled(duration_s, R_LB, lambda t_s: np.outer(t_s, [1.0, 0.0, 0.0]), _waves(), 1.0, speed)


_TOUR = (0.6, 0.3, 0.1)
"""Parts that the slow, the middling and the quick waves have in a tour."""
_TANK_M = 4.0
"""From the stops of an inspection to the axis of the tank."""
_TAKE_OFF_S, _CLIMB_S = 2.0, 3.0
_LOOK_S, _TRANSIT_S = 1.5, 2.5
_STEP_RAD = np.deg2rad(40.0)
_HEIGHTS_M = np.array([1.2, 1.2, 2.6, 2.6])


def _round_the_tank(t_s: Float) -> tuple[Float, Float]:
    """Angle around the tank (N,) rad and height (N,) m: a climb to the first stop, then from stop to stop."""
    stop, phase = np.divmod(np.maximum(t_s - _TAKE_OFF_S - _CLIMB_S, 0.0), _LOOK_S + _TRANSIT_S)
    moved = _smooth((phase - _LOOK_S) / _TRANSIT_S)
    low, high = (_HEIGHTS_M[(stop + k).astype(np.int64) % len(_HEIGHTS_M)] for k in (0, 1))
    climbed = _smooth((t_s - _TAKE_OFF_S) / _CLIMB_S)
    return _STEP_RAD * (stop + moved), climbed * (low + moved * (high - low))


def _leaning(yaw: Float, position: Shape, t_s: Float, size: float, speed: float) -> Float:
    """Yaw, pitch and roll (N, 3) rad: a multirotor leans the way it accelerates."""
    h = _CONTROL_INTERVAL_S
    a_W = size * (speed / h) ** 2 * (position(t_s - h) - 2.0 * position(t_s) + position(t_s + h))
    ahead = np.cos(yaw) * a_W[:, 0] + np.sin(yaw) * a_W[:, 1]
    left = np.cos(yaw) * a_W[:, 1] - np.sin(yaw) * a_W[:, 0]
    up = np.maximum(a_W[:, 2] + GRAVITY_M_S2, 0.5 * GRAVITY_M_S2)
    return np.column_stack([yaw, np.arctan2(ahead, up), -np.arctan2(left, np.hypot(ahead, up))])


def _smooth(x: Float) -> Float:
    """From 0 at x <= 0 to 1 at x >= 1, with velocity and acceleration zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def _scaled(
    duration_s: float,
    R_LB: Float,
    position: Shape,
    attitude: Shape,
    size: float,
    speed: float,
    interval_s: float = _CONTROL_INTERVAL_S,
) -> ShapedFlight:
    """The same path ``size`` times as large, and the same motion ``speed`` times as fast."""
    from vioframe.simulation.flights import ShapedFlight

    return ShapedFlight(
        duration_s,
        lambda t_s: size * position(speed * t_s),
        lambda t_s: attitude(speed * t_s),
        R_LB,
        interval_s / speed,
    )


def _waves(*terms: tuple[int, float, float, float]) -> Shape:
    """Sum of sines in three channels; a term is (channel, amplitude, period in s, phase in turns). None is rest."""

    def shape(t_s: Float) -> Float:
        out = np.zeros((len(t_s), 3))
        for channel, amplitude, period_s, phase in terms:
            out[:, channel] += amplitude * np.sin(2.0 * np.pi * (t_s / period_s + phase))
        return out

    return shape


def _stop_and_go(shape: Shape) -> Shape:
    """Rest for 4 s, fly along ``shape`` for 8 s, rest where that ended, and so on."""

    def paused(t_s: Float) -> Float:
        # Control points before time zero shape the beginning, which is at rest.
        cycle, phase = np.divmod(np.maximum(t_s, 0.0), 12.0)
        return np.asarray(shape(8.0 * cycle + np.clip(phase - 4.0, 0.0, 8.0)) - shape(np.zeros(1)))

    return paused


@hookimpl
def vioframe_flights() -> Mapping[str, FlightFactory]:
    flights = (standstill, hover, figure_eight, aggressive, stop_and_go, inspection, tour, walk)
    return {flight.__name__: flight for flight in (*flights, pure_rotation, constant_velocity)}
