"""How the camera is turned on the body, from tracks and gyroscope alone: hand-eye calibration of the rotation.

    chain keyframes -> turned about two axes? -> closed form -> refine on all tracks -> judge

A rotation R_BiBj of the body is R_BC R_CiCj R_BC' seen by the camera, hence log R_BiBj = R_BC log R_CiCj: one axis, in
two frames (Park, Martin, "Robot Sensor Calibration: Solving AX = XB on the Euclidean Group", T-RA 1994). Translation
plays no part, so that neither scale, gravity nor the lever arm need be known. Derivation:
``docs/derivations/initialization.md``.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vioframe.arrays import Float
from vioframe.estimation.inertial.preintegration import Preintegrated, join_segments, preintegrate
from vioframe.estimation.initialization.epipolar_pairs import CONVERGED, BearingPairs, Pairs, refine, relative_rotations
from vioframe.estimation.initialization.window import (
    BIAS_GYRO_SIGMA,
    LARGEST_IMU_GAP_S,
    PIXEL_SIGMA,
    RefusalError,
    refuse_unless,
)
from vioframe.geometry import so3
from vioframe.types import Calibration, FrameTracks, ImuSegment

_log = logging.getLogger("vioframe.estimation.initialization")

_KEYFRAME_NS, _ATTEMPT_EVERY = 180_000_000, 3
_FEWEST_KEYFRAMES, _MOST_KEYFRAMES = 10, 60
# What noise in the tracks (which pulls where parallax is small) and the gyroscope's own axes cost beyond the scatter:
# simulated and real recordings show 0.05 to 0.5 degrees.
_SYSTEMATIC_DEG = 0.3
_MAX_MISFIT, _LEAST_MISFIT = 2.0, 0.1
# Turns about other axes than the main one (root of their sum of squares) that an attempt needs, rad. VINS-Mono asks for
# 0.25; here what is too little shows in the covariance, of which this is the largest standard deviation accepted.
_LEAST_SECOND_TURN, _LARGEST_SIGMA_DEG = 0.15, 0.4
_FEWEST_TRACKS, _MOST_TRACKS = 15, 80
# Keyframes from the first of a pair to the second. One of two fifths of a second turns enough and keeps most tracks.
_STEPS, _COARSE_STEP = (1, 2, 4, 8), 2
# Iterations and Cauchy's scale (standard deviations) of each stage for a pair on its own ...
_PAIR_STAGES = ((6, 20.0), (6, 5.0), (6, 2.0))
_PAIR_PRIOR, _LARGEST_PAIR_STEP = 0.5, 0.2  # rad
# ... and for all: iterations, how many of the steps are used, Cauchy's scale.
_STAGES = ((6, 2, 50.0), (6, 3, 20.0), (8, 4, 5.0), (15, 4, 2.0))
_ALIGNMENT_ITERATIONS, _ALIGNMENT_SIGMA = 10, np.deg2rad(1.0)
# The median of |x| for x ~ N(0, 1).
_MEDIAN = 0.6745


@dataclass(frozen=True, slots=True)
class CameraRotation:
    """``R_BC`` (3, 3), and the covariance ``cov`` (3, 3) rad^2 of its right perturbation."""

    R_BC: Float
    cov: Float

    @property
    def sigma_deg(self) -> float:
        """Standard deviation about the axis that is known worst."""
        return float(np.rad2deg(np.sqrt(np.linalg.eigvalsh(self.cov)[-1])))

    def __str__(self) -> str:
        quat = " ".join(f"{q:.5f}" for q in so3.to_quat_xyzw(self.R_BC))
        return f"camera's rotation on the body found to {self.sigma_deg:.2f} deg: R_BC as quat_xyzw {quat}"


class RotationCalibrator:
    """Finds R_BC from the first frames of a recording; what ``calibration`` says of it is not used.

    The body must turn about two axes. Every attempt is logged to ``vioframe.estimation.initialization``.
    """

    def __init__(self, calibration: Calibration) -> None:
        self._noise, self._focal_px = calibration.imu, calibration.cameras[0].model.focal_px
        self._tracks: deque[FrameTracks] = deque(maxlen=_MOST_KEYFRAMES)
        self._imu: deque[Preintegrated] = deque(maxlen=_MOST_KEYFRAMES - 1)
        self._since_keyframe: list[ImuSegment] = []
        self._since_attempt = 0
        self.refusal = ""
        """Why the last attempt came to nothing, in one line; "" before the first and after a success."""

    def reset(self) -> None:
        """Forget everything seen."""
        self._tracks.clear()
        self._imu.clear()
        self._since_keyframe.clear()
        self._since_attempt = 0
        self.refusal = ""

    def add(self, imu: ImuSegment, tracks: FrameTracks) -> CameraRotation | None:
        """Take one frame and the readings since the one before; the rotation once it can be trusted, else None."""
        if imu.largest_gap_s > LARGEST_IMU_GAP_S:
            self.reset()
        if not self._chain(imu, tracks) or len(self._tracks) < _FEWEST_KEYFRAMES:
            return None
        self._since_attempt += 1
        if self._since_attempt < _ATTEMPT_EVERY:
            return None
        self._since_attempt = 0
        try:
            found = self._attempt()
        except (RefusalError, np.linalg.LinAlgError) as refusal:
            self.refusal = str(refusal)
            _log.debug("%d hand-eye refused: %s", tracks.t_ns, refusal)
            return None
        self.refusal = ""
        _log.info("%d %s", tracks.t_ns, found)
        return found

    def _chain(self, imu: ImuSegment, tracks: FrameTracks) -> bool:
        """Whether the frame became a keyframe."""
        if not self._tracks:
            self._tracks.append(tracks.finite())
            return True
        self._since_keyframe.append(imu)
        if tracks.t_ns - self._tracks[-1].t_ns < _KEYFRAME_NS:
            return False
        zero = np.zeros(3)
        self._imu.append(preintegrate(join_segments(self._since_keyframe), zero, zero, self._noise))
        self._tracks.append(tracks.finite())
        self._since_keyframe.clear()
        return True

    def _attempt(self) -> CameraRotation:
        chain = Chain(list(self._tracks), list(self._imu))
        turned = second_turn(chain)
        refuse_unless(
            turned >= _LEAST_SECOND_TURN,
            f"turned by {turned:.2f} rad about a second axis, {_LEAST_SECOND_TURN:.2f} are needed; "
            "turn the vehicle about two axes",
        )
        return _solve(chain, PIXEL_SIGMA / self._focal_px)


@dataclass(frozen=True, slots=True)
class Chain:
    """K keyframes ``tracks`` and the K - 1 measurements ``imu`` between them, integrated without bias."""

    tracks: Sequence[FrameTracks]
    imu: Sequence[Preintegrated]

    def pairs(self, steps: Sequence[int]) -> Pairs:
        """All pairs that are one of ``steps`` apart and share enough tracks; of very many tracks, some."""
        first, second, points = [], [], []
        for step in steps:
            for i, (a, b) in enumerate(zip(self.tracks, self.tracks[step:], strict=False)):
                _, in_a, in_b = np.intersect1d(a.ids, b.ids, return_indices=True)
                if len(in_a) >= _FEWEST_TRACKS:
                    some = np.linspace(0, len(in_a) - 1, min(len(in_a), _MOST_TRACKS)).astype(np.int64)
                    first.append(i)
                    second.append(i + step)
                    points.append((a.xy_normalised[in_a[some]], b.xy_normalised[in_b[some]]))
        xy = np.zeros((2, len(points), _MOST_TRACKS, 2))
        common = np.zeros((len(points), _MOST_TRACKS), bool)
        for k, (xy_1, xy_2) in enumerate(points):
            xy[0, k, : len(xy_1)], xy[1, k, : len(xy_2)], common[k, : len(xy_1)] = xy_1, xy_2, True
        return Pairs(np.array(first, np.int64), np.array(second, np.int64), BearingPairs.of(xy[0], xy[1], common))


def second_turn(chain: Chain) -> float:
    """How much the body turned about other axes than its main one, rad: without that R_BC cannot be known.

    To first order the second-smallest singular value of the quaternion equations q_B q_BC = q_BC q_C, by which
    VINS-Mono decides (Qin, Li, Shen, T-RO 2018). A steady turn does not count: it could be the gyroscope's bias.
    """
    k = np.arange(len(chain.tracks) - _COARSE_STEP)
    turns = so3.log(relative_rotations(chain.imu, np.zeros(3), k, k + _COARSE_STEP)[0])
    return float(np.linalg.norm(np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False)[1:]))


def _solve(chain: Chain, sigma: float) -> CameraRotation:
    """From tracks with noise ``sigma`` on the z = 1 plane; the scatter they show stands in for the noise assumed.

    Raises :class:`RefusalError` where there are too few tracks, or they contradict what comes out.
    """
    stages = [(chain.pairs(_STEPS[:count]), iterations, cauchy) for iterations, count, cauchy in _STAGES]
    refuse_unless(len(stages[-1][0].first) >= len(chain.tracks), "too few tracks from one keyframe to the next")
    R_BC, bias = _align_axes(chain, sigma)
    found = refine(stages, chain.imu, bias, R_BC, sigma, BIAS_GYRO_SIGMA, turn_camera=True)
    common = stages[-1][0].bearings.common
    # The typical distance of a track from its epipolar lines over the noise that was assumed.
    misfit = float(np.median(found.distance[common])) / _MEDIAN
    refuse_unless(misfit <= _MAX_MISFIT, f"the tracks disagree with the gyroscope by {misfit:.1f} times their noise")
    rate = float(np.linalg.norm(found.bias_gyro_B))
    refuse_unless(rate <= 3.0 * BIAS_GYRO_SIGMA, f"gyroscope bias of {rate:.2f} rad/s is not plausible")
    H = found.H
    information = H[3:, 3:] - H[3:, :3] @ np.linalg.solve(H[:3, :3], H[:3, 3:])
    information = information * _independent_share(chain, int(common.sum()))
    scatter = max(misfit, _LEAST_MISFIT) ** 2 * np.linalg.inv(information)
    rotation = CameraRotation(found.R_BC, scatter + np.eye(3) * np.deg2rad(_SYSTEMATIC_DEG) ** 2)
    refuse_unless(
        rotation.sigma_deg <= _LARGEST_SIGMA_DEG,
        f"the camera's rotation is known to {rotation.sigma_deg:.2f} deg only (standard deviation); "
        "turn the vehicle about two axes",
    )
    refuse_unless(found.last_step < 100.0 * CONVERGED, "the refinement of the camera's rotation did not settle")
    return rotation


def _align_axes(chain: Chain, sigma: float) -> tuple[Float, Float]:
    """R_BC (3, 3) and the bias (3,) from the turns of pairs: argmin sum w |beta - R_BC gamma - bias dt|^2.

    ``beta`` and ``gamma`` (P, 3) are the rotation vectors of body and camera. The bias is eliminated, which leaves an
    orthogonal Procrustes problem. An angle is the same in both frames: where they differ, the pair counts little.
    """
    pairs = chain.pairs([_COARSE_STEP])
    dt = np.array([sum(m.dt_s for m in chain.imu[i : i + _COARSE_STEP]) for i in pairs.first])
    beta = so3.log(relative_rotations(chain.imu, np.zeros(3), pairs.first, pairs.second)[0])
    gamma = so3.log(_turns_of_camera(pairs.bearings, sigma))
    off = np.abs(np.linalg.norm(beta, axis=1) - np.linalg.norm(gamma, axis=1))
    for _ in range(_ALIGNMENT_ITERATIONS):
        scale = max(_ALIGNMENT_SIGMA, 1.5 * float(np.median(off)))
        weight = 1.0 / (1.0 + (off / scale) ** 2)
        total = (weight * dt**2).sum() + (_ALIGNMENT_SIGMA / BIAS_GYRO_SIGMA) ** 2
        beta_dt, gamma_dt = (weight * dt) @ beta, (weight * dt) @ gamma
        R_BC = so3.project((beta * weight[:, None]).T @ gamma - np.outer(beta_dt, gamma_dt) / total)
        bias = (beta_dt - R_BC @ gamma_dt) / total
        off = np.linalg.norm(beta - gamma @ R_BC.T - dt[:, None] * bias, axis=1)
    return R_BC, bias


def _turns_of_camera(bearings: BearingPairs, sigma: float) -> Float:
    """R_C1C2 (P, 3, 3) of each pair by itself, beginning with the rotation that explains it best without moving."""
    f, g = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1.0) for v in (bearings.f, bearings.g))
    R = so3.project(np.swapaxes(f, -1, -2) @ g)
    weight = bearings.common.astype(np.float64)
    for iterations, cauchy in _PAIR_STAGES:
        for _ in range(iterations):
            equations = bearings.linearise(R, weight, sigma, cauchy)
            step = -np.linalg.solve(equations.H + np.eye(3) / _PAIR_PRIOR**2, equations.b[..., None])[..., 0]
            length = np.linalg.norm(step, axis=1, keepdims=True)
            R = R @ so3.exp(step * np.minimum(1.0, _LARGEST_PAIR_STEP / np.maximum(length, 1e-12)))
            weight = equations.weight
    return R


def _independent_share(chain: Chain, rows: int) -> float:
    """Pairs overlap: of ``rows`` equations, a track with V views brings 2 V - 3 that are independent."""
    _, views = np.unique(np.concatenate([t.ids for t in chain.tracks]), return_counts=True)
    return min(1.0, float(np.maximum(2 * views - 3, 0).sum()) / rows)
