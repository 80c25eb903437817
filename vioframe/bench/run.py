"""Running a back-end on tracks alone, no images and no front-end, and what that amounts to."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from time import thread_time
from typing import Any

import numpy as np

from vioframe.errors import TrajectoryError
from vioframe.estimation.lifecycle import LifeCycle
from vioframe.estimation.options import EstimationOptions
from vioframe.evaluation import evaluate
from vioframe.geometry.trajectory import Trajectory
from vioframe.incidents import Incidents
from vioframe.interfaces import Backend
from vioframe.io.synchronise import Synchroniser
from vioframe.simulation import TrackSequence
from vioframe.stopwatch import working_s
from vioframe.types import DP, Estimate, Float, FrameSet, FrameTracks, NavState, Status

_POSE = DP.stop  # [dtheta dp] come first in the error state


@dataclass(frozen=True)
class BackendRun:
    """What a back-end said after each packet: ``t_ns`` and ``estimates`` (N,), and how long each took it.

    ``seconds`` (N,) are those of the clock, ``cpu_seconds`` (N,) those the thread was computing: on a machine that is
    busy with other things the first are longer. Neither counts the compiling and loading of kernels.
    """

    t_ns: tuple[int, ...]
    estimates: tuple[Estimate, ...]
    seconds: Float
    cpu_seconds: Float

    @property
    def states(self) -> tuple[NavState, ...]:
        """The states of the frames at which the back-end was tracking."""
        return tuple(e.state for e in self.estimates if e.status is Status.TRACKING and e.state is not None)

    @property
    def trajectory(self) -> Trajectory:
        """Their poses, with covariance where the back-end knows it at every one.

        Raises :class:`TrajectoryError` where there are none.
        """
        states = self.states
        if not states:
            raise TrajectoryError("the back-end never got past initialisation; its events say why")
        return _trajectory(states)

    @property
    def stretches(self) -> tuple[Trajectory, ...]:
        """The trajectory cut where tracking was lost: each piece has a position and yaw of its own to begin with."""
        pieces = groupby(self.estimates, lambda e: e.status is Status.TRACKING and e.state is not None)
        return tuple(_trajectory([e.state for e in piece if e.state]) for tracking, piece in pieces if tracking)

    @property
    def initialised_after_s(self) -> float | None:
        """Time from the first packet to the first state, or None."""
        states = self.states
        return (states[0].t_ns - self.t_ns[0]) * 1e-9 if states else None

    @property
    def completion(self) -> float:
        """Part of the packets from the first state on at which the back-end was tracking."""
        tracking = [e.status is Status.TRACKING for e in self.estimates]
        first = tracking.index(True) if any(tracking) else 0
        return sum(tracking) / (len(tracking) - first)

    @property
    def resets(self) -> int:
        """How often tracking was lost after it had begun."""
        statuses = [e.status for e in self.estimates]
        return sum(a is Status.TRACKING and b is not Status.TRACKING for a, b in pairwise(statuses))

    @property
    def stage_ms(self) -> dict[str, float]:
        """Mean milliseconds a packet, in all (``total``) and by the back-end's own stages."""
        total: Counter[str] = Counter()
        for estimate in self.estimates:
            total.update(estimate.stage_seconds)
        per_packet = 1e3 / len(self.estimates)
        return {"total": float(self.seconds.mean()) * 1e3, **{k: v * per_packet for k, v in total.items()}}


def _trajectory(states: Sequence[NavState]) -> Trajectory:
    covs = [s.cov[:_POSE, :_POSE] for s in states if s.cov is not None]
    return Trajectory(
        np.array([s.t_ns for s in states], np.int64),
        np.array([s.R_WB for s in states]),
        np.array([s.p_WB for s in states]),
        np.array(covs) if len(covs) == len(states) else None,
    )


def run_backend(
    sequence: TrackSequence,
    backend: Backend,
    estimation: EstimationOptions | None = None,
    initial_state: NavState | None = None,
) -> BackendRun:
    """Feed every packet of ``sequence`` to ``backend`` in order, until the readings end."""
    life = LifeCycle(backend, sequence.calibration, estimation, initial_state)
    given, offset_ns = sequence.calibration.lenses, sequence.calibration.cameras[0].time_offset_ns
    synchroniser = Synchroniser(Incidents(), time_offset_ns=offset_ns, wait_ms=0.0)
    tracks = {tracks.t_ns: tracks for _, tracks in sequence.packets}
    t_ns, estimates, seconds, cpu_seconds = [], [], [], []
    for measured in sequence.measurements():
        measurement = FrameSet(measured.t_ns, ()) if isinstance(measured, FrameTracks) else measured
        for imu, frame in synchroniser.add(measurement):
            begin, cpu_begin = working_s(), working_s(thread_time)
            estimates.append(life.process(imu, tracks[frame.t_ns].undistorted(*life.calibration.lenses, by=given)))
            seconds.append(working_s() - begin)
            cpu_seconds.append(working_s(thread_time) - cpu_begin)
            t_ns.append(frame.t_ns)
            synchroniser.retime(life.calibration.cameras[0].time_offset_ns)
    return BackendRun(tuple(t_ns), tuple(estimates), np.array(seconds), np.array(cpu_seconds))


def backend_row(sequence: TrackSequence, run: BackendRun) -> dict[str, Any]:
    """What a back-end's run on ``sequence`` amounts to; without a single state, only that it failed.

    Errors are after alignment in position and yaw. ``percent`` is the root mean square error over the path flown from
    the first state on.
    """
    row: dict[str, Any] = {
        "sequence": sequence.name,
        "frames": len(run.estimates),
        "initialised_s": run.initialised_after_s,
        "completion": run.completion,
        "resets": run.resets,
    }
    if run.initialised_after_s is not None:
        errors = evaluate(run.trajectory, sequence.ground_truth)
        path_m = errors.truth.path_length_m
        row |= {
            "path_m": path_m,
            "ate_m": errors.ate_m.rmse,
            "percent": 100.0 * errors.ate_m.rmse / path_m if path_m > 0.0 else None,
            "ate_se3_m": errors.ate_se3_m,
            "scale": errors.scale,
            "yaw_deg": errors.yaw_deg.rmse,
            "orientation_deg": errors.orientation_deg.rmse,
            "nees": {nees.part: nees.mean for nees in errors.nees},
        }
    return row | {"cpu_ms": 1e3 * float(run.cpu_seconds.mean()), "stage_ms": run.stage_ms}
