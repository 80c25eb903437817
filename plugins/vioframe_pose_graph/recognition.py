"""Place recognition as a recipe: describe a keyframe, retrieve earlier ones that look like it, verify the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.stopwatch import Stopwatch
from vioframe.types import NS_PER_S, Float
from vioframe_pose_graph.corners import located
from vioframe_pose_graph.keyframes import Keyframe
from vioframe_pose_graph.matching import DescriptorIndex
from vioframe_pose_graph.options import PoseGraphOptions
from vioframe_pose_graph.place import Float32, Place, View, corner_finder, describe
from vioframe_pose_graph.verification import APART_PX, Relation, relate

# Earlier places that each keyframe is compared with in detail: an aliased world has more than one that look alike.
_MOST_CANDIDATES = 3
# Keyframes this near to a candidate look the same, and are not compared as well.
_NEIGHBOURS = 3
# Enough points to know a place by; the tracked features come first.
_ASKED = 300
# Keyframes in which the corners of a new one are looked for, to know where they are.
_LOOKED_BACK = 4
# To which corners are found again, and landmarks lie where a keyframe saw them.
_SIGMA_PX = 0.5
# Places whose looks are remembered: some 80 kB each.
_MOST_REMEMBERED = 2000


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Keyframe ``later`` shows the place of keyframe ``earlier``: their numbers, and how their worlds lie."""

    earlier: int
    later: int
    relation: Relation


class Recogniser:
    """Remembers the keyframes it is given; what it finds depends on their order and on nothing else.

    Of a long flight it remembers how every second place looked, then every fourth, the oldest first, so that memory is
    bounded; where they were it remembers of all.
    """

    def __init__(self, focal_px: float, options: PoseGraphOptions) -> None:
        self._focal_px, self._options = focal_px, options
        self._orb = corner_finder(options.max_corners)
        self._index = DescriptorIndex()
        # How a place looked: points as in its view; its descriptors are rows of the index.
        self._remembered: dict[int, tuple[Float32, Float32, Float32, slice]] = {}
        self.places: list[Place] = []
        self.sightings: list[Sighting] = []
        self.seconds: dict[str, float] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Look for the place of ``keyframe`` among the earlier ones, then remember it."""
        watch = Stopwatch()
        place, view = describe(keyframe, self._orb, _SIGMA_PX)
        watch.lap("describe")
        if before := self._just_before(place):
            view = located(place, view, before, _SIGMA_PX / self._focal_px, APART_PX / self._focal_px)
        watch.lap("locate")
        candidates = self._retrieve(place, view)
        number = len(self.places)
        rows = self._index.add(view.descriptors, number)
        watch.lap("retrieve")
        for earlier in candidates:
            relation = relate(
                (self.places[earlier], self._view(earlier)),
                (place, view),
                self._focal_px,
                self._options.min_inliers,
            )
            if relation is not None:
                self.sightings.append(Sighting(earlier, number, relation))
        self.places.append(place)
        self._remembered[number] = view.xy_normalised, view.p_WF, view.depth_sigma, rows
        if len(self._remembered) > _MOST_REMEMBERED:
            self._thin_out()
        watch.lap("verify")
        for stage, seconds in watch.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    def _just_before(self, place: Place) -> list[tuple[Place, View]]:
        """The last keyframes before ``place``, of one world with it."""
        last = range(max(len(self.places) - _LOOKED_BACK, 0), len(self.places))
        return [(self.places[n], self._view(n)) for n in last if self.places[n].segment == place.segment]

    def _view(self, number: int) -> View:
        xy_normalised, p_WF, depth_sigma, rows = self._remembered[number]
        return View(xy_normalised, p_WF, depth_sigma, self._index.descriptors(rows))

    def _retrieve(self, place: Place, view: View) -> list[int]:
        """Numbers of the earlier keyframes that look most like ``place``, no two of them neighbours."""
        gap_ns = round(self._options.min_gap_s * NS_PER_S)
        before = sum(earlier.t_ns <= place.t_ns - gap_ns for earlier in self.places)
        scores = self._index.similarity(view.descriptors[:_ASKED], before)
        return _peaks(scores, _MOST_CANDIDATES)

    def _thin_out(self) -> None:
        """Forget how every second of the older half of the remembered places looked."""
        old, index = self._remembered, DescriptorIndex()
        older = set(list(old)[1 : len(old) // 2 : 2])
        self._remembered = {}
        for number, (xy_normalised, p_WF, depth_sigma, rows) in old.items():
            if number not in older:
                kept = index.add(self._index.descriptors(rows), number)
                self._remembered[number] = xy_normalised, p_WF, depth_sigma, kept
        self._index = index


def _peaks(scores: Float, count: int) -> list[int]:
    left = scores.copy()
    peaks: list[int] = []
    while len(peaks) < count and left.any():
        best = int(np.argmax(left))
        peaks.append(best)
        left[max(0, best - _NEIGHBOURS) : best + _NEIGHBOURS + 1] = 0.0
    return peaks
