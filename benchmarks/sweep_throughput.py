"""How many times as much two workers of a sweep get done as one.

    python benchmarks/sweep_throughput.py [--record]

Target: at least 1.8 times. The same flights by one worker and by two, in turns; the recording is made beforehand. Time
is that of the whole sweep, from a cluster that has to start to the last result written.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import click
from common import benchmark, present

from vioframe.bench import Row
from vioframe.bench.suites.plan import plan
from vioframe.bench.suites.store import Store
from vioframe.bench.suites.suite import Suite
from vioframe.bench.suites.sweep import Sweep
from vioframe.bench.suites.tasks import simulate
from vioframe.parts import registry
from vioframe.parts.config import validate

COLUMNS = {"workers": "d", "flights": "d", "seconds": ".1f", "flights_per_minute": ".2f", "times_one": ".2f"}


@benchmark
@click.option("--flights", default=24, show_default=True, help="Flights of 10 s.")
@click.option("--rounds", default=1, show_default=True, help="Turns.")
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, flights: int, rounds: int) -> None:
    """Throughput of a sweep by the number of its workers."""
    del data, assignments
    tree = {
        "name": "throughput",
        "title": "throughput",
        "detectors": ["shi_tomasi", "fast"],
        "backends": [backend],
        # Long enough for every seed, which starts 0.5 s after the one before.
        "sequences": [{"name": "figure_eight", "duration_s": 10.0}],
        "seeds": flights // 2,
    }
    suite = validate(Suite, tree, "throughput")
    tasks = plan(suite, (), registry.load())

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary:
            recordings = Path(temporary) / "recordings"
            store = Store.at(Path(temporary) / "none", recordings)
            store.begin(suite, overwrite=False)
            for recording in Sweep(tasks, store).recordings.values():
                simulate(recording, store, 2)
            seconds = {1: 0.0, 2: 0.0}
            for turn in range(rounds):
                for workers in seconds:
                    store = Store.at(Path(temporary) / f"{workers}_{turn}", recordings)
                    store.begin(suite, overwrite=False)
                    begin_s = perf_counter()
                    sweep = Sweep(tasks, store)
                    sweep.run(workers=workers)
                    seconds[workers] += perf_counter() - begin_s
                    assert sweep.done == len(tasks), sweep.failed
            for workers, taken in seconds.items():
                yield {
                    "workers": workers,
                    "flights": flights * rounds,
                    "seconds": taken,
                    "flights_per_minute": 60.0 * flights * rounds / taken,
                    "times_one": seconds[1] / taken,
                }

    settings = {"backend": backend, "rounds": rounds}
    present("sweep_throughput", "Throughput of a sweep", rows(), COLUMNS, settings, keep)


if __name__ == "__main__":
    main()
