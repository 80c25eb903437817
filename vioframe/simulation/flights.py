"""Flights known exactly: pose, velocity, acceleration and angular rate as functions of time.

Both kinds are B-splines of degree five, so that accelerations and angular accelerations are smooth: a
:class:`ShapedFlight` through a position and yaw, pitch and roll that anybody may give as functions of time, of which
the built-in flights are made; a :class:`RecordedFlight` through the poses of a trajectory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vioframe.arrays import Float
from vioframe.errors import ConfigError, TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Flight
from vioframe.parts import registry
from vioframe.types import NS_PER_S, Motion

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_DEGREE = 5
# Of a recorded flight: between knots; poses beyond the piece asked for that still shape it; what is flown and no more.
_KNOT_INTERVAL_S = 0.1
_MARGIN_S = 1.0
_FEWEST_POSES = 12
_LONGEST_GAP_S = 1.0
_FASTEST_M_S = 30.0
_FASTEST_RAD_S = 20.0
_HARDEST_M_S2 = 150.0

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


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """A flight along recorded poses: splines of position (3) m and quaternion xyzw (4) from their time ``begin_s`` on.

    Both are B-splines of degree five, fitted by least squares; a rotation is the quaternion spline, normalised. With
    ``q`` a curve in R^4 and ``*`` the conjugate, the body turns at ``omega_B = 2 Im(q* dq/dt) / |q|^2``: the part of
    ``dq/dt`` along ``q`` changes nothing but the norm and drops out, for its product with ``q*`` is real. Where the
    norm is one, this is the rate of a quaternion as in Solà, "Quaternion kinematics for the error-state Kalman filter"
    (2017).
    """

    duration_s: float
    begin_s: float
    position: BSpline
    quat_xyzw: BSpline

    def at(self, t_s: Float) -> Motion:
        """The motion at times ``t_s`` (N,), 0 to ``duration_s``."""
        t_s = np.asarray(t_s, dtype=np.float64) + self.begin_s
        quat, d_quat = self.quat_xyzw(t_s), self.quat_xyzw(t_s, 1)
        (vector, w), (d_vector, d_w) = (np.split(q, [3], axis=1) for q in (quat, d_quat))
        imaginary = w * d_vector - d_w * vector - np.cross(vector, d_vector)
        omega_B = 2.0 * imaginary / (quat**2).sum(axis=1, keepdims=True)
        p_WB, v_WB, a_WB = (self.position(t_s, order) for order in range(3))
        return Motion(so3.from_quat_xyzw(quat), p_WB, v_WB, a_WB, omega_B)


def fit_flight(
    trajectory: Trajectory, start_s: float = 0.0, duration_s: float | None = None, *, name: str = "the trajectory"
) -> RecordedFlight:
    """The flight along ``trajectory``, the body's poses in a world with z up; errors call it ``name``.

    ``start_s`` counts from its first pose; ``duration_s`` None, or more than there is, is to its last. Motion faster
    than the knots, 0.1 s apart or two poses where that is more, is smoothed, and so are steps of the recording, which
    no body could fly. Raises :class:`TrajectoryError`, with the time, for gaps and jumps, and for a motion that comes
    out beyond what a vehicle can do.
    """
    from scipy.interpolate import make_lsq_spline

    if not (0.0 <= start_s < np.inf and (duration_s is None or 0.0 < duration_s < np.inf)):
        raise ConfigError("a flight begins at start_s >= 0 and lasts for duration_s > 0 seconds")
    t_s = (trajectory.t_ns - trajectory.t_ns[0]) / NS_PER_S
    end_s = t_s[-1] if duration_s is None else min(start_s + duration_s, t_s[-1])
    shaping = (t_s >= start_s - _MARGIN_S) & (t_s <= end_s + _MARGIN_S)
    if end_s <= start_s or shaping.sum() < _FEWEST_POSES:
        raise TrajectoryError(
            f"{name} lasts {t_s[-1]:g} s and has {shaping.sum()} poses for a flight from {start_s:g} s on, which needs "
            f"{_FEWEST_POSES}; start earlier or give a longer recording"
        )
    t_s, poses = t_s[shaping], trajectory.select(shaping)
    _check_poses(name, t_s, poses)
    quat = poses.quat_xyzw
    # q and -q are the same rotation: the signs that make neighbours alike.
    turned_over = np.einsum("ni,ni->n", quat[1:], quat[:-1]) < 0.0
    quat = quat * np.where(np.cumsum(np.r_[False, turned_over]) % 2, -1.0, 1.0)[:, None]
    knots = _knots(t_s)
    position, quat_xyzw = (make_lsq_spline(t_s, values, knots, _DEGREE) for values in (poses.p_WB, quat))
    flight = RecordedFlight(float(end_s - start_s), float(start_s), position, quat_xyzw)
    at_s = np.linspace(0.0, flight.duration_s, int(flight.duration_s / 0.01) + 2)
    motion = flight.at(at_s)
    hardest = ((motion.a_WB, _HARDEST_M_S2, "m/s^2"), (motion.omega_B, _FASTEST_RAD_S, "rad/s"))
    _check_limits(f"{name} asks for", at_s + start_s, hardest, "more than a vehicle can do; smooth the recording")
    return flight


def _knots(t_s: Float) -> Float:
    """Knots at every second pose or rarer, which keeps the least squares well posed (Schoenberg and Whitney 1953)."""
    inner: list[float] = []
    last = t_s[0]
    for candidate, beyond in zip(t_s[2:-2:2], t_s[3:-1:2], strict=True):
        # Halfway between two poses, so that none lies on a knot; the tolerance is for stamps that jitter.
        if candidate - last >= 0.999 * _KNOT_INTERVAL_S:
            inner.append(0.5 * (candidate + beyond))
            last = candidate
    # No last span shorter than the others: so few poses would leave its derivatives to their noise.
    while inner and t_s[-1] - inner[-1] < _KNOT_INTERVAL_S:
        inner.pop()
    return np.concatenate([np.repeat(t_s[0], _DEGREE + 1), inner, np.repeat(t_s[-1], _DEGREE + 1)])


def _check_poses(name: str, t_s: Float, poses: Trajectory) -> None:
    dt = np.diff(t_s)
    widest = int(np.argmax(dt))
    if dt[widest] > _LONGEST_GAP_S:
        raise TrajectoryError(
            f"{name} has no pose from {t_s[widest]:.3f} s to {t_s[widest + 1]:.3f} s after its first; "
            "take a piece without that gap (--start, --duration)"
        )
    velocity = np.diff(poses.p_WB, axis=0) / dt[:, None]
    rate = so3.log(np.swapaxes(poses.R_WB[:-1], 1, 2) @ poses.R_WB[1:]) / dt[:, None]
    fastest = ((velocity, _FASTEST_M_S, "m/s"), (rate, _FASTEST_RAD_S, "rad/s"))
    _check_limits(f"{name} jumps at", t_s, fastest, "a wrong pose; take a piece without the jump (start_s, duration_s)")


def _check_limits(what: str, t_s: Float, rates: Sequence[tuple[Float, float, str]], why: str) -> None:
    """Raise :class:`TrajectoryError` for the largest of the ``rates`` (N, 3) that is beyond its limit."""
    for rate, limit, unit in rates:
        size = np.linalg.norm(rate, axis=1)
        worst = int(np.argmax(size))
        if not size[worst] <= limit:
            raise TrajectoryError(f"{what} {size[worst]:.0f} {unit} {t_s[worst]:.3f} s after its first pose, {why}")
