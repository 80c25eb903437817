"""Rendered EuRoC flights with loop closure: does it help, and does it ever harm?

    python benchmarks/loops.py [--record] [--bags DIR]

Whole flights with their real IMU in two worlds each, by three detectors and two back-ends; the corrected path is
measured against the odometry's own, of the same run. Target: in no run an ATE of more than 1.02 times that without
loops, and 0.6 times on average. --backend counts for nothing here.
"""

from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from common import bags_option, benchmark, present
from euroc_clips import run
from rendered_flights import recording, seeds

from vioframe.bench import Row
from vioframe.bench.processes import installed, map_in_processes
from vioframe.bench.suites.sources import EUROC
from vioframe.cores import usable_cores
from vioframe.evaluation import evaluate
from vioframe.parts import config as configuration
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.runs.folder import RunFolder

FLIGHTS = ("MH_02_easy", "MH_03_medium", "V1_01_easy", "MH_05_difficult", "V1_02_medium")
WORLDS = 2
DETECTORS, BACKENDS = ("shi_tomasi", "orb", "keypointnet"), ("msckf", "sliding_window")
COLUMNS = {
    "clip": "",
    "world": "d",
    "detector": "",
    "backend": "",
    "loops": "d",
    "rejected": "d",
    "ate_mm": ".0f",
    "ate_loops_mm": ".0f",
    "ratio": ".2f",
}


@dataclass(frozen=True)
class Job:
    """One flight, of ``flight`` in ``world`` rendered to ``bag``."""

    bag: Path
    flight: str
    world: int
    detector: str
    backend: str
    assignments: tuple[str, ...]


@benchmark
@click.option("--worlds", default=WORLDS, show_default=True, help="In how many worlds each flight is flown.")
@bags_option
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, worlds: int, bags: Path | None) -> None:
    """Rendered flights, with loop closure and without."""
    with TemporaryDirectory() as temporary:
        bags = bags or Path(temporary)
        flown = list(product(FLIGHTS, seeds(worlds)))
        recordings = [recording(bags, flight, world, data, installed()) for flight, world in flown]
        jobs = [
            Job(bag, *about, *parts, assignments)
            for bag, about in zip(recordings, flown, strict=True)
            for parts in product(DETECTORS, BACKENDS)
        ]
        rows = map_in_processes(fly, jobs, usable_cores(), lambda row: click.echo(row["clip"], err=True))
    present("loops", "Rendered flights with loops", rows, COLUMNS, {"options": list(assignments)}, keep)


def fly(job: Job) -> Row:
    """One run with loop closure, and what that made of its odometry."""
    config = Config(
        dataset=DatasetConfig(path=job.bag),
        detector=PartConfig(name=job.detector),
        backend=PartConfig(name=job.backend),
        loop_closure=PartConfig(name="pose_graph"),
        start_s=EUROC[job.flight].start_s,
    )
    config = configuration.override(config, installed(), job.assignments)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "run"
        row = run(config, installed(), folder)
        done = RunFolder.open(folder)
        closed, truth = done.loop_closed(), done.ground_truth()
        found = done.summary["loop_closure"]
    row |= {"clip": job.flight, "world": job.world, "backend": job.backend}
    row |= {"loops": found["loops"], "rejected": found["rejected"]}
    if closed is not None and truth is not None:
        row["ate_loops_mm"] = 1e3 * evaluate(closed, truth).ate_m.rmse
        row["ratio"] = row["ate_loops_mm"] / row["ate_mm"]
    return row


if __name__ == "__main__":
    main()
