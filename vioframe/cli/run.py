"""``vioframe run``: from a recording to a run folder, with a progress bar.

What takes long to import is imported where it is needed, when the front-end's process loads already.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.cli import EXIT_FAILED
from vioframe.cli.common import FILE, Bar, PartName, calibration_option, cameras_option, print_notes, quiet_option
from vioframe.cores import ONE_BLAS_THREAD, usable_cores
from vioframe.errors import DatasetError, TrajectoryError
from vioframe.frontend_process import FrontendProcess

if TYPE_CHECKING:
    from vioframe.geometry.trajectory import Trajectory
    from vioframe.live import Live
    from vioframe.parts.config import Config
    from vioframe.parts.registry import Registry
    from vioframe.pipeline import Experiment
    from vioframe.types import Step

_MOST_REASONS = 4


@click.command("run")
@click.argument("data", type=FILE, required=False)
@click.option("--detector", type=PartName("DETECTOR"), help="Keypoint detector.  [default: shi_tomasi]")
@click.option("--backend", type=PartName("BACKEND"), help="Estimator.  [default: msckf]")
@click.option(
    "--loop-closure",
    type=PartName("LOOP_CLOSER"),
    help="Loop closer, such as pose_graph.  [default: none]",
)
@click.option("-o", "--option", "options", metavar="KEY=VALUE", multiple=True, help="Set an option of a part.")
@click.option("--config", "file", type=FILE, help="Configuration file; the other options override it.")
@click.option("--ground-truth", type=FILE, help="Trajectory to compare with: TUM or EuRoC csv.")
@calibration_option
@cameras_option("data", "estimate from", "all that the estimator takes")
@click.option("--reader", type=PartName("DATASET"), help="Data-set reader, where several accept DATA.")
@click.option("--start", "start_s", type=float, metavar="S", help="Skip the first S seconds.")
@click.option("--duration", "duration_s", type=float, metavar="S", help="Stop after S seconds.")
@click.option(
    "--wait-ms",
    type=float,
    metavar="MS",
    help="How long a frame waits for readings that come late; live, 0 is quickest where they come in order.  "
    "[default: 50]",
)
@click.option(
    "--cores",
    type=click.IntRange(1, 2),
    help="With 2, another process follows points while frames before are estimated from; the results are the same.  "
    "[default: 2 where there are as many]",
)
@click.option("--out", type=FILE, help="Run folder.  [default: runs/DATASET_DETECTOR_BACKEND]")
@click.option("--overwrite", is_flag=True, help="Replace the run that is in --out.")
@click.option(
    "--record",
    "tape",
    type=FILE,
    help="Write what is used of a live source to FILE.mcap, .bag or .ros2, which gives the same estimates again.",
)
@click.option("--view", is_flag=True, help="Watch it in rerun's viewer while it flies.")
@click.option("--save-view", type=FILE, metavar="FILE", help="Write what would be watched to FILE.rrd.")
@quiet_option
def run(
    cores: int | None,
    out: Path | None,
    overwrite: bool,
    tape: Path | None,
    view: bool,
    save_view: Path | None,
    quiet: bool,
    **choices: Any,
) -> None:
    """Estimate the motion along DATA, a bag or an ASL folder, and write a run folder.

    DATA may also be a live source, NAME:ADDRESS, such as `replay:FLIGHT.bag`; `vioframe plugins` lists them. Ctrl-C
    ends it, and the run folder is complete.

    The exit code is 1 where it never initialised; `vioframe check DATA` says more about why.

    Options of the parts are set with -o: `-o backend.max_clones=15`, or just `-o max_clones=15` where only one part has
    such an option. `vioframe plugins NAME` lists them.
    """
    if view and save_view is not None:
        raise click.UsageError("--view opens a window and --save-view writes a file; choose one")
    os.environ |= ONE_BLAS_THREAD  # before anything brings one
    with _begun(cores or usable_cores()) as pipelined:
        from vioframe.parts import registry
        from vioframe.pipeline import prepare, record
        from vioframe.runs.recorder import check_run_folder, free_run_folder
        from vioframe.warming import helped

        replaces = out is not None and check_run_folder(out, overwrite=overwrite)
        installed = registry.load()
        config = _configure(installed, **choices)
        with Bar(None, quiet=quiet, late=True) as bar, helped(config.backend.name):
            experiment = prepare(config, installed, warm=replaces, tape=tape, pipelined=pipelined)
            folder = out or free_run_folder(Path("runs"), experiment.name)
            told = _watched(bar, experiment)
            with _ended_by_signals(experiment.live), _viewer(experiment, view, save_view) as shown:

                def on_step(step: Step) -> None:
                    shown(step)
                    told(step)

                summary = record(experiment, folder, overwrite=overwrite, on_step=on_step, explain=True)
    if not quiet:
        if others := experiment.left_aside:
            used = experiment.dataset.calibration.cameras[0].name
            click.echo(f"camera {used} is used, {', '.join(others)} left aside; --cameras {others[0]} takes another")
        _report(folder, summary)
    if summary["initialised_t_ns"] is None:
        click.echo(f"vioframe: {summary['name']} never initialised; {_likeliest_cause(summary)}", err=True)
        click.get_current_context().exit(EXIT_FAILED)


def _begun(cores: int) -> AbstractContextManager[FrontendProcess | bool]:
    """The front-end's process where there is a core for it: it loads while this one does."""
    return FrontendProcess() if cores > 1 else nullcontext(False)


def _configure(
    installed: Registry, file: Path | None, data: Path | None, options: tuple[str, ...], **chosen: Any
) -> Config:
    """The configuration file, if any, with the command line's choices over it."""
    from vioframe.parts import config as configuration
    from vioframe.parts.config import Config

    tree = (Config() if file is None else configuration.read(file)).model_dump()
    for section in ("detector", "backend", "loop_closure"):
        if (name := chosen[section]) is not None and (tree[section] is None or name != tree[section]["name"]):
            tree[section] = {"name": name}  # the options in the file are those of another part
    if chosen["calibration"]:
        tree["dataset"]["options"]["calibration"] = list(chosen["calibration"])
    if chosen["cameras"]:
        tree["dataset"]["options"]["cameras"] = chosen["cameras"]
    tree["dataset"] |= {
        key: value for key, value in (("path", data), ("reader", chosen["reader"])) if value is not None
    }
    tree |= {
        key: chosen[key] for key in ("ground_truth", "start_s", "duration_s", "wait_ms") if chosen[key] is not None
    }
    if tree["dataset"]["path"] is None:
        raise DatasetError("no data given: `vioframe run DATA`, or set dataset.path in the configuration")
    return configuration.override(configuration.parse(tree, "command line"), installed, options)


@contextmanager
def _ended_by_signals(live: Live | None) -> Iterator[None]:
    """Within it the first Ctrl-C, or request to terminate, ends what is ``live``, and a second one everything."""
    if live is None:
        yield
        return
    before = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}

    def end(*_: object) -> None:
        for each, handler in before.items():
            signal.signal(each, handler)
        live.stop()

    try:
        for each in before:
            signal.signal(each, end)
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


@contextmanager
def _viewer(experiment: Experiment, window: bool, save: Path | None) -> Iterator[Callable[[Step], None]]:
    """What shows a step in a window, or writes it to ``save``, or does nothing."""
    if not window and save is None:
        yield lambda step: None
        return
    from vioframe.report.live_view import LiveView

    live = experiment.live
    with LiveView(experiment.name, experiment.dataset.calibration, save) as view:
        yield lambda step: view.add(step, *(() if live is None else (live.latency_ms, live.dropped)))


def _watched(bar: Bar, experiment: Experiment) -> Callable[[Step], None]:
    """Has ``bar`` show frame rate, real-time factor, tracked points and what the back-end says."""
    from vioframe.types import NS_PER_S

    config, frame_count = experiment.config, experiment.dataset.frame_count
    first_t_ns: int | None = None

    def expected(data_s: float) -> float | None:
        """Frames to come through, judged by those of the first ``data_s`` seconds where a part is played."""
        if config.start_s == 0.0 and config.duration_s is None:
            return frame_count
        if data_s == 0.0:
            return None
        rate_hz = bar.completed / data_s
        left = inf if frame_count is None else frame_count - round(config.start_s * rate_hz)
        wanted = inf if config.duration_s is None else round(config.duration_s * rate_hz)
        total = max(min(left, wanted), bar.completed + 1)
        return None if total == inf else total

    def on_step(step: Step) -> None:
        nonlocal first_t_ns
        first_t_ns = step.frames.t_ns if first_t_ns is None else first_t_ns
        data_s = (step.frames.t_ns - first_t_ns) / NS_PER_S
        pace = f"{data_s / bar.elapsed_s:.2f}x real time"
        if (live := experiment.live) is not None:
            late_ms = live.latency_ms
            pace = "" if late_ms is None else f"{late_ms:.0f} ms after the exposure, "
            pace += f"{live.dropped} dropped"
        bar(
            f"{(bar.completed + 1) / bar.elapsed_s:.1f} frames/s, {pace}, "
            f"{len(step.tracks.ids)} points, {step.estimate.status}",
            total=expected(data_s),
        )

    return on_step


def _likeliest_cause(summary: dict[str, Any]) -> str:
    """In one line: what is wrong with the recording, or else what may be, or else what was said most often."""
    findings = summary["findings"]
    if findings:
        likeliest = findings[0]
        return f"likeliest cause: {likeliest['sentence']} ({likeliest['certainty']}); {likeliest['remedy']}"
    if reasons := summary["event_reasons"]:
        return f"nothing is wrong with the recording as far as can be told; said most often: {next(iter(reasons))}"
    return f"it has {summary['frames']} frames only: it takes a second at rest, or two in motion"


def _report(folder: Path, summary: dict[str, Any]) -> None:
    """A few lines on how it went, and what to do next."""
    from vioframe.diagnosis import Severity
    from vioframe.runs.folder import RunFolder

    if summary["initialised_t_ns"] is None:
        went = "never initialised"
    else:
        went = f"initialised after {summary['initialised_after_s']:.2f} s, then {summary['completion']:.1%} tracked"
    click.echo(f"{summary['name']}: {summary['frames']} frames, {went}, {summary['resets']} resets")
    speed = f"{summary['mean_frame_ms']:.1f} ms a frame"
    if (live := summary.get("live")) is None:
        click.echo(f"{speed}, {summary['real_time_factor']:.2f} x real time")
    else:
        if late := live["latency_ms"]:
            speed += f"; from exposure to estimate {late['median']:.0f} ms (median), {late['p99']:.0f} ms (99 %)"
        click.echo(f"{speed}; {live['frames_dropped']} of {live['frames']} frames dropped")
    if summary["incidents"]:
        counts = ", ".join(f"{kind} {count}" for kind, count in summary["incidents"].items())
        click.echo(f"handled on the way: {counts}")
    for reason, count in list(summary["event_reasons"].items())[:_MOST_REASONS]:
        click.echo(f"  {count} times {reason}")
    wrong = [finding for finding in summary["findings"] if finding["severity"] == Severity.WRONG]
    print_notes(f"{finding['sentence']}; {finding['remedy']}" for finding in wrong)
    results = RunFolder.open(folder)
    estimate, truth = results.trajectory(), results.ground_truth()
    if estimate is not None and truth is not None:
        click.echo(_accuracy(estimate, truth))
    if closed := summary.get("loop_closure"):
        click.echo(f"{closed['loops']} loops closed, {closed['rejected']} rejected")
        corrected = results.loop_closed()
        if corrected is not None and truth is not None:
            click.echo(f"with loop closure: {_accuracy(corrected, truth)}")
    click.echo(f"written to {folder}; next:\n  vioframe evaluate {folder}\n  vioframe plot {folder}")


def _accuracy(estimate: Trajectory, truth: Trajectory) -> str:
    from vioframe.evaluation import evaluate
    from vioframe.report.units import length

    try:
        errors = evaluate(estimate, truth)
    except TrajectoryError as error:
        return f"no comparison with the ground truth: {error}"
    return (
        f"ATE {length(errors.ate_m.rmse)} (position and yaw aligned) over {errors.truth.path_length_m:.1f} m, "
        f"orientation {errors.orientation_deg.rmse:.2f} deg"
    )
