"""A back-end on simulated landmarks along five real EuRoC flights, with the IMU that was recorded on them.

    python benchmarks/real_motion.py [--record]

Target: ATE at most 0.5 % of the path on each. 150 landmarks, 1 px of noise, 20 frames a second.
"""

from collections.abc import Iterator
from pathlib import Path

import click
from common import BACKEND_COLUMNS, backend_rows, benchmark, present

from vioframe.bench import Row
from vioframe.simulation import REAL_MOTION_SEQUENCES, TrackSequence, real_motion_sequence


@benchmark
@click.option("--sequence", "names", multiple=True, type=click.Choice(REAL_MOTION_SEQUENCES), help="Default: all five.")
@click.option("--seed", "seeds", multiple=True, type=int, default=(0, 1, 2), help="Default: 0, 1 and 2.")
@click.option("--pixel-sigma", default=1.0, show_default=True, help="Noise of an observation, px.")
@click.option("--max-points", default=150, show_default=True, help="Landmarks in view.")
def main(
    data: Path,
    backend: str,
    assignments: tuple[str, ...],
    keep: bool,
    names: tuple[str, ...],
    seeds: tuple[int, ...],
    pixel_sigma: float,
    max_points: int,
) -> None:
    """Simulated landmarks along real motion with real IMU readings."""

    def sequences() -> Iterator[tuple[Row, TrackSequence]]:
        for name in names or REAL_MOTION_SEQUENCES:
            for seed in seeds:
                yield (
                    {"seed": seed},
                    real_motion_sequence(
                        data / "euroc_imu_gt" / name,
                        pixel_sigma=pixel_sigma,
                        max_points=max_points,
                        seed=seed,
                    ),
                )

    settings = {
        "backend": backend,
        "options": list(assignments),
        "pixel_sigma": pixel_sigma,
        "max_points": max_points,
    }
    present(
        "real_motion",
        f"{backend}: simulated landmarks along real motion",
        backend_rows(sequences(), backend, assignments),
        BACKEND_COLUMNS,
        settings,
        keep,
    )


if __name__ == "__main__":
    main()
