"""Consistency of a back-end: many simulated flights that differ by their noise alone, with and without an option.

    python benchmarks/montecarlo.py [--record]

Target: NEES per axis within 0.7 to 1.5, orientation RMSE at most 0.4 deg, position RMSE at most 0.25 % of the path, and
an NEES far outside without first-estimate Jacobians. 25 flights of 60 s each, EuRoC's noise, true calibration.
"""

from pathlib import Path

import click
from common import benchmark, results_file
from rich.console import Console

from vioframe.bench import record
from vioframe.bench.contenders import parse_contenders
from vioframe.bench.montecarlo import Setup, run_montecarlo
from vioframe.bench.processes import usable_cores
from vioframe.parts import registry
from vioframe.report.montecarlo import to_rich


@benchmark
@click.option("--flight", "flights", multiple=True, default=("figure_eight", "aggressive"), show_default=True)
@click.option("--seeds", default=25, show_default=True, help="Flights of each kind.")
@click.option("--duration", default=60.0, show_default=True, help="Seconds a flight.")
@click.option("--against", default="first_estimate_jacobians=false", show_default=True, help="What to compare with.")
def main(
    data: Path,
    backend: str,
    assignments: tuple[str, ...],
    keep: bool,
    flights: tuple[str, ...],
    seeds: int,
    duration: float,
    against: str,
) -> None:
    """Error against covariance over many simulated flights."""
    # The simulated IMU is as noisy as its data sheet says, and no more.
    told = ["imu_noise_factor=1", *assignments]
    contenders = parse_contenders([backend, f"{backend}:{against}"], told, registry.load())
    setups = [Setup(flight, duration) for flight in flights]
    outcomes = run_montecarlo(setups, contenders, seeds, workers=usable_cores())
    Console(width=200).print(to_rich(outcomes))
    if keep:
        settings = {"backend": backend, "options": list(assignments), "against": against, "seeds": seeds}
        record(results_file("montecarlo", settings), [outcome.to_dict() for outcome in outcomes], settings)


if __name__ == "__main__":
    main()
