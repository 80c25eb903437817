"""Metric ``evo``: the same error by another's code, evo (https://github.com/MichaelGrupp/evo), to check vioframe's own.

evo is under the GPL-3.0 and no part of vioframe: it is installed apart (``pip install "vioframe[evo]"``) and imported
only where this metric is asked for. A program that is passed on together with evo has to keep to the GPL. Of evo only
``evo.core`` is used, which computes and no more; ``evo.tools`` is left alone, as importing it writes settings into the
user's home and using it sets up logging and matplotlib.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vioframe.errors import PluginError, TrajectoryError
from vioframe.parts.hooks import hookimpl

if TYPE_CHECKING:
    from vioframe.evaluation import Comparison
    from vioframe.geometry.trajectory import Trajectory
    from vioframe.interfaces import MetricFactory


class Evo:
    """ATE by evo (GPL-3.0, an extra), RMSE: aligned by SE(3), by Sim(3), and vioframe's SE(3) figure less evo's."""

    def __init__(self) -> None:
        try:
            from evo.core import metrics, trajectory
        except ModuleNotFoundError as error:
            raise PluginError(
                "metric 'evo' needs evo (GPL-3.0), which is not installed: pip install \"vioframe[evo]\""
            ) from error
        self._metrics, self._trajectory = metrics, trajectory

    def measure(self, comparison: Comparison) -> dict[str, float]:
        """Of the poses that vioframe pairs, with the truth interpolated: what is checked is alignment and error."""
        own_m = comparison.errors.ate_se3_m
        if own_m is None:
            raise TrajectoryError("the body is at rest or moved along one line, which leaves the SE(3) alignment open")
        se3_m, _ = self._ate(comparison, with_scale=False)
        sim3_m, scale = self._ate(comparison, with_scale=True)
        return {"ate_se3_m": se3_m, "ate_sim3_m": sim3_m, "scale": scale, "difference_m": own_m - se3_m}

    def _ate(self, comparison: Comparison, *, with_scale: bool) -> tuple[float, float]:
        """RMSE in m, and the scale."""
        estimate, truth = self._poses(comparison.unaligned), self._poses(comparison.truth)
        _, _, scale = estimate.align(truth, correct_scale=with_scale)
        ape = self._metrics.APE(self._metrics.PoseRelation.translation_part)
        ape.process_data((truth, estimate))
        return float(ape.get_statistic(self._metrics.StatisticsType.rmse)), float(scale)

    def _poses(self, trajectory: Trajectory) -> Any:
        quat_wxyz = trajectory.quat_xyzw[:, [3, 0, 1, 2]]
        return self._trajectory.PosePath3D(trajectory.p_WB.copy(), quat_wxyz)


@hookimpl
def vioframe_metrics() -> Mapping[str, MetricFactory]:
    return {"evo": Evo}
