"""Whole EuRoC flights with their real IMU, camera stamps and true poses, and images rendered from those poses.

    python benchmarks/rendered_flights.py [--record]

Targets. MH_05_difficult from 5 s on: complete, ATE at most 0.5 m.
V1_02_medium: at most 0.15 m. The world is simulated: not to be compared with published ATE on the real images.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import click
from common import benchmark, present
from euroc_clips import run

from vioframe.bench import Row
from vioframe.cores import usable_cores
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.simulation.config import SimulationConfig, complete
from vioframe.simulation.record import record
from vioframe.simulation.recording import SimulatedRecording

START_S = {"MH_05_difficult": 5.0, "V1_02_medium": 0.0}
COLUMNS = {
    "clip": "",
    "detector": "",
    "path_m": ".1f",
    "initialised_s": ".2f",
    "completion": ".1%",
    "resets": "d",
    "ate_mm": ".0f",
    "scale": ".4f",
    "frame_ms": ".1f",
    "stage_ms.backend": ".1f",
    "rendered_per_s": ".1f",
}


@benchmark
@click.option("--detector", "detectors", multiple=True, default=["shi_tomasi"], help="Default: shi_tomasi.")
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, detectors: tuple[str, ...]) -> None:
    """Rendered EuRoC flights, from bag to trajectory."""
    installed = registry.load()
    workers = usable_cores()

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary:
            for name, start_s in START_S.items():
                bag = Path(temporary) / f"{name}.bag"
                simulated = SimulationConfig(recorded=data / "euroc_imu_gt" / name)
                recording = SimulatedRecording(complete(simulated, installed), installed, workers)
                begin_s = perf_counter()
                record(recording, [bag])
                rendered_per_s = recording.frame_count / (perf_counter() - begin_s)
                for detector in detectors:
                    config = Config(
                        dataset=DatasetConfig(path=bag),
                        detector=PartConfig(name=detector),
                        backend=PartConfig(name=backend),
                        start_s=start_s,
                    )
                    config = configuration.override(config, installed, assignments)
                    row = run(config, installed, Path(temporary) / f"{name}_{detector}")
                    yield {**row, "rendered_per_s": rendered_per_s}
                bag.unlink()

    settings = {"backend": backend, "options": list(assignments), "start_s": START_S, "workers": workers}
    present("rendered_flights", f"{backend}: rendered EuRoC flights", rows(), COLUMNS, settings, keep)


if __name__ == "__main__":
    main()
