"""Fixtures shared by all tests."""

import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from simulation_helpers import textures_drawn_once
from threadpoolctl import threadpool_limits

from vioframe.frontend.warming import load_kernels
from vioframe.io.calibration import packaged_calibration
from vioframe.parts import registry
from vioframe.warming import warm_up

ROOT = Path(__file__).resolve().parents[1]

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # As in jobs that a script puts into the background; the programs under test would ignore Ctrl-C as well.
    signal.signal(signal.SIGINT, signal.default_int_handler)

SHARED_DATA = ROOT.parent / "shared" / "data"

BACKENDS = ("msckf", "sliding_window", "loose_ekf")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Workers have a core each, so that what they run begins no second process beside those of the others.

    In a checkout that is new every worker would compile every kernel: each compiles a part ahead, for all.
    """
    worker = getattr(session.config, "workerinput", None)
    if worker is not None:
        number = int(worker["workerid"].removeprefix("gw"))  # xdist's are gw0, gw1, ...
        if hasattr(os, "sched_setaffinity"):
            cores = sorted(os.sched_getaffinity(0))
            os.sched_setaffinity(0, {cores[number % len(cores)]})
            # Threads of BLAS, as many as there are cores, would wait for one another on the one.
            threadpool_limits(1)
            os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        installed, calibration = registry.load(), packaged_calibration("euroc", cameras=["cam0"])
        parts = [partial(warm_up, installed.create_backend(name), calibration) for name in BACKENDS]
        for compile_part in [*parts, load_kernels][number :: worker["workercount"]]:
            compile_part()


@pytest.fixture(scope="session", autouse=True)
def remembered_textures() -> Iterator[None]:
    """Worlds of one seed look the same, and most tests' are of one."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("vioframe.simulation.textures.procedural_textures", textures_drawn_once)
        yield


@pytest.fixture
def no_display(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a computer without a screen."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings that lies beside the checkout; tests that need it skip where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("needs the real recordings in ../shared/data, which are not here")
    return SHARED_DATA
