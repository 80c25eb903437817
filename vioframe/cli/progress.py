"""What is shown while a command works, and tables of what came of it."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vioframe.types import NS_PER_S, Step

if TYPE_CHECKING:
    from rich.table import Table

_WIDE = 1000


def print_table(table: Table) -> None:
    """Into a file or a pipe the table goes whole: rich would fold it at 80 columns."""
    console = Console()
    (console if console.is_terminal else Console(width=_WIDE)).print(table)


def progress_bar(*, quiet: bool = False) -> Progress:
    """A bar with what is done, the task's ``figures`` and the time that is left, on standard error."""
    return Progress(
        BarColumn(bar_width=12),
        MofNCompleteColumn(),
        TextColumn("{task.fields[figures]}"),
        TimeRemainingColumn(compact=True),
        console=Console(stderr=True),
        disable=quiet,
    )


class RunProgress:
    """Frame rate, real-time factor, tracked points and what the back-end says; fed with each :class:`Step`.

    A context manager. ``frames`` is their expected number, None where unknown.
    """

    def __init__(self, frames: int | None) -> None:
        self._progress = progress_bar()
        self._task = self._progress.add_task("", total=frames, figures="")
        self._first_t_ns: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._first_t_ns is not None:
            self._progress.stop()

    def __call__(self, step: Step) -> None:
        if self._first_t_ns is None:
            self._first_t_ns = step.frames.t_ns
            # Not before: an error ahead of the first frame is then one line and nothing else.
            self._progress.start()
            self._progress.reset(self._task)
        task = self._progress.tasks[self._task]
        wall_s = max(task.elapsed or 0.0, 1e-3)
        data_s = (step.frames.t_ns - self._first_t_ns) / NS_PER_S
        figures = (
            f"{(task.completed + 1) / wall_s:.1f} frames/s, {data_s / wall_s:.2f}x real time, "
            f"{len(step.tracks.ids)} points, {step.estimate.status}"
        )
        self._progress.update(self._task, advance=1, figures=figures)
