"""The tasks of a sweep and what a worker does for them: flights, trials, timing of detectors, simulated recordings.

A task comes back as rows of the table of results (:mod:`vioframe.runs.results`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from vioframe import pipeline
from vioframe.bench.detectors.entrants import everyone, line_up, parse_entrants
from vioframe.bench.detectors.speed import pictures, speed_settings, time_detectors
from vioframe.bench.montecarlo import Setup, fly
from vioframe.bench.processes import installed, single_threaded
from vioframe.bench.suites import fingerprints
from vioframe.bench.suites.store import Store
from vioframe.errors import RunError, TrajectoryError
from vioframe.evaluation import TrajectoryErrors
from vioframe.evaluation.consistency import Trial
from vioframe.io.replace import appearing
from vioframe.parts.config import Config, LabelledPart, PartConfig
from vioframe.parts.registry import describe
from vioframe.runs import machine
from vioframe.runs.evaluated import create_metrics, evaluate_paths, measure_runs, write_matched_truth
from vioframe.runs.folder import RunFolder
from vioframe.runs.results import NEES_FILE, RUNS_FOLDER, TASK_FILES
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.record import record
from vioframe.simulation.recording import SimulatedRecording
from vioframe.types import NS_PER_S

Figures = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Recording:
    """A recording to be simulated, called ``name`` in the folder of recordings; ``cost_s`` is estimated."""

    name: str
    config: SimulationConfig
    cost_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """``about`` are the columns of its rows that are known beforehand, the fingerprint among them."""

    about: Mapping[str, Any]
    cost_s: float
    recording: Recording | None = None
    """What must be simulated first."""

    @property
    def name(self) -> str:
        return str(self.about["task"])


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightTask(Task):
    """A detector and a back-end on a data set, whose path is that of ``recording`` where there is one."""

    config: Config
    metrics: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialTask(Task):
    """A back-end on simulated tracks."""

    setup: Setup
    backend: PartConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedTask(Task):
    """All detectors timed in turns, on so many ``images`` of the data set ``frames_of``, or on drawn surfaces."""

    detectors: tuple[LabelledPart, ...]
    rounds: int
    images: int
    frames_of: Path | None


AnyTask = FlightTask | TrialTask | SpeedTask


def perform(task: AnyTask, store: Store, attempt: int) -> list[Figures]:
    """Do ``task``; its run folder appears once it is complete. Raises what the task raises."""
    begin_s = perf_counter()
    if isinstance(task, SpeedTask):
        rows = speed(task)  # on the whole machine
    else:
        with single_threaded(), appearing(store.run_folder(task.name), replace=TASK_FILES) as folder:
            try:
                rows = [_trial(task, folder) if isinstance(task, TrialTask) else _flight(task, store, folder)]
            except OSError as error:
                raise RunError(describe(error)) from error  # its own words, before the folder has others for it
        rows[0]["folder"] = f"{RUNS_FOLDER}/{task.name}"
    done = {"status": "ok", "attempts": attempt, "seconds": perf_counter() - begin_s, "machine": machine.describe()}
    return [{**done, **row} for row in rows]


def failure(attempts: int, error: str) -> Figures:
    """The row of a task that came to nothing."""
    return {"status": "failed", "error": error, "attempts": attempts, "machine": machine.describe()}


def simulate(recording: Recording, store: Store, threads: int) -> None:
    """Make a recording in so many ``threads``, unless it is there already."""
    if not (path := store.recording(recording.name)).exists():
        with single_threaded():
            record(SimulatedRecording(recording.config, installed(), threads), [path])


def code() -> str:
    """The version of the code in this process."""
    return fingerprints.of_code(installed())


def _flight(task: FlightTask, store: Store, folder: Path) -> Figures:
    config = task.config
    if task.recording is not None:
        dataset = config.dataset.model_copy(update={"path": store.recording(task.recording.name)})
        config = config.model_copy(update={"dataset": dataset})
    summary = pipeline.record(pipeline.prepare(config, installed()), folder)
    figures = {**_of_summary(summary), **_of_timings(RunFolder.open(folder))}
    try:
        evaluated = evaluate_paths([folder])
        write_matched_truth(folder)
    except TrajectoryError as error:
        # As where a handful of poses is all there is: the run went through, and there is nothing to measure.
        return figures | {"not_evaluated": " ".join(str(error).split())}
    (last,) = measure_runs(evaluated[-1:], create_metrics(task.metrics, installed()))
    if last.errors is None or last.measured is None:
        return figures
    figures |= {"loop_closed": last.loop_closed, **of_errors(last.errors)}
    for metric, values in last.measured.figures.items():
        figures |= {f"metrics.{metric}.{name}": value for name, value in values.items()}
    return figures | ({"metrics_left_out": dict(last.measured.left_out)} if last.measured.left_out else {})


def _of_summary(summary: Mapping[str, Any]) -> Figures:
    names = ("completion", "resets", "start_s", "initialised_after_s", "frames", "finished")
    figures = {name: summary.get(name) for name in names} | {"frame_ms": summary.get("mean_frame_ms")}
    if {"first_frame_t_ns", "last_frame_t_ns"} <= summary.keys():
        figures["flown_s"] = (summary["last_frame_t_ns"] - summary["first_frame_t_ns"]) / NS_PER_S
    events = summary.get("events") or [{"event": None}]
    return figures | {"last_event": events[-1]["event"]}


def _of_timings(run: RunFolder) -> Figures:
    """Milliseconds a frame by stage, and seconds of flight for a second of computing."""
    if (timings := run.timings()) is None:
        return {}
    stage_ms = timings.mean_ms()
    computing_s = 1e-3 * sum(stage_ms.values()) * len(timings.t_ns)
    figures = {f"stage_ms.{stage}": ms for stage, ms in stage_ms.items()}
    return figures | {"real_time_factor": float(np.ptp(timings.t_ns)) / NS_PER_S / computing_s if computing_s else None}


def of_errors(errors: TrajectoryErrors) -> Figures:
    """The columns of a flight's errors."""
    path_m = errors.truth.path_length_m
    figures: Figures = {key: getattr(errors, key) for key in ("ate_se3_m", "scale", "coverage")}
    figures |= {key: getattr(errors, key).rmse for key in ("ate_m", "orientation_deg", "yaw_deg")}
    figures |= {"path_length_m": path_m, "ate_percent": 100.0 * errors.ate_m.rmse / path_m if path_m > 0.0 else None}
    figures |= {f"nees.{each.part}": each.mean for each in errors.nees}
    for length, relative in errors.relative.items():
        figures[f"relative.{length:g}m.translation_percent"] = float(np.mean(relative.translation_percent))
        figures[f"relative.{length:g}m.yaw_deg"] = float(np.mean(relative.yaw_deg))
    return figures


def _trial(task: TrialTask, folder: Path) -> Figures:
    trial = fly_trial(task)
    folder.mkdir()
    if len(trial.t_ns):
        trial.nees_over_time().to_csv(folder / NEES_FILE, index=False, lineterminator="\n")
    return trial.to_dict()


def fly_trial(task: TrialTask) -> Trial:
    """One trial of a Monte Carlo."""
    return fly(task.setup, task.backend, task.about["seed"])


def speed(task: SpeedTask) -> list[Figures]:
    """Frames a second, a row a detector; those that lack something are absent, with the reason as their error."""
    entrants = task.detectors or parse_entrants(everyone(installed(), "speed"), (), installed())
    lined_up = line_up(entrants, installed())
    recording = None if task.frames_of is None else installed().open_dataset(task.frames_of)
    images = pictures(task.images, drawn=recording is None, recording=recording)
    settings = speed_settings(task.rounds)
    settings["width"], settings["height"] = settings.pop("resolution")
    timed: list[Any] = time_detectors(lined_up.ready, images, task.rounds).astype(object).to_dict("records")
    absent = [{"detector": name, "status": "absent", "error": why} for name, why in lined_up.absent.items()]
    return [*({**row, **settings} for row in timed), *absent]
