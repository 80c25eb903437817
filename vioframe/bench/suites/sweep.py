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
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from vioframe.bench.suites import tasks
from vioframe.bench.suites.store import Store
from vioframe.bench.suites.tasks import AnyTask, Recording, SpeedTask
from vioframe.cores import usable_cores
from vioframe.errors import RunError, VioframeError, needs
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


class Sweep:
    """The ``tasks`` that ``store`` has no result of by the same code on the same data, and what comes of them.

    ``left`` are to do and ``recordings`` must be simulated for them; ``reused`` were done before, and ``stale`` of
    those that are left were, by other code or on other data. ``done`` counts, ``failed`` has errors by name of the
    task.
    """

    def __init__(self, tasks: Sequence[AnyTask], store: Store) -> None:
        kept = read_rows(store.path)

        def same(task: AnyTask, row: Row) -> bool:
            return all(row[column] == task.about[column] for column in FINGERPRINT)

        def is_done(task: AnyTask) -> bool:
            rows = kept.get(task.name, ())
            return bool(rows) and all(row["status"] != "failed" and same(task, row) for row in rows)

        self.left = [task for task in tasks if not is_done(task)]
        self.recordings = {task.recording.name: task.recording for task in self.left if task.recording is not None}
        self.reused = len(tasks) - len(self.left)
        self.stale = sum(not same(task, kept[task.name][0]) for task in self.left if task.name in kept)
        self.done, self.failed = 0, dict[str, str]()
        self._store = store
        self._on_progress: Callable[[str, float], None] = lambda label, cost_s: None
        self._attempts: Counter[str] = Counter()
        # Flights first, recordings last: one that nobody needs any more can go.
        self._queue: deque[AnyTask | Recording] = deque()
        # Flights that are not done yet, by recording.
        self._needed: dict[str, list[AnyTask]] = defaultdict(list)

    @property
    def cost_s(self) -> float:
        """Estimated seconds on one core, for all that is left."""
        return sum(job.cost_s for job in (*self.left, *self.recordings.values()))

    def run(
        self,
        *,
        workers: int | None = None,
        scheduler: str | None = None,
        on_progress: Callable[[str, float], None] = lambda label, cost_s: None,
    ) -> None:
        """Do all that is left, by ``workers`` local processes (by default one a core) or by those of ``scheduler``.

        The workers of a scheduler must reach the store's folders under the same paths. ``on_progress`` is told what
        came to its end, and its part of :attr:`cost_s`. Raises :class:`RunError` where there is no scheduler, and
        :class:`PluginError` where dask is missing.
        """
        self._on_progress = on_progress
        for task in self.left:
            if isinstance(task, SpeedTask):
                self._here(task)
        if flown := [task for task in self.left if not isinstance(task, SpeedTask)]:
            for task in flown:
                self._needed[task.recording.name if task.recording is not None else ""].append(task)
            self._queue.extend([*self._needed.pop("", ()), *self.recordings.values()])
            with _connected(workers, scheduler) as client:
                if scheduler is not None:
                    _check_code(client, planned=flown[0].about["code"])
                self._by_workers(client, renderers_may_help=scheduler is None)

    def _here(self, task: SpeedTask) -> None:
        """Time is measured on the whole machine, with nothing beside."""
        self._queue.append(task)
        while self._queue:
            self._attempts[task.name] += 1
            try:
                rows, error = tasks.perform(task, self._store, self._attempts[task.name]), ""
            except Exception as failure:
                rows, error = [], _one_line(failure)
            self._finished(self._queue.popleft(), rows, error)

    def _by_workers(self, client: Client, *, renderers_may_help: bool) -> None:
        from concurrent.futures import CancelledError

        from distributed import wait

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
                finished = wait(list(running), return_when="FIRST_COMPLETED").done
            except (CancelledError, OSError) as error:
                raise RunError("the scheduler is gone; the same command goes on where it was") from error
            for future in finished:
                why = "" if future.status == "finished" else _why(future)
                self._finished(running.pop(future), [] if why else future.result(), why)
                future.release()

    def _finished(self, job: AnyTask | Recording, rows: list[tasks.Figures], error: str) -> None:
        """Take in what came of a job; one that failed is tried again, until it has been often enough."""
        if error and self._attempts[job.name] < ATTEMPTS:
            self._queue.appendleft(job)
        elif not isinstance(job, Recording):
            self._ended(job, rows, error)
        else:
            self._on_progress(f"{job.name} simulated", job.cost_s)
            waiting = tuple(self._needed[job.name])
            if not error:
                self._queue.extendleft(reversed(waiting))
                return
            for flight in waiting:
                self._ended(flight, [], f"its recording could not be simulated: {error}")

    def _ended(self, task: AnyTask, rows: list[tasks.Figures], error: str) -> None:
        if error:
            self.failed[task.name] = error
            rows = [tasks.failure(max(1, self._attempts[task.name]), error)]
        else:
            self.done += 1
        self._store.keep(task.name, [{**task.about, **row} for row in rows])
        self._on_progress(task.name, task.cost_s)
        if task.recording is not None:
            self._needed[task.recording.name].remove(task)
            if not self._needed[task.recording.name]:
                self._store.drop(task.recording.name)


def _check_code(client: Client, planned: str) -> None:
    """Raise :class:`RunError` where a worker elsewhere has other code than the tasks were ``planned`` with."""
    others = [worker for worker, version in client.run(tasks.code).items() if version != planned]
    if others:
        raise RunError(f"the worker {others[0]} has other code, plug-ins or versions; install the same there")


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
    with needs("dask.distributed", "bench", user="a sweep"):
        import dask
        from distributed import Client, LocalCluster
    with dask.config.set(_SETTINGS):
        if scheduler is None:
            count = usable_cores() if workers is None else workers
            # Where nobody asks for it, its page takes whatever port is free: several sweeps may run side by side.
            quiet: dict[str, Any] = {"dashboard_address": "127.0.0.1:0", "memory_limit": 0, "silence_logs": _SILENT}
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
