"""Checks a live source on a device, or what stands for one, that its author has plugged in."""

from __future__ import annotations

from threading import Event, Thread
from typing import Any

import numpy as np

from vioframe.interfaces import Source, SourceFactory
from vioframe.testing.dataset import check_about, check_measurements
from vioframe.testing.require import fail, require
from vioframe.types import NavState

# The promise is a second; threads may wait for one another.
_ENDS_WITHIN_S, _BEGINS_WITHIN_S = 2.0, 30.0


def check_source(factory: SourceFactory, address: str, *, max_frames: int = 10, **options: Any) -> None:
    """Check ``factory(address, **options)`` against :class:`vioframe.interfaces.Source`, on the first ``max_frames``.

    What it brings is as a data set's. It hears a state. Closed by another thread while it is read, it ends.
    """
    source = factory(address, **options)
    check_about(source)
    check_measurements(source, max_frames)
    try:
        source.tell(NavState(0, np.eye(3), *np.zeros((4, 3))))
    except Exception as error:
        fail(f"tell(state) raised {error!r}; states without a covariance come, too")
    source.close()
    _check_ends(factory(address, **options))


def _check_ends(source: Source) -> None:
    came, raised = Event(), list[BaseException]()

    def read() -> None:
        try:
            for _ in source.measurements():
                came.set()
        except BaseException as error:
            raised.append(error)

    thread = Thread(target=read, daemon=True)
    thread.start()
    came.wait(_BEGINS_WITHIN_S)
    source.close()
    thread.join(_ENDS_WITHIN_S)
    require(not raised, f"closed while it is read it raised {raised[0]!r}" if raised else "")
    require(not thread.is_alive(), f"measurements() goes on {_ENDS_WITHIN_S:g} s after close()")
