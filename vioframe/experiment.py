"""A run put together: a configuration and the installed parts in, a recorded run folder out.

The command line and the benchmarks both come through here; :mod:`vioframe.pipeline` is the loop itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any

from vioframe import pipeline
from vioframe.errors import DatasetError, PluginError, RunError, VioframeError
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.interfaces import Backend, Dataset, Detector, LoopCloser
from vioframe.io.calibration import write_calibration
from vioframe.io.trajectories import load_trajectory, write_tum
from vioframe.parts import config as configuration
from vioframe.parts.config import Config
from vioframe.parts.registry import BACKEND, DATASET, DETECTOR, LOOP_CLOSER, Registry, describe
from vioframe.runs import machine
from vioframe.runs.recorder import Recorder, new_run_folder, write_json
from vioframe.types import LoopClosure, Step

# More threads than this gain nothing on images of this size, and cost on machines that have many.
_MAX_OPENCV_THREADS = 4


@dataclass(frozen=True)
class Experiment:
    """A data set, the parts to run on it and what it is compared with. ``config`` is complete."""

    config: Config
    registry: Registry
    dataset: Dataset
    detector: Detector
    backend: Backend
    ground_truth: Trajectory | None
    loop_closer: LoopCloser | None = None
    incidents: Incidents = field(default_factory=Incidents)

    @property
    def name(self) -> str:
        return f"{self.dataset.name}_{self.config.detector.name}_{self.config.backend.name}"

    def steps(self) -> Iterator[Step]:
        """The main loop, the loop closer taking part; errors come out as :meth:`_blaming_plugins` says."""
        import cv2
        from threadpoolctl import threadpool_limits

        cv2.setNumThreads(min(cv2.getNumThreads(), _MAX_OPENCV_THREADS))
        # numpy and scipy bring a BLAS each; on matrices this small their threads only wait for one another.
        with threadpool_limits(1), self._blaming_plugins():
            steps = pipeline.run(
                self.dataset,
                self.detector,
                self.backend,
                self.config.frontend_options,
                start_s=self.config.start_s,
                duration_s=self.config.duration_s,
                incidents=self.incidents,
            )
            yield from steps if self.loop_closer is None else _closing_loops(steps, self.loop_closer)

    def close_loops(self) -> LoopClosure | None:
        """What the loop closer, if any, made of all steps; to be called once they are through."""
        from threadpoolctl import threadpool_limits

        if self.loop_closer is None:
            return None
        with threadpool_limits(1), self._blaming_plugins():
            return self.loop_closer.finish()

    @contextmanager
    def _blaming_plugins(self) -> Iterator[None]:
        """What a plug-in raises comes out as a :class:`PluginError` that names it."""
        try:
            yield
        except VioframeError:
            raise
        except (Exception, SystemExit) as error:
            if _is_interrupt(error):
                raise KeyboardInterrupt from error
            source = self.registry.blame(error.__traceback__)
            if source is None:
                raise
            raise PluginError(f"plug-in {source.entry_point!r} ({source}) failed: {describe(error)}") from error


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether Ctrl-C is what began it: within compiled code it comes out as a SystemError, or as one behind another."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt):
            return True
        error = error.__cause__ or error.__context__
    return False


def _closing_loops(steps: Iterable[Step], loop_closer: LoopCloser) -> Iterator[Step]:
    """``steps`` as ``loop_closer`` has seen them, with the time that took."""
    for step in steps:
        begin = perf_counter()
        loop_closer.add(step)
        yield replace(step, stage_seconds={**step.stage_seconds, "loop_closure": perf_counter() - begin})


def prepare(config: Config, registry: Registry) -> Experiment:
    """Check the whole of ``config``, then open the data set and create the parts."""
    config = configuration.complete(config, registry)
    if config.dataset.path is None:
        raise DatasetError("no data set given; name a bag or folder, or set dataset.path in the configuration")
    dataset = registry.open_dataset(config.dataset.path, config.dataset.reader, config.dataset.options)
    return Experiment(
        config,
        registry,
        dataset,
        registry.create_detector(config.detector.name, config.detector.options),
        registry.create_backend(config.backend.name, dataset.calibration, config.backend.options),
        dataset.ground_truth if config.ground_truth is None else load_trajectory(config.ground_truth),
        None
        if config.loop_closure is None
        else registry.create_loop_closer(config.loop_closure.name, dataset.calibration, config.loop_closure.options),
    )


def record(
    experiment: Experiment,
    folder: Path,
    *,
    overwrite: bool = False,
    on_step: Callable[[Step], None] = lambda step: None,
) -> dict[str, Any]:
    """Run ``experiment`` and write ``folder`` as it goes; returns the summary.

    Nothing is created or replaced before the first frame has gone through; after that the folder is completed
    however the run ends.
    """
    begin_s = perf_counter()
    steps = experiment.steps()
    first = next(steps, None)
    if first is None:
        raise DatasetError(f"{experiment.dataset.name} has no image to process; check --start and --duration")
    new_run_folder(folder, overwrite=overwrite)
    try:
        return _write(experiment, folder, chain([first], steps), begin_s, on_step)
    except OSError as error:
        raise RunError(f"cannot write to {folder}: {error.strerror}; is the disk full?") from error


def _write(
    experiment: Experiment, folder: Path, steps: Iterable[Step], begin_s: float, on_step: Callable[[Step], None]
) -> dict[str, Any]:
    config, registry = experiment.config, experiment.registry
    (folder / "config.yaml").write_text(configuration.render(config, registry), encoding="utf-8")
    write_json(folder / "machine.json", machine.describe())
    write_calibration(experiment.dataset.calibration, folder / "calibration")
    if experiment.ground_truth is not None:
        write_tum(experiment.ground_truth, folder / "ground_truth.tum")
    with Recorder(folder, _about(experiment), experiment.incidents, begin_s) as recorder:
        try:
            for step in steps:
                recorder.add(step)
                on_step(step)
            if (loop_closure := experiment.close_loops()) is not None:
                recorder.add_loop_closure(loop_closure)
        except BaseException as error:
            error.add_note(f"what was estimated until then is in {folder}")
            raise
    return recorder.summary


def _about(experiment: Experiment) -> dict[str, Any]:
    config = experiment.config
    chosen = {DATASET: config.dataset.reader or "", DETECTOR: config.detector.name, BACKEND: config.backend.name}
    if config.loop_closure is not None:
        chosen[LOOP_CLOSER] = config.loop_closure.name
    return {
        "name": experiment.name,
        "dataset": experiment.dataset.name,
        "detector": config.detector.name,
        "backend": config.backend.name,
        "loop_closer": None if config.loop_closure is None else config.loop_closure.name,
        "plugins": {kind.name: str(experiment.registry.find(kind, name).source) for kind, name in chosen.items()},
        "start_s": config.start_s,
        "duration_s": config.duration_s,
    }
