# SPDX-License-Identifier: Apache-2.0
"""One pass over a bag: each message is decoded for the sensors and references that read its topic."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from graphloc.frontends._clock import corrected_ns
from graphloc.frontends._readings import Readings
from graphloc.frontends._references import Reference
from graphloc.frontends._rejections import Rejection, malformed
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.decode import Decoded, decoder_of
from graphloc.frontends.msgtypes import NO_STAMP, header_stamp_ns, stamp_ns_of
from graphloc.frontends.source import LATEST_NS, TF_MOVING, TF_STATIC, Bag, RawMessage, TopicSummary
from graphloc.ledger import RECORDED_AT, LedgerRow, Outcome
from graphloc.recording import Progress
from graphloc.time import utc_text

_REPORT_EVERY = 2000  # messages between two calls of `progress`


class Reader:
    """One pass over a bag, which gives each message to the sensors and references that read its topic."""

    def __init__(
        self,
        bag: Bag,
        topics: Mapping[str, TopicSummary],
        sensors: Sequence[Readings],
        beside: Sequence[Reference],
        tree: StaticTree | None,
    ) -> None:
        self._bag, self._topics, self._tree = bag, topics, tree
        self._sensors: dict[str, list[Readings]] = {}
        for readings in sensors:
            self._sensors.setdefault(readings.config.topic, []).append(readings)
        self._references: dict[str, list[Reference]] = {}
        for item in beside:
            self._references.setdefault(item.topic, []).append(item)
        self._wanted = set(self._sensors) | set(self._references)
        if tree is not None:
            self._wanted |= {TF_STATIC, TF_MOVING} & set(topics)
        self._rows: list[LedgerRow] = []
        self._seq = 0

    def read(self, progress: Progress | None) -> list[LedgerRow]:
        """Fill the readings of sensors and references; return ledger rows of all messages that give no reading."""
        total = sum(self._topics[t].messages for t in self._wanted)
        read: Counter[str] = Counter()
        for done, raw in enumerate(self._bag.messages(self._wanted), start=1):
            read[raw.topic] += 1
            if raw.topic == TF_MOVING and self._tree is not None:
                self._tree.offer(raw, self._bag.decode)
            else:
                self._take(raw)
            if progress is not None and done % _REPORT_EVERY == 0:
                progress("reading", done, max(total, done))
        if self._tree is not None:
            self._tree.settle()
        if progress is not None:
            progress("reading", total, total)
        return self._rows + self._topic_rows(read)

    def _take(self, raw: RawMessage) -> None:
        msg: Any = None
        broken = malformed("")
        try:
            msg = self._bag.decode(raw)
        except Exception as error:  # noqa: BLE001 - damaged bytes make rosbags raise nearly anything
            broken = malformed(f"{raw.file}: cannot be decoded as {raw.msgtype} ({type(error).__name__}){_when(raw)}")
        for readings in self._sensors.get(raw.topic, ()):
            seq, self._seq = self._seq, self._seq + 1
            if msg is None:
                self._rows.append(readings.row(seq, 0, broken))
            else:
                self._decode(readings, raw, msg, seq)
        for item in self._references.get(raw.topic, ()):
            item.count, item.broken = item.count + 1, item.broken + (msg is None)
            if msg is not None:
                stamp_ns = header_stamp_ns(msg)
                item.unstamped += stamp_ns is None
                item.stamps_ns.append(raw.log_ns if stamp_ns is None else stamp_ns)
                item.logs_ns.append(raw.log_ns)
                item.messages.append(msg)
        if raw.topic == TF_STATIC and self._tree is not None:
            self._tree.take(raw.msgtype, msg)

    def _decode(self, readings: Readings, raw: RawMessage, msg: Any, seq: int) -> None:
        """Decode a message for a sensor; add a ledger row if it gives no reading."""
        stamp_ns = stamp_ns_of(msg, raw.msgtype, raw.log_ns, recorded=readings.config.stamps == "recorded")
        if stamp_ns is None:
            text = f"{raw.file}: header stamp is zero or negative{_when(raw)}: {NO_STAMP}"
            self._rows.append(readings.row(seq, 0, malformed(text)))
            return
        stamp_ns = corrected_ns(stamp_ns, readings.config, raw.elapsed_ns)
        if not 0 < stamp_ns <= LATEST_NS:
            text = f"{raw.file}: no time with time_offset_s on it{_when(raw)}"
            self._rows.append(readings.row(seq, 0, malformed(text)))
            return
        decoder = decoder_of(readings.config.kind, raw.msgtype)
        value: Decoded = malformed(f"{raw.msgtype} is not read by a {readings.config.kind} sensor")
        if decoder is not None:
            try:
                value = decoder(msg, stamp_ns, seq, readings.sensor, readings.config)
            except (ValueError, ArithmeticError, AttributeError, TypeError) as error:
                value = malformed(" ".join(str(error).split()))
            if not isinstance(value, Decoded):  # another package's
                value = malformed(f"its decoder returned {type(value).__name__}, no measurement")
        if not isinstance(value, Rejection):
            readings.add(seq, stamp_ns, raw.log_ns, value, raw.file)
        elif value.outcome is Outcome.MALFORMED:
            self._rows.append(readings.row(seq, stamp_ns, malformed(f"{raw.file}: {value.reason}")))
        else:
            self._rows.append(readings.row(seq, stamp_ns, value))

    def _topic_rows(self, read: Counter[str]) -> list[LedgerRow]:
        """Return ledger rows of whole topics: unused, read but not fused, or unreadable."""
        rows: list[LedgerRow] = []

        def add(topic: str, count: int, outcome: Outcome, reason: str) -> None:
            row = LedgerRow(seq=-1, stamp_ns=0, sensor="", topic=topic, outcome=outcome, reason=reason, count=count)
            rows.extend([row] if count > 0 else [])

        for topic, summary in self._topics.items():
            if topic not in self._wanted:
                reason = f"no sensor reads this topic ({either(summary.msgtypes)})"
                add(topic, summary.messages, Outcome.IGNORED, reason)
                continue
            for item in self._references.get(topic, ()):
                add(topic, item.count - item.broken, Outcome.READ, item.reason)
                add(topic, item.broken, Outcome.MALFORMED, "cannot be decoded")
            if topic == TF_STATIC and self._tree is not None:
                add(topic, read[topic] - self._tree.broken, Outcome.READ, "read for mounts")
                add(topic, self._tree.broken, Outcome.MALFORMED, "cannot be decoded")
            if topic == TF_MOVING and self._tree is not None:
                add(topic, read[topic], Outcome.READ, "read for mounts")
            missing = summary.messages - read[topic]
            add(topic, missing, Outcome.MALFORMED, "announced by the bag's index, but cannot be read")
        return rows


def _when(raw: RawMessage) -> str:
    """Return the clause that identifies a message without a stamp: when it was recorded."""
    return f"{RECORDED_AT}{utc_text(raw.log_ns)}"


def either(msgtypes: Sequence[str]) -> str:
    """Return message types as ROS writes them for people."""
    return " or ".join(n.replace("/msg/", "/") for n in msgtypes)
