"""Compiled code that is there in time, and clocks that leave out the waiting for it."""

import subprocess
import sys
from time import perf_counter, thread_time

import numpy as np
import pytest
from scipy.stats import chi2

from vioframe import odometry
from vioframe.io.calibration import packaged_calibration
from vioframe.jit import kernel, waited_s
from vioframe.odometry import Odometry
from vioframe.quantiles import chi2_quantile
from vioframe.stopwatch import Stopwatch, working_s
from vioframe.warming import helped

CALIBRATION = packaged_calibration("euroc", cameras=["cam0"])


def compile_something() -> None:
    """A kernel made anew, which no cache has as its constant is another each time."""
    constant = perf_counter()

    @kernel
    def add(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return a + constant * b.T

    add(np.eye(3), np.eye(3))


def test_a_stopwatch_stands_still_while_a_kernel_is_compiled():
    watch, begin_s, waited = Stopwatch(), perf_counter(), waited_s()
    compile_something()
    watch.lap("all")
    taken_s = perf_counter() - begin_s
    assert 0.5 * taken_s < waited_s() - waited < taken_s
    assert watch.seconds["all"] == pytest.approx(taken_s - (waited_s() - waited), abs=1e-3)


def test_what_a_thread_computes_is_counted_without_compiling():
    begin_s, working = thread_time(), working_s(thread_time)
    compile_something()
    taken_s = thread_time() - begin_s
    assert working_s(thread_time) - working < 0.5 * taken_s
    begin_s, working = thread_time(), working_s(thread_time)
    while thread_time() - begin_s < 0.02:
        pass
    assert working_s(thread_time) - working >= 0.02


@pytest.fixture
def helpers(monkeypatch):
    """The commands of the processes that were begun, and what became of them."""
    begun = []

    class Helper:
        def __init__(self, command: list[str], **files: int) -> None:
            begun.append(command)

        def terminate(self) -> None:
            begun.append("terminated")

        def wait(self) -> None:
            begun.append("waited for")

    monkeypatch.setattr(subprocess, "Popen", Helper)
    monkeypatch.setattr("vioframe.warming.usable_cores", lambda: 2)
    return begun


def test_another_process_helps_once_something_is_to_be_compiled(helpers):
    with helped("msckf"):
        assert helpers == []
        compile_something()
        compile_something()
        assert helpers == [[sys.executable, "-m", "vioframe.warming", "msckf"]]
    assert helpers[1:] == ["terminated", "waited for"]


def test_nobody_helps_on_one_core_nor_without_need(helpers, monkeypatch):
    with helped("msckf"):
        pass
    monkeypatch.setattr("vioframe.warming.usable_cores", lambda: 1)
    with helped("msckf"):
        compile_something()
    assert helpers == []


def test_what_helps_comes_to_its_end():
    subprocess.run([sys.executable, "-m", "vioframe.warming", "loose_ekf"], check=True, capture_output=True)


def test_a_recording_waits_for_no_warming_up(monkeypatch):
    warmed = []
    monkeypatch.setattr(odometry, "warm_up", lambda backend, calibration: warmed.append(backend))
    Odometry(CALIBRATION, warm=False)
    assert warmed == []
    Odometry(CALIBRATION)
    assert len(warmed) == 1


@pytest.mark.parametrize("p", [0.05, 0.5, 0.95, 0.999])
def test_quantiles_are_those_of_scipy(p):
    dof = np.arange(1, 50)
    np.testing.assert_allclose(chi2_quantile(p, dof), chi2.ppf(p, dof), rtol=1e-12)
