"""A keyframe as it is kept for recognition: where it was, what it saw, and how that looked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Calibration, Float, Image
from vioframe_pose_graph.descriptors import Describer, Words
from vioframe_pose_graph.resection import resect

_MAX_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A frame picked by :class:`~vioframe_pose_graph.keyframes.KeyframeSelector`, in the world of the odometry.

    ``segment`` numbers the stretches of tracking between resets. ``xy`` (N, 2) px are the tracked features, ``p_WF``
    (N, 3) m what is known of them, NaN where nothing is.
    """

    t_ns: int
    segment: int
    R_WB: Float
    p_WB: Float
    image: Image
    xy: Float
    p_WF: Float


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """What recognition needs of a keyframe: K described points on the z = 1 plane, some of them with a position.

    ``p_WF`` (K, 3) m is NaN where unknown. ``R_WC`` and ``p_WC`` are the camera's pose as those points say, and
    ``p_WB_seen`` (3,) m is where the body is by that; ``R_WB`` and ``p_WB`` are its pose as the odometry gave it.
    """

    t_ns: int
    segment: int
    R_WB: Float
    p_WB: Float
    p_WB_seen: Float
    R_WC: Float
    p_WC: Float
    xy_normalised: Float
    p_WF: Float
    descriptors: Words


def describe(keyframe: Keyframe, describer: Describer, calibration: Calibration, sigma_px: float) -> Place:
    """Find and describe the points of ``keyframe``; its landmarks are known to ``sigma_px`` in the image."""
    R_WC = keyframe.R_WB @ calibration.cameras[0].R_BC
    p_WC = keyframe.p_WB + keyframe.R_WB @ calibration.cameras[0].p_BC
    xy, descriptors, which = describer.describe(keyframe.image, keyframe.xy, R_WC)
    xy_normalised = calibration.cameras[0].model.undistort(xy)
    seen = np.isfinite(xy_normalised).all(axis=1)
    xy_normalised, descriptors, which = xy_normalised[seen], descriptors[seen], which[seen]

    p_WF = np.where(which[:, None] >= 0, keyframe.p_WF[which], np.nan)
    known = np.flatnonzero(np.isfinite(p_WF[:, 0]))
    sigma = sigma_px / calibration.cameras[0].model.focal_px
    R_WC, p_WC, fits = resect(p_WF[known], xy_normalised[known], R_WC, p_WC, sigma, _MAX_SIGMAS * sigma)
    p_WF[known[~fits]] = np.nan
    p_WB_seen = p_WC - keyframe.R_WB @ calibration.cameras[0].p_BC
    return Place(
        keyframe.t_ns,
        keyframe.segment,
        keyframe.R_WB,
        keyframe.p_WB,
        p_WB_seen,
        R_WC,
        p_WC,
        xy_normalised,
        p_WF,
        descriptors,
    )
