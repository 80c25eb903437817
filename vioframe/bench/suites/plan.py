"""What a suite means on the data at hand: every task there is, and the recordings that must be simulated for them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

from vioframe.bench.suites import fingerprints, sources
from vioframe.bench.suites.suite import SEED_SHIFT_S, Suite
from vioframe.bench.suites.tasks import AnyTask, FlightTask, Recording, SpeedTask, TrialTask
from vioframe.errors import ConfigError, DatasetError
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import config as configuration
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.parts.registry import BACKEND, DETECTOR, Registry
from vioframe.runs.evaluated import create_metrics
from vioframe.runs.results import CELL, CLEAR, Data
from vioframe.simulation.config import RIGS, RigName, SimulationConfig
from vioframe.simulation.flights import flight as named_flight
from vioframe.simulation.seeds import seed_for
from vioframe.warming import warm_up

# About how long things take on one core, for the time that is left: a frame to render, to fly, and a second of a trial.
_RENDER_S, _FLY_S, _TRIAL_S = 0.2, 0.02, 0.35


def plan(suite: Suite, folders: Sequence[Path], installed: Registry) -> tuple[AnyTask, ...]:
    """All tasks of ``suite``.

    Raises :class:`vioframe.errors.VioframeError` for all that can be told before the first of them.
    """
    tasks: Iterable[AnyTask]
    if suite.kind == "detector_speed":
        tasks = [_speed(suite, folders, installed)]
    else:
        _create(suite, installed)
        tasks = _flights(suite, folders, installed) if suite.kind == "flights" else _trials(suite, installed)
    by_name: dict[str, AnyTask] = {}
    for task in tasks:
        if by_name.setdefault(task.name, task) is not task:
            raise ConfigError(f"two tasks of {suite.name} would be called {task.name}; give their parts other labels")
    return tuple(by_name.values())


def _create(suite: Suite, installed: Registry) -> None:
    """Make every part once: what is missing is said now, and kernels are compiled before the workers all would."""
    calibration = packaged_calibration("euroc", cameras=["cam0"])
    for detector in suite.detectors:
        installed.create_detector(detector.name, detector.options)
    for backend in suite.backends:
        made = installed.create_backend(backend.name, backend.options)
        with suppress(Exception):  # what it raises in flight is said by its tasks
            warm_up(made, calibration)
        if (closer := backend.loop_closure) is not None:
            installed.create_loop_closer(closer.name, calibration, closer.options)


def _flights(suite: Suite, folders: Sequence[Path], installed: Registry) -> Iterator[FlightTask]:
    code = fingerprints.of_code(installed)
    conditions = [(CLEAR, 0.0)] if suite.clear else []
    conditions += [(name, level) for name, levels in suite.conditions.items() for level in levels]
    rig: RigName = "stereo" if any(backend.rig == "stereo" for backend in suite.backends) else "mono"
    # Of a recording that all seeds share there is enough for the one that starts last.
    shift_s = SEED_SHIFT_S * (suite.seeds - 1) if suite.seeds_vary == "start" else 0.0
    found = {each.name: sources.find_source(each.name, folders, installed) for each in suite.sequences}
    create_metrics(suite.metrics, installed)  # says what is wrong with one before anything is flown
    for sequence, (condition, level), seed in product(suite.sequences, conditions, range(suite.seeds)):
        flown = sources.flown(
            found[sequence.name],
            start_s=sequence.start_s,
            duration_s=None if sequence.duration_s is None else sequence.duration_s + shift_s,
            conditions={condition: level} if level else {},
            rig=rig,
            seed=seed_for(suite.worlds, seed if suite.seeds_vary == "recording" else 0),
            installed=installed,
        )
        # What was recorded stays as it is, so that it can only be started later.
        later = suite.seeds_vary == "start" or flown.simulated is None
        recording = None if flown.simulated is None else _recording(sequence.name, flown.simulated, flown.digest, code)
        seconds = sequence.duration_s or (flown.simulated.duration_s if flown.simulated else None) or 100.0
        for detector, backend in product(suite.detectors, suite.backends):
            config = Config(
                dataset=DatasetConfig(path=flown.recording, options={"cameras": list(RIGS[backend.rig])}),
                detector=PartConfig(name=detector.name, options=detector.options),
                backend=PartConfig(name=backend.name, options=backend.options),
                loop_closure=backend.loop_closure,
                frontend=suite.frontend,
                ground_truth=flown.ground_truth,
                start_s=flown.start_s + (SEED_SHIFT_S * seed if later else 0.0),
                duration_s=sequence.duration_s,
            )
            config = configuration.complete(config, installed)
            nowhere = config.dataset.model_copy(update={"path": None})  # where the data lie says nothing about them
            plain = config.model_copy(update={"dataset": nowhere, "ground_truth": None}).model_dump(mode="json")
            about = _about(
                *("flight", flown.data, sequence.name, condition, level, detector.called, backend.called),
                seed=seed,
                note=flown.note,
                code=code,
                config=fingerprints.of_values(plain, list(suite.metrics)),
                inputs=flown.digest,
            )
            yield FlightTask(
                about=about,
                cost_s=_FLY_S * 20.0 * seconds,
                recording=recording,
                config=config,
                metrics=suite.metrics,
            )


def _recording(sequence: str, config: SimulationConfig, digest: str, code: str) -> Recording:
    frames = config.frame_rate_hz * (config.duration_s or 100.0)
    # A blurred frame is the mean of many.
    effort = 1.0 + 8.0 * max(config.conditions.get(name, 0.0) for name in ("motion_blur", "rolling_shutter"))
    name = f"{sequence}.{fingerprints.of_values(digest, code)}.bag"
    return Recording(name, config, _RENDER_S * effort * frames)


def _trials(suite: Suite, installed: Registry) -> Iterator[TrialTask]:
    code, setup = fingerprints.of_code(installed), suite.setup
    R_BC = packaged_calibration("euroc").cameras[0].R_BC
    named_flight(setup.flight, setup.duration_s, R_BC)  # says so where there is none
    for backend, seed in product(suite.backends, range(suite.seeds)):
        options = installed.find(BACKEND, backend.name).validate(backend.options)
        about = _about(
            *("trial", Data.SIMULATED, setup.flight, CLEAR, 0.0, "simulated tracks", backend.called),
            seed=seed,
            note=f"simulated tracks of the flight {setup.flight}, {setup.pixel_sigma:g} px noise; no images",
            code=code,
            config=fingerprints.of_values(backend.name, options),
            inputs=fingerprints.of_values(setup.model_dump(), seed),
        )
        part = PartConfig(name=backend.name, options=options)
        yield TrialTask(about=about, cost_s=_TRIAL_S * setup.duration_s, setup=setup, backend=part)


def _speed(suite: Suite, folders: Sequence[Path], installed: Registry) -> SpeedTask:
    for detector in suite.detectors:
        installed.find(DETECTOR, detector.name).validate(detector.options)
    found = [sources.find_source(each.name, folders, installed) for each in suite.sequences] if folders else []
    source = next((each for each in found if each.recording is not None), sources.Source("drawn surfaces"))
    if folders and source.recording is None:
        names = ", ".join(each.name for each in suite.sequences) or "no sequence"
        raise DatasetError(f"--data holds no images of {names}; leave it out to time detectors on drawn surfaces")
    parts = [each.model_dump() for each in suite.detectors]
    images = source.name if source.recording is None else f"frames of {source.name}"
    about = {
        "task": "detector_speed",
        "kind": "speed",
        "data": None if source.recording is None else source.kind,
        "data_note": f"{images}, 640 x 480, 300 keypoints, one image at a time",
        "code": fingerprints.of_code(installed),
        "config": fingerprints.of_values(parts, suite.rounds, suite.images),
        "inputs": "drawn" if source.recording is None else fingerprints.of_recordings([source.recording]),
    }
    return SpeedTask(
        about=about,
        cost_s=60.0,
        detectors=suite.detectors,
        rounds=suite.rounds,
        images=suite.images,
        frames_of=source.recording,
    )


def _about(kind: str, *cell: Any, seed: int, note: str, **fingerprint: str) -> dict[str, Any]:
    """The columns of a flight's or a trial's row, ``cell`` by :data:`CELL`.

    Its task has a name that says what it is and can be a folder's.
    """
    _, sequence, condition, level, detector, backend = cell
    how = f"{condition}_{level:g}" if level else condition
    name = ".".join(re.sub(r"[^\w+-]", "_", part) for part in (sequence, how, detector, backend, f"seed{seed}"))
    about = {"task": name, "kind": kind, **dict(zip(CELL, cell, strict=True)), "seed": seed}
    return {**about, "data_note": note, **fingerprint}
