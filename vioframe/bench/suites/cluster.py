"""The workers of a sweep: processes of this machine, one a core, or those of a dask scheduler elsewhere."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

from vioframe.bench.processes import usable_cores
from vioframe.errors import PluginError, RunError

if TYPE_CHECKING:
    from distributed import Client

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


@contextmanager
def connected(workers: int | None, scheduler: str | None) -> Iterator[Client]:
    """A client of ``workers`` local processes, one a core where None, or of the ``scheduler`` at an address.

    Local workers have one thread each, for BLAS and OpenMP too. Raises :class:`RunError` where there is no scheduler,
    or no worker behind it, and :class:`PluginError` where dask is missing.
    """
    try:
        import dask
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise PluginError('sweeps need dask.distributed: pip install "vioframe[bench]"') from error
    with dask.config.set(_SETTINGS):
        if scheduler is None:
            count = usable_cores() if workers is None else workers
            with _deaf_to_ctrl_c():
                cluster = LocalCluster(
                    n_workers=count,
                    threads_per_worker=1,
                    dashboard_address=None,
                    memory_limit=0,
                    silence_logs=_SILENT,
                )
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
