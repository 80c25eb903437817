"""The results folder: what is done stays done, however a sweep ends. Read by :mod:`vioframe.report.suite.results`."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from vioframe import machine
from vioframe.bench.suites.plan import AnyJob, Plan, RecordingJob
from vioframe.bench.suites.suite import render
from vioframe.convert import appearing
from vioframe.errors import RunError
from vioframe.recorder import write_json
from vioframe.report.suite.results import SUITE_FILE, TASK_FILE, TASKS_FOLDER
from vioframe.simulation.files import simulation_folder

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
                    raise RunError(f"{self.path} holds another suite's results; choose another --out or --overwrite")
                shutil.rmtree(self.path)
        try:
            (self.path / TASKS_FOLDER).mkdir(parents=True, exist_ok=True)
            self.recordings.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
        except OSError as error:
            raise RunError(f"cannot write to {self.path}: {error.strerror}; choose another --out") from error

    def done(self, job: AnyJob) -> bool:
        """Whether there is a result of ``job`` that the same code made of the same data."""
        try:
            task = json.loads((self._folder(job) / TASK_FILE).read_text(encoding="utf-8"))
            return bool(task["status"] == "ok" and task["fingerprint"] == dict(job.fingerprint))
        except (OSError, ValueError, KeyError, TypeError):
            return False

    def keep(self, job: AnyJob, attempts: int, work: Callable[[Path], Result]) -> Result:
        """Have ``work`` done in a folder that becomes the task's once it has returned its figures."""
        begin_s = perf_counter()
        with appearing(self._folder(job), replace=True) as folder:
            folder.mkdir()
            result = work(folder)
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
            shutil.rmtree(simulation_folder(path), ignore_errors=True)

    def _folder(self, job: AnyJob) -> Path:
        return self.path / TASKS_FOLDER / job.key


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
