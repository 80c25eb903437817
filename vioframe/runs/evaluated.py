"""A run, or somebody's trajectory file, beside its ground truth: what tables and plots are made from.

Metrics are plug-ins; what they say of a run is part of its evaluation::

    metrics = create_metrics(["ate", "band:half_width_m=0.1"], registry.load())
    measured = measure(metrics, Comparison.of(estimate, ground_truth))
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from vioframe.errors import PluginError, RunError, TrajectoryError, VioframeError
from vioframe.evaluation import Comparison, TrajectoryErrors, associate, evaluate
from vioframe.evaluation.landmarks import Landmarks, MapQuality, belonging
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Metric
from vioframe.io.trajectories import load_trajectory, write_tum
from vioframe.parts.config import parse_part
from vioframe.parts.registry import METRIC, Part, Registry, describe
from vioframe.runs.folder import RunFolder
from vioframe.runs.recorder import write_ply
from vioframe.types import NS_PER_S, Int

MATCHED_TRUTH = "ground_truth_matched.tum"
"""The true pose at every stamp that was estimated, for tools that only pair equal stamps, such as evo."""

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
# A line is not drawn over a time in which nothing was estimated.
_GAP_NS = NS_PER_S


@dataclass(frozen=True, slots=True)
class AskedMetric:
    """A metric ready for use; ``label`` is what it was asked for with, name and options."""

    label: str
    part: Part
    metric: Metric


@dataclass(frozen=True, slots=True)
class Measured:
    """``figures`` by metric and name; ``left_out`` says in a line why a metric has none. Both by label, as asked."""

    figures: Mapping[str, Mapping[str, float]]
    left_out: Mapping[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        out: dict[str, Any] = {"metrics": {label: dict(figures) for label, figures in self.figures.items()}}
        return {**out, "metrics_left_out": dict(self.left_out)} if self.left_out else out


@dataclass(frozen=True)
class Evaluated:
    """``folder`` is None for a bare trajectory file; ``errors`` where there is no pose or no ground truth.

    ``map_quality`` is there where :func:`~vioframe.report.map_quality.measure_maps` found a world to compare with,
    ``measured`` where :func:`measure_runs` was asked for metrics.
    ``segment_starts_ns`` are the stamps at which tracking began again after a reset. What loop closure made of a run is
    an evaluation of its own, ``loop_closed`` and without a folder. ``kept_in`` is the file of the run folder that an
    evaluation belongs in.
    """

    name: str
    folder: RunFolder | None
    estimate: Trajectory | None
    ground_truth: Trajectory | None
    errors: TrajectoryErrors | None = None
    map_quality: MapQuality | None = None
    measured: Measured | None = None
    segment_starts_ns: tuple[int, ...] = ()
    kept_in: Path | None = None
    loop_closed: bool = False

    @property
    def summary(self) -> Mapping[str, Any]:
        return self.folder.summary if self.folder else {}

    @property
    def aligned(self) -> Trajectory | None:
        """The whole estimate, also where the ground truth does not reach, in its world where there is one."""
        return self.errors.alignment.apply(self.estimate) if self.errors and self.estimate else self.estimate

    def landmarks(self) -> Landmarks | None:
        """The landmarks in the same world, without those that stand alone; None where there are none."""
        landmarks = self.folder.landmarks() if self.folder else None
        if landmarks is None or not len(landmarks):
            return None
        kept = landmarks.select(belonging(landmarks.p_WF))
        return kept.moved(self.errors.alignment) if self.errors else kept

    def breaks(self, t_ns: Int) -> Int:
        """Indices into the ascending stamps (N,) of poses that a line must not lead to: they begin a stretch anew."""
        after_gap = np.flatnonzero(np.diff(t_ns) > _GAP_NS) + 1
        after_reset = np.searchsorted(t_ns, np.array(self.segment_starts_ns, np.int64))
        every = np.union1d(after_gap, after_reset)
        return np.asarray(every[(every > 0) & (every < len(t_ns))])

    def errors_by_stretch(self) -> Iterator[TrajectoryErrors]:
        """Errors of each stretch between resets in the gauge of its own first pose, in which a filter's covariance is
        meant; those of stretches without ground truth are left out."""
        if self.estimate is None or self.ground_truth is None:
            return
        starts = np.searchsorted(self.estimate.t_ns, np.array(self.segment_starts_ns, np.int64))
        for first, last in pairwise([0, *starts.tolist(), len(self.estimate)]):
            with suppress(VioframeError):
                yield evaluate(self.estimate.select(slice(first, last)), self.ground_truth, alignment="first")

    def stage_ms(self) -> dict[str, float]:
        """Mean milliseconds a frame by stage; the stages add up to the whole."""
        timings = self.folder.timings() if self.folder else None
        return timings.mean_ms() if timings else {}

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for JSON; what is not known is left out."""
        run = {key: self.summary[key] for key in _RUN_FIGURES if key in self.summary}
        errors = {} if self.errors is None else self.errors.to_dict()
        quality = {} if self.map_quality is None else {"map": self.map_quality.to_dict()}
        measured = {} if self.measured is None else self.measured.to_dict()
        return {"name": self.name, **run, **errors, **quality, **measured, "stage_ms": self.stage_ms()}


def evaluate_paths(
    paths: Sequence[Path], ground_truth: Path | None = None, alignment: str = "posyaw"
) -> list[Evaluated]:
    """Evaluate run folders and trajectory files against ``ground_truth`` or their own; errors note whose they are.

    A run with loop closure is followed by what that made of it, unless no loop was accepted: it is the same trajectory
    then. Runs that would share a name are called by their paths.
    """
    truth = None if ground_truth is None else load_trajectory(ground_truth)
    names = [path.resolve().name if path.is_dir() else path.name.split(".")[0] for path in paths]
    evaluated: list[Evaluated] = []
    for path, name in zip(paths, names, strict=True):
        try:
            evaluated += _evaluate(path, name if names.count(name) == 1 else str(path), truth, alignment)
        except VioframeError as error:
            error.add_note(f"while evaluating {path}")
            raise
    return evaluated


def _evaluate(path: Path, name: str, truth: Trajectory | None, alignment: str) -> Iterator[Evaluated]:
    """One run or trajectory file, and what loop closure made of it, if any."""
    if not path.is_dir():
        yield _compared(Evaluated(name, None, load_trajectory(path), truth), alignment)
        return
    folder = RunFolder.open(path)
    run = Evaluated(
        name,
        folder,
        folder.trajectory(),
        truth or folder.ground_truth(),
        segment_starts_ns=folder.segment_starts_ns(),
        kept_in=path / "evaluation.json",
    )
    yield _compared(run, alignment)
    corrected = folder.loop_closed()
    if corrected is not None and run.summary.get("loop_closure", {}).get("loops", 1):
        closed = replace(
            run,
            name=f"{name} with loop closure",
            folder=None,
            estimate=corrected,
            kept_in=path / "evaluation_loop.json",
            loop_closed=True,
        )
        yield _compared(closed, alignment)


def _compared(run: Evaluated, alignment: str) -> Evaluated:
    if run.estimate is None or run.ground_truth is None:
        return run
    return replace(run, errors=evaluate(run.estimate, run.ground_truth, alignment=alignment))


def write_matched_truth(run_folder: str | Path) -> Path | None:
    """Write :data:`MATCHED_TRUTH` beside the trajectory of a run; None where there is nothing to pair.

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


def create_metrics(specs: Sequence[str], installed: Registry) -> tuple[AskedMetric, ...]:
    """A metric for each of ``specs``, ``NAME`` or ``NAME:KEY=VALUE,...``; a repeated one counts once.

    Raises :class:`PluginError` or :class:`ConfigError` where one is unknown, lacks what it needs or has a wrong option.
    """
    asked = []
    for spec in dict.fromkeys(specs):
        named = parse_part(spec, METRIC, installed)
        part = installed.find(METRIC, named.name)
        asked.append(AskedMetric(spec, part, part.create(options=named.options)))
    return tuple(asked)


def measure(metrics: Sequence[AskedMetric], comparison: Comparison) -> Measured:
    """What each of ``metrics`` says; one that cannot tell leaves the others alone.

    Raises :class:`PluginError` naming the plug-in where one fails or returns something else than finite figures.
    """
    figures: dict[str, Mapping[str, float]] = {}
    left_out: dict[str, str] = {}
    for asked in metrics:
        try:
            figures[asked.label] = _checked(asked.part, asked.metric.measure(comparison))
        except TrajectoryError as error:
            left_out[asked.label] = " ".join(str(error).split())
        except VioframeError:
            raise
        except Exception as error:
            raise PluginError(f"{asked.part} failed: {describe(error)}; leave it out or repair it") from error
    return Measured(figures, left_out)


def _checked(part: Part, figures: Any) -> dict[str, float]:
    if not isinstance(figures, Mapping):
        raise PluginError(f"{part} returned a {type(figures).__name__}, not figures by name")
    for name, value in figures.items():
        if not isinstance(name, str) or not isinstance(value, Real) or not math.isfinite(value):
            raise PluginError(f"{part} returned {name!r}: {value!r}; a figure is a finite number by name")
    return {name: float(value) for name, value in figures.items()}


def measure_runs(runs: Sequence[Evaluated], metrics: Sequence[AskedMetric]) -> list[Evaluated]:
    """``runs`` with what ``metrics`` say about those that have both an estimate and the truth.

    However a run was aligned for its table, metrics get it aligned by position and yaw, so that one and the same figure
    never means two things.
    """
    return [replace(run, measured=measure(metrics, found)) if (found := _comparison(run)) else run for run in runs]


def _comparison(run: Evaluated) -> Comparison | None:
    if run.estimate is None or run.ground_truth is None or run.errors is None:
        return None
    if run.errors.alignment_name == "posyaw":
        return Comparison(run.estimate, run.ground_truth, run.errors)
    return Comparison.of(run.estimate, run.ground_truth)


def export_map(run: Evaluated, path: Path) -> int:
    """Write :meth:`Evaluated.landmarks` to a PLY file as ``map.ply`` is one, and return their number.

    Raises :class:`RunError` where the run has no landmarks or the file cannot be written.
    """
    landmarks = run.landmarks()
    if landmarks is None:
        raise RunError(f"{run.name} has no landmarks: only a run folder whose map.ply holds some has a map to write")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_ply(path, landmarks)
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another name") from error
    return len(landmarks)
