"""``vioframe bench SUITE``: a sweep over all that a suite names, and its report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from vioframe.bench.suites.suite import Suite
    from vioframe.bench.suites.sweep import Agenda, Event, Tally

EXIT_FAILED = 1
"""Some task came to nothing; the others, and the report, are there."""

_FOLDER = click.Path(file_okay=False, path_type=Path)


def suite_command(name: str, summary: str) -> click.Command:
    """The command that runs the suite ``name``, which is a shipped one or a YAML file."""

    @click.command(name, short_help=summary, help=_help(name))
    @click.option("--out", type=_FOLDER, metavar="RESULTS", help="Results folder.  [default: results/SUITE]")
    @click.option("--data", type=_FOLDER, multiple=True, metavar="DIR", help="Where recordings are. Repeatable.")
    @click.option("--detector", "detectors", metavar="NAME", multiple=True, help="Only these of the suite's detectors.")
    @click.option("--backend", "backends", metavar="NAME", multiple=True, help="Only these of its back-ends.")
    @click.option("--sequence", "sequences", metavar="NAME", multiple=True, help="Only these of its sequences.")
    @click.option("--seeds", type=click.IntRange(1), metavar="N", help="Repetitions.  [default: the suite's]")
    @click.option("--workers", type=click.IntRange(1), metavar="N", help="Processes.  [default: one a core]")
    @click.option("--scheduler", metavar="ADDRESS", help="Work on the dask cluster there, such as tcp://host:8786.")
    @click.option("--recordings", type=_FOLDER, metavar="DIR", help="Keep simulated recordings, and use those there.")
    @click.option("--overwrite", is_flag=True, help="Replace the results of another suite in RESULTS.")
    @click.option("--no-report", is_flag=True, help="Leave the report to `vioframe report RESULTS`.")
    @click.option("--quiet", is_flag=True, help="No progress bar.")
    def command(**arguments: Any) -> None:
        _run(name, **arguments)

    return command


def _help(name: str) -> str:
    return f"""Run the suite {name} and write its report.

    Stopped, it goes on where it was when it is called again: a result is used again where code, configuration and data
    are the same. A sequence that --data does not hold, as DIR/NAME.bag or DIR/NAME/mav0, is replaced: by images
    rendered along its motion where DIR/NAME has IMU and ground truth, else by a simulated flight. Captions say which.
    """


def _run(
    name: str,
    *,
    out: Path | None,
    data: tuple[Path, ...],
    workers: int | None,
    scheduler: str | None,
    recordings: Path | None,
    overwrite: bool,
    no_report: bool,
    quiet: bool,
    **narrowing: Any,
) -> None:
    from vioframe.bench.suites import suite as suites
    from vioframe.bench.suites.plan import plan
    from vioframe.bench.suites.store import Store
    from vioframe.bench.suites.sweep import agenda, sweep
    from vioframe.parts import registry

    whole = suites.read(suites.find(name))
    _check_used(whole, data=data, scheduler=scheduler, workers=workers, recordings=recordings, seeds=narrowing["seeds"])
    suite = suites.narrowed(whole, **narrowing)
    planned = plan(suite, data, registry.load())
    store = Store.at(out or Path("results") / suite.name, recordings)
    store.begin(planned, overwrite=overwrite)
    with store.alone():
        left = agenda(planned, store)
        if left.stale:
            click.echo(f"note: {left.stale} results are of other code or data, and are made again", err=True)
        with _Watch(left, quiet) as watch:
            tally = sweep(left, store, workers=_workers(suite, workers), scheduler=scheduler, on_event=watch)
    _say(tally, store.path)
    if not no_report:
        from vioframe.cli.report import write_and_say

        write_and_say(store.path)
    if tally.failed:
        click.get_current_context().exit(EXIT_FAILED)


_NO_USE = {"detector_speed": ("seeds", "workers", "scheduler", "recordings"), "trials": ("data", "recordings")}


def _check_used(suite: Suite, **given: Any) -> None:
    """Raise ConfigError for an option that a suite of this kind has no use for."""
    from vioframe.errors import ConfigError

    if unused := next((name for name in _NO_USE.get(suite.kind, ()) if given[name]), None):
        raise ConfigError(f"--{unused} does nothing in a suite of kind {suite.kind}; leave it out")


def _workers(suite: Suite, asked: int | None) -> int | None:
    from vioframe.errors import ConfigError

    if suite.workers is not None and asked not in (None, suite.workers):
        raise ConfigError(f"the suite {suite.name} measures with {suite.workers} worker; leave --workers out")
    return asked or suite.workers


class _Watch:
    """A progress bar of work done, with the tasks, the failures and the time left; a context manager."""

    def __init__(self, left: Agenda, quiet: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

        columns = (BarColumn(bar_width=20), TaskProgressColumn(), TextColumn("{task.fields[what]}"))
        self._progress = Progress(
            *columns, TimeRemainingColumn(elapsed_when_finished=True), console=Console(stderr=True), disable=quiet
        )
        self._tasks, self._done, self._failed = len(left.tasks), 0, 0
        reused = f", {left.reused} done before" if left.reused else ""
        self._bar = self._progress.add_task("", total=left.cost_s, what=f"{self._tasks} tasks{reused}")

    def __enter__(self) -> _Watch:
        if self._tasks:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def __call__(self, event: Event) -> None:
        self._done += event.is_task
        self._failed += event.is_task and bool(event.error)
        failed = f", {self._failed} failed" if self._failed else ""
        what = f"{self._done} of {self._tasks} tasks{failed}, last: {event.label}"
        self._progress.update(self._bar, advance=event.cost_s, what=what)


def _say(tally: Tally, path: Path) -> None:
    before = f", {tally.reused} done before" if tally.reused else ""
    failed = f", {len(tally.failed)} failed" if tally.failed else ""
    click.echo(f"{tally.done} tasks done{before}{failed}; results in {path}")
    for key, error in tally.failed.items():
        click.echo(f"failed: {key}: {error}", err=True)
