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
        return {r.name: r for task in self.tasks if isinstance(task, FlightTask) and (r := task.recording)}

    @property
    def cost_s(self) -> float:
        return sum(task.cost_s for task in self.tasks) + sum(each.cost_s for each in self.recordings.values())


def agenda(plan: Plan, store: Store) -> Agenda:
    """Every task of ``plan`` that ``store`` has no result of, by the same code on the same data."""
    left, stale = store.left(plan.tasks)
    return Agenda(tuple(left), len(plan.tasks) - len(left), stale)


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
            drive.by_workers(client, flown, renderers_may_help=scheduler is None)
    return drive.tally


def _check_code(client: Client, planned: str) -> None:
    """Raise :class:`RunError` where a worker elsewhere has other code than the tasks were ``planned`` with."""
    others = [worker for worker, version in client.run(tasks.code).items() if version != planned]
    if others:
        raise RunError(f"the worker {others[0]} has other code, plug-ins or versions; install the same there")


class _Drive:
    """Hands out tasks one by one as workers become free."""

    def __init__(self, store: Store, left: Agenda, on_event: Callable[[Event], None]) -> None:
        self.tally = Tally(reused=left.reused)
        self._store, self._on_event = store, on_event
        self._attempts: Counter[str] = Counter()
        self._ready: deque[AnyTask] = deque()
        self._to_record = deque(left.recordings.values())
        self._needed: dict[str, list[FlightTask]] = defaultdict(list)
        """Flights that are not done yet, by recording."""

    def here(self, speeds: list[SpeedTask]) -> None:
        for task in speeds:
            for attempt in range(1, ATTEMPTS + 1):
                self._attempts[task.name] = attempt
                try:
                    rows, error = tasks.perform(task, self._store, attempt), ""
                    break
                except Exception as failure:
                    rows, error = [], _one_line(failure)
            self._ended(task, rows, error)

    def by_workers(self, client: Client, flown: Sequence[AnyTask], *, renderers_may_help: bool) -> None:
        from concurrent.futures import CancelledError

        from distributed import wait

        for task in flown:
            if isinstance(task, FlightTask) and task.recording is not None:
                self._needed[task.recording.name].append(task)
            else:
                self._ready.append(task)
        running: dict[Future[Any], AnyTask | Recording] = {}
        while self._ready or self._to_record or running:
            capacity = max(1, len(client.nthreads()))
            while len(running) < capacity and (self._ready or self._to_record):
                # Flights first: a recording that nobody needs any more can go.
                job = self._ready.popleft() if self._ready else self._to_record.popleft()
                self._attempts[job.name] += 1
                # Where there are fewer recordings than workers, the idle ones help.
                rendering = 1 + len(self._to_record) + sum(isinstance(each, Recording) for each in running.values())
                helpers = max(1, capacity // rendering) if renderers_may_help else 1
                work = tasks.simulate if isinstance(job, Recording) else tasks.perform
                how = helpers if isinstance(job, Recording) else self._attempts[job.name]
                key = f"{job.name}-{self._attempts[job.name]}"
                running[client.submit(work, job, self._store, how, key=key, pure=False)] = job
            try:
                done = wait(list(running), return_when="FIRST_COMPLETED").done
            except (CancelledError, OSError) as error:
                raise RunError("the scheduler is gone; the same command goes on where it was") from error
            for future in done:
                self._take_in(running.pop(future), future)

    def _take_in(self, job: AnyTask | Recording, future: Future[Any]) -> None:
        error = "" if future.status == "finished" else _why(future)
        rows = [] if error or isinstance(job, Recording) else future.result()
        future.release()
        again = bool(error) and self._attempts[job.name] < ATTEMPTS
        if not isinstance(job, Recording):
            if again:
                self._ready.append(job)
            else:
                self._ended(job, rows, error)
        elif again:
            self._to_record.append(job)
        else:
            self._on_event(Event(f"{job.name} simulated", job.cost_s, is_task=False, error=error))
            if not error:
                self._ready.extend(self._needed[job.name])
            else:
                for flight in tuple(self._needed[job.name]):
                    self._ended(flight, [], f"its recording could not be simulated: {error}")

    def _ended(self, task: AnyTask, rows: list[tasks.Figures], error: str) -> None:
        if error:
            rows = [tasks.failure(max(1, self._attempts[task.name]), error)]
            self.tally.failed[task.name] = error
        else:
            self.tally.done += 1
        self._store.keep(task, rows)
        self._on_event(Event(task.name, task.cost_s, is_task=True, error=error))
        if isinstance(task, FlightTask) and task.recording is not None:
            waiting = self._needed[task.recording.name]
            waiting.remove(task)
            if not waiting:
                self._store.drop(task.recording)


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
