# SPDX-License-Identifier: Apache-2.0
"""Blocks of a drafted `vessel.yaml` on velocities: of receivers, Doppler logs and wheels."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import count

from graphloc.frontends._draft_lines import FILTERED, antenna_lines, filtered_lines, mount_line, numbered, topic_lines
from graphloc.frontends._reports import (
    BODY_AXES,
    EAST_AXES,
    NORTH_AXES,
    GnssReport,
    Inspection,
    OdometryReport,
    VelocityReport,
    bare_topic,
    filtered,
    through_water,
)
from graphloc.frontends._tf import WORLD_NAMES
from graphloc.frontends.msgtypes import VECTOR

_TO_STARBOARD = "xyz_m: [0.0, 0.0, 0.0], rpy_deg: [180.0, 0.0, 0.0]"
_UNKNOWN_MOUNT = (
    "  mount_sigma_m: 1.5  # guess: how far from the mount the place is that does not slip sideways (a car's rear axle); estimated with the run",
    "  mount_sigma_deg: 1.0  # guess: how far the way they roll is turned; estimated with the run",
)


def velocity_blocks(inspection: Inspection) -> Iterator[list[str]]:
    """Yield drafts of velocities; of those over ground, in world axes, one is used.

    Two velocities of one device repeat each other.
    """
    gnss = next(iter(inspection.gnss), None)
    known = [v for v in inspection.velocities if v.axes != "unknown"]
    told = [v for v in known if v.axes in (EAST_AXES, NORTH_AXES)] or [
        v for v in known if v.axes is None and v.msgtype != VECTOR
    ]
    used = min(told, key=lambda v: filtered(v.topic), default=None)
    body, world = count(), count()
    for twist in known:
        if twist.axes == BODY_AXES:
            yield _body_velocity_block(numbered("body_velocity", next(body)), twist)
        else:
            yield _velocity_block(numbered("gnss_velocity", next(world)), twist, gnss, _why_off(twist, used))
    for twist in inspection.velocities:
        if twist not in known:
            yield [f"# {twist.topic}: left out, it is no velocity of the craft; {twist.why}"]


def _why_off(twist: VelocityReport, used: VelocityReport | None) -> str | None:
    """Return why a velocity over ground is switched off; None if it is the one that is used."""
    if twist.axes is None and twist.msgtype == VECTOR:
        return f"nothing shows that it is a velocity; {twist.why}"
    if twist is used:
        return None
    if filtered(twist.topic):
        return FILTERED
    return f"true if it comes from another receiver than {used.topic if used else 'that'}; {twist.why}"


def _body_velocity_block(name: str, twist: VelocityReport) -> list[str]:
    turned = ", rpy_deg: [0.0, 0.0, 180.0]" if twist.reverse else ""
    frame = f"tf_frame: {json.dumps(twist.tf_frame)}" if twist.tf_frame else f"xyz_m: [0.0, 0.0, 0.0]{turned}"
    known = "from tf" if twist.tf_frame else "guess: where it sits is not in the bag; measure it"
    water = through_water(twist.topic)
    fuse = "true to fuse it" if water else "true to fuse it, through: water for a speed log"
    lines = [f"{name}:", "  kind: body_velocity", *topic_lines(twist.topic), *(["  through: water"] if water else [])]
    if twist.mount:
        return [
            *lines,
            f"  enabled: false  # guess: true to fuse it; {twist.why}",
            "  axes: [x, y, z]",
            mount_line(twist.mount),
        ]
    if twist.side:
        return [
            *lines,
            f"  enabled: false  # guess: {fuse}; its axes look {twist.looks}; {twist.why}",
            f"  axes: [x, y{', z' if twist.rises else ''}]  # guess: {twist.side.said}",
            f"  mount: {{{frame if twist.side.to_port else _TO_STARBOARD}}}  # {known}",
            "  mount_sigma_m: 1.0  # guess: how far off that may be: of speeds to the side it counts; estimated with the run; 0 once it is measured",
            "  mount_sigma_deg: 1.0  # guess: how far its yaw is off; estimated with the run",
        ]
    beside = "" if not twist.unsided else "; x alone is read: axes: [x, y, z] reads all, if y looks to port and z up"
    return [
        *lines,
        f"  enabled: false  # guess: {fuse}; its axes look {twist.looks}; {twist.why}{beside}",
        *(["  axes: [x, y]"] if twist.sideways else []),
        f"  mount: {{{frame}}}  # {known}",
    ]  # fmt: skip


def _velocity_block(name: str, twist: VelocityReport, gnss: GnssReport | None, off: str | None) -> list[str]:
    lines = [f"{name}:", "  kind: gnss_velocity", *topic_lines(twist.topic)]
    if off is not None:
        lines.append(f"  enabled: false  # guess: {off}")
    else:
        lines[-1] += f"  # guess: a velocity in {twist.axes or EAST_AXES}; {twist.why}"
        lines += filtered_lines(twist.topic)
    if twist.axes == NORTH_AXES:
        lines.append("  convention: ned  # guess: by the GNSS track")
    if (said := _of_antenna(twist, gnss)) is not None:
        return [*lines, f"  antenna: {numbered('gnss', 0)}  # guess: {said}; it sits where that does"]
    frame = twist.tf_frame or (gnss.tf_frame if gnss else None)
    evidence = "from tf" if twist.tf_frame else "guess: the antenna of the GNSS receiver"
    return [*lines, *antenna_lines(frame, evidence, gnss.keeps_m if gnss else 0.0)]


def _of_antenna(twist: VelocityReport, gnss: GnssReport | None) -> str | None:
    """Return the evidence that a velocity is of a receiver's antenna, whose place nothing tells; None if there is none.

    A filter's output is of another place than the fixes that went into it.
    """
    if gnss is None or gnss.tf_frame or twist.tf_frame or filtered(gnss.topic) != filtered(twist.topic):
        return None
    if bare_topic(gnss.topic) == bare_topic(twist.topic):
        return "of the same topic"
    told = twist.frame_id and twist.frame_id == gnss.frame_id and twist.frame_id.strip("/") not in WORLD_NAMES
    return f"both have the frame '{twist.frame_id}'" if told else None


def wheels_block(name: str, item: OdometryReport) -> list[str]:
    """Return a draft of wheels, switched off."""
    turned = ["  mount: {rpy_deg: [0.0, 0.0, 180.0]}  # guess: its sign looks wrong"] if item.reverse else []
    return [
        f"{name}:", "  kind: body_velocity", f"  topic: {item.topic}",
        "  enabled: false  # guess: true to fuse it (it tells the heading, too), if held-out fixes are predicted no worse (fix_rmse_m); then delete check_speed_topic",
        "  axes: [x, y]  # guess: wheels do not slip sideways; x alone tells the heading by its cosine only, and may not converge",
        *turned,
        *_UNKNOWN_MOUNT,
    ]  # fmt: skip
