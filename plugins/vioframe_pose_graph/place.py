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

from vioframe.geometry import so3
from vioframe.types import Float, Image, Int
from vioframe_pose_graph.keyframes import Keyframe

_MAX_SIGMAS = 4.0

Float32 = NDArray[np.float32]
Words = NDArray[np.uint64]

_LEVELS, _SCALE_FACTOR, _FAST_THRESHOLD = 4, 1.3, 12
_PATCH_PX = 31
# Sine of the angle between the optical axis and the vertical below which the world's x axis says what is up.
_STEEP = 0.35
_ITERATIONS = 5
_SIGMA_TURN, _SIGMA_M = np.radians(1.0), 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a keyframe was: its body as the odometry gave it, its camera as its landmarks say.

    ``p_WB_seen`` (3,) m is where the body is by that.
    """

    t_ns: int
    segment: int
    R_WB: Float
    p_WB: Float
    p_WB_seen: Float
    R_WC: Float
    p_WC: Float


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """K described points of a keyframe on the z = 1 plane, some of them with a position ``p_WF`` (K, 3) m, else NaN."""

    xy_normalised: Float32
    p_WF: Float32
    descriptors: Words


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
    R_WC, p_WC, fits = resect(
        p_WF[known], xy_normalised[known], keyframe.R_WC, keyframe.p_WC, sigma, _MAX_SIGMAS * sigma
    )
    p_WF[known[~fits]] = np.nan
    p_WB_seen = state.p_WB + p_WC - keyframe.p_WC
    place = Place(state.t_ns, keyframe.segment, state.R_WB, state.p_WB, p_WB_seen, R_WC, p_WC)
    return place, View(xy_normalised.astype(np.float32), p_WF.astype(np.float32), descriptors)


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
    places = np.array([corner.pt for corner in kept])
    return places, descriptors.view(np.uint64), np.array([corner.class_id for corner in kept], np.int64)


def image_angle_deg(R_WC: Float) -> float:
    """Direction in the image, degrees from its x axis towards its y axis, that stands for the same one in the world.

    It is that of gravity, and of the world's x axis where the camera looks steeply up or down.
    """
    direction_C = R_WC[2] if np.hypot(R_WC[2, 0], R_WC[2, 1]) > _STEEP else R_WC[0]
    return float(np.degrees(np.arctan2(-direction_C[1], -direction_C[0])))


def reprojection(p_WF: Float, xy: Float, R_WC: Float, p_WC: Float) -> tuple[Float, Float]:
    """(M, 2) on the z = 1 plane, and (M, 2, 6) their derivatives by [turn, p_WC]; NaN for points behind the camera.

    The camera is perturbed as ``R_WC <- R_WC Exp(turn)``.
    """
    p_C = (p_WF - p_WC) @ R_WC
    there, J = projected(p_C, np.concatenate([so3.hat(p_C), np.broadcast_to(-R_WC.T, (len(p_C), 3, 3))], axis=2))
    return there - xy, J


def projected(p_C: Float, J_C: Float) -> tuple[Float, Float]:
    """Points (M, 3) on the z = 1 plane, (M, 2), and from the points' derivatives (M, 3, n) those there, (M, 2, n).

    NaN for points behind the camera.
    """
    z = np.where(p_C[:, 2] > 0.0, p_C[:, 2], np.nan)
    xy = p_C[:, :2] / z[:, None]
    return xy, (J_C[:, :2] - xy[:, :, None] * J_C[:, 2:]) / z[:, None, None]


def resect(
    p_WF: Float, xy: Float, R_WC: Float, p_WC: Float, sigma: float, tolerance: float
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """The camera's pose that fits the landmarks (M, 3) seen at ``xy`` (M, 2), and (M,) which of them then fit.

    The pose given is the prior. A landmark is seen to ``sigma``, counts less the further it lies off (Cauchy), and fits
    if it lies within ``tolerance``; both are lengths on the z = 1 plane.
    """
    R, p = R_WC, p_WC
    prior = np.repeat([_SIGMA_TURN**-2, _SIGMA_M**-2], 3)
    for _ in range(_ITERATIONS):
        r, J = reprojection(p_WF, xy, R, p)
        r, J = np.nan_to_num(r), np.nan_to_num(J)
        w = 1.0 / (sigma**2 + np.sum(r**2, axis=1))
        off = np.concatenate([so3.log(R_WC.T @ R), p - p_WC])
        H = np.einsum("m,mki,mkj->ij", w, J, J) + np.diag(prior)
        step = np.linalg.solve(H, -np.einsum("m,mki,mk->i", w, J, r) - prior * off)
        R, p = R @ so3.exp(step[:3]), p + step[3:]
    error = np.linalg.norm(reprojection(p_WF, xy, R, p)[0], axis=1)
    return R, p, np.asarray(error < tolerance)
