"""The results folder of a sweep, as :mod:`vioframe.runs.results` has it: what is done stays done, however it ends."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from pydantic_core import to_jsonable_python

from vioframe.bench.suites.suite import Suite
from vioframe.errors import RunError
from vioframe.io.calibration import CALIBRATION_FILES, sidecar_folder
from vioframe.io.replace import remove_written
from vioframe.locks import locked
from vioframe.parts.config import read_tree, to_yaml
from vioframe.runs.recorder import write_whole
from vioframe.runs.results import RESULT_FILES, RUNS_FOLDER, SUITE_FILE, Row, read_rows, write_rows
from vioframe.simulation.config import SIMULATION_FILES, simulation_folder


@dataclass(frozen=True, slots=True)
class Store:
    """The folder ``path``; recordings that had to be simulated lie in ``recordings``, which several sweeps may share.

    What is written appears at once and complete, so that nobody ever reads the half of anything.
    """

    path: Path
    recordings: Path
    keep_recordings: bool

    @classmethod
    def at(cls, path: Path, recordings: Path | None = None) -> Store:
        """Recordings without a folder of their own go, each when nothing needs it any more."""
        own = path.absolute() / "recordings"
        return cls(path.absolute(), own if recordings is None else recordings.absolute(), recordings is not None)

    @property
    def _own_recordings(self) -> tuple[str, ...]:
        """Patterns of what is written among the recordings that are not to be kept."""
        if self.keep_recordings:
            return ()
        beside = (f"*.bag.calib/{file}" for file in CALIBRATION_FILES)
        made = (f"*.bag.simulation/{file}" for file in SIMULATION_FILES)
        return tuple(f"{self.recordings.name}/{file}" for file in ("*.bag", ".lock", *beside, *made))

    def begin(self, suite: Suite, *, overwrite: bool) -> None:
        """Make the folder that of ``suite``, or go on with it; raises :class:`RunError` where it is another suite's.

        With more seeds than before it is the same one.
        """
        text, file = to_yaml(suite), self.path / SUITE_FILE
        if self.path.exists() and any(self.path.iterdir()):
            if not file.is_file():
                raise RunError(
                    f"{self.path} holds no {SUITE_FILE}, is no results folder and stays; choose another --out"
                )
            if file.read_text(encoding="utf-8") != text and (differing := _differing(file, suite)):
                if not overwrite:
                    raise RunError(
                        f"{self.path} holds another suite's results, which differs in {', '.join(differing)}; choose "
                        "another --out, or --overwrite to begin anew"
                    )
                remove_written(self.path, (*RESULT_FILES, *self._own_recordings))
        try:
            for folder in (self.path / RUNS_FOLDER, self.recordings):
                folder.mkdir(parents=True, exist_ok=True)
            write_whole(file, text)
        except OSError as error:
            raise RunError(f"cannot write to {self.path}: {error.strerror}; choose another --out") from error

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep other sweeps off the folders, and leave no recording behind that is not to be kept.

        Raises :class:`RunError` where another sweep is at work there.
        """
        with ExitStack() as stack:
            for folder in {self.path, self.recordings}:
                stack.enter_context(_locked(folder))
            # What a sweep left that was killed.
            for folder in (self.path / RUNS_FOLDER, self.recordings):
                for unfinished in folder.glob(".*.unfinished"):
                    shutil.rmtree(unfinished, ignore_errors=True)
            try:
                yield
            finally:
                if not self.keep_recordings:
                    with suppress(OSError):
                        remove_written(self.path, self._own_recordings)

    def keep(self, task: str, rows: Sequence[Row]) -> None:
        """Put down the ``rows`` of a task in place of any that it had."""
        write_rows(self.path, {**read_rows(self.path), task: rows})

    def run_folder(self, task: str) -> Path:
        return self.path / RUNS_FOLDER / task

    def recording(self, name: str) -> Path:
        return self.recordings / name

    def drop(self, recording: str) -> None:
        """Nothing needs this recording any more."""
        if not self.keep_recordings:
            path = self.recording(recording)
            path.unlink(missing_ok=True)
            for folder in (simulation_folder(path), sidecar_folder(path)):
                shutil.rmtree(folder, ignore_errors=True)


def _differing(file: Path, suite: Suite) -> list[str]:
    """In what the suite in ``file`` is another than ``suite``; in nothing where that only has more seeds."""
    before, now = read_tree(file), to_jsonable_python(suite.model_dump())
    keys = [key for key in now if before.get(key) != now[key]]
    if keys == ["seeds"] and before.get("seeds") in range(suite.seeds):
        return []
    return keys or ["what it says"]


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold ``folder`` for this process."""
    try:
        file = locked(folder / ".lock", wait=False)
    except BlockingIOError:
        raise RunError(f"another sweep is at work in {folder}; wait for it, or choose another --out") from None
    with file:
        yield
