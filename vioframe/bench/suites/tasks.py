"""What a worker does: a flight, a trial, the timing of detectors, or the simulation of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vioframe import experiment
from vioframe.bench.montecarlo import fly
from vioframe.bench.processes import installed, single_threaded
from vioframe.bench.suites.code import code_version
from vioframe.bench.suites.plan import AnyJob, FlightJob, RecordingJob, SpeedJob, TrialJob, at
from vioframe.bench.suites.store import Store
from vioframe.errors import TrajectoryError
from vioframe.evaluation import Comparison
from vioframe.report.suite.results import RUN_FOLDER
from vioframe.runs.evaluated import Evaluated, evaluate_path, with_loop_closure, write_matched_truth
from vioframe.runs.folder import RunFolder
from vioframe.runs.metrics import create_metrics, measure
from vioframe.simulation.record import record
from vioframe.simulation.recording import SimulatedRecording
from vioframe.types import NS_PER_S

Figures = Mapping[str, Any]


def perform(store: Store, job: AnyJob, attempts: int) -> None:
    """Do ``job`` on one core, and keep what comes of it; raises what it raises."""
    with single_threaded():
        store.keep(job, attempts, lambda folder: _do(job, store, folder))


def simulate(store: Store, job: RecordingJob, workers: int) -> None:
    """Make a recording by ``workers`` processes, unless it is there already."""
    path = store.recording(job)
    if path.exists():
        return
    with single_threaded():
        record(SimulatedRecording(job.config, installed(), workers), [path])


def code() -> str:
    """The version of the code in this process."""
    return code_version(installed())


def _do(job: AnyJob, store: Store, folder: Path) -> Figures:
    if isinstance(job, FlightJob):
        return _flight(job, store, folder)
    if isinstance(job, TrialJob):
        return _trial(job)
    return speed(job)


def _flight(job: FlightJob, store: Store, folder: Path) -> Figures:
    config = job.config
    if job.recording is not None:
        config = config.model_copy(update={"dataset": at(config.dataset, store.recording(job.recording))})
    run = folder / RUN_FOLDER
    summary = experiment.record(experiment.prepare(config, installed()), run)
    figures: dict[str, Any] = {"summary": summary, "evaluation": None, "evaluation_loop": None, "metrics": {}}
    figures |= _timing(run)
    try:
        evaluated = evaluate_path(run, None)
        closed = with_loop_closure(evaluated)
        write_matched_truth(run)
    except TrajectoryError as error:
        # As where a handful of poses is all there is: the run went through, and there is nothing to measure.
        return figures | {"not_evaluated": " ".join(str(error).split())}
    figures["evaluation"] = _errors(evaluated)
    figures["evaluation_loop"] = _errors(closed)
    last = closed or evaluated
    if last.estimate is not None and last.ground_truth is not None and last.errors is not None:
        asked = create_metrics(job.metrics, installed())
        comparison = Comparison(last.estimate, last.ground_truth, last.errors)
        figures |= measure(asked, comparison).to_dict()
    return figures


def _errors(run: Evaluated | None) -> Figures | None:
    return None if run is None or run.errors is None else run.errors.to_dict()


def _timing(run: Path) -> Figures:
    """Milliseconds a frame by stage, and seconds of flight for a second of computing."""
    timings = RunFolder.open(run).timings()
    if timings is None:
        return {"stage_ms": {}, "real_time_factor": None}
    stage_ms = timings.mean_ms()
    seconds = float(timings.t_ns[-1] - timings.t_ns[0]) / NS_PER_S
    computing = 1e-3 * sum(stage_ms.values()) * len(timings.t_ns)
    return {"stage_ms": stage_ms, "real_time_factor": seconds / computing if computing else None}


def _trial(job: TrialJob) -> Figures:
    trial = fly(job.setup, job.contender, job.seed)
    t_s = trial.t_ns / NS_PER_S
    return {"trial": trial.to_dict(), "t_s": t_s.tolist(), "nees": {k: v.tolist() for k, v in trial.nees.items()}}


def speed(job: SpeedJob) -> Figures:
    """Frames a second of each detector; those that lack something are absent, with the reason."""
    from vioframe.bench.detectors.entrants import Entrant, everyone, line_up, parse_entrants
    from vioframe.bench.detectors.images import fit, frames_of, procedural_images
    from vioframe.bench.detectors.speed import RESOLUTION, speed_settings, time_detectors

    entrants = [Entrant(each.called, each.name, each.options) for each in job.detectors]
    if not entrants:
        entrants = parse_entrants(everyone(installed(), "speed"), (), installed())
    lined_up = line_up(entrants, installed())
    if job.recording is None:
        images, source = procedural_images(job.images, RESOLUTION, 0), "drawn surfaces"
    else:
        taken = frames_of(installed().open_dataset(job.recording), job.images)
        images = [fit(image, RESOLUTION) for _, frames in taken if (image := frames.images[0]) is not None]
        source = f"frames of {job.recording.stem}"
    rows = time_detectors(lined_up.ready, images, job.rounds)
    settings = speed_settings(source, len(images), job.rounds)
    return {"rows": rows, "absent": dict(lined_up.absent), "settings": settings}
