"""Whole EuRoC flights with their real IMU and camera stamps, and images rendered along the path that the IMU felt.

    python benchmarks/rendered_flights.py [--record] [--against anchored=false] [--bags DIR]

Each flight in several of the worlds kept for reporting, which differ by what stands in them and by their textures;
--against has every recording flown a second time, with other options. Nothing is tuned on these flights. Targets.
MH_05_difficult from 5 s on: complete, ATE at most 0.5 m; V1_02_medium: at most 0.15 m. The worlds are simulated: not to
be compared with published ATE on the real images.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import click
from common import bags_option, benchmark, present, render
from euroc_clips import run

from vioframe.bench import Row
from vioframe.bench.suites.sources import EUROC
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.parts.registry import Registry
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.seeds import seed_for

FLIGHTS = ("MH_05_difficult", "V1_02_medium")
WORLDS = 5
COLUMNS = {
    "clip": "",
    "world": "d",
    "detector": "",
    "options": "",
    "path_m": ".1f",
    "initialised_s": ".2f",
    "completion": ".1%",
    "resets": "d",
    "ate_mm": ".0f",
    "scale": ".4f",
    "nees.orientation": ".1f",
    "nees.position": ".1f",
    "held_95.orientation": ".1%",
    "held_95.position": ".1%",
    "frame_ms": ".1f",
    "stage_ms.backend": ".1f",
}


@benchmark
@click.option("--detector", "detectors", multiple=True, default=["shi_tomasi"], help="Default: shi_tomasi.")
@click.option("--worlds", default=WORLDS, show_default=True, help="In how many worlds each flight is flown.")
@click.option("--against", multiple=True, metavar="KEY=VALUE", help="Fly each recording also with these options.")
@bags_option
def main(
    data: Path,
    backend: str,
    assignments: tuple[str, ...],
    keep: bool,
    detectors: tuple[str, ...],
    worlds: int,
    against: tuple[str, ...],
    bags: Path | None,
) -> None:
    """Rendered EuRoC flights, from bag to trajectory."""
    installed = registry.load()
    contenders = [(), against] if against else [()]

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary:
            for world, name in product(seeds(worlds), FLIGHTS):
                bag = recording(bags or Path(temporary), name, world, data, installed)
                for detector, options in product(detectors, contenders):
                    config = Config(
                        dataset=DatasetConfig(path=bag),
                        detector=PartConfig(name=detector),
                        backend=PartConfig(name=backend),
                        start_s=EUROC[name].start_s,
                    )
                    config = configuration.override(config, installed, [*assignments, *options])
                    row = run(config, installed, Path(temporary) / f"{bag.stem}_{detector}_{'_'.join(options)}")
                    yield {**row, "clip": name, "world": world, "options": ", ".join(options)}
                if bags is None:
                    bag.unlink()

    settings = {"backend": backend, "options": list(assignments), "against": list(against)}
    present("rendered_flights", f"{backend}: rendered EuRoC flights", rows(), COLUMNS, settings, keep)


def seeds(worlds: int) -> list[int]:
    """Those of the first ``worlds`` kept for reporting."""
    return [seed_for("reporting", number) for number in range(worlds)]


def recording(folder: Path, flight: str, world: int, data: Path, installed: Registry) -> Path:
    """The bag in ``folder`` with EuRoC's ``flight``, images rendered in ``world``; written where it is not there."""
    bag = folder / f"{flight}_{world}.bag"
    if not bag.exists():
        render(SimulationConfig(recorded=data / "euroc_imu_gt" / flight, seed=world), installed, bag)
    return bag


if __name__ == "__main__":
    main()
