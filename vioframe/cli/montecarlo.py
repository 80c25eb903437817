"""``vioframe montecarlo``: back-ends on many simulated flights; are they accurate, and do they know how accurate?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.cli.common import FILE, Bar, print_notes, print_table, quiet_option

if TYPE_CHECKING:
    from vioframe.evaluation.consistency import Trial


@click.command("montecarlo")
@click.option(
    "--backend",
    "backends",
    metavar="NAME[:KEY=VALUE,...]",
    multiple=True,
    default=("msckf",),
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
@click.option("--duration", "duration_s", metavar="S", default=60.0, show_default=True, help="Length of a flight.")
@click.option("--pixel-sigma", metavar="PX", default=1.0, show_default=True, help="Noise of an observation.")
@click.option(
    *("--outliers", "outlier_ratio"),
    metavar="PART",
    default=0.0,
    show_default=True,
    help="Observations that are 5-30 px off.",
)
@click.option("--max-points", type=int, default=150, show_default=True, help="Landmarks in view.")
@click.option("--workers", type=int, help="Processes.  [default: one a core]")
@click.option("--out", type=FILE, help="Folder.  [default: runs/montecarlo]")
@click.option("--overwrite", is_flag=True, help="Replace the results that are in --out.")
@quiet_option
def montecarlo(
    backends: tuple[str, ...],
    flights: tuple[str, ...],
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
    from vioframe.bench.montecarlo import Setup, check_montecarlo, run_montecarlo
    from vioframe.bench.processes import usable_cores
    from vioframe.bench.results import record
    from vioframe.parts import registry
    from vioframe.parts.config import PartConfig, parse_part, validate
    from vioframe.parts.registry import BACKEND
    from vioframe.report.montecarlo import MARKER, figures, write_files
    from vioframe.report.tables import to_rich
    from vioframe.runs.recorder import check_run_folder, free_run_folder, new_run_folder

    if out is not None:
        check_run_folder(out, overwrite=overwrite, marker=MARKER)
    setups = [validate(Setup, {"flight": each, **sensors}, "command line") for each in dict.fromkeys(flights)]
    installed = registry.load()
    parts = {spec: parse_part(spec, BACKEND, installed) for spec in backends}
    complete = {
        spec: PartConfig(name=part.name, options=installed.find(BACKEND, part.name).validate(part.options))
        for spec, part in parts.items()
    }
    workers = usable_cores() if workers is None else workers
    check_montecarlo(setups, complete, seeds, workers)  # before there is a bar: an error is one line and nothing else
    with Bar(len(setups) * len(complete) * seeds, "first trials under way", quiet=quiet) as bar:
        failed = 0

        def on_trial(trial: Trial) -> None:
            nonlocal failed
            failed += trial.failure is not None
            went = trial.failure or f"{trial.figures['ate_m']:.3f} m, {trial.figures['orientation_deg']:.2f} deg"
            bar(f"{failed} failed, seed {trial.seed}: {went}")

        cases = run_montecarlo(setups, complete, seeds, workers=workers, on_trial=on_trial)
    print_table(to_rich(figures(cases)))
    print_notes(note for case in cases for note in case.notes())
    # Last: what was found is shown even where the disk is full.
    folder = out or free_run_folder(Path("runs"), "montecarlo")
    new_run_folder(folder, overwrite=overwrite, marker=MARKER)
    write_files(cases, folder)
    settings = {"backends": backends, "flights": flights, "seeds": seeds, **sensors}
    record(folder / MARKER, [case.to_dict() for case in cases], settings)
    click.echo(f"written to {folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
