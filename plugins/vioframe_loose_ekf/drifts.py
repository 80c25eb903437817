"""How far the vision frame may have come to differ from what it was: what the poses' own noise leaves out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Float
from vioframe_loose_ekf.bootstrap import MEDIAN_DEPTH
from vioframe_loose_ekf.measurement import VisionPose
from vioframe_loose_ekf.options import LooseEkfOptions

# Of a map of two views, which bends as a whole: rotation in units of a pixel's angle, and direction of the first way in
# units of pixel noise by parallax. Measured over 120 starts on simulated flights.
_BIRTH_ROTATION, _BIRTH_DIRECTION = 1.2, 0.7
_LOOK_BACK_S = 0.5
"""Over which standstill is recognised."""


@dataclass(frozen=True, slots=True)
class Drifts:
    """Each a (7,) array of standard deviations: [log-scale, rotation, position] about the anchor.

    Rotation is in rad, position in units of V.
    """

    options: LooseEkfOptions
    focal_px: float

    def at_birth(self, first: VisionPose) -> Float:
        """Of a new vision frame whose first pose is ``first``."""
        o = self.options
        direction = _BIRTH_DIRECTION * o.pixel_sigma / o.bootstrap_parallax_px
        return _stacked(0.0, _BIRTH_ROTATION * o.pixel_sigma / self.focal_px, direction * _length(first.p_VC))

    def since(self, p_VA: Float, keyframe: VisionPose) -> Float:
        """From the last keyframe at ``p_VA`` (3,) to ``keyframe``."""
        o = self.options
        way = _length(keyframe.p_VC - p_VA)
        return _stacked(o.drift_scale, float(np.deg2rad(o.drift_rotation_deg)), o.drift_position * way)

    def at_rest(self, duration_s: float) -> Float:
        """While the body passed for still: a picture that creeps less than is noticed is not followed."""
        unnoticed = self.options.standstill_disparity_px / self.focal_px * (duration_s / _LOOK_BACK_S) ** 0.5
        return _stacked(0.0, unnoticed, unnoticed * MEDIAN_DEPTH)


def _stacked(scale: float, rotation: float, position: float) -> Float:
    return np.repeat([scale, rotation, position], [1, 3, 3])


def _length(v: Float) -> float:
    return float(np.linalg.norm(v))
