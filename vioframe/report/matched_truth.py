"""The true pose at every stamp that was estimated, for tools that only pair equal stamps, such as evo."""

from __future__ import annotations

from pathlib import Path

from vioframe.evaluation import associate
from vioframe.io.trajectories import write_tum
from vioframe.report.suite.results import MATCHED_TRUTH
from vioframe.runs.folder import RunFolder


def write_matched_truth(run_folder: str | Path) -> Path | None:
    """Write ``ground_truth_matched.tum`` beside the trajectory of a run; None where there is nothing to pair.

    The pairing is that of :func:`vioframe.evaluation.evaluate`, so that whoever aligns ``trajectory.tum`` with it by
    SE(3) finds ``ate_se3_m``. Raises :class:`RunError` or :class:`TrajectoryError` as reading the run does.
    """
    run = RunFolder.open(run_folder)
    estimate, truth = run.trajectory(), run.ground_truth()
    if estimate is None or truth is None:
        return None
    path = run.path / MATCHED_TRUTH
    write_tum(associate(estimate, truth)[1], path)
    return path
