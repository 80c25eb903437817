"""KLT tracking of sparse points, one camera frame at a time."""

from __future__ import annotations

import numpy as np

from vioframe.errors import DatasetError
from vioframe.frontend.candidates import CandidateSource
from vioframe.frontend.flow import camera_rotation, equalise, follow, predict
from vioframe.frontend.lucas_kanade import Pyramid
from vioframe.frontend.options import FrontendOptions
from vioframe.frontend.refill import spread, thin
from vioframe.geometry import so3, two_view
from vioframe.geometry.cameras import Camera
from vioframe.incidents import Incidents
from vioframe.interfaces import Detector
from vioframe.stopwatch import Stopwatch
from vioframe.types import Calibration, Float, FrameSet, FrameTracks, Image, ImuSegment, Int

# Standard deviation, in grey levels, below which an image (black, saturated, lens covered) shows nothing but noise.
_FEATURELESS = 3.0
# Turned by so much, a camera shows another image.
_FROZEN_PX = 1.0
# Points closer than this to the edge of the image are dropped: their patches reach beyond it.
_BORDER_PX = 5.0
# A point tracked forth and back must return to within this of where it was.
_FORWARD_BACKWARD_PX = 1.0
# Candidates asked of the detector, as a multiple of the points wanted; most fall near live tracks.
_CANDIDATES_PER_POINT = 3
# The 5-, 7- and 8-point solvers need more points than that before an odd one out can be told.
_FEWEST_TO_JUDGE = 10


class Frontend:
    """Follows points through the images of a rig's camera and lets ``detector`` replace those that are lost.

    An id names one track for ever: ids only grow, and one that is missing from a frame never comes back. What is
    irregular but handled (an image that shows nothing, a detector that fails) is counted in ``incidents``. Raises
    :class:`ConfigError` for a rig of more than one camera.
    """

    def __init__(
        self, detector: Detector, calibration: Calibration, options: FrontendOptions, incidents: Incidents
    ) -> None:
        camera = calibration.single("the front-end").model
        self._candidates = CandidateSource(detector, camera, _BORDER_PX, incidents)
        self._camera = camera
        self._options = options
        self._incidents = incidents
        self._image: Image | None = None
        self._pyramid: Pyramid | None = None
        self._next_id = 0
        self._ids: Int = np.empty(0, np.int64)
        self._xy: Float = np.empty((0, 2))
        self._xy_normalised: Float = np.empty((0, 2))
        self.stage_seconds: dict[str, float] = {}
        """Seconds that the last call of :meth:`track` spent by stage: equalise, klt, reject, detect."""

    def track(self, imu: ImuSegment, frames: FrameSet, calibration: Calibration) -> FrameTracks:
        """The tracks of ``frames``; ``imu`` spans the time since those before, ``calibration`` is the newest there is.

        Of the calibration only the camera's rotation on the body is used, where it is known. Raises
        :class:`DatasetError` where the image does not fit the calibration, and :class:`PluginError` where the detector
        has never worked.
        """
        (raw,) = frames.images
        assert raw is not None  # a camera that brings nothing comes in no set of its own
        self._check(raw)
        watch = Stopwatch()
        image = equalise(raw, self._options.equalisation).view()
        image.flags.writeable = False  # the detector is anybody's code
        watch.lap("equalise")
        if np.std(raw[::4, ::4]) < _FEATURELESS:
            self._incidents.add("featureless_image", frames.t_ns)
            self._keep(np.zeros(len(self._ids), bool))
        else:
            (on_body,) = calibration.cameras
            R_C2C1 = camera_rotation(imu, on_body.R_BC) if on_body.rotation_known else None
            self._watch_for_frozen(image, R_C2C1, frames.t_ns)
            pyramid = Pyramid.of(image, self._options.klt_levels, self._options.klt_window_px)
            xy_normalised_before = self._follow(pyramid, R_C2C1)
            self._pyramid = pyramid
            watch.lap("klt")
            self._reject(xy_normalised_before, R_C2C1)
            watch.lap("reject")
            self._refill(image, frames.t_ns)
            watch.lap("detect")
        self._image = image
        self.stage_seconds = watch.seconds
        return FrameTracks(
            frames.t_ns, self._ids.copy(), np.zeros_like(self._ids), self._xy.copy(), self._xy_normalised.copy()
        )

    def recalibrate(self, camera: Camera) -> None:
        """Count with ``camera`` from the next frame on."""
        if camera != self._camera:
            self._camera = camera
            self._xy_normalised = camera.undistort(self._xy)

    def _check(self, image: Image) -> None:
        width, height = self._camera.resolution
        if image.shape != (height, width) or image.dtype != np.uint8:
            got = "x".join(str(n) for n in image.shape[1::-1]) + f" {image.dtype}"
            raise DatasetError(
                f"image is {got}, but the calibration is for {width}x{height} grey uint8; "
                "use the calibration of this camera, or convert the images"
            )

    def _watch_for_frozen(self, image: Image, R_C2C1: Float | None, t_ns: int) -> None:
        """Count an image that is the one before it to the last bit, though the camera turned: it was not taken anew."""
        if R_C2C1 is None or self._image is None or not np.array_equal(image[::16, ::16], self._image[::16, ::16]):
            return
        turned_px = self._camera.focal_px * float(np.linalg.norm(so3.log(R_C2C1)))
        if turned_px > _FROZEN_PX and np.array_equal(image, self._image):
            self._incidents.add("frozen_image", t_ns)

    def _follow(self, pyramid: Pyramid, R_C2C1: Float | None) -> Float:
        """Move all tracks to ``pyramid``, dropping the lost; returns (N, 2) where the others were, normalised."""
        before = self._xy_normalised
        if self._pyramid is None or not len(self._ids):
            return before
        guess = self._xy if R_C2C1 is None else predict(self._camera, self._xy, before, R_C2C1)
        xy, found = follow(self._pyramid, pyramid, self._xy, guess, _FORWARD_BACKWARD_PX)
        found &= self._camera.contains(xy, _BORDER_PX)
        self._xy = xy
        self._xy_normalised = self._camera.undistort(xy)
        found &= np.isfinite(self._xy_normalised).all(axis=1)
        self._keep(found)
        return before[found]

    def _reject(self, xy_normalised_before: Float, R_C2C1: Float | None) -> None:
        """Drop the tracks that moved as nothing fixed in the world could have."""
        options = self._options
        if options.rejection == "none" or len(self._ids) < _FEWEST_TO_JUDGE:
            return
        threshold = options.rejection_px / self._camera.focal_px
        pair = xy_normalised_before, self._xy_normalised
        if options.rejection == "two_point" and R_C2C1 is not None:
            inliers = two_view.two_point_inliers(*pair, R_C2C1, threshold)
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
        candidates = self._candidates.ask(image, _CANDIDATES_PER_POINT * options.max_points, t_ns)
        taken = spread(
            candidates,
            self._xy,
            options.max_points - len(self._ids),
            size=self._camera.resolution,
            min_distance_px=options.min_distance_px,
        )
        xy = candidates[taken]
        xy_normalised = self._camera.undistort(xy)
        usable = np.isfinite(xy_normalised).all(axis=1) & self._camera.contains(xy, _BORDER_PX)
        ids = self._next_id + np.arange(np.sum(usable))
        self._next_id += len(ids)
        self._ids = np.concatenate([self._ids, ids])
        self._xy = np.concatenate([self._xy, xy[usable]])
        self._xy_normalised = np.concatenate([self._xy_normalised, xy_normalised[usable]])

    def _keep(self, mask: two_view.Mask) -> None:
        self._ids, self._xy, self._xy_normalised = self._ids[mask], self._xy[mask], self._xy_normalised[mask]
