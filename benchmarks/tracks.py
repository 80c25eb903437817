"""How long each detector's points are followed, and how far they stray from their landmarks, in worlds for reporting.

    python benchmarks/tracks.py [--record]

Simulated flights with EuRoC's true motion, in the clear and under conditions, the same ones for every detector, by the
front-end alone, with the options that the suite stress has for each. A track that is not lost to the end of the
recording counts as long as that.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from common import HERE, SHARED_DATA, present, render, script, tracked
from rendered_flights import seeds
from threadpoolctl import threadpool_limits

from vioframe.bench import Row
from vioframe.bench.suites import suite
from vioframe.evaluation.tracks import TrackLives, track_lives
from vioframe.geometry.meshes import read_mesh
from vioframe.parts import registry
from vioframe.parts.config import PartConfig
from vioframe.parts.registry import Registry
from vioframe.simulation.config import MESH, SimulationConfig, simulation_folder

FLIGHT, START_S, DURATION_S = "V1_02_medium", 5.0, 15.0
LEVEL = 0.67
CONDITIONS = ("", "motion_blur", "low_light", "low_texture")
WORLDS = 3
COLUMNS = {
    "condition": "",
    "world": "d",
    "detector": "",
    "tracks": "d",
    "life.median": ".0f",
    "life.mean": ".1f",
    "drift_px.median": ".2f",
    "drift_px.p95": ".2f",
}


@script
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
@click.option(
    "--data",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    default=SHARED_DATA,
    help="Folder of the recordings.  [default: ../shared/data]",
)
def main(keep: bool, data: Path) -> None:
    """Tracks of each detector against the truth."""
    installed = registry.load()
    detectors = suite.read(HERE / "suites" / "stress.yaml").detectors

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary, threadpool_limits(1):
            for condition, world in product(CONDITIONS, seeds(WORLDS)):
                bag = Path(temporary) / "flight.bag"
                flown = SimulationConfig(
                    recorded=data / "euroc_imu_gt" / FLIGHT,
                    start_s=START_S,
                    duration_s=DURATION_S,
                    seed=world,
                    conditions={condition: LEVEL} if condition else {},
                )
                render(flown, installed, bag)
                for detector in detectors:
                    row = {"condition": condition or "clear", "world": world, "detector": detector.called}
                    yield row | summary(lives(bag, detector, installed))

    options = {detector.called: detector.options for detector in detectors}
    settings = {"flight": FLIGHT, "duration_s": DURATION_S, "level": LEVEL, "detectors": options}
    present("tracks", "Images a track lives, and its distance from the truth, px", rows(), COLUMNS, settings, keep)


def lives(bag: Path, detector: PartConfig, installed: Registry) -> TrackLives:
    """Of the tracks through the simulated recording ``bag`` by the front-end with ``detector``."""
    made = installed.create_detector(detector.name, detector.options)
    sequence = tracked(installed.open_dataset(bag), made)
    steps = [tracks for _, tracks in sequence.packets]
    (camera,) = sequence.calibration.cameras
    return track_lives(steps, sequence.ground_truth, camera, read_mesh(simulation_folder(bag) / MESH))


def summary(lives: TrackLives) -> Row:
    drift_px = lives.drift_px[np.isfinite(lives.drift_px)]
    return {
        "tracks": len(lives.images),
        "life": {"median": float(np.median(lives.images)), "mean": float(np.mean(lives.images))},
        "drift_px": {"median": float(np.median(drift_px)), "p95": float(np.quantile(drift_px, 0.95))},
    }


if __name__ == "__main__":
    main()
