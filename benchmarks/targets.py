"""What a KeypointNet is trained for: the same network, on the same flights, once for each target, and what ships.

    python benchmarks/targets.py [--out targets] [--record]
    vioframe bench benchmarks/targets.yaml

The first simulates flights in worlds for training, follows their points, and trains `compact` for each target by which
a point that was followed can be judged; the weights lie in the folder. Flights and followed points that are there are
not made again. The second flies with these weights, in worlds for tuning.
"""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from itertools import chain
from multiprocessing import get_context
from pathlib import Path
from typing import get_args

import click
from common import present, render, script
from threadpoolctl import threadpool_limits

from vioframe.bench import Row
from vioframe.bench.suites.sources import tour
from vioframe.cores import usable_cores
from vioframe.parts import registry
from vioframe.simulation.config import SimulationConfig
from vioframe.simulation.seeds import seed_for
from vioframe_keypointnet import weights
from vioframe_keypointnet.network import of_weights
from vioframe_keypointnet.options import Target, TrainingOptions
from vioframe_keypointnet.training.followed import Followed, follow, rank_correlation
from vioframe_keypointnet.training.samples import simulated_worlds
from vioframe_keypointnet.training.trainer import Training

TOURS = ("V2_02_medium", "V1_01_easy", "MH_03_medium", "V2_01_easy")
CONDITIONS: tuple[dict[str, float], ...] = (
    {},
    {"motion_blur": 0.6},
    {"low_texture": 0.9},
    {"low_light": 0.8},
    {"fog": 0.8},
    {"low_texture": 0.6},
    {"exposure": 0.8},
    {"motion_blur": 0.9},
)
DURATION_S = 20.0
HELD_OUT = 4
"""The last of the flights, on which it is told how well a network orders points."""
START = "compact"
SHIPPED = ("compact", "tracks")
CALIBRATED = 64
"""Images, about, on which the reach of each layer is measured for int8."""
TARGETS: tuple[Target, ...] = get_args(Target)[1:]
OPTIONS = TrainingOptions(
    dropout=0.0, size=(376, 240), batch=4, epochs=12, halve_at=(5, 8, 10, 11), learning_rate=2e-3, threads=1
)
COLUMNS = {"trained for": "", "steps": "d"} | {f"order.{target}": ".2f" for target in TARGETS}


@script
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("targets"), show_default=True)
@click.option("--flights", default=24, show_default=True, help="Flights that are followed.")
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
def main(out: Path, flights: int, keep: bool) -> None:
    """How well networks order points as each target does (rank correlation on flights held out), by what they saw."""
    out.mkdir(parents=True, exist_ok=True)
    settings = {"flights": flights, "held_out": HELD_OUT, "duration_s": DURATION_S, "options": asdict(OPTIONS)}
    with ProcessPoolExecutor(usable_cores(), mp_context=get_context("spawn")) as workers:
        kept = list(workers.map(followed, [out] * flights, range(flights)))
        rows = chain(
            workers.map(trained, TARGETS, [out] * len(TARGETS), [kept] * len(TARGETS)),
            (ships(name, kept) for name in SHIPPED),
        )
        present("targets", "Rank correlation with what became of points", rows, COLUMNS, settings, keep)


def followed(out: Path, number: int) -> Path:
    """Where it is kept what became of the points of the ``number``-th flight for training."""
    kept = out / f"flight_{number:02}.followed"
    if not kept.exists():
        simulated = SimulationConfig(
            flight=tour(TOURS[number // 2 % len(TOURS)]),
            duration_s=DURATION_S,
            seed=seed_for("training", number),
            conditions=CONDITIONS[number % len(CONDITIONS)],
        )
        bag = kept.with_suffix(".bag")
        render(simulated, registry.load(), bag)
        with threadpool_limits(1):
            kept.write_bytes(pickle.dumps(follow(bag)))
    return kept


def trained(target: Target, out: Path, kept: Sequence[Path]) -> Row:
    """The network for ``target``: how it orders what is held out."""
    shown = pictures(kept[:-HELD_OUT])
    training = Training(replace(OPTIONS, target=target), shown)
    training.start_from(weights.load(START))
    training.saw(simulated_worlds(path.with_suffix(".bag") for path in kept[:-HELD_OUT]))
    for _ in training.steps():
        pass
    training.write(out / f"{target}.safetensors", shown[:: len(shown) // CALIBRATED], {"started_from": START})
    return {"trained for": target, "steps": training.step, "order": order(training.weights(), kept)}


def ships(name: str, kept: Sequence[Path]) -> Row:
    """How the weights ``name`` that ship order what is held out."""
    return {"trained for": f"ships as {name}", "steps": 0, "order": order(weights.load(name), kept)}


def order(made: weights.Weights, kept: Sequence[Path]) -> dict[str, float]:
    """How well they order the points of the flights held out as each target does."""
    network, held_out = of_weights(made), pictures(kept[-HELD_OUT:])
    return {target: rank_correlation(network, held_out, target) for target in TARGETS}


def pictures(kept: Sequence[Path]) -> list[Followed]:
    return [picture for path in kept for picture in pickle.loads(path.read_bytes())]


if __name__ == "__main__":
    main()
