"""Judging an initial estimate by the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.estimation.initialization import InitialEstimate, Initializer
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.simulation import Packet, TrackSequence
from vioframe.types import DTHETA, DV, Calibration, Float, FrameTracks, Int


@dataclass(frozen=True)
class Motion:
    """True poses and velocities at frames, in any world with z up."""

    t_ns: Int
    R_WB: Float
    p_WB: Float
    v_WB: Float

    @staticmethod
    def of(sequence: TrackSequence) -> Motion:
        """Velocity from the true states where there are any, else from the poses."""
        truth = sequence.ground_truth
        if sequence.true_states:
            velocity = np.stack([state.v_WB for state in sequence.true_states])
        else:
            velocity = velocity_of(truth.t_ns, truth.p_WB)
        return Motion(truth.t_ns, truth.R_WB, truth.p_WB, velocity)


def velocity_of(t_ns: Int, p_WB: Float) -> Float:
    """Slope of a cubic fitted to seven poses around each; one-sided at the ends."""
    v = np.empty_like(p_WB)
    for k in range(len(t_ns)):
        first = min(max(k - 3, 0), max(len(t_ns) - 7, 0))
        part = slice(first, first + 7)
        t = (t_ns[part] - t_ns[k]) * 1e-9
        v[k] = np.linalg.lstsq(np.vander(t, 4, increasing=True), p_WB[part], rcond=None)[0][1]
    return v


@dataclass(frozen=True)
class Errors:
    """``velocity`` m/s, ``tilt_deg``, ``scale`` (relative, of the window's path), ``nees`` per degree of freedom."""

    velocity: float
    tilt_deg: float
    scale: float
    nees: float
    seconds: float


def first_estimate(packets: Sequence[Packet], calibration: Calibration) -> tuple[InitialEstimate | None, Initializer]:
    """What the initialiser says first."""
    initializer = Initializer(calibration)
    for imu, tracks in packets:
        estimate = initializer.add(imu, tracks)
        if estimate is not None:
            return estimate, initializer
    return None, initializer


def judge(estimate: InitialEstimate, truth: Motion, start_ns: int) -> Errors:
    """Errors of the newest state and of the window, free of the yaw and position that nothing measures."""
    state = estimate.states[-1]
    at = np.searchsorted(truth.t_ns, [s.t_ns for s in estimate.states])
    R, v, p = truth.R_WB[at[-1]], truth.v_WB[at[-1]], truth.p_WB[at]
    # The truth turned about the vertical onto the estimate.
    A = state.R_WB @ R.T
    yaw = np.arctan2(A[1, 0] - A[0, 1], A[0, 0] + A[1, 1])
    turn = so3.exp([0.0, 0.0, yaw])
    dtheta, dv = so3.log(state.R_WB.T @ turn @ R), turn @ v - state.v_WB
    horizontal = np.linalg.svd(state.R_WB[2][None])[2][1:]  # the two axes across the vertical, in the body
    tilt = horizontal @ dtheta
    assert state.cov is not None
    pick = np.zeros((5, 15))
    pick[:2, DTHETA], pick[2:, DV] = horizontal, np.eye(3)
    e = np.concatenate([tilt, dv])
    nees = float(e @ np.linalg.solve(pick @ state.cov @ pick.T, e)) / 5.0
    q = np.stack([s.p_WB for s in estimate.states])
    q, p = q - q.mean(axis=0), (p - p.mean(axis=0)) @ turn.T
    scale = float((q * p).sum() / (p * p).sum()) - 1.0 if p.any() and estimate.method != "static" else 0.0
    seconds = (state.t_ns - start_ns) * 1e-9
    return Errors(float(np.linalg.norm(dv)), float(np.rad2deg(np.linalg.norm(tilt))), scale, nees, seconds)


def seen_by(packets: Sequence[Packet], camera: Camera) -> list[Packet]:
    """The same pixels, taken to the z = 1 plane by another camera model."""
    return [(imu, tracks.undistorted(camera)) for imu, tracks in packets]


def without_points(tracks: FrameTracks) -> FrameTracks:
    return FrameTracks.none(tracks.t_ns)
