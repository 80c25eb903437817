"""Five minutes live: does it keep up, lose nothing, give the same bytes again, and does its memory stay as it is?

    python benchmarks/live.py [--record] [--minutes 5]

A simulated flight at half of EuRoC's resolution is replayed at its own pace: as it is; with a back-end that is slowed
to half of real time; and watched, the viewer's recording written. Each in a process of its own, whose memory is looked
at every second. What it recorded is then run again. Targets: no reading lost; frames dropped by the slow one only,
which stays tracking; after the first minute memory stays as it is; the same bytes again; latency at most 25 ms (median)
and 60 ms (99 %) beyond the 50 ms that a frame waits for late readings. --data counts for nothing here.
"""

import multiprocessing
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event, Thread
from time import monotonic, sleep
from typing import Any

import click
import numpy as np
import psutil
from common import benchmark, present, render

from vioframe.bench import Row
from vioframe.evaluation import evaluate
from vioframe.io.calibration import packaged_calibration, write_calibration
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.parts.registry import BACKEND, Registry
from vioframe.pipeline import prepare, record
from vioframe.report.live_view import LiveView
from vioframe.runs.folder import RunFolder
from vioframe.simulation.config import SimulationConfig
from vioframe.types import Estimate, FrameTracks, ImuSegment

FLIGHT, RATE_HZ = "figure_eight", 20.0
# Twice the period of the frames, with what it takes by itself.
SLOWED_BY_S = 0.09
CASES = ("as it is", "slowed", "watched")
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
    installed = registry.load()
    watch = _Memory()
    with TemporaryDirectory() as temporary:
        folder, again, tape = (Path(temporary) / name for name in ("flown", "again", "tape.mcap"))
        flying = _slowed(installed, backend) if case == "slowed" else installed
        experiment = prepare(_config(f"replay:{bag}", backend, flying, assignments), flying, tape=tape)
        live = experiment.live
        assert live is not None
        if case == "watched":
            with LiveView(experiment.name, live.calibration, Path(temporary) / "view.rrd") as view, watch:
                summary = record(experiment, folder, on_step=lambda step: view.add(step, live.latency_ms, live.dropped))
        else:
            with watch:
                summary = record(experiment, folder)
        record(prepare(_config(tape, backend, installed, assignments), installed), again)
        estimate = RunFolder.open(folder).trajectory()
        same = all((folder / name).read_bytes() == (again / name).read_bytes() for name in SAME)
    figures = summary["live"]
    dataset = installed.open_dataset(bag)
    readings = sum(not hasattr(measurement, "images") for measurement in dataset.measurements())
    truth = dataset.ground_truth
    assert estimate is not None
    assert truth is not None
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
            sleep(SLOWED_BY_S if tracks.t_ns > 10**10 else 0.0)  # not while it is warmed up, which begins at 0
            return self._backend.process(imu, tracks, still)

    slow = replace(part, factory=Slowed)
    return replace(installed, parts={**installed.parts, BACKEND.name: {**installed.parts[BACKEND.name], backend: slow}})


class _Memory:
    """What this process holds in memory, MiB, once a second; a context manager."""

    def __init__(self) -> None:
        self._begin_s, self._ended = monotonic(), Event()
        self._seen: list[tuple[float, float]] = []
        self._thread = Thread(target=self._look, daemon=True)

    def __enter__(self) -> None:
        self._begin_s = monotonic()
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
            self._seen.append((monotonic() - self._begin_s, process.memory_info().rss / 2**20))


def _simulated(bag: Path, duration_s: float) -> None:
    """The flight, by EuRoC's left camera at half its resolution."""
    rig = packaged_calibration("euroc", cameras=["cam0"])
    model = rig.cameras[0].model
    width, height = model.resolution
    half = replace(
        model,
        fx=model.fx / 2,
        fy=model.fy / 2,
        cx=(model.cx + 0.5) / 2 - 0.5,
        cy=(model.cy + 0.5) / 2 - 0.5,
        resolution=(width // 2, height // 2),
    )
    files = bag.with_name("calibration")
    write_calibration(rig.with_camera(0, model=half), files)
    settings = {"flight": FLIGHT, "duration_s": duration_s, "frame_rate_hz": RATE_HZ, "rig": (str(files),)}
    render(SimulationConfig.model_validate(settings), registry.load(), bag)


if __name__ == "__main__":
    main()
