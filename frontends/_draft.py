# SPDX-License-Identifier: Apache-2.0
"""A first `vessel.yaml` from an inspection: it works as it is, and every guess is marked as one."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from graphloc.config import CompassConfig, ImuConfig
from graphloc.frames import rotation_from_rpy_deg
from graphloc.frontends._assess_mount import yawed
from graphloc.frontends._draft_clock import with_clock
from graphloc.frontends._draft_lines import FILTERED, mount_line, numbered, topic_lines
from graphloc.frontends._draft_receivers import receiver_blocks
from graphloc.frontends._draft_scanners import scanner_blocks
from graphloc.frontends._draft_velocities import velocity_blocks, wheels_block
from graphloc.frontends._reports import (
    TURNED_DEG,
    CompassReport,
    ImuReport,
    Inspection,
    MountGuess,
    OdometryReport,
    bare_topic,
    filtered,
)
from graphloc.frontends._turns import WANDERS_DEG
from graphloc.frontends.msgtypes import IMU, POINT

_MAGNETIC = ("HDG", "HDM")  # endings of the names of NMEA streams
# Wander of a compass from which it is drafted, in deg and as a multiple of the usual one: in heavy waves the comparison
# with the gyro shows 0.6 deg by itself.
_WANDER_DEG, _LARGER = 0.7, 1.4
_LEEWAY_DEG = 5.0  # by which the mean course of a vessel may differ from her heading
# Wander, deg, and its time constant, s, of a yaw without a north: cheap ones drift 1 deg in half a minute; a choice.
_DRIFTS = (10.0, 600.0)
_UNKNOWN_DEG = 10.0  # error of a magnetic compass on most coasts, 1 sigma
_COMPASS_SIGMA_DEG = 2.0  # an offset up to this is covered by the default of a compass's mount offset


def draft_config(inspection: Inspection) -> str:
    """Return the YAML text of a configuration for a bag. Lines with `# guess:` are to be checked."""
    name = Path(inspection.source.split(", ")[0]).stem or "vessel"
    lines = [
        f"# A first configuration for {inspection.source}, written by `graphloc inspect`.",
        "# Look at each line marked 'guess'. All keys and their defaults: docs/configuration.md.",
        f"vessel: {json.dumps(name)}",
        f"body_frame: {inspection.body_frame}"
        + ("" if inspection.body_frame == "base_link" else "  # guess: the body, by tf"),
        _datum_line(inspection),
        "sensors:" if inspection.usable else "sensors: {}  # nothing in this bag can be used",
    ]
    blocks = [with_clock(_in_body(block, inspection), inspection) for block in _blocks(inspection)]
    lines += [f"  {line}" for block in blocks for line in block]
    lines += _beside(_other_odometry(inspection))
    return "\n".join(lines) + "\n"


def _blocks(inspection: Inspection) -> Iterator[list[str]]:
    """Yield a draft of each sensor, the most important first, and a comment on each topic that is left out."""
    for k, imu in enumerate(inspection.imus):
        yield _imu_block(numbered("imu", k), imu, enabled=k == 0 and not imu.missing)
    yield from receiver_blocks(inspection)
    yield from _compass_blocks(inspection.compasses)
    yield from velocity_blocks(inspection)
    yield from _odometry_blocks(inspection)
    yield from scanner_blocks(inspection)
    placed = inspection.gnss or inspection.in_a_grid or any(item.role == "pose" for item in inspection.odometry)
    if placed or not all(lidar.left_out for lidar in inspection.lidars):
        alone = "" if placed else "; nothing else tells the height"
        yield ["height:", f"  enabled: false  # guess: true for a vessel that floats{alone}"]


def _compass_blocks(compasses: Sequence[CompassReport]) -> Iterator[list[str]]:
    """Yield drafts of headings, true before magnetic ones, filters' last; of other orientations, why they are none."""
    usable = (c for c in compasses if c.usable)
    seen: set[str] = set()
    for k, compass in enumerate(sorted(usable, key=lambda c: (filtered(c.topic), c.topic.endswith(_MAGNETIC)))):
        name = bare_topic(compass.topic)
        off = "another heading of the same topic is used, a true one before a magnetic one" if name in seen else ""
        if k and filtered(compass.topic):
            off = "by its name, or its messages, a filter's output, which the other heading may be in already"
        yield _compass_block(numbered("compass", k), compass, off)
        seen.add(name)
    for compass in compasses:
        if not compass.usable:
            yield [f"# orientation of {compass.topic}: left out as a compass; {compass.why}"]


def _odometry_blocks(inspection: Inspection) -> Iterator[list[str]]:
    """Yield drafts of wheels and poses, switched off; of other odometry, why it is left out."""
    odometry = _other_odometry(inspection)
    speeds = [item for item in odometry if item.role == "check_speed"]
    for item in speeds:
        if item.fused:
            better = (
                f"no truth_topic: {item.world}" if item.origin is None else "truth_topic if it is better than they are"
            )
            yield [f"# {item.topic}: not fused, as it has used receiver and IMU already; {better}; {item.why}"]
    for k, item in enumerate(item for item in speeds if not item.fused):
        yield wheels_block(numbered("wheels", k), item)
    alone = not inspection.gnss and not inspection.in_a_grid
    for k, item in enumerate(item for item in odometry if item.role == "pose"):
        yield _pose_block(numbered("pose", k), item, alone=alone)
    for item in odometry:
        if item.role == "other":
            instead = ": take the receiver's NavSatFix" if inspection.gnss and item.grid else ""
            yield [f"# {item.topic}: left out, {item.world}{instead}"]


def _other_odometry(inspection: Inspection) -> list[OdometryReport]:
    """Return odometry and poses, except those in a map grid that stand for fixes."""
    return [item for item in inspection.odometry if item not in inspection.in_a_grid]


def _pose_block(name: str, item: OdometryReport, *, alone: bool) -> list[str]:
    """Return a draft of poses; `alone`: nothing else tells the position."""
    measured = "x, y, z" if item.msgtype == POINT else "x, y, z, yaw"
    return [
        f"{name}:",
        "  kind: pose",
        f"  topic: {item.topic}",
        f"  # its frame '{item.frame_id}': {item.world}",
        *([f"  axes: [{measured}]"] if item.msgtype == POINT or alone else []),
        "  enabled: false  # guess: true if its frame is east-north-up at the datum and no fix went into it",
        "  # slow_error: {sigma_m: 1.0, time_constant_s: 60}  # where errors last (USBL, UWB, a filter's output); else they count as independent",
    ]


def _in_body(block: list[str], inspection: Inspection) -> list[str]:
    """Return the block with its mounts by tf as numbers, if the axes of tf's body are ahead, to starboard, down."""

    def numbers(line: str) -> str:
        head, found, rest = line.partition("mount: {tf_frame: ")
        frame, brace, _ = rest.partition("}")
        if not found or not brace or json.loads(frame) not in inspection.in_body:
            return line
        xyz, rpy = (
            ", ".join(f"{round(x, n) + 0.0:.{n}f}" for x in v)
            for v, n in zip(inspection.in_body[json.loads(frame)], (3, 1), strict=True)
        )
        said = f"{json.loads(frame)} of tf, whose body looks ahead, to starboard, down, by gravity and the antennas below it: turned"
        return f"{head}mount: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}  # guess: {said}"

    return [numbers(line) for line in block] if inspection.in_body else block


def _imu_block(name: str, imu: ImuReport, *, enabled: bool) -> list[str]:
    lines = [f"{name}:", "  kind: imu", f"  topic: {imu.topic}"]
    reason = "; ".join(imu.why)
    if not enabled:
        why = (
            reason
            if imu.missing
            else "one IMU is used: a whole one, with gravity in it, that feels how the vessel moves, and with least gyro noise, of about equal ones that whose mount tf or the motion tells"
        )
        lines.append(f"  enabled: false  # guess: {why}")
    if imu.accel_unit != "m/s^2":
        lines.append(f"  accel_unit: {imu.accel_unit}  # guess: {reason}")
    if imu.gyro_unit != "rad/s" or imu.fast:
        lines.append(f"  gyro_unit: {imu.gyro_unit}  # guess: {reason}")
    if imu.gravity != "included":
        lines.append(f"  gravity: {imu.gravity}  # guess: {reason}")
    lines.append(mount_line(imu.mount))
    lines += _mount_sigma_lines(imu.mount)
    lines += _noise_lines(imu)
    return lines


def _mount_sigma_lines(mount: MountGuess) -> list[str]:
    """Return the mount's sigmas where gravity and the motion leave more open than the default."""
    beyond = np.array([mount.tilt_sigma_deg, mount.tilt_sigma_deg, mount.yaw_sigma_deg])
    if mount.tf_frame is not None or not beyond.any():
        return []
    known = np.degrees(ImuConfig().mount_sigma_rad)
    sigmas = ", ".join(f"{sigma:.1f}" for sigma in np.hypot(known, beyond))
    return [
        f"  mount_sigma_deg: [{sigmas}]  # guess: what gravity and the motion leave open; {known[0]:g} once it is measured"
    ]


def _noise_lines(imu: ImuReport) -> list[str]:
    """Return the measured noise as a comment, and as keys where it is more than the default."""
    default = ImuConfig()
    noise = f"{imu.accel_noise_ug:.0f} ug, {imu.gyro_noise_mdps:.1f} mdps per sqrt(Hz)"
    lines = [f"  # measured, worst axis, vibration included: {noise}"]
    if imu.accel_noise_ug > default.accel_noise_ug_per_sqrt_hz:
        lines.append(f"  accel_noise_ug_per_sqrt_hz: {imu.accel_noise_ug:.0f}  # guess: as measured")
    if imu.gyro_noise_mdps > default.gyro_noise_mdps_per_sqrt_hz:
        lines.append(f"  gyro_noise_mdps_per_sqrt_hz: {imu.gyro_noise_mdps:.1f}  # guess: as measured")
    return lines


def _compass_block(name: str, compass: CompassReport, off: str) -> list[str]:
    lines = [
        f"{name}:",
        "  kind: compass",
        *topic_lines(compass.topic),
        f"  convention: {compass.convention}  # guess: {compass.why}",
    ]
    if compass.unit is not None:
        lines.append(f"  unit: {compass.unit}  # guess: by the size of its numbers")
    if compass.like:
        lines.append(f"  enabled: false  # guess: it repeats {compass.like}, and must not count twice")
    elif off:
        lines.append(f"  enabled: false  # guess: {off}")
    elif filtered(compass.topic):
        lines.append(f"  # guess: {FILTERED}; enabled: false where it is a reference to compare with")
    lines += [*_tilted_line(compass), *_mount_lines(compass)]
    lines += _error_lines(compass)
    if (compass.msgtype == IMU or filtered(compass.topic)) and not compass.two_antennas:
        lines.append("  use_reported_sigma: false  # guess: drivers' orientation covariances are seldom measured")
    return lines


def _error_lines(compass: CompassReport) -> list[str]:
    """Return the keys on errors that vary with time or heading: by iron, which does not affect two antennas."""
    wander = compass.wander_deg or 0.0
    gnss = compass.two_antennas and wander < WANDERS_DEG
    usual = 0.2 if gnss else CompassConfig().wander_sigma_deg
    if gnss:
        lines = [
            "  deviation_sigma_deg: 0.0  # guess: a heading of GNSS by its topic or message; 1.5 for a magnetic compass"
        ]
        why = "a heading of GNSS; 0.5 for a magnetic compass"
    else:
        sigma, seen = CompassConfig().deviation_sigma_deg, "a magnetic compass; 0 for a GNSS compass"
        if compass.deviation_deg is not None and compass.deviation_deg > sigma:
            sigma, seen = compass.deviation_deg, "as it varies with the heading beside the gyro: iron near it; swing it"
        lines = [f"  deviation_sigma_deg: {sigma:.1f}  # guess: {seen}"]
        why = "passing errors near iron; 0.2 for a GNSS compass"
    if wander > max(_WANDER_DEG, _LARGER * usual):
        usual, why = wander, "as it wanders beside the gyro; iron near it, or its own filter"
    if compass.drifts:
        usual = max(_DRIFTS[0], usual)
        why = "its north is its own, as without a magnetometer, so it drifts; 0.5 if it is magnetic"
    lines.append(f"  wander_sigma_deg: {usual:.1f}  # guess: {why}")
    return [*lines, f"  wander_time_constant_s: {_DRIFTS[1]:.0f}  # guess: likewise"] if compass.drifts else lines


def _tilted_line(compass: CompassReport) -> list[str]:
    """Return the mount of an orientation whose x axis is tilted as its IMU is; none of another one."""
    mount, yaw = compass.mount, compass.turned_deg
    if mount is None:
        return []
    if mount.tf_frame is not None and yaw == 0.0:
        return [f"  mount: {{tf_frame: {json.dumps(mount.tf_frame)}}}  # as its IMU"]
    rpy = yawed(yaw, rotation_from_rpy_deg(np.array(mount.rpy_deg)))
    off = f", turned by {yaw:.0f} deg: constant offset to the GNSS course" if yaw else ""
    return [f"  mount: {{rpy_deg: [{', '.join(f'{a:.1f}' for a in rpy)}]}}  # guess: as its IMU{off}"]


def _mount_lines(compass: CompassReport) -> list[str]:
    """Return the mount of a compass by the GNSS course, and how well the course tells it."""
    if compass.offset_deg is None:
        said = "no GNSS course tells it: declination or a mount angle may be included; 1 for a true heading whose mount is known"
        return [f"  mount_offset_sigma_deg: {_UNKNOWN_DEG:.1f}  # guess: {said}"]
    lines = []
    sigma, why = abs(compass.offset_deg), "as far as it is off the GNSS course"
    if sigma > TURNED_DEG:
        yaw = compass.turned_deg
        sigma = abs(compass.offset_deg - yaw)
        if yaw % 90.0:  # if a vessel is set to either side by turns, the mean course is no better than its scatter
            sigma = max(_LEEWAY_DEG, compass.scatter_deg or 0.0)
        why = "the course differs from the heading by leeway, so it shows no more than that"
        if compass.one_way:
            why = f"{compass.offset_deg:+.0f} deg off the course, one way all along: leeway, a current, declination or the mount"
        astern = ", unless the vessel goes astern most of the time: then 0" if compass.backwards else ""
        if compass.mount is None:
            lines.append(
                f"  mount: {{rpy_deg: [0.0, 0.0, {yaw:.1f}]}}  # guess: constant offset to the GNSS course{astern}"
            )
    if compass.leeway_deg is not None and compass.leeway_deg > sigma:
        sigma, why = compass.leeway_deg, "as far as its offset to the GNSS course wanders: leeway, or the compass"
    if sigma > _COMPASS_SIGMA_DEG:
        lines.append(f"  mount_offset_sigma_deg: {sigma:.1f}  # guess: {why}")
    return lines


def _datum_line(inspection: Inspection) -> str:
    """Return the datum: the origin of the frame of true or measured poses. Without poses any place will do."""
    for role in ("truth", "pose"):
        for item in inspection.odometry:
            if item.role == role and item.origin is not None:
                lat, lon, height = item.origin
                where = f"latitude_deg: {lat:.8f}, longitude_deg: {lon:.8f}, height_m: {height:.2f}"
                return f"datum: {{{where}}}  # guess: the origin of {item.topic}; {item.world}"
    frames = [item.frame_id for item in inspection.odometry if item.role == "pose"]
    if frames and not (inspection.gnss or inspection.in_a_grid):
        where = "latitude_deg: , longitude_deg: , height_m: 0"
        return f"# datum: {{{where}}}  # set it where the origin of '{frames[0]}' lies: the bag does not say"
    return "# datum: the median of the first five fixes"


def _beside(odometry: Sequence[OdometryReport]) -> list[str]:
    lines = []
    truths = [o for o in odometry if o.role == "truth"]
    for k, item in enumerate(sorted(truths, key=lambda o: o.origin is None)):
        off = "# " if k or item.origin is None else ""
        lines.append(f"{off}truth_topic: {item.topic}  # guess: {item.why}; {item.world}; for comparison, never fused")
    speeds = [o for o in odometry if o.role == "check_speed"]
    for k, item in enumerate(sorted(speeds, key=lambda o: o.fused)):
        lines.append(f"{'# ' if k else ''}check_speed_topic: {item.topic}  # guess: {item.why}; compared, never fused")
    return lines
