"""How far an odometry is trusted: its drift as a random walk of position and yaw."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.types import Float, Int
from vioframe_pose_graph.graph import Edges, root_of
from vioframe_pose_graph.options import PoseGraphOptions

# Each keyframe is tied to as many before it.
_SPAN = 4
# Position also drifts where nothing moves, as far as it would along this many metres a second.
_HOVERING_M_S = 0.1
# Between two segments nothing is known but that the body cannot have gone far.
_LOST_SPEED_M_S, _LOST_M, _LOST_YAW = 5.0, 5.0, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """N keyframes as the odometry placed them, and the variances that each step added.

    ``p`` (N, 3) m; ``var_p`` (N,) m^2 and ``var_yaw`` (N,) rad^2 of the step that leads to each, 0 for the first.
    """

    p: Float
    var_p: Float
    var_yaw: Float

    @classmethod
    def of(cls, t_ns: Int, p: Float, segment: Int, options: PoseGraphOptions) -> Odometry:
        dt = np.diff(t_ns, prepend=t_ns[:1]) * 1e-9
        way = np.linalg.norm(np.diff(p, axis=0, prepend=p[:1]), axis=1)
        broken = np.diff(segment, prepend=segment[:1]) > 0
        var_p = options.position_drift**2 * (way + _HOVERING_M_S * dt)
        var_yaw = np.radians(options.yaw_drift_deg) ** 2 * dt
        var_p[broken] = (_LOST_M + _LOST_SPEED_M_S * dt[broken]) ** 2
        var_yaw[broken] = _LOST_YAW**2
        return cls(p, var_p, var_yaw)

    def edges(self) -> Edges:
        """Edges from every keyframe to the four before it.

        Four overlapping edges must not count as four measurements. An edge over k steps that drift by v each has the
        variance c k v. A stretch by u a step costs sum_k (k u)^2 / (c k v) = (sum_k k / c) u^2 / v, which is what it
        costs the random walk for c = 1 + 2 + 3 + 4.
        """
        n = len(self.p)
        i, j = np.array([(j - k, j) for j in range(n) for k in range(1, min(_SPAN, j) + 1)], np.int64).reshape(-1, 2).T
        share = _SPAN * (_SPAN + 1) / 2
        sum_p, sum_yaw = np.cumsum(self.var_p), np.cumsum(self.var_yaw)
        cov = np.zeros((len(i), 4, 4))
        cov[:, [0, 1, 2], [0, 1, 2]] = share * (sum_p[j] - sum_p[i])[:, None]
        cov[:, 3, 3] = share * (sum_yaw[j] - sum_yaw[i])
        return Edges(i, j, self.p[j] - self.p[i], np.zeros(len(i)), root_of(cov))

    def cov(self, i: Int, j: Int) -> Float:
        """(M, 4, 4) covariance of [position yaw] of keyframes j (M,) as seen from keyframes i (M,), i <= j.

        A yaw error of step k swings keyframe j around keyframe k: with J_k = [-(y_j - y_k), x_j - x_k, 0, 1] it adds
        var_yaw_k J_k J_k^T. The sums over k from i + 1 to j are differences of running sums.
        """
        xy = self.p[:, :2] - self.p[:, :2].mean(axis=0)  # near the origin, where no digits are lost
        moments = np.column_stack([np.ones(len(xy)), xy, xy**2, xy[:, 0] * xy[:, 1]])
        running = np.cumsum(self.var_yaw[:, None] * moments, axis=0)
        v, vx, vy, vxx, vyy, vxy = (running[j] - running[i]).T
        x, y = xy[j].T
        var_p = np.cumsum(self.var_p)
        cov = np.zeros((len(i), 4, 4))
        cov[:, [0, 1, 2], [0, 1, 2]] = (var_p[j] - var_p[i])[:, None]
        cov[:, 0, 0] += v * y * y - 2.0 * y * vy + vyy
        cov[:, 1, 1] += v * x * x - 2.0 * x * vx + vxx
        cov[:, 0, 1] = cov[:, 1, 0] = -(v * x * y - x * vy - y * vx + vxy)
        cov[:, 0, 3] = cov[:, 3, 0] = vy - v * y
        cov[:, 1, 3] = cov[:, 3, 1] = v * x - vx
        cov[:, 3, 3] = v
        return cov
