"""Images of any kind a recording may hold -> the (H, W) uint8 that a :class:`~vioframe.types.FrameSet` carries.

A reader makes a set of each image as it comes (:func:`frame_set`); :func:`gathered` joins those of one stamp.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from io import BytesIO
from math import inf
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import DatasetError, ImageSizeError
from vioframe.geometry.cameras import Camera
from vioframe.types import Calibration, FrameSet, Image, Measurement

MOST_PIXELS = 1 << 26
"""Of an image file: eight thousand by eight thousand, or 64 MiB in grey."""

_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP", "JPEG2000")

# How many measurements may follow an image before those of the other cameras at its instant are no longer waited for:
# half a second of two cameras at 20 Hz and an IMU at 200 Hz.
_LOOK_AHEAD = 120


def decode_image(data: bytes | NDArray[np.uint8], where: str) -> NDArray[Any] | None:
    """A PNG, JPEG or other image file as it is, channels in OpenCV's order; None where it is damaged.

    A few bytes can decode to gigabytes: :class:`~vioframe.errors.DatasetError`, which begins with ``where``, for an
    image that says it is beyond :data:`MOST_PIXELS`.
    """
    import cv2

    pixels = _declared_pixels(data)
    if pixels is None:
        return None
    if pixels > MOST_PIXELS:
        raise DatasetError(f"{where} says that it has more than {MOST_PIXELS >> 20} million pixels, and is not decoded")
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _declared_pixels(data: bytes | NDArray[np.uint8]) -> float | None:
    """How many by the header of an image file; None where it is damaged or of no format that is decoded."""
    from PIL import Image as Pillow

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Pillow.DecompressionBombWarning)
            width, height = Pillow.open(BytesIO(bytes(data)), formats=_FORMATS).size
    except (Pillow.DecompressionBombError, Pillow.DecompressionBombWarning):
        return inf
    except Exception:  # its readers of headers raise whatever they stumble on
        return None
    return width * height


def to_gray8(image: NDArray[Any], bit_depth: int | None, where: str) -> Image:
    """(H, W) or (H, W, 3 or 4) BGR, uint8 or uint16 -> (H, W) uint8, read-only; gray uint8 is not copied.

    ``bit_depth`` is how many low bits of a 16-bit image carry the signal (12 for values up to 4095). Nothing in the
    file says so, and a wrong guess turns images black: without it a 16-bit image is a
    :class:`~vioframe.errors.DatasetError` that begins with ``where``.
    """
    import cv2

    if image.dtype == np.uint16:
        if bit_depth is None:
            raise DatasetError(f"{where} has 16-bit images; say how many bits are in use, -o bit_depth=8 to 16")
        image = np.minimum(image >> (bit_depth - 8), 255).astype(np.uint8)
    if image.dtype != np.uint8:
        raise DatasetError(f"{where} has images of {image.dtype}; convert them to 8 or 16 bits")
    if image.ndim == 3:
        code = cv2.COLOR_BGRA2GRAY if image.shape[2] == 4 else cv2.COLOR_BGR2GRAY
        image = cv2.cvtColor(image, code)
    image.flags.writeable = False
    return cast(Image, image)


def check_bit_depth(bit_depth: int | None) -> None:
    """Raise :class:`~vioframe.errors.DatasetError` unless the option is None or 8 to 16."""
    if bit_depth is not None and not 8 <= bit_depth <= 16:
        raise DatasetError(f"bit_depth must lie between 8 and 16, not {bit_depth}")


def frame_set(
    t_ns: int, image: NDArray[Any], place: int, calibration: Calibration, bit_depth: int | None, where: str
) -> FrameSet:
    """What the camera at ``place`` in a rig took, as a set without the others; for the image see :func:`to_gray8`.

    Raises :class:`~vioframe.errors.ImageSizeError` where it is not of the size that the camera was calibrated for.
    """
    gray = to_gray8(image, bit_depth, where)
    check_size(gray, calibration.cameras[place].model, where)
    return FrameSet(t_ns, tuple(gray if i == place else None for i in range(len(calibration.cameras))))


def check_size(image: Image, camera: Camera, where: str) -> None:
    """Raise :class:`~vioframe.errors.ImageSizeError`, beginning with ``where``, unless ``camera`` has such images."""
    size = image.shape[1], image.shape[0]
    if size != camera.resolution:
        got, calibrated = ("x".join(map(str, each)) for each in (size, camera.resolution))
        raise ImageSizeError(
            f"{where} has images of {got}, but the calibration is for {calibrated}; "
            "name the right one with --calibration FILE",
            size,
            camera.resolution,
        )


def gathered(measurements: Iterable[Measurement]) -> Iterator[Measurement]:
    """The same measurements in the same order, but images of one stamp joined, in the place of the first of them.

    An incomplete set is held back, and with it what follows, until its other images have come or too much has.
    """
    held: list[Measurement] = []
    for measurement in measurements:
        if not isinstance(measurement, FrameSet) or not _joined(measurement, held):
            held.append(measurement)
        ready = next((i for i, other in enumerate(held) if _incomplete(other)), len(held))
        if len(held) > _LOOK_AHEAD:
            ready = max(ready, 1)
        yield from held[:ready]
        del held[:ready]
    yield from held


def _incomplete(measurement: Measurement) -> bool:
    return isinstance(measurement, FrameSet) and any(image is None for image in measurement.images)


def _joined(frames: FrameSet, held: list[Measurement]) -> bool:
    """Whether a set of the same stamp among ``held`` lacked these images; it now has them."""
    for i, other in enumerate(held):
        if isinstance(other, FrameSet) and other.t_ns == frames.t_ns:
            pairs = list(zip(other.images, frames.images, strict=True))
            if all(one is None or another is None for one, another in pairs):
                held[i] = FrameSet(frames.t_ns, tuple(another if one is None else one for one, another in pairs))
                return True
    return False
