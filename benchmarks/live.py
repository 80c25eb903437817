"""Five minutes live: does it keep up, lose nothing, give the same bytes again, and does its memory stay as it is?

    python benchmarks/live.py [--record] [--minutes 5]

A simulated flight at half of EuRoC's resolution is replayed at its own pace: as it is; with a back-end that is slowed
to half of real time; watched, the viewer's recording written; and by a RealSense camera that librealsense emulates.
Each in a process of its own, whose memory is looked at every second. What it recorded is then run again. Targets: no
reading lost; frames dropped by the slow one only, which stays tracking; after the first minute memory stays as it is;
the same bytes again; latency, of frames with an estimate, at most 25 ms (median) and 60 ms (99 %) beyond the 50 ms that
a frame waits for late readings. --data counts for nothing here.
"""

import multiprocessing
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from typing import Any

import click
import numpy as np
import psutil
from common import benchmark, present, render

from vioframe.bench import Row
from vioframe.evaluation import evaluate
from vioframe.interfaces import Dataset
from vioframe.io.ahead import read_ahead
from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.live.stream import Live
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.parts.registry import BACKEND, SOURCE, Part, Registry
from vioframe.pipeline import prepare, record
from vioframe.report.live_view import LiveView
from vioframe.runs.folder import RunFolder
from vioframe.simulation.config import SimulationConfig
from vioframe.types import Calibration, Estimate, FrameTracks, ImuSample, ImuSegment, Step
from vioframe_realsense.device import Wanted
from vioframe_realsense.emulated import Emulated
from vioframe_realsense.source import RealSense

FLIGHT, RATE_HZ = "figure_eight", 20.0
# Twice the period of the frames, with what it takes by itself.
SLOWED_BY_S = 0.09
CASES = ("as it is", "slowed", "watched", "realsense")
COLUMNS = {
    "case": "",
    "backend": "",
    "frames": "d",
    "frames_dropped": "d",
    "readings_lost": "d",
    "completion": ".1%",
    "resets": "d",
    "ate_mm": ".0f",
    "latency_ms.median": ".0f",
    "latency_ms.p99": ".0f",
    "minute_mib": ".0f",
    "end_mib": ".0f",
    "same_bytes": "",
}
SAME = ("trajectory.tum", "states.csv", "pose_cov.csv", "tracks.csv", "calibration.csv", "map.ply")


@benchmark
@click.option("--minutes", default=5.0, show_default=True, help="Length of the flight.")
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, minutes: float) -> None:
    """A simulated flight, live."""
    settings = {
        "backend": backend,
        "options": list(assignments),
        "flight": FLIGHT,
        "minutes": minutes,
        "frame_rate_hz": RATE_HZ,
        "slowed_by_s": SLOWED_BY_S,
    }

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary:
            bag = Path(temporary) / "flight.mcap"
            _simulated(bag, 60.0 * minutes)
            for case in CASES:
                # Each in a process of its own, which has nothing else in memory.
                with multiprocessing.get_context("spawn").Pool(1) as pool:
                    yield pool.apply(fly, (case, bag, backend, assignments))

    present("live", f"{backend}: live, {minutes:g} minutes", rows(), COLUMNS, settings, keep)


def fly(case: str, bag: Path, backend: str, assignments: tuple[str, ...]) -> Row:
    """One flight of the recording ``bag``, live, and what was recorded of it once more."""
    flying = installed = registry.load()
    data, watch, dataset = f"replay:{bag}", _Memory(), installed.open_dataset(bag)
    readings = sum(isinstance(measurement, ImuSample) for measurement in dataset.measurements())
    with TemporaryDirectory() as temporary, ExitStack() as within:
        folder, again, tape = (Path(temporary) / name for name in ("flown", "again", "tape.mcap"))
        if case == "slowed":
            flying = _slowed(installed, backend)
        elif case == "realsense":
            device = Emulated(dataset.calibration, rate_hz=round(RATE_HZ), accel_rate_hz=200)
            data, flying = "realsense:", _emulating(installed, device, dataset.calibration)
        experiment = prepare(_config(data, backend, flying, assignments), flying, tape=tape)
        live = experiment.live
        assert live is not None
        on_step = _unseen
        if case == "watched":
            view = within.enter_context(LiveView(experiment.name, live.calibration, Path(temporary) / "view.rrd"))
            on_step = partial(_seen, view, live)
        elif case == "realsense":
            within.enter_context(_playing(device, dataset, live))
        with watch:
            summary = record(experiment, folder, on_step=on_step)
        record(prepare(_config(tape, backend, installed, assignments), installed), again)
        estimate = RunFolder.open(folder).trajectory()
        same = all((folder / name).read_bytes() == (again / name).read_bytes() for name in SAME)
    figures, truth = summary["live"], dataset.ground_truth
    assert estimate is not None
    assert truth is not None
    if case == "realsense":
        readings = device.usable
    return {
        "case": case,
        "backend": backend,
        "frames": figures["frames"],
        "frames_dropped": figures["frames_dropped"],
        "readings_lost": readings - figures["readings"],
        "completion": summary["completion"],
        "resets": summary["resets"],
        "ate_mm": 1e3 * evaluate(estimate, truth).ate_m.rmse,
        "latency_ms": figures["latency_ms"],
        "minute_mib": watch.at(60.0),
        "end_mib": watch.at(np.inf),
        "same_bytes": "yes" if same else "no",
    }


def _unseen(step: Step) -> None:
    """Nobody looks."""


def _seen(view: LiveView, live: Live, step: Step) -> None:
    view.add(step, live.latency_ms, live.dropped)


@contextmanager
def _playing(device: Emulated, recording: Dataset, live: Live) -> Iterator[None]:
    """Meanwhile the emulated ``device`` measures what is in the ``recording``; when that ends, so does ``live``."""

    def play() -> None:
        device.wait_until_started()
        device.play(read_ahead(recording.measurements()))
        time.sleep(1.0)  # the last of it arrives
        live.stop()

    player = Thread(target=play, daemon=True)
    player.start()
    yield
    player.join()


def _config(data: Path | str, backend: str, installed: Registry, assignments: tuple[str, ...]) -> Config:
    config = Config(dataset=DatasetConfig(path=Path(data)), backend=PartConfig(name=backend))
    return configuration.override(config, installed, assignments)


def _slowed(installed: Registry, backend: str) -> Registry:
    """With a back-end of that name that takes as long again as frames take to come."""
    part = installed.find(BACKEND, backend)

    class Slowed:
        takes_rigs = True

        def __init__(self, **options: Any) -> None:
            self._backend = installed.create_backend(backend, options)
            self.begin = self._backend.begin

        def process(self, imu: ImuSegment, tracks: FrameTracks, still: bool) -> Estimate:
            time.sleep(SLOWED_BY_S if tracks.t_ns > 10**10 else 0.0)  # not while it is warmed up, which begins at 0
            return self._backend.process(imu, tracks, still)

    return _with(installed, replace(part, factory=Slowed))


def _emulating(installed: Registry, device: Emulated, rig: Calibration) -> Registry:
    """With the ``device`` as the RealSense camera that is found."""
    wanted = Wanted(rig.cameras[0].model.resolution, round(RATE_HZ), emitter=False)

    def realsense(address: str) -> RealSense:
        return RealSense(lambda serial: device.device, address, wanted)

    return _with(installed, replace(installed.find(SOURCE, "realsense"), factory=realsense))


def _with(installed: Registry, part: Part) -> Registry:
    """With ``part`` in the place of that of its name."""
    kind = part.kind.name
    return replace(installed, parts={**installed.parts, kind: {**installed.parts[kind], part.name: part}})


class _Memory:
    """What this process holds in memory, MiB, once a second; a context manager."""

    def __init__(self) -> None:
        self._begin_s, self._ended = time.monotonic(), Event()
        self._seen: list[tuple[float, float]] = []
        self._thread = Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        self._begin_s = time.monotonic()
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def at(self, s: float) -> float:
        """The most of the ten seconds up to ``s``, or to the end."""
        end = min(s, self._seen[-1][0])
        return max(mib for at_s, mib in self._seen if end - 10.0 <= at_s <= end)

    def _look(self) -> None:
        process = psutil.Process()
        while not self._ended.wait(1.0):
            self._seen.append((time.monotonic() - self._begin_s, process.memory_info().rss / 2**20))


def _simulated(bag: Path, duration_s: float) -> None:
    """The flight, by EuRoC's left camera at half its resolution."""
    rig = packaged_calibration("euroc", cameras=["cam0"])
    files = bag.with_name("calibration")
    write_calibration(rig.with_camera(0, model=rig.cameras[0].model.shrunk(2)), files)
    settings = {"flight": FLIGHT, "duration_s": duration_s, "frame_rate_hz": RATE_HZ, "rig": (str(files),)}
    render(SimulationConfig.model_validate(settings), registry.load(), bag)


if __name__ == "__main__":
    main()
