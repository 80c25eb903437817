"""Where ROS 2 puts its topics among Zenoh's keys, by the design of rmw_zenoh_cpp and of zenoh-plugin-ros2dds.

Under rmw_zenoh_cpp a message lies at ``DOMAIN/TOPIC/TYPE/HASH``: ``0/imu0/sensor_msgs::msg::dds_::Imu_/RIHS01_`` and 64
digits, or ``TypeHashNotSupported`` under Humble. Who publishes says so by a liveliness token::

    @ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME/TOPIC/TYPE/HASH/QOS

with ``%`` for every slash within a part; a node's ends with its name. The bridge of zenoh-plugin-ros2dds puts a message
at the topic's name alone, and its token has ``§`` for every slash::

    @/SESSION/@ros2_lv/KIND/TOPIC/TYPE/QOS
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal

Kind = Literal["NN", "MP", "MS"]
"""Of what a token speaks: a node, one who publishes a topic, one who subscribes to it."""

NO_HASH = "TypeHashNotSupported"
"""What Humble says, whose types have no hashes yet."""

# rmw_zenoh_cpp's way of writing quality of service, where what is left out is the default: reliable, volatile, of the
# last so many messages. 1 for durability keeps them for those who come late.
RELIABLE = "::,10:,:,:,,"
LATCHED = ":1:,100:,:,:,,"

_PUBLISHER = "MP"


@dataclass(frozen=True, slots=True)
class Topic:
    """Its ROS ``name`` and ``type``, such as ``/imu0`` and ``sensor_msgs/msg/Imu``, and the ``key`` of its messages.

    The key has ``*`` for the hash: it is the same where who publishes comes again with another version of the type.
    ``type_hash`` is None where the topic comes through a bridge, which has none.
    """

    name: str
    type: str
    key: str
    type_hash: str | None = None


def all_data(domain: int) -> str:
    """Everything that is published under rmw_zenoh_cpp."""
    return f"{domain}/**"


def all_tokens(domain: int) -> tuple[str, ...]:
    """What all who publish say, in either layout."""
    return f"@ros2_lv/{domain}/*/*/*/{_PUBLISHER}/**", f"@/*/@ros2_lv/{_PUBLISHER}/**"


def topic(domain: int, name: str, message_type: str, type_hash: str) -> Topic:
    """A topic under rmw_zenoh_cpp."""
    return Topic(name, message_type, f"{domain}/{name.strip('/')}/{_dds_name(message_type)}/*", type_hash)


def exactly(topic: Topic) -> str:
    """The key to publish at, of a topic whose hash is told."""
    return f"{topic.key.removesuffix('*')}{topic.type_hash}"


def of_data(key: str) -> Topic | None:
    """The topic of a message at ``key`` under rmw_zenoh_cpp, of any hash; None where it is no topic's."""
    domain, _, rest = key.partition("/")
    name, *end = rest.rsplit("/", 2)
    message_type = _ros_name(end[0]) if len(end) == 2 else None
    if message_type is None or not domain.isdecimal():
        return None
    return topic(int(domain), f"/{name}", message_type, end[1])


def of_token(token: str) -> Topic | None:
    """The topic of whose publisher ``token`` speaks, in either layout; None where it speaks of anything else."""
    match token.split("/"):
        case ["@ros2_lv", domain, _, _, _, "MP", _, _, _, name, type_name, type_hash, *_] if domain.isdecimal():
            if (message_type := _ros_name(type_name)) is not None:
                return topic(int(domain), name.replace("%", "/"), message_type, type_hash)
        case ["@", _, "@ros2_lv", "MP", name, type_name, _]:
            key = name.replace("§", "/")
            return Topic(f"/{key}", type_name.replace("§", "/"), key)
    return None


def token(
    domain: int, session: str, entity: int, kind: Kind, node: str, about: Topic | None = None, qos: str = RELIABLE
) -> str:
    """What a node of that name says of itself, or of what it does with the topic it speaks ``about``."""
    end = ""
    if about is not None:
        end = f"/{about.name.replace('/', '%')}/{_dds_name(about.type)}/{about.type_hash}/{qos}"
    return f"@ros2_lv/{domain}/{session}/0/{entity}/{kind}/%/%/{node}{end}"


def attachment(number: int, t_ns: int, gid: bytes) -> bytes:
    """What goes with a message under rmw_zenoh_cpp: its number, when it was sent, and 16 bytes that tell by whom."""
    return struct.pack("<qqB16s", number, t_ns, len(gid), gid)


def _dds_name(message_type: str) -> str:
    """``sensor_msgs/msg/Imu`` -> ``sensor_msgs::msg::dds_::Imu_``."""
    package, kind, name = message_type.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _ros_name(type_name: str) -> str | None:
    match type_name.split("::"):
        case [package, kind, "dds_", name] if name.endswith("_"):
            return f"{package}/{kind}/{name[:-1]}"
    return None
