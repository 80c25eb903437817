"""What a suite means on the data at hand: every task there is, and the recordings that must be simulated for them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from vioframe.bench.montecarlo import Setup
from vioframe.bench.suites import sources
from vioframe.bench.suites.code import code_version
from vioframe.bench.suites.sources import Flown
from vioframe.bench.suites.suite import SEED_SHIFT_S, BackendContender, Contender, Suite, montecarlo_setup
from vioframe.errors import ConfigError, DatasetError
from vioframe.estimation.lifecycle import warm_up
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import config as configuration
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.parts.registry import BACKEND, DETECTOR, Registry
from vioframe.report.suite.results import Data, Kind, Labels
from vioframe.runs.metrics import create_metrics
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.flights import flight as named_flight

CLEAR = "clear"

# About how long things take on one core, for the time that is left: a frame to render, to fly, and a second of a trial.
_RENDER_S, _FLY_S, _TRIAL_S = 0.2, 0.02, 0.35


@dataclass(frozen=True, slots=True)
class RecordingJob:
    """A recording to be simulated, at ``name`` in the folder of recordings."""

    name: str
    config: SimulationConfig
    cost_s: float


@dataclass(frozen=True, slots=True)
class Job:
    """A task. ``fingerprint`` says what its result depends on: code, config and data."""

    key: str
    kind: Kind
    labels: Labels | None
    data: Data | None
    note: str
    fingerprint: Mapping[str, str]
    cost_s: float


@dataclass(frozen=True, slots=True)
class FlightJob(Job):
    """A flight; its data set's path is that of ``recording`` where there is one."""

    config: Config
    recording: RecordingJob | None
    metrics: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TrialJob(Job):
    """A back-end on simulated tracks."""

    setup: Setup
    contender: PartConfig
    seed: int


@dataclass(frozen=True, slots=True)
class SpeedJob(Job):
    """All detectors timed in turns, on so many ``images`` of ``recording``, or on drawn surfaces."""

    detectors: tuple[Contender, ...]
    rounds: int
    images: int
    recording: Path | None


AnyJob = FlightJob | TrialJob | SpeedJob


@dataclass(frozen=True, slots=True)
class Plan:
    """All tasks of ``suite``."""

    suite: Suite
    jobs: tuple[AnyJob, ...]


def plan(suite: Suite, folders: Sequence[Path], installed: Registry) -> Plan:
    """Raises :class:`vioframe.errors.VioframeError` for all that can be told before the first task."""
    jobs: Iterable[AnyJob]
    if suite.kind == "flights":
        _create(suite, installed)
        jobs = _flights(suite, folders, installed)
    elif suite.kind == "trials":
        _create(suite, installed)
        jobs = _trials(suite, installed)
    else:
        jobs = [_speed(suite, folders, installed)]
    by_key: dict[str, AnyJob] = {}
    for job in jobs:
        if by_key.setdefault(job.key, job) is not job:
            raise ConfigError(f"two tasks of {suite.name} would be called {job.key}; give their parts other labels")
    return Plan(suite, tuple(by_key.values()))


def _create(suite: Suite, installed: Registry) -> None:
    """Make every part once: what is missing is said now, and kernels are compiled before the workers all would."""
    calibration = packaged_calibration("euroc")
    for detector in suite.detectors:
        installed.create_detector(detector.name, detector.options)
    for backend in suite.backends:
        warm_up(installed.create_backend(backend.name, backend.options), calibration)
        if backend.loop_closure is not None:
            closer = backend.loop_closure
            installed.create_loop_closer(closer.name, calibration, closer.options)


def _flights(suite: Suite, folders: Sequence[Path], installed: Registry) -> Iterator[FlightJob]:
    code = code_version(installed)
    conditions = [(CLEAR, 0.0)] if suite.clear else []
    conditions += [(name, level) for name, levels in suite.conditions.items() for level in levels]
    found = {each.name: sources.find_source(each.name, folders, installed) for each in suite.sequences}
    create_metrics(suite.metrics, installed)  # says what is wrong with one before anything is flown
    for sequence, (condition, level), seed in product(suite.sequences, conditions, range(suite.seeds)):
        shift_s = SEED_SHIFT_S * seed if suite.seeds_vary == "start" else 0.0
        flown = sources.flown(
            found[sequence.name],
            start_s=sequence.start_s,
            # Whichever seed comes last, there is enough of it for all.
            duration_s=None if sequence.duration_s is None else sequence.duration_s + SEED_SHIFT_S * (suite.seeds - 1),
            conditions={condition: level} if level else {},
            seed=seed if suite.seeds_vary == "recording" else 0,
            installed=installed,
        )
        if flown.simulated is None and suite.seeds_vary == "recording":
            shift_s = SEED_SHIFT_S * seed  # what was recorded stays as it is
        data = sources.fingerprint(flown)
        recording = None if flown.simulated is None else _recording(sequence.name, flown.simulated, data, code)
        seconds = sequence.duration_s or (flown.simulated.duration_s if flown.simulated else None) or 100.0
        for detector, backend in product(suite.detectors, suite.backends):
            config = _config(suite, detector, backend, flown, shift_s, sequence.duration_s, installed)
            labels = Labels(sequence.name, condition, level, detector.called, backend.called, seed)
            yield FlightJob(
                _key(labels),
                Kind.FLIGHT,
                labels,
                flown.data,
                flown.note,
                {"code": code, "config": _config_digest(config, suite.metrics), "data": data},
                _FLY_S * 20.0 * seconds,
                config,
                recording,
                suite.metrics,
            )


def _config(
    suite: Suite,
    detector: Contender,
    backend: BackendContender,
    flown: Flown,
    shift_s: float,
    duration_s: float | None,
    installed: Registry,
) -> Config:
    config = Config(
        dataset=DatasetConfig(path=flown.recording),
        detector=PartConfig(name=detector.name, options=detector.options),
        backend=PartConfig(name=backend.name, options=backend.options),
        loop_closure=backend.loop_closure,
        frontend=suite.frontend,
        ground_truth=flown.ground_truth,
        start_s=flown.start_s + shift_s,
        duration_s=duration_s,
    )
    return configuration.complete(config, installed)


def _recording(sequence: str, config: SimulationConfig, data: str, code: str) -> RecordingJob:
    frames = config.frame_rate_hz * (config.duration_s or 100.0)
    # A blurred frame is the mean of many.
    effort = 1.0 + 8.0 * max(config.conditions.get(name, 0.0) for name in ("motion_blur", "rolling_shutter"))
    name = f"{sequence}.{_digest(data, code)}.bag"
    return RecordingJob(name, config, _RENDER_S * effort * frames)


def _trials(suite: Suite, installed: Registry) -> Iterator[TrialJob]:
    code, setup = code_version(installed), montecarlo_setup(suite)
    named_flight(
        setup.flight, setup.duration_s, packaged_calibration("euroc").cameras[0].R_BC
    )  # says so where there is none
    for backend, seed in product(suite.backends, range(suite.seeds)):
        options = installed.find(BACKEND, backend.name).validate(backend.options)
        labels = Labels(setup.flight, CLEAR, 0.0, "simulated tracks", backend.called, seed)
        yield TrialJob(
            _key(labels),
            Kind.TRIAL,
            labels,
            Data.SIMULATED,
            f"simulated tracks of the flight {setup.flight}, {setup.pixel_sigma:g} px noise; no images",
            {"code": code, "config": _digest(backend.name, options), "data": _digest(suite.setup, seed)},
            _TRIAL_S * setup.duration_s,
            setup,
            PartConfig(name=backend.name, options=options),
            seed,
        )


def _speed(suite: Suite, folders: Sequence[Path], installed: Registry) -> SpeedJob:
    for detector in suite.detectors:
        installed.find(DETECTOR, detector.name).validate(detector.options)
    about = [each.model_dump() for each in suite.detectors]
    found = [sources.find_source(each.name, folders, installed) for each in suite.sequences] if folders else []
    source = next((each for each in found if each.recording is not None), None)
    if folders and source is None:
        names = ", ".join(each.name for each in suite.sequences) or "no sequence"
        raise DatasetError(f"--data holds no images of {names}; leave it out to time detectors on drawn surfaces")
    images = "drawn surfaces" if source is None else f"frames of {source.name}"
    data = "drawn" if source is None or source.recording is None else sources.fingerprint_of([source.recording])
    return SpeedJob(
        "detector_speed",
        Kind.DETECTOR_SPEED,
        None,
        None if source is None else source.kind,
        f"{images}, 640 x 480, 300 keypoints, one image at a time",
        {"code": code_version(installed), "config": _digest(about, suite.rounds, suite.images), "data": data},
        60.0,
        suite.detectors,
        suite.rounds,
        suite.images,
        None if source is None else source.recording,
    )


def _key(labels: Labels) -> str:
    """A name that says what it is and can be a folder's."""
    condition = labels.condition if not labels.level else f"{labels.condition}_{labels.level:g}"
    parts = [labels.sequence, condition, labels.detector, labels.backend, f"seed{labels.seed}"]
    return ".".join("".join(c if c.isalnum() or c in "_-+" else "_" for c in part.replace(" ", "_")) for part in parts)


def _config_digest(config: Config, metrics: Sequence[str]) -> str:
    """Of all that a run depends on but its data, wherever that lies."""
    plain = config.model_copy(update={"dataset": at(config.dataset, None), "ground_truth": None})
    return _digest(plain.model_dump(mode="json"), list(metrics))


def at(dataset: DatasetConfig, path: Path | None) -> DatasetConfig:
    """``dataset`` at another place."""
    return dataset.model_copy(update={"path": path})


def _digest(*values: Any) -> str:
    """Tells values from other values."""
    return hashlib.sha256(json.dumps(values, sort_keys=True, default=str).encode()).hexdigest()[:16]
