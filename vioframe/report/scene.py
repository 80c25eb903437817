"""What there is to see of a set of runs: paths, cameras, landmarks and the world, all in the ground truth's world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from vioframe.evaluation.landmarks import Landmarks, belonging
from vioframe.geometry.trajectory import Trajectory
from vioframe.runs.evaluated import Evaluated
from vioframe.types import Calibration, Float, Int

_NEAR_PERCENT = 80.0
_AROUND = 1.6


@dataclass(frozen=True, eq=False)
class Flight:
    """One run: its ``number`` in the palette, its poses and where its path is broken, and what is known beside them."""

    number: int
    name: str
    estimate: Trajectory
    landmarks: Landmarks | None
    calibration: Calibration | None
    breaks: Int = field(default_factory=lambda: np.empty(0, np.int64))


@dataclass(frozen=True, eq=False)
class Scene:
    """``world`` (T, 3, 3) m is the mesh that was flown in, if one is to be shown."""

    flights: Sequence[Flight]
    truths: Sequence[Trajectory]
    world: Float | None = None

    @property
    def path(self) -> Float:
        """(N, 3) all positions."""
        flown = [*(flight.estimate.p_WB for flight in self.flights), *(truth.p_WB for truth in self.truths)]
        return np.concatenate(flown)

    @property
    def landmarks(self) -> Float:
        """(M, 3) all landmarks."""
        clouds = [flight.landmarks.p_WF for flight in self.flights if flight.landmarks is not None]
        return np.concatenate([np.empty((0, 3)), *clouds])

    @property
    def near_landmarks(self) -> Float:
        """(M, 3) those not far from the path: a few of a hall's far end would leave the flight small in the picture."""
        path, landmarks = self.path, self.landmarks
        if not len(landmarks):
            return landmarks
        middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
        reach = max(float(np.linalg.norm(path - middle, axis=1).max()), 0.5)
        away = np.linalg.norm(landmarks - middle, axis=1)
        return np.asarray(landmarks[away <= min(float(np.percentile(away, _NEAR_PERCENT)), _AROUND * reach)])

    @property
    def of_interest(self) -> Float:
        """(N, 3) what should be in the picture: the paths, and the world or else the landmarks near them."""
        around = self.near_landmarks if self.world is None else self.world.reshape(-1, 3)
        return np.concatenate([self.path, around])


def scene_of(runs: Sequence[Evaluated], world: Float | None = None) -> Scene:
    """The runs that have an estimate, each aligned with its ground truth where there is one; landmarks that stand
    alone are left out."""
    flights = []
    for number, run in enumerate(runs):
        if run.estimate is not None:
            calibration = run.folder.calibration() if run.folder else None
            estimate = aligned_estimate(run)
            breaks = run.breaks(estimate.t_ns)
            flights.append(Flight(number, run.name, estimate, aligned_landmarks(run), calibration, breaks))
    # Of runs on one recording the ground truth is shown once.
    truths = {run.ground_truth.t_ns.tobytes(): run.ground_truth for run in runs if run.errors and run.ground_truth}
    return Scene(flights, list(truths.values()), world)


def aligned_estimate(run: Evaluated) -> Trajectory:
    """The whole estimate of a run that has one, in the ground truth's world where there is one."""
    assert run.estimate is not None
    return run.errors.alignment.apply(run.estimate) if run.errors else run.estimate


def aligned_landmarks(run: Evaluated) -> Landmarks | None:
    """The landmarks of a run in the same world, without those that stand alone; None where there are none."""
    landmarks = run.folder.landmarks() if run.folder else None
    if landmarks is None or not len(landmarks):
        return None
    kept = landmarks.select(belonging(landmarks.p_WF))
    return kept.moved(run.errors.alignment) if run.errors else kept
