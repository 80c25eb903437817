"""Loop closure by binary descriptors and a pose graph over x, y, z and yaw, as in VINS-Mono (Qin, Li, Shen, 2018)."""

from collections.abc import Mapping

from vioframe.interfaces import LoopCloser, LoopCloserFactory
from vioframe.parts.hooks import hookimpl
from vioframe.parts.options import plugin_factory
from vioframe.types import Calibration
from vioframe_pose_graph.options import PoseGraphOptions


def pose_graph(calibration: Calibration, options: PoseGraphOptions) -> LoopCloser:
    """Recognises places by ORB descriptors and corrects position and yaw by a pose graph that lets wrong loops go."""
    from vioframe_pose_graph.closer import PoseGraph, warm_up

    warm_up()
    return PoseGraph(calibration, options)


@hookimpl
def vioframe_loop_closers() -> Mapping[str, LoopCloserFactory]:
    return {"pose_graph": plugin_factory(pose_graph, PoseGraphOptions)}
