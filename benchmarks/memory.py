"""What an hour of flight takes: the memory of a process that estimates from simulated landmarks, and records.

    python benchmarks/memory.py [--record] [--minutes M]

Targets, for an hour: after the first minute memory grows by less than 50 MB with every back-end, the recorder running,
the map included; with the loop closer, by what it remembers of its keyframes, by less than 300 MB.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import click
import numpy as np
import psutil
from common import present, script

from vioframe.bench import Row
from vioframe.cores import limited_threads
from vioframe.incidents import Incidents
from vioframe.io.calibration import packaged_calibration
from vioframe.odometry import Odometry
from vioframe.runs.recorder import Recorder
from vioframe.simulation import TrackOptions, simulated_stream
from vioframe.types import FrameTracks, ImuSample, Step

COLUMNS = {
    "backend": "",
    "loop_closer": "",
    "minutes": ".0f",
    "frames": "d",
    "completion": ".1%",
    "first_minute_mb": ".0f",
    "grown_mb": ".1f",
    "landmarks": "d",
    "frame_ms": ".1f",
}
FRAME_RATE_HZ, POINTS = 10.0, 60


@script
@click.option("--record", "keep", is_flag=True, help="Write the results to benchmarks/results.")
@click.option("--minutes", default=60.0, show_default=True, help="Length of the flight.")
@click.option("--backend", "backends", multiple=True, default=["msckf", "sliding_window", "loose_ekf"])
def main(keep: bool, minutes: float, backends: tuple[str, ...]) -> None:
    """How memory grows in a long flight."""
    settings = {"minutes": minutes, "frame_rate_hz": FRAME_RATE_HZ, "points": POINTS}
    cases = [*((backend, None) for backend in backends), ("msckf", "pose_graph")]
    present("memory", "memory in a long flight", _rows(cases, minutes), COLUMNS, settings, keep)


def _rows(cases: list[tuple[str, str | None]], minutes: float) -> Iterator[Row]:
    for case in cases:
        # Each in a process of its own, which has nothing else in memory.
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            yield pool.apply(fly, (*case, minutes))


def fly(backend: str, loop_closer: str | None, minutes: float) -> Row:
    """A row of the table; memory is what the process has in use, not its peak."""
    calibration = packaged_calibration("euroc", cameras=["cam0"])
    odometry = Odometry(calibration, backend=backend, loop_closer=loop_closer)
    stream = simulated_stream(
        "figure_eight", options=TrackOptions(max_points=POINTS), duration_s=60.0 * minutes, frame_rate_hz=FRAME_RATE_HZ
    )
    begin_s = perf_counter()
    process, first_minute = psutil.Process(), 0
    frames = 0
    with TemporaryDirectory() as folder, limited_threads():
        with Recorder(Path(folder), {}, Incidents(), begin_s) as recorder:
            for item in stream:
                pictured = loop_closer is not None
                steps = odometry.add(item) if isinstance(item, ImuSample) else _add(odometry, item, pictured)
                for step in steps:
                    frames += 1
                    recorder.add(step)
                    if frames == round(60.0 * FRAME_RATE_HZ):
                        first_minute = process.memory_info().rss
            grown = process.memory_info().rss - first_minute
        landmarks = sum(1 for _ in (Path(folder) / "map.ply").open()) - 8
    return {
        "backend": backend,
        "loop_closer": loop_closer or "",
        "minutes": minutes,
        "frames": frames,
        "completion": recorder.summary["completion"],
        "first_minute_mb": first_minute / 1e6,
        "grown_mb": grown / 1e6,
        "landmarks": landmarks,
        "frame_ms": 1e3 * (perf_counter() - begin_s) / frames,
    }


def _add(odometry: Odometry, tracks: FrameTracks, pictured: bool) -> list[Step]:
    """The landmarks of a frame, with a picture of noise where somebody looks at it."""
    if not pictured:
        return odometry.add_tracks(tracks)
    width, height = odometry.calibration.cameras[0].model.resolution
    rng = np.random.default_rng(tracks.t_ns)
    image = np.kron(rng.integers(0, 256, (height // 8, width // 8), np.uint8), np.ones((8, 8), np.uint8))
    image.flags.writeable = False
    return odometry.add_tracks(tracks, (image,))


if __name__ == "__main__":
    main()
