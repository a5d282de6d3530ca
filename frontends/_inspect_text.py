# SPDX-License-Identifier: Apache-2.0
"""An inspection as text for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice

from graphloc.errors import printable
from graphloc.frontends._draft_clock import clock_lines
from graphloc.frontends._reports import (
    FITS_WITH_FIXES,
    CompassReport,
    GnssReport,
    ImuReport,
    Inspection,
    MountedTopic,
    OdometryReport,
    TopicReport,
    of_nmea,
)
from graphloc.frontends.msgtypes import UNSTAMPED
from graphloc.plain import aligned
from graphloc.time import utc_text

_MOST_NAMED = 12  # most unread sentences that are named
_MOST_AFTER_S = 60.0  # a clock that is set is off by less
# How the draft names an odometry or pose topic, by its role.
_DRAFTED = {"truth": "truth_topic", "check_speed": "check_speed_topic", "pose": "a sensor of kind pose, switched off"}


def render(inspection: Inspection) -> str:
    """Return the inspection as text for a terminal."""
    lines = [inspection.source, ""]
    lines += _topic_table(inspection.topics)
    lines += clock_lines(inspection)
    for imu in inspection.imus:
        lines += ["", *_imu_lines(imu)]
    for gnss in inspection.gnss:
        lines += ["", *_gnss_lines(gnss)]
    for compass in inspection.compasses:
        lines += ["", *_compass_lines(compass)]
    for twist in inspection.velocities:
        lines += ["", f"{twist.topic}: velocity, axes {twist.looks or 'not known'}", f"  {twist.why}"]
        lines += [f"  {twist.side.said}"] if twist.side else []
    for item in inspection.odometry:
        lines += ["", f"{item.topic}: {_fate(item)}", f"  {item.why}; {item.world}"]
    counts = {t.topic: t.count for t in inspection.topics}
    lines += _mounted_lines(inspection.lidars, counts, "scans", "aerial", "a map")
    lines += _mounted_lines(inspection.cameras, counts, "images", "apriltag", "a survey of tags")
    if inspection.tf_frames:
        lines += ["", f"frames in tf: {', '.join(inspection.tf_frames)}"]
    lines += [f"warning: {w}" for w in inspection.warnings]
    return "\n".join(printable(line) for line in lines)


def _compass_lines(compass: CompassReport) -> list[str]:
    verdict = f"fits as a compass ({compass.convention})" if compass.usable else "not usable as a compass"
    lines = [f"{compass.topic}: {verdict}", f"  {compass.why}"]
    if compass.backwards and not compass.like:
        lines.append(
            "  half a turn off the course: drafted as mounted backwards. If the vessel went astern most of the time, that turns every "
            "heading by half a turn: set its mount's yaw to 0, and turn that of the IMU by 180 where it is by the motion"
        )
    if compass.late_s:
        fits = FITS_WITH_FIXES if compass.late_with_fixes else "its turns fit the gyro's"
        lines.append("  {} {:+.2f} +- {:.2f} s from its stamps".format(fits, *compass.late_s))
    return lines


def _mounted_lines(
    mounted: Sequence[MountedTopic], counts: Mapping[str, int], what: str, kind: str, need: str
) -> list[str]:
    """Return lines on LiDARs or cameras: their numbers of messages, of `what`, and what a sensor of `kind` needs."""
    if not mounted:
        return []
    lines = [""]
    for m in mounted:
        counted = f"{m.topic}: {counts[m.topic]} {'lists of tags' if m.listed else what}"
        lines.append(f"{counted}; left out, {m.left_out}" if m.left_out else counted)
    if any(not m.left_out for m in mounted):
        lines.append(f"  read by a sensor of kind {kind}, which the draft has switched off until there is {need}")
    return lines


def _fate(item: OdometryReport) -> str:
    if item.grid:
        return "in a map grid"
    if item.role == "other":
        return "left out"
    if item.role == "check_speed" and not item.fused:
        return f"drafted as {_DRAFTED[item.role]}, and as a sensor that is switched off: fused, it holds the track where fixes fail or are wrong"
    return f"drafted as {_DRAFTED[item.role]}{', switched off' if item.role == 'truth' and item.origin is None else ''}"


def _topic_table(topics: Sequence[TopicReport]) -> list[str]:
    rows = [("topic", "type", "count", "Hz", "span s", "gaps", "longest s", "repeated", "backward", "latency s")]
    for t in topics:
        told = None if t.recorded or t.msgtype in UNSTAMPED else t.latency_s  # no stamps: how late is not known
        latency = "-" if told is None else f"{told[1]:.3f} ({told[0]:.3f}..{told[2]:.3f})"
        rows.append(
            (
                t.topic,
                t.msgtype.replace("/msg/", "/"),
                str(t.count),
                _number(t.rate_hz, ".1f"),
                _number(t.span_s, ".1f"),
                _number(t.gaps, "d"),
                _number(t.max_gap_s, ".2f"),
                _number(t.repeated, "d"),
                _number(t.backward, "d"),
                latency,
            )
        )
    lines = aligned(rows)
    starts = [t.start_ns for t in topics if t.start_ns is not None]
    if starts:
        lines.append(f"starts {utc_text(min(starts))}")
    for t in topics:
        if t.recorded:
            lines.append(
                f"{t.topic}: its headers hold no stamps (all zero, all the same, or whole seconds): recording times are used"
            )
        if t.after_s and abs(t.after_s[1]) < _MOST_AFTER_S:
            lines.append(
                f"{t.topic}: stamped {t.after_s[1]:.2f} s ({t.after_s[0]:.2f}..{t.after_s[2]:.2f}) after the time that it tells"
            )
        if t.unread:
            named = [f"{name} ({n})" for name, n in islice(t.unread.items(), _MOST_NAMED)]
            lines.append(
                f"{t.topic}: of its sentences not read: {', '.join(named)}{', ...' if len(t.unread) > _MOST_NAMED else ''}"
            )
        if t.undecodable or t.no_stamp:
            why = f" as {t.msgtype} ({t.broken})" if t.broken else ""
            lines.append(f"{t.topic}: {t.undecodable} messages cannot be decoded{why}, {t.no_stamp or 0} have no stamp")
    return lines


def _number(value: float | None, spec: str) -> str:
    return "-" if value is None else format(value, spec)


def _imu_lines(imu: ImuReport) -> list[str]:
    x, y, z = imu.gravity_axis
    lines = [
        f"{imu.topic}: acceleration {imu.gravity_size:.2f} (median), along {x:+.2f} {y:+.2f} {z:+.2f}",
        *(f"  {why}" for why in imu.why),
        f"  mount: rpy {', '.join(f'{a:.1f}' for a in imu.mount.rpy_deg)} deg; {imu.mount.evidence}",
    ]
    if imu.unfinite:
        lines.append(f"  {imu.unfinite} messages hold an acceleration or a rate that is NaN, and are not used")
    if imu.gyro_bias_radps is None:
        lines.append("  no standstill found, so the gyro bias was not measured")
    else:
        bias = ", ".join(f"{b:+.5f}" for b in imu.gyro_bias_radps)
        lines.append(f"  standstill {imu.still_s:.1f} s: gyro bias {bias} rad/s")
    noise = f"{imu.accel_noise_ug:.0f} ug/sqrt(Hz) and {imu.gyro_noise_mdps:.1f} mdeg/s/sqrt(Hz)"
    return [*lines, f"  noise of the worst axis, vibration included: {noise}"]


def _gnss_lines(gnss: GnssReport) -> list[str]:
    statuses = ", ".join(f"{n} {s}" for s, n in gnss.statuses.items())
    lat, lon, height = gnss.first
    east_m, north_m = gnss.extent_m
    flat = gnss.without_height == gnss.fixes
    lines = [
        f"{gnss.topic}: {statuses}; first fix {lat:.7f}, {lon:.7f}{'' if flat else f', {height:.1f} m'}",
        f"  track {gnss.travelled_m:.0f} m in a box of {east_m:.0f} x {north_m:.0f} m"
        + ("" if flat else f", height {gnss.height_range_m:.1f} m"),
    ]
    if gnss.elsewhere:
        lines.append(f"  not used: {gnss.elsewhere}")
    if gnss.without_place:
        lines.append(f"  {gnss.without_place} fixes lie at 0, 0, are NaN or beyond 90 and 180 deg, and are not used")
    if gnss.outliers:
        lines.append(
            f"  {gnss.outliers} fixes lie so far off the others that no craft goes there and comes back; they are outliers"
        )
    if gnss.without_height:
        lines.append(f"  {gnss.without_height} messages have no height (NaN) and are used as horizontal fixes")
    if gnss.reported_sigma_m is not None:
        source = "sigma by quality" if of_nmea(gnss.topic) else "reported sigma"
        lines.append(f"  {source} east, north, up {' '.join(f'{s:.3f}' for s in gnss.reported_sigma_m)} m")
    if gnss.tf_frame is None:
        lines.append(
            "  no tf tells where its antenna sits: drafted at 0, 0, 0, and estimated with the run (mount_sigma_m); measured, "
            "bounds are narrower"
        )
    if gnss.scatter_m is not None:
        lines.append(
            f"  scatter from fix to fix        {' '.join(f'{s:.3f}' for s in gnss.scatter_m[: 2 if flat else 3])} m"
        )
    if gnss.wander:
        said = ", ".join(f"{change.m:.1f} m in {change.span_s:.0f} s" for change in gnss.wander)
        lines.append(f"  error changes by {said} along the way, by {gnss.wander_by}")
    return lines
