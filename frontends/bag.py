# SPDX-License-Identifier: Apache-2.0
"""Read a bag as a `Recording`: measurements, inertial samples, and a ledger row for each message that gave neither.

Steps: subscribe to the topics that the configuration names; decode their messages one by one; reject implausible
stamps; check the whole run for wrong units. Messages of other topics are counted from the bag's index and never
decompressed, so they need no memory.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from itertools import islice

import numpy as np

from graphloc.config import BodyVelocityConfig, SensorConfig, VesselConfig
from graphloc.errors import InputError
from graphloc.frames import Array
from graphloc.frontends._clock import ScanClock, corrected_ns, usual_latency_s
from graphloc.frontends._clocks import clock_warnings
from graphloc.frontends._reader import Reader, either
from graphloc.frontends._readings import (
    Readings,
    at_pace,
    imu_series,
    judge_fixes,
    reject_far,
    reject_far_poses,
    reject_jumps,
    reject_repeats,
    reject_scattered,
    reject_set_back,
    reject_stored,
    right_leaps,
    thin,
)
from graphloc.frontends._references import Reference, check_speed, true_trajectory
from graphloc.frontends._run_warnings import run_warnings
from graphloc.frontends._sanity import lever_warning
from graphloc.frontends._tf import StaticTree
from graphloc.frontends.decode import DECODERS_GROUP, supported_types
from graphloc.frontends.msgtypes import NMEA, ODOMETRY, TRUE_TYPES, stamp_ns_of
from graphloc.frontends.part import Bags
from graphloc.frontends.source import Bag, TopicSummary, unopened
from graphloc.frontends.vendors import VENDORS
from graphloc.ledger import LedgerRow
from graphloc.measurements import ImuSeries, Measurement
from graphloc.recording import Mounts, Progress, Recording, Span
from graphloc.time import NS_PER_S

_FIRST_SCANS = 20  # so many first scans of a LiDAR tell how late they are recorded


def check_bag(bags: Bags, config: VesselConfig) -> None:
    """Check that a bag can be opened and has the topics that the configuration names, without reading it.

    Raises:
        InputError: no readable bag, a missing topic, one of another type, or one of a kind that reads none.
    """
    with Bag(bags) as bag:
        _asked_for(config, bag)


def read_recording(bags: Bags | Bag, config: VesselConfig, progress: Progress | None = None) -> Recording:
    """Read the topics that the configuration names.

    Args:
        bags: a .bag, .mcap or .db3 file, the folder of a ROS 2 bag, several files of a split bag, a part of them, or a
            bag that is not opened yet.
        config: topics, units and mounts of the sensors.
        progress: called now and then with the stage, the number of messages done and that of all messages.

    Returns:
        The recording. Its measurements, IMU samples and rows add up to its `message_count`, in which a message that
        several sensors read counts once for each sensor.

    Raises:
        InputError: no readable bag, a missing topic or one of another type, a mount without a chain of transforms, or
            an empty part of the bag.
    """
    with unopened(bags) as bag:
        topics = bag.topics
        sensors, truth, check = _asked_for(config, bag)
        references = [b for b in (truth, check) if b]
        span = _span(bag, config)
        bag.refuse_set_back([r.config.topic for r in sensors if r.config.kind == "imu"])
        tree = StaticTree() if any(s.enabled and s.mount.tf_frame for s in config.sensors.values()) else None
        rows = Reader(bag, topics, sensors, references, tree).read(progress)
        scan_latencies = _scan_latencies(bag, config)
        warnings = list(bag.warnings)

    at_pace(sensors, warnings)
    right_leaps(sensors, warnings)
    rows += reject_jumps(sensors, warnings)
    rows += reject_far_poses(sensors, warnings)
    rows += reject_set_back(sensors, references, warnings)
    clocks, doubts = clock_warnings(sensors)
    warnings += clocks
    doubts += _scan_clocks(sensors, scan_latencies, config, warnings)
    mounts = _mounts(config, tree, bag.name)
    warnings += _far_levers(config, mounts)
    imu, measurements, dropped = _usable(sensors, config, warnings)
    rows += dropped
    warnings += run_warnings(imu, sensors, rows, topics, mounts, config)
    warnings += [
        f"{b.topic}: {b.unstamped} of its headers hold no stamp: recording times are used"
        for b in references
        if b.unstamped
    ]
    return Recording(
        source=bag.name if span is None else f"{bag.name}, {span.start_s:g} s to {span.end_s:g} s",
        imu=imu,
        measurements=tuple(sorted(measurements, key=lambda m: (m.stamp_ns, m.seq))),
        rows=tuple(sorted(rows, key=lambda r: (r.seq < 0, r.seq, r.topic))),
        message_count=sum(len(r.values) for r in sensors) + sum(r.count for r in rows),
        topics={r.sensor: r.config.topic for r in sensors},
        mounts=mounts,
        truth=true_trajectory(truth, config.truth_time_offset_s, warnings) if truth else None,
        check_speed=check_speed(check) if check else None,
        warnings=tuple(warnings),
        span=span,
        clock_doubts=doubts,
    )


def _scan_latencies(bag: Bag, config: VesselConfig) -> dict[str, float]:
    """Return by aerial sensor how much later than stamped its scans are usually recorded, s.

    It is the median over the first scans of a LiDAR; of several LiDARs, the least. Sensors without header stamps, and
    LiDARs without stamped scans, are left out.
    """
    found = {}
    for name, sensor in config.of_kind("aerial").items():
        latency_s = []
        for lidar in sensor.lidars.values() if sensor.stamps == "header" else ():
            own = []
            for raw in islice(bag.messages({lidar.topic}), _FIRST_SCANS) if lidar.topic in bag.topics else ():
                try:
                    stamp_ns = stamp_ns_of(bag.decode(raw), raw.msgtype, raw.log_ns)
                except Exception:  # noqa: BLE001, S112 - damaged bytes make rosbags raise nearly anything; others do
                    continue
                if stamp_ns is not None:
                    own.append((raw.log_ns - corrected_ns(stamp_ns, sensor, raw.elapsed_ns)) / NS_PER_S)
            if own:
                latency_s.append(float(np.median(own)))
        if latency_s:
            found[name] = min(latency_s)
    return found


def _scan_clocks(
    sensors: Sequence[Readings], latencies_s: Mapping[str, float], config: VesselConfig, warnings: list[str]
) -> tuple[str, ...]:
    """Add a warning on each aerial sensor whose clock is not the IMU's; return those that make all poses doubtful.

    Clocks are compared by the recording times.

    Args:
        latencies_s: by aerial sensor, of `_scan_latencies`. warnings: gets the new lines.
    """
    imu = next((r for r in sensors if r.config.kind == "imu" and r.stamps_ns), None)
    doubts = []
    for name, latency_s in latencies_s.items() if imu is not None else ():
        assert imu is not None
        sensor = config.of_kind("aerial")[name]
        clock = ScanClock(usual_latency_s(imu.stamps(), imu.logs()) - latency_s)
        if line := clock.said(name, sensor):
            warnings.append(line)
        if clock.astray(sensor):
            doubts.append(line)
    return tuple(doubts)


def _usable(
    sensors: Sequence[Readings], config: VesselConfig, warnings: list[str]
) -> tuple[ImuSeries | None, list[Measurement], list[LedgerRow]]:
    """Return IMU samples and measurements that pass the checks of a whole run, and ledger rows of all others."""
    imu: ImuSeries | None = None
    measurements: list[Measurement] = []
    rows: list[LedgerRow] = []
    for readings in sorted(sensors, key=lambda r: r.config.kind != "imu"):  # headings are compared with the gyroscope
        if readings.config.kind == "imu":
            imu, more = imu_series(readings, warnings)
            rows += more
        else:
            rows += reject_repeats(readings) + reject_stored(readings, warnings)
            rows += reject_far(readings, config, warnings) + judge_fixes(readings, warnings)
            rows += thin(readings) + reject_scattered(imu, readings, warnings)
            measurements += readings.of(Measurement)
    return imu, measurements, rows


def _span(bag: Bag, config: VesselConfig) -> Span | None:
    """Return the part of the bag that is read, with counts of the topics that the configuration names; None: all of it.

    Raises:
        InputError: the part holds no message of these topics.
    """
    if bag.span is None:
        return None
    sensors = [sensor for sensor in config.sensors.values() if sensor.enabled]
    named = {config.truth_topic, config.check_speed_topic, *(sensor.topic for sensor in sensors)}
    named |= {lidar.topic for sensor in config.of_kind("aerial").values() for lidar in sensor.lidars.values()}
    named |= {camera.topic for sensor in config.of_kind("apriltag").values() for camera in sensor.cameras.values()}
    span = bag.span.of(named)
    if not sum(span.messages.values()):
        raise InputError(
            f"{bag.name}: no message of a topic that vessel.yaml names was recorded from --start {span.start_s:g} s to "
            f"{span.end_s:g} s, of {span.bag_s:.1f} s: take another part"
        )
    return span


def _asked_for(config: VesselConfig, bag: Bag) -> tuple[list[Readings], Reference | None, Reference | None]:
    """Return empty containers for what is read of a bag: of sensors, of the truth, and of the speed to compare with.

    Raises:
        InputError: see `check_bag`.
    """
    sensors = _subscriptions(config, bag.topics, bag.name)
    truth = _reference(config.truth_topic, "truth_topic", "truth, never fused", bag.topics, bag.name)
    check = _reference(config.check_speed_topic, "check_speed_topic", "check, never fused", bag.topics, bag.name)
    return sensors, truth, check


def _subscriptions(config: VesselConfig, topics: Mapping[str, TopicSummary], bag: str) -> list[Readings]:
    """Return `Readings` for each enabled sensor that reads a topic.

    Raises:
        InputError: see `check_bag`.
    """
    found: list[Readings] = []
    for name, sensor in config.sensors.items():
        types = supported_types(sensor.kind)
        if sensor.enabled and sensor.topic and not types:
            raise InputError(
                f"{bag}: sensors.{name}.topic '{sensor.topic}': nothing reads a topic for kind '{sensor.kind}': delete the key, or, if a "
                f"package adds this kind, name its decoders '{sensor.kind}' under {DECODERS_GROUP}"
            )
        if sensor.enabled and types:
            _check_topic(sensor.topic, f"sensors.{name}.topic", types, topics, bag)
            _check_through(name, sensor, found, topics[sensor.topic], bag)
            found.append(Readings(name, sensor))
    return found


def _tells_both(own: Sequence[str], other: Sequence[str]) -> bool:
    """Return whether VBW is the only sentence that two lists of NMEA sentences share, if they share any.

    VBW tells the velocity over ground and the one through the water, so two sensors may read it.
    """
    kinds = {said[-3:] for said in own} & {said[-3:] for said in other}
    return kinds <= {"VBW"}


def _check_through(name: str, sensor: SensorConfig, others: Sequence[Readings], topic: TopicSummary, bag: str) -> None:
    """Refuse a log that another sensor reads, too, one as over ground and one as through water.

    Accepted are messages that say which velocity they are, and NMEA sentences that differ or tell both velocities
    (VBW).

    Args:
        others: the sensors that were subscribed before. topic: the topic of `sensor`.

    Raises:
        InputError: nothing tells which of the two velocities the messages hold.
    """
    if not isinstance(sensor, BodyVelocityConfig):
        return
    own = [r for r in others if r.config.topic == sensor.topic]
    twins = [
        r.sensor
        for r in own
        if isinstance(r.config, BodyVelocityConfig)
        and r.config.through != sensor.through
        and not (set(topic.msgtypes) <= set(NMEA) and _tells_both(sensor.nmea, r.config.nmea))
    ]
    telling = any(part.through for msgtype in topic.msgtypes for part in VENDORS.get(msgtype, ()))
    if twins and not telling:
        raise InputError(
            f"{bag}: sensors.{name} and sensors.{twins[0]} read {topic.topic} over ground and through water; {either(topic.msgtypes)} does not "
            "say which it is, so both would count: delete one"
        )


def _check_topic(topic: str, key: str, types: tuple[str, ...], topics: Mapping[str, TopicSummary], bag: str) -> None:
    """Raise an `InputError` if a topic is missing or has another type."""
    fitting = [t.topic for t in topics.values() if set(t.msgtypes) & set(types)]
    offer = f"topics of a fitting type: {', '.join(fitting)}" if fitting else f"no topic holds {either(types)}"
    if topic not in topics:
        close = difflib.get_close_matches(topic, list(topics), n=3, cutoff=0.3)
        near = f"nearest: {', '.join(close)}" if close else f"it holds: {', '.join(topics) or 'no topic at all'}"
        raise InputError(f"{bag}: {key} '{topic}' is not in the bag; {near}; {offer}")
    have = topics[topic].msgtypes
    if not set(have) & set(types):
        raise InputError(f"{bag}: {key} '{topic}' holds {either(have)}, but must hold {either(types)}; {offer}")


def _reference(
    topic: str | None, key: str, reason: str, topics: Mapping[str, TopicSummary], bag: str
) -> Reference | None:
    if topic is None:
        return None
    _check_topic(topic, key, TRUE_TYPES if key == "truth_topic" else (ODOMETRY,), topics, bag)
    return Reference(topic, reason)


def _mounts(config: VesselConfig, tree: StaticTree | None, bag: str) -> dict[str, tuple[Array, Array]]:
    """Return the mounts of all enabled sensors that name a frame of /tf_static, also of sensors that read no topic.

    Raises:
        InputError: no chain of transforms leads from the body to a frame.
    """
    if tree is None:
        return {}
    return {
        name: tree.mount(config.body_frame, sensor.mount.tf_frame, f"{bag}: sensors.{name}.mount.tf_frame")
        for name, sensor in config.sensors.items()
        if sensor.enabled and sensor.mount.tf_frame
    }


def _far_levers(config: VesselConfig, mounts: Mounts) -> list[str]:
    enabled = ((name, sensor.mount) for name, sensor in config.sensors.items() if sensor.enabled)
    return [
        line
        for name, mount in enabled
        for line in lever_warning(name, mounts[name][0] if name in mounts else mount.t_body_sensor_m, mount.tf_frame)
    ]
