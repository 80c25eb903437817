"""``vioframe montecarlo``: back-ends on many simulated flights; are they accurate, and do they know how accurate?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.cli.common import (
    FILE,
    Bar,
    PartName,
    compiling_shown,
    print_notes,
    print_table,
    quiet_option,
    workers_option,
)

if TYPE_CHECKING:
    from vioframe.evaluation.consistency import Trial

MARKER = "montecarlo.json"
FILES = (MARKER, "nees.csv", "*trials.png")
"""The file by which a folder is known as that of a Monte Carlo."""


@click.command("montecarlo")
@click.option(
    "--backend",
    "backends",
    metavar="NAME[:KEY=VALUE,...]",
    type=PartName("BACKEND"),
    multiple=True,
    default=("msckf",),
    show_default=True,
    help="Estimator, with options of its own; repeat to compare.",
)
@click.option(
    "--flight",
    "flights",
    type=PartName("FLIGHT"),
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
@click.option(
    "--rig",
    type=click.Choice(["mono", "stereo"]),
    default="mono",
    show_default=True,
    help="EuRoC's left camera, or both.",
)
@workers_option
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

    Landmarks instead of images, EuRoC's cameras and IMU noise, true calibration, the back-end's own initialisation. A
    trial that fails counts and is shown.
    """
    from vioframe.bench.processes import map_in_processes
    from vioframe.bench.results import record
    from vioframe.bench.suites.plan import plan
    from vioframe.bench.suites.suite import Suite
    from vioframe.bench.suites.tasks import TrialTask, fly_trial
    from vioframe.cores import usable_cores
    from vioframe.evaluation.consistency import notes, over_trials
    from vioframe.parts import registry
    from vioframe.parts.config import parse_part, validate
    from vioframe.parts.registry import BACKEND
    from vioframe.report.drawing import write_figures
    from vioframe.report.suite.figures import figures
    from vioframe.report.suite.statistics import Study, groups
    from vioframe.report.suite.tables import nees_of_trials
    from vioframe.report.tables import to_rich
    from vioframe.report.units import length
    from vioframe.runs.recorder import check_run_folder, free_run_folder, new_run_folder
    from vioframe.runs.results import Reference, Results

    if out is not None:
        check_run_folder(out, overwrite=overwrite, marker=MARKER)
    installed = registry.load()
    parts = {spec: parse_part(spec, BACKEND, installed) for spec in backends}
    grid = {
        "kind": "trials",
        "backends": [{"label": spec, "name": part.name, "options": part.options} for spec, part in parts.items()],
        "seeds": seeds,
    }
    tasks = []
    for flight in dict.fromkeys(flights):
        tree = {"name": flight, "title": flight, **grid, "setup": {"flight": flight, **sensors}}
        with compiling_shown(quiet=quiet):
            planned = plan(validate(Suite, tree, "command line"), (), installed)
        tasks += [task for task in planned if isinstance(task, TrialTask)]
    with Bar(len(tasks), "first trials under way", quiet=quiet) as bar:
        failed = 0

        def on_trial(trial: Trial) -> None:
            nonlocal failed
            failed += trial.failure is not None
            went = trial.failure or f"{length(trial.figures['ate_m'])}, {trial.figures['orientation_deg']:.2f} deg"
            bar(f"{failed} failed, seed {trial.seed}: {went}")

        trials = map_in_processes(fly_trial, tasks, workers or usable_cores(), on_trial)
    flown = {task.name: (task, trial) for task, trial in zip(tasks, trials, strict=True)}
    rows = tuple({**task.about, "status": "ok", **trial.to_dict()} for task, trial in flown.values())
    listed = {"backends": list(parts), "sequences": list(flights)}
    nees = {name: trial.nees_over_time() for name, (_, trial) in flown.items()}
    study = Study(Results(Path(), listed, Reference(), rows), nees)
    print_table(to_rich(nees_of_trials(study).upright(["back-end", "flight"])))
    by_case = [own for _, own in groups(study.trials, ("sequence", "backend"))]
    print_notes(note for own in by_case for note in notes(own))
    # Last: what was found is shown even where the disk is full.
    folder = out or free_run_folder(Path("runs"), "montecarlo")
    new_run_folder(folder, overwrite=overwrite, marker=MARKER, files=FILES)
    study.nees_table().to_csv(folder / "nees.csv", index=False, float_format="%.9g")
    write_figures(figures(study), folder)
    cases = []
    for own in by_case:
        of_case = [flown[name] for name in own["task"]]
        task = of_case[0][0]
        about = {"backend": task.backend.name, "options": task.backend.options, "setup": task.setup.model_dump()}
        averages = {part: each.to_dict() for part, each in study.nees(own).items()}
        by_seed = [trial.to_dict() for _, trial in of_case]
        cases.append({"name": task.about["backend"], **about, **over_trials(own), "nees": averages, "by_seed": by_seed})
    record(folder / MARKER, cases, {"backends": backends, "flights": flights, "seeds": seeds, **sensors})
    if quiet:
        return
    written = sorted(path.name for pattern in FILES for path in folder.glob(pattern))
    click.echo(f"written to {folder}: {', '.join(written)}")
