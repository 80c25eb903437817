"""Points of one keyframe found in the picture of another, to a tenth of a pixel: what a corner alone does not tell.

Corners are found anew in each picture, to a pixel of the level on which they are found; descriptors say which of them
are one, and no more. Once they have, and it is known about how two keyframes lie to one another, a patch of one is laid
over the other by an affine map, as the front-end does it from image to image (:mod:`vioframe.frontend.anchors`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vioframe.frontend.anchors import Anchors
from vioframe.frontend.lucas_kanade import Pyramid
from vioframe.geometry.cameras import Camera
from vioframe.geometry.two_view import rays
from vioframe.types import Float, Image, Int

_SIDE_PX = 11
# Of a patch between pixels, with one more all round for its gradients.
_CUT_PX = _SIDE_PX + 3
# A patch may have grown to so many times its area, or shrunk to one in so many.
_GROWN = 4.0
_NEAREST = 1e-3


@dataclass(frozen=True, slots=True)
class Picture:
    """An image in which patches are looked for, and the camera that took it."""

    pyramid: Pyramid
    model: Camera

    @staticmethod
    def of(image: Image, model: Camera) -> Picture:
        return Picture(Pyramid.of(image, 0, _SIDE_PX), model)


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """What K points looked like: ``pixels`` (K, 14, 14), and ``xy`` (K, 2) px where in those each lies."""

    pixels: Image
    xy: Float

    @staticmethod
    def of(picture: Picture, xy_normalised: Float) -> Patches:
        """Of the points (K, 2) on the z = 1 plane of a picture."""
        xy = picture.model.distort(xy_normalised) + picture.pyramid.border_px
        first, beside = np.floor(xy).astype(int) - _CUT_PX // 2 + 1, np.arange(_CUT_PX)
        rows, columns = first[:, 1, None] + beside, first[:, 0, None] + beside
        return Patches(picture.pyramid.images[0][rows[:, :, None], columns[:, None, :]], xy - first)

    def select(self, which: Int | slice) -> Patches:
        return Patches(self.pixels[which], self.xy[which])

    def found_in(self, picture: Picture, guess: Float, warp: Float) -> Float:
        """Where they are in a picture, (K, 2) on its z = 1 plane, and NaN where not.

        ``guess`` (K, 2) px is where they ought to be, ``warp`` (K, 2, 2) the map by which they are laid over it.
        """
        grown = warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0]
        tried = picture.model.contains(guess) & (grown > 1.0 / _GROWN) & (grown < _GROWN)
        # One below the other they are an image of their own.
        strip = Pyramid((self.pixels.reshape(-1, _CUT_PX),), 0, _SIDE_PX)
        at = self.xy + np.column_stack([np.zeros(len(self.xy)), _CUT_PX * np.arange(len(self.xy))])
        laid = replace(Anchors.of(strip, at), warp=warp)
        _, xy, held = laid.refine(picture.pyramid, guess, tried)
        found = np.full(guess.shape, np.nan)
        found[held] = picture.model.undistort(xy[held])
        return found


def laid_over(model: Camera, xy: Float, inverse_depth: Float, R_TS: Float, t_TS: Float) -> tuple[Float, Float]:
    """Where a camera that sees points at ``xy`` (N, 2) on its z = 1 plane sees them from elsewhere, (N, 2) px, and by
    which maps (N, 2, 2) their patches are to be laid there; NaN for what is behind it.

    ``p_T = R_TS p_S + t_TS``. Patches face the camera that saw them, at 1 / ``inverse_depth`` (N,) from it, 1/m.
    """
    reach = 0.5 * _SIDE_PX
    px = model.distort(xy)
    there = []
    for beside in ((0.0, 0.0), (reach, 0.0), (0.0, reach)):
        ahead = rays(model.undistort(px + beside)) @ R_TS.T + inverse_depth[:, None] * t_TS
        there.append(model.project(np.where(ahead[:, 2:] > _NEAREST, ahead, np.nan)))
    at, right, down = there
    return at, np.stack([right - at, down - at], axis=2) / reach
