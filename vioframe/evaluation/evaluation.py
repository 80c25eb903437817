"""An estimate beside the truth, and the one function that turns the two into numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import TrajectoryError
from vioframe.evaluation.alignment import ALIGNMENTS, Alignment, align_posyaw_by_attitude, align_se3, align_sim3
from vioframe.evaluation.metrics import (
    RelativeErrors,
    Stats,
    relative_errors,
    rotation_error_deg,
    rotation_error_rpy_deg,
)
from vioframe.evaluation.nees import Nees, nees
from vioframe.geometry import so3
from vioframe.geometry.so3 import yaw_of
from vioframe.geometry.trajectory import Trajectory
from vioframe.types import Float

LENGTHS_M = (8.0, 16.0, 24.0, 32.0, 40.0, 48.0)
"""Stretches for relative errors as OpenVINS reports them."""
FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Stretches as parts of the whole path, as rpg_trajectory_evaluation reports them."""

_AT_REST_M = 0.05
_SUSPICIOUS_ANGLE_DEG = 10.0


@dataclass(frozen=True, eq=False)
class TrajectoryErrors:
    """What separates an estimate from the truth; N associated poses in the ground truth's world.

    ``position_m`` (N, 3) estimate minus truth, ``rotation_rpy_deg`` (N, 3) about the world's axes. ``ate_se3_m``,
    ``ate_sim3_m`` and ``scale``, the factor the estimate would have to be multiplied by, come from alignments of their
    own and are None where the body did not move enough to tell. ``relative`` is by length in metres,
    ``relative_by_fraction`` by the fraction of the whole path. NEES is taken in the gauge of the first pose in any
    case. ``coverage`` is the part of the ground truth's time between the first and the last associated pose.
    """

    alignment_name: str
    alignment: Alignment
    estimate: Trajectory
    truth: Trajectory
    position_m: Float
    rotation_rpy_deg: Float
    ate_m: Stats
    orientation_deg: Stats
    yaw_deg: Stats
    ate_se3_m: float | None
    ate_sim3_m: float | None
    scale: float | None
    relative: Mapping[float, RelativeErrors]
    relative_by_fraction: Mapping[float, RelativeErrors]
    nees: tuple[Nees, ...]
    coverage: float
    notes: tuple[str, ...]

    @property
    def at_rest(self) -> bool:
        """Whether the body stayed in one place, so that its path tells neither heading, scale nor drift by length."""
        return _spread_m(self.truth) < _AT_REST_M

    @property
    def max_position_m(self) -> Float:
        """(3,) largest absolute position error along x, y, z."""
        return np.asarray(np.abs(self.position_m).max(axis=0))

    @property
    def max_rotation_deg(self) -> Float:
        """(3,) largest absolute rotation error in roll, pitch, yaw."""
        return np.asarray(np.abs(self.rotation_rpy_deg).max(axis=0))

    def inside_band(self, half_width_m: float) -> dict[str, float]:
        """Percent of the instants at which |x|, |y|, |z| and all three are within ``half_width_m``."""
        within = np.abs(self.position_m) <= half_width_m
        percent = dict(zip("xyz", (100.0 * within.mean(axis=0)).tolist(), strict=True))
        return {**percent, "all": 100.0 * float(within.all(axis=1).mean())}

    def to_dict(self) -> dict[str, object]:
        """The summary without time series, ready for JSON."""
        return {
            "alignment": self.alignment_name,
            "poses": len(self.estimate),
            "duration_s": self.estimate.duration_s,
            "path_length_m": self.truth.path_length_m,
            "coverage": self.coverage,
            "ate_m": self.ate_m.to_dict(),
            "ate_se3_m": self.ate_se3_m,
            "scale": self.scale,
            "orientation_deg": self.orientation_deg.to_dict(),
            "yaw_deg": self.yaw_deg.to_dict(),
            "max_position_m": dict(zip("xyz", self.max_position_m.tolist(), strict=True)),
            "max_rotation_deg": dict(zip(("roll", "pitch", "yaw"), self.max_rotation_deg.tolist(), strict=True)),
            "relative": {f"{length:g}m": errors.to_dict() for length, errors in self.relative.items()},
            "relative_by_fraction": {
                f"{100 * f:g}%": errors.to_dict() for f, errors in self.relative_by_fraction.items()
            },
            "nees": {n.part: n.to_dict() for n in self.nees},
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """What a metric looks at: ``estimate`` in its own world and ``ground_truth`` at its own rate, both whole.

    ``errors`` are those of the poses that belong together, aligned by position and yaw, the gauge that a
    visual-inertial system leaves open.
    """

    estimate: Trajectory
    ground_truth: Trajectory
    errors: TrajectoryErrors

    @classmethod
    def of(cls, estimate: Trajectory, ground_truth: Trajectory) -> Self:
        """Raises :class:`TrajectoryError` where the two cannot be compared."""
        return cls(estimate, ground_truth, evaluate(estimate, ground_truth))

    @property
    def truth(self) -> Trajectory:
        """The true pose, interpolated, for each of the N poses of the estimate that have one."""
        return self.errors.truth

    @property
    def unaligned(self) -> Trajectory:
        """Those N poses of the estimate, in its own world."""
        return self.estimate.select(np.isin(self.estimate.t_ns, self.truth.t_ns))


def evaluate(estimate: Trajectory, ground_truth: Trajectory, *, alignment: str = "posyaw") -> TrajectoryErrors:
    """Associate, align and measure. The estimate is moved, never the truth; neither is changed.

    ``alignment`` is one of :data:`ALIGNMENTS`. Raises :class:`TrajectoryError` where the two cannot be compared.
    """
    if alignment not in ALIGNMENTS:
        raise TrajectoryError(f"unknown alignment {alignment!r}; use one of {', '.join(ALIGNMENTS)}")
    raw, truth = associate(estimate, ground_truth)
    at_rest = _spread_m(truth) < _AT_REST_M
    fit = align_posyaw_by_attitude if at_rest and alignment == "posyaw" else ALIGNMENTS[alignment]
    transform = fit(raw, truth)
    aligned = transform.apply(raw)
    rotation_rpy_deg = rotation_error_rpy_deg(aligned, truth)
    position_m = aligned.p_WB - truth.p_WB
    path_m = truth.path_length_m
    by_length = {} if at_rest else relative_errors(aligned, truth, {length: length for length in LENGTHS_M})
    by_fraction = {} if at_rest else relative_errors(aligned, truth, {part: part * path_m for part in FRACTIONS})
    ate_se3_m, ate_sim3_m, scale = (None, None, None) if at_rest else _by_other_alignments(raw, truth)
    return TrajectoryErrors(
        alignment_name=alignment,
        alignment=transform,
        estimate=aligned,
        truth=truth,
        position_m=position_m,
        rotation_rpy_deg=rotation_rpy_deg,
        ate_m=Stats.of(np.linalg.norm(position_m, axis=1)),
        orientation_deg=Stats.of(rotation_error_deg(aligned, truth)),
        yaw_deg=Stats.of(rotation_rpy_deg[:, 2]),
        ate_se3_m=ate_se3_m,
        ate_sim3_m=ate_sim3_m,
        scale=scale,
        relative=by_length,
        relative_by_fraction=by_fraction,
        nees=nees(ALIGNMENTS["first"](raw, truth).apply(raw), truth),
        coverage=min(1.0, raw.duration_s / ground_truth.duration_s) if len(ground_truth) > 1 else 1.0,
        notes=tuple(_notes(estimate, raw, aligned, truth, at_rest)),
    )


def associate(estimate: Trajectory, ground_truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """The poses of ``estimate`` that have a true one, and those, pairwise.

    The ground truth, the denser of the two, is brought onto the estimate's stamps wherever it :meth:`covers
    <Trajectory.covers>` them. Raises :class:`TrajectoryError` where it covers none.
    """
    covered = ground_truth.covers(estimate.t_ns)
    if not covered.any():
        spans = " and ".join(f"{x.t_ns[0] * 1e-9:.3f} .. {x.t_ns[-1] * 1e-9:.3f} s" for x in (estimate, ground_truth))
        raise TrajectoryError(f"no stamps in common: the trajectories span {spans}; are they of one flight and clock?")
    matched = estimate.select(covered)
    return matched, ground_truth.at(matched.t_ns)


def _spread_m(trajectory: Trajectory) -> float:
    """Root mean square distance from the mean position."""
    return float(np.sqrt(trajectory.p_WB.var(axis=0).sum()))


def _by_other_alignments(raw: Trajectory, truth: Trajectory) -> tuple[float | None, float | None, float | None]:
    """ATE by SE(3) and by Sim(3), m, and the scale of the latter."""
    try:
        fits = align_se3(raw, truth), align_sim3(raw, truth)
    except TrajectoryError:
        # A straight path leaves a rotation open.
        return None, None, None
    se3_m, sim3_m = (Stats.of(np.linalg.norm(fit.apply(raw).p_WB - truth.p_WB, axis=1)).rmse for fit in fits)
    return se3_m, sim3_m, fits[1].scale


def _notes(estimate: Trajectory, raw: Trajectory, aligned: Trajectory, truth: Trajectory, at_rest: bool) -> list[str]:
    """What a reader of the numbers should know: one line each."""
    notes = []
    if at_rest:
        notes.append("body at rest: yaw aligned by attitude; SE(3), scale and relative errors left out")
    placeholders = int(np.logical_and.accumulate(_is_identity(estimate)).sum())
    if placeholders:
        poses = "pose of the estimate is" if placeholders == 1 else f"{placeholders} poses of the estimate are"
        notes.append(f"the first {poses} the identity: written before initialisation?")
    E = aligned.R_WB @ truth.R_WB.transpose(0, 2, 1)
    in_body = so3.project((truth.R_WB.transpose(0, 2, 1) @ aligned.R_WB).mean(axis=0))
    offset = float(np.degrees(np.linalg.norm(so3.log(in_body))))
    if offset > _SUSPICIOUS_ANGLE_DEG:
        notes.append(
            f"the estimate's body is turned by {offset:.0f} deg: not the IMU's frame, or quaternions not in x y z w?"
        )
    elif abs(float(np.degrees(yaw_of(E.mean(axis=0))))) > _SUSPICIOUS_ANGLE_DEG:
        notes.append("attitude and path disagree about the yaw that aligns the estimate")
    return notes


def _is_identity(trajectory: Trajectory) -> NDArray[np.bool_]:
    return np.asarray((np.eye(3) == trajectory.R_WB).all(axis=(1, 2)) & (trajectory.p_WB == 0.0).all(axis=1))
