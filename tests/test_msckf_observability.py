"""No camera and IMU can tell where the world's origin is, nor its yaw: the filter must not believe it can.

The unobservable directions of the error state are carried through every linear operation of a whole simulated flight,
as the filter performs it; what the measurements say of them is the stacked observability matrix times these directions
(Hesch, Kottas, Bowman, Roumeliotis 2014).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

import numpy as np
import pytest
from msckf_helpers import CALIBRATION, STEREO, drawn_start, sighting_rows, since

from vioframe.bench import run_backend
from vioframe.estimation.options import EstimationOptions
from vioframe.simulation import simulated_sequence
from vioframe.types import DP, DTHETA, DV, Calibration, Float, NavState
from vioframe_msckf.backend import Msckf
from vioframe_msckf.options import MsckfOptions
from vioframe_msckf.state import IMU, FilterState

UP = np.array([0.0, 0.0, 1.0])
FLIGHTS = ("figure_eight", "aggressive", "stop_and_go")


def unobservable(state: FilterState) -> Float:
    """(15 + 15 N or 16 N, 4) of the body and the cameras: the world moved along its axes, and turned about gravity."""
    N = np.zeros((state.calibrated.stop, 4))
    N[DP, :3] = np.eye(3)
    R_WB, p_WB, v_WB = state.first
    N[DTHETA, 3], N[DP, 3], N[DV, 3] = R_WB.T @ UP, np.cross(UP, p_WB), np.cross(UP, v_WB)
    return N


@dataclass
class Recorder:
    """Carries the unobservable directions ``N`` along with a filter and keeps what its measurements say of them."""

    N: Float = field(default_factory=lambda: np.empty((0, 4)))
    seen: list[Float] = field(default_factory=list)
    """(4,) for each update: |H N| by direction, over |H| and |N|."""
    landmarks: int = 0

    def attach(self, monkeypatch: pytest.MonkeyPatch) -> None:
        for name in ("propagate", "augment_clone", "add_landmarks", "update", "innovation", "_delete"):
            monkeypatch.setattr(FilterState, name, self._wrapped(name, getattr(FilterState, name)))

    def _wrapped(self, name, original):
        before = getattr(self, f"_{name.strip('_')}")

        def method(state, *arguments):
            if not len(self.N):
                self.N = unobservable(state)
            before(state, original, *arguments)
            return original(state, *arguments)

        return method

    def _propagate(self, state, original, *arguments) -> None:
        # A filter whose body is known only through its correlation with the calibration shows its transition there.
        shadow = copy.copy(state)
        shadow.cov = np.zeros_like(state.cov)
        shown = slice(IMU, 2 * IMU)
        shadow.cov[:IMU, shown] = np.eye(IMU)
        original(shadow, *arguments)
        self.N[:IMU] = shadow.cov[:IMU, shown] @ self.N[:IMU]

    def _augment_clone(self, state, original, *arguments) -> None:
        shadow = copy.copy(state)
        shadow.cov, at = np.eye(len(state.cov)), state.landmarks_begin
        original(shadow, *arguments)
        J = np.delete(shadow.cov[at : at + 6], np.s_[at : at + 6], axis=1)
        self.N = np.insert(self.N, at, J @ self.N, axis=0)

    def _add_landmarks(self, state, original, ids, p_WF, p_WF_first, gain, columns, own) -> None:
        self.N = np.concatenate([self.N, (gain @ self.N[columns]).reshape(-1, 4)])
        self.landmarks += len(ids)

    def _delete(self, state, original, index) -> None:
        self.N = np.delete(self.N, index, axis=0)

    def _update(self, state, original, H, residual, columns, R) -> None:
        assert len(self.N) == len(state.cov)
        self._see(H, self.N[columns])

    def _innovation(self, state, original, clone, landmarks, cameras, blocks, variance) -> None:
        self._see(sighting_rows(state, clone, landmarks, cameras, blocks), self.N)

    def _see(self, H: Float, N: Float) -> None:
        self.seen.append(np.linalg.norm(H @ N, axis=0) / np.linalg.norm(H) / np.linalg.norm(N, axis=0))


def fly(
    flight: str,
    options: MsckfOptions,
    monkeypatch: pytest.MonkeyPatch,
    seed: int = 0,
    *,
    at_rest: bool = True,
    readout_s: float = 0.0,
    calibration: Calibration = CALIBRATION,
) -> Recorder:
    calibration = calibration.with_camera(0, readout_s=readout_s)
    sequence = simulated_sequence(flight, seed=seed, duration_s=10.0, calibration=calibration)
    recorder = Recorder()
    recorder.attach(monkeypatch)
    estimation = EstimationOptions(zero_velocity_update=at_rest)
    run = run_backend(since(sequence, 1), Msckf(options), estimation, drawn_start(sequence, 1, seed))
    assert run.completion == 1.0
    assert recorder.landmarks > 20
    return recorder


@pytest.mark.parametrize("calibration", [CALIBRATION, STEREO], ids=["mono", "stereo"])
@pytest.mark.parametrize("flight", FLIGHTS)
def test_first_estimates_keep_position_and_yaw_unobservable(flight, calibration, monkeypatch):
    seen = np.array(fly(flight, MsckfOptions(), monkeypatch, at_rest=False, calibration=calibration).seen)
    assert len(seen) > 200
    assert seen.max() < 1e-8


def test_the_rows_of_a_rolling_shutter_tell_nothing_of_position_and_yaw(monkeypatch):
    """Where the body moves as each row is read is known in its own frame, which turns with the world."""
    options = MsckfOptions(calibrate_readout=True)
    seen = np.array(fly("figure_eight", options, monkeypatch, at_rest=False, readout_s=0.03).seen)
    assert len(seen) > 200
    assert seen.max() < 1e-8


def test_without_first_estimates_yaw_is_observed_and_position_is_not(monkeypatch):
    seen = np.array(fly("figure_eight", MsckfOptions(first_estimate_jacobians=False), monkeypatch).seen)
    assert seen[:, :3].max() < 1e-8
    assert seen[:, 3].max() > 1e-4


def yaw_sigma(state: NavState) -> float:
    up_B = state.R_WB.T @ UP
    assert state.cov is not None
    return float(np.sqrt(up_B @ state.cov[DTHETA, DTHETA] @ up_B))


def start_with_free_yaw(true: NavState) -> Float:
    """(15, 15): yaw uncertain by 0.01 rad, and position and velocity turning with it, as after an initialisation.

    Were they independent of yaw, a velocity would be a legitimate compass.
    """
    up_B = true.R_WB.T @ UP
    cov = np.diag(np.repeat([0.005, 0.01, 0.05, 0.005, 0.05], 3) ** 2)
    cov[DTHETA, DTHETA] -= 0.005**2 * np.outer(up_B, up_B)
    turned = np.concatenate([up_B, np.cross(UP, true.p_WB), np.cross(UP, true.v_WB), np.zeros(6)])
    return cov + 0.01**2 * np.outer(turned, turned)


@pytest.mark.parametrize(("flight", "first_estimates"), [(f, True) for f in FLIGHTS] + [("figure_eight", False)])
def test_yaw_never_becomes_better_known_than_it_was(flight, first_estimates):
    """Without first estimates it does, from nothing."""
    sequence = simulated_sequence(flight, seed=3, duration_s=12.0)
    start = drawn_start(sequence, 1, 3, start_with_free_yaw(sequence.true_states[1]))
    options = MsckfOptions(first_estimate_jacobians=first_estimates)
    run = run_backend(since(sequence, 1), Msckf(options), initial_state=start)
    ratio = np.array([yaw_sigma(state) for state in run.states]) / yaw_sigma(start)
    assert (ratio.min() > 0.999) if first_estimates else (ratio.min() < 0.5)
