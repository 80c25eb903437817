"""One landmark, one id: points that one camera follows are looked for in the images of another, taken about then.

Between two cameras ``p_C2 = R_C2C1 @ p_C1 + p_C2C1``. A point on the z = 1 plane of the first, at the inverse depth
``rho``, is seen by the second at the direction of ``R_C2C1 @ [x y 1] + rho p_C2C1``. Where the second image came later,
the gyroscope tells how the body has turned since the first; how it has moved is left open, within what a body can.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vioframe.frontend.flow import follow, projected, returns
from vioframe.frontend.refill import spread
from vioframe.frontend.view import FORWARD_BACKWARD_PX, View
from vioframe.geometry.two_view import essential_matrix, inverse_depths, rays, sampson_distance
from vioframe.types import Bool, Calibration, Float, Int

# Largest distance of a match from the epipolar geometry, px: the extrinsics are only known to so much.
_EPIPOLAR_PX = 2.0
# Nearer than this nothing is matched, 1/m, nor much farther than infinity, as noise can have it.
_NEAREST, _FARTHEST = 1.0 / 0.2, -0.02
# Between two images that are matched a body moves at most as fast as this, m/s.
_FASTEST_M_S = 3.0
# Cameras overlap where one sees this part of what another does, infinitely far away or at one of these distances, m.
_LEAST_OVERLAP, _DISTANCES_M = 0.1, (np.inf, 5.0, 1.0)
# What was not found is looked for again every so many images: it looks different from elsewhere.
_AGAIN_IMAGES = 5
_GRID = 12


class Pair:
    """Two cameras whose images overlap; what the ``first`` follows is looked for in what the ``second`` sees.

    ``overlap`` is the part of the second's image in which the first can see the same.
    """

    def __init__(self, first: int, second: int, overlap: float) -> None:
        self.first, self.second, self.overlap = first, second, overlap
        self._not_found: Int = np.empty(0, np.int64)
        self._shared: Int = np.empty(0, np.int64)  # what both saw last
        self._let_go: Int = np.empty(0, np.int64)
        self._images = 0

    def match(
        self, views: tuple[View, ...], calibration: Calibration, R_B1B2: Float, apart_s: float, most: int
    ) -> None:
        """Have the second camera follow what the first one does, and let go of what it only seemed to.

        ``R_B1B2`` (3, 3) is how the body turned in the ``apart_s`` between the image of the first and that of the
        second, which is to follow no more than ``most`` points.
        """
        one, other = views[self.first], views[self.second]
        if one.is_featureless or other.is_featureless:
            self._shared = self._shared[:0]
            return
        _, i, j = np.intersect1d(one.ids, other.ids, assume_unique=True, return_indices=True)
        # What a camera no longer follows was hidden or has slid off its landmark, and would be taken up where it did.
        gone = np.append(self._let_go, np.setdiff1d(self._shared, other.ids, assume_unique=True))
        self._let_go, self._shared = one.ids[np.isin(one.ids, gone)], one.ids[i]
        lets_go = self.first < self.second  # of the two it is this one that does
        if not (lets_go or other.wanted(most)):
            return
        self._images += 1
        if self._images % _AGAIN_IMAGES == 0:
            self._not_found = self._not_found[:0]
        first = calibration.cameras[self.first]
        then = replace(first, R_BC=R_B1B2.T @ first.R_BC, p_BC=R_B1B2.T @ first.p_BC)
        R_C2C1, p_C2C1 = then.seen_from(calibration.cameras[self.second])
        nearest = _EPIPOLAR_PX / other.camera.focal_px, _FASTEST_M_S * apart_s
        right, rho = _agreement(one.xy_normalised[i], other.xy_normalised[j], R_C2C1, p_C2C1, nearest)
        wrong, typical = ~right, float(np.median(rho[right])) if right.any() else 0.0
        if lets_go and wrong.any():
            keep = np.ones(len(other.ids), bool)
            keep[j[wrong]] = False
            other.keep(keep)

        wanted = other.wanted(most)
        if not wanted:
            return
        tried = np.isin(one.ids, np.append(self._not_found, self._let_go))
        tried[i] = True
        new = np.flatnonzero(~tried)
        p_C2 = rays(one.xy_normalised[new]) @ R_C2C1.T + max(typical, 0.0) * p_C2C1
        guess, in_view = projected(other.camera, p_C2)
        new, guess = new[in_view], guess[in_view]
        taken = spread(guess, other.xy, wanted, size=other.camera.resolution, min_distance_px=0.0)
        if not len(taken):
            return
        new, guess = new[taken], guess[taken]
        xy, found = follow(one.pyramid, other.pyramid, one.xy[new], guess)
        found &= returns(one.pyramid, other.pyramid, one.xy[new], xy, FORWARD_BACKWARD_PX)
        xy_normalised, usable = other.undistorted(xy)
        found &= usable
        there = np.where(found[:, None], xy_normalised, 0.0)
        found &= _agreement(one.xy_normalised[new], there, R_C2C1, p_C2C1, nearest)[0]
        other.add(one.ids[new[found]], xy[found], xy_normalised[found])
        self._not_found = np.append(self._not_found, one.ids[new[~found]])


def overlapping(calibration: Calibration) -> tuple[Pair, ...]:
    """Of each camera, in the order of the rig, with all those that see a part of what it sees."""
    count = range(len(calibration.cameras))
    pairs = (Pair(o, c, _seen_by(calibration, c, o)) for c in count for o in count if o != c)
    return tuple(pair for pair in pairs if pair.overlap > _LEAST_OVERLAP)


def _agreement(
    xy_1: Float, xy_2: Float, R_C2C1: Float, p_C2C1: Float, nearest: tuple[float, float]
) -> tuple[Bool, Float]:
    """Which pairs (N, 2) may be of one point, as near to each other's epipolar lines; and inverse depths (N,) 1/m.

    ``nearest`` is the least distance that is tolerated, on the z = 1 plane, and what the body may have moved, m.
    """
    rho, (least, moved_m) = inverse_depths(xy_1, xy_2, R_C2C1, p_C2C1), nearest
    threshold = least + moved_m * np.maximum(rho, 0.0)
    near = np.abs(sampson_distance(essential_matrix(R_C2C1, p_C2C1), xy_1, xy_2)) < threshold
    return np.asarray(near & (rho > _FARTHEST) & (rho < _NEAREST)), rho


def _seen_by(calibration: Calibration, camera: int, other: int) -> float:
    """The part of the image of ``camera`` that ``other`` sees as well, at the distance where that is most."""
    one, another = calibration.cameras[camera], calibration.cameras[other]
    if not (one.rotation_known and another.rotation_known):
        return 0.0
    width, height = one.model.resolution
    grid = np.meshgrid(np.linspace(0.0, width - 1.0, _GRID), np.linspace(0.0, height - 1.0, _GRID))
    xy_normalised = one.model.undistort(np.column_stack([axis.ravel() for axis in grid]))
    R_C2C1, p_C2C1 = one.seen_from(another)
    turned = rays(xy_normalised[np.isfinite(xy_normalised).all(axis=1)]) @ R_C2C1.T
    return max(float(projected(another.model, turned + p_C2C1 / m)[1].mean()) for m in _DISTANCES_M)
