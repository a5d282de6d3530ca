# SPDX-License-Identifier: Apache-2.0
"""Receivers of a bag: the best one first, how late each is stamped, and how fast its error changes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

from graphloc.config import GnssConfig
from graphloc.frontends._assess import MeasuredMotion, gnss_report, motion_of_places, track
from graphloc.frontends._assess_receivers import apart, height_wanders_m
from graphloc.frontends._assess_wander import changes, way_of
from graphloc.frontends._clock import usual_latency_s
from graphloc.frontends._contents import Contents
from graphloc.frontends._reports import EAST_AXES, NORTH_AXES, GnssReport, VelocityReport, filtered
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import FIX_TYPES
from graphloc.frontends.time_offsets import MotionOffset, later_than

Late = Mapping[str, tuple[float, float]]
"""How late the stamps of the fixes are, s, and 1 sigma, by receiver (`receiver_of`)."""
_NONE: Mapping[str, str] = {}
_FAR_BEYOND = 3.0  # a height that wanders by over so many times the steadiest one's drifts
_SAME_M = 0.05  # two topics of one receiver wander against each other by no more
_SAME_WAY_S = 0.1  # latencies of messages of one device differ by less
# Least share of the longest duration of a receiver that is there throughout, and of the most fixes of one that has as
# many as others.
_COVERS = 0.8


def receivers_of(bag: Contents, elsewhere: Mapping[str, str] = _NONE) -> list[GnssReport]:
    """Report the receivers, the best one first.

    Args:
        bag: what was read. elsewhere: by topic, why a receiver is not of this craft.
    """
    found = [r for s in bag.of_type(*FIX_TYPES) if (r := gnss_report(bag.streams[s.topic], bag.tf_frame(s)))]
    found = [replace(r, elsewhere=elsewhere.get(r.topic, "")) for r in found]
    longest_s = max((r.spans_s for r in found), default=0.0)
    rivals = [r for r in found if r.spans_s >= _COVERS * longest_s and not filtered(r.topic) and not r.elsewhere]
    most = max((r.fixes for r in rivals), default=0)
    level_m = min((m for r in rivals if (m := height_wanders_m(r)) is not None), default=0.0)
    heights_m = {receiver_of(r.topic): m for r in found if (m := height_wanders_m(r)) is not None}
    claimed = any(r.reported_sigma_m for r in rivals)
    found.sort(
        key=lambda r: (
            bool(r.elsewhere),
            filtered(r.topic),
            r.spans_s < _COVERS * longest_s,
            r.slow_error,
            _octave(r, heights_m.get(receiver_of(r.topic)), level_m if r in rivals else math.inf, claimed=claimed),
            r.fixes < _COVERS * most,
            r.without_height == r.fixes,
            -r.fixes,
            r.without_height,
        )
    )
    return [report if report.elsewhere else _beside_others(report, rivals, bag) for report in found]


def receiver_of(topic: str) -> str:
    """Return the name of the receiver of a stream: its topic, of NMEA with the talker.

    Sentences of one talker tell one position, with or without a height.
    """
    name, _, sentence = topic.partition(" ")
    return name if sentence[:1] in ("", "(") else f"{name} {sentence[:2]}"


def _octave(gnss: GnssReport, wanders_m: float | None, level_m: float, *, claimed: bool) -> int:
    """Return the size of the fixes' error, by claim, scatter or drift, as the rounded log2 of metres.

    Args:
        gnss: the receiver. wanders_m: by how much its height wanders, 1 sigma; None if it tells no height.
        level_m: the same of the receiver whose height wanders least. All receivers ride on one craft: a far larger
            wander is drift, of which the horizontal one is half. A smaller one may be hills, which receivers smooth.
        claimed: whether any receiver claims a sigma; if none does, only their heights compare them.
    """
    drift_m = 0.5 * wanders_m if wanders_m is not None and wanders_m > _FAR_BEYOND * level_m else 0.0
    if gnss.reported_sigma_m:
        taken_m = max(gnss.reported_sigma_m[:2])
    elif gnss.rtk_sigma_m:
        taken_m = gnss.rtk_sigma_m[0]
    elif claimed or wanders_m is None:
        taken_m = GnssConfig().default_horizontal_sigma_m
    else:
        taken_m = 0.5 * wanders_m
    return round(math.log2(max(taken_m, *(gnss.scatter_m or ())[:2], drift_m, 1e-3)))


def _beside_others(gnss: GnssReport, rivals: Sequence[GnssReport], bag: Contents) -> GnssReport:
    """Return the report with its wander against the receiver that it agrees with best, and the distance of antennas."""
    beside = {
        other.topic: found
        for other in rivals
        if other.topic != gnss.topic
        and (found := apart(gnss, other, bag.aligned[gnss.topic], bag.aligned[other.topic])) is not None
    }
    gnss = replace(gnss, keeps_m=max((found.keeps_m for found in beside.values()), default=0.0))
    wander = {topic: found.wander_m for topic, found in beside.items() if found.wander_m > _SAME_M}
    nearest = min(wander, key=lambda topic: wander[topic], default="")
    return replace(gnss, apart_m=wander[nearest], apart_from=nearest) if nearest else gnss


def timed_fixes(
    gnss: GnssReport,
    late: Mapping[str, MotionOffset | None],
    motions: Sequence[MeasuredMotion],
    velocities: Sequence[tuple[TopicData, VelocityReport]],
    streams: Mapping[str, TopicData],
) -> GnssReport:
    """Return the report with how late the fixes' stamps are, by the fixes or a velocity that tells it better.

    A receiver measures fixes and velocity at once. A velocity with another latency is taken for another device's.
    Plotters average course and speed over seconds, but not the position: a velocity that shows the motion later than
    the fixes tells nothing of them.

    Args:
        gnss: the receiver. late: by source, of `motion_time_offsets`. motions: by each source.
        velocities: streams and reports. streams: all, by name.
    """
    by_topic = {motion.source: motion for motion in motions}
    own_late = late.get(gnss.topic)
    gnss = replace(gnss, felt_s=own_late.value_s if own_late is not None and own_late.clear else None)
    candidates = {gnss.topic: own_late}
    for stream, report in velocities:
        said = late.get(stream.topic)
        if said is None or report.axes not in (EAST_AXES, NORTH_AXES) or filtered(stream.topic):
            continue
        denied = own_late is not None and own_late.denies(said)
        if denied or not _same_way(streams[gnss.topic], streams[stream.topic]):
            continue
        if said.is_of(by_topic.get(gnss.topic), by_topic[stream.topic]):
            candidates[stream.topic] = said
    known = {topic: found for topic, found in candidates.items() if found is not None and found.clear}
    if known:
        by = min(known, key=lambda topic: known[topic].sigma_s)
        return replace(gnss, late_s=known[by][:2], late_by=by)
    return replace(gnss, hinted_s=own_late[:2]) if own_late is not None and own_late.hinted else gnss


def _same_way(fixes: TopicData, velocity: TopicData) -> bool:
    """Return whether the latency of a velocity is that of the fixes, as of one device."""
    latency_s, own_s = (usual_latency_s(s.stamps_ns, s.logs_ns) for s in (fixes, velocity))
    return velocity.recorded == fixes.recorded and abs(own_s - latency_s) < _SAME_WAY_S


def timed_velocity(report: VelocityReport, late: MotionOffset | None, together: Late) -> VelocityReport:
    """Return the report with how late its stamps are, by its motion.

    If that is not clear, by the fixes of the same messages, unless its motion contradicts these.
    """
    if late is not None and late.clear:
        return replace(report, late_s=late[:2])
    fixes_late_s = together.get(receiver_of(report.topic))
    if fixes_late_s is None or (late and late.denies(MotionOffset(*fixes_late_s, clear=True))):
        return report
    return replace(report, late_s=fixes_late_s, late_with_fixes=True)


def with_wander(
    gnss: GnssReport, fixes: TopicData, wheels: Sequence[TopicData], velocities: Sequence[MeasuredMotion]
) -> GnssReport:
    """Return the report with how fast the fixes' error changes, by the first wheels or, without wheels, velocities.

    A receiver's velocity is by Doppler, on which multipath has little effect.

    Args:
        gnss, fixes: report and stream of the receiver. wheels, velocities: none of them outputs of a filter.
    """
    rolled = way_of(wheels[0]) if wheels else None
    stamps, p_m, _ = track(fixes)
    scatter_m = max(gnss.scatter_m[:2]) if gnss.scatter_m else 0.0
    moved = motion_of_places(gnss.topic, stamps, p_m)
    known = [(rolled, "the wheels")] if rolled else []
    if rolled is None and moved is not None:
        known = [(_at_the_time_of(moved, m), m.source) for m in velocities]
    for motion, name in known:
        if wander := changes(motion, stamps, p_m, scatter_m, turned=motion is rolled):
            return replace(gnss, wander=wander, wander_by=name)
    return gnss


def _at_the_time_of(fixes: MeasuredMotion, velocity: MeasuredMotion) -> MeasuredMotion:
    """Return a velocity's motion, its times corrected by its delay after the fixes.

    Otherwise braking looks like an error of the fixes.
    """
    later = later_than(fixes, velocity)
    return replace(velocity, t_s=velocity.t_s - later[0]) if later else velocity
