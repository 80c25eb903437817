"""The whole pipeline on the real EuRoC images there are, once for each detector.

    python benchmarks/euroc_clips.py [--record]

Targets. MH_01_easy_15s, read from a ROS 1 bag, starts in motion: initialised within 3 s, complete after that, ATE at
most 15 mm with shi_tomasi and 25 mm with the others. V1_01_easy_rest stands still and drifts by at most 10 mm from
where it was first. Front-end and back-end together take at most 15 ms a frame.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
from common import benchmark, present

from vioframe.bench import Row
from vioframe.bench.detectors.entrants import line_up, parse_entrants
from vioframe.evaluation import evaluate
from vioframe.io.convert import convert
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config, DatasetConfig, PartConfig
from vioframe.parts.registry import DETECTOR, Registry
from vioframe.pipeline import prepare, record
from vioframe.runs.folder import RunFolder

TRUTH = "mav0/state_groundtruth_estimate0/data.csv"
COLUMNS = {
    "clip": "",
    "detector": "",
    "initialised_s": ".2f",
    "completion": ".1%",
    "resets": "d",
    "ate_mm": ".1f",
    "scale": ".4f",
    "drift_mm": ".1f",
    "stage_ms.klt": ".1f",
    "stage_ms.detect": ".1f",
    "stage_ms.backend": ".1f",
    "frame_ms": ".1f",
}


@benchmark
@click.option("--detector", "detectors", multiple=True, help="Default: all that need nothing more.")
def main(data: Path, backend: str, assignments: tuple[str, ...], keep: bool, detectors: tuple[str, ...]) -> None:
    """Real EuRoC images, from bag to trajectory."""
    installed = registry.load()
    names = detectors or _ready(installed)

    def rows() -> Iterator[Row]:
        with TemporaryDirectory() as temporary:
            moving, resting = data / "euroc/MH_01_easy_15s", data / "euroc/V1_01_easy_rest"
            bag = Path(temporary) / "MH_01_easy_15s.bag"
            source = installed.open_dataset(moving, options={"cameras": ["cam0"]})
            convert(source.measurements(), source.calibration, bag)
            for recording, clip in ((bag, moving), (resting, resting)):
                for detector in names:
                    config = Config(
                        dataset=DatasetConfig(path=recording),
                        detector=PartConfig(name=detector),
                        backend=PartConfig(name=backend),
                        ground_truth=clip / TRUTH,
                    )
                    config = configuration.override(config, installed, assignments)
                    yield run(config, installed, Path(temporary) / f"{clip.name}_{detector}")

    settings = {"backend": backend, "options": list(assignments)}
    present("euroc_clips", f"{backend}: real EuRoC images", rows(), COLUMNS, settings, keep)


def _ready(installed: Registry) -> tuple[str, ...]:
    """Detectors that can be made as they are: no library or file of weights is missing."""
    return tuple(
        entrant.name
        for entrant, _ in line_up(parse_entrants(installed.names(DETECTOR), (), installed), installed).ready
    )


def run(config: Config, installed: Registry, folder: Path) -> Row:
    """One run, and what its folder says of it."""
    return {"detector": config.detector.name, **judged(record(prepare(config, installed), folder), folder)}


def judged(summary: Mapping[str, Any], folder: Path) -> Row:
    """What a run came to, by its ``summary`` and the truth in its ``folder``."""
    row = {
        "clip": summary["dataset"],
        "initialised_s": summary["initialised_after_s"],
        "completion": summary["completion"],
        "resets": summary["resets"],
        "incidents": summary["incidents"],
        "frame_ms": summary["mean_frame_ms"],
        "stage_ms": summary["mean_ms"],
    }
    done = RunFolder.open(folder)
    estimate, truth = done.trajectory(), done.ground_truth()
    if estimate is not None and truth is not None:
        errors = evaluate(estimate, truth)
        from_first = errors.position_m - errors.position_m[0]
        row |= {
            "path_m": errors.truth.path_length_m,
            "ate_mm": 1e3 * errors.ate_m.rmse,
            "ate_se3_mm": None if errors.ate_se3_m is None else 1e3 * errors.ate_se3_m,
            "scale": errors.scale,
            "drift_mm": 1e3 * float(np.linalg.norm(from_first, axis=1).max()),
            "nees": {found.part: found.mean for found in errors.nees},
            "held_95": {found.part: found.held for found in errors.nees},
        }
    return row


if __name__ == "__main__":
    main()
