"""Compiled code of the front-end that is there before the first frame."""

from __future__ import annotations

import cv2
import numpy as np

from vioframe.frontend import anchors, equalisation, lucas_kanade
from vioframe.frontend.options import FrontendOptions
from vioframe.frontend.tracker import Frontend
from vioframe.geometry import two_point
from vioframe.geometry.cameras import Camera
from vioframe.incidents import Incidents
from vioframe.interfaces import Detector
from vioframe.types import NS_PER_S, Calibration, FrameSet, ImuSegment, g_W

_FRAMES, _PERIOD_NS = 3, NS_PER_S // 10


def load_kernels() -> None:
    """Compile those that any detector's points are followed by, or load them: last what a first frame needs first.

    Two processes that are at it from either end each find half of them done.
    """
    ideal = Camera(1.0, 1.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0), (1, 1))
    ideal.distort(ideal.undistort(np.zeros((1, 2))))
    two_point.warm_up()
    anchors.warm_up()
    lucas_kanade.warm_up()
    equalisation.warm_up()


def warm_up(detector: Detector, calibration: Calibration, options: FrontendOptions) -> None:
    """Come once through all that is compiled for following points, or load it.

    A few images at rest are looked at, for detectors compile and load what they need as they see the first of them.
    """
    load_kernels()
    frontend = Frontend(detector, calibration, options, Incidents())
    rng = np.random.default_rng(0)
    sizes = [camera.model.resolution for camera in calibration.cameras]
    images = tuple(cv2.blur(rng.integers(0, 256, (h, w), np.uint8), (5, 5)).astype(np.uint8) for w, h in sizes)
    for k in range(_FRAMES):
        t_ns = np.array([k - 1, k]) * _PERIOD_NS
        frontend.track(ImuSegment(t_ns, np.zeros((2, 3)), np.tile(-g_W, (2, 1))), FrameSet(k, images), calibration)
