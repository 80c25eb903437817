"""Which sightings to believe: those that the odometry's drift can explain, and that agree with one another.

A place may have a twin: shelves, windows, a texture laid out again and again. Its picture verifies as well as the place
itself, so the picture cannot tell; where it would put the body can.

How far the odometry is trusted is what its back-end says of itself, made larger, and a random walk of position and yaw
at least: no right loop may be turned away. Those that are believed are weighed against what it says, or what they show
where that is more: a loop is off, too, and one that always won would harm an odometry that knows better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vioframe.arrays import Bool
from vioframe.geometry.so3 import rotation_z
from vioframe.types import NS_PER_S, Float, Int
from vioframe_pose_graph.graph import GATE, Edges, mahalanobis_squared, residuals, solve, solve_robustly, wrapped
from vioframe_pose_graph.options import PoseGraphOptions
from vioframe_pose_graph.recognition import Sighting

# Each keyframe is tied to as many before it.
_SPAN = 4
# Position also drifts where nothing moves, as far as it would along this many metres a second.
_HOVERING_M_S = 0.1
# As little as this an odometry drifts at best, whatever it says: x, y and z, m after 1 m, and yaw, rad after 1 s.
_LEAST_DRIFT = np.array([0.001, 0.001, 0.001, np.radians(0.003)])
# How many times as far as it says an odometry may have drifted. It may be less than once, as an error that images take
# away again counts twice in what it says, and up to a hundred times where it claims too much.
_TIMES = 0.5 * 1.1 ** np.arange(57)
# Between two segments nothing is known but that the body cannot have gone far.
_LOST_SPEED_M_S, _LOST_M, _LOST_YAW = 5.0, 5.0, 1.0
REPEAT_NS = 3 * NS_PER_S
"""Within which another keyframe must say the same."""
# Patches found to a tenth of a pixel place a camera to a millimetre; but their points were placed by the odometry, and
# what is wrong with them is wrong with many: a fit is off by twice what it says, and by more the farther its views are
# apart. That is what the loops of MH_02, MH_03 and V1_01 show, rendered in worlds for tuning.
_SIGMA_M, _SIGMA_PART, _SIGMA_YAW, _OF_FIT = 0.0005, 0.003, np.radians(0.01), 2.0
# What is wrong with the points is wrong, in part, with all loops by them: each counts as an eighth of one that knew
# nothing of the others. Most are far better than they may be, and some are not: they are off by Cauchy's distribution,
# and the last solution is weighed anew as often. With both the paths of those flights come out best.
_SHARED, _WEIGHED = 8.0, 4


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """N keyframes as the odometry placed them, and how far each step may have led astray.

    ``p`` (N, 3) m; ``drift`` (N, 4, 4) is the covariance that the step to each added to [position yaw] at most, 0 for
    the first, and ``told`` (N, 4, 4) what its back-end says.
    """

    p: Float
    drift: Float
    told: Float

    @classmethod
    def of(cls, t_ns: Int, p: Float, segment: Int, options: PoseGraphOptions, cov: Float | None = None) -> Odometry:
        """``cov`` (N, 4, 4) is that of [position yaw] of each keyframe by the back-end, NaN where it does not say.

        An error of yaw goes on to move all that follows, and counts where it began: ``docs/derivations/pose_graph.md``,
        section 3. Where images have told more than was lost, the step has moved the estimate by what they told.
        """
        dt = np.diff(t_ns, prepend=t_ns[:1]) * 1e-9
        steps = np.diff(p, axis=0, prepend=p[:1])
        way = np.linalg.norm(steps, axis=1) + _HOVERING_M_S * dt
        walked = np.column_stack([way, way, way, dt])
        most = np.array([options.position_drift] * 3 + [np.radians(options.yaw_drift_deg)])
        drift, told = (np.eye(4) * (rate**2 * walked)[:, None] for rate in (most, _LEAST_DRIFT))
        said = np.zeros(len(p), bool)
        if cov is not None:
            added = cov[1:] - _seen_from_afar(cov[:-1], steps[1:])
            said[1:] = np.isfinite(added).all(axis=(1, 2))
            values, vectors = np.linalg.eigh(added[said[1:]])
            added = (vectors * np.abs(values)[:, None]) @ np.swapaxes(vectors, 1, 2)
            drift[said] += options.overconfidence**2 * added
            told[said] += added
        broken = np.diff(segment, prepend=segment[:1]) > 0
        lost = np.full((np.count_nonzero(broken), 4), _LOST_YAW)
        lost[:, :3] = (_LOST_M + _LOST_SPEED_M_S * dt[broken])[:, None]
        drift[broken] = np.eye(4) * lost[:, None] ** 2
        told[broken | ~said] = drift[broken | ~said]
        return cls(p, drift, told)

    def at(self, which: Int) -> Odometry:
        """The keyframes ``which`` (M,), in their order: fewer and longer steps."""
        before = np.concatenate([which[:1], which[:-1]])
        return Odometry(self.p[which], self.cov(before, which), self.as_told().cov(before, which))

    def as_told(self, times: float = 1.0) -> Odometry:
        """The same, drifting no farther than ``times`` what its back-end says."""
        return replace(self, drift=times**2 * self.told)

    def edges(self) -> Edges:
        """Edges from every keyframe to the four before it.

        Four overlapping edges must not count as four measurements. An edge over k steps that drift by v each has the
        variance c k v. A stretch by u a step costs sum_k (k u)^2 / (c k v) = (sum_k k / c) u^2 / v, which is what it
        costs the random walk for c = 1 + 2 + 3 + 4.
        """
        n = len(self.p)
        i, j = np.array([(j - k, j) for j in range(n) for k in range(1, min(_SPAN, j) + 1)], np.int64).reshape(-1, 2).T
        share = _SPAN * (_SPAN + 1) / 2
        return Edges(i, j, self.p[j] - self.p[i], np.zeros(len(i)), share * self.cov(i, j))

    def cov(self, i: Int, j: Int) -> Float:
        """(M, 4, 4) covariance of [position yaw] of keyframes j (M,) as seen from keyframes i (M,), i <= j.

        An error of yaw of step k swings keyframe j around keyframe k. All swung to one place, what the steps from i + 1
        to j added is a difference of running sums.
        """
        lever = self.p - self.p.mean(axis=0)  # short, where no digits are lost
        running = np.cumsum(_seen_from_afar(self.drift, -lever), axis=0)
        return _seen_from_afar(running[j] - running[i], lever[j])


def measured(sightings: Sequence[Sighting]) -> Edges:
    """What the sightings (S,) say, as edges from the earlier to the later keyframe."""
    relations = [sighting.relation for sighting in sightings]
    z = np.array([relation.z for relation in relations]).reshape(-1, 3)
    cov = _OF_FIT**2 * np.array([relation.cov for relation in relations]).reshape(-1, 4, 4)
    variance = _SIGMA_M**2 + _SIGMA_PART**2 * np.sum(z**2, axis=1)
    cov[:, [0, 1, 2], [0, 1, 2]] += variance[:, None]
    cov[:, 3, 3] += _SIGMA_YAW**2
    i, j = np.array([(s.earlier, s.later) for s in sightings], np.int64).reshape(-1, 2).T
    return Edges(i, j, z, np.array([relation.yaw for relation in relations]), cov)


def within_drift(loops: Edges, odometry: Odometry) -> Bool:
    """(S,) whether what a loop says is as near to what the odometry says as its drift can explain."""
    cov = odometry.cov(loops.i, loops.j) + loops.cov
    return np.asarray(mahalanobis_squared(_innovation(loops, odometry), cov) < GATE)


def agreed(loops: Edges, odometry: Odometry, t_ns: Int) -> Bool:
    """(S,) whether another keyframe, soon before or after, says the same as a loop, and its own nothing else.

    The loops come in the order of their later keyframes.
    """
    later = loops.j
    a, b = _soon_after(t_ns[later])
    agree = _disagreement(loops, odometry, a, b) < GATE
    own = later[a] == later[b]
    repeated, contradicted = np.zeros(len(later), bool), np.zeros(len(later), bool)
    for side in (a, b):
        repeated[side[agree & ~own]] = True
        contradicted[side[~agree & own]] = True
    return np.asarray(repeated & ~contradicted)


def corrected(odometry: Odometry, loops: Edges, trusted: Bool) -> tuple[Float, Float, Bool]:
    """Positions (N, 3), yaws (N,) and which of the ``loops`` (L,) were believed; ``trusted`` (L,) as for
    :func:`~vioframe_pose_graph.graph.solve_robustly`.
    """
    p, yaw, used = solve_robustly(odometry.p, odometry.edges(), loops, trusted)
    if used.any():
        believed = loops.select(used)
        edges, worth = _as_shown(odometry, believed).edges(), np.ones(len(believed))
        for _ in range(_WEIGHED):
            weighed = replace(believed, cov=(_SHARED / worth)[:, None, None] * believed.cov)
            p, yaw = solve(p, yaw, edges + weighed)
            worth = 5.0 / (1.0 + np.sum(residuals(p, yaw, believed)[0] ** 2, axis=1))  # Cauchy's of four
    return p, yaw, used


def _as_shown(odometry: Odometry, loops: Edges) -> Odometry:
    """The odometry drifting as told, or as much farther as ``loops`` (L,) show.

    Their squared Mahalanobis distances from where it puts them are four in the mean if it drifts as is assumed.
    """
    error, told = _innovation(loops, odometry), odometry.as_told().cov(loops.i, loops.j)
    for times in _TIMES:
        if mahalanobis_squared(error, times**2 * told + loops.cov).mean() <= 4.0:
            break
    return odometry.as_told(times)


def _innovation(loops: Edges, odometry: Odometry) -> Float:
    """(L, 4) how far from where the odometry puts them the loops put their later bodies, and how they turn them."""
    return np.column_stack([loops.z - (odometry.p[loops.j] - odometry.p[loops.i]), loops.turn])


def _soon_after(t_ns: Int) -> tuple[Int, Int]:
    """The pairs (P,), (P,) of which the second comes at most :data:`REPEAT_NS` after the first; ``t_ns`` ascend."""
    ends = np.searchsorted(t_ns, t_ns + REPEAT_NS, side="right")
    a = np.repeat(np.arange(len(t_ns)), ends - np.arange(len(t_ns)) - 1)
    b = np.concatenate([np.empty(0, np.int64), *(np.arange(k + 1, end) for k, end in enumerate(ends))])
    return a, b


def _disagreement(loops: Edges, odometry: Odometry, a: Int, b: Int) -> Float:
    """(P,) squared Mahalanobis distances between where loops ``b`` (P,) put their later bodies and where loops ``a``
    (P,), no later ones, say that these are.

    Both say how the world in which the later keyframe was placed lies to that of the earlier one; between the two later
    keyframes, and between the two earlier ones, these worlds drifted.
    """
    earlier, later, yaw = loops.i, loops.j, loops.turn
    R = np.zeros((len(a), 4, 4))
    R[:, :3, :3] = rotation_z(yaw[a])
    R[:, 3, 3] = 1.0
    moved = np.einsum("pij,pj->pi", R[:, :3, :3], odometry.p[later[b]] - odometry.p[later[a]])
    p_a, p_b = odometry.p[earlier[a]] + loops.z[a], odometry.p[earlier[b]] + loops.z[b]
    error = np.column_stack([p_a + moved - p_b, wrapped(yaw[a] - yaw[b])])
    between_later = R @ odometry.cov(later[a], later[b]) @ R.transpose(0, 2, 1)
    first, last = np.minimum(earlier[a], earlier[b]), np.maximum(earlier[a], earlier[b])
    between_earlier = _seen_from_afar(odometry.cov(first, last), p_b - odometry.p[last])
    said = _seen_from_afar(loops.cov[a], moved) + loops.cov[b]
    return mahalanobis_squared(error, said + between_later + between_earlier)


def _seen_from_afar(cov: Float, lever: Float) -> Float:
    """The covariances (P, 4, 4) of [position yaw] of points rigidly ``lever`` (P, 3) m away."""
    G = np.broadcast_to(np.eye(4), cov.shape).copy()
    G[:, 0, 3], G[:, 1, 3] = -lever[:, 1], lever[:, 0]
    return np.asarray(G @ cov @ G.transpose(0, 2, 1))
