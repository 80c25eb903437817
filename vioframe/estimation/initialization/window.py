"""The frames an initialisation is made from, with their tracks as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from vioframe.estimation.factors.tracks import TrackTable
from vioframe.estimation.inertial.preintegration import join_segments
from vioframe.types import Float, FrameTracks, ImuSegment, Int

Bool = NDArray[np.bool_]
Packet = tuple[ImuSegment, FrameTracks]


@dataclass(frozen=True, slots=True)
class Window:
    """K keyframes, the readings between them, and L tracks.

    ``t_ns`` (K,), ``segments`` K - 1, ``ids`` (L,). ``xy`` (K, L, 2) are points on the z = 1 plane, NaN where ``seen``
    (K, L) is False.
    """

    t_ns: Int
    segments: tuple[ImuSegment, ...]
    ids: Int
    xy: Float
    seen: Bool

    def only(self, keep: Bool) -> Window:
        """The same window with the tracks ``keep`` (L,)."""
        return Window(self.t_ns, self.segments, self.ids[keep], self.xy[:, keep], self.seen[:, keep])

    def without_last(self) -> Window:
        """The same tracks without the newest keyframe."""
        return Window(self.t_ns[:-1], self.segments[:-1], self.ids, self.xy[:-1], self.seen[:-1])


def build_window(packets: Sequence[Packet], chosen: Sequence[int], min_views: int, max_landmarks: int) -> Window:
    """The frames ``chosen``, ascending indices of ``packets``, and the tracks that ``min_views`` or more see."""
    tracks = [packets[k][1] for k in chosen]
    segments = tuple(join_segments([imu for imu, _ in packets[a + 1 : b + 1]]) for a, b in pairwise(chosen))
    table = TrackTable()
    for frame in tracks:
        table.add_frame(frame)
    # The longest first; the older id where they are equally long.
    views = table.lengths()
    order = np.argsort(-views, kind="stable")
    rows = np.sort(order[views[order] >= min_views][:max_landmarks])
    seen = table.seen[rows].T
    xy = np.where(seen[..., None], np.swapaxes(table.xy_normalised[rows], 0, 1), np.nan)
    return Window(np.array([t.t_ns for t in tracks]), segments, table.ids[rows], xy, seen)


def finite_tracks(tracks: FrameTracks) -> FrameTracks:
    """Without the points that could not be undistorted."""
    good = np.isfinite(tracks.xy_normalised).all(axis=1)
    return FrameTracks(tracks.t_ns, tracks.ids[good], tracks.xy[good], tracks.xy_normalised[good])


def spread_indices(t_ns: Int, count: int) -> list[int]:
    """At most ``count`` ascending indices of ``t_ns``, first and last among them, evenly spaced in time."""
    wanted = np.linspace(t_ns[0], t_ns[-1], count)
    nearest = np.abs(t_ns[:, None] - wanted).argmin(axis=0)
    return [int(k) for k in np.unique(nearest)]
