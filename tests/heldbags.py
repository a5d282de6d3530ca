# SPDX-License-Identifier: Apache-2.0
"""Bags held in memory, for tests of what is made of the messages: to write them and read them again takes longer than all the rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from graphloc.config import VesselConfig
from graphloc.frontends import bag, inspect
from graphloc.frontends._order import refuse_set_back
from graphloc.frontends._types import MessageTypes
from graphloc.frontends.source import Bag, RawMessage, TopicSummary
from graphloc.recording import Recording
from tests.bagfactory import Item, Messages

# Types whose values a file does not change, as they are all text, integers and 64-bit numbers; others are packed and unpacked.
_AS_MADE = {
    "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/QuaternionStamped", "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/TwistWithCovarianceStamped", "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/Vector3Stamped",
}  # fmt: skip
_MOST_HELD = 8  # bags: the newest; of a test, and of the fixtures of its module
_held: dict[Path, HeldBag] = {}


class HeldBag(Bag):
    """A ROS 2 bag of (topic, recording time in ns, message, or its type and bytes), which no file holds; `path` names it."""

    def __init__(self, path: Path, make: Messages, items: Iterable[Item]) -> None:
        super().__init__(path)
        self.ros1 = False
        self._make, self._items = make, sorted(items, key=lambda item: item[1])
        counts = Counter((topic, _type_of(msg)) for topic, _, msg in self._items)
        self._summary = {topic: TopicSummary(topic, (kind,), count) for (topic, kind), count in counts.items()}
        assert len(self._summary) == len(counts), "messages of two types on one topic"

    def __enter__(self) -> Self:
        self.warnings = []
        connections = [self._connection(summary) for summary in self._summary.values()]
        self._types = MessageTypes(self.name, connections, self.warnings, ros1=False)
        return self

    def _connection(self, of: TopicSummary) -> Connection:
        """Return a topic, with the definition of its messages, as it is read from a file."""
        text, _ = self._make.store.generate_msgdef(of.msgtypes[0], ros_version=2)
        return Connection(
            id=0, topic=of.topic, msgtype=of.msgtypes[0], msgcount=of.messages, digest="",
            owner=None,  # not this bag: it would be in a circle, and with all of its messages left to the garbage collector
            msgdef=MessageDefinition(MessageDefinitionFormat.MSG, text),
            ext=ConnectionExtRosbag2(serialization_format="cdr", offered_qos_profiles=[]),
        )  # fmt: skip

    @property
    def topics(self) -> dict[str, TopicSummary]:
        return dict(sorted(self._summary.items()))

    def messages(self, topics: Collection[str], *, whole: bool = False) -> Iterator[RawMessage]:
        del whole  # no part of it is taken
        began_ns, file = self._items[0][1] if self._items else 0, self.paths[0].name
        for topic, log_ns, msg in self._items:
            if topic in topics:
                yield RawMessage(topic, _type_of(msg), file, log_ns, msg, log_ns - began_ns)

    def refuse_set_back(self, topics: Collection[str]) -> None:
        for topic in topics:
            refuse_set_back(
                topic, self.name, np.array([at for of, at, _ in self._items if of == topic], dtype=np.int64)
            )

    def decode(self, message: RawMessage) -> object:
        msg: Any = message.data
        if message.msgtype in _AS_MADE and not isinstance(msg, tuple):
            return msg
        data = msg[1] if isinstance(msg, tuple) else bytes(self._make.store.serialize_cdr(msg, message.msgtype))
        return self._types.decode(data, message.msgtype)


def _type_of(msg: Any) -> str:
    return str(msg[0] if isinstance(msg, tuple) else msg.__msgtype__)


def hold_bag(path: Path, make: Messages, items: Iterable[Item]) -> Path:
    """As `write_bag`, for `inspect_bag` and `read_recording` of this module, while it is one of the newest."""
    path.mkdir(parents=True)  # a name is given once
    _held[path] = HeldBag(path, make, items)
    while len(_held) > _MOST_HELD:
        del _held[next(iter(_held))]
    return path


def inspect_bag(path: Path) -> inspect.Inspection:
    """Inspect a bag that is held, or a file."""
    return inspect.inspect_bag(_held.get(path, path))


def read_recording(path: Path, config: VesselConfig) -> Recording:
    """Read a bag that is held, or a file."""
    return bag.read_recording(_held.get(path, path), config)
