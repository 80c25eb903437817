"""A run, or somebody's trajectory file, beside its ground truth: what tables and plots are made from."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vioframe.errors import VioframeError
from vioframe.report.map_quality import MapQuality
from vioframe.report.run_folder import RunFolder
from vioframe.trajectory import Trajectory, TrajectoryErrors, evaluate, load_trajectory

_RUN_FIGURES = (
    "dataset",
    "detector",
    "backend",
    "start_s",
    "frames",
    "initialised_after_s",
    "completion",
    "resets",
    "incidents",
    "finished",
)


@dataclass(frozen=True)
class Evaluated:
    """``folder`` is None for a bare trajectory file; ``errors`` where there is no pose or no ground truth.

    ``map_quality`` is there where :func:`~vioframe.report.map_quality.measure_maps` found a world to compare with.
    """

    name: str
    folder: RunFolder | None
    estimate: Trajectory | None
    ground_truth: Trajectory | None
    errors: TrajectoryErrors | None
    map_quality: MapQuality | None = None

    @property
    def summary(self) -> Mapping[str, Any]:
        return self.folder.summary if self.folder else {}

    def stage_ms(self) -> dict[str, float]:
        """Mean milliseconds a frame by stage; the stages add up to the whole."""
        timings = self.folder.timings() if self.folder else None
        return timings.mean_ms() if timings else {}

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for JSON; what is not known is left out."""
        run = {key: self.summary[key] for key in _RUN_FIGURES if key in self.summary}
        errors = {} if self.errors is None else self.errors.to_dict()
        quality = {} if self.map_quality is None else {"map": self.map_quality.to_dict()}
        return {"name": self.name, **run, **errors, **quality, "stage_ms": self.stage_ms()}


def evaluate_path(path: Path, ground_truth: Trajectory | None, alignment: str = "posyaw") -> Evaluated:
    """Evaluate a run folder or a trajectory file; ``ground_truth`` comes before the one that a run folder holds."""
    if path.is_dir():
        folder = RunFolder.open(path)
        name, estimate = folder.name, folder.trajectory()
        ground_truth = ground_truth or folder.ground_truth()
    else:
        folder, name, estimate = None, path.name.split(".")[0], load_trajectory(path)
    errors = None
    if estimate is not None and ground_truth is not None:
        errors = evaluate(estimate, ground_truth, alignment=alignment)
    return Evaluated(name, folder, estimate, ground_truth, errors)


def evaluate_paths(
    paths: Sequence[Path], ground_truth: Path | None = None, alignment: str = "posyaw"
) -> list[Evaluated]:
    """Evaluate each of ``paths`` against ``ground_truth`` or its own; an error notes the path it came from.

    Runs that would share a name are called by their paths.
    """
    truth = None if ground_truth is None else load_trajectory(ground_truth)
    evaluated = []
    for path in paths:
        try:
            evaluated.append(evaluate_path(path, truth, alignment))
        except VioframeError as error:
            error.add_note(f"while evaluating {path}")
            raise
    times = Counter(run.name for run in evaluated)
    return [
        replace(run, name=str(path)) if times[run.name] > 1 else run for path, run in zip(paths, evaluated, strict=True)
    ]
