"""A rolling shutter of 30 ms against a global one: the same rendered flights, the readout told, hidden and estimated.

    python benchmarks/rolling_shutter.py [--record] [--backend NAME] [--recordings FOLDER]

Target. With the readout told, ATE at most 1.15 times that with a global shutter; estimated from zero it ends within
2 ms of the truth. Each flight is rendered in three worlds. Points are followed once a recording; a back-end, which
initialises itself, is flown from starts four seconds apart. Pieces of one world overlap, so their spread is not that of
independent flights.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from common import benchmark, present, render, tracked

from vioframe.bench import Row, backend_row, run_backend
from vioframe.cores import limited_threads
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, PartConfig
from vioframe.parts.registry import FLIGHT, Registry
from vioframe.simulation import TrackSequence
from vioframe.simulation.config import SimulationConfig
from vioframe.types import NS_PER_S

FLIGHTS_S = {"figure_eight": 30.0, "aggressive": 20.0}
WORLDS = (0, 1, 2)
READOUT_MS = 30.0
PIECE_S, EVERY_S = 12.0, 4.0
# What the shutter is, what the back-end is told of it, both ms, and whether it estimates it.
CASES = {
    "global": (0.0, 0.0, False),
    "rolling, told": (READOUT_MS, READOUT_MS, False),
    "rolling, not told": (READOUT_MS, 0.0, False),
    "rolling, estimated from 0 ms": (READOUT_MS, 0.0, True),
}
COLUMNS = {
    "flight": "",
    "shutter": "",
    "world": "d",
    "start_s": ".0f",
    "initialised_s": ".2f",
    "completion": ".1%",
    "resets": "d",
    "ate_m": ".4f",
    "scale": ".4f",
    "readout_ms": ".2f",
    "readout_sigma_ms": ".2f",
    "cpu_ms": ".2f",
}


@benchmark
@click.option(
    "--recordings",
    type=click.Path(file_okay=False, path_type=Path),
    help="Folder of the recordings, FLIGHT_WORLD_READOUT.bag; made there where missing.  [default: none is kept]",
)
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, recordings: Path | None) -> None:
    """Rendered flights with a global and a rolling shutter."""
    installed = registry.load()
    config = configuration.override(Config(backend=PartConfig(name=backend)), installed, assignments)

    def rows() -> Iterator[Row]:
        with ExitStack() as stack:
            folder = recordings or Path(stack.enter_context(TemporaryDirectory()))
            folder.mkdir(parents=True, exist_ok=True)
            for (flight, duration_s), world in product(FLIGHTS_S.items(), WORLDS):
                bags = {ms: rendered(folder, flight, world, duration_s, ms, installed) for ms in (0.0, READOUT_MS)}
                seen = {
                    ms: tracked(installed.open_dataset(bag), installed.create_detector("shi_tomasi"))
                    for ms, bag in bags.items()
                }
                for shutter, (true_ms, told_ms, estimate) in CASES.items():
                    for start_s in np.arange(0.0, duration_s - PIECE_S + 0.5 * EVERY_S, EVERY_S).tolist():
                        sequence = piece(seen[true_ms], start_s, 1e-3 * told_ms)
                        options = {**config.backend.options, "calibrate_readout": estimate}
                        estimator = installed.create_backend(backend, options)
                        with limited_threads():
                            run = run_backend(sequence, estimator, config.estimation_options)
                        row = {
                            "flight": flight,
                            "shutter": shutter,
                            "world": world,
                            "start_s": start_s,
                            **backend_row(sequence, run),
                        }
                        learned = run.estimates[-1].calibration
                        if learned is not None:
                            row["readout_ms"] = 1e3 * learned.calibration.cameras[0].readout_s
                            row["readout_sigma_ms"] = 1e3 * learned.sigma[0].readout_s
                        yield row

    settings = {
        "backend": backend,
        "options": list(assignments),
        "readout_ms": READOUT_MS,
        "piece_s": PIECE_S,
        "every_s": EVERY_S,
        "flights_s": FLIGHTS_S,
        "worlds": WORLDS,
    }
    present("rolling_shutter", f"{backend}: rolling shutter of {READOUT_MS:g} ms", rows(), COLUMNS, settings, keep)


def rendered(folder: Path, flight: str, world: int, duration_s: float, readout_ms: float, installed: Registry) -> Path:
    """The recording of a flight, made where it is missing; ``world`` is the seed of all that is random."""
    bag = folder / f"{flight}_{world}_{readout_ms:g}.bag"
    if not bag.exists():
        config = SimulationConfig(
            flight=PartConfig(name=installed.find(FLIGHT, flight).name),
            duration_s=duration_s,
            readout_ms=readout_ms,
            seed=world,
        )
        render(config, installed, bag)
    return bag


def piece(sequence: TrackSequence, start_s: float, told_s: float) -> TrackSequence:
    """``PIECE_S`` seconds from ``start_s`` on, of a camera whose readout is said to be ``told_s``."""
    begin_ns = sequence.packets[0][1].t_ns + round(start_s * NS_PER_S)
    end_ns = begin_ns + round(PIECE_S * NS_PER_S)
    packets = tuple(packet for packet in sequence.packets if begin_ns <= packet[1].t_ns <= end_ns)
    return replace(sequence, packets=packets, calibration=sequence.calibration.with_camera(0, readout_s=told_s))


if __name__ == "__main__":
    main()
