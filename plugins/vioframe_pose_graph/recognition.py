"""Place recognition as a recipe: describe a keyframe, retrieve earlier ones that look like it, verify the geometry."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from vioframe.stopwatch import Stopwatch
from vioframe.types import NS_PER_S, Float
from vioframe_pose_graph.corners import located, seen_again
from vioframe_pose_graph.keyframes import Keyframe
from vioframe_pose_graph.matching import DescriptorIndex
from vioframe_pose_graph.options import PoseGraphOptions
from vioframe_pose_graph.patches import Patches, Picture
from vioframe_pose_graph.place import Float32, Place, View, corner_finder, describe
from vioframe_pose_graph.verification import APART_PX, Relation, aligned, relate

# Earlier places that each keyframe is compared with in detail: an aliased world has more than one that look alike.
_MOST_CANDIDATES = 3
# Keyframes this near to a candidate look the same, and are not compared as well.
_NEIGHBOURS = 3
# Enough points to know a place by; the tracked features come first.
_ASKED = 300
# Keyframes in which the corners of a new one are looked for, to know where they are.
_LOOKED_BACK = 2
# To which corners are found again, and landmarks lie where a keyframe saw them.
_SIGMA_PX = 0.5
# Places whose looks are remembered: some 150 kB each.
_MOST_REMEMBERED = 1500


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Keyframe ``later`` shows the place of keyframe ``earlier``: their numbers, and how their worlds lie."""

    earlier: int
    later: int
    relation: Relation


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """How a place looked: points as in its view, their descriptors as rows of the index, and patches of the known."""

    xy_normalised: Float32
    p_WF: Float32
    depth_sigma: Float32
    rows: slice
    patches: Patches


class Recogniser:
    """Remembers the keyframes it is given; what it finds depends on their order and on nothing else.

    Of a long flight it remembers how every second place looked, then every fourth, the oldest first, so that memory is
    bounded; where they were it remembers of all.
    """

    def __init__(self, focal_px: float, options: PoseGraphOptions) -> None:
        self._focal_px, self._options = focal_px, options
        self._orb = corner_finder(options.max_corners)
        self._index = DescriptorIndex()
        self._remembered: dict[int, _Look] = {}
        self._newest: deque[tuple[Place, View, Picture]] = deque(maxlen=_LOOKED_BACK)
        self.places: list[Place] = []
        self.sightings: list[Sighting] = []
        self.seconds: dict[str, float] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Look for the place of ``keyframe`` among the earlier ones, then remember it."""
        watch = Stopwatch()
        place, view = describe(keyframe, self._orb, _SIGMA_PX)
        picture = Picture.of(keyframe.image, keyframe.model)
        watch.lap("describe")
        patches = Patches.of(picture, view.xy_normalised.astype(np.float64))
        before = [
            (at, seen_again(view, patches, other, shot, at.R_WC.T @ place.R_WC, APART_PX / self._focal_px))
            for at, other, shot in self._newest
            if at.segment == place.segment
        ]
        view = located(place, view, before, _SIGMA_PX / self._focal_px)
        self._newest.append((place, view, picture))
        watch.lap("locate")
        candidates = self._retrieve(place, view)
        number = len(self.places)
        rows = self._index.add(view.descriptors, number)
        watch.lap("retrieve")
        for earlier in candidates:
            seen, least = (self.places[earlier], self._view(earlier)), self._options.min_inliers
            relation = relate(seen, (place, view), self._focal_px, least)
            if relation is not None:
                relation = aligned(relation, seen, self._remembered[earlier].patches, place, picture, least)
                self.sightings.append(Sighting(earlier, number, relation))
        self.places.append(place)
        kept = patches.select(view.known)
        self._remembered[number] = _Look(view.xy_normalised, view.p_WF, view.depth_sigma, rows, kept)
        if len(self._remembered) > _MOST_REMEMBERED:
            self._thin_out()
        watch.lap("verify")
        for stage, seconds in watch.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    def _view(self, number: int) -> View:
        look = self._remembered[number]
        return View(look.xy_normalised, look.p_WF, look.depth_sigma, self._index.descriptors(look.rows))

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
        for number, look in old.items():
            if number not in older:
                rows = index.add(self._index.descriptors(look.rows), number)
                self._remembered[number] = replace(look, rows=rows)
        self._index = index


def _peaks(scores: Float, count: int) -> list[int]:
    left = scores.copy()
    peaks: list[int] = []
    while len(peaks) < count and left.any():
        best = int(np.argmax(left))
        peaks.append(best)
        left[max(0, best - _NEIGHBOURS) : best + _NEIGHBOURS + 1] = 0.0
    return peaks
