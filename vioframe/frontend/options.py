"""What can be chosen about the front-end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from vioframe.errors import ConfigError
from vioframe.frontend.equalisation import Equalisation

Rejection = Literal["none", "fundamental", "magsac", "two_point"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontendOptions:
    """Options of :class:`vioframe.frontend.Frontend`; raises :class:`ConfigError` on a value out of range."""

    max_points: int = 150
    """Tracks kept alive at once in a camera."""
    overlap_share: float = 0.2
    """Share of these that a camera follows where one ahead of it in the rig sees the same: it is there to tell how far
    away things are, for which fewer points will do."""
    min_distance_px: float = 15.0
    """New points keep this far from every track and from each other; of two tracks that come within half of it, the
    younger is dropped."""
    equalisation: Equalisation = "clahe"
    """Contrast equalisation before tracking and detection: none, clahe (local) or histogram (global)."""
    klt_window_px: int = 15
    """Side of the square patch that is followed; odd."""
    klt_levels: int = 4
    """Pyramid levels above the full image."""
    anchored: bool = True
    """Find each patch again as it looked at first, or let go of it, so that points do not slide off their landmarks."""
    rejection: Rejection = "two_point"
    """Epipolar outlier rejection: two_point (the gyroscope gives the rotation to begin from, and two points the
    direction; magsac where it is unknown how the camera is turned, or fewer than four fifths agree), magsac (essential
    matrix by MAGSAC++), fundamental (fundamental matrix by RANSAC, it asks less of the calibration) or none."""
    rejection_px: float = 0.7
    """Largest distance of an inlier from the epipolar geometry, scaled by the focal length."""
    refill_below: float = 0.9
    """New points are looked for once fewer than this share of those that there should be is alive."""

    def __post_init__(self) -> None:
        for name, valid, remedy in (
            ("max_points", self.max_points >= 1, "at least 1"),
            ("overlap_share", 0.0 < self.overlap_share <= 1.0, "in (0, 1]"),
            ("min_distance_px", self.min_distance_px >= 0.0, "zero or more"),
            ("equalisation", self.equalisation in get_args(Equalisation), " or ".join(get_args(Equalisation))),
            ("klt_window_px", self.klt_window_px >= 5 and self.klt_window_px % 2 == 1, "odd and at least 5"),
            ("klt_levels", 0 <= self.klt_levels <= 8, "0 to 8"),
            ("rejection", self.rejection in get_args(Rejection), " or ".join(get_args(Rejection))),
            ("rejection_px", self.rejection_px > 0.0, "more than zero"),
            ("refill_below", 0.0 < self.refill_below <= 1.0, "in (0, 1]"),
        ):
            if not valid:
                raise ConfigError(f"front-end option {name} must be {remedy}, got {getattr(self, name)!r}")
