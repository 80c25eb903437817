"""Errors of an aligned estimate: absolute, by axis, and relative over stretches of the path."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

import numpy as np

from vioframe.geometry import so3
from vioframe.geometry.so3 import yaw_of
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import Float, Int

_LENGTH_TOLERANCE = 0.2
"""A stretch may be longer than asked by this fraction, as at a gap in the estimate; longer ones are not counted."""


@dataclass(frozen=True, slots=True)
class Stats:
    """Summary of absolute errors, in their unit."""

    rmse: float
    mean: float
    median: float
    max: float

    @classmethod
    def of(cls, errors: Float) -> Stats:
        """Of ``errors`` (N,), whose sign does not matter."""
        size = np.abs(errors)
        return cls(float(np.sqrt(np.mean(size**2))), float(size.mean()), float(np.median(size)), float(size.max()))

    def to_dict(self) -> dict[str, float]:
        return asdict(self)


def rotation_error_rpy_deg(aligned: Trajectory, truth: Trajectory) -> Float:
    """(N, 3) deg, roll, pitch and yaw of E = R_est R_true^T about the world's axes.

    E = R_z(yaw) Exp([roll, pitch, 0]) is unique short of a tilt of 180 deg: yaw is the twist of E about gravity, which
    a visual-inertial system cannot observe, and roll and pitch are the tilt, which it can.
    """
    E = aligned.R_WB @ truth.R_WB.transpose(0, 2, 1)
    yaw = yaw_of(E)
    tilt = so3.log(so3.exp(-yaw[:, None] * np.array([0.0, 0.0, 1.0])) @ E)
    return np.degrees(np.column_stack([tilt[:, :2], yaw]))


def rotation_error_deg(aligned: Trajectory, truth: Trajectory) -> Float:
    """(N,) deg, the angle of R_true^T R_est."""
    return np.asarray(np.degrees(np.linalg.norm(so3.log(truth.R_WB.transpose(0, 2, 1) @ aligned.R_WB), axis=1)))


@dataclass(frozen=True, eq=False)
class RelativeErrors:
    """How far the estimate drifts over stretches of ``length_m``, one entry for each pose a stretch starts from.

    ``translation_percent`` (M,) of the way gone, ``yaw_deg`` (M,) about gravity, ``rotation_deg`` (M,) in all.
    """

    length_m: float
    start_ns: Int
    translation_percent: Float
    yaw_deg: Float
    rotation_deg: Float

    def to_dict(self) -> dict[str, object]:
        return {
            "length_m": self.length_m,
            "stretches": len(self.start_ns),
            "translation_percent": Stats.of(self.translation_percent).to_dict(),
            "yaw_deg": Stats.of(self.yaw_deg).to_dict(),
            "rotation_deg": Stats.of(self.rotation_deg).to_dict(),
        }


def relative_errors(
    estimate: Trajectory, truth: Trajectory, lengths_m: Mapping[float, float]
) -> dict[float, RelativeErrors]:
    """Relative errors over each of ``lengths_m`` that fits into the true path, under its key; the others are left out.

    With A = T_i^-1 T_j of the truth and B of the estimate, the error is A^-1 B (Zhang and Scaramuzza, IROS 2018); R_j
    of the truth turns its rotation into the world's axes, to tell yaw from tilt. No rigid alignment changes it.
    """
    travelled = truth.travelled_m
    found = {key: _over_length(estimate, truth, travelled, length) for key, length in lengths_m.items()}
    return {key: errors for key, errors in found.items() if errors is not None}


def _over_length(estimate: Trajectory, truth: Trajectory, travelled: Float, length_m: float) -> RelativeErrors | None:
    end = np.searchsorted(travelled, travelled + length_m)
    start = np.flatnonzero(end < len(travelled))
    end = end[start]
    fits = travelled[end] - travelled[start] <= (1.0 + _LENGTH_TOLERANCE) * length_m
    start, end = start[fits], end[fits]
    if not start.size:
        return None
    R_true, p_true = _relative_poses(truth, start, end)
    R_est, p_est = _relative_poses(estimate, start, end)
    R_Wj = truth.R_WB[end]
    E_W = R_Wj @ (R_true.transpose(0, 2, 1) @ R_est) @ R_Wj.transpose(0, 2, 1)
    return RelativeErrors(
        length_m=float(length_m),
        start_ns=truth.t_ns[start],
        translation_percent=100.0 * np.linalg.norm(p_est - p_true, axis=1) / (travelled[end] - travelled[start]),
        yaw_deg=np.degrees(np.abs(yaw_of(E_W))),
        rotation_deg=np.degrees(np.linalg.norm(so3.log(E_W), axis=1)),
    )


def _relative_poses(trajectory: Trajectory, start: Int, end: Int) -> tuple[Float, Float]:
    """R (M, 3, 3) and p (M, 3) of the end pose seen from the start pose."""
    R_iW = trajectory.R_WB[start].transpose(0, 2, 1)
    p = np.einsum("nij,nj->ni", R_iW, trajectory.p_WB[end] - trajectory.p_WB[start])
    return R_iW @ trajectory.R_WB[end], p
