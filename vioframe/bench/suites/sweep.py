"""Gets the tasks of a plan done by the workers of a dask cluster, whatever happens to a worker or to the sweep.

A run folder is left by the worker that made it, and the table of results grows with every task that is done: a sweep
that was stopped goes on where it was. A task that fails, or whose worker dies, is tried once more; if that fails too it
is written down with its error, and the others go on. Not more tasks are handed out than there are workers, so that one
that dies takes only its own task with it.
"""

from __future__ import annotations

import signal
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from vioframe.bench.processes import usable_cores
from vioframe.bench.suites import tasks
from vioframe.bench.suites.plan import AnyTask, FlightTask, Plan, Recording, SpeedTask
from vioframe.bench.suites.store import Store
from vioframe.errors import PluginError, RunError, VioframeError
from vioframe.parts.registry import describe
from vioframe.runs.results import FINGERPRINT, Row, read_rows

if TYPE_CHECKING:
    from distributed import Client, Future

ATTEMPTS = 2
CONNECT_S = 10.0

_SETTINGS = {
    # A worker that dies is the sweep's business: it counts the attempts.
    "distributed.scheduler.allowed-failures": 0,
    # A worker that renders has helpers of its own, which daemons may not have.
    "distributed.worker.daemon": False,
    "distributed.scheduler.worker-saturation": 1.0,
    # Compiled code that holds the interpreter for seconds is no reason for complaints.
    "distributed.admin.tick.limit": "1h",
}
_SILENT = 100


@dataclass(frozen=True, slots=True)
class Event:
    """Something that is done: ``label`` of ``cost_s`` estimated seconds, ``error`` where it came to nothing."""

    label: str
    cost_s: float
    is_task: bool
    error: str = ""


@dataclass
class Tally:
    """What a sweep came to: tasks that had been done before, that were done, and that failed, with the error."""

    reused: int = 0
    done: int = 0
    failed: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Agenda:
    """What is left to do: tasks, and the recordings that must be simulated first."""

    tasks: tuple[AnyTask, ...]
    reused: int
    stale: int
    """Results there are that other code or data made, and that are made again."""

    @property
    def recordings(self) -> dict[str, Recording]:
        return {r.name: r for task in self.tasks if (r := _recording_of(task))}

    @property
    def cost_s(self) -> float:
        return sum(task.cost_s for task in self.tasks) + sum(each.cost_s for each in self.recordings.values())


def agenda(plan: Plan, store: Store) -> Agenda:
    """Every task of ``plan`` that ``store`` has no result of, by the same code on the same data."""
    kept = read_rows(store.path)

    def same(task: AnyTask, row: Row) -> bool:
        return all(row[column] == task.about[column] for column in FINGERPRINT)

    def done(task: AnyTask) -> bool:
        rows = kept.get(task.name, ())
        return bool(rows) and all(row["status"] != "failed" and same(task, row) for row in rows)

    left = tuple(task for task in plan.tasks if not done(task))
    stale = sum(not same(task, kept[task.name][0]) for task in left if task.name in kept)
    return Agenda(left, len(plan.tasks) - len(left), stale)


def sweep(
    left: Agenda,
    store: Store,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    on_event: Callable[[Event], None] = lambda event: None,
) -> Tally:
    """Do all that is ``left``, by ``workers`` local processes (by default one a core) or by those of ``scheduler``.

    The workers of a scheduler must reach the store's folders under the same paths. Raises :class:`RunError` where there
    is no scheduler, and :class:`PluginError` where dask is missing.
    """
    drive = _Drive(store, left, on_event)
    # Time is measured on the whole machine, with nothing beside.
    drive.here([task for task in left.tasks if isinstance(task, SpeedTask)])
    if flown := [task for task in left.tasks if not isinstance(task, SpeedTask)]:
        with _connected(workers, scheduler) as client:
            if scheduler is not None:
                _check_code(client, planned=flown[0].about["code"])
            drive.by_workers(client, flown, list(left.recordings.values()), renderers_may_help=scheduler is None)
    return drive.tally


def _check_code(client: Client, planned: str) -> None:
    """Raise :class:`RunError` where a worker elsewhere has other code than the tasks were ``planned`` with."""
    others = [worker for worker, version in client.run(tasks.code).items() if version != planned]
    if others:
        raise RunError(f"the worker {others[0]} has other code, plug-ins or versions; install the same there")


class _Drive:
    """Hands out jobs one by one as workers become free."""

    def __init__(self, store: Store, left: Agenda, on_event: Callable[[Event], None]) -> None:
        self.tally = Tally(reused=left.reused)
        self._store, self._on_event = store, on_event
        self._attempts: Counter[str] = Counter()
        self._queue: deque[AnyTask | Recording] = deque()
        """Flights first, recordings last: one that nobody needs any more can go."""
        self._needed: dict[str, list[AnyTask]] = defaultdict(list)
        """Flights that are not done yet, by recording."""

    def here(self, speeds: Sequence[SpeedTask]) -> None:
        for task in speeds:
            self._queue.append(task)
            while self._queue:
                self._attempts[task.name] += 1
                try:
                    rows, error = tasks.perform(task, self._store, self._attempts[task.name]), ""
                except Exception as failure:
                    rows, error = [], _one_line(failure)
                self._finished(self._queue.popleft(), rows, error)

    def by_workers(
        self, client: Client, flown: Sequence[AnyTask], recordings: Sequence[Recording], *, renderers_may_help: bool
    ) -> None:
        from concurrent.futures import CancelledError

        from distributed import wait

        for task in flown:
            self._needed[recording.name if (recording := _recording_of(task)) else ""].append(task)
        self._queue.extend([*self._needed.pop("", ()), *recordings])
        running: dict[Future[Any], AnyTask | Recording] = {}
        while self._queue or running:
            capacity = max(1, len(client.nthreads()))
            while self._queue and len(running) < capacity:
                job = self._queue.popleft()
                self._attempts[job.name] += 1
                attempt = self._attempts[job.name]
                how: dict[str, Any] = {"key": f"{job.name}-{attempt}", "pure": False}
                if isinstance(job, Recording):
                    # Where there are fewer recordings than workers, the idle ones help.
                    rendering = 1 + sum(isinstance(each, Recording) for each in (*self._queue, *running.values()))
                    helpers = max(1, capacity // rendering) if renderers_may_help else 1
                    future = client.submit(tasks.simulate, job, self._store, helpers, **how)
                else:
                    future = client.submit(tasks.perform, job, self._store, attempt, **how)
                running[future] = job
            try:
                done = wait(list(running), return_when="FIRST_COMPLETED").done
            except (CancelledError, OSError) as error:
                raise RunError("the scheduler is gone; the same command goes on where it was") from error
            for future in done:
                why = "" if future.status == "finished" else _why(future)
                self._finished(running.pop(future), None if why else future.result(), why)
                future.release()

    def _finished(self, job: AnyTask | Recording, rows: list[tasks.Figures] | None, error: str) -> None:
        """Take in what came of a job; one that failed is tried again, until it has been often enough."""
        again = bool(error) and self._attempts[job.name] < ATTEMPTS
        if not isinstance(job, Recording):
            if again:
                self._queue.appendleft(job)
            else:
                self._ended(job, rows, error)
        elif again:
            self._queue.append(job)
        else:
            self._on_event(Event(f"{job.name} simulated", job.cost_s, is_task=False, error=error))
            if not error:
                self._queue.extendleft(reversed(self._needed[job.name]))
                return
            for flight in tuple(self._needed[job.name]):
                self._ended(flight, None, f"its recording could not be simulated: {error}")

    def _ended(self, task: AnyTask, rows: list[tasks.Figures] | None, error: str) -> None:
        if error:
            self.tally.failed[task.name] = error
        else:
            self.tally.done += 1
        self._store.keep(task, rows or [tasks.failure(max(1, self._attempts[task.name]), error)])
        self._on_event(Event(task.name, task.cost_s, is_task=True, error=error))
        if (recording := _recording_of(task)) is not None:
            self._needed[recording.name].remove(task)
            if not self._needed[recording.name]:
                self._store.drop(recording)


def _recording_of(task: AnyTask) -> Recording | None:
    """What must be simulated for ``task``."""
    return task.recording if isinstance(task, FlightTask) else None


def _why(future: Future[Any]) -> str:
    from distributed.scheduler import KilledWorker

    error = future.exception()
    if isinstance(error, KilledWorker):
        return "its worker died, killed or short of memory"
    return _one_line(error) if error is not None else f"the scheduler says it is {future.status}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) if isinstance(error, VioframeError) else describe(error)


@contextmanager
def _connected(workers: int | None, scheduler: str | None) -> Iterator[Client]:
    """A client of ``workers`` local processes, one a core where None, or of the ``scheduler`` at an address.

    Local workers have one thread each, for BLAS and OpenMP too.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise PluginError('sweeps need dask.distributed: pip install "vioframe[bench]"') from error
    with dask.config.set(_SETTINGS):
        if scheduler is None:
            count = usable_cores() if workers is None else workers
            quiet: dict[str, Any] = {"dashboard_address": None, "memory_limit": 0, "silence_logs": _SILENT}
            with _deaf_to_ctrl_c():
                cluster = LocalCluster(n_workers=count, threads_per_worker=1, **quiet)
            with cluster, Client(cluster) as client:
                yield client
            return
        try:
            client = Client(scheduler, timeout=CONNECT_S)
        except (OSError, ValueError, TimeoutError) as error:
            raise RunError(f"there is no dask scheduler at {scheduler}; start one by `dask scheduler`") from error
        with client:
            if not client.nthreads():
                raise RunError(f"the scheduler at {scheduler} has no workers; start some by `dask worker`")
            yield client


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Ctrl-C goes to every process of a terminal; it is for this one to end the others, which begin without an ear.

    Threads and processes inherit what is blocked when they begin. What came meanwhile arrives here at the end.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Begun later, it would unblock the signal in the thread that begins it, and so in the worker that comes next.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
