"""Gets the tasks of a plan done by the workers of a dask cluster, whatever happens to a worker or to the sweep.

What is done is kept by the worker that did it, at once: a sweep that was stopped goes on where it was. A task that
fails, or whose worker dies, is tried once more; if that fails too it is written down with its error, and the others go
on. Not more tasks are handed out than there are workers, so that one that dies takes only its own task with it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vioframe.bench.suites import tasks
from vioframe.bench.suites.cluster import connected
from vioframe.bench.suites.plan import AnyJob, FlightJob, Plan, RecordingJob, SpeedJob
from vioframe.bench.suites.store import Store
from vioframe.errors import RunError, VioframeError
from vioframe.parts.registry import describe

if TYPE_CHECKING:
    from distributed import Client, Future

ATTEMPTS = 2


@dataclass(frozen=True, slots=True)
class Event:
    """Something that is done: ``label`` of ``cost_s`` estimated seconds, ``error`` where it came to nothing."""

    label: str
    cost_s: float
    is_task: bool
    error: str = ""


@dataclass
class Outcome:
    """What a sweep came to: tasks that had been done before, that were done, and that failed, with the error."""

    reused: int = 0
    done: int = 0
    failed: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Agenda:
    """What is left to do: tasks, and the recordings that must be simulated first, with the tasks that wait for each."""

    jobs: tuple[AnyJob, ...]
    reused: int
    stale: int
    """Results there are that other code or data made, and that are made again."""

    @property
    def recordings(self) -> dict[str, RecordingJob]:
        found = (job.recording for job in self.jobs if isinstance(job, FlightJob))
        return {recording.name: recording for recording in found if recording is not None}

    @property
    def cost_s(self) -> float:
        return sum(job.cost_s for job in self.jobs) + sum(job.cost_s for job in self.recordings.values())


def agenda(plan: Plan, store: Store) -> Agenda:
    """Every task of ``plan`` that ``store`` has no result of, by the same code on the same data."""
    left = tuple(job for job in plan.jobs if not store.done(job))
    return Agenda(left, len(plan.jobs) - len(left), sum(store.stale(job) for job in left))


def sweep(
    left: Agenda,
    store: Store,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    on_event: Callable[[Event], None] = lambda event: None,
) -> Outcome:
    """Do all that is ``left``, by ``workers`` local processes (by default one a core) or by those of ``scheduler``.

    The workers of a scheduler must reach the store's folders under the same paths. Raises :class:`RunError` where there
    is no scheduler, and :class:`PluginError` where dask is missing.
    """
    outcome = Outcome(reused=left.reused)
    flown = [job for job in left.jobs if not isinstance(job, SpeedJob)]
    for job in left.jobs:
        if isinstance(job, SpeedJob):
            # Time is measured on the whole machine, with nothing beside.
            _report(outcome, on_event, job, _attempt_here(store, job))
    if flown:
        with connected(workers, scheduler) as client:
            if scheduler is not None:
                _check_code(client, planned=flown[0].fingerprint["code"])
            _Drive(client, store, flown, left, outcome, on_event, helpers=scheduler is None).run()
    return outcome


def _check_code(client: Client, planned: str) -> None:
    """Raise :class:`RunError` where a worker elsewhere has other code than the tasks were ``planned`` with."""
    others = [worker for worker, version in client.run(tasks.code).items() if version != planned]
    if others:
        raise RunError(f"the worker {others[0]} has other code, plug-ins or versions; install the same there")


class _Drive:
    """Hands out tasks one by one as workers become free."""

    def __init__(
        self,
        client: Client,
        store: Store,
        jobs: Sequence[AnyJob],
        left: Agenda,
        outcome: Outcome,
        on_event: Callable[[Event], None],
        *,
        helpers: bool,
    ) -> None:
        self._client, self._store, self._outcome, self._on_event = client, store, outcome, on_event
        self._helpers = helpers
        self._ready: deque[AnyJob] = deque()
        self._waiting: dict[str, list[FlightJob]] = {name: [] for name in left.recordings}
        self._needed: Counter[str] = Counter()
        self._to_record = deque(left.recordings.values())
        self._attempts: Counter[str] = Counter()
        self._running: dict[Future[Any], AnyJob | RecordingJob] = {}
        for job in jobs:
            if isinstance(job, FlightJob) and job.recording is not None:
                self._waiting[job.recording.name].append(job)
                self._needed[job.recording.name] += 1
            else:
                self._ready.append(job)

    def run(self) -> None:
        from concurrent.futures import CancelledError

        from distributed import wait

        while self._ready or self._to_record or self._running:
            self._hand_out()
            try:
                done = wait(list(self._running), return_when="FIRST_COMPLETED").done
            except (CancelledError, OSError) as error:
                raise RunError("the scheduler is gone; the same command goes on where it was") from error
            for future in done:
                self._take_in(self._running.pop(future), future)

    def _hand_out(self) -> None:
        while len(self._running) < self._capacity() and (self._ready or self._to_record):
            # Flights first: a recording that nobody needs any more can go.
            job = self._ready.popleft() if self._ready else self._to_record.popleft()
            name = _name(job)
            self._attempts[name] += 1
            key = f"{name}-{self._attempts[name]}"
            if isinstance(job, RecordingJob):
                work: tuple[Any, ...] = (tasks.simulate, self._store, job, self._rendering_processes())
            else:
                work = (tasks.perform, self._store, job, self._attempts[name])
            self._running[self._client.submit(*work, key=key, pure=False)] = job

    def _capacity(self) -> int:
        return max(1, len(self._client.nthreads()))

    def _rendering_processes(self) -> int:
        """Where there are fewer recordings than workers, the idle ones help."""
        if not self._helpers:
            return 1
        rendering = 1 + len(self._to_record) + sum(isinstance(job, RecordingJob) for job in self._running.values())
        return max(1, self._capacity() // rendering)

    def _take_in(self, job: AnyJob | RecordingJob, future: Future[Any]) -> None:
        error = "" if future.status == "finished" else _why(future)
        future.release()
        if error and self._attempts[_name(job)] < ATTEMPTS:
            (self._to_record if isinstance(job, RecordingJob) else self._ready).append(job)  # type: ignore[arg-type]
        elif isinstance(job, RecordingJob):
            self._recorded(job, error)
        else:
            if error:
                self._store.failed(job, self._attempts[job.key], error)
            self._ended(job, error)

    def _recorded(self, job: RecordingJob, error: str) -> None:
        waiting = self._waiting.pop(job.name)
        self._on_event(Event(f"{job.name} simulated", job.cost_s, is_task=False, error=error))
        if not error:
            self._ready.extend(waiting)
            return
        for flight in waiting:
            text = f"its recording could not be simulated: {error}"
            self._store.failed(flight, self._attempts[job.name], text)
            self._ended(flight, text)

    def _ended(self, job: AnyJob, error: str) -> None:
        _report(self._outcome, self._on_event, job, error)
        if isinstance(job, FlightJob) and job.recording is not None:
            self._needed[job.recording.name] -= 1
            if not self._needed[job.recording.name]:
                self._store.drop(job.recording)


def _attempt_here(store: Store, job: AnyJob) -> str:
    """Do ``job`` in this process; the error of the last attempt, or nothing."""
    error = ""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            store.keep(job, attempt, lambda folder: tasks.speed(job))  # type: ignore[arg-type]
            return ""
        except Exception as failure:
            error = _one_line(failure)
    store.failed(job, ATTEMPTS, error)
    return error


def _report(outcome: Outcome, on_event: Callable[[Event], None], job: AnyJob, error: str) -> None:
    if error:
        outcome.failed[job.key] = error
    else:
        outcome.done += 1
    on_event(Event(job.key, job.cost_s, is_task=True, error=error))


def _name(job: AnyJob | RecordingJob) -> str:
    return job.name if isinstance(job, RecordingJob) else job.key


def _why(future: Future[Any]) -> str:
    from distributed.scheduler import KilledWorker

    error = future.exception()
    if isinstance(error, KilledWorker):
        return "its worker died, killed or short of memory"
    return _one_line(error) if error is not None else f"the scheduler says it is {future.status}"


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) if isinstance(error, VioframeError) else describe(error)
