"""Compile every kernel of the filter, or load it from the cache, so that the first frames of a flight do not wait."""

import numpy as np

from vioframe.estimation.inertial.preintegration import preintegrate
from vioframe.estimation.initialization import dynamic
from vioframe.types import NS_PER_S, Calibration, FrameTracks, ImuSegment, NavState, g_W
from vioframe_msckf.backend import Msckf
from vioframe_msckf.options import MsckfOptions

_FRAMES, _PERIOD_NS, _SPEED_M_S = 6, NS_PER_S // 10, 1.0


def warm_up(calibration: Calibration) -> None:
    """Fly a small filter sideways past a wall of points, long enough to come through every update once."""
    dynamic.warm_up(calibration)
    right_W = calibration.R_BC[:, 0]
    rng = np.random.default_rng(0)
    p_CF = rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (20, 3))
    start = NavState(0, np.eye(3), np.zeros(3), _SPEED_M_S * right_W, np.zeros(3), np.zeros(3), 1e-4 * np.eye(15))
    backend = Msckf(calibration, MsckfOptions(max_clones=4, max_slam_features=5, zero_velocity_update=False), start)
    for k in range(1, _FRAMES + 1):
        t_ns = np.linspace((k - 1) * _PERIOD_NS, k * _PERIOD_NS, 3).astype(np.int64)
        imu = ImuSegment(t_ns, np.zeros((3, 3)), np.tile(-g_W, (3, 1)))
        p_C = p_CF - [_SPEED_M_S * k * _PERIOD_NS / NS_PER_S, 0.0, 0.0]
        xy_normalised = p_C[:, :2] / p_C[:, 2:]
        tracks = FrameTracks(int(t_ns[-1]), np.arange(20), calibration.camera.distort(xy_normalised), xy_normalised)
        backend.process(imu, tracks)
    preintegrate(imu, np.zeros(3), np.zeros(3), calibration.imu)
