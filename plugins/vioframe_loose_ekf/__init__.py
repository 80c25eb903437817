"""The loosely coupled back-end: a visual odometry's poses up to scale, fused with the IMU by an extended Kalman filter.

Weiss, Achtelik, Lynen, Chli, Siegwart, "Real-time onboard visual-inertial state estimation and self-calibration of MAVs
in unknown environments", ICRA 2012.
"""

from collections.abc import Mapping

from vioframe.interfaces import Backend, BackendFactory
from vioframe.parts.hooks import hookimpl
from vioframe.parts.options import plugin_factory
from vioframe_loose_ekf.options import LooseEkfOptions


def loose_ekf(options: LooseEkfOptions) -> Backend:
    """Loosely coupled: a visual odometry's poses up to scale, fused with the IMU by an extended Kalman filter."""
    from vioframe_loose_ekf.backend import LooseEkf

    return LooseEkf(options)


@hookimpl
def vioframe_backends() -> Mapping[str, BackendFactory]:
    return {"loose_ekf": plugin_factory(loose_ekf, LooseEkfOptions)}
