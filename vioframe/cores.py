"""How many processors there are to work on, and how many threads work on them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock
from typing import Any

# More threads than this gain nothing on images of this size, and cost on machines that have many.
_MAX_OPENCV_THREADS = 4

ONE_BLAS_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""The environment of a process whose BLAS comes with one thread; what of it is not loaded yet need not be limited."""


def usable_cores() -> int:
    """Cores that this process may run on, which can be fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def limited_threads(opencv: int = _MAX_OPENCV_THREADS) -> Iterator[None]:
    """One BLAS thread, and few of OpenCV's, as long as it lasts; next to nothing to do within another.

    numpy and scipy bring a BLAS each; on matrices this small their threads only wait for one another.
    """
    import cv2

    before, most = cv2.getNumThreads(), min(max(opencv, 1), _MAX_OPENCV_THREADS)
    if before > most:
        cv2.setNumThreads(most)
    try:
        with _one_blas_thread:
            yield
    finally:
        if before > most:
            cv2.setNumThreads(before)


class _OneBlasThread:
    """From the first that enters to the last that leaves, whichever threads they are."""

    def __init__(self) -> None:
        self._lock, self._within = Lock(), 0
        self._limit: Any = None

    def __enter__(self) -> None:
        with self._lock:
            if self._within == 0:
                self._limit = _blas_libraries().limit(limits=1)
            self._within += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._within -= 1
            if self._within == 0:
                self._limit.__exit__(None, None, None)


_one_blas_thread = _OneBlasThread()


@cache
def _blas_libraries() -> Any:
    """A handle on the libraries that are loaded by now: finding them takes a while, so it is done once."""
    if not os.environ.items() >= ONE_BLAS_THREAD.items():
        import scipy.linalg  # noqa: F401  its BLAS is to be among them
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController().select(user_api="blas")
