"""Which topics are read, and what is known of the rig: by what others say of themselves, and by what comes."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

import numpy as np

from vioframe.errors import DatasetError, SourceError
from vioframe.io import ros
from vioframe.io.calibration import match_cameras
from vioframe.types import NS_PER_S, Calibration
from vioframe_ros2 import calibration as rig
from vioframe_ros2 import keys, messages
from vioframe_ros2.keys import Topic
from vioframe_ros2.node import Node

_log = logging.getLogger("vioframe.ros2")

STATICS_TOPIC = "/tf_static"
_IMAGES = messages.IMAGE, messages.COMPRESSED

_LOOK_EVERY_S = 0.02
# Topics of nodes that are there are known within milliseconds of each other.
_SETTLED_S = 0.3
# Who says nothing of himself by now does not do so: topics are told by what comes.
_SAYS_SO_WITHIN_S = 1.0
# The rate of the IMU is told by so many readings.
_READINGS = 40


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the options say: ``cameras`` by name, topic or as NAME:TOPIC, None for all; files of a calibration."""

    cameras: Sequence[str] | None
    imu_topic: str | None
    calibration: Sequence[Path]
    wait_s: float

    @property
    def topics(self) -> list[str]:
        """Those that are named."""
        cameras = [camera[camera.index("/") :] for camera in self.cameras or () if "/" in camera]
        return [*cameras, *([self.imu_topic] if self.imu_topic else [])]


@dataclass(frozen=True, slots=True)
class Found:
    """The rig, and the topics of its cameras, in their order, of its IMU, and of what is fixed to what."""

    calibration: Calibration
    cameras: tuple[Topic, ...]
    imu: Topic
    statics: Topic


class _Topics:
    """Those that are known by now; Zenoh's threads add to them."""

    def __init__(self) -> None:
        self._by_name: dict[str, Topic] = {}

    def add(self, topic: Topic) -> None:
        self._by_name.setdefault(topic.name, topic)

    def __getitem__(self, name: str) -> Topic:
        return self._by_name[name]

    def get(self, name: str) -> Topic | None:
        return self._by_name.get(name)

    def names(self) -> list[str]:
        return sorted(self._by_name.copy())

    def of(self, *types: str) -> list[Topic]:
        return [self._by_name[name] for name in self.names() if self._by_name[name].type in types]

    def images(self, named: Sequence[str]) -> list[Topic]:
        """Image topics but those of depth, and compressed ones only where there is nothing else of the camera.

        Those that are ``named`` are always among them.
        """
        found = {topic.name: topic for topic in self.of(*_IMAGES)}

        def counts(name: str) -> bool:
            return name in named or ("depth" not in name.lower() and name.rpartition("/")[0] not in found)

        return [topic for name, topic in found.items() if counts(name)]


@dataclass
class _Published:
    """What has come of the rig by now: CameraInfo by camera, the IMU's frame and stamps, and transforms."""

    infos: dict[str, Any] = field(default_factory=dict)
    imu_frame: str | None = None
    stamps_ns: list[int] = field(default_factory=list)
    transforms: rig.Transforms = field(default_factory=rig.Transforms)

    def take(self, camera: str, message: Any) -> None:
        """A message of any of these types; ``camera`` is whose CameraInfo it is."""
        if message.__msgtype__ == messages.CAMERA_INFO:
            self.infos[camera] = message
        elif message.__msgtype__ == messages.TRANSFORMS:
            self.transforms.add(message)
        else:
            self.imu_frame = message.header.frame_id
            self.stamps_ns.append(ros.stamp_ns(message))

    def is_complete(self, cameras: Iterable[str]) -> bool:
        return (
            self.imu_frame is not None
            and len(self.stamps_ns) >= _READINGS
            and all(name in self.infos for name in cameras)
            and rig.missing_way(self.infos, self.imu_frame, self.transforms) is None
        )


def find(node: Node, domain: int, wanted: Wanted, where: str) -> Found:
    """Look until all is there, ``wait_s`` at most; raises :class:`DatasetError` saying what is missing ``where``."""
    until_s = time.monotonic() + wanted.wait_s
    topics = _await_topics(node, wanted, until_s, where)
    imu = _chosen_imu(topics, wanted)
    images = topics.images(wanted.topics)
    statics = _expected(topics, domain, STATICS_TOPIC, messages.TRANSFORMS)
    noise = rig.noise_alone(wanted.calibration)
    if wanted.calibration and noise is None:
        calibration, sources = match_cameras(wanted.calibration, [topic.name for topic in images], wanted.cameras)
        return Found(calibration, tuple(_of_type(topics[source], _IMAGES) for source in sources), imu, statics)
    cameras = _chosen_cameras(images, wanted)
    info_topics = {
        name: _expected(topics, domain, f"{_camera_base(topic.name)}/camera_info", messages.CAMERA_INFO)
        for name, topic in cameras.items()
    }
    came = _await_calibration(node, imu, statics, info_topics, until_s)
    if noise is None:
        noise = rig.usual_noise(_rate_hz(came.stamps_ns))
        _log.warning("no message tells the noise of the IMU, a usual one is taken; --calibration FILE tells it")
    image_topics = {name: topic.name for name, topic in cameras.items()}
    calibration = rig.published(image_topics, came.infos, came.imu_frame or "", came.transforms, noise)
    return Found(calibration, tuple(cameras.values()), imu, statics)


def camera_name(topic: str) -> str:
    """``/camera/infra1/image_raw/compressed`` -> ``camera_infra1``."""
    parts = _camera_base(topic).strip("/") or topic.strip("/")
    return parts.replace("/", "_")


def _camera_base(topic: str) -> str:
    """What a camera's topics begin with: ``/camera/infra1``."""
    return topic.removesuffix("/compressed").rpartition("/")[0]


def _await_topics(node: Node, wanted: Wanted, until_s: float, where: str) -> _Topics:
    """All there are, once those that are needed are among them."""
    topics = _Topics()

    def missing() -> str | None:
        if absent := [name for name in wanted.topics if topics.get(name) is None]:
            return f"nobody publishes {', '.join(absent)}"
        if not topics.images(wanted.topics):
            return f"nobody publishes images ({' or '.join(_IMAGES)})"
        return None if topics.of(messages.IMU) else f"nobody publishes readings of an IMU ({messages.IMU})"

    begin_s = changed_s = time.monotonic()
    listening, known = False, 0
    node.hear_of_topics(topics.add)
    while True:
        now_s, count = time.monotonic(), len(topics.names())
        if count != known:
            known, changed_s = count, now_s
        if missing() is None and now_s - changed_s > _SETTLED_S:
            return topics
        if now_s > until_s:
            there = ", ".join(topics.names()) or "none"
            raise SourceError(f"{where}: {missing()}; its topics: {there}; is the driver running, in this domain?")
        if not listening and not known and now_s - begin_s > _SAYS_SO_WITHIN_S:
            node.hear_of_data(topics.add)
            listening = True
        time.sleep(_LOOK_EVERY_S)


def _chosen_imu(topics: _Topics, wanted: Wanted) -> Topic:
    if wanted.imu_topic is not None:
        return _of_type(topics[wanted.imu_topic], (messages.IMU,))
    first, *others = topics.of(messages.IMU)
    if others:
        aside = ", ".join(topic.name for topic in others)
        _log.warning("%s is read, %s left aside; to choose: -o imu_topic=%s", first.name, aside, others[0].name)
    return first


def _chosen_cameras(images: Sequence[Topic], wanted: Wanted) -> dict[str, Topic]:
    """The image topics to be read, by the names of their cameras."""
    by_topic = {topic.name: topic for topic in images}
    by_name = {camera_name(topic.name): topic for topic in images}
    if wanted.cameras is None:
        if len(by_name) < len(images):
            raise DatasetError(
                f"several of {', '.join(by_topic)} are of one camera; choose, as by --cameras {images[0].name}"
            )
        return by_name
    chosen = {}
    for each in wanted.cameras:
        name, _, source = each.rpartition(":")
        if source in by_topic:
            chosen[name or camera_name(source)] = by_topic[source]
        elif each in by_name:
            chosen[each] = by_name[each]
        else:
            there = ", ".join(f"{name} ({topic.name})" for name, topic in by_name.items())
            raise DatasetError(f"there is no camera {each!r}; choose of: {there}")
    return chosen


def _of_type(topic: Topic, types: tuple[str, ...]) -> Topic:
    if topic.type not in types:
        raise DatasetError(f"{topic.name} carries {topic.type}, not {' or '.join(types)}; name another topic")
    return topic


def _expected(topics: _Topics, domain: int, name: str, message_type: str) -> Topic:
    """A topic that others tell of, or else one as under rmw_zenoh_cpp that may yet come."""
    return topics.get(name) or keys.topic(domain, name, message_type, messages.type_hash(message_type))


def _await_calibration(
    node: Node, imu: Topic, statics: Topic, info_topics: Mapping[str, Topic], until_s: float
) -> _Published:
    """All that is published of the rig, or what of it there is when the time is over.

    ``info_topics`` are by camera. Raises :class:`SourceError` where one of them or the IMU is silent.
    """
    came = _Published()
    arrivals: SimpleQueue[tuple[str, str, bytes]] = SimpleQueue()

    def listen(topic: Topic, camera: str = "", latched: bool = False) -> None:
        node.subscribe(topic, lambda data: arrivals.put((camera, topic.type, data)), latched=latched)

    listen(imu)
    listen(statics, latched=True)
    for name, topic in info_topics.items():
        listen(topic, name)
    while not came.is_complete(info_topics) and (left_s := until_s - time.monotonic()) > 0.0:
        with suppress(Empty, DatasetError):  # what is damaged comes again
            camera, message_type, data = arrivals.get(timeout=left_s)
            came.take(camera, messages.decoded(data, message_type))
    silent = [] if came.imu_frame is not None else [imu.name]
    silent += [topic.name for name, topic in info_topics.items() if name not in came.infos]
    if silent:
        raise SourceError(f"nothing came on {', '.join(silent)}, which tells the calibration; publish it, {rig.REMEDY}")
    return came


def _rate_hz(stamps_ns: Sequence[int]) -> float:
    """Of readings, by the usual time between two."""
    between_ns = np.median(np.diff(stamps_ns)) if len(stamps_ns) > 1 else 0.0
    return float(NS_PER_S / between_ns) if between_ns > 0.0 else 200.0
