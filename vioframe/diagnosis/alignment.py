"""The camera's turns beside the gyroscope's, whatever the calibration says: units, axes, rotation and time offset."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from vioframe.diagnosis.recording import ImuSamples
from vioframe.estimation.hand_eye import top_beside
from vioframe.estimation.turns import Turn, turn_between
from vioframe.types import NS_PER_S, Float, FrameTracks

LARGEST_OFFSET_S, _GRID_S = 1.0, 0.005
_ITERATIONS, _CAUCHY = 5, 1.5
_FEWEST_TURNS = 20
# What turns are off by beside their noise, rad; beyond how many typical rates a turn is hardly believed at first.
_FLOOR, _TYPICAL_RATES = 1e-3, 3.0
# Frames farther apart than this tell of no rate.
_LONGEST_S = 0.25


def camera_turns(stretches: Iterable[Sequence[FrameTracks]], sigma: float) -> list[Turn]:
    """Between consecutive frames, for tracks with noise ``sigma`` on the z = 1 plane."""
    out = []
    for stretch in stretches:
        for before, now in pairwise(stretch):
            if 0 < now.t_ns - before.t_ns < _LONGEST_S * NS_PER_S:
                turn = turn_between(before.finite(), now.finite(), sigma)
                if turn is not None and np.isfinite(turn.R_C1C2).all():
                    out.append(turn)
    return out


@dataclass(frozen=True, slots=True)
class Alignment:
    """What lays the camera's rates on the gyroscope's: beta = scale M gamma + bias, at t_imu = t_cam + offset.

    ``M`` (3, 3) is R_BC where ``mirrored`` is False, else an orthogonal matrix that turns a right-handed frame into a
    left-handed one. ``explained`` is the share of the gyroscope's motion that is explained so, ``other_explained`` what
    the best matrix of the other handedness makes of it; ``turned_rad_s`` how much the camera turned unsteadily.
    ``second_turn`` is what it turned about other axes than the main one, as a share.
    """

    M: Float
    mirrored: bool
    offset_s: float
    scale: float
    bias_gyro_B: Float
    explained: float
    other_explained: float
    turned_rad_s: float
    second_turn: float
    third_turn: float


def align(turns: Sequence[Turn], imu: ImuSamples, near_s: float) -> Alignment | None:
    """The best of all offsets within :data:`LARGEST_OFFSET_S` of ``near_s``; None where there are too few turns."""
    from vioframe.geometry import so3

    if len(turns) < _FEWEST_TURNS or len(imu.t_ns) < _FEWEST_TURNS:
        return None
    offsets = near_s + np.arange(-LARGEST_OFFSET_S, LARGEST_OFFSET_S + 1e-9, _GRID_S)
    imu_s = (imu.t_ns - imu.t_ns[0]) / NS_PER_S
    # The integral of the rate; turns between frames are small enough for it to be their vector.
    steps = 0.5 * (imu.gyro_B[1:] + imu.gyro_B[:-1]) * np.diff(imu_s)[:, None]
    integral = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    first, second = ((np.array([turn.t_ns[k] for turn in turns]) - imu.t_ns[0]) / NS_PER_S for k in (0, 1))
    dt = second - first
    gamma = so3.log(np.array([turn.R_C1C2 for turn in turns])) / dt[:, None]
    at = [[np.interp(t + offsets[:, None], imu_s, column) for column in integral.T] for t in (first, second)]
    beta = (np.stack(at[1], axis=-1) - np.stack(at[0], axis=-1)) / dt[:, None]
    covered = (first + offsets[:, None] >= imu_s[0]) & (second + offsets[:, None] <= imu_s[-1])
    usable = covered.sum(axis=1) >= _FEWEST_TURNS
    if not usable.any():
        return None
    # A turn counts by how well its tracks know it, and little where it is far larger than the others.
    known = np.array([1.0 / np.trace(np.linalg.inv(turn.H[:3, :3]) + _FLOOR**2 * np.eye(3)) for turn in turns]) * dt**2
    rate = np.linalg.norm(gamma, axis=1)
    known /= (1.0 + (rate / (_TYPICAL_RATES * np.median(rate))) ** 2) ** 2
    fits = _fit(beta, gamma, covered * (known / known.max()))
    best = int(np.argmax(np.where(usable, np.maximum(fits.proper, fits.improper), -np.inf)))
    mirrored = bool(fits.improper[best] > fits.proper[best])
    offset = offsets[best] + _GRID_S * top_beside(fits.improper if mirrored else fits.proper, best)
    U, Vt = fits.U[best], fits.Vt[best]
    flip = np.diag([1.0, 1.0, np.linalg.det(U @ Vt) * (-1.0 if mirrored else 1.0)])
    M = U @ flip @ Vt
    chosen, other = fits.proper[best], fits.improper[best]
    weight = fits.weight[best]
    turned = np.sqrt(np.maximum(np.linalg.eigvalsh(fits.gamma_moments[best]), 0.0))[::-1]
    scale = fits.scale[int(mirrored)][best]
    bias = (weight @ (beta[best] - scale * gamma @ M.T)) / weight.sum()
    if mirrored:
        chosen, other = other, chosen
    return Alignment(
        M,
        mirrored,
        float(offset),
        float(scale),
        bias,
        float(chosen),
        float(other),
        float(np.linalg.norm(turned)),
        float(turned[1] / max(turned[0], 1e-12)),
        float(turned[2] / max(turned[0], 1e-12)),
    )


@dataclass(frozen=True, slots=True)
class _Fits:
    """At each of G offsets: the share explained by rotations and by rotoreflections, and what they are made of."""

    proper: Float
    improper: Float
    scale: tuple[Float, Float]
    U: Float
    Vt: Float
    weight: Float
    gamma_moments: Float


def _fit(beta: Float, gamma: Float, known: Float) -> _Fits:
    """Orthogonal Procrustes with scale of ``beta`` (G, P, 3) and ``gamma`` (P, 3), robust by reweighting."""
    weight, covered = known, known > 0.0
    for iteration in range(_ITERATIONS):
        total = weight.sum(axis=1, keepdims=True) + 1e-12
        centred_beta = beta - ((weight[:, None] @ beta) / total[..., None])
        centred_gamma = gamma - ((weight @ gamma) / total)[:, None]
        weighted = centred_beta * weight[..., None]
        moments = np.swapaxes(weighted, 1, 2) @ centred_gamma / total[..., None]
        gamma_moments = np.swapaxes(centred_gamma * weight[..., None], 1, 2) @ centred_gamma / total[..., None]
        power_beta = (weighted * centred_beta).sum(axis=(1, 2)) / total[:, 0]
        power_gamma = np.trace(gamma_moments, axis1=1, axis2=2)
        U, S, Vt = np.linalg.svd(moments)
        sign = np.sign(np.linalg.det(U @ Vt))
        traces = S[:, 0] + S[:, 1] + sign * S[:, 2], S[:, 0] + S[:, 1] - sign * S[:, 2]
        explained = [trace**2 / np.maximum(power_beta * power_gamma, 1e-18) for trace in traces]
        scales = tuple(trace / np.maximum(power_gamma, 1e-18) for trace in traces)
        if iteration == _ITERATIONS - 1:
            break
        better = np.where(explained[0] >= explained[1], 1.0, -1.0) * sign
        M = (U * np.stack([np.ones_like(sign), np.ones_like(sign), better], axis=1)[:, None]) @ Vt
        scale = np.where(explained[0] >= explained[1], scales[0], scales[1])
        off = np.linalg.norm(centred_beta - scale[:, None, None] * centred_gamma @ np.swapaxes(M, 1, 2), axis=2)
        typical = np.array([np.median(r[c]) if c.any() else 1.0 for r, c in zip(off, covered, strict=True)])
        weight = known / (1.0 + (off / (_CAUCHY * np.maximum(typical, 1e-6))[:, None]) ** 2)
    return _Fits(explained[0], explained[1], (scales[0], scales[1]), U, Vt, weight, gamma_moments)
