"""A ROS 2 system as Zenoh sees it, in a process of its own: a rig that flies a recording, and a node that listens.

It speaks the layout of rmw_zenoh_cpp, written down here anew from its design document, so as to tell what the plug-in
has wrong: ``python ros2_publisher.py RECORDING --listen|--connect ENDPOINT OUT.npz``. Until somebody publishes
``/vioframe/odometry`` the rig stands still, with nothing but readings and camera_info; then it prints the time at which
the flight begins, which moves to the clock of the computer, flies it and writes what it published and heard.
With ``--zero NS`` it begins at that time, whoever listens.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np
import zenoh
from rosbags.typesys import Stores, get_typestore
from zenoh.ext import CacheConfig, declare_advanced_publisher

from vioframe.geometry import so3
from vioframe.parts import registry
from vioframe.types import CameraOnBody, Float, FrameSet, ImuSample, Measurement

STORE = get_typestore(Stores.ROS2_JAZZY)
# The body sits in base_link, and so do the cameras: what is known of them goes by way of it.
R_LB, p_LB = so3.exp([0.2, -0.1, 0.5]), np.array([0.05, -0.02, 0.1])
IMU_FRAME, BASE_FRAME = "imu_link", "base_link"
NS_PER_S = 1_000_000_000
# From the moment that somebody listens.
BEGINS_AFTER_NS = NS_PER_S // 4
STILL_NS = 5_000_000
HEARS_ON_S = 1.0


def new(name: str, **fields: Any) -> Any:
    package, _, name = name.partition("/")
    return STORE.types[f"{package}/msg/{name}"](**fields)


def header(t_ns: int, frame_id: str) -> Any:
    stamp = new("builtin_interfaces/Time", sec=t_ns // NS_PER_S, nanosec=t_ns % NS_PER_S)
    return new("std_msgs/Header", stamp=stamp, frame_id=frame_id)


def vector(values: Float) -> Any:
    return new("geometry_msgs/Vector3", **dict(zip("xyz", values.tolist(), strict=True)))


def imu_message(t_ns: int, sample: ImuSample) -> Any:
    return new(
        "sensor_msgs/Imu",
        header=header(t_ns, IMU_FRAME),
        orientation=new("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.r_[-1.0, np.zeros(8)],
        angular_velocity=vector(sample.gyro_B),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector(sample.accel_B),
        linear_acceleration_covariance=np.zeros(9),
    )


def image_message(t_ns: int, camera: str, image: np.ndarray) -> Any:
    height, width = image.shape
    return new(
        "sensor_msgs/Image",
        header=header(t_ns, f"{camera}_optical"),
        height=height,
        width=width,
        encoding="mono8",
        is_bigendian=0,
        step=width,
        data=image.ravel(),
    )


def camera_info(t_ns: int, camera: CameraOnBody) -> Any:
    model = camera.model
    nothing = new("sensor_msgs/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return new(
        "sensor_msgs/CameraInfo",
        header=header(t_ns, f"{camera.name}_optical"),
        height=model.resolution[1],
        width=model.resolution[0],
        distortion_model="plumb_bob" if model.distortion_model == "radtan" else "equidistant",
        d=np.array([*model.distortion, *([0.0] if model.distortion_model == "radtan" else [])]),
        k=model.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.pad(model.K, ((0, 0), (0, 1))).ravel(),
        binning_x=0,
        binning_y=0,
        roi=nothing,
    )


def transform(parent: str, child: str, R: Float, p: Float) -> Any:
    x, y, z, w = so3.to_quat_xyzw(R).tolist()
    moved = new(
        "geometry_msgs/Transform",
        translation=vector(p),
        rotation=new("geometry_msgs/Quaternion", x=x, y=y, z=z, w=w),
    )
    return new("geometry_msgs/TransformStamped", header=header(0, parent), child_frame_id=child, transform=moved)


def static_transforms(cameras: Sequence[CameraOnBody]) -> Any:
    in_base = [
        transform(BASE_FRAME, f"{each.name}_optical", R_LB @ each.R_BC, R_LB @ each.p_BC + p_LB) for each in cameras
    ]
    return new("tf2_msgs/TFMessage", transforms=[transform(BASE_FRAME, IMU_FRAME, R_LB, p_LB), *in_base])


class Node:
    """A ROS 2 node under rmw_zenoh_cpp, in domain 0: a peer that ``listens`` at an endpoint, or is connected to it."""

    def __init__(self, endpoint: str, *, listens: bool) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("timestamping/enabled", "true")
        own = endpoint if listens else "tcp/127.0.0.1:0"
        config.insert_json5("listen/endpoints", f'["{own}"]')
        if not listens:
            config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        self.session = zenoh.open(config)
        self._zid = str(self.session.info.zid())
        self._tokens = [self._token(0, "NN", "")]
        self._numbers: dict[str, int] = {}
        self._publishers: dict[str, Any] = {}
        self._subscribers: list[Any] = []

    def _token(self, entity: int, kind: str, end: str) -> Any:
        return self.session.liveliness().declare_token(f"@ros2_lv/0/{self._zid}/0/{entity}/{kind}/%/%/rig{end}")

    def advertise(
        self,
        topic: str,
        message_type: str,
        *,
        latched: bool = False,
        never_dropped: bool = False,
        says_so: bool = True,
        bridged: bool = False,
    ) -> None:
        """Begin with a topic; ``bridged`` as zenoh-plugin-ros2dds would bring it from a DDS system."""
        package, _, name = message_type.partition("/")
        dds = _dds(message_type)
        qos = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
        token = f"/{topic.replace('/', '%')}/{dds}/{qos}"
        key = f"0{topic}/{dds}"
        if bridged:
            key = topic[1:]
            about = f"{key.replace('/', '§')}/{package}§msg§{name}"
            self._tokens.append(self.session.liveliness().declare_token(f"@/{self._zid}/@ros2_lv/MP/{about}/::,10"))
        elif says_so:
            self._tokens.append(self._token(10 + len(self._tokens), "MP", token))
        if latched:
            publisher = declare_advanced_publisher(
                self.session, key, cache=CacheConfig(max_samples=1), publisher_detection=True
            )
        else:
            control = zenoh.CongestionControl.BLOCK if never_dropped else zenoh.CongestionControl.DROP
            publisher = self.session.declare_publisher(key, congestion_control=control)
        self._publishers[topic] = publisher

    def publish(self, topic: str, message: Any) -> None:
        number = self._numbers[topic] = self._numbers.get(topic, 0) + 1
        attachment = pack("<qqB16s", number, time.time_ns(), 16, b"sixteen bytes...")
        self._publishers[topic].put(bytes(STORE.serialize_cdr(message, message.__msgtype__)), attachment=attachment)

    def hear(self, topic: str, message_type: str) -> list[tuple[bytes, bytes]]:
        """A list that fills with message and attachment, as of a subscriber that knows its type by one hash."""
        heard: list[tuple[bytes, bytes]] = []

        def take(sample: zenoh.Sample) -> None:
            assert sample.attachment is not None
            heard.append((sample.payload.to_bytes(), sample.attachment.to_bytes()))

        self._subscribers.append(self.session.declare_subscriber(f"0{topic}/{_dds(message_type)}", take))
        return heard

    def tokens(self, about: str) -> list[str]:
        """What is said of a topic by those who publish or hear it."""
        replies = self.session.liveliness().get(f"@ros2_lv/0/*/*/*/*/*/*/*/{about.replace('/', '%')}/**", timeout=1.0)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def _dds(message_type: str) -> str:
    package, _, name = message_type.partition("/")
    return f"{package}::msg::dds_::{name}_/{STORE.hash_rihs01(f'{package}/msg/{name}')}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recording", type=Path)
    parser.add_argument("out", type=Path)
    way = parser.add_mutually_exclusive_group(required=True)
    way.add_argument("--listen", metavar="ENDPOINT")
    way.add_argument("--connect", metavar="ENDPOINT")
    parser.add_argument("--zero", type=int)
    chosen = parser.parse_args()

    recording = registry.load().open_dataset(chosen.recording)
    cameras = recording.calibration.cameras
    measurements = list(recording.measurements())
    node = Node(chosen.listen or chosen.connect, listens=chosen.listen is not None)
    node.advertise("/imu0", "sensor_msgs/Imu", never_dropped=True)
    node.advertise("/tf_static", "tf2_msgs/TFMessage", latched=True)
    node.publish("/tf_static", static_transforms(cameras))
    for camera in cameras:
        node.advertise(f"/{camera.name}/image_raw", "sensor_msgs/Image")
        node.advertise(f"/{camera.name}/camera_info", "sensor_msgs/CameraInfo")
    odometry = node.hear("/vioframe/odometry", "nav_msgs/Odometry")
    moved = node.hear("/tf", "tf2_msgs/TFMessage")
    read: list[int] = []

    def put(measurement: Measurement, t_ns: int) -> None:
        if isinstance(measurement, ImuSample):
            read.append(t_ns)
            node.publish("/imu0", imu_message(t_ns, measurement))
        elif isinstance(measurement, FrameSet):
            for camera, image in zip(cameras, measurement.images, strict=True):
                if image is not None:
                    node.publish(f"/{camera.name}/image_raw", image_message(t_ns, camera.name, image))
                    node.publish(f"/{camera.name}/camera_info", camera_info(t_ns, camera))

    zero_ns = chosen.zero or stand_still(node, cameras, next(m for m in measurements if isinstance(m, ImuSample)), put)
    print(zero_ns, flush=True)
    tokens = [*node.tokens("/vioframe/odometry"), *node.tokens("/imu0")]
    late_ns = zero_ns - measurements[0].t_ns
    for measurement in measurements:
        due_ns = measurement.t_ns + late_ns
        time.sleep(max(due_ns - time.time_ns(), 0) / NS_PER_S)
        put(measurement, due_ns)
    time.sleep(HEARS_ON_S)
    np.savez(
        chosen.out,
        readings_ns=read,
        odometry=np.array([np.frombuffer(data, np.uint8) for data, _ in odometry]),
        attachments=np.array([np.frombuffer(attachment, np.uint8) for _, attachment in odometry]),
        tf=np.array([np.frombuffer(data, np.uint8) for data, _ in moved]),
        tokens=tokens,
    )


def stand_still(node: Node, cameras: tuple[CameraOnBody, ...], sample: ImuSample, put: Any) -> int:
    """Until somebody listens, and a little longer; returns when the flight begins, ns."""
    rng = np.random.default_rng(0)
    zero_ns: int | None = None
    due_ns, looked_ns = time.time_ns(), 0
    while zero_ns is None or due_ns < zero_ns:
        noisy = ImuSample(due_ns, sample.gyro_B + rng.normal(0, 1e-3, 3), sample.accel_B + rng.normal(0, 1e-2, 3))
        put(noisy, due_ns)
        if due_ns - looked_ns > 10 * STILL_NS:
            looked_ns = due_ns
            for camera in cameras:
                node.publish(f"/{camera.name}/camera_info", camera_info(due_ns, camera))
            if zero_ns is None and any("/MP/" in token for token in node.tokens("/vioframe/odometry")):
                zero_ns = time.time_ns() + BEGINS_AFTER_NS
        due_ns += STILL_NS
        time.sleep(max(due_ns - time.time_ns(), 0) / NS_PER_S)
    return zero_ns


if __name__ == "__main__":
    sys.exit(main())
