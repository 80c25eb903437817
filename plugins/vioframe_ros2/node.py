"""A Zenoh session that others see as a ROS 2 node, ``vioframe``."""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable
from itertools import count
from typing import Any

import zenoh
from zenoh.ext import HistoryConfig, declare_advanced_subscriber

from vioframe.errors import SourceError
from vioframe_ros2 import keys, messages
from vioframe_ros2.keys import Topic

NAME = "vioframe"

# A router that is there answers at once, and whoever closes the source waits no longer than a second.
_CONNECTS_WITHIN_S = 0.8


class Node:
    """Open until :meth:`close`; as a client of whoever listens at ``endpoint``, over whom everything comes and goes.

    Raises :class:`SourceError` where nobody does.
    """

    def __init__(self, endpoint: str, domain: int) -> None:
        self._domain = domain
        settings = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": round(1e3 * _CONNECTS_WITHIN_S),
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 100, "period_increase_factor": 1},
            "scouting/multicast/enabled": False,
        }
        config = zenoh.Config()
        try:
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise SourceError(
                f"no Zenoh router answers at {endpoint}; start it by `ros2 run rmw_zenoh_cpp rmw_zenohd`, or name "
                "where it is, as in ros2:tcp/HOST:7447"
            ) from error
        self._entities = count()
        # What is declared ends when nobody holds it any more.
        self._declared: list[Any] = []
        self._say("NN")

    @property
    def is_connected(self) -> bool:
        if self._session.is_closed():
            return False
        return bool(self._session.info.routers_zid() or self._session.info.peers_zid())

    def close(self) -> None:
        """From any thread, and as often as one likes."""
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def hear_of_topics(self, take: Callable[[Topic], None]) -> None:
        """Have ``take`` called with each topic that is published, now or later, as its publisher says."""

        def heard(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT and (topic := keys.of_token(str(sample.key_expr))) is not None:
                take(topic)

        for tokens in keys.all_tokens(self._domain):
            self._declared.append(self._session.liveliness().declare_subscriber(tokens, heard, history=True))

    def hear_of_data(self, take: Callable[[Topic], None]) -> None:
        """The same for publishers that say nothing of themselves, by what they publish: all of it comes here then."""

        def heard(sample: zenoh.Sample) -> None:
            if (topic := keys.of_data(str(sample.key_expr))) is not None:
                take(topic)

        self._declared.append(self._session.declare_subscriber(keys.all_data(self._domain), heard))

    def subscribe(self, topic: Topic, take: Callable[[bytes], None], *, latched: bool = False) -> None:
        """Have ``take`` called with each message from now on, in a thread of Zenoh's that waits for it.

        Where it is ``latched``, also with those that were published before and are kept for who comes late.
        """

        def heard(sample: zenoh.Sample) -> None:
            take(sample.payload.to_bytes())

        # Cameras may publish to those only who say that they listen.
        self._say("MS", topic, keys.LATCHED if latched else keys.RELIABLE)
        if latched:
            history = HistoryConfig(detect_late_publishers=True)
            self._declared.append(declare_advanced_subscriber(self._session, topic.key, heard, history=history))
        else:
            self._declared.append(self._session.declare_subscriber(topic.key, heard))

    def publisher(self, topic: Topic) -> Publisher:
        self._say("MP", topic)
        return Publisher(self._session.declare_publisher(keys.exactly(topic)))

    def _say(self, kind: keys.Kind, topic: Topic | None = None, qos: str = keys.RELIABLE) -> None:
        """Declare what others are to know; of what comes through a bridge they cannot be told."""
        entity = next(self._entities)
        if topic is None or topic.type_hash is not None:
            token = keys.token(self._domain, str(self._session.info.zid()), entity, kind, NAME, topic, qos)
            self._declared.append(self._session.liveliness().declare_token(token))


class Publisher:
    """Of one topic, as rmw_zenoh_cpp publishes: each message with its number, its time and whom it is from."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._publisher = publisher
        self._gid = secrets.token_bytes(16)
        self._numbers = count(1)

    def put(self, message: Any) -> None:
        attachment = keys.attachment(next(self._numbers), time.time_ns(), self._gid)
        self._publisher.put(messages.encoded(message), attachment=attachment)
