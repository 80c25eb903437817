"""An estimate beside the truth: what a metric looks at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from vioframe.evaluation.evaluation import TrajectoryErrors, evaluate
from vioframe.geometry.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Comparison:
    """``estimate`` in its own world and ``ground_truth`` at its own rate, both whole and as they are; ``errors`` of the
    poses that belong together, aligned by position and yaw, the gauge that a visual-inertial system leaves open.
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
