"""Tracks and gyroscope against the calibration: offset, rotation, focal length, distortion and readout, all at once.

With the gyroscope's turn between two frames the rays of a landmark and the unknown translation must lie in a plane
(:mod:`vioframe.estimation.turns`). Whatever bends rays or turns frames leaves them off it: a Gauss-Newton adjustment of
all such distances, the translation of each pair eliminated, tells these apart by where in the image and when they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vioframe.arrays import Bool
from vioframe.diagnosis.recording import ImuSamples
from vioframe.estimation.inertial.gyro_path import GyroPath
from vioframe.estimation.turns import common_tracks, likeliest_translations
from vioframe.geometry import so3
from vioframe.geometry.cameras import Camera
from vioframe.types import NS_PER_S, CameraOnBody, Float, FrameTracks

BIAS, ROTATION, OFFSET, FOCAL, DISTORTION, READOUT = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 7),
    slice(7, 8),
    slice(8, 10),
    slice(10, 11),
)
_SIZE = 11
# Gaps between the frames of a pair, s; how many pairs are used, and tracks of each.
_SPACINGS_S, _MOST_PAIRS, _FEWEST_TRACKS, _MOST_TRACKS = (0.1, 0.3), 160, 20, 60
_PIXEL_SIGMA = 0.5
# Cauchy's scales in standard deviations, and the iterations with each.
_STAGES = ((20.0, 4), (5.0, 6), (2.0, 8))
_STEPS = np.array([1e-4] * 3 + [1e-4] * 3 + [1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
_LARGEST_STEP = np.array([0.1] * 3 + [0.1] * 3 + [0.02, 0.05, 0.1, 0.1, 0.01])
# Priors about the start: what the tracks do not tell stays as it is.
_PRIOR = np.array([0.2] * 3 + [1.0] * 3 + [0.3, 0.2, 0.3, 0.3, 0.03])
_SETTLED = 1e-3


@dataclass(frozen=True, slots=True)
class SelfCalibration:
    """``camera``, ``R_BC`` (3, 3), offset and readout s, bias (3,) rad/s; ``cov`` (11, 11), ``cost`` and the misfit px.

    ``log_focal`` is that of the focal length over the one begun with; ``cov`` is in the order of the module's slices.
    """

    camera: Camera
    R_BC: Float
    bias_gyro_B: Float
    offset_s: float
    readout_s: float
    log_focal: float
    cov: Float
    cost: float
    misfit_px: float

    def sigma(self, part: slice) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.cov[part, part])[-1]))


class Pairs:
    """Pairs of frames and the pixels of their common tracks, with the readings to turn one into the other."""

    def __init__(
        self, stretches: Sequence[Sequence[FrameTracks]], camera: CameraOnBody, imu: ImuSamples, margin_s: float
    ) -> None:
        chosen = [pair for stretch in stretches for pair in _spaced(stretch)]
        margin_ns = round(margin_s * NS_PER_S)
        begin, end = imu.t_ns[0] + margin_ns, imu.t_ns[-1] - margin_ns
        chosen = [(a, b) for a, b in chosen if a.t_ns >= begin and b.t_ns <= end]
        if chosen:
            begin, end = min(a.t_ns for a, _ in chosen), max(b.t_ns for _, b in chosen)
        needed = slice(*np.searchsorted(imu.t_ns, [begin - margin_ns, end + margin_ns + 1]))
        self._imu_s = (imu.t_ns[needed] - imu.t_ns[0]) / NS_PER_S
        self._gyro_B = np.ascontiguousarray(imu.gyro_B[needed])
        some = np.linspace(0, len(chosen) - 1, min(len(chosen), _MOST_PAIRS)).astype(int)
        chosen = [chosen[k] for k in some.tolist()]
        self.t_s = np.array([[a.t_ns - imu.t_ns[0], b.t_ns - imu.t_ns[0]] for a, b in chosen]).reshape(-1, 2) / NS_PER_S
        self.xy = np.zeros((2, len(chosen), _MOST_TRACKS, 2))
        self.common = np.zeros((len(chosen), _MOST_TRACKS), bool)
        for p, (a, b) in enumerate(chosen):
            i, j = common_tracks(a, b, _MOST_TRACKS)
            self.xy[0, p, : len(i)], self.xy[1, p, : len(i)], self.common[p, : len(i)] = a.xy[i], b.xy[j], True
        self._row = camera.row(self.xy[..., 1])

    def __len__(self) -> int:
        return len(self.t_s)

    def half(self, later: bool) -> Pairs:
        """Those before, or after, the middle of the recording's pairs."""
        out = object.__new__(Pairs)
        out._imu_s, out._gyro_B = self._imu_s, self._gyro_B
        middle = np.median(self.t_s[:, 0]) if len(self) else 0.0
        of_half = (self.t_s[:, 0] > middle) == later
        out.t_s, out.common = self.t_s[of_half], self.common[of_half]
        out.xy, out._row = self.xy[:, of_half], self._row[:, of_half]
        return out

    def calibrate(self, start: SelfCalibration, free: Sequence[slice]) -> SelfCalibration:
        """From ``start`` to where tracks and gyroscope agree best in the parts that are ``free``, and the bias."""
        active = np.r_[tuple(np.arange(_SIZE)[part] for part in (BIAS, *free))]
        x, origin = np.zeros(_SIZE), start
        weight = self.common.astype(np.float64)
        H = np.eye(len(active))
        for cauchy, iterations in _STAGES:
            for _ in range(iterations):
                here = _moved(origin, x)
                xy = self._undistorted(here.camera)
                rays, usable = self._rays(here, xy)
                t = likeliest_translations(*rays[:3], weight, usable)
                r, by_t = self._residuals(rays, t, usable)
                J = np.zeros((*r.shape, len(active)))
                for column, k in enumerate(active):
                    d = np.zeros(_SIZE)
                    d[k] = _STEPS[k]
                    there = _moved(origin, x + d)
                    # Most parameters leave the lens as it is.
                    moved, _ = self._rays(there, xy if there.camera == here.camera else self._undistorted(there.camera))
                    J[..., column] = (self._residuals(moved, t, usable)[0] - r) / _STEPS[k]
                J = np.nan_to_num(J)
                robust = usable / (1.0 + (r / cauchy) ** 2)
                H, b = _reduced(J, by_t, r, robust)
                prior = 1.0 / _PRIOR[active] ** 2
                H += np.diag(prior)
                b += prior * x[active]
                step = -np.linalg.solve(H, b)
                step *= min(1.0, float((_LARGEST_STEP[active] / np.maximum(np.abs(step), 1e-12)).min()))
                x[active] += step
                weight = robust
                if (np.abs(step) < _SETTLED * _LARGEST_STEP[active]).all():
                    break
        here = _moved(origin, x)
        rays, usable = self._rays(here, self._undistorted(here.camera))
        r, _ = self._residuals(rays, likeliest_translations(*rays[:3], weight, usable), usable)
        squared = np.where(usable, r * r, 0.0)
        count = max(int(self.common.sum()), 1)
        # What cannot be undistorted is as bad as what is far off.
        cauchy = _STAGES[-1][0]
        lost = (self.common & ~usable).sum() * np.log1p((20.0 / cauchy) ** 2)
        cost = float(cauchy**2 * (np.log1p(squared / cauchy**2).sum() + lost) / count)
        misfit = float(np.median(np.abs(r[usable]))) / 0.6745 if usable.any() else np.inf
        cov = np.zeros((_SIZE, _SIZE))
        # The same track is in several pairs: a third of the equations are taken for independent.
        cov[np.ix_(active, active)] = np.linalg.inv(H) * max(misfit, 0.3) ** 2 * 3.0
        return replace(here, cov=cov, cost=cost, misfit_px=misfit * _PIXEL_SIGMA)

    def _undistorted(self, camera: Camera) -> Float:
        return camera.undistort(self.xy.reshape(-1, 2)).reshape(self.xy.shape)

    def _rays(self, x: SelfCalibration, xy: Float) -> tuple[tuple[Float, Float, Float, float], Bool]:
        """Rays of the first frame, those of the second turned into it, R_C1C2 (P, 3, 3), the noise, and which are good.

        ``xy`` are the points undistorted by the camera of ``x``. Of a rolling shutter each ray is turned to the instant
        of the frame's stamp, which is that of its middle row.
        """
        usable = self.common & np.isfinite(xy).all(axis=(0, 3))
        rays = np.concatenate([np.nan_to_num(xy), np.ones((*xy.shape[:-1], 1))], axis=-1)
        R, rate = GyroPath(self._imu_s, self._gyro_B - x.bias_gyro_B).at(self.t_s.T + x.offset_s)
        if x.readout_s:
            rate_C, delay_s = rate @ x.R_BC, x.readout_s * self._row
            rays = rays + np.cross(rate_C[:, :, None], rays) * delay_s[..., None]
        R_C1C2 = x.R_BC.T @ np.swapaxes(R[0], -1, -2) @ R[1] @ x.R_BC
        turned = rays[1] @ np.swapaxes(R_C1C2, -1, -2)
        sigma = _PIXEL_SIGMA / x.camera.focal_px
        return (rays[0], turned, R_C1C2, sigma), np.asarray(usable)

    @staticmethod
    def _residuals(rays: tuple[Float, Float, Float, float], t: Float, usable: Bool) -> tuple[Float, Float]:
        """Sampson's distances (P, N) in standard deviations, and their derivatives by the translation (P, N, 2)."""
        f, y, R, sigma = rays
        n = np.cross(f, y)
        by_f, t_x_f = np.cross(y, t[:, None]), np.cross(t[:, None], f)
        by_g = t_x_f @ R
        scale = sigma * np.sqrt((by_f[..., :2] ** 2).sum(-1) + (by_g[..., :2] ** 2).sum(-1)) + 1e-12
        tangent = np.linalg.svd(t[:, None, :])[2].swapaxes(-1, -2)[..., 1:]
        r = np.where(usable, (n @ t[..., None])[..., 0] / scale, 0.0)
        return r, n @ tangent / scale[..., None] * usable[..., None]


def start_at(camera: CameraOnBody, R_BC: Float, bias_gyro_B: Float, offset_s: float) -> SelfCalibration:
    """With the lens and the readout of ``camera``."""
    cov = np.zeros((_SIZE, _SIZE))
    return SelfCalibration(camera.model, R_BC, bias_gyro_B, offset_s, camera.readout_s, 0.0, cov, np.inf, np.inf)


def _moved(start: SelfCalibration, x: Float) -> SelfCalibration:
    camera = start.camera.zoomed(float(np.exp(x[7])))
    k1, k2, d3, d4 = camera.distortion
    moved = replace(camera, distortion=(k1 + float(x[8]), k2 + float(x[9]), d3, d4))
    return replace(
        start,
        camera=moved,
        R_BC=start.R_BC @ so3.exp(x[ROTATION]),
        bias_gyro_B=start.bias_gyro_B + x[BIAS],
        offset_s=start.offset_s + float(x[6]),
        readout_s=start.readout_s + float(x[10]),
        log_focal=start.log_focal + float(x[7]),
    )


def _reduced(J: Float, by_t: Float, r: Float, robust: Float) -> tuple[Float, Float]:
    """Normal equations of the parameters, each pair's translation (with a prior of 1 rad) eliminated."""
    weighted = np.swapaxes(J * robust[..., None], -1, -2)
    H, b = weighted @ J, (weighted @ r[..., None])[..., 0]
    H_xt = weighted @ by_t
    weighted_t = np.swapaxes(by_t * robust[..., None], -1, -2)
    H_tt, b_t = weighted_t @ by_t + np.eye(2), (weighted_t @ r[..., None])
    eliminated = np.linalg.solve(H_tt, np.concatenate([np.swapaxes(H_xt, -1, -2), b_t], axis=-1))
    return (H - H_xt @ eliminated[..., :-1]).sum(axis=0), (b - (H_xt @ eliminated[..., -1:])[..., 0]).sum(axis=0)


def _spaced(stretch: Sequence[FrameTracks]) -> list[tuple[FrameTracks, FrameTracks]]:
    """Pairs about each of the spacings apart, that share enough tracks, ever second frame being a first one."""
    t_s = np.array([tracks.t_ns for tracks in stretch]) / NS_PER_S
    out = []
    for spacing in _SPACINGS_S:
        for i in range(0, len(stretch) - 1, 2):
            j = int(np.argmin(np.abs(t_s - t_s[i] - spacing)))
            if (
                j > i
                and abs(t_s[j] - t_s[i] - spacing) < 0.5 * spacing
                and len(common_tracks(stretch[i], stretch[j], _MOST_TRACKS)[0]) >= _FEWEST_TRACKS
            ):
                out.append((stretch[i], stretch[j]))
    return out
