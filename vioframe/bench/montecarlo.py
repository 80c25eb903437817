"""Monte Carlo: back-ends on many simulated flights that differ by their noise alone, each trial with its own seed.

A trial starts as a real flight does, with the back-end's own initialisation. Nothing is left out: a trial that never
initialises, diverges or crashes is kept and says so. What the NEES of many trials tells: ``docs/montecarlo.md``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydantic import Field

from vioframe.bench.processes import installed
from vioframe.bench.run import BackendRun, backend_row, run_backend
from vioframe.errors import TrajectoryError
from vioframe.estimation.options import EstimationOptions
from vioframe.evaluation.alignment import align_first
from vioframe.evaluation.consistency import PARTS, Trial
from vioframe.evaluation.nees import nees
from vioframe.geometry.trajectory import Trajectory
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import registry
from vioframe.parts.config import PartConfig, Section
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.simulation.config import RIGS, RigName
from vioframe.types import Float, Int

SHORTEST_S = 10.0
"""A shorter flight is over before it tells anything: initialisation alone takes one to four seconds of motion."""

# An estimate this far from the truth is no longer one of the flight, whatever it says of itself.
_DIVERGED_FRACTION, _DIVERGED_M, _DIVERGED_DEG = 0.05, 0.5, 15.0


class Setup(Section):
    """What every trial flies through: an installed flight, EuRoC's cameras and IMU noise, and what is tracked.

    ``rig`` is one of :data:`~vioframe.simulation.config.RIGS`; ``pixel_sigma`` px is the noise of an observation,
    ``outlier_ratio`` the chance that one is 5 to 30 px off.
    """

    flight: str = "figure_eight"
    duration_s: float = Field(default=60.0, ge=SHORTEST_S, allow_inf_nan=False)
    pixel_sigma: float = Field(default=1.0, ge=0.0, allow_inf_nan=False)
    outlier_ratio: float = Field(default=0.0, ge=0.0, lt=1.0)
    max_points: int = Field(default=150, ge=1)
    rig: RigName = "mono"

    def sequence(self, seed: int) -> TrackSequence:
        """The flight with the noise of ``seed``."""
        calibration = packaged_calibration("euroc", cameras=RIGS[self.rig])
        sensors = self.model_dump(exclude={"flight", "rig"})
        return simulated_sequence(self.flight, seed=seed, calibration=calibration, **sensors)


def fly(setup: Setup, part: PartConfig, seed: int) -> Trial:
    """One trial of the back-end ``part`` on one core.

    What the back-end raises is a failure of the trial, not of the campaign.
    """
    from threadpoolctl import threadpool_limits

    sequence = setup.sequence(seed)
    backend = installed().create_backend(part.name, part.options)
    # Small matrices; and sums in another order would be other results.
    with threadpool_limits(1):
        try:
            run = run_backend(sequence, backend, EstimationOptions())
        except Exception as error:
            if isinstance(error.__cause__, KeyboardInterrupt):
                raise KeyboardInterrupt from error  # Ctrl-C within compiled code
            return Trial(seed, "crashed", registry.describe(error))
        return judge(sequence, run, seed)


def judge(sequence: TrackSequence, run: BackendRun, seed: int) -> Trial:
    """What ``run`` amounts to against the truth of ``sequence``."""
    events = [event for estimate in run.estimates for event in estimate.events]
    if not run.states:
        return Trial(seed, "never initialised", events[-1] if events else "")
    try:
        row = backend_row(sequence, run)
        stamps, values = nees_by_stretch(run, sequence.ground_truth)
        t_ns = stamps - run.t_ns[0]
    except (TrajectoryError, np.linalg.LinAlgError) as error:
        return Trial(seed, "diverged", str(error))
    figures = {k: v for k, v in row.items() if k not in ("sequence", "nees", "stage_ms")}
    figures["judged"] = len(t_ns) / len(run.states)
    too_far = row["ate_m"] > max(_DIVERGED_M, _DIVERGED_FRACTION * row["path_m"])
    if too_far or row["orientation_deg"] > _DIVERGED_DEG:
        detail = f"ends with {row['ate_m']:.3g} m and {row['orientation_deg']:.3g} deg RMSE"
        return Trial(seed, "diverged", detail, figures, t_ns, values)
    lost = [event for event in events if event.startswith("lost")]
    return Trial(seed, None, "; ".join(lost), figures, t_ns, values)


def nees_by_stretch(run: BackendRun, truth: Trajectory) -> tuple[Int, Mapping[str, Float]]:
    """Stamps (N,) ns and NEES (N,) by part of the pose, each stretch of tracking in the gauge of its own first pose.

    A filter counts its uncertainty of position and yaw from where it began, and begins anew where it was lost.
    """
    against = [(piece, truth.at(piece.t_ns)) for piece in run.stretches]
    found = [nees(align_first(piece, true).apply(piece), true) for piece, true in against]
    pieces = [each for each in found if each]
    t_ns = np.concatenate([[], *(each[0].t_ns for each in pieces)]).astype(np.int64)
    return t_ns, {
        part: np.concatenate([[], *(n.values for each in pieces for n in each if n.part == part)]) for part in PARTS
    }
