"""The live source: what comes on the topics, and the body's pose back."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cached_property, partial
from queue import Empty, SimpleQueue

import zenoh

from vioframe.errors import DatasetError, SourceError
from vioframe.geometry.trajectory import Trajectory
from vioframe.io import ros
from vioframe.io.images import frame_set
from vioframe.types import Calibration, FrameSet, Measurement, NavState, Unreadable
from vioframe_ros2 import discovery, messages
from vioframe_ros2.discovery import Found, Wanted
from vioframe_ros2.node import Node
from vioframe_ros2.outlet import Outlet
from vioframe_ros2.pairing import Pairing

ROUTER = "tcp/localhost:7447"
"""Where the router of rmw_zenoh_cpp listens."""

# Nothing at all for so long, s, and the source is lost.
_SILENT_S = 2.0
_LOOK_UP_S = 0.1
_CONNECT_EVERY_S = 0.2

Arrival = Callable[[], Measurement | None]
"""What came, to be read by who waits for it, not by Zenoh's threads."""


class Ros2Source:
    """Cameras and an IMU of the ROS 2 system whose router is at ``address``; nothing is opened before it is asked."""

    def __init__(
        self, address: str, domain: int | None, wanted: Wanted, *, bit_depth: int | None, with_tf: bool
    ) -> None:
        self._endpoint = address or ROUTER
        self._domain = _domain_of_environment() if domain is None else domain
        self._wanted, self._bit_depth, self._with_tf = wanted, bit_depth, with_tf
        self._closed = False
        # Both outlive a silence, so that nothing is lost that comes before who reads is back.
        self._node: Node | None = None
        self._arrivals: SimpleQueue[Arrival | None] = SimpleQueue()
        self._outlet: Outlet | None = None
        self._last_ns: int | None = None

    @property
    def name(self) -> str:
        return "ros2"

    @property
    def calibration(self) -> Calibration:
        """Asked for the first time it looks for the topics, ``wait_s`` at most; raises :class:`DatasetError`."""
        return self._found.calibration

    @property
    def frame_count(self) -> int | None:
        return None

    @property
    def ground_truth(self) -> Trajectory | None:
        return None

    def measurements(self) -> Iterator[Measurement]:
        """As they come; of several cameras the images of one stamp come in one set."""
        if self._closed:
            return
        found = self._found
        self._connect()
        pairing = Pairing(len(found.cameras))
        patience_s = max(_SILENT_S, self._wanted.wait_s) if self._last_ns is None else _SILENT_S
        heard_s = time.monotonic()
        while not self._closed:
            try:
                arrival = self._arrivals.get(timeout=_LOOK_UP_S)
            except Empty:
                if time.monotonic() - heard_s > patience_s:
                    yield from pairing.rest()
                    topics = ", ".join(topic.name for topic in (found.imu, *found.cameras))
                    raise SourceError(f"nothing came on {topics} at {self._where} for {patience_s:g} s") from None
                continue
            if arrival is None or (measurement := arrival()) is None:
                continue
            heard_s, patience_s, self._last_ns = time.monotonic(), _SILENT_S, measurement.t_ns
            if isinstance(measurement, FrameSet):
                yield from pairing.add(measurement)
            else:
                yield measurement
        yield from pairing.rest()

    def tell(self, state: NavState) -> None:
        """Publish it."""
        if self._outlet is not None and not self._closed:
            with suppress(zenoh.ZError):  # another thread may close it right now
                self._outlet.publish(state)

    def close(self) -> None:
        self._closed = True
        self._arrivals.put(None)
        if self._node is not None:
            self._node.close()

    @cached_property
    def _found(self) -> Found:
        until_s = time.monotonic() + self._wanted.wait_s
        while True:
            try:
                node = Node(self._endpoint, self._domain)
                break
            except SourceError:
                if time.monotonic() > until_s:
                    raise
            time.sleep(_CONNECT_EVERY_S)
        try:
            return discovery.find(node, self._domain, self._wanted, self._where)
        finally:
            node.close()

    @property
    def _where(self) -> str:
        return f"{self._endpoint}, domain {self._domain}"

    def _connect(self) -> None:
        """Have a node that listens: the one there is, unless whoever it was connected to has gone.

        Raises :class:`SourceError` where nobody is there.
        """
        if self._node is not None:
            if self._node.is_connected:
                return
            self._node.close()
        self._node = node = Node(self._endpoint, self._domain)
        try:
            self._outlet = outlet = Outlet(node, self._domain, self._found, with_tf=self._with_tf)
            node.subscribe(self._found.statics, partial(self._put, outlet.take_statics), latched=True)
            node.subscribe(self._found.imu, partial(self._put, self._reading))
            for place, topic in enumerate(self._found.cameras):
                node.subscribe(topic, partial(self._put, partial(self._frame, place)))
        except zenoh.ZError as error:
            node.close()
            if not self._closed:
                raise SourceError(f"the connection to {self._where} was lost: {error}") from error
        if self._closed:
            node.close()

    def _put(self, read: Callable[[bytes], Measurement | None], data: bytes) -> None:
        self._arrivals.put(partial(read, data))

    def _reading(self, data: bytes) -> Measurement:
        try:
            message = messages.decoded(data, messages.IMU)
        except DatasetError as error:
            return Unreadable(self._last_ns or 0, "imu_unreadable", str(error))
        sample = ros.imu_sample(message)
        if self._outlet is not None:
            self._outlet.take_reading(sample, message.header.frame_id)
        return sample

    def _frame(self, place: int, data: bytes) -> Measurement:
        topic = self._found.cameras[place]
        try:
            message = messages.decoded(data, topic.type)
        except DatasetError as error:
            return Unreadable(self._last_ns or 0, "frame_unreadable", f"{topic.name}: {error}")
        t_ns, where = ros.stamp_ns(message), f"{self._endpoint} [{topic.name}]"
        image = ros.pixels(message, where)
        if image is None:
            return Unreadable(t_ns, "frame_unreadable", f"an image's data on {topic.name} are damaged or incomplete")
        return frame_set(t_ns, image, place, self.calibration, self._bit_depth, where)


def _domain_of_environment() -> int:
    """That of ROS_DOMAIN_ID, as for every node."""
    said = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not said.isdecimal():
        raise DatasetError(f"ROS_DOMAIN_ID is {said!r}, no number; set it right, or say -o domain=0")
    return int(said)
