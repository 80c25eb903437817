"""A simulated camera at work: light gathered through an exposure, then amplified, read out with noise and digitised."""

from __future__ import annotations

import os
import signal
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from threading import Thread

import numpy as np

from vioframe.errors import DatasetError
from vioframe.geometry.cameras import Camera
from vioframe.interfaces import World
from vioframe.simulation.movers import Movers
from vioframe.simulation.renderer import Renderer
from vioframe.simulation.sensor import digitise
from vioframe.simulation.shading import Float32
from vioframe.types import Float, Image

_MIDDLE_GREY = 0.4


@dataclass(frozen=True)
class Shot:
    """One picture to take: the camera's poses at S instants of the exposure, and how it is exposed.

    ``R_WC`` (S, 3, 3) and ``p_WC`` (S, 3) m; with a rolling shutter (S, height, 3, 3) and (S, height, 3). ``p_WM``
    (S, M, 3) m is where the movers are, or None. ``gain`` is that of the whole exposure; ``seed`` that of its noise.
    """

    R_WC: Float
    p_WC: Float
    p_WM: Float | None
    gain: float
    seed: tuple[int, ...]


@dataclass(frozen=True)
class Studio:
    """All that is the same for every picture: world, optics and sensor. Small enough to be sent to other processes.

    ``light`` is the part of full light there is, which the gain makes up for; ``noise_deviation`` is added to that of
    the sensor itself, 1 is white; ``dynamic_range`` is the exponent of light around middle grey.
    """

    camera: Camera
    world: World
    movers: Movers | None = None
    contrast: float = 1.0
    fog_per_m: float = 0.0
    light: float = 1.0
    noise_deviation: float = 0.0
    dynamic_range: float = 1.0


class SimulatedCamera:
    """Takes the pictures of a studio, the same ones for the same shots."""

    def __init__(self, studio: Studio) -> None:
        self._studio = studio
        self._renderer = Renderer(
            studio.camera, studio.world, studio.movers, contrast=studio.contrast, fog_per_m=studio.fog_per_m
        )

    def take(self, shot: Shot) -> Image:
        """(height, width) uint8."""
        movers = [None] * len(shot.p_WC) if shot.p_WM is None else shot.p_WM
        instants = zip(shot.R_WC, shot.p_WC, movers, strict=True)
        return self._digitise(np.mean([self._renderer.render(*instant) for instant in instants], axis=0), shot)

    def _digitise(self, light: Float32, shot: Shot) -> Image:
        studio = self._studio
        if studio.dynamic_range != 1.0:
            light = _MIDDLE_GREY * (light / _MIDDLE_GREY) ** studio.dynamic_range
        return digitise(
            light,
            np.random.default_rng(shot.seed),
            gain=shot.gain,
            exposed=studio.light,
            noise_deviation=studio.noise_deviation,
        )


def take_pictures(studio: Studio, shots: Iterable[Shot], workers: int) -> Iterator[Image]:
    """The pictures in the order of the shots, taken by ``workers`` processes; by this one where that is one.

    Raises :class:`DatasetError` where a process ends before its time.
    """
    if workers == 1:
        yield from map(SimulatedCamera(studio).take, shots)
        return
    # Spawned, not forked: threads of BLAS and Open3D do not survive a fork.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _open_studio, (studio,))
    waiting: deque[Future[Image]] = deque()
    try:
        for shot in shots:
            waiting.append(pool.submit(_take, shot))
            # A few ahead for each, and no more: shots and pictures must not pile up.
            if len(waiting) > 4 * workers:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    except BrokenProcessPool as error:
        raise DatasetError("a rendering process died, perhaps of too little memory; try fewer --workers") from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_camera: SimulatedCamera | None = None
"""That of a worker process: what it renders with is built once, not for every shot."""


def _open_studio(studio: Studio) -> None:
    global _camera
    # Ctrl-C goes to the whole group of processes; the one that waits for these ends them.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    _camera = SimulatedCamera(studio)


def _end_with_parent() -> None:
    """Where the one that waits is killed, nobody else would end this process."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _take(shot: Shot) -> Image:
    assert _camera is not None
    return _camera.take(shot)
