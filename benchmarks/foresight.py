"""What the best of all detectors would be worth: flights by points of which it is known what will become of them.

    python benchmarks/foresight.py [--worlds 3] [--record]

The flight of the suite stress, in worlds for reporting, in the clear and under each of its conditions. Of every third
image 900 random points are followed for three seconds ahead, as for the training of KeypointNet, and the detector
``foresight`` offers them, those first of which most is to be learned about their landmarks; in the images between it
finds nothing. Beside it Shi-Tomasi and KeypointNet, which may take any point of any image, with the options of stress.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import chain, product
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import numpy as np
from common import HERE, backend_rows, present, render, script, tracked
from rendered_flights import seeds
from threadpoolctl import threadpool_limits

from vioframe.bench import Row
from vioframe.bench.suites import suite
from vioframe.bench.suites.sources import tour
from vioframe.cores import usable_cores
from vioframe.interfaces import Detector
from vioframe.parts import registry
from vioframe.simulation.config import SimulationConfig
from vioframe.types import Image, Keypoints
from vioframe_keypointnet.training.followed import Followed, follow, wanted

FLIGHT, DURATION_S = "V1_02_medium", 30.0
LEVEL = 0.67
EVERY, POINTS, APART_PX = 3, 900, 5.0
BACKENDS = ("msckf", "sliding_window")
BESIDE = ("shi_tomasi", "keypointnet")
COLUMNS = {"condition": "", "world": "d", "detector": "", "backend": "", "ate_mm": ".1f", "completion": ".1%"}


class Foresight:
    """Finds, in the images that points were ``followed`` from, these points: first those that told most."""

    best_first = True

    def __init__(self, followed: Sequence[Followed]) -> None:
        self._followed = {picture.pixels.tobytes(): picture for picture in followed}

    def detect(self, image: Image, max_points: int) -> Keypoints:
        if (picture := self._followed.get(image.tobytes())) is None:
            return Keypoints(np.empty((0, 2), np.float32), np.empty(0, np.float32))
        score = wanted("information", picture)[0].astype(np.float32)
        first = np.argsort(-score, kind="stable")[:max_points]
        return Keypoints(picture.xy[first], score[first])


@script
@click.option("--worlds", default=3, show_default=True, help="In how many worlds it is flown.")
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
def main(worlds: int, keep: bool) -> None:
    """The error of back-ends by points of which it is known what will become of them."""
    conditions = "", *suite.read(HERE / "suites" / "stress.yaml").conditions
    flights = list(product(conditions, seeds(worlds)))
    settings = {
        "flight": FLIGHT,
        "duration_s": DURATION_S,
        "level": LEVEL,
        "every": EVERY,
        "points": POINTS,
        "apart_px": APART_PX,
    }
    with ProcessPoolExecutor(usable_cores(), mp_context=get_context("spawn")) as workers:
        rows = chain.from_iterable(workers.map(flown, *zip(*flights, strict=True)))
        present("foresight", "ATE by points whose fate is known", rows, COLUMNS, settings, keep)


def flown(condition: str, world: int) -> list[Row]:
    """One flight, by all detectors and back-ends."""
    installed = registry.load()
    parts = [part for part in suite.read(HERE / "suites" / "stress.yaml").detectors if part.name in BESIDE]
    with TemporaryDirectory() as temporary, threadpool_limits(1):
        bag = Path(temporary) / "flight.bag"
        simulated = SimulationConfig(
            flight=tour(FLIGHT),
            duration_s=DURATION_S,
            seed=world,
            conditions={condition: LEVEL} if condition else {},
        )
        render(simulated, installed, bag)
        detectors: dict[str, Detector] = {
            part.called: installed.create_detector(part.name, part.options) for part in parts
        }
        detectors["foresight"] = Foresight(follow(bag, every=EVERY, points=POINTS, apart_px=APART_PX))
        sequences = [
            (
                {"condition": condition or "clear", "world": world, "detector": name},
                tracked(installed.open_dataset(bag), detector),
            )
            for name, detector in detectors.items()
        ]
        rows = [{**row, "backend": backend} for backend in BACKENDS for row in backend_rows(sequences, backend, ())]
    return [{**row, "ate_mm": 1e3 * row["ate_m"]} for row in rows if "ate_m" in row]


if __name__ == "__main__":
    main()
