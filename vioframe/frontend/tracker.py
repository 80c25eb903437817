"""KLT tracking of sparse points, one camera frame at a time."""

from __future__ import annotations

import numpy as np

from vioframe.errors import DatasetError
from vioframe.frontend.candidates import CandidateSource
from vioframe.frontend.flow import camera_rotation, equalise, follow, predict
from vioframe.frontend.options import FrontendOptions
from vioframe.frontend.refill import refine_whole_pixels, spread, thin
from vioframe.geometry import two_view
from vioframe.geometry.cameras import Camera
from vioframe.incidents import Incidents
from vioframe.interfaces import Detector
from vioframe.stopwatch import Stopwatch
from vioframe.types import Float, Frame, FrameTracks, Image, ImuSegment, Int

# Standard deviation, in grey levels, below which an image (black, saturated, lens covered) shows nothing but noise.
_FEATURELESS = 3.0
# The 5-, 7- and 8-point solvers need more points than that before an odd one out can be told.
_FEWEST_TO_JUDGE = 10


class Frontend:
    """Follows points through the images of ``camera`` and lets ``detector`` replace those that are lost.

    An id names one track for ever: ids only grow, and one that is missing from a frame never comes back. What is
    irregular but handled (an image that shows nothing, a detector that fails) is counted in ``incidents``.
    """

    def __init__(self, detector: Detector, camera: Camera, options: FrontendOptions, incidents: Incidents) -> None:
        self._candidates = CandidateSource(detector, camera, options.border_px, incidents)
        self._camera = camera
        self._options = options
        self._incidents = incidents
        self._image: Image | None = None
        self._next_id = 0
        self._ids: Int = np.empty(0, np.int64)
        self._xy: Float = np.empty((0, 2))
        self._xy_normalised: Float = np.empty((0, 2))
        self.stage_seconds: dict[str, float] = {}
        """Seconds that the last call of :meth:`track` spent by stage: equalise, klt, reject, detect."""

    def track(self, imu: ImuSegment, frame: Frame, R_BC: Float) -> FrameTracks:
        """The tracks of ``frame``; ``imu`` spans the time since the frame before and ``R_BC`` (3, 3) turns C into B.

        Raises :class:`DatasetError` where the image does not fit the calibration, and :class:`PluginError` where the
        detector has never worked.
        """
        self._check(frame.image)
        watch = Stopwatch()
        image = equalise(frame.image, self._options.equalisation)
        watch.lap("equalise")
        if np.std(frame.image[::4, ::4]) < _FEATURELESS:
            self._incidents.add("featureless_image", frame.t_ns)
            self._keep(np.zeros(len(self._ids), bool))
        else:
            R_C2C1 = camera_rotation(imu, R_BC)
            xy_normalised_before = self._follow(image, R_C2C1)
            watch.lap("klt")
            self._reject(xy_normalised_before, R_C2C1)
            watch.lap("reject")
            self._refill(image, frame.t_ns)
            watch.lap("detect")
        self._image = image
        self.stage_seconds = watch.seconds
        return FrameTracks(frame.t_ns, self._ids.copy(), self._xy.copy(), self._xy_normalised.copy())

    def _check(self, image: Image) -> None:
        width, height = self._camera.resolution
        if image.shape != (height, width) or image.dtype != np.uint8:
            got = "x".join(str(n) for n in image.shape[1::-1]) + f" {image.dtype}"
            raise DatasetError(
                f"image is {got}, but the calibration is for {width}x{height} grey uint8; "
                "use the calibration of this camera, or convert the images"
            )

    def _follow(self, image: Image, R_C2C1: Float) -> Float:
        """Move all tracks into ``image``, dropping the lost; returns (N, 2) where the others were, normalised."""
        before = self._xy_normalised
        if self._image is None or not len(self._ids):
            return before
        options = self._options
        guess = predict(self._camera, self._xy, before, R_C2C1) if options.predict_with_gyro else self._xy
        xy, found = follow(
            self._image,
            image,
            self._xy,
            guess,
            window_px=options.klt_window_px,
            levels=options.klt_levels,
            tolerance_px=options.forward_backward_px,
        )
        found &= self._camera.contains(xy, options.border_px)
        self._xy = xy
        self._xy_normalised = self._camera.undistort(xy)
        found &= np.isfinite(self._xy_normalised).all(axis=1)
        self._keep(found)
        return before[found]

    def _reject(self, xy_normalised_before: Float, R_C2C1: Float) -> None:
        """Drop the tracks that moved as nothing fixed in the world could have."""
        options = self._options
        if options.rejection == "none" or len(self._ids) < _FEWEST_TO_JUDGE:
            return
        threshold = options.rejection_px / self._camera.focal_px
        pair = xy_normalised_before, self._xy_normalised
        if options.rejection == "two_point":
            inliers = two_view.two_point_inliers(*pair, R_C2C1, threshold)
        elif options.rejection == "essential":
            inliers = two_view.essential_inliers(*pair, threshold)
        elif options.rejection == "fundamental":
            inliers = two_view.fundamental_inliers(*pair, threshold)
        else:
            inliers = two_view.magsac_inliers(*pair, threshold)
        self._keep(inliers)

    def _refill(self, image: Image, t_ns: int) -> None:
        """Take new points where there are fewest, once enough tracks are lost."""
        options = self._options
        self._keep(thin(self._xy, self._ids, 0.5 * options.min_distance_px))
        if len(self._ids) >= options.refill_below * options.max_points:
            return
        candidates = self._candidates.ask(image, options.candidates_per_point * options.max_points, t_ns)
        taken = spread(
            candidates,
            self._xy,
            options.max_points - len(self._ids),
            size=self._camera.resolution,
            grid=options.grid,
            min_distance_px=options.min_distance_px,
        )
        xy = refine_whole_pixels(image, candidates[taken], options.subpixel_window_px)
        xy_normalised = self._camera.undistort(xy)
        usable = np.isfinite(xy_normalised).all(axis=1) & self._camera.contains(xy, options.border_px)
        ids = self._next_id + np.arange(np.sum(usable))
        self._next_id += len(ids)
        self._ids = np.concatenate([self._ids, ids])
        self._xy = np.concatenate([self._xy, xy[usable]])
        self._xy_normalised = np.concatenate([self._xy_normalised, xy_normalised[usable]])

    def _keep(self, mask: two_view.Mask) -> None:
        self._ids, self._xy, self._xy_normalised = self._ids[mask], self._xy[mask], self._xy_normalised[mask]
