"""A rolling shutter costs no accuracy where its readout is known, and the readout is found where it is not."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, EXACT, drawn_start, since

from vioframe.bench import BackendRun, run_backend
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Backend
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe_msckf.backend import Msckf
from vioframe_msckf.options import MsckfOptions
from vioframe_sliding_window.backend import SlidingWindow
from vioframe_sliding_window.options import SlidingWindowOptions

READOUT_S = 0.03


def msckf(calibrate: bool) -> Backend:
    return Msckf(MsckfOptions(calibrate_readout=calibrate))


def sliding_window(calibrate: bool) -> Backend:
    return SlidingWindow(SlidingWindowOptions(calibrate_readout=calibrate))


BACKENDS = pytest.mark.parametrize("make", [msckf, sliding_window])


@cache
def flown(make: Callable[[bool], Backend], calibrate: bool, true_s: float, told_s: float) -> tuple[BackendRun, float]:
    """A short flight that turns fast, and its ATE m."""
    sequence = simulated_sequence(
        "aggressive", seed=2, duration_s=6.0, calibration=CALIBRATION.with_camera(0, readout_s=true_s)
    )
    start = drawn_start(sequence, 1, 2)
    sequence = replace(since(sequence, 1), calibration=CALIBRATION.with_camera(0, readout_s=told_s))
    run = run_backend(sequence, make(calibrate), EXACT, start)
    assert run.completion == 1.0
    return run, _ate_m(run, sequence)


def _ate_m(run: BackendRun, sequence: TrackSequence) -> float:
    states = run.states
    t_ns = np.array([state.t_ns for state in states])
    R_WB, p_WB = np.array([state.R_WB for state in states]), np.array([state.p_WB for state in states])
    return evaluate(Trajectory(t_ns, R_WB, p_WB), sequence.ground_truth).ate_m.rmse


@BACKENDS
def test_a_known_readout_costs_nothing_and_an_unknown_one_does(make):
    """Of a few seconds the error is mostly the noise's: more than twice another's it is not."""
    _, still = flown(make, False, 0.0, 0.0)
    run, known = flown(make, False, READOUT_S, READOUT_S)
    _, unknown = flown(make, False, READOUT_S, 0.0)
    assert known < 2.0 * still
    assert unknown > 5.0 * known
    learned = run.estimates[-1].calibration
    assert learned is not None
    assert learned.calibration.cameras[0].readout_s == READOUT_S
    assert learned.sigma[0].readout_s == 0.0


@BACKENDS
@pytest.mark.parametrize("told_s", [0.0, 0.015])
def test_the_readout_is_found(make, told_s):
    run, ate_m = flown(make, True, READOUT_S, told_s)
    learned = run.estimates[-1].calibration
    assert learned is not None
    assert learned.calibration.cameras[0].readout_s == pytest.approx(READOUT_S, abs=1e-3)
    assert 0.0 < learned.sigma[0].readout_s < 1e-3
    assert ate_m < 2.0 * flown(make, False, READOUT_S, READOUT_S)[1]
