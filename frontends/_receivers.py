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
from graphloc.frontends._streams import TopicData
from graphloc.frontends.decode import FIX_TYPES
from graphloc.frontends.time_offsets import MotionOffset, later_than

Late = Mapping[str, tuple[float, float]]
"""How late the stamps of the fixes are, s, and 1 sigma, by receiver (`receiver_of`)."""
_NONE: Mapping[str, str] = {}
_FAR_BEYOND = 3.0  # times as far as another one's height wanders
_SAME_M = 0.05  # by which two topics of one receiver wander against each other at most
_SAME_WAY_S = 0.1  # within which messages of one device are recorded after their stamps
# Of the run, from which a receiver is there throughout; of the fixes, from which it says as much as another.
_COVERS = 0.8


def receivers_of(bag: Contents, elsewhere: Mapping[str, str] = _NONE) -> list[GnssReport]:
    """Report the receivers, the best one first.

    Args:
        elsewhere: why a receiver, by topic, is not of this craft.
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
    """Return the receiver of a stream: its topic; of NMEA the talker on it, whose sentences tell one position, with a height or without."""
    name, _, sentence = topic.partition(" ")
    return name if sentence[:1] in ("", "(") else f"{name} {sentence[:2]}"


def _octave(gnss: GnssReport, wanders_m: float | None, level_m: float, *, claimed: bool) -> int:
    """Return how large the fixes' error is by what they claim, or scatter or drift by, in powers of two: closer ones are taken for equal.

    Args:
        wanders_m: by how much the receiver's height wanders, 1 sigma; None where it tells none.
        level_m: by how much the heights of that receiver wander whose heights wander least, 1 sigma. All ride on one craft: what others
            wander by far beyond it is their drift, and the horizontal one is half of the vertical. Up to that it may be hills, which
            receivers smooth.
        claimed: whether one of the receivers claims anything; where none does, their heights alone compare them.
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
    """Return the report with by how much it and the other receiver that it agrees with best wander against each other, and how far off others sit."""
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
    """Return the report with how late the fixes' stamps are: by the fixes, or by a velocity over ground that tells it better.

    A receiver measures both at once. One that is recorded at another time after its stamps is taken for another device. Plotters
    average course and speed over seconds, and not the place: a velocity that shows the same motion later than the fixes tells nothing of
    them.
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
    """Return whether messages are recorded as long after their stamps as the fixes are, as those of one device."""
    latency_s, own_s = (usual_latency_s(s.stamps_ns, s.logs_ns) for s in (fixes, velocity))
    return velocity.recorded == fixes.recorded and abs(own_s - latency_s) < _SAME_WAY_S


def timed_velocity(report: VelocityReport, late: MotionOffset | None, together: Late) -> VelocityReport:
    """Return the report with how late its stamps are: by its motion; where that is not clear, by the fixes of the same messages, unless it denies them."""
    if late is not None and late.clear:
        return replace(report, late_s=late[:2])
    fixes_late_s = together.get(receiver_of(report.topic))
    if fixes_late_s is None or (late and late.denies(MotionOffset(*fixes_late_s, clear=True))):
        return report
    return replace(report, late_s=fixes_late_s, late_with_fixes=True)


def with_wander(
    gnss: GnssReport, fixes: TopicData, wheels: Sequence[TopicData], velocities: Sequence[MeasuredMotion]
) -> GnssReport:
    """Return the report with how fast the fixes' error changes, by the first wheels, or velocity, that is no filter's output.

    A receiver's velocity is by Doppler, on which multipath has little effect.
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
    """Return a velocity's motion with what it shows later than the fixes taken off its times: else braking looks like an error of these."""
    later = later_than(fixes, velocity)
    return replace(velocity, t_s=velocity.t_s - later[0]) if later else velocity
