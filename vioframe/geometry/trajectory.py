"""A body's poses over time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vioframe.arrays import Float, Int
from vioframe.errors import TrajectoryError
from vioframe.geometry import so3

_ORTHONORMAL_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses ``p_W = R_WB @ p_B + p_WB`` at strictly increasing stamps; the arrays are copied and read-only.

    ``t_ns`` (N,) int64, ``R_WB`` (N, 3, 3), ``p_WB`` (N, 3) m, N >= 1. ``cov_pose`` (N, 6, 6) is the covariance of
    [dtheta dp], ``R_WB <- R_WB Exp(dtheta)`` in rad and ``p_WB <- p_WB + dp`` in m along W, or None. An instant whose
    covariance is not known holds NaN. Raises :class:`TrajectoryError` where shapes, stamps or rotations are invalid.
    """

    t_ns: Int
    R_WB: Float
    p_WB: Float
    cov_pose: Float | None = None

    def __post_init__(self) -> None:
        stamps = np.asarray(self.t_ns)
        if stamps.ndim != 1 or stamps.size == 0:
            raise TrajectoryError(f"a trajectory needs at least one pose; t_ns has shape {stamps.shape}")
        if not np.issubdtype(stamps.dtype, np.integer):
            raise TrajectoryError(f"t_ns must be integer nanoseconds, got {stamps.dtype}")
        n = len(stamps)
        self._freeze("t_ns", np.array(stamps, dtype=np.int64), (n,))
        self._freeze("R_WB", np.array(self.R_WB, dtype=np.float64), (n, 3, 3))
        self._freeze("p_WB", np.array(self.p_WB, dtype=np.float64), (n, 3))
        if self.cov_pose is not None:
            self._freeze("cov_pose", np.array(self.cov_pose, dtype=np.float64), (n, 6, 6))
        self._check_values()

    def _freeze(self, name: str, array: NDArray[np.generic], shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            raise TrajectoryError(f"{name} has shape {array.shape}, expected {shape} to match t_ns")
        array.flags.writeable = False
        object.__setattr__(self, name, array)

    def _check_values(self) -> None:
        backwards = np.flatnonzero(np.diff(self.t_ns) <= 0)
        if backwards.size:
            i = int(backwards[0]) + 1
            raise TrajectoryError(f"stamps must increase: pose {i} at {self.t_ns[i]} ns follows {self.t_ns[i - 1]} ns")
        finite = np.isfinite(self.p_WB).all(axis=1) & np.isfinite(self.R_WB).all(axis=(1, 2))
        if not finite.all():
            raise TrajectoryError(f"pose {int(np.argmin(finite))} is not finite")
        gram = self.R_WB @ self.R_WB.transpose(0, 2, 1)
        bad = np.abs(gram - np.eye(3)).max(axis=(1, 2)) > _ORTHONORMAL_TOLERANCE
        bad |= np.linalg.det(self.R_WB) < 0.0
        if bad.any():
            raise TrajectoryError(f"R_WB of pose {int(np.argmax(bad))} is not a rotation; project it to SO(3) first")

    @classmethod
    def from_quat_xyzw(cls, t_ns: Int, p_WB: ArrayLike, quat_xyzw: ArrayLike) -> Trajectory:
        """From Hamilton quaternions (N, 4) of ``R_WB``, of any norm but zero."""
        quat = np.asarray(quat_xyzw, dtype=np.float64)
        if np.any(np.linalg.norm(quat, axis=-1) == 0.0):
            raise TrajectoryError("a quaternion is zero and has no direction")
        return cls(t_ns, so3.from_quat_xyzw(quat), np.asarray(p_WB, dtype=np.float64))

    @property
    def quat_xyzw(self) -> Float:
        """(N, 4) Hamilton quaternions of ``R_WB``, w >= 0."""
        return so3.to_quat_xyzw(self.R_WB)

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def duration_s(self) -> float:
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9

    @property
    def travelled_m(self) -> Float:
        """(N,) path length from the first pose to each."""
        steps = np.linalg.norm(np.diff(self.p_WB, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def path_length_m(self) -> float:
        return float(self.travelled_m[-1])

    def select(self, which: NDArray[np.generic] | slice) -> Trajectory:
        """The poses that a boolean mask, ascending indices or a slice picks."""
        cov = None if self.cov_pose is None else self.cov_pose[which]
        return Trajectory(self.t_ns[which], self.R_WB[which], self.p_WB[which], cov)

    def covers(self, t_ns: ArrayLike, max_gap_s: float = 0.1) -> NDArray[np.bool_]:
        """(M,) whether each stamp is a pose's own or lies between two poses at most ``max_gap_s`` apart."""
        left, right = self._neighbours(np.asarray(t_ns, dtype=np.int64))
        inside = (left >= 0) & (right < len(self))
        gap = self.t_ns[np.minimum(right, len(self) - 1)] - self.t_ns[np.maximum(left, 0)]
        return np.asarray(inside & (gap <= round(max_gap_s * 1e9)))

    def at(self, t_ns: ArrayLike, max_gap_s: float = 0.1) -> Trajectory:
        """Interpolated at ascending stamps (M,): geodesic in rotation, linear in position, without covariance.

        Raises :class:`TrajectoryError` for a stamp that :meth:`covers` says is not covered.
        """
        stamps = np.asarray(t_ns, dtype=np.int64)
        covered = self.covers(stamps, max_gap_s)
        if not covered.all():
            first = stamps[int(np.argmin(covered))]
            raise TrajectoryError(
                f"cannot interpolate at {first} ns: no poses on both sides within {max_gap_s:g} s "
                f"(trajectory spans {self.t_ns[0]} to {self.t_ns[-1]} ns)"
            )
        left, right = self._neighbours(stamps)
        span = np.maximum(self.t_ns[right] - self.t_ns[left], 1)
        fraction = (stamps - self.t_ns[left]) / span
        p_WB = self.p_WB[left] + fraction[:, None] * (self.p_WB[right] - self.p_WB[left])
        return Trajectory(stamps, so3.interpolate(self.R_WB[left], self.R_WB[right], fraction), p_WB)

    def _neighbours(self, t_ns: Int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Indices of the last pose not after, and of the first pose not before, each stamp; -1 or N outside."""
        left = np.searchsorted(self.t_ns, t_ns, side="right") - 1
        right = np.searchsorted(self.t_ns, t_ns, side="left")
        return left, right
