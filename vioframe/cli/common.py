"""What the commands share: options, the progress bar, and how notes and tables are printed.

rich is imported where something is shown, as a run first has its other process begin.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeVar

import click
from click.shell_completion import CompletionItem

from vioframe.errors import VioframeError

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

_Command = TypeVar("_Command", bound=Callable[..., Any])

FILE = click.Path(path_type=Path)


class PartName(click.types.StringParamType):
    """The name of an installed part of ``kinds``, constants of :mod:`vioframe.parts.registry`, or of any; the shell
    completes it."""

    name = "name"

    def __init__(self, *kinds: str) -> None:
        self._kinds = kinds

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        from vioframe.parts import registry

        # What is wrong with a plug-in is for the command itself to say.
        logging.getLogger("vioframe").addHandler(logging.NullHandler())
        installed = registry.load()
        asked = [getattr(registry, kind) for kind in self._kinds] or registry.KINDS
        known = sorted({name for kind in asked for name in installed.names(kind)})
        return [CompletionItem(name) for name in known if name.startswith(incomplete)]


class _CameraNames(click.types.StringParamType):
    """``cam0,cam1``; the shell completes the cameras of the recording that the argument ``recording`` names."""

    name = "cameras"

    def __init__(self, recording: str) -> None:
        self._recording = recording

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        from vioframe.parts import registry

        # While the option has no value yet, click leaves arguments unnamed; the recording is the first of any command.
        path = ctx.params.get(self._recording) or next(iter(ctx.args), None)
        if path is None:
            return []
        logging.getLogger("vioframe").addHandler(logging.NullHandler())
        options = {"calibration": list(given)} if (given := ctx.params.get("calibration")) else {}
        try:
            rig = registry.load().open_dataset(Path(path), ctx.params.get("reader"), options).calibration
        except VioframeError:  # what is wrong with it is for the command itself to say
            return []
        before, comma, begun = incomplete.rpartition(",")
        free = (camera.name for camera in rig.cameras if camera.name not in before.split(","))
        return [CompletionItem(before + comma + name) for name in free if name.startswith(begun)]


def _each_once(context: click.Context, parameter: click.Parameter, names: str | None) -> list[str] | None:
    chosen = None if names is None else names.split(",")
    if chosen is not None and (not all(chosen) or len(set(chosen)) < len(chosen)):
        raise click.BadParameter(f"expected names such as cam0,cam1, each once, got {names!r}", context, parameter)
    return chosen


def cameras_option(recording: str, use: str, default: str) -> Callable[[_Command], _Command]:
    """``--cameras`` of a command whose argument ``recording`` names what is read; ``use`` says what cameras are for."""
    return click.option(
        "--cameras",
        type=_CameraNames(recording),
        callback=_each_once,
        metavar="NAME,...",
        help=f"Cameras to {use}, in this order.  [default: {default}]",
    )


def _without_other_folders(context: click.Context, parameter: click.Parameter, paths: tuple[Path, ...]) -> list[Path]:
    """Of what the shell makes of ``runs/*`` the runs, unless there is none among them."""
    from vioframe.runs.folder import RunFolder

    others = [path for path in paths if path.is_dir() and not RunFolder.is_at(path)]
    if len(others) == len(paths):
        return list(paths)
    print_notes(f"{path} is left aside: it holds no trajectory.tum and is no run folder" for path in others)
    return [path for path in paths if path not in others]


runs_argument = click.argument(
    "runs", metavar="RUN...", type=FILE, nargs=-1, required=True, callback=_without_other_folders
)
ground_truth_option = click.option(
    "--ground-truth", type=FILE, help="TUM or EuRoC csv; a run folder's own is the default."
)
quiet_option = click.option("--quiet", is_flag=True, help="No progress bar and no summary.")
workers_option = click.option(
    "--workers", type=click.IntRange(1), metavar="N", help="Processes.  [default: one a core]"
)
calibration_option = click.option(
    "--calibration", type=FILE, multiple=True, help="Calibration file; repeat where it is in several."
)

_WIDE = 1000


def print_table(table: Table) -> None:
    """Into a file or a pipe the table goes whole: rich would fold it at 80 columns."""
    from rich.console import Console

    console = Console()
    (console if console.is_terminal else Console(width=_WIDE)).print(table)


def print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        click.echo(f"note: {note}", err=True)


_COMPILING = "compiling kernels (once after installation)"


@contextmanager
def compiling_shown(*, quiet: bool = False) -> Iterator[None]:
    """Say so while kernels are compiled, which is half a minute of silence else; nothing where all are cached."""
    from vioframe.jit import heard

    shown: Progress | None = None

    def on_kernel(name: str) -> None:
        nonlocal shown
        if shown is None:
            from rich.console import Console
            from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

            console = Console(stderr=True)
            columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            shown = Progress(*columns, console=console, transient=True)
            shown.add_task(_COMPILING)
            if console.is_terminal:
                shown.start()
            else:
                click.echo(f"vioframe: {_COMPILING} ...", err=True)
        shown.update(shown.task_ids[0], description=f"{_COMPILING}: {name}")

    if quiet:
        yield
        return
    try:
        with heard(on_kernel):
            yield
    finally:
        if shown is not None and shown.live.is_started:
            shown.stop()


class Bar:
    """A progress bar on standard error: what is done, ``figures``, and the time that is left; a context manager.

    ``total`` None is unknown. Where it is ``late`` it appears when first something is done: an error ahead of that is
    then one line and nothing else, and the compiling of kernels is shown, ahead of it and within. In ``percent`` it
    counts no things but an amount of work.
    """

    def __init__(
        self, total: float | None, figures: str = "", *, quiet: bool = False, late: bool = False, percent: bool = False
    ) -> None:
        self._total, self._figures, self._percent = total, figures, percent
        self._late, self._shown, self._quiet = late, False, quiet
        self._before, self._within = ExitStack(), ExitStack()

    @cached_property
    def progress(self) -> Progress:
        """What is shown, with this as its first task."""
        from rich.console import Console
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TaskProgressColumn,
            TextColumn,
            TimeRemainingColumn,
        )

        progress = Progress(
            BarColumn(bar_width=12),
            TaskProgressColumn() if self._percent else MofNCompleteColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(compact=True),
            console=Console(stderr=True),
            disable=self._quiet,
        )
        progress.add_task("", total=self._total, figures=self._figures)
        return progress

    @property
    def _id(self) -> TaskID:
        return self.progress.task_ids[0]

    def __enter__(self) -> Self:
        if self._late:
            from vioframe.jit import heard

            self._before.enter_context(compiling_shown(quiet=self._quiet))
            self._within.enter_context(heard(self._compiling))
        else:
            self._show()
        return self

    def __exit__(self, *_: object) -> None:
        self._before.close()
        self._within.close()
        if self._shown:
            self.progress.stop()

    def __call__(self, figures: str | None = None, *, advance: float = 1, total: float | None = None) -> None:
        """So much more is done, of a ``total`` that may have become known."""
        self._show()
        self._figures = self._figures if figures is None else figures
        self.progress.update(self._id, advance=advance, total=total, figures=self._figures)

    def _compiling(self, kernel: str) -> None:
        if self._shown:
            self.progress.update(self._id, figures=f"{_COMPILING}: {kernel}")

    @property
    def completed(self) -> float:
        return self.progress.tasks[self._id].completed

    @property
    def elapsed_s(self) -> float:
        """Since it appeared."""
        return max(self.progress.tasks[self._id].elapsed or 0.0, 1e-3)

    def _show(self) -> None:
        if not self._shown:
            self._shown = True
            self._before.close()
            self.progress.reset(self._id)
            self.progress.start()
