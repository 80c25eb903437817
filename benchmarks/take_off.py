"""Take-off from rest: how far off the estimate is in the seconds after it.

    python benchmarks/take_off.py [--record]

The flight of `make demo` (`inspection`: at rest for 1.5 s, then up and around a tank), rendered, in its world and in
others, which nothing was looked at in before. Target: within 15 mm in the five seconds after take-off in the demo's.
All back-ends fly it, whatever --backend says.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from common import benchmark, present, render
from euroc_clips import run

from vioframe.bench import Row
from vioframe.evaluation import evaluate
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.runs.folder import RunFolder
from vioframe.simulation.config import SimulationConfig
from vioframe.types import NS_PER_S

BACKENDS = ("msckf", "sliding_window", "loose_ekf")
# The demo's world, and others.
WORLDS = (0, 10, 11, 12, 13, 14)
FLIGHT, DURATION_S, AFTER_S = "inspection", 25.0, 5.0
# A body that has moved by this has taken off.
OFF_M = 0.02
COLUMNS = {
    "world": "d",
    "backend": "",
    "resets": "d",
    "ate_mm": ".1f",
    "after_take_off_mm": ".1f",
    "nees.orientation": ".1f",
    "nees.position": ".1f",
}


@benchmark
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool) -> None:
    """A rendered flight that begins at rest."""
    installed = registry.load()

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary:
            for world in WORLDS:
                bag = Path(temporary) / f"{world}.bag"
                simulated = SimulationConfig(flight=PartConfig(name=FLIGHT), duration_s=DURATION_S, seed=world)
                render(simulated, installed, bag)
                for name in BACKENDS:
                    config = Config(dataset=DatasetConfig(path=bag), backend=PartConfig(name=name))
                    folder = Path(temporary) / f"{world}_{name}"
                    row = run(configuration.override(config, installed, assignments), installed, folder)
                    yield {**row, "world": world, "backend": name, "after_take_off_mm": after_take_off_mm(folder)}
                bag.unlink()

    settings = {"options": list(assignments), "flight": FLIGHT, "duration_s": DURATION_S, "after_s": AFTER_S}
    present("take_off", "Take-off from rest", rows(), COLUMNS, settings, keep)


def after_take_off_mm(folder: Path) -> float | None:
    """The largest error of position in the :data:`AFTER_S` after take-off; None without an estimate before it."""
    done = RunFolder.open(folder)
    estimate, truth = done.trajectory(), done.ground_truth()
    if estimate is None or truth is None:
        return None
    errors = evaluate(estimate, truth)
    true = errors.truth
    off = np.linalg.norm(true.p_WB - true.p_WB[0], axis=1) > OFF_M
    if off[0] or not off.any():
        return None
    since_s = (true.t_ns - true.t_ns[off.argmax()]) / NS_PER_S
    shortly = (since_s >= 0.0) & (since_s <= AFTER_S)
    return 1e3 * float(np.linalg.norm(errors.position_m[shortly], axis=1).max())


if __name__ == "__main__":
    main()
