"""Ideal feature tracks: static landmarks seen by a moving camera, with noise in the pixels and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry.cameras import Camera
from vioframe.types import Calibration, Float, FrameTracks, Int

# Landmarks nearer than this cannot be tracked: they cross the image too fast.
_NEAREST_M = 0.3


@dataclass(frozen=True)
class TrackOptions:
    """What the simulated front-end sees. Landmarks are born at a depth drawn uniformly from ``depth_m``."""

    max_points: int = 150
    pixel_sigma: float = 1.0
    """Standard deviation of an observation, px on either axis of the raw (distorted) image."""
    outlier_ratio: float = 0.0
    """Chance that an observation is off by ``outlier_px``."""
    outlier_px: tuple[float, float] = (5.0, 30.0)
    depth_m: tuple[float, float] = (2.0, 10.0)
    border_px: float = 5.0
    """Landmarks are seen this far inside the image, as a tracking window needs."""


class TrackSimulator:
    """Tracks landmarks frame by frame: one lives while it is in view and is never seen again after leaving it.

    As in the simulator of OpenVINS (Geneva et al., ICRA 2020), a new landmark is put at a random pixel and a random
    depth whenever there are fewer than wanted. ``p_WF`` maps each id that ever lived to its true position.
    """

    def __init__(self, calibration: Calibration, options: TrackOptions, rng: np.random.Generator) -> None:
        self._camera = calibration.camera
        self._R_BC, self._p_BC = calibration.R_BC, calibration.p_BC
        self._options = options
        self._rng = rng
        self._widest = _widest_radius(calibration.camera)
        self._ids: Int = np.empty(0, np.int64)
        self._p_WF: Float = np.empty((0, 3))
        self._next_id = 0
        self.p_WF: dict[int, Float] = {}

    def observe(self, t_ns: int, R_WB: Float, p_WB: Float) -> FrameTracks:
        """The tracks of a frame taken at ``R_WB`` (3, 3), ``p_WB`` (3,) m."""
        R_WC = R_WB @ self._R_BC
        p_WC = R_WB @ self._p_BC + p_WB
        xy, visible = self._project(R_WC, p_WC, self._p_WF)
        self._ids, self._p_WF, xy = self._ids[visible], self._p_WF[visible], xy[visible]
        missing = self._options.max_points - len(self._ids)
        if missing > 0:
            xy = np.concatenate([xy, self._add_landmarks(missing, R_WC, p_WC)])
        xy = self._disturb(xy)
        return FrameTracks(t_ns, self._ids.copy(), xy, self._camera.undistort(xy))

    def _project(self, R_WC: Float, p_WC: Float, p_WF: Float) -> tuple[Float, NDArray[np.bool_]]:
        p_CF = (p_WF - p_WC) @ R_WC
        in_front = p_CF[:, 2] > _NEAREST_M
        uv = p_CF[:, :2] / np.where(in_front, p_CF[:, 2], 1.0)[:, None]
        # Far outside the image the distortion model folds back into it.
        in_front &= (uv * uv).sum(axis=1) < self._widest**2
        xy = np.full_like(uv, np.nan)
        xy[in_front] = self._camera.distort(uv[in_front])
        return xy, in_front & self._camera.contains(xy, self._options.border_px)

    def _add_landmarks(self, count: int, R_WC: Float, p_WC: Float) -> Float:
        border = self._options.border_px
        limit = np.array(self._camera.resolution) - 1.0 - border
        xy = self._rng.uniform(border, limit, (count, 2))
        depth = self._rng.uniform(*self._options.depth_m, count)
        rays_C = np.column_stack([self._camera.undistort(xy), np.ones(count)])
        p_WF = (rays_C * depth[:, None]) @ R_WC.T + p_WC
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        self._ids, self._p_WF = np.concatenate([self._ids, ids]), np.concatenate([self._p_WF, p_WF])
        self.p_WF.update(zip(ids.tolist(), p_WF, strict=True))
        return xy

    def _disturb(self, xy: Float) -> Float:
        xy = xy + self._rng.normal(0.0, self._options.pixel_sigma, xy.shape)
        wrong = self._rng.random(len(xy)) < self._options.outlier_ratio
        angle = self._rng.uniform(0.0, 2.0 * np.pi, wrong.sum())
        length = self._rng.uniform(*self._options.outlier_px, wrong.sum())
        xy[wrong] += length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        return xy


def _widest_radius(camera: Camera) -> float:
    """Distance from the optical axis of the farthest image corner, on the z = 1 plane."""
    width, height = camera.resolution
    corners = camera.undistort(np.array([[x, y] for x in (0.0, width - 1.0) for y in (0.0, height - 1.0)]))
    return float(np.linalg.norm(corners, axis=1).max())
