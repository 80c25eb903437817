"""The results folder: what is done stays done, however a sweep ends. Read by :mod:`vioframe.report.suite.results`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from pydantic_core import to_jsonable_python

from vioframe.bench.suites.plan import AnyJob, Plan, RecordingJob
from vioframe.bench.suites.suite import Suite, render
from vioframe.errors import RunError
from vioframe.io.calibration import sidecar_folder
from vioframe.io.convert import appearing
from vioframe.parts.config import read_tree
from vioframe.parts.registry import describe
from vioframe.report.suite.results import SUITE_FILE, TASK_FILE, TASKS_FOLDER
from vioframe.runs import machine
from vioframe.runs.recorder import write_json, write_whole
from vioframe.simulation.config import simulation_folder

Result = Mapping[str, Any]


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

    def begin(self, plan: Plan, *, overwrite: bool) -> None:
        """Make the folder that of ``plan``, or go on with it; raises :class:`RunError` where it is another suite's."""
        text, file = render(plan.suite), self.path / SUITE_FILE
        if self.path.exists() and any(self.path.iterdir()):
            if not file.is_file():
                raise RunError(
                    f"{self.path} holds no {SUITE_FILE}, is no results folder and stays; choose another --out"
                )
            if file.read_text(encoding="utf-8") != text:
                if not overwrite:
                    differing = ", ".join(_differing(read_tree(file), plan.suite)) or "what it says"
                    raise RunError(
                        f"{self.path} holds another suite's results, which differs in {differing}; choose another "
                        "--out, or --overwrite to begin anew"
                    )
                shutil.rmtree(self.path)
        try:
            (self.path / TASKS_FOLDER).mkdir(parents=True, exist_ok=True)
            self.recordings.mkdir(parents=True, exist_ok=True)
            if not file.is_file():
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
            for unfinished in (self.path / TASKS_FOLDER).glob(".*.unfinished"):
                shutil.rmtree(unfinished, ignore_errors=True)
            try:
                yield
            finally:
                if not self.keep_recordings:
                    shutil.rmtree(self.recordings, ignore_errors=True)

    def done(self, job: AnyJob) -> bool:
        """Whether there is a result of ``job`` that the same code made of the same data."""
        task = self._task(job)
        return bool(task.get("status") == "ok" and task.get("fingerprint") == dict(job.fingerprint))

    def stale(self, job: AnyJob) -> bool:
        """Whether there is a result of ``job`` that other code, or other data, made."""
        task = self._task(job)
        return bool(task.get("fingerprint", dict(job.fingerprint)) != dict(job.fingerprint))

    def _task(self, job: AnyJob) -> dict[str, Any]:
        try:
            tree = json.loads((self._folder(job) / TASK_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return tree if isinstance(tree, dict) else {}

    def keep(self, job: AnyJob, attempts: int, work: Callable[[Path], Result]) -> Result:
        """Have ``work`` done in a folder that becomes the task's once it has returned its figures."""
        begin_s = perf_counter()
        with appearing(self._folder(job), replace=True) as folder:
            folder.mkdir()
            try:
                result = work(folder)
            except OSError as error:
                raise RunError(describe(error)) from error  # its own words, before the folder has others for it
            _write(folder, job, attempts, perf_counter() - begin_s, "", result)
        return result

    def failed(self, job: AnyJob, attempts: int, error: str) -> None:
        """Write down that ``job`` came to nothing, and why."""
        with appearing(self._folder(job), replace=True) as folder:
            folder.mkdir()
            _write(folder, job, attempts, 0.0, error, {})

    def recording(self, job: RecordingJob) -> Path:
        return self.recordings / job.name

    def drop(self, job: RecordingJob) -> None:
        """Nothing needs this recording any more."""
        if not self.keep_recordings:
            path = self.recording(job)
            path.unlink(missing_ok=True)
            for folder in (simulation_folder(path), sidecar_folder(path)):
                shutil.rmtree(folder, ignore_errors=True)

    def _folder(self, job: AnyJob) -> Path:
        return self.path / TASKS_FOLDER / job.key


def _differing(before: Mapping[str, Any], suite: Suite) -> list[str]:
    """The keys in which the tree of a suite differs from ``suite``."""
    now = to_jsonable_python(suite.model_dump())
    return [key for key in now if before.get(key) != now[key]]


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold ``folder`` for this process; the system lets go of it when the process ends, however it does."""
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(f"another sweep is at work in {folder}; wait for it, or choose another --out") from None
        yield


def _write(folder: Path, job: AnyJob, attempts: int, seconds: float, error: str, result: Result) -> None:
    tree = {
        "key": job.key,
        "kind": job.kind.value,
        "labels": None if job.labels is None else asdict(job.labels),
        "data": None if job.data is None else job.data.value,
        "data_note": job.note,
        "fingerprint": dict(job.fingerprint),
        "status": "failed" if error else "ok",
        "error": error,
        "attempts": attempts,
        "seconds": seconds,
        "machine": machine.describe(),
        "result": result,
    }
    write_json(folder / TASK_FILE, tree)
