"""Asking a detector, which is anybody's code, for points."""

from __future__ import annotations

import numpy as np

from vioframe.errors import PluginError
from vioframe.geometry.cameras import Camera
from vioframe.incidents import Incidents
from vioframe.interfaces import Detector
from vioframe.types import Float, Image

_FAILURES_BEFORE_GIVING_UP = 10


class CandidateSource:
    """Calls a detector and lets through only what can be used; everything else is counted in ``incidents``.

    A detector that fails now and then costs the points of that frame. One that has never worked by its tenth call is an
    error of the plug-in, raised as :class:`PluginError`.
    """

    def __init__(self, detector: Detector, camera: Camera, border_px: float, incidents: Incidents) -> None:
        self._detector = detector
        self._camera = camera
        self._border_px = border_px
        self._incidents = incidents
        self._failures = 0
        self._has_worked = False
        self.best_first = bool(getattr(detector, "best_first", False))
        """Whether the first candidates are those that will be followed best."""

    def ask(self, image: Image, max_points: int, t_ns: int) -> Float:
        """(N, 2) px, N <= ``max_points``, strongest first: finite and at least ``border_px`` inside the image."""
        try:
            xy = np.asarray(self._detector.detect(image, max_points).xy, dtype=np.float64)
            if xy.ndim != 2 or xy.shape[1] != 2:
                raise ValueError(f"keypoints must be (N, 2), got {xy.shape}")
        except (Exception, SystemExit) as error:  # a plug-in may raise anything
            self._failed(error, t_ns)
            return np.empty((0, 2))
        self._has_worked = True
        if len(xy) > max_points:
            self._incidents.add("detector_too_many_points", t_ns, f"{len(xy)} points, {max_points} asked for")
            xy = xy[:max_points]
        finite = np.isfinite(xy).all(axis=1)
        inside = self._camera.contains(xy)
        if not finite.all():
            self._incidents.add("detector_points_not_finite", t_ns, f"{np.sum(~finite)} of {len(xy)} points")
        if (finite & ~inside).any():
            self._incidents.add("detector_points_outside", t_ns, f"{np.sum(finite & ~inside)} of {len(xy)} points")
        if not len(xy):
            self._incidents.add("detector_found_nothing", t_ns)
        return xy[finite & self._camera.contains(xy, self._border_px)]

    def _failed(self, error: BaseException, t_ns: int) -> None:
        self._failures += 1
        name = type(self._detector).__name__
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        self._incidents.add("detector_failed", t_ns, f"{name}: {reason}")
        if not self._has_worked and self._failures >= _FAILURES_BEFORE_GIVING_UP:
            raise PluginError(
                f"detector {name} failed on each of its first {self._failures} calls ({reason}); "
                "repair the plug-in or choose another detector"
            ) from error
