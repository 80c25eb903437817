"""``vioframe montecarlo``: back-ends on many simulated flights; are they accurate, and do they know how accurate?"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from collections.abc import Callable

    from vioframe.evaluation.consistency import Trial

_WIDE = 1000


@click.command("montecarlo")
@click.option(
    "--backend",
    "backends",
    metavar="NAME[:KEY=VALUE,...]",
    multiple=True,
    default=("msckf:imu_noise_factor=1",),
    show_default=True,
    help="Estimator, with options of its own; repeat to compare.",
)
@click.option(
    "--flight",
    "flights",
    metavar="NAME",
    multiple=True,
    default=("figure_eight",),
    show_default=True,
    help="Flight; repeat for more.",
)
@click.option("--seeds", type=int, default=25, show_default=True, help="Trials of each back-end on each flight.")
@click.option("--duration", type=float, metavar="S", default=60.0, show_default=True, help="Length of a flight.")
@click.option(
    "--pixel-sigma", type=float, metavar="PX", default=1.0, show_default=True, help="Noise of an observation."
)
@click.option(
    "--outliers", type=float, metavar="PART", default=0.0, show_default=True, help="Observations that are 5-30 px off."
)
@click.option("--max-points", type=int, default=150, show_default=True, help="Landmarks in view.")
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Set an option of all back-ends.")
@click.option("--workers", type=int, help="Processes.  [default: one a core]")
@click.option("--out", type=click.Path(path_type=Path), help="Folder.  [default: runs/montecarlo]")
@click.option("--overwrite", is_flag=True, help="Replace the results that are in --out.")
@click.option("--quiet", is_flag=True, help="No progress bar.")
def command(
    backends: tuple[str, ...],
    flights: tuple[str, ...],
    options: tuple[str, ...],
    seeds: int,
    workers: int | None,
    out: Path | None,
    overwrite: bool,
    quiet: bool,
    **sensors: Any,
) -> None:
    """Fly simulated flights that differ by their noise alone, and compare errors with what back-ends say of them.

    Landmarks instead of images, EuRoC's camera and IMU noise, true calibration, the back-end's own initialisation. A
    trial that fails counts and is shown. docs/montecarlo.md says how to read the table and the plots.
    """
    from vioframe.bench.contenders import parse_contenders
    from vioframe.bench.montecarlo import Setup, check_montecarlo, run_montecarlo
    from vioframe.bench.processes import usable_cores
    from vioframe.bench.results import record
    from vioframe.parts import registry
    from vioframe.report.montecarlo import MARKER, to_rich, write_files
    from vioframe.runs.recorder import check_run_folder, free_run_folder, new_run_folder

    if out is not None:
        check_run_folder(out, overwrite=overwrite, marker=MARKER)
    setups = [
        Setup(flight, sensors["duration"], sensors["pixel_sigma"], sensors["outliers"], sensors["max_points"])
        for flight in dict.fromkeys(flights)
    ]
    contenders = parse_contenders(backends, options, registry.load())
    workers = usable_cores() if workers is None else workers
    check_montecarlo(setups, contenders, seeds, workers)  # before there is a bar: an error is one line and nothing else
    with _watch(len(setups) * len(contenders) * seeds, quiet) as on_trial:
        outcomes = run_montecarlo(setups, contenders, seeds, workers=workers, on_trial=on_trial)
    _print(to_rich(outcomes))
    for outcome in outcomes:
        for note in outcome.notes():
            click.echo(f"note: {note}", err=True)
    # Last: what was found is shown even where the disk is full.
    folder = out or free_run_folder(Path("runs"), "montecarlo")
    new_run_folder(folder, overwrite=overwrite, marker=MARKER)
    settings = {"backends": backends, "options": options, "flights": flights, "seeds": seeds, **sensors}
    write_files(outcomes, folder)
    record(folder / MARKER, [outcome.to_dict() for outcome in outcomes], settings)
    click.echo(f"written to {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")


def _watch(trials: int, quiet: bool) -> AbstractContextManager[Callable[[Trial], None]]:
    if quiet:
        return nullcontext(lambda trial: None)
    from vioframe.cli.trial_progress import TrialProgress

    return TrialProgress(trials)


def _print(table: Any) -> None:
    from rich.console import Console

    console = Console()
    # Into a file or a pipe the table goes whole: rich would fold it at 80 columns.
    (console if console.is_terminal else Console(width=_WIDE)).print(table)
