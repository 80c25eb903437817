"""Jobs spread over processes, as parallel Python must be where each job keeps one core busy."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from multiprocessing import active_children, get_context
from typing import TypeVar

from vioframe.errors import RunError
from vioframe.parts import registry
from vioframe.parts.registry import Registry

JobT = TypeVar("JobT")
ResultT = TypeVar("ResultT")


@cache
def installed() -> Registry:
    """The installed parts, loaded once in each process."""
    return registry.load()


def map_in_processes(
    function: Callable[[JobT], ResultT],
    jobs: Sequence[JobT],
    workers: int,
    on_result: Callable[[ResultT], None] = lambda result: None,
) -> list[ResultT]:
    """``function`` of each job, in the order of ``jobs``, by at most ``workers`` processes; one worker is this process.

    ``on_result`` is called here with each result as it comes. The first error of a job, and Ctrl-C, ends them all.
    Raises :class:`RunError` where a process dies.
    """
    if workers == 1:
        results = []
        for job in jobs:
            results.append(function(job))
            on_result(results[-1])
        return results
    others = set(active_children())
    # Spawned, not forked: a fork copies the locks of threads (BLAS, the progress bar) that do not exist in the copy.
    pool = ProcessPoolExecutor(min(workers, len(jobs)), get_context("spawn"), initializer=_leave_talking_to_parent)
    try:
        futures = [pool.submit(function, job) for job in jobs]
        for future in as_completed(futures):
            on_result(future.result())
        return [future.result() for future in futures]
    except BrokenProcessPool as error:
        raise RunError("a worker process died, killed or short of memory; try again with fewer --workers") from error
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(active_children()) - others:
            child.terminate()
        raise
    finally:
        pool.shutdown()


@contextmanager
def single_threaded() -> Iterator[None]:
    """OpenCV, BLAS and OpenMP on one thread: for where there is a process a core already."""
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)


def _leave_talking_to_parent() -> None:
    # Ctrl-C and a plug-in that does not load reach every process; one that says so is enough.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    logging.getLogger("vioframe").addHandler(logging.NullHandler())
