"""Checks a back-end on a simulated flight that rests at first, so that any way of initialising has its chance."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from vioframe.errors import PluginError, TrajectoryError
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.interfaces import Backend, BackendFactory
from vioframe.simulation import Packet, TrackSequence, simulated_sequence
from vioframe.testing.require import fail, freeze, require, same
from vioframe.types import Estimate, FrameTracks, Status

_DURATION_S = 12.0
_FRAMES_WITHOUT_POINTS = slice(160, 164)


def check_backend(factory: BackendFactory, *, max_ate_percent: float = 2.0, **options: Any) -> None:
    """Check ``factory(**options)`` against :class:`vioframe.interfaces.Backend`.

    Shapes, stamps and finiteness of every estimate; rotations that are rotations; covariances that are symmetric and
    positive semi-definite; inputs left alone; the same result for the same input; frames without a single point
    survived; a begin that forgets what was before; and a trajectory within ``max_ate_percent`` of the path length
    (position and yaw aligned).
    """
    sequence = simulated_sequence("stop_and_go", duration_s=_DURATION_S, max_points=100)
    for packet in sequence.packets:
        freeze(*packet)
    backend = factory(**options)
    estimates = _run(backend, sequence, sequence.packets)
    _check_accuracy(estimates, sequence, max_ate_percent)
    again = _run(backend, sequence, sequence.packets)
    for k, (a, b) in enumerate(zip(estimates, again, strict=True)):
        require(same(a.state, b.state), f"the same input gave another state at frame {k} the second time")
    _run(factory(**options), sequence, _blinded(sequence.packets))


def _run(backend: Backend, sequence: TrackSequence, packets: Iterable[Packet]) -> list[Estimate]:
    life = LifeCycle(backend, sequence.calibration)
    estimates = []
    for k, (imu, tracks) in enumerate(packets):
        try:
            estimates.append(life.process(imu, tracks))
        except PluginError as error:
            fail(f"frame {k}: {error}")
        except Exception as error:
            fail(f"the back-end raised at frame {k}, which has {len(tracks.ids)} points: {error!r}")
    return estimates


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
    require(
        percent <= max_ate_percent,
        f"ATE is {percent:.2f} % of the path, more than the {max_ate_percent:g} % of max_ate_percent",
    )


def _blinded(packets: tuple[Packet, ...]) -> list[Packet]:
    """``packets`` with a few frames in which nothing is seen; the tracks end there, as ids never come back."""
    blind = list(packets)
    last_seen = packets[_FRAMES_WITHOUT_POINTS.start - 1][1].ids.max()
    for k, (imu, tracks) in enumerate(packets):
        if k in range(*_FRAMES_WITHOUT_POINTS.indices(len(packets))):
            blind[k] = imu, FrameTracks.none(tracks.t_ns)
        elif k >= _FRAMES_WITHOUT_POINTS.stop:
            renamed = np.where(tracks.ids <= last_seen, tracks.ids + 1_000_000, tracks.ids)
            blind[k] = imu, replace(tracks, ids=renamed)
    return blind
