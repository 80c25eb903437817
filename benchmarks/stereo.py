"""EuRoC flights with their real IMU, rendered for both cameras: one camera, and both.

    python benchmarks/stereo.py [--record] [--flight MH_05_difficult]

Both back-ends fly each of six worlds kept for reporting with the left camera and with both, and then with each of the
two black for five seconds, and with the right one exposed 20 ms later, with stamps of its own. Targets, of means over
the worlds: with both cameras at most 0.6 times the ATE, and at most 1.6 times the time a frame; black at most twice,
apart at most 1.2 times the ATE of both; no resets.

How much a second camera can take away at all is told by landmarks that are seen almost exactly, along the same motion
and with the same readings of the IMU.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
from common import backend_rows, benchmark, present, render
from euroc_clips import judged
from rendered_flights import FLIGHTS, seeds

from vioframe.bench import Row
from vioframe.bench.suites.sources import EUROC
from vioframe.interfaces import Dataset
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.pipeline import prepare, record
from vioframe.simulation import real_motion_sequence
from vioframe.simulation.config import SimulationConfig
from vioframe.types import NS_PER_S, FrameSet, Measurement

BACKENDS = ("msckf", "sliding_window")
WORLDS = 6
# Seconds into the recording in which the left camera sees nothing, and the right one.
BLACK_S = ((30.0, 35.0), (45.0, 50.0))
APART_MS = 20.0
# Noise of landmarks that are seen almost exactly, px.
EXACT_PX = 0.1
CAMERAS = {"one": ["cam0"], "both": ["cam0", "cam1"]}
COLUMNS = {
    "clip": "",
    "world": "d",
    "backend": "",
    "cameras": "",
    "initialised_s": ".2f",
    "completion": ".1%",
    "resets": "d",
    "ate_mm": ".0f",
    "scale": ".4f",
    "frame_ms": ".1f",
}


class _Covered:
    """A data set of two cameras, each of them black for a while."""

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset

    def __getattr__(self, name: str) -> Any:
        return getattr(self._dataset, name)

    def measurements(self) -> Iterator[Measurement]:
        first_ns = None
        for measured in self._dataset.measurements():
            if isinstance(measured, FrameSet):
                first_ns = measured.t_ns if first_ns is None else first_ns
                at_s = (measured.t_ns - first_ns) / NS_PER_S
                images = tuple(
                    np.zeros_like(image) if image is not None and begin <= at_s < end else image
                    for image, (begin, end) in zip(measured.images, BLACK_S, strict=True)
                )
                measured = replace(measured, images=images)
            yield measured


def exact(data: Path, flight: str, assignments: tuple[str, ...]) -> Iterator[Row]:
    """Both back-ends on landmarks that one camera, and both, see almost exactly."""
    for backend, (name, cameras) in product(BACKENDS, CAMERAS.items()):
        sequences = (
            (
                {"clip": flight, "backend": backend, "cameras": f"{name}, exact points", "world": seed},
                real_motion_sequence(
                    data / "euroc_imu_gt" / flight,
                    packaged_calibration("euroc", cameras=cameras),
                    pixel_sigma=EXACT_PX,
                    seed=seed,
                    start_s=EUROC[flight].start_s,
                ),
            )
            for seed in range(WORLDS)
        )
        for row in backend_rows(sequences, backend, assignments):
            yield {**row, "ate_mm": 1e3 * row["ate_m"], "frame_ms": row["cpu_ms"]}


@benchmark
@click.option("--flight", default="MH_05_difficult", show_default=True, type=click.Choice(FLIGHTS))
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, flight: str) -> None:
    """Rendered EuRoC flights by one camera and by two; both back-ends, whatever --backend says."""
    installed = registry.load()

    def flown(bag: Path, backend: str, cameras: str, world: int) -> Row:
        config = Config(
            dataset=DatasetConfig(path=bag, options={"cameras": CAMERAS.get(cameras, CAMERAS["both"])}),
            backend=PartConfig(name=backend),
            start_s=EUROC[flight].start_s,
        )
        experiment = prepare(configuration.override(config, installed, assignments), installed)
        if cameras == "both, black in turn":
            experiment = replace(experiment, dataset=_Covered(experiment.dataset))
        folder = bag.parent / "run"
        row = judged(record(experiment, folder, overwrite=True), folder)
        click.echo(f"{backend}, {cameras}, world {world}: {row.get('ate_mm', float('nan')):.0f} mm", err=True)
        return {**row, "clip": flight, "backend": backend, "cameras": cameras, "world": world}

    def rows() -> Iterator[Row]:
        yield from exact(data, flight, assignments)
        with TemporaryDirectory() as temporary:
            bag = Path(temporary) / "flight.bag"

            def rendered(world: int, **settings: object) -> None:
                recorded = {"recorded": data / "euroc_imu_gt" / flight, "seed": world, "rig": ("stereo",), **settings}
                render(SimulationConfig.model_validate(recorded), installed, bag)

            for world in seeds(WORLDS):
                rendered(world)
                for name in BACKENDS:
                    for cameras in ("one", "both", "both, black in turn"):
                        yield flown(bag, name, cameras, world)
                rendered(world, delay_ms={"cam1": APART_MS})
                for name in BACKENDS:
                    yield flown(bag, name, "both, apart", world)

    settings = {
        "options": list(assignments),
        "start_s": EUROC[flight].start_s,
        "black_s": BLACK_S,
        "apart_ms": APART_MS,
        "exact_px": EXACT_PX,
    }
    present(f"stereo_{flight}", f"{flight}: one camera and two", rows(), COLUMNS, settings, keep)


if __name__ == "__main__":
    main()
