"""Messages of ROS 2, as bytes (CDR) and as what vioframe works with."""

from __future__ import annotations

from functools import cache
from typing import Any

from vioframe.errors import DatasetError
from vioframe.types import NS_PER_S

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
IMU = "sensor_msgs/msg/Imu"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
ODOMETRY = "nav_msgs/msg/Odometry"


@cache
def _store() -> Any:
    """The layouts of messages: those in use here are the same in all versions of ROS 2."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.LATEST)


def decoded(data: bytes, message_type: str) -> Any:
    """The message; raises :class:`DatasetError` where it is damaged."""
    try:
        return _store().deserialize_cdr(data, message_type)
    except Exception as error:  # rosbags reports damage by whatever exception it stumbled on
        raise DatasetError(f"a {message_type} is damaged: {error}") from error


def encoded(message: Any) -> bytes:
    """Its bytes, with the header that says in which order they are."""
    return bytes(_store().serialize_cdr(message, message.__msgtype__))


def new(message_type: str, **fields: Any) -> Any:
    return _store().types[message_type](**fields)


def header(t_ns: int, frame_id: str) -> Any:
    stamp = new("builtin_interfaces/msg/Time", sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
    return new("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def type_hash(message_type: str) -> str:
    """``RIHS01_`` and 64 digits, by which versions of a type are told apart (REP-2016)."""
    return str(_store().hash_rihs01(message_type))
