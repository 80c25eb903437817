"""A keyframe as it is kept for recognition: where it was, what it saw, and how that looked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Calibration, Float, Image
from vioframe_pose_graph.descriptors import Describer, Words


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

    ``p_WF`` (K, 3) m is NaN where unknown. The camera's pose is in the world of the odometry at that time.
    """

    t_ns: int
    segment: int
    R_WB: Float
    p_WB: Float
    R_WC: Float
    p_WC: Float
    xy_normalised: Float
    p_WF: Float
    descriptors: Words


def describe(keyframe: Keyframe, describer: Describer, calibration: Calibration) -> Place:
    """Find and describe the points of ``keyframe``."""
    R_WC = keyframe.R_WB @ calibration.R_BC
    p_WC = keyframe.p_WB + keyframe.R_WB @ calibration.p_BC
    xy, descriptors, which = describer.describe(keyframe.image, keyframe.xy, R_WC)
    xy_normalised = calibration.camera.undistort(xy)
    seen = np.isfinite(xy_normalised).all(axis=1)
    p_WF = np.full((len(xy), 3), np.nan)
    tracked = which >= 0
    p_WF[tracked] = keyframe.p_WF[which[tracked]]
    return Place(
        keyframe.t_ns,
        keyframe.segment,
        keyframe.R_WB,
        keyframe.p_WB,
        R_WC,
        p_WC,
        xy_normalised[seen],
        p_WF[seen],
        descriptors[seen],
    )
