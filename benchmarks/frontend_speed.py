"""The front-end with each detector on real images: milliseconds by stage, and how long and true its tracks are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import cv2
import numpy as np
from common import SHARED_DATA, present
from threadpoolctl import threadpool_limits

from vioframe.bench import Row
from vioframe.evaluation.epipolar import epipolar_errors_px
from vioframe.frontend import Frontend, FrontendOptions
from vioframe.incidents import Incidents
from vioframe.interfaces import Dataset
from vioframe.io.synchronise import synchronise
from vioframe.parts import registry
from vioframe.types import FrameTracks

COLUMNS = {
    "detector": "",
    "threads": "",
    "ms.equalise": ".2f",
    "ms.klt": ".2f",
    "ms.reject": ".2f",
    "ms.detect": ".2f",
    "ms.total": ".2f",
    "alive": ".0f",
    "lifetime": ".1f",
    "px.1": "",
    "px.5": "",
    "px.10": "",
}
TITLE = "Front-end: mean ms a frame, tracks alive, frames lived, epipolar error over 1, 5, 10 frames (median / 95 %)"


@click.command(context_settings={"show_default": True})
@click.argument("sequence", type=click.Path(path_type=Path), default=SHARED_DATA / "euroc" / "MH_01_easy_15s")
@click.option("--detector", "detectors", multiple=True, default=["shi_tomasi", "fast", "orb", "sift"])
@click.option("--threads", "thread_counts", multiple=True, type=int, default=[1, 2], help="Threads of OpenCV.")
@click.option("--max-points", default=FrontendOptions().max_points)
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
def main(
    sequence: Path, detectors: tuple[str, ...], thread_counts: tuple[int, ...], max_points: int, keep: bool
) -> None:
    """Time the front-end on SEQUENCE, image decoding excluded, and hold its tracks against the ground truth."""
    installed = registry.load()
    dataset = installed.open_dataset(sequence, options={"cameras": ["cam0"]})
    options = FrontendOptions(max_points=max_points)

    def rows() -> Iterator[Row]:
        with threadpool_limits(1):  # OpenCV's own threads are counted apart
            for threads in thread_counts:
                cv2.setNumThreads(threads)
                for name in detectors:
                    frontend = Frontend(installed.create_detector(name), dataset.calibration, options, Incidents())
                    yield {"detector": name, "threads": threads, **measure(frontend, dataset)}

    present("frontend_speed", TITLE, rows(), COLUMNS, {"sequence": sequence.name, "max_points": max_points}, keep)


def measure(frontend: Frontend, dataset: Dataset) -> Row:
    steps, seconds = [], []
    for imu, frame in synchronise(dataset.measurements(), incidents=Incidents()):
        steps.append(frontend.track(imu, frame, dataset.calibration))
        seconds.append(frontend.stage_seconds)
    ms = {stage: 1e3 * float(np.mean([s.get(stage, 0.0) for s in seconds])) for stage in seconds[-1]}
    lifetimes = np.unique(np.concatenate([s.ids for s in steps]), return_counts=True)[1]
    return {
        "frames": len(steps),
        "ms": {**ms, "total": sum(ms.values())},
        "alive": float(np.mean([len(s.ids) for s in steps])),
        "lifetime": float(lifetimes.mean()),
        "px": {str(b): epipolar_summary(steps, dataset, b) for b in (1, 5, 10)},
    }


def epipolar_summary(steps: list[FrameTracks], dataset: Dataset, baseline: int) -> str | None:
    if dataset.ground_truth is None:
        return None
    error = epipolar_errors_px(steps, dataset.ground_truth, dataset.calibration, baseline)
    return f"{np.median(error):.2f} / {np.quantile(error, 0.95):.2f}"


if __name__ == "__main__":
    main()
