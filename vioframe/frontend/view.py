"""The points of one camera: followed from image to image, judged, and replaced where they are lost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vioframe.arrays import same_image
from vioframe.frontend.anchors import Anchors
from vioframe.frontend.candidates import CandidateSource
from vioframe.frontend.equalisation import equalise
from vioframe.frontend.flow import follow, predict, returns
from vioframe.frontend.lucas_kanade import Pyramid
from vioframe.frontend.options import FrontendOptions
from vioframe.frontend.refill import spread, thin
from vioframe.geometry import so3, two_view
from vioframe.geometry.cameras import Camera
from vioframe.geometry.two_point import two_point_inliers
from vioframe.incidents import Incidents
from vioframe.interfaces import Detector
from vioframe.stopwatch import Stopwatch
from vioframe.types import Bool, Float, Image, Int

# Standard deviation, in grey levels, below which an image (black, saturated, lens covered) shows nothing but noise.
_FEATURELESS = 3.0
# Turned by so much, a camera shows another image.
_FROZEN_PX = 1.0
# Points closer than this to the edge of the image are dropped: their patches reach beyond it.
BORDER_PX = 5.0
# A point followed there and back must return to within this of where it was.
FORWARD_BACKWARD_PX = 1.0
# Candidates asked of the detector, as a multiple of the points wanted: all over the image, not where contrast is best.
_CANDIDATES_PER_POINT = 6
# The 5-, 7- and 8-point solvers need more points than that before an odd one out can be told.
_FEWEST_TO_JUDGE = 10


@dataclass(frozen=True, slots=True)
class Shown:
    """What an image shows whatever came before it: its contrast spread, and as a pyramid unless that is nothing."""

    image: Image
    pyramid: Pyramid | None

    @staticmethod
    def of(raw: Image, options: FrontendOptions, watch: Stopwatch) -> Shown:
        import cv2

        image = equalise(raw, options.equalisation).view()
        image.flags.writeable = False  # the detector is anybody's code
        is_featureless = cv2.meanStdDev(np.ascontiguousarray(raw[::4, ::4]))[1].item() < _FEATURELESS
        watch.lap("equalise")
        pyramid = None if is_featureless else Pyramid.of(image, options.klt_levels, options.klt_window_px)
        watch.lap("klt")
        return Shown(image, pyramid)


class View:
    """``ids`` (N,), ``xy`` (N, 2) px and ``xy_normalised`` (N, 2) of the points in the newest image of ``camera``."""

    def __init__(self, detector: Detector, camera: Camera, options: FrontendOptions, incidents: Incidents) -> None:
        self._candidates = CandidateSource(detector, camera, BORDER_PX, incidents)
        self._options = options
        self._incidents = incidents
        self._dice = np.random.default_rng(0)
        self._image: Image | None = None
        self._pyramid: Pyramid | None = None
        self._anchors: Anchors | None = None
        self.camera = camera
        self.is_featureless = True
        """Whether the newest image shows nothing that could be followed."""
        self.ids: Int = np.empty(0, np.int64)
        self.xy: Float = np.empty((0, 2))
        self.xy_normalised: Float = np.empty((0, 2))

    @property
    def pyramid(self) -> Pyramid:
        """That of the newest image that shows anything."""
        assert self._pyramid is not None
        return self._pyramid

    def advance(self, shown: Shown, R_C2C1: Float | None, t_ns: int, watch: Stopwatch) -> None:
        """Follow the points to the next image, ``R_C2C1`` (3, 3) being how the camera turned, where that is known."""
        self.is_featureless = shown.pyramid is None
        if shown.pyramid is None:
            self._incidents.add("featureless_image", t_ns)
            self.keep(np.zeros(len(self.ids), bool))
        else:
            self._watch_for_frozen(shown.image, R_C2C1, t_ns)
            xy_normalised_before = self._follow(shown.pyramid, R_C2C1)
            self._pyramid = shown.pyramid
            watch.lap("klt")
            self._reject(xy_normalised_before, R_C2C1)
            watch.lap("reject")
        self._image = shown.image

    def recalibrate(self, camera: Camera) -> None:
        """Count with ``camera`` from the next image on."""
        if camera != self.camera:
            self.camera = camera
            self.xy_normalised = camera.undistort(self.xy)

    def wanted(self, most: int) -> int:
        """How many new points would make them ``most``; none until enough are lost."""
        return most - len(self.ids) if len(self.ids) < self._options.refill_below * most else 0

    def refill(self, next_id: int, t_ns: int, most: int) -> int:
        """Draw new points where there are fewest, once too many of ``most`` are lost; returns the id of the next one.

        They are drawn, not the strongest taken: these lie on outlines more often than others, slide along them and are
        lost, only to be taken again. Of what is drawn, whatever can be followed stays. Of a detector whose score says
        how well a point will be followed, the first are taken.
        """
        options, camera, image = self._options, self.camera, self._image
        assert image is not None
        self.keep(thin(self.xy, self.ids, 0.5 * options.min_distance_px))
        wanted = self.wanted(most)
        if not wanted:
            return next_id
        candidates = self._candidates.ask(image, _CANDIDATES_PER_POINT * options.max_points, t_ns)
        if not self._candidates.best_first:
            candidates = self._dice.permutation(candidates)
        taken = spread(
            candidates,
            self.xy,
            wanted,
            size=camera.resolution,
            min_distance_px=options.min_distance_px,
        )
        xy = candidates[taken]
        xy_normalised, usable = self.undistorted(xy)
        ids = next_id + np.arange(np.sum(usable))
        self.add(ids, xy[usable], xy_normalised[usable])
        return next_id + len(ids)

    def undistorted(self, xy: Float) -> tuple[Float, Bool]:
        """(N, 2) on the z = 1 plane of points (N, 2) px, and which can be followed (N,): they lie well in the image."""
        xy_normalised = self.camera.undistort(xy)
        return xy_normalised, np.isfinite(xy_normalised).all(axis=1) & self.camera.contains(xy, BORDER_PX)

    def add(self, ids: Int, xy: Float, xy_normalised: Float) -> None:
        """Points (N,) that were found in the newest image."""
        self.ids = np.concatenate([self.ids, ids])
        self.xy = np.concatenate([self.xy, xy])
        self.xy_normalised = np.concatenate([self.xy_normalised, xy_normalised])
        if self._options.anchored:
            anchors = Anchors.of(self.pyramid, xy)
            self._anchors = anchors if self._anchors is None else self._anchors.joined(anchors)

    def keep(self, mask: Bool) -> None:
        """Only the points ``mask`` (N,)."""
        if mask.all():
            return
        self.ids, self.xy, self.xy_normalised = self.ids[mask], self.xy[mask], self.xy_normalised[mask]
        if self._anchors is not None:
            self._anchors = self._anchors.keep(mask)

    def _watch_for_frozen(self, image: Image, R_C2C1: Float | None, t_ns: int) -> None:
        """Count an image that is the one before it to the last bit, though the camera turned: it was not taken anew."""
        if R_C2C1 is None or self._image is None or not same_image(image, self._image):
            return
        if self.camera.focal_px * float(np.linalg.norm(so3.log(R_C2C1))) > _FROZEN_PX:
            self._incidents.add("frozen_image", t_ns)

    def _follow(self, pyramid: Pyramid, R_C2C1: Float | None) -> Float:
        """Move all tracks to ``pyramid``, dropping the lost; returns (N, 2) where the others were, normalised."""
        before = self.xy_normalised
        if self._pyramid is None or not len(self.ids):
            return before
        guess = self.xy if R_C2C1 is None else predict(self.camera, self.xy, before, R_C2C1)
        xy, found = follow(self._pyramid, pyramid, self.xy, guess)
        if self._anchors is None:
            found[found] = returns(self._pyramid, pyramid, self.xy[found], xy[found], FORWARD_BACKWARD_PX)
        else:
            # What is not like its anchor any more may be followed on, but most of it has left its landmark.
            self._anchors, xy, found = self._anchors.refine(pyramid, xy, found)
        self.xy = xy
        self.xy_normalised, usable = self.undistorted(self.xy)
        found &= usable
        self.keep(found)
        return before[found]

    def _reject(self, xy_normalised_before: Float, R_C2C1: Float | None) -> None:
        """Drop the tracks that moved as nothing fixed in the world could have."""
        options = self._options
        if options.rejection == "none" or len(self.ids) < _FEWEST_TO_JUDGE:
            return
        threshold = options.rejection_px / self.camera.focal_px
        pair = xy_normalised_before, self.xy_normalised
        if options.rejection == "two_point" and R_C2C1 is not None:
            inliers = two_point_inliers(*pair, R_C2C1, threshold)
        elif options.rejection == "fundamental":
            inliers = two_view.fundamental_inliers(*pair, threshold)
        else:
            inliers = two_view.magsac_inliers(*pair, threshold)
        self.keep(inliers)
