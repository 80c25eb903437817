"""What any detector could take away at most: flights of a suite again, with their points where they truly are.

    vioframe bench stress --seeds 5 --backend msckf --backend sliding_window --out RESULTS
    python benchmarks/exact_points.py RESULTS [--record]

Of each simulated flight that the suite's first detector completed, its tracks are taken from the run folder, and put
where the world says that their landmarks are; the back-end, its options and the readings are the same. What is left of
the error is of the readings and of how they are estimated from.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import click
import numpy as np
from common import present, script
from error_budget import EXACT_POINTS, estimated, with_landmarks

from vioframe.bench import Row
from vioframe.bench.suites import suite as suites
from vioframe.bench.suites.plan import plan
from vioframe.bench.suites.tasks import FlightTask
from vioframe.cores import usable_cores
from vioframe.geometry.cameras import Camera
from vioframe.parts import registry
from vioframe.runs.folder import RunFolder
from vioframe.runs.results import SUITE_FILE, read_rows
from vioframe.simulation.recording import SimulatedRecording
from vioframe.types import FrameTracks

COLUMNS = {"condition": "", "level": ".2f", "seed": "d", "backend": "", "ate_mm": ".1f", "exact_mm": ".1f"}


@script
@click.argument("results", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
def main(results: Path, keep: bool) -> None:
    """The error of simulated flights of a suite, and what is left of it with exact points."""
    suite, done = suites.read(results / SUITE_FILE), read_rows(results)
    detector = suite.detectors[0].called
    flights = [
        (task, done[task.name][0])
        for task in plan(suite, (), registry.load())
        if isinstance(task, FlightTask) and task.about["detector"] == detector and task.name in done
    ]
    whole = [(task, row) for task, row in flights if row.get("completion") == 1.0 and not row["resets"]]
    settings = {"suite": suite.title, "detector": detector, "flights": len(flights)}
    with ProcessPoolExecutor(usable_cores(), mp_context=get_context("spawn")) as workers:
        rows = workers.map(with_exact_points, *zip(*whole, strict=True), [results] * len(whole))
        title = f"ATE by {detector}, and with its points where they truly are"
        present("exact_points", title, rows, COLUMNS, settings, keep)


def with_exact_points(task: FlightTask, flown: Row, results: Path) -> Row:
    """The flight of ``task``, which has been ``flown``, estimated again."""
    assert task.recording is not None
    installed = registry.load()
    recording = SimulatedRecording(task.recording.config, installed)
    (lens,) = recording.calibration.lenses
    followed = with_landmarks(list(of_frames(RunFolder.open(results / flown["folder"]), lens)), recording)
    estimated_again = estimated(EXACT_POINTS, followed, recording, task.config, installed, flown["seed"])
    about = {column: flown[column] for column in ("condition", "level", "seed", "backend")}
    return {**about, "ate_mm": 1e3 * flown["ate_m"], "exact_mm": estimated_again["ate_mm"]}


def of_frames(run: RunFolder, lens: Camera) -> Iterator[FrameTracks]:
    """What the front-end gave of each frame."""
    tracks = run.tracks()
    assert tracks is not None
    ends = np.searchsorted(tracks.t_ns, tracks.frames_ns, side="right")
    for t_ns, begin, end in zip(tracks.frames_ns.tolist(), [0, *ends[:-1]], ends, strict=True):
        xy = tracks.xy[begin:end]
        yield FrameTracks(t_ns, tracks.ids[begin:end], tracks.camera[begin:end], xy, lens.undistort(xy))


if __name__ == "__main__":
    main()
