"""Publishes where the body is to ROS 2."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from vioframe.errors import DatasetError
from vioframe.types import Float, ImuSample, NavState
from vioframe_ros2 import keys, messages
from vioframe_ros2.calibration import Transforms
from vioframe_ros2.discovery import Found
from vioframe_ros2.node import Node, Publisher
from vioframe_ros2.odometry import odometry, transform

ODOMETRY_TOPIC, TF_TOPIC = "/vioframe/odometry", "/tf"
WORLD_FRAME = "odom"
"""What W is called: a frame in which the pose drifts and does not jump (REP-105)."""
UNNAMED_IMU = "imu"
"""What the body's frame is called where the readings do not say."""


class Outlet:
    """As nav_msgs/Odometry of the IMU's frame and, ``with_tf``, as a transform, which moves the frame that holds it.

    A frame has one parent: where ``/tf_static`` puts the IMU's into others, the outermost of these moves in W.
    """

    def __init__(self, node: Node, domain: int, found: Found, *, with_tf: bool) -> None:
        def publisher(name: str, message_type: str) -> Publisher:
            hashes = found.imu.type_hash != keys.NO_HASH
            type_hash = messages.type_hash(message_type) if hashes else keys.NO_HASH
            return node.publisher(keys.topic(domain, name, message_type, type_hash))

        self._noise = found.calibration.imu
        self._odometry = publisher(ODOMETRY_TOPIC, messages.ODOMETRY)
        self._tf = publisher(TF_TOPIC, messages.TRANSFORMS) if with_tf else None
        self._statics = Transforms()
        self._frame, self._gyro_B = UNNAMED_IMU, np.zeros(3)
        self._moved: tuple[str, Float, Float] | None = None

    def take_statics(self, data: bytes) -> None:
        """Of /tf_static."""
        with suppress(DatasetError):
            self._statics.add(messages.decoded(data, messages.TRANSFORMS))
            self._moved = None

    def take_reading(self, sample: ImuSample, frame_id: str) -> None:
        """The newest one: what is published next reaches to it."""
        self._gyro_B = sample.gyro_B
        if (frame := frame_id or UNNAMED_IMU) != self._frame:
            self._frame, self._moved = frame, None

    def publish(self, state: NavState) -> None:
        self._odometry.put(odometry(state, self._gyro_B, self._noise, WORLD_FRAME, self._frame))
        if self._tf is not None:
            root, R_BR, p_BR = self._moved_frame()
            R_WR, p_WR = state.R_WB @ R_BR, state.R_WB @ p_BR + state.p_WB
            self._tf.put(transform(state.t_ns, WORLD_FRAME, root, R_WR, p_WR))

    def _moved_frame(self) -> tuple[str, Float, Float]:
        """Its name, R_BR (3, 3) and p_BR (3,)."""
        if self._moved is None:
            root = self._statics.root(self._frame)
            way = self._statics.between(self._frame, root)
            assert way is not None
            self._moved = root, *way
        return self._moved
