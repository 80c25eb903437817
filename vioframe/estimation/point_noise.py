"""How far tracked points are from where they should be, as their own residuals show it."""

from __future__ import annotations

import numpy as np

from vioframe.arrays import Float, Int

# The noise that is begun with, px, where the least is less, and most of it, were it white. With little at first, a
# filter that was too sure of its first second stays so, and a robust loss does not find that a calibration is off; with
# too much later on, images that contradict the readings pass for noisy ones.
_AT_FIRST_PX, _AT_MOST_PX = 1.0, 1.6
# How many tracks it is found by.
_REMEMBERED = 100
# Views from which on a track tells how its errors last: of fewer its landmark leaves nothing.
_LONG = 6


class PointNoise:
    """The standard deviation of a tracked point, px: at least what the options say, and more where tracks fit worse.

    A gate or a robust loss that takes noise for smaller than it is turns good tracks away, the long ones first; what is
    too large for a while does less harm, and so it begins. Errors that last from one sighting to the next, as those of
    a blurred patch do, tell a filter that takes them for white less than as many others would, and so count for more.
    """

    def __init__(self, least_px: float) -> None:
        self._least_px = least_px
        self.begin()

    def begin(self) -> None:
        """Forget what was found; of a body at rest it says little about the flight to come."""
        self.px, self._ratio = max(_AT_FIRST_PX, self._least_px), 1.0

    @property
    def lasting_px(self) -> float:
        """What of ``px`` lasts from one sighting to the next: 0 where errors are white."""
        return max(self._ratio - 1.0, 0.0) * self.px

    def add(self, squares: Float, views: Int, ratios: Float | None = None) -> None:
        """Go by what (N,) tracks are off by, seen by ``views`` (N,): sums of squares, in standard deviations.

        Not all that is accepted, which would agree with any noise; of several the middle one is no outlier. Each counts
        for one of the last ``_REMEMBERED``; those of zero for none. The variance ``ratios`` (N,) say how errors last:
        sums of successive ones over what they were if white. As landmarks take up much of what lasts, the square of
        that is what noise is larger by (``docs/derivations/msckf.md``).
        """
        found = squares > 0.0
        if ratios is not None and len(told := ratios[found & (views >= _LONG) & (ratios > 0.0)]):
            self._ratio += len(told) / (len(told) + _REMEMBERED) * (told.mean() - self._ratio)
        if found.any():
            # A landmark takes up three of two residuals a view; where the noise is right, this is 1 in the middle.
            dof = 2.0 * views[found] - 3.0
            excess = float(np.median(squares[found] / (dof - 2.0 / 3.0)))
            share = len(dof) / (len(dof) + _REMEMBERED)
            px = self.px * (excess * self._ratio**2) ** (0.5 * share)
            self.px = max(min(px, _AT_MOST_PX * self._ratio), self._least_px)
