"""A keyframe as it is kept for recognition: where it was, what it saw, and how that looked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vioframe.geometry.cameras import Camera
from vioframe.types import Float, Image
from vioframe_pose_graph.descriptors import Describer, Words
from vioframe_pose_graph.resection import resect

_MAX_SIGMAS = 4.0

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame picked by :class:`~vioframe_pose_graph.keyframes.KeyframeSelector`, in the world of the odometry.

    ``segment`` numbers the stretches of tracking between resets. ``R_WC`` and ``p_WC`` are the pose of the camera
    ``model`` when the image was taken, by the calibration that the back-end had learned by then. ``xy`` (N, 2) px are
    the tracked features, ``p_WF`` (N, 3) m what is known of them, NaN where nothing is.
    """

    t_ns: int
    segment: int
    R_WB: Float
    p_WB: Float
    R_WC: Float
    p_WC: Float
    model: Camera
    image: Image
    xy: Float
    p_WF: Float


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


def describe(keyframe: Keyframe, describer: Describer, sigma_px: float) -> tuple[Place, View]:
    """Find and describe the points of ``keyframe``; its landmarks are known to ``sigma_px`` in the image."""
    camera, R_WC, p_WC = keyframe.model, keyframe.R_WC, keyframe.p_WC
    xy, descriptors, which = describer.describe(keyframe.image, keyframe.xy, R_WC)
    xy_normalised = camera.undistort(xy)
    seen = np.isfinite(xy_normalised).all(axis=1)
    xy_normalised, descriptors, which = xy_normalised[seen], descriptors[seen], which[seen]

    p_WF = np.where(which[:, None] >= 0, keyframe.p_WF[which], np.nan)
    known = np.flatnonzero(np.isfinite(p_WF[:, 0]))
    sigma = sigma_px / camera.focal_px
    R_WC, p_WC, fits = resect(p_WF[known], xy_normalised[known], R_WC, p_WC, sigma, _MAX_SIGMAS * sigma)
    p_WF[known[~fits]] = np.nan
    p_WB_seen = keyframe.p_WB + p_WC - keyframe.p_WC
    place = Place(keyframe.t_ns, keyframe.segment, keyframe.R_WB, keyframe.p_WB, p_WB_seen, R_WC, p_WC)
    return place, View(xy_normalised.astype(np.float32), p_WF.astype(np.float32), descriptors)
