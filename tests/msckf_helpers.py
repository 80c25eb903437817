"""Filter states to test with, and how far they are from the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.options import EstimationOptions
from vioframe.geometry import so3
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import TrackSequence, simulated_sequence
from vioframe.simulation.tracks import EUROC_NOISE
from vioframe.types import Calibration, CalibrationEstimate, Float, Int, NavState
from vioframe_msckf.state import IMU, FilterState

CALIBRATION = packaged_calibration("euroc", cameras=["cam0"])
STEREO = packaged_calibration("euroc")
EXACT = EstimationOptions(gyro_noise_factor=1.0, accel_noise_factor=1.0, accel_walk_factor=1.0)
"""Readings are as noisy as stated, and no more."""
START_COV = np.diag(np.repeat([0.005, 0.001, 0.02, 0.005, 0.05], 3) ** 2)
"""How well a drawn start is known: rad, m, m/s, rad/s, m/s^2."""


def sighting_rows(state: FilterState, clone: int, landmarks: Int, cameras: Int, blocks: Float) -> Float:
    """H (2 M, n) of sightings from one clone, with all the zeros that their ``blocks`` (M, 2, 25) leave out."""
    H = np.zeros((2 * len(blocks), len(state.cov)))
    at_clone = state.calibrated.stop + 6 * clone
    for i, (landmark, camera, block) in enumerate(zip(landmarks, cameras, blocks, strict=True)):
        at_camera, at_landmark = IMU + state.of_camera * camera, state.landmarks_begin + 3 * landmark
        rows = H[2 * i : 2 * i + 2]
        rows[:, at_camera : at_camera + state.of_camera] = block[:, : state.of_camera]
        rows[:, at_clone : at_clone + 6] = block[:, 16:22]
        rows[:, at_landmark : at_landmark + 3] = block[:, 22:]
    return H


def prior_of(calibration: Calibration) -> CalibrationEstimate:
    """``calibration`` as well known as the life cycle takes any to be."""
    return CalibrationEstimate(calibration, (EstimationOptions().camera_sigma,) * len(calibration.cameras))


def random_covariance(rng: np.random.Generator, n: int) -> Float:
    """(n, n), well conditioned, with correlations between everything."""
    A = rng.normal(size=(n, 2 * n))
    sigma = rng.uniform(0.5, 2.0, n)
    return A @ A.T / (2 * n) * np.outer(sigma, sigma)


def random_state(
    seed: int = 0,
    clones: int = 4,
    landmarks: int = 3,
    *,
    calibrate: bool = True,
    scale: float = 1.0,
    calibration: Calibration = STEREO,
) -> FilterState:
    """A filter in the midst of a flight; ``scale`` is that of its standard deviations."""
    rng = np.random.default_rng(seed)
    nav = NavState(0, so3.exp(rng.normal(size=3)), *(rng.normal(size=3) for _ in range(4)), np.eye(15))
    state = FilterState(nav, prior_of(calibration), extrinsics=calibrate, offset=calibrate, intrinsics=calibrate)
    for _ in range(clones):
        state.R_WB, state.p_WB = state.R_WB @ so3.exp(0.1 * rng.normal(size=3)), state.p_WB + 0.3 * rng.normal(size=3)
        state.augment_clone(rng.normal(size=3))
    for k in range(landmarks):
        add_independent(state, 10 + k, 5.0 * rng.normal(size=3), np.eye(3))
    if calibrate:
        state.cov = scale**2 * random_covariance(rng, len(state.cov))
    return state


def add_independent(state: FilterState, landmark_id: int, p_WF: Float, cov: Float) -> None:
    """A landmark (3,) of covariance (3, 3) that nothing else has to do with."""
    state.add_landmarks(np.array([landmark_id]), p_WF[None], p_WF[None], np.zeros((1, 3, 0)), slice(0, 0), cov[None])


def seeing_state(
    seed: int = 0,
    clones: int = 6,
    *,
    readout_s: float = 0.0,
    exact: bool = False,
    calibration: Calibration = CALIBRATION,
) -> tuple[FilterState, TrackTable]:
    """A filter that knows to millimetres where it has been on a simulated flight, and what it saw from there.

    With a rolling shutter it estimates the readout. An ``exact`` one sees without noise.
    """
    for c in range(len(calibration.cameras)):
        calibration = calibration.with_camera(c, readout_s=readout_s)
    noise = None if exact else EUROC_NOISE
    sequence = simulated_sequence(
        "figure_eight", noise, 0.0 if exact else 1.0, seed, duration_s=2.0, calibration=calibration
    )
    start = sequence.true_states[0]
    state = FilterState(
        replace(start, cov=np.eye(15)),
        prior_of(sequence.calibration),
        extrinsics=True,
        offset=True,
        intrinsics=True,
        readout=readout_s != 0.0,
    )
    observations = TrackTable(len(calibration.cameras))
    for k in range(1, 3 * clones, 3):
        true, (imu, tracks) = sequence.true_states[k], sequence.packets[k]
        state.R_WB, state.p_WB, state.v_WB = true.R_WB, true.p_WB, true.v_WB
        state.augment_clone(imu.gyro_B[-1] - true.bias_gyro_B)
        observations.add_frame(tracks)
    state.cov = 0.003**2 * random_covariance(np.random.default_rng(seed), len(state.cov))
    return state, observations


def drawn_start(sequence: TrackSequence, frame: int, seed: int, cov: Float = START_COV) -> NavState:
    """The true state at ``frame``, off by an error drawn from the covariance it states."""
    d = np.random.default_rng(seed).multivariate_normal(np.zeros(15), cov, method="eigh")
    truth = sequence.true_states[frame]
    return NavState(
        truth.t_ns,
        truth.R_WB @ so3.exp(d[0:3]),
        truth.p_WB + d[3:6],
        truth.v_WB + d[6:9],
        truth.bias_gyro_B + d[9:12],
        truth.bias_accel_B + d[12:15],
        cov,
    )


def since(sequence: TrackSequence, frame: int) -> TrackSequence:
    """The packets from ``frame`` on."""
    return replace(sequence, packets=sequence.packets[frame:])


def pose_nees(states: tuple[NavState, ...], truth: dict[int, NavState]) -> tuple[float, float]:
    """Mean normalised estimation error squared of orientation and of position, three degrees of freedom each."""
    values = []
    for state in states:
        true = truth[state.t_ns]
        assert state.cov is not None
        dtheta, dp = so3.log(state.R_WB.T @ true.R_WB), true.p_WB - state.p_WB
        P = state.cov
        values.append([dtheta @ np.linalg.solve(P[:3, :3], dtheta), dp @ np.linalg.solve(P[3:6, 3:6], dp)])
    orientation, position = np.mean(values, axis=0)
    return float(orientation), float(position)
