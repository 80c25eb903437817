"""``vioframe run``: from a recording to a run folder, with a progress bar."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import click

from vioframe.cli.progress import RunProgress
from vioframe.errors import DatasetError, TrajectoryError
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.parts import config as configuration
from vioframe.parts import registry
from vioframe.parts.config import Config
from vioframe.pipeline import Experiment, prepare, record
from vioframe.runs.folder import RunFolder
from vioframe.runs.recorder import check_run_folder, free_run_folder
from vioframe.types import Step

_FILE = click.Path(path_type=Path)


@click.command("run")
@click.argument("data", type=_FILE, required=False)
@click.option("--detector", metavar="NAME", help="Keypoint detector.  [default: shi_tomasi]")
@click.option("--backend", metavar="NAME", help="Estimator.  [default: msckf]")
@click.option("--loop-closure", metavar="NAME", help="Loop closer, such as pose_graph.  [default: none]")
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Set an option of a part.")
@click.option("--config", "config_file", type=_FILE, help="Configuration file; the other options override it.")
@click.option("--ground-truth", type=_FILE, help="Trajectory to compare with: TUM or EuRoC csv.")
@click.option("--calibration", type=_FILE, multiple=True, help="Calibration file; repeat where it is in several.")
@click.option("--reader", metavar="NAME", help="Data-set reader, where several accept DATA.")
@click.option("--start", type=float, metavar="S", help="Skip the first S seconds.")
@click.option("--duration", type=float, metavar="S", help="Stop after S seconds.")
@click.option("--out", type=_FILE, help="Run folder.  [default: runs/DATASET_DETECTOR_BACKEND]")
@click.option("--overwrite", is_flag=True, help="Replace the run that is in --out.")
@click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
def command(out: Path | None, overwrite: bool, quiet: bool, **arguments: Any) -> None:
    """Estimate the motion along DATA, a bag or an ASL folder, and write a run folder.

    Options of the parts are set with -o: `-o backend.max_clones=15`, or just `-o max_clones=15` where only one part has
    such an option. `vioframe plugins NAME` lists them.
    """
    if out is not None:
        check_run_folder(out, overwrite=overwrite)
    installed = registry.load()
    experiment = prepare(_configure(installed, **arguments), installed)
    folder = out or free_run_folder(Path("runs"), experiment.name)
    with _watch(experiment, quiet) as on_step:
        summary = record(experiment, folder, overwrite=overwrite, on_step=on_step)
    if not quiet:
        _report(folder, summary)


def _configure(
    installed: registry.Registry,
    *,
    data: Path | None,
    detector: str | None,
    backend: str | None,
    loop_closure: str | None,
    options: tuple[str, ...],
    config_file: Path | None,
    ground_truth: Path | None,
    calibration: tuple[Path, ...],
    reader: str | None,
    start: float | None,
    duration: float | None,
) -> Config:
    """The configuration file, if any, with the command line's choices over it."""
    config = Config() if config_file is None else configuration.read(config_file)
    tree = config.model_dump()
    for section, name in (("detector", detector), ("backend", backend), ("loop_closure", loop_closure)):
        if name is not None and (tree[section] is None or name != tree[section]["name"]):
            tree[section] = {"name": name}  # the options in the file are those of another part
    if data is not None:
        tree["dataset"]["path"] = data
    if reader is not None:
        tree["dataset"]["reader"] = reader
    if calibration:
        tree["dataset"]["options"]["calibration"] = list(calibration)
    for key, value in (("ground_truth", ground_truth), ("start_s", start), ("duration_s", duration)):
        if value is not None:
            tree[key] = value
    if tree["dataset"]["path"] is None:
        raise DatasetError("no data given: `vioframe run DATA`, or set dataset.path in the configuration")
    return configuration.override(configuration.parse(tree, "command line"), installed, options)


def _watch(experiment: Experiment, quiet: bool) -> AbstractContextManager[Callable[[Step], None]]:
    if quiet:
        return nullcontext(lambda step: None)
    config = experiment.config
    whole = config.start_s == 0.0 and config.duration_s is None
    return RunProgress(experiment.dataset.frame_count if whole else None)


def _report(folder: Path, summary: dict[str, Any]) -> None:
    """A few lines on how it went, and what to do next."""
    if summary["initialised_t_ns"] is None:
        went = "never initialised; the events in summary.json say why"
    else:
        went = f"initialised after {summary['initialised_after_s']:.2f} s, then {summary['completion']:.1%} tracked"
    click.echo(f"{summary['name']}: {summary['frames']} frames, {went}, {summary['resets']} resets")
    click.echo(f"{summary['mean_frame_ms']:.1f} ms a frame, {summary['real_time_factor']:.2f} x real time")
    if summary["incidents"]:
        counts = ", ".join(f"{kind} {count}" for kind, count in summary["incidents"].items())
        click.echo(f"handled on the way: {counts}")
    run = RunFolder.open(folder)
    estimate, truth = run.trajectory(), run.ground_truth()
    if estimate is not None and truth is not None:
        click.echo(_accuracy(estimate, truth))
    if closed := summary.get("loop_closure"):
        click.echo(f"{closed['loops']} loops closed, {closed['rejected']} rejected")
        corrected = run.loop_closed()
        if corrected is not None and truth is not None:
            click.echo(f"with loop closure: {_accuracy(corrected, truth)}")
    click.echo(f"written to {folder}; next:\n  vioframe evaluate {folder}\n  vioframe plot {folder}")


def _accuracy(estimate: Trajectory, truth: Trajectory) -> str:
    try:
        errors = evaluate(estimate, truth)
    except TrajectoryError as error:
        return f"no comparison with the ground truth: {error}"
    return (
        f"ATE {1e3 * errors.ate_m.rmse:.1f} mm (position and yaw aligned) over {errors.truth.path_length_m:.1f} m, "
        f"orientation {errors.orientation_deg.rmse:.2f} deg"
    )
