# SPDX-License-Identifier: Apache-2.0
"""Read a run from a bag: ROS 1, ROS 2 in sqlite3 or MCAP, split or compressed.

Streams: topics that no sensor asks for are counted and never deserialised. Every message of the bag
ends in a measurement, an IMU sample, or a ledger row.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from graphloc.config import SensorConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.frames import Array, Datum
from graphloc.frontends.decode import DECODERS, SUPPORTED, Unusable, imu_sample
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import GnssPosition, ImuSeries, Measurement
from graphloc.recording import Recording, SpeedSeries
from graphloc.time import duration_ns, utc_text
from graphloc.trajectory import Trajectory

_CLOCK_JUMP_S = 60.0  # a header further than this from its topic's usual latency is a clock jump
_TELEPORT_M = 100_000.0

Progress = Callable[[str, int, int], None]


@contextmanager
def open_bag(paths: Sequence[Path]) -> Iterator[AnyReader]:
    """Open one bag, or the parts of a split one.

    Raises:
        InputError: it does not exist or cannot be read; the line says what to do.
    """
    name = ", ".join(str(p) for p in paths)
    for path in paths:
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
    try:
        with AnyReader(list(paths), default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except InputError:
        raise
    except (AnyReaderError, OSError, ValueError, KeyError, AssertionError) as error:
        text = " ".join(str(error).split())[:200]
        hint = "`rosbag reindex`" if any(p.suffix == ".bag" for p in paths) else "`ros2 bag reindex` or `mcap recover`"
        raise InputError(f"{name}: cannot be read as a bag ({text}); if it is cut off, try {hint}") from error
    except Exception as error:  # rosbags' storage layers raise their own, unrelated errors
        if type(error).__module__.split(".")[0] not in ("rosbags", "sqlite3", "apsw", "struct", "lz4", "zstandard"):
            raise
        raise InputError(f"{name}: cannot be read as a bag ({' '.join(str(error).split())[:200]})") from error


@dataclass(slots=True)
class _Collected:
    """What the stream has given so far."""

    measurements: list[Measurement] = field(default_factory=list)
    imu: list[tuple[int, int, Array, Array]] = field(default_factory=list)
    rows: list[LedgerRow] = field(default_factory=list)
    truth: list[tuple[int, Array, Array, Array]] = field(default_factory=list)
    speed: list[tuple[int, float]] = field(default_factory=list)
    transforms: dict[str, tuple[str, Array, Array]] = field(default_factory=dict)
    latency: dict[str, list[float]] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)


def read_recording(
    paths: Path | Sequence[Path], config: VesselConfig, progress: Progress = lambda *_: None
) -> Recording:
    """Read what the configuration asks for.

    Args:
        paths: a bag, or the parts of a split one.
        config: the vessel; its sensors name the topics.
        progress: called with stage, messages done, messages in all.

    Raises:
        InputError: the bag cannot be opened, or a configured topic is missing or of an unsupported type.
    """
    parts = [paths] if isinstance(paths, Path) else list(paths)
    source = str(parts[0])
    got = _Collected()
    with open_bag(parts) as reader:
        sensors = _match(reader, config, source)
        total = sum(c.msgcount for c in reader.connections)
        wanted = [c for c in reader.connections if c.topic in _asked(config)]
        done = 0
        try:
            for connection, log_ns, raw in reader.messages(connections=wanted):
                _take(reader, connection, log_ns, raw, done, sensors, config, source, got)
                done += 1
                if done % 5000 == 0:
                    progress("reading", done, sum(c.msgcount for c in wanted))
        except InputError:
            raise
        except Exception as error:
            if not done:
                raise
            text = " ".join(str(error).split())[:120]
            got.warnings.append(f"{source}: damaged after {done} messages ({text}); the rest is lost")
            lost = sum(c.msgcount for c in wanted) - done
            got.rows.append(_topic_row(source, "(unread)", lost, Outcome.MALFORMED, "behind the damage in the bag"))
        for topic in sorted({c.topic for c in reader.connections} - _asked(config)):
            count = sum(c.msgcount for c in reader.connections if c.topic == topic)
            kind = next(c.msgtype for c in reader.connections if c.topic == topic)
            reason = f"no sensor is configured for this topic ({kind})"
            got.rows.append(_topic_row(source, topic, count, Outcome.IGNORED, reason))
    return _finish(got, config, sensors, source, total)


def _asked(config: VesselConfig) -> set[str]:
    topics = {s.topic for s in config.sensors.values() if s.enabled and s.topic}
    extra = {config.truth_topic, config.check_speed_topic} - {None}
    return topics | {t for t in extra if t} | {"/tf_static"}


def _match(reader: AnyReader, config: VesselConfig, source: str) -> dict[str, list[tuple[str, SensorConfig]]]:
    """Return the sensors of each topic; complain about what is missing or of the wrong type."""
    types = {c.topic: c.msgtype for c in reader.connections}
    sensors: dict[str, list[tuple[str, SensorConfig]]] = {}
    for name, sensor in config.sensors.items():
        if not sensor.enabled or sensor.kind not in SUPPORTED:
            continue
        if sensor.topic not in types:
            close = difflib.get_close_matches(sensor.topic, list(types), n=3, cutoff=0.3)
            known = ", ".join(close or sorted(types)) or "none: it is empty"
            raise InputError(f"{source}: sensors.{name}: no topic '{sensor.topic}' in the bag; it has {known}")
        if types[sensor.topic] not in SUPPORTED[sensor.kind]:
            raise InputError(
                f"{source}: sensors.{name}: topic '{sensor.topic}' is {types[sensor.topic]}, but kind "
                f"'{sensor.kind}' reads {' or '.join(SUPPORTED[sensor.kind])}"
            )
        sensors.setdefault(sensor.topic, []).append((name, sensor))
    for topic in (config.truth_topic, config.check_speed_topic):
        if topic and topic not in types:
            raise InputError(f"{source}: no topic '{topic}' in the bag (truth_topic or check_speed_topic)")
    return sensors


def _topic_row(source: str, topic: str, count: int, outcome: Outcome, reason: str) -> LedgerRow:
    return LedgerRow(seq=-1, stamp_ns=0, sensor="", topic=topic, outcome=outcome, reason=reason, count=count)


def _take(
    reader: AnyReader,
    connection: Any,
    log_ns: int,
    raw: bytes,
    seq: int,
    sensors: dict[str, list[tuple[str, SensorConfig]]],
    config: VesselConfig,
    source: str,
    got: _Collected,
) -> None:
    """Turn one message into what it is. The first sensor of a topic owns its ledger row."""
    topic, stamp_ns = connection.topic, 0
    owners = sensors.get(topic, [])
    try:
        try:
            msg = reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            raise Unusable(f"cannot be decoded ({' '.join(str(error).split())[:80]})") from None
        if topic == "/tf_static":
            _take_transforms(msg, got)
        if hasattr(msg, "header"):
            stamp_ns = int(msg.header.stamp.sec) * 1_000_000_000 + int(msg.header.stamp.nanosec)
            if stamp_ns == 0 and owners:
                raise Unusable("the header's stamp is zero")
        if topic == config.truth_topic:
            _take_truth(msg, stamp_ns, got)
        if topic == config.check_speed_topic:
            got.speed.append((stamp_ns, float(msg.twist.twist.linear.x)))
        if not owners:
            reason = "static transforms" if topic == "/tf_static" else "for comparison only, never fused"
            got.rows.append(_row(seq, stamp_ns, "", topic, Outcome.IGNORED, reason))
            return
        _check_clock(topic, stamp_ns, log_ns, got)
        for k, (name, sensor) in enumerate(owners):
            at = stamp_ns + duration_ns(sensor.time_offset_s)
            number = seq if k == 0 else -2  # a second sensor of the same topic gets no row of its own
            if sensor.kind == "imu":
                got.imu.append((at, number, *imu_sample(msg, sensor)))  # type: ignore[arg-type]
            else:
                decode = DECODERS[(sensor.kind, connection.msgtype)]
                got.measurements.append(decode(msg, at, number, name, sensor))
    except (Unusable, ValueError) as error:
        outcome = error.outcome if isinstance(error, Unusable) else Outcome.MALFORMED
        reason = f"{error} [{Path(source).name} {topic} {utc_text(stamp_ns)}]"
        got.rows.append(_row(seq, stamp_ns, owners[0][0] if owners else "", topic, outcome, reason))


def _row(seq: int, stamp_ns: int, sensor: str, topic: str, outcome: Outcome, reason: str) -> LedgerRow:
    return LedgerRow(seq=seq, stamp_ns=stamp_ns, sensor=sensor, topic=topic, outcome=outcome, reason=reason)


def _check_clock(topic: str, stamp_ns: int, log_ns: int, got: _Collected) -> None:
    latency = (log_ns - stamp_ns) * 1e-9
    seen = got.latency.setdefault(topic, [])
    if len(seen) >= 5 and abs(latency - float(np.median(seen[:200]))) > _CLOCK_JUMP_S:
        raise Unusable(
            f"clock jump: the stamp is {latency - float(np.median(seen[:200])):+.0f} s off its usual latency"
        )
    if len(seen) < 200:
        seen.append(latency)


def _take_transforms(msg: Any, got: _Collected) -> None:
    for t in msg.transforms:
        q, p = t.transform.rotation, t.transform.translation
        R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
        got.transforms[t.child_frame_id.lstrip("/")] = (t.header.frame_id.lstrip("/"), np.array([p.x, p.y, p.z]), R)


def _take_truth(msg: Any, stamp_ns: int, got: _Collected) -> None:
    p, q, v = msg.pose.pose.position, msg.pose.pose.orientation, msg.twist.twist.linear
    R = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    if not got.truth or stamp_ns > got.truth[-1][0]:
        got.truth.append((stamp_ns, np.array([p.x, p.y, p.z]), R, R @ np.array([v.x, v.y, v.z])))


def _mount_from_tf(got: _Collected, frame: str, body: str, source: str, name: str) -> tuple[Array, Array]:
    """Follow the chain of /tf_static from a sensor's frame up to body."""
    t, R, at = np.zeros(3), np.eye(3), frame.lstrip("/")
    for _ in range(len(got.transforms) + 1):
        if at == body:
            return t, R
        if at not in got.transforms:
            break
        at, step_t, step_R = got.transforms[at]
        t, R = step_R @ t + step_t, step_R @ R
    known = ", ".join(sorted(got.transforms)) or "none"
    raise InputError(
        f"{source}: sensors.{name}.mount.tf_frame: /tf_static does not lead from '{body}' to '{frame}'; it has {known}"
    )


def _imu_series(got: _Collected, name: str, topic: str, source: str) -> ImuSeries | None:
    """Order the samples; repeated and backward stamps go to the ledger."""
    kept: list[tuple[int, int, Array, Array]] = []
    for sample in got.imu:
        if kept and sample[0] <= kept[-1][0]:
            word = "repeated" if sample[0] == kept[-1][0] else "backward"
            reason = f"{word} stamp [{Path(source).name} {topic} {utc_text(sample[0])}]"
            got.rows.append(_row(sample[1], sample[0], name, topic, Outcome.REJECTED, reason))
        else:
            kept.append(sample)
    if not kept:
        return None
    return ImuSeries(
        sensor=name,
        stamps_ns=np.array([s[0] for s in kept], dtype=np.int64),
        accel_mps2=np.array([s[2] for s in kept]),
        gyro_radps=np.array([s[3] for s in kept]),
        seqs=np.array([s[1] for s in kept], dtype=np.int64),
    )


def _drop_teleports(got: _Collected, topics: dict[str, str], source: str) -> None:
    fixes = [m for m in got.measurements if isinstance(m, GnssPosition)]
    if len(fixes) < 5:
        return
    middle = np.median([m.position for m in fixes], axis=0)
    scale = np.array([111_000.0, 111_000.0 * np.cos(np.radians(middle[0]))])
    for m in fixes:
        distance = float(np.hypot(*((np.array(m.position[:2]) - middle[:2]) * scale)))
        if distance > _TELEPORT_M:
            got.measurements.remove(m)
            reason = (
                f"{distance / 1000.0:.0f} km from the run's other fixes [{Path(source).name} {utc_text(m.stamp_ns)}]"
            )
            got.rows.append(_row(m.seq, m.stamp_ns, m.sensor, topics[m.sensor], Outcome.REJECTED, reason))


def _finish(
    got: _Collected, config: VesselConfig, sensors: dict[str, list[tuple[str, SensorConfig]]], source: str, total: int
) -> Recording:
    topics = {name: topic for topic, owners in sensors.items() for name, _ in owners}
    imu_name = next(iter(config.of_kind("imu")), "")
    imu = _imu_series(got, imu_name, topics.get(imu_name, ""), source)
    _drop_teleports(got, topics, source)
    mounts = {
        name: _mount_from_tf(got, sensor.mount.tf_frame, config.body_frame, source, name)
        for owners in sensors.values()
        for name, sensor in owners
        if sensor.mount.tf_frame
    }
    if imu is not None:
        got.warnings.extend(_imu_warnings(imu, config.sensors[imu_name], source))
    got.warnings.extend(_clock_warnings(got, source))
    truth = None
    if len(got.truth) > 1:
        stamps, p, R, v = (list(column) for column in zip(*got.truth, strict=True))
        truth = Trajectory(
            stamps_ns=np.array(stamps, dtype=np.int64),
            p_world_m=np.array(p),
            R_world_body=np.array(R),
            v_world_mps=np.array(v),
        )
    speed = None
    if got.speed and config.check_speed_topic:
        at, value = zip(*got.speed, strict=True)
        speed = SpeedSeries(config.check_speed_topic, np.array(at, dtype=np.int64), np.array(value))
    return Recording(
        source=source,
        imu=imu,
        measurements=tuple(sorted(got.measurements, key=lambda m: (m.stamp_ns, m.seq))),
        rows=tuple(got.rows),
        message_count=total,
        topics=topics,
        mounts=mounts,
        truth=truth,
        truth_datum=Datum(config.datum.geodetic) if config.datum else None,
        check_speed=speed,
        warnings=tuple(got.warnings),
    )


def _imu_warnings(imu: ImuSeries, config: Any, source: str) -> list[str]:
    size = float(np.median(np.linalg.norm(imu.accel_mps2, axis=1)))
    rate = float(np.percentile(np.linalg.norm(imu.gyro_radps, axis=1), 95))
    where = f"{source}: {config.topic}"
    out = []
    if config.gravity == "included" and 0.8 < size < 1.2:
        out.append(f"{where}: acceleration is about 1: it looks like g; set accel_unit: g")
    elif config.gravity == "included" and size < 4.0:
        out.append(f"{where}: acceleration is about {size:.1f} m/s^2: gravity looks removed; set gravity: removed")
    elif config.gravity == "removed" and size > 8.0:
        out.append(f"{where}: acceleration is about {size:.1f} m/s^2: gravity looks included; set gravity: included")
    if rate > 6.0:
        out.append(f"{where}: rates reach {rate:.0f} rad/s: they look like deg/s; set gyro_unit: deg/s")
    return out


def _clock_warnings(got: _Collected, source: str) -> list[str]:
    usual = {topic: float(np.median(seen)) for topic, seen in got.latency.items() if seen}
    if len(usual) < 2:
        return []
    middle = float(np.median(list(usual.values())))
    return [
        f"{source}: {topic}: its clock is {value - middle:+.3f} s off the other topics' (header against log)"
        for topic, value in usual.items()
        if abs(value - middle) > 5.0
    ]
