"""KLT tracking of sparse points in the cameras of a rig, a set of images at a time."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from vioframe.errors import DatasetError
from vioframe.frontend.flow import body_rotation
from vioframe.frontend.options import FrontendOptions
from vioframe.frontend.stereo import Pair, overlapping
from vioframe.frontend.view import Shown, View
from vioframe.incidents import Incidents
from vioframe.interfaces import Detector
from vioframe.stopwatch import Stopwatch
from vioframe.types import MOST_APART_S, NS_PER_S, Calibration, FrameSet, FrameTracks, Image, ImuSegment

# Frames that are prepared at once: more than wait at any rate of a camera, unless its IMU has fallen silent.
_MOST_PREPARED = 8


@dataclass(frozen=True, slots=True)
class _Prepared:
    """``frames``, what each camera's image shows, and the seconds that took by stage."""

    frames: FrameSet
    shown: dict[int, Shown]
    stage_seconds: dict[str, float]


class Frontend:
    """Follows points through the images of a rig's cameras and lets ``detector`` replace those that are lost.

    An id names one landmark for ever, in whichever cameras it is seen: ids only grow, and one that no camera sees any
    more never comes back. What is irregular but handled (an image that shows nothing, a detector that fails) is counted
    in ``incidents``.
    """

    def __init__(
        self, detector: Detector, calibration: Calibration, options: FrontendOptions, incidents: Incidents
    ) -> None:
        self._options = options
        self._views = tuple(View(detector, camera.model, options, incidents) for camera in calibration.cameras)
        self._pairs = overlapping(calibration)
        # How the body has turned since each camera's last image, R_B1B2, and when that was.
        self._turned = [np.eye(3) for _ in self._views]
        self._seen_ns: list[float] = [-math.inf for _ in self._views]
        self._next_id = 0
        self._prepared: dict[int, _Prepared] = {}
        self.stage_seconds: dict[str, float] = {}
        """Seconds that the last call of :meth:`track` spent by stage: equalise, klt, reject, match, detect."""

    def prepare(self, frames: FrameSet) -> None:
        """Do for ``frames`` what takes the images alone, while they wait for readings: :meth:`track` is done sooner."""
        if len(self._prepared) < _MOST_PREPARED:
            with suppress(DatasetError):  # raised in its turn
                self._prepared[id(frames)] = self._prepare(frames)

    def track(self, imu: ImuSegment, frames: FrameSet, calibration: Calibration) -> FrameTracks:
        """The tracks of ``frames``; ``imu`` spans the time since those before, ``calibration`` is as known by then.

        Of the calibration only the cameras' poses on the body are used, where they are known. Raises
        :class:`DatasetError` where an image does not fit the calibration, and :class:`PluginError` where the detector
        has never worked.
        """
        prepared = self._prepared.pop(id(frames), None) or self._prepare(frames)
        self._prepared = {key: kept for key, kept in self._prepared.items() if kept.frames.t_ns > frames.t_ns}
        watch = Stopwatch(prepared.stage_seconds)
        R_B1B2 = body_rotation(imu)
        self._turned = [turned @ R_B1B2 for turned in self._turned]
        seeing = list(prepared.shown)
        for c in seeing:
            camera = calibration.cameras[c]
            R_C2C1 = camera.R_BC.T @ self._turned[c].T @ camera.R_BC if camera.rotation_known else None
            self._views[c].advance(prepared.shown[c], R_C2C1, frames.t_ns, watch)
            self._turned[c], self._seen_ns[c] = np.eye(3), frames.t_ns
        for c in seeing:
            pairs = self._pairs_with(c, frames.t_ns)
            most = self._most_points(pairs)
            for pair, apart_s in pairs:
                pair.match(self._views, calibration, self._turned[pair.first], apart_s, most)
                watch.lap("match")
            if not self._views[c].is_featureless:
                self._next_id = self._views[c].refill(self._next_id, frames.t_ns, most)
                watch.lap("detect")
        self.stage_seconds = watch.seconds
        views = [self._views[c] for c in seeing]
        return FrameTracks(
            frames.t_ns,
            np.concatenate([view.ids for view in views]),
            np.repeat(seeing, [len(view.ids) for view in views]),
            np.concatenate([view.xy for view in views]),
            np.concatenate([view.xy_normalised for view in views]),
        )

    def _pairs_with(self, second: int, t_ns: int) -> list[tuple[Pair, float]]:
        """Those of the camera ``second`` with others that brought an image shortly before ``t_ns``, and how long, s."""
        pairs = [pair for pair in self._pairs if pair.second == second]
        apart = [(pair, (t_ns - self._seen_ns[pair.first]) / NS_PER_S) for pair in pairs]
        return [(pair, apart_s) for pair, apart_s in apart if apart_s <= MOST_APART_S]

    def _most_points(self, pairs: list[tuple[Pair, float]]) -> int:
        """How many points the second camera of ``pairs`` is to follow: fewer where one ahead of it sees the same."""
        shared = (p.overlap for p, _ in pairs if p.first < p.second and not self._views[p.first].is_featureless)
        share = 1.0 - (1.0 - self._options.overlap_share) * max(shared, default=0.0)
        return math.ceil(share * self._options.max_points)

    def recalibrate(self, calibration: Calibration) -> None:
        """Count with the lenses of ``calibration`` from the next images on."""
        for view, camera in zip(self._views, calibration.cameras, strict=True):
            view.recalibrate(camera.model)

    def _prepare(self, frames: FrameSet) -> _Prepared:
        watch, shown = Stopwatch(), {}
        for c, image in enumerate(frames.images):
            if image is not None:
                _check_size(image, self._views[c].camera.resolution)
                shown[c] = Shown.of(image, self._options, watch)
        return _Prepared(frames, shown, watch.seconds)


def _check_size(image: Image, resolution: tuple[int, int]) -> None:
    width, height = resolution
    if image.shape != (height, width) or image.dtype != np.uint8:
        got = "x".join(str(n) for n in image.shape[1::-1]) + f" {image.dtype}"
        raise DatasetError(
            f"image is {got}, but the calibration is for {width}x{height} grey uint8; "
            "use the calibration of this camera, or convert the images"
        )
