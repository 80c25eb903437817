"""One landmark, one id: points that one camera follows are looked for in the images of another, taken with it.

Between two cameras ``p_C2 = R_C2C1 @ p_C1 + p_C2C1``. A point on the z = 1 plane of the first, at the inverse depth
``rho``, is seen by the second at the direction of ``R_C2C1 @ [x y 1] + rho p_C2C1``.
"""

from __future__ import annotations

import numpy as np

from vioframe.frontend.flow import follow
from vioframe.frontend.view import BORDER_PX, FORWARD_BACKWARD_PX, View
from vioframe.geometry.cameras import Camera
from vioframe.geometry.two_view import essential_matrix, rays, sampson_distance
from vioframe.types import Bool, Calibration, CameraOnBody, Float, Int

# Largest distance of a match from the epipolar geometry, px: the extrinsics are only known to so much.
_EPIPOLAR_PX = 2.0
# Nearer than this nothing is matched, 1/m, nor much farther than infinity, as noise can have it.
_NEAREST, _FARTHEST = 1.0 / 0.2, -0.02
# Cameras overlap where one sees this part of what another does, infinitely far away or at one of these distances, m.
_LEAST_OVERLAP, _DISTANCES_M = 0.1, (np.inf, 5.0, 1.0)
# What was not found is looked for again every so many images: it looks different from elsewhere.
_AGAIN_IMAGES = 5
_GRID = 12


class Pair:
    """Two cameras whose images overlap; what the ``first`` follows is looked for in what the ``second`` sees."""

    def __init__(self, first: int, second: int) -> None:
        self.first, self.second = first, second
        self._not_found: Int = np.empty(0, np.int64)
        self._images = 0

    def match(self, views: tuple[View, ...], calibration: Calibration) -> None:
        """Have the second camera follow what the first one does, and let go of what it only seemed to."""
        one, other = views[self.first], views[self.second]
        if one.is_featureless or other.is_featureless:
            return
        self._images += 1
        if self._images % _AGAIN_IMAGES == 0:
            self._not_found = self._not_found[:0]
        R_C2C1, p_C2C1 = between(calibration.cameras[self.first], calibration.cameras[self.second])
        E, focal_px = essential_matrix(R_C2C1, p_C2C1), other.camera.focal_px
        _, i, j = np.intersect1d(one.ids, other.ids, assume_unique=True, return_indices=True)
        rho = inverse_depths(R_C2C1, p_C2C1, one.xy_normalised[i], other.xy_normalised[j])
        wrong = ~_agree(E, focal_px, rho, one.xy_normalised[i], other.xy_normalised[j])
        typical = float(np.median(rho[~wrong])) if not wrong.all() else 0.0
        if self.first < self.second and wrong.any():  # of the two it is this one that lets go
            keep = np.ones(len(other.ids), bool)
            keep[j[wrong]] = False
            self._not_found = np.append(self._not_found, one.ids[i[wrong]])
            other.keep(keep)

        new = np.flatnonzero(~np.isin(one.ids, other.ids) & ~np.isin(one.ids, self._not_found))
        guess, in_view = projected(one.xy_normalised[new], max(typical, 0.0), R_C2C1, p_C2C1, other.camera)
        new, guess = new[in_view], guess[in_view]
        if not len(new):
            return
        xy, found = follow(one.pyramid, other.pyramid, one.xy[new], guess, FORWARD_BACKWARD_PX)
        xy_normalised = other.camera.undistort(xy)
        found &= other.camera.contains(xy, BORDER_PX) & np.isfinite(xy_normalised).all(axis=1)
        here, there = one.xy_normalised[new], np.where(found[:, None], xy_normalised, 0.0)
        found &= _agree(E, focal_px, inverse_depths(R_C2C1, p_C2C1, here, there), here, there)
        other.add(one.ids[new[found]], xy[found], xy_normalised[found])
        self._not_found = np.append(self._not_found, one.ids[new[~found]])


def overlapping(calibration: Calibration) -> tuple[Pair, ...]:
    """Of each camera, in the order of the rig, with all those that see a part of what it sees."""
    count = range(len(calibration.cameras))
    return tuple(Pair(o, c) for c in count for o in count if o != c and _overlap(calibration, o, c))


def between(first: CameraOnBody, second: CameraOnBody) -> tuple[Float, Float]:
    """R_C2C1 (3, 3) and p_C2C1 (3,) m."""
    return second.R_BC.T @ first.R_BC, second.R_BC.T @ (first.p_BC - second.p_BC)


def inverse_depths(R_C2C1: Float, p_C2C1: Float, xy_1: Float, xy_2: Float) -> Float:
    """(N,) 1/m in the first camera, of points seen at (N, 2) in both: where they are in the second, least squares."""
    turned = rays(xy_1) @ R_C2C1.T
    # x_2 (turned_z + rho p_z) = turned_xy + rho p_xy.
    a = p_C2C1[:2] - xy_2 * p_C2C1[2]
    b = xy_2 * turned[:, 2:] - turned[:, :2]
    squared = (a * a).sum(axis=1)
    return np.asarray((a * b).sum(axis=1) / np.maximum(squared, 1e-12))


def projected(xy_1: Float, rho: float, R_C2C1: Float, p_C2C1: Float, camera: Camera) -> tuple[Float, Bool]:
    """(N, 2) px in the second camera, at the inverse depth ``rho`` 1/m in the first; which are in its image (N,)."""
    p_C2 = rays(xy_1) @ R_C2C1.T + rho * p_C2C1
    ahead = p_C2[:, 2] > 0.1
    p_C2[~ahead] = [0.0, 0.0, 1.0]
    xy = camera.project(p_C2)
    return xy, ahead & camera.contains(xy)


def _agree(E: Float, focal_px: float, rho: Float, xy_1: Float, xy_2: Float) -> Bool:
    near = np.abs(sampson_distance(E, xy_1, xy_2)) * focal_px < _EPIPOLAR_PX
    return np.asarray(near & (rho > _FARTHEST) & (rho < _NEAREST))


def _overlap(calibration: Calibration, first: int, second: int) -> bool:
    one, other = calibration.cameras[first], calibration.cameras[second]
    if not (one.rotation_known and other.rotation_known):
        return False
    width, height = one.model.resolution
    grid = np.meshgrid(np.linspace(0.0, width - 1.0, _GRID), np.linspace(0.0, height - 1.0, _GRID))
    xy_normalised = one.model.undistort(np.column_stack([axis.ravel() for axis in grid]))
    xy_normalised = xy_normalised[np.isfinite(xy_normalised).all(axis=1)]
    return any(
        projected(xy_normalised, 1.0 / distance, *between(one, other), other.model)[1].mean() > _LEAST_OVERLAP
        for distance in _DISTANCES_M
    )
