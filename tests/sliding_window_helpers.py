"""Small windows on a simulated flight, with every kind of factor, whose parts can be looked at one by one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from msckf_helpers import random_covariance
from numpy.typing import NDArray

from vioframe.estimation.factors.inertial import ImuFactors, StateArrays
from vioframe.estimation.factors.landmarks import in_hosts, positions
from vioframe.estimation.factors.problem import STATE_SIZE, Prior, Problem, Variables
from vioframe.estimation.factors.reprojection import (
    GLOBAL_SHUTTER,
    Calibrated,
    Lens,
    Shutter,
    Sightings,
    pixels_by_intrinsics,
    pixels_by_residual,
)
from vioframe.estimation.inertial.preintegration import join_segments, preintegrate
from vioframe.estimation.standstill import Standstill
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera, intrinsics_of
from vioframe.io.calibration import packaged_calibration
from vioframe.simulation import simulated_sequence
from vioframe.types import Float, Int

CALIBRATION = packaged_calibration("euroc")
CAMERA = CALIBRATION.cameras[0].model
NATURAL = np.repeat([0.01, 0.05, 0.1, 0.005, 0.05], 3)
"""Errors of a state that are large but linear enough: rad, m, m/s, rad/s, m/s^2."""
NATURAL_CALIBRATION = np.repeat([0.005, 0.01, 0.002, 0.005, 2.0, 0.01], [3, 3, 1, 1, 4, 4])


def flown_window(
    frames: int = 5,
    landmarks: int = 24,
    seed: int = 0,
    *,
    on_sphere: bool = False,
    noise_px: float = 2.0,
    offset_s: float = 0.003,
    readout_s: float = 0.0,
    camera: Camera = CAMERA,
    cameras: int = 1,
    first_estimates: bool = True,
) -> tuple[Problem, Variables]:
    """States a quarter of a second apart, landmarks seen by two views or more, a prior on the first two states.

    They are the true ones, of which pixels and readings are off by noise, and the prior by as much. With ``noise_px`` 0
    all are exact. Each state but the last hosts some landmarks. With a rolling shutter the readout is one of
    the unknowns, and the body moves while rows are read in some way of its own.
    """
    rng, exact = np.random.default_rng(seed), noise_px == 0.0
    duration_s = 0.25 * frames + 0.1
    noise = None if exact else packaged_calibration("euroc").imu
    sequence = simulated_sequence("figure_eight", noise, seed=seed, duration_s=duration_s)
    at = 1 + 5 * np.arange(frames)
    states = StateArrays.stack([sequence.true_states[k] for k in at])
    readings = []
    for k in at[:-1]:
        imu = join_segments([imu for imu, _ in sequence.packets[k + 1 : k + 6]])
        biases = np.zeros((2, 3)) if exact else rng.normal(size=(2, 3)) * [[0.002], [0.02]]
        readings.append(preintegrate(imu, *biases, sequence.calibration.imu))
    lenses = [camera, *(other.model for other in CALIBRATION.cameras[1:cameras])]
    calibrated = Calibrated.of(*CALIBRATION.cameras[:cameras])._replace(
        offset_s=offset_s * np.arange(1.0, cameras + 1.0),
        readout_s=readout_s * np.arange(1.0, cameras + 1.0),
        intrinsics=np.stack([intrinsics_of(lens)[1] for lens in lenses]),
    )
    sightings, points = _sightings(states, calibrated, lenses, landmarks, noise_px, on_sphere, rng)
    x = Variables(states, calibrated, points)
    prior = prior_on(x, 2, rng)
    if exact:
        prior = replace(prior, b=np.zeros_like(prior.b))
    problem = Problem(prior, ImuFactors.stack(readings), {}, sightings, first_estimates)
    return problem, x


def prior_on(x: Variables, frozen: int, rng: np.random.Generator) -> Prior:
    """A random prior on the first ``frozen`` states and the calibration, about ``x``."""
    n, known = STATE_SIZE * len(x.states), STATE_SIZE * frozen
    end = len(natural(x))
    index = np.r_[0:known, n:end]
    sigma = natural(x)[index]
    H, b = np.zeros((end, end)), np.zeros(end)
    H[np.ix_(index, index)] = random_covariance(rng, len(index)) / np.outer(sigma, sigma)
    b[index] = rng.normal(size=len(index)) / sigma
    return Prior(H, b, x.states, x.cameras, np.arange(len(x.states)) < frozen)


def standing(problem: Problem, state: int) -> Problem:
    """The same, with readings by which the body stood still at a state (which it did not)."""
    noise = packaged_calibration("euroc").imu
    still = Standstill(np.array([0.01, -0.02, 0.03]), np.array([9.7, 0.2, -0.4]), 0.5, noise)
    return replace(problem, still={state: still})


def without_sightings(problem: Problem) -> Problem:
    return replace(problem, sightings=only(problem.sightings, slice(0, 0)))


def only(sightings: Sightings, rows: slice | NDArray[np.bool_]) -> Sightings:
    s = sightings
    s = s._replace(seen=s.seen[rows], share=s.share[rows], lens=s.lens._replace(px=s.lens.px[rows]))
    s = s._replace(xy=s.xy[rows], velocity=s.velocity[rows], to_px=s.to_px[rows])
    return s._replace(shutter=s.shutter._replace(row=s.shutter.row[rows])) if s.shutter.rolling else s


def moved(x: Variables, rng: np.random.Generator, scale: float) -> Variables:
    """``x`` off by ``scale`` of what is natural, in everything."""
    return x.retract(
        scale * natural(x) * rng.normal(size=natural(x).shape), 0.01 * scale * rng.normal(size=x.landmarks.shape)
    )


def natural(x: Variables) -> Float:
    """(n,) natural sizes of the error of states and calibration."""
    return np.concatenate([np.tile(NATURAL, len(x.states)), np.tile(NATURAL_CALIBRATION, len(x.cameras.p_BC))])


def retracted(x: Variables, d: Float) -> Variables:
    """``x`` moved by ``d``: states and calibration, then landmarks."""
    n = len(natural(x))
    return x.retract(d[:n], d[n:].reshape(-1, 3))


def numeric(function: Callable[[Float], Float], sizes: Float, eps: float = 1e-4) -> Float:
    """Derivatives (..., n) of ``function`` at zero by central differences of fourth order of ``eps * sizes`` (n,)."""
    columns = []
    for e in np.diag(eps * sizes):
        near = np.asarray(function(e)) - np.asarray(function(-e))
        far = np.asarray(function(2.0 * e)) - np.asarray(function(-2.0 * e))
        columns.append((8.0 * near - far) / (12.0 * e.sum()))
    return np.stack(columns, axis=-1)


def row_poses(states: StateArrays, cameras: Calibrated, shutter: Shutter, row: Int, view: Int) -> tuple[Float, Float]:
    """R_WC (..., 3, 3) and p_WC (..., 3) when each landmark ``row`` was seen in its ``view``."""
    frame, camera = np.divmod(view, len(cameras.p_BC))
    R_WB, p_WB = states.R_WB[frame], states.p_WB[frame]
    if shutter.rolling:
        late_s = (cameras.readout_s[camera] * shutter.row[row, view])[..., None]
        p_WB = p_WB + np.einsum("...ij,...j", R_WB, shutter.velocity_B[frame] * late_s)
        R_WB = R_WB @ so3.exp(shutter.rate_B[frame] * late_s)
    return R_WB @ cameras.R_BC[camera], np.einsum("...ij,...j", R_WB, cameras.p_BC[camera]) + p_WB


def _sightings(
    states: StateArrays,
    calibrated: Calibrated,
    lenses: list[Camera],
    count: int,
    noise_px: float,
    on_sphere: bool,
    rng: np.random.Generator,
) -> tuple[Sightings, Float]:
    """Of random landmarks by random views, two of them at least, and [x y rho] of the landmarks."""
    frames, N, drawn = len(states), len(lenses), 4 * count
    views = N * frames
    hosts = np.arange(drawn) % (views - N)
    xy_rho = np.column_stack([rng.uniform(-0.5, 0.5, (drawn, 2)), 1.0 / rng.uniform(3.0, 10.0, drawn)])
    p_WF = positions(states, calibrated, hosts, xy_rho)
    shutter = GLOBAL_SHUTTER
    if calibrated.readout_s.any():
        own = np.random.default_rng(1)
        shutter = Shutter(True, own.uniform(-0.5, 0.5, (drawn, views)), *own.normal(size=(2, frames, 3)))
    R_WC, p_WC = row_poses(states, calibrated, shutter, np.arange(drawn)[:, None], np.arange(views))
    p_CF = np.einsum("...ji,...j", R_WC, p_WF[:, None] - p_WC)
    in_view = (p_CF[..., 2] > 1.0) & (np.abs(p_CF[..., :2]) < 0.7 * p_CF[..., 2:]).all(axis=2)
    seen = in_view & (rng.random((drawn, views)) < 0.7) & (np.arange(views) > hosts[:, None])
    seen[np.arange(drawn), hosts] = True
    chosen = np.flatnonzero(seen.sum(axis=1) >= 2)[:count]
    assert len(chosen) == count
    hosts, p_WF, p_CF, seen = hosts[chosen], p_WF[chosen], p_CF[chosen], seen[chosen]
    exact = p_CF[..., :2] / p_CF[..., 2:]
    exact[~seen] = 0.0
    velocity = np.where(seen[..., None], rng.normal(0.0, 0.3, exact.shape), 0.0)
    noise, xy, to_px = np.zeros_like(exact), np.zeros_like(exact), np.zeros((count, views, 2, 2))
    noise[seen] = rng.normal(0.0, noise_px, (seen.sum(), 2))
    for c, lens in enumerate(lenses):
        own = seen & (np.arange(views) % N == c)
        pixels = lens.distort(exact[own]) + noise[own]
        xy[own] = lens.undistort(pixels) + calibrated.offset_s[c] * velocity[own]
        to_px[own] = pixels_by_residual(*intrinsics_of(lens), xy[own], on_sphere)
    models, intrinsics = zip(*map(intrinsics_of, lenses), strict=True)
    px = pixels_by_intrinsics(np.array(models), np.stack(intrinsics), exact, seen)
    lens = Lens(True, px, np.tile(calibrated.intrinsics, (frames, 1)))
    landmarks, in_front = in_hosts(states, calibrated, hosts, p_WF)
    assert in_front.all()
    if shutter.rolling:
        shutter = shutter._replace(row=shutter.row[chosen])
    share = rng.uniform(0.1, 1.0, seen.shape)
    return Sightings(seen, share, xy, velocity, to_px, 0.8, 2.0, on_sphere, shutter, lens), landmarks
