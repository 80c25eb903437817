"""Compiled code that is there when it is needed: by a flight ahead of the flight, or by another process meanwhile.

That process is ``python -m vioframe.warming BACKEND``.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial

import numpy as np

from vioframe import jit
from vioframe.cores import limited_threads, usable_cores
from vioframe.errors import DivergedError
from vioframe.estimation import initialization
from vioframe.estimation.factors import problem
from vioframe.estimation.initialization import closed_form
from vioframe.estimation.standstill import common_motion_px
from vioframe.frontend.warming import load_kernels
from vioframe.interfaces import Backend
from vioframe.io.calibration import packaged_calibration
from vioframe.io.synchronise import Packet
from vioframe.parts import registry
from vioframe.quantiles import gate
from vioframe.types import (
    NS_PER_S,
    Calibration,
    CalibrationEstimate,
    FrameTracks,
    ImuSegment,
    NavState,
    Start,
    g_W,
)

# The flight that compiles everything: frames, and how far the camera moves between two.
_FRAMES, _PERIOD_NS, _STEP_M = 30, NS_PER_S // 10, 0.2
# Where the kernels lie that a start takes first and last.
_OF_A_START = closed_form, problem


def warm_up(backend: Backend, calibration: Calibration, *, start_first: bool = True) -> None:
    """Come once through all that is compiled for ``backend`` and its starts, or load it.

    What a start needs is ``start_first``, as it is in flight; who helps begins at the other end. ``backend`` is of no
    use afterwards; it may find its flight too odd to follow.
    """
    calibration = _with_rotation(calibration)

    def fly() -> None:
        with suppress(DivergedError, np.linalg.LinAlgError):
            _fly_along_a_wall(backend, calibration)

    steps: list[Callable[[], None]] = [partial(initialization.warm_up, calibration), fly]
    with limited_threads():
        for step in steps if start_first else reversed(steps):
            step()


@contextmanager
def helped(backend: str) -> Iterator[None]:
    """Within it, from the first kernel that has to be compiled on, another process compiles those of ``backend``.

    It begins with those that points are followed by, at the other end, and with what comes after a start.
    """
    helpers: list[subprocess.Popen[bytes]] = []

    def begin(kernel: str) -> None:
        if not helpers and usable_cores() > 1:
            command = [sys.executable, "-m", "vioframe.warming", backend]
            quiet = subprocess.DEVNULL
            helpers.append(subprocess.Popen(command, stdin=quiet, stdout=quiet, stderr=quiet))

    try:
        with jit.heard(begin):
            yield
    finally:
        for helper in helpers:
            helper.terminate()
            helper.wait()


def loading_meanwhile(packets: Iterable[Packet], calibration: Calibration) -> Iterator[Packet]:
    """The same; from the first on a thread loads what a start needs, while the other process prepares to follow points.

    Only what has been compiled before: to compile takes this process' time as well.
    """
    with ThreadPoolExecutor(1, "loader") as thread:
        for number, packet in enumerate(packets):
            if number == 0 and all(map(jit.have_been_compiled, _OF_A_START)):
                thread.submit(_load_start, _with_rotation(calibration))  # what fails here fails in its turn
            yield packet


def _load_start(calibration: Calibration) -> None:
    """What is needed when a flight begins: the module that gates take, and the kernels of a start."""
    gate(0.95, 1)
    initialization.warm_up(calibration)


def _with_rotation(calibration: Calibration) -> Calibration:
    """The same, the first camera's rotation taken for any where it is not known."""
    if calibration.cameras[0].rotation_known:
        return calibration
    return calibration.with_camera(0, R_BC=np.eye(3), rotation_known=True)


def _fly_along_a_wall(backend: Backend, calibration: Calibration) -> None:
    """Fly sideways along points that come and go, through every step of a window of some ten frames, and rest."""
    camera = calibration.cameras[0]
    right_W = camera.R_BC[:, 0]
    rng = np.random.default_rng(0)
    wall_C = rng.uniform([-1.5, -1.0, 3.0], [_FRAMES * _STEP_M + 1.5, 1.0, 5.0], (600, 3))
    cov = 1e-4 * np.eye(15)
    speed = _STEP_M / (_PERIOD_NS / NS_PER_S)
    state = NavState(0, np.eye(3), np.zeros(3), speed * right_W, np.zeros(3), np.zeros(3), cov)
    for k in range(_FRAMES):
        t_ns = np.linspace((k - 1) * _PERIOD_NS, k * _PERIOD_NS, 3).astype(np.int64)
        imu = ImuSegment(t_ns, np.zeros((3, 3)), np.tile(-g_W, (3, 1)))
        p_C = wall_C - [k * _STEP_M, 0.0, 0.0]
        ids = np.flatnonzero(np.abs(p_C[:, 0] / p_C[:, 2]) < 0.35)
        xy_normalised = p_C[ids, :2] / p_C[ids, 2:]
        xy = camera.model.distort(xy_normalised)
        tracks = FrameTracks(int(t_ns[-1]), ids, np.zeros_like(ids), xy, xy_normalised)
        if k == 0:
            known = CalibrationEstimate(calibration, (initialization.GIVEN,) * len(calibration.cameras))
            start = Start(state, known, calibration.imu, imu, tracks)
            backend.begin(start)
        else:
            backend.process(imu, tracks, False)
            if k == 1:
                resting = imu, tracks
    # A body that rests is seen to, and held: many a flight comes to that late, and none may wait then.
    common_motion_px(resting[1], resting[1])
    backend.begin(replace(start, state=replace(state, v_WB=np.zeros(3))))
    backend.process(*resting, True)


if __name__ == "__main__":
    load_kernels()
    found = registry.load().create_backend(sys.argv[1], {})
    warm_up(found, packaged_calibration("euroc", cameras=["cam0"]), start_first=False)
