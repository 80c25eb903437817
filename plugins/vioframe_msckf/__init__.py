"""The MSCKF back-end: an error-state filter over a window of cloned poses (Mourikis and Roumeliotis, ICRA 2007)."""

from collections.abc import Mapping

from vioframe.interfaces import Backend, BackendFactory
from vioframe.parts.hooks import hookimpl
from vioframe.parts.options import plugin_factory
from vioframe_msckf.options import MsckfOptions


def msckf(options: MsckfOptions) -> Backend:
    """Multi-state constraint Kalman filter with first-estimate Jacobians and in-state landmarks."""
    from vioframe_msckf.backend import Msckf

    return Msckf(options)


@hookimpl
def vioframe_backends() -> Mapping[str, BackendFactory]:
    return {"msckf": plugin_factory(msckf, MsckfOptions)}
