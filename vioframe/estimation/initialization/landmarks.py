"""Landmarks in inverse depth: how their projections change with them and with the poses that see them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.estimation.factors.inertial import StateArrays
from vioframe.estimation.initialization.window import Window
from vioframe.geometry import so3
from vioframe.types import Calibration, Float, Int

# Depth in a frame over depth in the host: a landmark nearer than this is beside the camera, and cannot be seen.
_LEAST_DEPTH_RATIO = 0.05


@dataclass(frozen=True, slots=True)
class Observations:
    """M observations sorted by track, each (M,): ``frame``, ``landmark`` and ``host``, the first frame of the track.

    ``xy`` (M, 2) on the z = 1 plane; ``start`` (L,) is where each track begins.
    """

    frame: Int
    landmark: Int
    host: Int
    xy: Float
    start: Int

    @staticmethod
    def of(window: Window) -> Observations:
        landmark, frame = np.nonzero(window.seen.T)
        start = np.searchsorted(landmark, np.arange(len(window.ids)))
        return Observations(frame, landmark, frame[start][landmark], window.xy[frame, landmark], start)


def project(
    states: StateArrays, landmarks: Float, observations: Observations, calibration: Calibration
) -> tuple[Float, Float]:
    """Residuals (M, 2) on the z = 1 plane, and the depth in the frame over the depth in the host (M,).

    ``landmarks`` (L, 3) are [x y rho]: the point on the host's z = 1 plane and the inverse depth, 1/m (Civera, Davison,
    Montiel, "Inverse Depth Parametrization for Monocular SLAM", T-RO 2008).
    """
    X, *_ = _transform(states, landmarks, observations, calibration)
    depth = np.maximum(X[:, 2], _LEAST_DEPTH_RATIO)
    return X[:, :2] / depth[:, None] - observations.xy, X[:, 2]


def linearise(
    states: StateArrays, landmarks: Float, observations: Observations, calibration: Calibration
) -> tuple[Float, Float, Float, Float]:
    """Residuals (M, 2), Jacobians by the poses [dtheta dp] of frame and host (M, 2, 6), and by the landmark (M, 2, 3).

    Where the frame is the host itself the two pose Jacobians are zero.
    """
    X, q_host, b, R_CW, R_host = _transform(states, landmarks, observations, calibration)
    depth = np.maximum(X[:, 2], _LEAST_DEPTH_RATIO)
    xy = X[:, :2] / depth[:, None]
    D = np.zeros((len(X), 2, 3))
    D[:, 0, 0] = D[:, 1, 1] = 1.0 / depth
    D[:, :, 2] = np.where((X[:, 2] > _LEAST_DEPTH_RATIO)[:, None], -xy / depth[:, None], 0.0)

    rho = landmarks[observations.landmark, 2, None, None]
    R_CB = calibration.R_BC.T
    between = states.p_WB[observations.host] - states.p_WB[observations.frame]
    by_position = D @ R_CW * rho
    J_frame = np.concatenate([D @ R_CB @ so3.hat(b), -by_position], axis=2)
    J_host = np.concatenate([-D @ R_CW @ R_host @ so3.hat(q_host), by_position], axis=2)
    by_rho = R_CW @ ((R_host @ calibration.p_BC) + between)[..., None] - (R_CB @ calibration.p_BC)[:, None]
    J_landmark = D @ np.concatenate([R_CW @ R_host @ calibration.R_BC[:, :2], by_rho], axis=2)
    own = observations.frame == observations.host
    J_frame[own] = J_host[own] = 0.0
    return xy - observations.xy, J_frame, J_host, J_landmark


def _transform(
    states: StateArrays, landmarks: Float, observations: Observations, calibration: Calibration
) -> tuple[Float, Float, Float, Float, Float]:
    """Landmarks times inverse depth (M, 3) in the observing camera, the host's and the frame's body; R_CW; R_host."""
    m = landmarks[observations.landmark]
    rho = m[:, 2:]
    R_host, R_frame = states.R_WB[observations.host], states.R_WB[observations.frame]
    q_host = np.column_stack([m[:, :2], np.ones(len(m))]) @ calibration.R_BC.T + rho * calibration.p_BC
    between = states.p_WB[observations.host] - states.p_WB[observations.frame]
    w = (R_host @ q_host[..., None])[..., 0] + rho * between
    b = (np.swapaxes(R_frame, -1, -2) @ w[..., None])[..., 0]
    X = (b - rho * calibration.p_BC) @ calibration.R_BC
    return X, q_host, b, calibration.R_BC.T @ np.swapaxes(R_frame, -1, -2), R_host


def positions(states: StateArrays, landmarks: Float, observations: Observations, calibration: Calibration) -> Float:
    """The landmarks in the world, (L, 3) m."""
    host = observations.frame[observations.start]
    p_C = np.column_stack([landmarks[:, :2], np.ones(len(landmarks))]) / landmarks[:, 2:]
    p_B = p_C @ calibration.R_BC.T + calibration.p_BC
    return (states.R_WB[host] @ p_B[..., None])[..., 0] + states.p_WB[host]
