"""Compiled code that is there in time, and clocks that leave out the waiting for it."""

import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter, thread_time

import numpy as np
import pytest
from scipy.stats import chi2

from vioframe import odometry
from vioframe.frontend.warming import load_kernels
from vioframe.io.calibration import packaged_calibration
from vioframe.jit import kernel, waited_s
from vioframe.odometry import Odometry
from vioframe.quantiles import chi2_quantile
from vioframe.stopwatch import Stopwatch, working_s
from vioframe.warming import helped, loading_meanwhile

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


@pytest.mark.parametrize("compiled", [True, False])
def test_a_start_is_loaded_meanwhile_where_that_is_not_to_compile(monkeypatch, compiled):
    loaded = []
    monkeypatch.setattr("vioframe.jit.have_been_compiled", lambda module: compiled)
    monkeypatch.setattr("vioframe.estimation.initialization.warm_up", loaded.append)
    assert list(loading_meanwhile([1, 2, 3], CALIBRATION.with_camera(0, rotation_known=False))) == [1, 2, 3]
    assert [calibration.cameras[0].rotation_known for calibration in loaded] == [True] * compiled


def test_loading_the_kernels_of_a_first_frame_brings_no_compiler_and_no_linear_algebra():
    """In a process of its own. Each takes 0.1 s of a start, so that kernels do without what numba overloads."""
    code = """
import sys
from vioframe.frontend.warming import load_kernels
from vioframe.jit import heard
told = []
with heard(told.append):
    load_kernels()
print(*told, *sorted({"scipy.linalg", "numba.core.typing.arraydecl", "numba.np.arraymath"} & set(sys.modules)))
"""
    load_kernels()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


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


IN_FLIGHT = """
import gc
import sys
from numba.core.dispatcher import Dispatcher
from rendered_flight import CALIBRATION, rendered_flight
from vioframe.odometry import Odometry

def compiled():
    kernels = [each for each in gc.get_objects() if isinstance(each, Dispatcher)]
    ours = [k for k in kernels if k.__module__.startswith("vioframe")]
    return {f"{k.__module__}.{k.__name__}{s}" for k in ours for s in k.signatures}

measurements = rendered_flight().measurements
first_ns = measurements[0].t_ns + int(sys.argv[2]) * 10**9
odometry = Odometry(CALIBRATION, backend=sys.argv[1])
before = compiled()
steps = [step for m in measurements if first_ns <= m.t_ns < first_ns + 6 * 10**9 for step in odometry.add(m)]
assert steps[-1].estimate.state is not None, steps[-1].estimate.events
print(*sorted(compiled() - before), sep="\\n")
"""


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["msckf", "sliding_window", "loose_ekf"])
@pytest.mark.parametrize("begin_s", [0, 2])
def test_nothing_is_compiled_or_loaded_in_flight(backend: str, begin_s: int):
    """In a process of its own, where nobody else has compiled anything; begun at rest and in motion."""
    command = [sys.executable, "-c", IN_FLIGHT, backend, str(begin_s)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == ""


@pytest.mark.parametrize("p", [0.05, 0.5, 0.95, 0.999])
def test_quantiles_are_those_of_scipy(p):
    dof = np.arange(1, 50)
    np.testing.assert_allclose(chi2_quantile(p, dof), chi2.ppf(p, dof), rtol=1e-12)


def test_outliers_are_judged_by_what_was_loaded():
    """Where the camera's rotation is unknown at first, that is needed in the midst of a flight."""
    code = (
        "from vioframe.frontend.warming import load_kernels; from vioframe.geometry import two_point; load_kernels(); "
        "print(len(two_point._inliers.signatures))"
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert int(found.stdout) == 1
