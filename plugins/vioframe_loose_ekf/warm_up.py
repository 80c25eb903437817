"""Compile every kernel of the back-end, or load it from the cache, so that the first frames of a flight do not wait."""

import numpy as np

from vioframe.estimation.initialization import dynamic
from vioframe.types import NS_PER_S, Calibration, FrameTracks, ImuSegment, NavState, g_W
from vioframe_loose_ekf.backend import LooseEkf
from vioframe_loose_ekf.options import LooseEkfOptions

_FRAMES, _PERIOD_NS, _SPEED_M_S, _POINTS = 8, NS_PER_S // 10, 1.0, 60


def warm_up(calibration: Calibration) -> None:
    """Fly sideways past a wall of points, long enough to make a map and a keyframe."""
    dynamic.warm_up(calibration)
    right_W = calibration.R_BC[:, 0]
    rng = np.random.default_rng(0)
    p_CF = rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (_POINTS, 3))
    start = NavState(0, np.eye(3), np.zeros(3), _SPEED_M_S * right_W, np.zeros(3), np.zeros(3), 1e-4 * np.eye(15))
    backend = LooseEkf(calibration, LooseEkfOptions(), start)
    for k in range(_FRAMES):
        t_ns = np.linspace((k - 1) * _PERIOD_NS, k * _PERIOD_NS, 3).astype(np.int64)
        imu = ImuSegment(t_ns, np.zeros((3, 3)), np.tile(-g_W, (3, 1)))
        p_C = p_CF - [_SPEED_M_S * k * _PERIOD_NS / NS_PER_S, 0.0, 0.0]
        xy_normalised = p_C[:, :2] / p_C[:, 2:]
        tracks = FrameTracks(
            int(t_ns[-1]), np.arange(_POINTS), calibration.camera.distort(xy_normalised), xy_normalised
        )
        backend.process(imu, tracks)
