# SPDX-License-Identifier: Apache-2.0
"""Lines of a drafted `vessel.yaml` on the clock of a sensor: which stamps are used, and what is added to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from graphloc.frontends._clock import (
    EPOCH_LIMIT_S,
    LEAP_S,
    MOST_ON_ITS_WAY_S,
    SCANS_AHEAD_S,
    Clock,
    behind_s,
    reference_of,
)
from graphloc.frontends._reports import (
    FITS_WITH_FIXES,
    CompassReport,
    GnssReport,
    Inspection,
    MountedTopic,
    TopicReport,
    VelocityReport,
    bare_topic,
)
from graphloc.frontends.msgtypes import UNSTAMPED
from graphloc.time import GPS_AHEAD_S

# Least sigma of a velocity that is averaged over seconds: its error lasts as long, and would count as white.
_FILTERED_SIGMA_MPS = 1.0
_OWN_CLOCK_S = 10.0  # no message takes so long: stamps that are off by more are of another clock
_FEWEST_STAMPS = 10  # messages of a topic that tells of a clock
_STAMPED_LATE_S, _ON_ITS_WAY_S = 0.05, 0.15  # 1 sigma of the delay of a receiver's stamps; of recording times
# A delay of NMEA stamps after the times in the sentences: least, most, and largest spread. Stamps of whole seconds
# spread over a second.
_LEAST_AFTER_S, _MOST_AFTER_S, _EVEN_S = 0.1, 1.0, 0.5
_STAMPS = "stamps may be late: the delay is estimated with the run; set 0 if the receiver stamps with its own clock"
_LONG_ON_ITS_WAY = "recorded {:.1f} s after its stamps, which fit what the IMU feels: its messages take as long, and its clock is right"
# The longest that messages may take; relative difference up to which two delays are equal.
_LONGEST_WAY_S, _NEAR = 3.0, 0.25
_ESTIMATED = ("gnss", "gnss_velocity")  # kinds whose delay is estimated with the run
_SET = ("imu", "gnss", "gnss_velocity", "body_velocity", "compass")  # kinds whose clocks are set; poses may come late


def with_clock(block: list[str], inspection: Inspection) -> list[str]:
    """Return the block of a sensor, with lines on its clock if there is anything to say."""
    kind, topic = _value(block, "kind"), _value(block, "topic")
    topics = _by_topic(inspection)
    if topic not in topics:
        return block
    own = topics[topic]
    return [*block, *_stamp_lines(kind, own), *_drift_lines(own), *_offset_lines(kind, topic, topics, inspection)]


def _by_topic(inspection: Inspection) -> dict[str, TopicReport]:
    """Return the reports by topic. On an NMEA topic each sentence has a report: the last one is taken."""
    return {bare_topic(t.topic): t for t in inspection.topics}


def _value(block: list[str], key: str) -> str:
    return next((line.split()[1] for line in block if line.startswith(f"  {key}:")), "")


def _stamp_lines(kind: str, own: TopicReport) -> list[str]:
    """Return the line that recording times are used as stamps, if the headers tell none."""
    if not own.recorded:
        return []
    unknown = "" if kind in _ESTIMATED else ", which no bound includes"
    said = f"guess: its headers hold no stamps, or whole seconds only; recording times are late by the transport delay of a message{unknown}"
    return [f"  stamps: recorded  # {said}"]


def _drift_lines(own: TopicReport) -> list[str]:
    """Return the line on how fast a clock drifts, by the recording times, if it does."""
    ppm = own.drift_ppm
    if not ppm:
        return []
    gained_s = 1e-6 * ppm * (own.span_s or 0.0)
    said = (
        f"it {'gains' if ppm > 0.0 else 'loses'} {abs(gained_s):.2f} s on the steadiest clock, by the recording times"
    )
    said += "" if ppm > 0.0 else "; set 0 if the clock is right, and only the transport delay of its messages grew"
    return [f"  clock_drift_ppm: {ppm:.1f}  # guess: {said}"]


class _Told(NamedTuple):
    """A correction of a sensor's stamps: what to add to them, 1 sigma of the remaining error, and the evidence."""

    by_s: float
    sigma_s: float
    why: str


def _offset_lines(kind: str, topic: str, topics: Mapping[str, TopicReport], inspection: Inspection) -> list[str]:
    """Return lines on what to add to the stamps, by the recording times, the motion, or the times in NMEA sentences."""
    behind = _behind(topic, topics, inspection) if kind in _SET else None
    if behind is None:
        return []
    if _takes_long(behind[0], topics, inspection):
        said = f"guess: {_LONG_ON_ITS_WAY.format(behind[0])}"
        return [f"  stamp_sigma_s: {_ON_ITS_WAY_S:.2f}  # {said}"] if kind in _ESTIMATED else []
    by_motion = _by_motion(kind, topic, inspection)
    told = [*_by_recording_times(kind, *behind), *by_motion] or _by_sentences(kind, topic, inspection)
    lines = []
    if told:
        lines.append(f"  time_offset_s: {sum(t.by_s for t in told):.3f}  # guess: {'; '.join(t.why for t in told)}")
    fixes_late_s = next((r.late_s[0] for r in inspection.gnss if r.late_s), 0.0)
    if kind == "gnss_velocity" and by_motion and by_motion[0].by_s < fixes_late_s - MOST_ON_ITS_WAY_S:
        lines.append(
            f"  min_sigma_mps: {_FILTERED_SIGMA_MPS}  # guess: so late, it is filtered, and its errors are correlated"
        )
    return [*lines, _sigma_line(topics[topic], told, _hinted(topic, inspection))] if kind in _ESTIMATED else lines


def _takes_long(behind_s: float, topics: Mapping[str, TopicReport], inspection: Inspection) -> bool:
    """Return whether messages are recorded `behind_s` after their stamps because they take so long, as by radio.

    Then the clock is right. Recording times cannot tell that, but what the IMU feels can, of fixes that are as far
    behind: moved by `behind_s`, they are too late for its motion by as much.
    """
    if not EPOCH_LIMIT_S < behind_s <= _LONGEST_WAY_S:
        return False
    for gnss in inspection.gnss:
        own = _behind(bare_topic(gnss.topic), topics, inspection)
        if own is not None and gnss.felt_s is not None and abs(own[0] - behind_s) < _NEAR * behind_s:
            return abs(gnss.felt_s + behind_s) < _NEAR * behind_s
    return False


def _sigma_line(own: TopicReport, told: Sequence[_Told], hinted: tuple[float, float] | None) -> str:
    """Return the line on how well the delay is known before the run."""
    unstamped = own.recorded or own.msgtype in UNSTAMPED
    sigma_s, said = _ON_ITS_WAY_S if unstamped else _STAMPED_LATE_S, ""
    if told:
        sigma_s = told[-1].sigma_s
    if hinted:
        sigma_s = max(sigma_s, abs(hinted[0]))
        said = f"; what the IMU feels hints at {hinted[0]:+.2f} +- {hinted[1]:.2f} s, not clearly"
    return f"  stamp_sigma_s: {sigma_s:.2f}  # guess: {_STAMPS}{said}"


def _hinted(topic: str, inspection: Inspection) -> tuple[float, float] | None:
    """Return the offset of the stamps of fixes at which the IMU hints, s, and its 1 sigma; None if it does not."""
    return next((r.hinted_s for r in inspection.gnss if bare_topic(r.topic) == topic and r.hinted_s), None)


def _by_recording_times(kind: str, behind_s: float, clock: str) -> list[_Told]:
    if abs(behind_s) <= EPOCH_LIMIT_S:
        return []
    why = (
        f"its clock is {'behind' if behind_s > 0 else 'ahead of'} {clock}, by the recording times; that includes the "
        f"difference of their transport delays{'' if kind in _ESTIMATED else ', which no bound includes'}"
    )
    return [_Told(behind_s, _ON_ITS_WAY_S, why)]


def _by_motion(kind: str, topic: str, inspection: Inspection) -> list[_Told]:
    """Return how late the stamps of a topic are, by its motion or turns; empty if these do not tell."""
    reports: dict[str, Sequence[GnssReport | VelocityReport | CompassReport]] = {
        "gnss": inspection.gnss,
        "gnss_velocity": inspection.velocities,
        "compass": inspection.compasses,
    }
    for report in reports.get(kind, ()):
        if bare_topic(report.topic) == topic and report.late_s:
            late_s, sigma_s = report.late_s
            why = f"{_fits(report)} {late_s:+.2f} +- {sigma_s:.2f} s from its stamps"
            return [_Told(late_s, max(sigma_s, _STAMPED_LATE_S), why)]
    return []


def _fits(report: GnssReport | VelocityReport | CompassReport) -> str:
    if not isinstance(report, GnssReport) and report.late_with_fixes:
        return FITS_WITH_FIXES
    if isinstance(report, CompassReport):
        return "its turns fit the gyro's"
    by = report.late_by if isinstance(report, GnssReport) else ""
    other = by if bare_topic(by) != bare_topic(report.topic) else ""
    whose = f"the motion of {other}, taken for the same receiver's," if other else "its motion"
    return f"what the IMU feels fits {whose}"


def _by_sentences(kind: str, topic: str, inspection: Inspection) -> list[_Told]:
    """Return how long after the times in its sentences an NMEA topic is stamped; empty if that is no delay of messages.

    A computer's clock that nothing sets may be as far off by chance: so what the IMU feels is believed first, even if
    it is only a hint.
    """
    told = [t.after_s for t in inspection.topics if bare_topic(t.topic) == topic and t.after_s]
    if kind not in _ESTIMATED or not told:
        return []
    least, after, most = min(told, key=lambda points: points[2] - points[0])
    if not _LEAST_AFTER_S <= after <= _MOST_AFTER_S or most - least > _EVEN_S:
        return []
    hinted = _hinted(topic, inspection)
    if hinted and abs(hinted[0] + after) > 2.0 * hinted[1]:
        return []
    why = f"its sentences tell a time {after:.2f} s ({least:.2f} to {most:.2f}) before they are stamped: right if the computer's clock is"
    return [_Told(-after, max(_ON_ITS_WAY_S, 0.5 * after), why)]


def clock_lines(inspection: Inspection) -> list[str]:
    """Return lines on sensors that are stamped by another clock than the IMU's."""
    topics = _by_topic(inspection)
    named = [imu.topic for imu in inspection.imus] + [gnss.topic for gnss in inspection.gnss]
    named += [twist.topic for twist in inspection.velocities] + [compass.topic for compass in inspection.compasses]
    lines = []
    for topic in dict.fromkeys(bare_topic(name) for name in named):
        behind, clock = _behind(topic, topics, inspection) or (0.0, "")
        if abs(behind) > EPOCH_LIMIT_S:
            way = "behind" if behind > 0.0 else "ahead of"
            whose = f"{clock} is " if behind > 0.0 else ""
            gps = abs(abs(behind) - GPS_AHEAD_S) < LEAP_S
            why = f": {whose}GPS time, which is ahead of UTC by 18 s" if gps else ""
            if _takes_long(behind, topics, inspection):
                lines.append(f"{topic}: {_LONG_ON_ITS_WAY.format(behind)}")
                continue
            off = f"{topic}: its clock is {abs(behind):.1f} s {way} {clock}, by the recording times"
            lines.append(f"{off}{why}; drafted as time_offset_s")
    return lines


def _behind(topic: str, topics: Mapping[str, TopicReport], inspection: Inspection) -> tuple[float, str] | None:
    """Return by how much the clock of a topic is behind the reference, s, by the recording times, and the name of that.

    None without an IMU, or if the topic has no stamps.
    """
    clocks = {n: Clock(t.start_ns, t.latency_s[1]) for n, t in topics.items() if t.start_ns is not None and t.latency_s}
    imu = next((clocks[i.topic] for i in inspection.imus if i.topic in clocks), None)
    if imu is None or topic not in clocks:
        return None
    own = (c for n, c in clocks.items() if not topics[n].recorded and topics[n].msgtype not in UNSTAMPED)
    reference = reference_of(imu, own)
    return behind_s(clocks[topic], imu, reference), "the IMU's" if reference is imu else "one that tells the date"


def scan_clock_lines(inspection: Inspection, lidars: tuple[MountedTopic, ...]) -> list[str]:
    """Return lines on how far the clocks of LiDARs are off the IMU's, by the recording times.

    Empty if they are not, or if the IMU's own clock is off. Where recording times replace the stamps, only the sigma.
    """
    topics = _by_topic(inspection)
    imu_s = next((t.latency_s[1] for i in inspection.imus if (t := topics.get(i.topic)) and t.latency_s), None)
    own_s = [lidar.latency_s for lidar in lidars if lidar.latency_s is not None]
    if recorded_lines(inspection, lidars):
        return [
            f"  stamp_sigma_s: {_ON_ITS_WAY_S:.2f}  # guess: how long a message takes is not known; estimated with the run"
        ]
    # Another clock than the IMU's is taken for the right one.
    if imu_s is None or abs(imu_s) > EPOCH_LIMIT_S or not own_s:
        return []
    ahead_s = imu_s - min(own_s)
    if -MOST_ON_ITS_WAY_S <= ahead_s <= SCANS_AHEAD_S:
        return []
    way = "ahead of" if ahead_s > 0.0 else "behind"
    said = f"by the recording times their clock is {way} the IMU's by {abs(ahead_s):.2f} s, the difference of their transport delays included"
    if abs(ahead_s) <= EPOCH_LIMIT_S:
        return [f"  stamp_sigma_s: {abs(ahead_s):.2f}  # guess: {said}; estimated with the run"]
    return [
        f"  time_offset_s: {-ahead_s:.3f}  # guess: {said}",
        f"  stamp_sigma_s: {_ON_ITS_WAY_S:.2f}  # guess: that difference, estimated with the run",
    ]


def recorded_lines(inspection: Inspection, mounted: tuple[MountedTopic, ...]) -> list[str]:
    """Return the line that recording times replace the stamps of scans or images, if these have none or another clock.

    Not if all stamps in the bag are far from the recording times: then recording times are not on the IMU's clock
    either.
    """
    usual = [t.latency_s[1] for t in inspection.topics if t.latency_s and t.count >= _FEWEST_STAMPS]
    if all(abs(latency_s) > EPOCH_LIMIT_S for latency_s in usual):
        return []
    for item in mounted:
        if item.latency_s is None or abs(item.latency_s) > _OWN_CLOCK_S:
            clock = (
                "have no stamps" if item.latency_s is None else f"are stamped {item.latency_s:+.0f} s before they come"
            )
            return [
                f"  stamps: recorded  # guess: messages of {item.topic} {clock}; recording times are late by the transport delay"
            ]
    return []
