"""Place recognition as a recipe: describe a keyframe, retrieve earlier ones that look like it, verify the geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.stopwatch import Stopwatch
from vioframe.types import NS_PER_S, Calibration, Float
from vioframe_pose_graph.descriptors import Describer
from vioframe_pose_graph.index import DescriptorIndex
from vioframe_pose_graph.options import PoseGraphOptions
from vioframe_pose_graph.place import Keyframe, Place, describe
from vioframe_pose_graph.verification import Relation, relate

# Keyframes this near to a candidate look the same, and are not compared as well.
_NEIGHBOURS = 3
# Enough points to know a place by; the tracked features come first.
_ASKED = 300


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """Keyframe ``later`` shows the place of keyframe ``earlier``: their numbers, and how their worlds lie."""

    earlier: int
    later: int
    relation: Relation


class Recogniser:
    """Remembers every keyframe it is given; what it finds depends on their order and on nothing else."""

    def __init__(self, calibration: Calibration, options: PoseGraphOptions) -> None:
        self._calibration, self._options = calibration, options
        self._describer = Describer(options.max_corners)
        self._index = DescriptorIndex()
        self.places: list[Place] = []
        self.sightings: list[Sighting] = []
        self.seconds: dict[str, float] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Look for the place of ``keyframe`` among the earlier ones, then remember it."""
        watch = Stopwatch()
        place = describe(keyframe, self._describer, self._calibration, 0.5 * self._options.reprojection_px)
        watch.lap("describe")
        candidates = self._retrieve(place)
        self._index.add(place.descriptors)
        watch.lap("retrieve")
        for earlier in candidates:
            relation = relate(
                self.places[earlier],
                place,
                self._calibration.cameras[0].model.focal_px,
                self._options.reprojection_px,
                self._options.min_inliers,
            )
            if relation is not None:
                self.sightings.append(Sighting(earlier, len(self.places), relation))
        self.places.append(place)
        watch.lap("verify")
        for stage, seconds in watch.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    def _retrieve(self, place: Place) -> list[int]:
        """Numbers of the earlier keyframes that look most like ``place``, no two of them neighbours."""
        gap_ns = round(self._options.min_gap_s * NS_PER_S)
        before = sum(earlier.t_ns <= place.t_ns - gap_ns for earlier in self.places)
        scores = self._index.similarity(place.descriptors[:_ASKED], before)
        return _peaks(scores, self._options.max_candidates)


def _peaks(scores: Float, count: int) -> list[int]:
    left = scores.copy()
    peaks: list[int] = []
    while len(peaks) < count and left.any():
        best = int(np.argmax(left))
        peaks.append(best)
        left[max(0, best - _NEIGHBOURS) : best + _NEIGHBOURS + 1] = 0.0
    return peaks
