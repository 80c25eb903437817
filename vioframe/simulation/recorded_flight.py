"""A flight along a recorded trajectory: splines through its poses, so that every derivative is known exactly.

Positions and quaternions are B-splines of degree five, fitted by least squares; a rotation is the quaternion spline,
normalised. With ``q`` a curve in R^4 and ``*`` the conjugate, the body turns at ``omega_B = 2 Im(q* dq/dt) / |q|^2``:
the part of ``dq/dt`` along ``q`` changes nothing but the norm and drops out, for its product with ``q*`` is real. Where
the norm is one, this is the rate of a quaternion as in Solà, "Quaternion kinematics for the error-state Kalman filter"
(2017).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vioframe.errors import ConfigError, TrajectoryError
from vioframe.geometry import so3
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.trajectories import load_trajectory
from vioframe.types import NS_PER_S, Float, Motion

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

_DEGREE = 5
_FEWEST_POSES = 12
_LONGEST_GAP_S = 1.0
_FASTEST_M_S = 30.0
_FASTEST_RAD_S = 20.0
_HARDEST_M_S2 = 150.0
# Poses beyond the piece asked for that still shape it, where there are any.
_MARGIN_S = 1.0


@dataclass(frozen=True, slots=True)
class RecordedFlight:
    """Splines of position (3) m and quaternion xyzw (4), of ``duration_s`` from their own time ``begin_s``."""

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


def flight_from_file(
    path: str | Path, start_s: float = 0.0, duration_s: float | None = None, *, knot_interval_s: float = 0.1
) -> RecordedFlight:
    """The flight along the TUM or EuRoC file ``path``, whose poses are the body's in a world with z up.

    ``start_s`` counts from the file's first pose; ``duration_s`` None, or more than there is, is to its last. Knots are
    ``knot_interval_s`` apart, or wider where that would leave fewer than two poses between them: motion that is faster
    is smoothed, and so are steps of the recording, which no body could fly. Raises :class:`TrajectoryError`, with the
    time, for gaps and jumps, and for a motion that comes out beyond what a vehicle can do.
    """
    path = Path(path)
    return fit_flight(load_trajectory(path), start_s, duration_s, knot_interval_s=knot_interval_s, name=path.name)


def fit_flight(
    trajectory: Trajectory,
    start_s: float = 0.0,
    duration_s: float | None = None,
    *,
    knot_interval_s: float = 0.1,
    name: str = "the trajectory",
) -> RecordedFlight:
    """As :func:`flight_from_file`, from poses at hand; errors call them ``name``."""
    from scipy.interpolate import make_lsq_spline

    if not (0.0 <= start_s < np.inf and (duration_s is None or 0.0 < duration_s < np.inf)):
        raise ConfigError("a flight begins at start_s >= 0 and lasts for duration_s > 0 seconds")
    if not 0.0 < knot_interval_s < np.inf:
        raise ConfigError(f"knot_interval_s must be above 0, not {knot_interval_s:g}; 0.1 suits a multirotor")
    t_s = (trajectory.t_ns - trajectory.t_ns[0]) / NS_PER_S
    end_s = t_s[-1] if duration_s is None else min(start_s + duration_s, t_s[-1])
    shaping = (t_s >= start_s - _MARGIN_S) & (t_s <= end_s + _MARGIN_S)
    if end_s <= start_s or shaping.sum() < _FEWEST_POSES:
        raise TrajectoryError(
            f"{name} lasts {t_s[-1]:g} s and has {shaping.sum()} poses for a flight from {start_s:g} s on, which needs "
            f"{_FEWEST_POSES}; start earlier or give a longer recording"
        )
    t_s, poses = t_s[shaping], trajectory.select(shaping)
    quat = _continuous(poses.quat_xyzw)
    _check_samples(name, t_s, poses)
    knots = _knots(t_s, knot_interval_s)
    position, quat_xyzw = (make_lsq_spline(t_s, values, knots, _DEGREE) for values in (poses.p_WB, quat))
    flight = RecordedFlight(float(end_s - start_s), float(start_s), position, quat_xyzw)
    _check_motion(name, flight)
    return flight


def _continuous(quat: Float) -> Float:
    """``quat`` (N, 4) with the signs that make neighbours alike: q and -q are the same rotation."""
    turned_over = np.einsum("ni,ni->n", quat[1:], quat[:-1]) < 0.0
    return np.asarray(quat * np.where(np.cumsum(np.r_[False, turned_over]) % 2, -1.0, 1.0)[:, None])


def _knots(t_s: Float, interval_s: float) -> Float:
    """Knots at every second pose or rarer, which keeps the least squares well posed (Schoenberg and Whitney 1953)."""
    inner: list[float] = []
    last = t_s[0]
    for candidate, beyond in zip(t_s[2:-2:2], t_s[3:-1:2], strict=True):
        # Halfway between two poses, so that none lies on a knot; the tolerance is for stamps that jitter.
        if candidate - last >= 0.999 * interval_s:
            inner.append(0.5 * (candidate + beyond))
            last = candidate
    # No last span shorter than the others: so few poses would leave its derivatives to their noise.
    while inner and t_s[-1] - inner[-1] < interval_s:
        inner.pop()
    return np.concatenate([np.repeat(t_s[0], _DEGREE + 1), inner, np.repeat(t_s[-1], _DEGREE + 1)])


def _check_samples(name: str, t_s: Float, poses: Trajectory) -> None:
    dt = np.diff(t_s)
    widest = int(np.argmax(dt))
    if dt[widest] > _LONGEST_GAP_S:
        raise TrajectoryError(
            f"{name} has no pose from {t_s[widest]:.3f} s to {t_s[widest + 1]:.3f} s after its first; "
            "take a piece without that gap (start_s, duration_s)"
        )
    speed = np.linalg.norm(np.diff(poses.p_WB, axis=0), axis=1) / dt
    turn = np.linalg.norm(so3.log(np.swapaxes(poses.R_WB[:-1], 1, 2) @ poses.R_WB[1:]), axis=1) / dt
    for rate, limit, unit in ((speed, _FASTEST_M_S, "m/s"), (turn, _FASTEST_RAD_S, "rad/s")):
        worst = int(np.argmax(rate))
        if rate[worst] > limit:
            raise TrajectoryError(
                f"{name} jumps at {rate[worst]:.0f} {unit} {t_s[worst]:.3f} s after its first pose; "
                "remove the poses that are wrong, or take a piece without the jump (start_s, duration_s)"
            )


def _check_motion(name: str, flight: RecordedFlight) -> None:
    t_s = np.linspace(0.0, flight.duration_s, int(flight.duration_s / 0.01) + 2)
    motion = flight.at(t_s)
    for rate, limit, unit in ((motion.a_WB, _HARDEST_M_S2, "m/s^2"), (motion.omega_B, _FASTEST_RAD_S, "rad/s")):
        size = np.linalg.norm(rate, axis=1)
        worst = int(np.argmax(size))
        if not size[worst] <= limit:
            raise TrajectoryError(
                f"{name} asks for {size[worst]:.0f} {unit} {t_s[worst] + flight.begin_s:.3f} s after its first pose, "
                "more than a vehicle can do; smooth the recording or take wider knots (knot_interval_s)"
            )
