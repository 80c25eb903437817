"""The progress bar of a Monte Carlo: trials done, failures, and what the last one came to."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vioframe.evaluation.consistency import Trial


class TrialProgress:
    """Fed with each :class:`Trial`; a context manager."""

    def __init__(self, trials: int) -> None:
        self._progress = Progress(
            BarColumn(bar_width=12),
            MofNCompleteColumn(),
            TextColumn("{task.fields[figures]}"),
            TimeRemainingColumn(compact=True),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task("", total=trials, figures="first trials under way")
        self._failed = 0

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def __call__(self, trial: Trial) -> None:
        self._failed += trial.failure is not None
        went = trial.failure or f"{trial.figures['ate_m']:.3f} m, {trial.figures['orientation_deg']:.2f} deg"
        figures = f"{self._failed} failed, seed {trial.seed}: {went}"
        self._progress.update(self._task, advance=1, figures=figures)
