"""Pairing an estimate with the ground truth in time."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import TrajectoryError
from vioframe.geometry.trajectory import Trajectory

Association = Literal["interpolate", "nearest"]


def associate(
    estimate: Trajectory,
    ground_truth: Trajectory,
    method: Association = "interpolate",
    *,
    max_gap_s: float = 0.1,
    max_dt_s: float = 0.01,
) -> tuple[Trajectory, Trajectory]:
    """The poses of both that belong together, pairwise: equally many, in order.

    ``interpolate`` brings the ground truth, the denser of the two, onto the estimate's stamps, across gaps of at most
    ``max_gap_s``. ``nearest`` takes for every pose of the sparser trajectory the nearest in time of the other, at most
    ``max_dt_s`` away, as evo does. Raises :class:`TrajectoryError` where nothing matches.
    """
    if method == "interpolate":
        matched = estimate.select(_nonempty(ground_truth.covers(estimate.t_ns, max_gap_s), estimate, ground_truth))
        return matched, ground_truth.at(matched.t_ns, max_gap_s)
    if method != "nearest":
        raise TrajectoryError(f"unknown association {method!r}; use interpolate or nearest")
    if len(estimate) > len(ground_truth):
        truth, matched = _nearest(ground_truth, estimate, max_dt_s)
        return matched, truth
    return _nearest(estimate, ground_truth, max_dt_s)


def _nearest(sparse: Trajectory, dense: Trajectory, max_dt_s: float) -> tuple[Trajectory, Trajectory]:
    right = np.clip(np.searchsorted(dense.t_ns, sparse.t_ns), 1, max(len(dense) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(dense) - 1)
    closer_left = sparse.t_ns - dense.t_ns[left] <= dense.t_ns[right] - sparse.t_ns
    partner = np.where(closer_left, left, right)
    dt_ns = np.abs(dense.t_ns[partner] - sparse.t_ns)
    # Where two poses want the same partner only the closer one gets it: stable by time, then the first of each group.
    order = np.lexsort((dt_ns, partner))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(partner[order]) > 0
    wins = np.zeros(len(order), dtype=bool)
    wins[order[first]] = True
    keep = _nonempty(wins & (dt_ns <= round(max_dt_s * 1e9)), sparse, dense)
    return sparse.select(keep), dense.select(partner[keep])


def _nonempty(mask: NDArray[np.bool_], a: Trajectory, b: Trajectory) -> NDArray[np.bool_]:
    if not mask.any():
        spans = " and ".join(f"{x.t_ns[0] * 1e-9:.3f} .. {x.t_ns[-1] * 1e-9:.3f} s" for x in (a, b))
        raise TrajectoryError(f"no stamps in common: the trajectories span {spans}; are they of one flight and clock?")
    return mask
