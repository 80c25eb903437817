"""A keyframe as it is kept for recognition: where it was, what it saw, and how that looked.

*Descriptors*, 256 bits each, are of its tracked features and of further corners. The bit tests are ORB's (Rublee et
al., ICCV 2011), but turned by the camera's attitude instead of by the patch's own moments: the odometry knows which way
is down, and better than a patch of 31 pixels does.

*Resection*: a filter places a keyframe by what it knew then, and its landmarks by what it has learned in the second
after that. Seen from the keyframe's pose they lie off by several pixels, all to one side: at 8 m, 0.3 degrees are 4 cm,
more than a loop need be off by. The keyframe saw these landmarks itself: where it saw them says where its camera is to
be put, and the body with it. Without this three of four loops of a rendered V1_02 find too few points that agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vioframe.geometry.resection import resect
from vioframe.types import Float, Image, Int, NavState
from vioframe_pose_graph.keyframes import Keyframe

_MAX_SIGMAS = 4.0
# How well the distance of a landmark is known at best, as a part of it, and the least angle of its rays, rad.
_LEAST_DEPTH_SIGMA, _PARALLEL = 0.004, 1e-3

Float32 = NDArray[np.float32]
Words = NDArray[np.uint64]

_LEVELS, _SCALE_FACTOR, _FAST_THRESHOLD = 4, 1.3, 12
_PATCH_PX = 31
# Sine of the angle between the optical axis and the vertical below which the world's x axis says what is up.
_STEEP = 0.35
PRIOR = np.repeat([np.radians(1.0), 0.03], 3) ** -2.0
"""How well the odometry knows its camera against what it sees: to a degree, and to 3 cm."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a keyframe was: its body as the odometry gave it, its camera as its landmarks say.

    ``p_WB_seen`` (3,) m is where the body is by that. ``cov`` (4, 4) is that of [p_WB yaw] by the odometry, NaN where
    it does not say.
    """

    t_ns: int
    segment: int
    R_WB: Float
    p_WB: Float
    p_WB_seen: Float
    R_WC: Float
    p_WC: Float
    cov: Float


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """K described points of a keyframe on the z = 1 plane, some of them with a position ``p_WF`` (K, 3) m, else NaN.

    ``depth_sigma`` (K,) is how well their distance from the camera is known, as a part of it.
    """

    xy_normalised: Float32
    p_WF: Float32
    depth_sigma: Float32
    descriptors: Words

    @property
    def known(self) -> Int:
        """(L,) which of the points have a position."""
        return np.flatnonzero(np.isfinite(self.p_WF[:, 0]))


def corner_finder(max_corners: int) -> cv2.ORB:
    """What finds up to ``max_corners`` corners, and describes any."""
    return cv2.ORB.create(max_corners, _SCALE_FACTOR, _LEVELS, patchSize=_PATCH_PX, fastThreshold=_FAST_THRESHOLD)


def describe(keyframe: Keyframe, orb: cv2.ORB, sigma_px: float) -> tuple[Place, View]:
    """Find and describe the points of ``keyframe``; its landmarks are known to ``sigma_px`` in the image."""
    camera, state = keyframe.model, keyframe.state
    xy, descriptors, which = _described(orb, keyframe.image, keyframe.tracks.xy, image_angle_deg(keyframe.R_WC))
    xy_normalised = camera.undistort(xy)
    seen = np.isfinite(xy_normalised).all(axis=1)
    xy_normalised, descriptors, which = xy_normalised[seen], descriptors[seen], which[seen]

    p_WF = np.where(which[:, None] >= 0, keyframe.p_WF[which], np.nan)
    known = np.flatnonzero(np.isfinite(p_WF[:, 0]))
    sigma = sigma_px / camera.focal_px
    R_WC, p_WC, _, squared = resect(keyframe.R_WC, keyframe.p_WC, p_WF[known], xy_normalised[known], sigma, 1.0, PRIOR)
    p_WF[known[squared > _MAX_SIGMAS**2]] = np.nan
    p_WB_seen = state.p_WB + p_WC - keyframe.p_WC
    depth_sigma = depth_sigma_of(keyframe.parallax[which], sigma)
    place = Place(state.t_ns, keyframe.segment, state.R_WB, state.p_WB, p_WB_seen, R_WC, p_WC, _levelled(state))
    xy_seen, p_known, sigma_known = (array.astype(np.float32) for array in (xy_normalised, p_WF, depth_sigma))
    return place, View(xy_seen, p_known, sigma_known, descriptors)


def depth_sigma_of(parallax: Float, sigma: float) -> Float:
    """(K,) how well distances are known, as a part of them, along rays that diverge by ``parallax`` (K,) rad."""
    return np.asarray(np.hypot(_LEAST_DEPTH_SIGMA, sigma / np.maximum(parallax, _PARALLEL)))


def _levelled(state: NavState) -> Float:
    """(4, 4) the covariance of position and yaw alone."""
    if state.cov is None:
        return np.full((4, 4), np.nan)
    J = np.zeros((4, 6))
    J[:3, 3:] = np.eye(3)
    J[3, :3] = state.R_WB[2]  # R_WB dtheta about z
    return np.asarray(J @ state.cov[:6, :6] @ J.T)


def _described(orb: cv2.ORB, image: Image, xy: Float, angle_deg: float) -> tuple[Float, Words, Int]:
    """Points (K, 2) px, their descriptors (K, 4), and (K,) which of the given ``xy`` (N, 2) px each is, or -1.

    Points too near to the border to be described are left out.
    """
    given = [cv2.KeyPoint(x, y, _PATCH_PX, angle_deg, 0, 0, i) for i, (x, y) in enumerate(xy.tolist())]
    found = list(orb.detect(image))
    for corner in found:
        corner.angle, corner.class_id = angle_deg, -1
    kept, descriptors = orb.compute(image, given + found)
    if descriptors is None:
        return np.empty((0, 2)), np.empty((0, 4), np.uint64), np.empty(0, np.int64)
    places, which = np.array([corner.pt for corner in kept]), np.array([corner.class_id for corner in kept], np.int64)
    return places, descriptors.view(np.uint64), which


def image_angle_deg(R_WC: Float) -> float:
    """Direction in the image, degrees from its x axis towards its y axis, that stands for the same one in the world.

    It is that of gravity, and of the world's x axis where the camera looks steeply up or down.
    """
    direction_C = R_WC[2] if np.hypot(R_WC[2, 0], R_WC[2, 1]) > _STEEP else R_WC[0]
    return float(np.degrees(np.arctan2(-direction_C[1], -direction_C[0])))
