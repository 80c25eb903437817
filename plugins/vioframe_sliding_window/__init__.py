"""A sliding-window optimiser in the manner of VINS-Mono (Qin, Li, Shen, T-RO 2018), as a back-end."""

from collections.abc import Mapping

from vioframe.interfaces import Backend, BackendFactory
from vioframe.parts.hooks import hookimpl
from vioframe.parts.options import plugin_factory
from vioframe_sliding_window.options import SlidingWindowOptions


def sliding_window(options: SlidingWindowOptions) -> Backend:
    """Tightly coupled non-linear optimisation over a window of keyframes, with a marginalisation prior."""
    from vioframe_sliding_window.backend import SlidingWindow

    return SlidingWindow(options)


@hookimpl
def vioframe_backends() -> Mapping[str, BackendFactory]:
    return {"sliding_window": plugin_factory(sliding_window, SlidingWindowOptions)}
