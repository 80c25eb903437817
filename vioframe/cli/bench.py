"""``vioframe bench``: parts compared with one another, a sub-command a question; every suite is one as well."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from vioframe.cli import LazyGroup
from vioframe.cli.common import Bar, PartName, compiling_shown, print_notes, quiet_option, workers_option
from vioframe.errors import ConfigError

if TYPE_CHECKING:
    from vioframe.bench.suites.suite import Suite

_COMMANDS = {
    "detectors": "Detectors by speed, by quality, or by the tracks made of them.",
    "detector_fps": "Suite: frames a second of all detectors.",
    "mh05_comparison": "Suite: KeypointNet and Shi-Tomasi on MH_05_difficult.",
    "euroc": "Suite: all eleven sequences, beside what is published.",
    "stress": "Suite: detectors and back-ends under hard conditions.",
    "tuning": "Suite: options of detectors, chosen where nothing is reported.",
    "consistency": "Suite: NEES of the back-ends.",
    "speed": "Suite: milliseconds a frame by stage.",
}


class _Suites(LazyGroup):
    """A name that is no module's is that of a suite, shipped or in a YAML file."""

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name == "detectors":
            return super().get_command(ctx, name)
        if name not in _COMMANDS and not name.endswith((".yaml", ".yml")):
            return None
        return _suite_command(name, _COMMANDS.get(name, f"The suite {name}."))

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        # Not click's message, which knows nothing of suites in files.
        if args and not args[0].startswith("-") and self.get_command(ctx, args[0]) is None:
            from vioframe.bench.suites.suite import find

            find(args[0], _COMMANDS)
        return super().resolve_command(ctx, args)


@click.group("bench", cls=_Suites, modules={"detectors": "bench_detectors"}, summaries=_COMMANDS)
def bench() -> None:
    """Compare parts with one another: by a question to detectors, or by a suite.

    A suite is a YAML file of detectors, back-ends, sequences, conditions and seeds; `vioframe bench my_suite.yaml` runs
    one of your own.
    """


EXIT_FAILED = 1
"""Some task came to nothing; the others, and the report, are there."""

_FOLDER = click.Path(file_okay=False, path_type=Path)


def _suite_command(name: str, summary: str) -> click.Command:
    """The command that runs the suite ``name``, which is a shipped one or a YAML file."""

    @click.command(name, short_help=summary, help=_help(name))
    @click.option("--out", type=_FOLDER, metavar="RESULTS", help="Results folder.  [default: results/SUITE]")
    @click.option("--data", type=_FOLDER, multiple=True, metavar="DIR", help="Where recordings are. Repeatable.")
    @click.option(
        "--detector",
        "detectors",
        metavar="NAME",
        type=PartName("DETECTOR"),
        multiple=True,
        help="Only these of the suite's detectors.",
    )
    @click.option(
        "--backend",
        "backends",
        metavar="NAME",
        type=PartName("BACKEND"),
        multiple=True,
        help="Only these of its back-ends.",
    )
    @click.option("--sequence", "sequences", metavar="NAME", multiple=True, help="Only these of its sequences.")
    @click.option("--seeds", type=click.IntRange(1), metavar="N", help="Repetitions.  [default: the suite's]")
    @workers_option
    @click.option("--scheduler", metavar="ADDRESS", help="Work on the dask cluster there, such as tcp://host:8786.")
    @click.option("--recordings", type=_FOLDER, metavar="DIR", help="Keep simulated recordings, and use those there.")
    @click.option("--overwrite", is_flag=True, help="Replace the results of another suite in RESULTS.")
    @click.option("--no-report", is_flag=True, help="Leave the report to `vioframe report RESULTS`.")
    @quiet_option
    def command(
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
        from vioframe.bench.suites.sweep import Sweep
        from vioframe.parts import registry

        whole = suites.read(suites.find(name))
        given = {"data": data, "scheduler": scheduler, "workers": workers, "recordings": recordings}
        _check_used(whole, **given, seeds=narrowing["seeds"])
        suite = suites.narrowed(whole, **narrowing)
        with compiling_shown(quiet=quiet):
            tasks = plan(suite, data, registry.load())
        store = Store.at(out or Path("results") / suite.name, recordings)
        store.begin(suite, overwrite=overwrite)
        with store.alone():
            sweep = Sweep(tasks, store)
            if sweep.stale:
                print_notes([f"{sweep.stale} results are of other code or data, and are made again"])
            count, reused = len(sweep.left), f", {sweep.reused} done before" if sweep.reused else ""
            with Bar(sweep.cost_s, f"{count} tasks{reused}", quiet=quiet or not count, percent=True) as bar:

                def on_progress(label: str, cost_s: float) -> None:
                    failed = f", {len(sweep.failed)} failed" if sweep.failed else ""
                    ended = sweep.done + len(sweep.failed)
                    bar(f"{ended} of {count} tasks{failed}, last: {label}", advance=cost_s)

                sweep.run(workers=workers or suite.workers, scheduler=scheduler, on_progress=on_progress)
        failures = f", {len(sweep.failed)} failed" if sweep.failed else ""
        if not quiet:
            click.echo(f"{sweep.done} tasks done{reused}{failures}; results in {store.path}")
        for key, error in sweep.failed.items():
            click.echo(f"failed: {key}: {error}", err=True)
        if not no_report:
            from vioframe.cli.show import write_and_say

            write_and_say(store.path, quiet=quiet)
        if sweep.failed:
            click.get_current_context().exit(EXIT_FAILED)

    return command


def _help(name: str) -> str:
    return f"""Run the suite {name} and write its report.

    Stopped, it goes on where it was when it is called again: a result is used again where code, configuration and data
    are the same. A sequence that --data does not hold, as DIR/NAME.bag or DIR/NAME/mav0, is replaced: by images
    rendered along its motion where DIR/NAME has IMU and ground truth, else by a simulated flight. Captions say which.
    """


_NO_USE = {"detector_speed": ("seeds", "workers", "scheduler", "recordings"), "trials": ("data", "recordings")}


def _check_used(suite: Suite, **given: Any) -> None:
    """Raise ConfigError for an option that a suite of this kind, or this suite, has no use for."""
    if unused := next((name for name in _NO_USE.get(suite.kind, ()) if given[name]), None):
        raise ConfigError(f"--{unused} does nothing in a suite of kind {suite.kind}; leave it out")
    if suite.workers is not None and given["workers"] not in (None, suite.workers):
        raise ConfigError(f"the suite {suite.name} measures with {suite.workers} worker; leave --workers out")
