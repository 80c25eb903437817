"""Checks a back-end on a simulated flight that rests at first, so that any way of initialising has its chance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Backend, BackendFactory
from vioframe.simulation import Packet, TrackSequence, simulated_sequence
from vioframe.testing.require import fail, require
from vioframe.types import Estimate, Float, FrameTracks, NavState, Status

_DURATION_S = 12.0
_FRAMES_WITHOUT_POINTS = slice(160, 164)
_ORTHONORMAL = 1e-9
_RELATIVE_SYMMETRY = 1e-9


def check_backend(factory: BackendFactory, *, max_ate_percent: float = 2.0, **options: Any) -> None:
    """Check ``factory(calibration, **options)`` against :class:`vioframe.interfaces.Backend`.

    Shapes, stamps and finiteness of every estimate; rotations that are rotations; covariances that are symmetric and
    positive semi-definite; inputs left alone; the same result for the same input; frames without a single point
    survived; and a trajectory within ``max_ate_percent`` of the path length (position and yaw aligned).
    """
    sequence = _frozen(simulated_sequence("stop_and_go", duration_s=_DURATION_S, max_points=100))
    estimates = _run(factory(sequence.calibration, **options), sequence.packets)
    _check_accuracy(estimates, sequence, max_ate_percent)
    again = _run(factory(sequence.calibration, **options), sequence.packets)
    for k, (a, b) in enumerate(zip(estimates, again, strict=True)):
        require(_same(a.state, b.state), f"the same input gave another state at frame {k} the second time")
    _run(factory(sequence.calibration, **options), _blinded(sequence.packets))


def _run(backend: Backend, packets: Iterable[Packet]) -> list[Estimate]:
    estimates = []
    for k, (imu, tracks) in enumerate(packets):
        try:
            estimate = backend.process(imu, tracks)
        except Exception as error:
            fail(f"process() raised at frame {k}, which has {len(tracks.ids)} points: {error!r}")
        _check_estimate(estimate, tracks, k)
        estimates.append(estimate)
    return estimates


def _check_estimate(estimate: Estimate, tracks: FrameTracks, k: int) -> None:
    require(isinstance(estimate, Estimate), f"process() returned a {type(estimate).__name__}, not an Estimate")
    require(isinstance(estimate.status, Status), f"status is {estimate.status!r}, not a Status")
    m = len(estimate.landmark_ids)
    require(estimate.p_WF.shape == (m, 3), f"p_WF has shape {estimate.p_WF.shape} for {m} landmarks at frame {k}")
    require(len(np.unique(estimate.landmark_ids)) == m, f"landmark_ids repeat at frame {k}")
    require(np.isfinite(estimate.p_WF).all(), f"p_WF is not finite at frame {k}")
    require(all(seconds >= 0.0 for seconds in estimate.stage_seconds.values()), f"negative stage_seconds at frame {k}")
    if estimate.status is Status.TRACKING:
        require(estimate.state is not None, f"tracking without a state at frame {k}")
    if estimate.state is not None:
        _check_state(estimate.state, tracks.t_ns, k)


def _same(a: NavState | None, b: NavState | None) -> bool:
    if a is None or b is None:
        return a is b
    return np.array_equal(a.R_WB, b.R_WB) and np.array_equal(a.p_WB, b.p_WB) and np.array_equal(a.v_WB, b.v_WB)


def _check_state(state: NavState, t_ns: int, k: int) -> None:
    require(state.t_ns == t_ns, f"the state of frame {k} is of {state.t_ns} ns, the frame of {t_ns} ns")
    shapes = {"R_WB": (3, 3), "p_WB": (3,), "v_WB": (3,), "bias_gyro_B": (3,), "bias_accel_B": (3,)}
    for name, shape in shapes.items():
        array = getattr(state, name)
        require(array.shape == shape and np.isfinite(array).all(), f"{name} at frame {k} is {array}, expected {shape}")
    R_WB: Float = state.R_WB
    orthonormal = np.abs(R_WB @ R_WB.T - np.eye(3)).max() <= _ORTHONORMAL and np.linalg.det(R_WB) > 0.0
    require(orthonormal, f"R_WB at frame {k} is not a rotation")
    if state.cov is not None:
        require(state.cov.shape == (15, 15), f"cov at frame {k} has shape {state.cov.shape}, expected (15, 15)")
        scale = np.abs(state.cov).max()
        require(
            np.abs(state.cov - state.cov.T).max() <= _RELATIVE_SYMMETRY * scale, f"cov at frame {k} is not symmetric"
        )
        smallest = np.linalg.eigvalsh(state.cov)[0]
        require(smallest >= -_RELATIVE_SYMMETRY * scale, f"cov at frame {k} has the eigenvalue {smallest:.2e}")


def _check_accuracy(estimates: list[Estimate], sequence: TrackSequence, max_ate_percent: float) -> None:
    states = [e.state for e in estimates if e.status is Status.TRACKING and e.state is not None]
    require(states, f"never initialised in {_DURATION_S:g} s; events: {[e for x in estimates for e in x.events][-3:]}")
    trajectory = Trajectory(
        np.array([s.t_ns for s in states]), np.array([s.R_WB for s in states]), np.array([s.p_WB for s in states])
    )
    try:
        errors = evaluate(trajectory, sequence.ground_truth)
    except TrajectoryError as error:
        fail(f"the trajectory cannot be evaluated: {error}")
    require(
        errors.truth.path_length_m > 0.5 * sequence.ground_truth.path_length_m,
        f"tracked only {errors.truth.path_length_m:.1f} m of {sequence.ground_truth.path_length_m:.1f} m",
    )
    percent = 100.0 * errors.ate_m.rmse / errors.truth.path_length_m
    require(percent <= max_ate_percent, f"ATE is {percent:.2f} % of the path, more than {max_ate_percent:g} %")


def _frozen(sequence: TrackSequence) -> TrackSequence:
    """The same with read-only arrays, so that a back-end that changes its input fails where it does."""
    for imu, tracks in sequence.packets:
        for array in (imu.t_ns, imu.gyro_B, imu.accel_B, tracks.ids, tracks.xy, tracks.xy_normalised):
            array.flags.writeable = False
    return sequence


def _blinded(packets: tuple[Packet, ...]) -> list[Packet]:
    """``packets`` with a few frames in which nothing is seen; the tracks end there, as ids never come back."""
    blind = list(packets)
    last_seen = packets[_FRAMES_WITHOUT_POINTS.start - 1][1].ids.max()
    nothing = np.empty((0, 2))
    for k, (imu, tracks) in enumerate(packets):
        if k in range(*_FRAMES_WITHOUT_POINTS.indices(len(packets))):
            blind[k] = imu, FrameTracks(tracks.t_ns, np.empty(0, np.int64), nothing, nothing)
        elif k >= _FRAMES_WITHOUT_POINTS.stop:
            renamed = np.where(tracks.ids <= last_seen, tracks.ids + 1_000_000, tracks.ids)
            blind[k] = imu, replace(tracks, ids=renamed)
    return blind
