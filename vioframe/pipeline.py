"""A run put together: a configuration and the installed parts in, a recorded run folder out.

The command line and the benchmarks both come through here; :class:`vioframe.odometry.Odometry` is the loop itself.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, cast

from vioframe.cores import limited_threads
from vioframe.diagnosis import HOPELESS, Certainty, Diagnosis, Gatherer, diagnose, gather
from vioframe.diagnosis.stamps import span_s
from vioframe.errors import DatasetError, RunError, VioframeError
from vioframe.frontend_process import FrontendProcess
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.interfaces import Dataset, Source
from vioframe.io.calibration import write_calibration
from vioframe.io.synchronise import played
from vioframe.io.trajectories import load_trajectory, write_tum
from vioframe.live.ahead import Ahead
from vioframe.live.stream import Live
from vioframe.live.tape import Tape
from vioframe.odometry import Odometry
from vioframe.parts import config as configuration
from vioframe.parts.config import Config
from vioframe.parts.registry import BACKEND, DATASET, DETECTOR, LOOP_CLOSER, SOURCE, Registry
from vioframe.runs import machine
from vioframe.runs.recorder import Recorder, new_run_folder, write_json
from vioframe.stopwatch import working_s
from vioframe.types import Measurement, Step

# A run looks at stamps and readings of its first minute, and at every so manieth image of it.
_LOOK_S, _LOOK_EVERY = 60.0, 10


def run(
    dataset: Dataset,
    odometry: Odometry,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    listeners: Sequence[Callable[[Measurement], None]] = (),
) -> Iterator[Step]:
    """Push a data set through ``odometry``, yielding one :class:`~vioframe.types.Step` a frame.

    ``start_s`` seconds are skipped, counted from the first frame's stamp; ``duration_s`` is how much is then played.
    ``listeners`` hear every measurement ahead of the odometry.
    """

    def heard() -> Iterator[Measurement]:
        for measurement in played(dataset.measurements(), start_s, duration_s):
            for listen in listeners:
                listen(measurement)
            yield measurement

    return odometry.follow(heard())


@dataclass(frozen=True)
class Experiment:
    """A data set, the odometry to push it through and what it is compared with. ``config`` is complete."""

    config: Config
    registry: Registry
    dataset: Dataset
    odometry: Odometry
    given_truth: Trajectory | None
    """That of a file of its own, which counts before the data set's."""
    gatherer: Gatherer
    left_aside: tuple[str, ...] = ()
    """Cameras of the rig that are not used."""
    tape: Path | None = None
    """The file that all of a live source is written to that is used: run again it gives the same estimates."""

    @property
    def live(self) -> Live | None:
        """The data set, where it is a live source: then it is not run a second time, and can be told to stop."""
        return self.dataset if isinstance(self.dataset, Live) else None

    @property
    def ground_truth(self) -> Trajectory | None:
        """Read when it is asked for, as a bag is gone through for it."""
        return self.dataset.ground_truth if self.given_truth is None else self.given_truth

    @property
    def name(self) -> str:
        return f"{self.dataset.name}_{self.config.detector.name}_{self.config.backend.name}"

    @property
    def incidents(self) -> Incidents:
        return self.odometry.incidents

    def steps(self) -> Iterator[Step]:
        """The main loop; what a plug-in raises comes out as an error that names it."""
        with ExitStack() as within:
            # Around all of it, not each frame alone: a loop closer's own thread works between frames.
            within.enter_context(limited_threads())
            within.enter_context(self.registry.blaming())
            listeners = [self.gatherer.add]
            if self.tape is not None:
                listeners.append(within.enter_context(Tape(self.tape, self.dataset.calibration)).add)
            yield from run(
                self.dataset,
                self.odometry,
                start_s=self.config.start_s,
                duration_s=self.config.duration_s,
                listeners=listeners,
            )

    def look_closely(self) -> Diagnosis:
        """Read what was played once more, as `vioframe check` does: what may be the cause where a run came to nothing.

        It takes seconds, as points are followed anew, without believing the calibration.
        """
        with limited_threads(), self.registry.blaming():
            measurements = played(self.dataset.measurements(), self.config.start_s, self.config.duration_s)
            return diagnose(gather(measurements, self.dataset.calibration))


def prepare(
    config: Config,
    registry: Registry,
    *,
    warm: bool = False,
    tape: Path | None = None,
    pipelined: FrontendProcess | bool = False,
) -> Experiment:
    """Check the whole of ``config``, then open the data set and create the parts.

    ``warm``, the back-end has flown once: it begins later, but one that fails does so before a run is replaced. A
    live source, which waits for nobody, always finds it so; all that is used of it is written to ``tape``.

    ``pipelined`` as of :class:`~vioframe.odometry.Odometry`, but for a live source: there a frame that was read ahead
    would only be older.
    """
    config = configuration.complete(config, registry)
    if config.dataset.path is None:
        raise DatasetError("no data set given; name a bag or folder, or set dataset.path in the configuration")
    live = registry.resolve(config.dataset.path, config.dataset.reader)[0].kind is SOURCE
    dataset, options, left_aside = _of_usable_cameras(registry, config)
    config = config.model_copy(update={"dataset": config.dataset.model_copy(update={"options": options})})
    loop_closure = config.loop_closure
    if live:
        imu = config.estimation_options.in_flight(dataset.calibration.imu)
        dataset = Live(cast(Source, dataset), Ahead(imu))
        if isinstance(pipelined, FrontendProcess):
            pipelined.close()
    elif tape is not None:
        raise DatasetError(f"{dataset.name} is a recording already; `vioframe convert` makes another of it")
    odometry = Odometry(
        dataset.calibration,
        config.detector.name,
        config.backend.name,
        detector_options=config.detector.options,
        backend_options=config.backend.options,
        loop_closer=None if loop_closure is None else loop_closure.name,
        loop_closer_options=None if loop_closure is None else loop_closure.options,
        frontend=config.frontend_options,
        estimation=config.estimation_options,
        wait_ms=config.wait_ms,
        warm=warm or live,
        pipelined=not live and pipelined,
        installed=registry,
    )
    return Experiment(
        config,
        registry,
        dataset,
        odometry,
        None if config.ground_truth is None else load_trajectory(config.ground_truth),
        Gatherer(dataset.calibration, _LOOK_EVERY, _LOOK_S),
        left_aside,
        tape,
    )


def _of_usable_cameras(registry: Registry, config: Config) -> tuple[Dataset, dict[str, Any], tuple[str, ...]]:
    """The data set, of a rig its first camera where nothing is said and the back-end, or a camera, is no use for more.

    With its options, and the names of the cameras that are left aside.
    """
    path, reader, options = config.dataset.path, config.dataset.reader, dict(config.dataset.options)
    assert path is not None
    dataset = registry.open_dataset(path, reader, options)
    cameras = dataset.calibration.cameras
    if len(cameras) == 1 or "cameras" not in options or options["cameras"] is not None:
        return dataset, options, ()
    backend = registry.create_backend(config.backend.name, config.backend.options)
    if not (getattr(backend, "takes_rigs", False) and all(camera.rotation_known for camera in cameras)):
        options["cameras"] = [cameras[0].name]
        return registry.open_dataset(path, reader, options), options, tuple(camera.name for camera in cameras[1:])
    return dataset, options, ()


def record(
    experiment: Experiment,
    folder: Path,
    *,
    overwrite: bool = False,
    on_step: Callable[[Step], None] = lambda step: None,
    explain: bool = False,
) -> dict[str, Any]:
    """Run ``experiment`` and write ``folder`` as it goes; returns the summary.

    Nothing is created or replaced before the first frame has gone through; after that the folder is completed
    however the run ends. The summary has the ``findings`` about the recording: those of its stamps and readings, or
    with ``explain`` all that can be found (:meth:`Experiment.look_closely`) where the run never initialised.
    """
    with limited_threads():  # as in flight; ahead of it, while a front-end's process still loads
        facts = machine.describe()
    begin_s = working_s()
    steps = experiment.steps()
    first = next(steps, None)
    if first is None:
        raise DatasetError(f"{experiment.dataset.name} has no image to process: {_why_none(experiment)}")
    taken_s = working_s() - begin_s
    new_run_folder(folder, overwrite=overwrite)
    try:
        write_json(folder / "machine.json", facts)
        return _write(experiment, folder, chain([first], steps), taken_s, on_step, explain)
    except OSError as error:
        raise RunError(f"cannot write to {folder}: {error.strerror}; is the disk full?") from error


def _why_none(experiment: Experiment) -> str:
    """Why not one frame got as far as the estimator.

    Told by all of the recording: what was played may have ended where clocks are apart, and a run listens to a part.
    """
    if experiment.live is not None:
        return "it ended, or was told to, ahead of the first image that its readings reach behind"
    gatherer = Gatherer(experiment.dataset.calibration, look_every=sys.maxsize)
    for measurement in experiment.dataset.measurements():
        gatherer.add(measurement)
    recording = gatherer.recording()
    for finding in diagnose(recording).findings:
        if finding.kind in HOPELESS and finding.certainty is Certainty.CERTAIN:
            return str(finding)
    length_s = span_s(recording.look.t_ns)
    return f"its images span {length_s:.1f} s, of which --start and --duration leave none that the IMU covers"


def _write(
    experiment: Experiment,
    folder: Path,
    steps: Iterable[Step],
    taken_s: float,
    on_step: Callable[[Step], None],
    explain: bool,
) -> dict[str, Any]:
    config, registry, live = experiment.config, experiment.registry, experiment.live
    (folder / "config.yaml").write_text(configuration.render(config, registry), encoding="utf-8")
    write_calibration(experiment.dataset.calibration, folder / "calibration")
    begin_s = working_s() - taken_s  # the clock stood still meanwhile: no frame was under way
    with (
        _truth_at_the_end(experiment, folder),
        Recorder(folder, _about(experiment), experiment.incidents, begin_s) as recorder,
    ):
        try:
            for step in steps:
                between = () if live is None else live.estimated(step)
                recorder.add(step)
                recorder.add_between(between)
                on_step(step)
            if (loop_closure := experiment.odometry.close_loops()) is not None:
                recorder.add_loop_closure(loop_closure)
            if live is not None:
                recorder.summary["live"] = live.figures()
            closely = explain and live is None and not recorder.initialised
            found = experiment.look_closely() if closely else diagnose(experiment.gatherer.recording())
            recorder.add_findings(found)
        except BaseException as error:
            error.add_note(f"what was estimated until then is in {folder}")
            raise
    return recorder.summary


@contextmanager
def _truth_at_the_end(experiment: Experiment, folder: Path) -> Iterator[None]:
    """Write the ground truth, however a run ends: a bag is gone through for it, which no frame is to wait for."""

    def write_truth() -> None:
        if (truth := experiment.ground_truth) is not None:
            write_tum(truth, folder / "ground_truth.tum")

    try:
        yield
    except BaseException:
        with suppress(VioframeError, OSError):  # a recording that is damaged may have none; why it ended counts
            write_truth()
        raise
    write_truth()


def _about(experiment: Experiment) -> dict[str, Any]:
    config = experiment.config
    kind = DATASET if experiment.live is None else SOURCE
    chosen = {kind: config.dataset.reader or "", DETECTOR: config.detector.name, BACKEND: config.backend.name}
    if config.loop_closure is not None:
        chosen[LOOP_CLOSER] = config.loop_closure.name
    return {
        "name": experiment.name,
        "dataset": experiment.dataset.name,
        "cameras": [camera.name for camera in experiment.dataset.calibration.cameras],
        "detector": config.detector.name,
        "backend": config.backend.name,
        "loop_closer": None if config.loop_closure is None else config.loop_closure.name,
        "plugins": {kind.name: str(experiment.registry.find(kind, name).origin) for kind, name in chosen.items()},
        "start_s": config.start_s,
        "duration_s": config.duration_s,
    }
