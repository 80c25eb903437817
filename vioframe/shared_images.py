"""Images in memory that two processes see."""

from __future__ import annotations

import os
from itertools import accumulate
from mmap import mmap

import numpy as np

from vioframe.types import Calibration, Image


class SharedImages:
    """Images of a rig's cameras in the open file ``descriptor`` that two processes see.

    Each frame takes the place of the oldest: while one is being taken from there and one is being put, ``waiting``
    frames lie between.
    """

    def __init__(self, descriptor: int, calibration: Calibration, waiting: int) -> None:
        self._slots = waiting + 2
        self._shapes = [camera.model.resolution[::-1] for camera in calibration.cameras]
        *self._begins, self._frame_bytes = accumulate((h * w for h, w in self._shapes), initial=0)
        size = self._slots * self._frame_bytes
        os.truncate(descriptor, size)
        self._memory = np.frombuffer(mmap(descriptor, size), np.uint8)
        self._slot = 0

    def put(self, images: tuple[Image | None, ...]) -> tuple[Image | int | None, ...]:
        """Where each image now is; itself, if it is none or not as calibrated, which the front-end will refuse."""
        self._slot = (self._slot + 1) % self._slots
        places: list[Image | int | None] = []
        for image, shape, begin in zip(images, self._shapes, self._begins, strict=True):
            place = self._slot * self._frame_bytes + begin
            if image is None or image.shape != shape or image.dtype != np.uint8:
                places.append(image)
            else:
                self._at(place, shape)[:] = image
                places.append(place)
        return tuple(places)

    def taken(self, places: tuple[Image | int | None, ...]) -> tuple[Image | None, ...]:
        """Copies of what was put: a detector, which is anybody's code, may keep them."""
        return tuple(
            self._at(place, shape).copy() if isinstance(place, int) else place
            for place, shape in zip(places, self._shapes, strict=True)
        )

    def _at(self, place: int, shape: tuple[int, int]) -> Image:
        return self._memory[place : place + shape[0] * shape[1]].reshape(shape)
