"""Messages of ROS, of either version, as what vioframe works with."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vioframe.errors import DatasetError
from vioframe.io.images import decode_image
from vioframe.types import NS_PER_S, ImuSample


def stamp_ns(message: Any) -> int:
    """That of the header."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def imu_sample(message: Any) -> ImuSample:
    """Of a sensor_msgs/Imu."""
    w, a = message.angular_velocity, message.linear_acceleration
    return ImuSample(stamp_ns(message), np.array([w.x, w.y, w.z]), np.array([a.x, a.y, a.z]))


def pixels(message: Any, where: str) -> NDArray[Any] | None:
    """Of an image, compressed or not, as :func:`~vioframe.io.images.to_gray8` takes them; None where it is damaged.

    Raises :class:`DatasetError`, beginning with ``where``, for a kind of pixels that is not read.
    """
    return decode_image(message.data, where) if is_compressed(message) else _raw_image(message, where)


def is_compressed(message: Any) -> bool:
    """Whether an image has to be decoded."""
    return not hasattr(message, "encoding")


def _raw_image(message: Any, where: str) -> NDArray[Any] | None:
    """The pixels of a sensor_msgs/Image, mono8 without copying; None where there are fewer than its header says."""
    from rosbags.image import ImageError, message_to_cvimage
    from rosbags.image.image import to_cvtype

    try:
        bits, _, type_name, channels = to_cvtype(message.encoding)
        if bits > 16:
            raise ImageError(f"Format {message.encoding!r} is not supported")
        row_bytes = message.width * channels * np.dtype(type_name).itemsize
        if message.step < row_bytes or message.data.size < message.height * message.step:
            return None
        rows: NDArray[Any] = message.data[: message.height * message.step].reshape(message.height, message.step)[
            :, :row_bytes
        ]
        if message.encoding in ("mono8", "8UC1"):
            return rows
        # rosbags-image takes rows to be contiguous.
        packed = replace(message, data=np.ascontiguousarray(rows).ravel(), step=row_bytes)
        image: NDArray[Any] = message_to_cvimage(packed, "mono16" if bits == 16 else "mono8")
        return image
    except ImageError as err:
        raise DatasetError(f"{where}: {err}; convert the images to mono8, rgb8 or bgr8") from None
