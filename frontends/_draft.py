# SPDX-License-Identifier: Apache-2.0
"""A first `vessel.yaml` from an inspection: it works as it stands, and every guess says that it is one."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path

from graphloc.config import CompassConfig, GnssConfig, ImuConfig, SlowErrorConfig
from graphloc.frontends._assess_wander import slow_error_by
from graphloc.frontends._draft_clock import recorded_lines, scan_clock_lines, with_clock
from graphloc.frontends._fixes import NOTHING_M, RTK_SIGMA_M, SCATTERS
from graphloc.frontends._reports import (
    BODY_AXES,
    EAST_AXES,
    FILTER,
    NORTH_AXES,
    WATER,
    CompassReport,
    GnssReport,
    ImuReport,
    Inspection,
    MountedTopic,
    MountGuess,
    OdometryReport,
    PartOfFixes,
    VelocityReport,
    filtered,
    through_water,
)
from graphloc.frontends._streams import COURSE, HEADING
from graphloc.frontends._tf import WORLD_NAMES
from graphloc.frontends._turns import WANDERS_DEG
from graphloc.frontends.decode import IMU, POINT, VECTOR

_MAGNETIC = ("HDG", "HDM")  # ends of names of streams of NMEA
# Wander of a compass from which it is drafted, and times what is usual: the comparison itself shows 0.6 deg in heavy waves.
_WANDER_DEG, _LARGER = 0.7, 1.4
_TURNED_DEG = 10.0  # off the course, from which a compass is taken for turned in the craft
_LEEWAY_DEG = 5.0  # by which the mean course of a vessel may differ from her heading
_LISTED_EDGE_PX = 0.3  # AprilTag 3 finds corners 0.3 to 0.5 px inside in images as they come
_UNKNOWN_DEG = 10.0  # what a magnetic compass is off by at most coasts, 1 sigma
_COMPASS_SIGMA_DEG = 2.0  # that the default of a compass's mount offset covers
_ANTENNA_OFF_M = 1.0  # from the IMU: of a car; 4 m on a boat or 0.3 m on a robot are found with it as well
_RTK_SLOW_ERROR = "horizontal_sigma_m: 0.03, vertical_sigma_m: 0.06"  # not off: else a wrong fix draws the track along
# For how long the error of a float or single fix stays the same: from where RTK was, its growth is the bound.
_FLOAT_S = 60.0
_FILTERED = "by its name, or its messages, a filter's output: it has used the IMU already, and its errors are correlated, so it gets too much weight"
_INS = "it tells its speed, as an INS or a filter does: it has used the IMU already, and its errors are correlated, so it gets too much weight"
_MOST_TURNS_HZ = 25.0  # LiDARs turn 5 to 20 times a second; drivers may publish each packet
_TURN_S = 0.1  # of a LiDAR: nearly all turn ten times a second
_MOST_PARTS = 100  # of a submap
_HEIGHT_WANDERS_M = 10.0  # more than a vessel's heave and tide within a run


def draft_config(inspection: Inspection) -> str:
    """Return the YAML text of a configuration for this bag. Lines with `# guess:` want a look."""
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
    lines += _beside([o for o in inspection.odometry if o not in _in_a_grid(inspection)])
    return "\n".join(lines) + "\n"


def _blocks(inspection: Inspection) -> Iterator[list[str]]:
    for k, imu in enumerate(inspection.imus):
        yield _imu_block(_numbered("imu", k), imu, enabled=k == 0 and not imu.missing)
    for k, gnss in enumerate(inspection.gnss):
        yield _gnss_block(_numbered("gnss", k), gnss, enabled=k == 0)
        if gnss.by_turns:
            yield _other_block(_numbered("gnss", k), gnss, gnss.by_turns[1], enabled=k == 0)
    for k, item in enumerate(_in_a_grid(inspection)):
        yield _grid_block(_numbered("gnss", k), item, enabled=k == 0)
    compasses = sorted(
        (c for c in inspection.compasses if c.usable), key=lambda c: (filtered(c.topic), c.topic.endswith(_MAGNETIC))
    )
    seen: set[str] = set()
    for k, compass in enumerate(compasses):
        name = compass.topic.partition(" ")[0]
        off = "another heading of the same topic is used, a true one before a magnetic one" if name in seen else ""
        if k and filtered(compass.topic):
            off = "by its name, or its messages, a filter's output, which the other heading may be in already"
        yield _compass_block(_numbered("compass", k), compass, off)
        seen.add(name)
    for compass in (c for c in inspection.compasses if not c.usable):
        yield [f"# orientation of {compass.topic}: left out as a compass; {compass.why}"]
    yield from _velocities(inspection)
    in_a_grid = _in_a_grid(inspection)
    speeds = [o for o in inspection.odometry if o.role == "check_speed" and o not in in_a_grid]
    wheels = [o for o in speeds if not o.fused]
    for item in (o for o in speeds if o.fused):
        yield [
            f"# {item.topic}: not fused, as it has used receiver and IMU already; truth_topic if it is better than they are; {item.why}"
        ]
    yield from (_wheels_block(_numbered("wheels", k), item) for k, item in enumerate(wheels))
    for k, item in enumerate(o for o in inspection.odometry if o.role == "pose"):
        measured = "x, y, z" if item.msgtype == POINT else "x, y, z, yaw"
        axes = [f"  axes: [{measured}]"] if item.msgtype == POINT or not (inspection.gnss or in_a_grid) else []
        yield [
            f"{_numbered('pose', k)}:",
            "  kind: pose",
            f"  topic: {item.topic}",
            f"  # its frame '{item.frame_id}': {item.world}",
            *axes,
            "  enabled: false  # guess: true if its frame is east-north-up at the datum and no fix went into it",
            "  # slow_error: {sigma_m: 1.0, time_constant_s: 60}  # where errors last (USBL, UWB, a filter's output); else they count as independent",
        ]
    for item in (o for o in inspection.odometry if o.role == "other" and o not in in_a_grid):
        instead = ": take the receiver's NavSatFix" if inspection.gnss and item.grid else ""
        yield [f"# {item.topic}: left out, {item.world}{instead}"]
    lidars, cameras = (tuple(m for m in every if not m.left_out) for every in (inspection.lidars, inspection.cameras))
    if lidars:
        block = _aerial_block(lidars, _clouds_hz(inspection, lidars))
        yield [*block, *recorded_lines(inspection, lidars), *scan_clock_lines(inspection, lidars)]
    if cameras:
        yield [*_tags_block(cameras), *recorded_lines(inspection, cameras)]
    for other in (m for m in (*inspection.lidars, *inspection.cameras) if m.left_out):
        yield [f"# {other.topic}: left out; {other.left_out}"]
    fixes, poses = inspection.gnss or in_a_grid, any(item.role == "pose" for item in inspection.odometry)
    if fixes or poses or lidars:
        alone = "" if fixes or poses else "; nothing else tells the height"
        yield ["height:", f"  enabled: false  # guess: true for a vessel that floats{alone}"]


def _in_body(block: list[str], inspection: Inspection) -> list[str]:
    """Return the block with its mounts from tf as numbers, where the body of tf has its axes ahead, to starboard, down."""

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


def _in_a_grid(inspection: Inspection) -> list[OdometryReport]:
    """Positions in a map grid, where nothing tells a latitude."""
    return [] if inspection.gnss else [item for item in inspection.odometry if item.grid]


def _grid_block(name: str, item: OdometryReport, *, enabled: bool) -> list[str]:
    lines = [f"{name}:", "  kind: gnss", f"  topic: {item.topic}"]
    lines += [] if enabled else ["  enabled: false  # guess: one receiver is used"]
    lines += [f"  # guess: {_INS}"] if item.role == "check_speed" else []
    zone = "EPSG:32632 for UTM zone 32 north, EPSG:32732 for zone 32 south"
    return [
        *lines,
        f"  grid: ''  # set it, the zone is not in the bag: {zone}; {item.world}",
        "  mount: {xyz_m: [0.0, 0.0, 0.0]}  # guess: of base_link, if /tf_static was applied; else of the antenna",
        "  slow_error: {}  # guess: where RTK is fixed throughout, {" + _RTK_SLOW_ERROR + "}",
    ]


def _clouds_hz(inspection: Inspection, lidars: tuple[MountedTopic, ...]) -> float:
    """Return how many clouds a second come of the busiest LiDAR, over the run."""
    span_s = max((t.span_s for t in inspection.topics if t.span_s is not None), default=0.0)
    counts = {t.topic: t.count for t in inspection.topics}
    return max(counts[lidar.topic] for lidar in lidars) / span_s if span_s > 0.0 else 0.0


def _aerial_block(lidars: tuple[MountedTopic, ...], clouds_hz: float) -> list[str]:
    lines = [
        "aerial:",
        "  kind: aerial",
        "  enabled: false  # guess: true once there is a map: `image`, `vector`, or both",
        "  image: ''  # an aerial image of the place: GeoTIFF, MBTiles, or a folder of tiles",
        "  vector: ''  # GeoJSON of quays and piers",
        "  hull_m: []  # guess: corners of the vessel's outline, [forward, port], m: points inside are its own; 'smooth' suggests some",
        "  waterline_m: 0.0  # guess: height of the waterline in the body frame, m",
    ]
    if clouds_hz > _MOST_TURNS_HZ:
        parts = min(round(_TURN_S * clouds_hz), _MOST_PARTS)
        lines.append(f"  submap: {parts}  # guess: {clouds_hz:.0f} clouds a second are parts of turns")
    lines.append("  lidars:")
    for k, lidar in enumerate(lidars):
        lines.append(f"    {_numbered('lidar', k)}:")
        lines.append(f"      topic: {lidar.topic}")
        if lidar.tf_frame is not None:
            lines.append(f"      mount: {{tf_frame: {json.dumps(lidar.tf_frame)}}}  # from tf")
        else:
            lines.append(
                f"      mount: {{xyz_m: [0.0, 0.0, 0.0]}}  # guess: where '{lidar.frame_id}' sits is not in the bag; measure it"
            )
    return lines


def _tags_block(cameras: tuple[MountedTopic, ...]) -> list[str]:
    lines = [
        "tags:",
        "  kind: apriltag",
        "  enabled: false  # guess: true once there is a survey of the tags",
        "  survey: tags.yaml  # positions and sizes of the tags: docs/tags.md",
    ]
    if any(camera.listed for camera in cameras):
        lines.append(f"  edge_sigma_px: {_LISTED_EDGE_PX}  # guess: an external detector, on images with gamma")
    lines.append("  cameras:")
    for k, camera in enumerate(cameras):
        lines.append(f"    {_numbered('camera', k)}:")
        lines.append(f"      topic: {camera.topic}")
        if camera.info_topic:
            why = f"  # guess: {camera.info_why}, as none lies beside it" if camera.info_why else ""
            lines.append(f"      info_topic: {camera.info_topic}{why}")
        else:
            lines.append("      info_topic: ''  # guess: there is no CameraInfo beside it; name its topic")
        if camera.optical is not None:
            xyz, rpy = (
                ", ".join(f"{round(x, n) + 0.0:.{n}f}" for x in v) for v, n in zip(camera.optical, (3, 1), strict=True)
            )
            lines.append(
                f"      mount: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}  # guess: by tf '{camera.tf_frame}' would look at the sky: taken "
                "for one with x ahead, z up; this is its optical frame"
            )
        elif camera.tf_frame is not None:
            lines.append(
                f"      mount: {{tf_frame: {json.dumps(camera.tf_frame)}}}  # from tf; it must be the optical frame"
            )
        else:
            lines.append(
                f"      mount: {{xyz_m: [0.0, 0.0, 0.0], rpy_deg: [-90.0, 0.0, -90.0]}}  # guess: '{camera.frame_id}' looks "
                "ahead; where it sits is not in the bag; measure it"
            )
    return lines


def _topic_lines(topic: str) -> list[str]:
    """The topic; of NMEA (see `read_streams`) with the sentence that is read."""
    for beside in (FILTER, COURSE, HEADING, WATER):
        topic = topic.removesuffix(beside)
    name, *sentence = topic.split(" ")
    return [f"  topic: {name}", *(f"  nmea: [{', '.join(said.split('+'))}]" for said in sentence)]


def _numbered(name: str, k: int) -> str:
    return name if k == 0 else f"{name}_{k + 1}"


def _imu_block(name: str, imu: ImuReport, *, enabled: bool) -> list[str]:
    lines = [f"{name}:", "  kind: imu", f"  topic: {imu.topic}"]
    reason = "; ".join(imu.why)
    if not enabled:
        why = (
            reason
            if imu.missing
            else "one IMU is used: a whole one, with gravity in it, and with least gyro noise, of about equal ones that whose mount tf or the motion tells"
        )
        lines.append(f"  enabled: false  # guess: {why}")
    if imu.accel_unit != "m/s^2":
        lines.append(f"  accel_unit: {imu.accel_unit}  # guess: {reason}")
    if imu.gyro_unit != "rad/s":
        lines.append(f"  gyro_unit: {imu.gyro_unit}  # guess: {reason}")
    if imu.gravity != "included":
        lines.append(f"  gravity: {imu.gravity}  # guess: {reason}")
    lines.append(_mount_line(imu.mount))
    lines += _mount_sigma_lines(imu.mount)
    lines += _noise_lines(imu)
    return lines


def _mount_line(mount: MountGuess) -> str:
    if mount.tf_frame is not None:
        return f"  mount: {{tf_frame: {json.dumps(mount.tf_frame)}}}  # {mount.evidence}"
    rpy = ", ".join(f"{a:.1f}" for a in mount.rpy_deg)
    xyz = ", ".join(f"{a:.3f}" for a in mount.xyz_m) if mount.xyz_m else "0.0, 0.0, 0.0"
    whose = "xyz as there" if mount.xyz_m else "xyz unknown"
    return f"  mount: {{xyz_m: [{xyz}], rpy_deg: [{rpy}]}}  # guess: {mount.evidence}; {whose}"


def _mount_sigma_lines(mount: MountGuess) -> list[str]:
    """A yaw that is no quarter turn is known as well as the motion tells it, which is often worse than the default allows for."""
    default = ImuConfig().mount_sigma_deg
    if mount.tf_frame is not None or mount.yaw_sigma_deg is None:
        return []
    sigma = math.hypot(default, mount.yaw_sigma_deg)
    return [
        f"  mount_sigma_deg: {sigma:.1f}  # guess: as well as the motion tells that yaw; {default:g} once it is measured"
    ]


def _noise_lines(imu: ImuReport) -> list[str]:
    """Noise is set only where the bag shows more than the default allows for."""
    default = ImuConfig()
    noise = f"{imu.accel_noise_ug:.0f} ug, {imu.gyro_noise_mdps:.1f} mdps per sqrt(Hz)"
    lines = [f"  # measured, worst axis, vibration included: {noise}"]
    if imu.accel_noise_ug > default.accel_noise_ug_per_sqrt_hz:
        lines.append(f"  accel_noise_ug_per_sqrt_hz: {imu.accel_noise_ug:.0f}  # guess: as measured")
    if imu.gyro_noise_mdps > default.gyro_noise_mdps_per_sqrt_hz:
        lines.append(f"  gyro_noise_mdps_per_sqrt_hz: {imu.gyro_noise_mdps:.1f}  # guess: as measured")
    return lines


def _other_block(name: str, gnss: GnssReport, others: PartOfFixes, *, enabled: bool) -> list[str]:
    """The fixes of a receiver while its RTK is gone: as a second sensor, with an error of metres that the RTK does not have."""
    own, slow_m = _of_part(gnss, others), others.slow_m
    if slow_m >= SlowErrorConfig().horizontal_sigma_m:
        slow_m = max(slow_m, _as_large(own)[0])
    wanders = gnss.height_range_m > _HEIGHT_WANDERS_M
    vertical_m = max(2.0 * slow_m, gnss.height_range_m / 3.3 if wanders else 0.0)
    keys = f"horizontal_sigma_m: {slow_m:.2g}, vertical_sigma_m: {vertical_m:.2g}, time_constant_s: {_FLOAT_S:g}"
    return [
        f"{name}_other:",
        "  kind: gnss",
        "  fixes: other  # those without RTK: a sensor of its own, whose error is slow",
        *_topic_lines(gnss.topic),
        *([] if enabled else [f"  enabled: false  # guess: as {name}"]),
        *_antenna_lines(gnss.tf_frame, "from tf", gnss.keeps_m),
        *_scatter_lines(own),
        *([_wandering(gnss)] if wanders else []),
        f"  slow_error: {{{keys}}}  # guess: as large as float fixes claim, metres for other fixes; it changes from minute to minute",
    ]


def _wandering(gnss: GnssReport) -> str:
    return f"  min_vertical_sigma_m: 5.0  # guess: height ranges over {gnss.height_range_m:.0f} m"


def _of_part(gnss: GnssReport, part: PartOfFixes) -> GnssReport:
    """Return the report with what a part of the fixes claims and scatters by."""
    scatter = None if part.white_m is None else (part.white_m, part.white_m, part.white_m)
    return replace(gnss, reported_sigma_m=part.sigma_m, white_m=part.white_m, scatter_m=scatter)


def _gnss_block(name: str, gnss: GnssReport, *, enabled: bool) -> list[str]:
    lines = [f"{name}:", "  kind: gnss", *_topic_lines(gnss.topic)]
    if gnss.by_turns:
        share = 100.0 * gnss.by_turns[0].share
        lines.append(f"  fixes: rtk  # guess: {share:.0f} % of the fixes; the rest is {name}_other's")
    if not enabled:
        why = (
            _FILTERED
            if filtered(gnss.topic)
            else "one receiver is used: RTK throughout, else the most accurate by its claims and the drift of its height, of equal ones that with heights, then with most fixes"
        )
        lines.append(f"  enabled: false  # guess: {why}")
    else:
        lines += _filtered_lines(gnss.topic)
    lines += _antenna_lines(gnss.tf_frame, "from tf", gnss.keeps_m)
    lines += _scatter_lines(_of_part(gnss, gnss.by_turns[0]) if gnss.by_turns else gnss)
    lines += _rtk_lines(gnss)
    lines += _uneven_lines(gnss)
    wanders = gnss.height_range_m > _HEIGHT_WANDERS_M and gnss.slow_error and not gnss.by_turns
    if wanders:
        lines.append(_wandering(gnss))
    if gnss.by_turns or not gnss.slow_error:
        why = f"status gbas (RTK) and less than {RTK_SIGMA_M:g} m" if gnss.by_turns else gnss.why
        lines.append(f"  slow_error: {{{_RTK_SLOW_ERROR}}}  # guess: {why}")
    else:
        # Left to the default, which is on where a second absolute sensor can tell the error from motion.
        large, said = _slow_error(gnss)
        vertical = max(SlowErrorConfig().vertical_sigma_m, gnss.height_range_m / 3.3)
        more = ", ".join([*([f"vertical_sigma_m: {vertical:.1f}"] if wanders else []), *large])
        fixed = f"; {{{_RTK_SLOW_ERROR}}} where RTK is fixed throughout" if gnss.rtk_sigma_m else ""
        if gnss.reported_sigma_m and max(gnss.reported_sigma_m[:2]) < RTK_SIGMA_M:
            fixed = f"; {{{_RTK_SLOW_ERROR}}} if RTK makes them as good as they claim, which their status does not say"
        lines.append(f"  slow_error: {{{more}}}  # guess: {gnss.why}{said}{fixed}")
    return lines


def _slow_error(gnss: GnssReport) -> tuple[list[str], str]:
    """Return the keys of a horizontal slow error other than by default, and why: as large and fast as wheels or a velocity show.

    Otherwise these contradict the fixes, and what gives way is the heading.
    """
    default_m = SlowErrorConfig().horizontal_sigma_m
    sigma_m, why = _as_large(gnss)
    found = slow_error_by(gnss.wander, sigma_m)
    if found is None:
        return ([f"horizontal_sigma_m: {sigma_m:.1f}"] if sigma_m > default_m else []), why
    seen = ", ".join(f"{change.m:.1f} m in {change.span_s:.0f} s" for change in gnss.wander)
    keys = [f"horizontal_sigma_m: {found[0]:.1f}", f"time_constant_s: {found[1]:.0f}"]
    return keys, f"; by {gnss.wander_by} it changes by {seen}{why}"


def _as_large(gnss: GnssReport) -> tuple[float, str]:
    """Return the sigma of a slow error, m, if larger than by default, and why: another receiver, or what the fixes claim, less what is white."""
    claimed_m = max(gnss.reported_sigma_m[:2]) if gnss.reported_sigma_m else 0.0
    white_m = max(gnss.scatter_m[:2]) if gnss.scatter_m else claimed_m
    slow_m = claimed_m if SCATTERS * white_m < claimed_m <= NOTHING_M else 0.0
    if gnss.differs and gnss.apart_m >= slow_m:
        return gnss.apart_m, f"; so far it and {gnss.apart_from} wander against each other"
    if slow_m <= SlowErrorConfig().horizontal_sigma_m:
        return SlowErrorConfig().horizontal_sigma_m, ""
    said = f"; scatter from fix to fix is {white_m:.1f} m, so most of the error that they claim is slow"
    return slow_m, said


def _scatter_lines(gnss: GnssReport) -> list[str]:
    """What the fixes scatter by, where they claim far less; what they are taken for, where they claim next to nothing."""
    default = GnssConfig()
    claimed = max(gnss.reported_sigma_m[:2]) if gnss.reported_sigma_m else default.default_horizontal_sigma_m
    if claimed > NOTHING_M:
        taken = max(default.default_horizontal_sigma_m, max(gnss.scatter_m[:2]) if gnss.scatter_m else 0.0)
        said = f"guess: fixes claim {claimed:.0f} m, which looks like a placeholder: taken as good to {taken:.1f} m"
        return [f"  sigma_scale: {taken / claimed:.2g}  # {said}"]
    if gnss.white_m is None or gnss.white_m <= SCATTERS * claimed:
        return []
    scatter, times = f"guess: fixes scatter by {gnss.white_m:.2f} m from one to the next", gnss.white_m / claimed
    if gnss.reported_sigma_m:
        return [f"  sigma_scale: {times:.1f}  # {scatter}, and claim {claimed:.2f} m"]
    vertical = f"  default_vertical_sigma_m: {times * default.default_vertical_sigma_m:.1f}  # guess: as many times"
    return [f"  default_horizontal_sigma_m: {gnss.white_m:.1f}  # {scatter}, and claim nothing", vertical]


def _rtk_lines(gnss: GnssReport) -> list[str]:
    """What is seen of RTK that reports no covariance, which would count as good to metres."""
    if gnss.rtk_sigma_m is None or gnss.scatter_m is None:
        return []
    horizontal, vertical = gnss.rtk_sigma_m
    said = f"guess: status gbas (RTK, or DGPS), and consecutive fixes scatter by {max(gnss.scatter_m[:2]):.3f} m"
    return [
        f"  default_horizontal_sigma_m: {horizontal:.2f}  # {said}",
        f"  default_vertical_sigma_m: {vertical:.2f}  # guess: likewise, {gnss.scatter_m[2]:.3f} m",
    ]


def _uneven_lines(gnss: GnssReport) -> list[str]:
    """What uneven stamps are off by along the way, where that is more than the fixes are taken for."""
    default = GnssConfig()
    taken_m = gnss.rtk_sigma_m[0] if gnss.rtk_sigma_m else default.default_horizontal_sigma_m
    if gnss.reported_sigma_m:
        taken_m = max(*gnss.reported_sigma_m[:2], default.min_horizontal_sigma_m)
    if gnss.uneven is None or gnss.uneven.along_m <= taken_m:
        return []
    return [f"  min_horizontal_sigma_m: {gnss.uneven.along_m:.2g}  # guess: {gnss.uneven.said}"]


def _velocities(inspection: Inspection) -> Iterator[list[str]]:
    """Velocities, of which one is used: of two that a device says of itself, neither tells what the other does not."""
    gnss = next(iter(inspection.gnss), None)
    known = [v for v in inspection.velocities if v.axes != "unknown"]
    told = [v for v in known if v.axes in (EAST_AXES, NORTH_AXES)] or [
        v for v in known if v.axes is None and v.msgtype != VECTOR
    ]
    used = min(told, key=lambda v: filtered(v.topic), default=None)
    body, world = count(), count()
    for twist in known:
        off = None
        if twist.axes == BODY_AXES:
            yield _body_velocity_block(_numbered("body_velocity", next(body)), twist)
            continue
        if twist.axes is None and twist.msgtype == VECTOR:
            off = f"nothing tells that it is a velocity; {twist.why}"
        elif twist is not used and filtered(twist.topic):
            off = _FILTERED
        elif twist is not used:
            off = f"true if it comes of another receiver than {used.topic if used else 'that'}; {twist.why}"
        yield _velocity_block(_numbered("gnss_velocity", next(world)), twist, gnss, off)
    for twist in inspection.velocities:
        if twist not in known:
            yield [f"# {twist.topic}: left out, it is no velocity of the craft; {twist.why}"]


def _body_velocity_block(name: str, twist: VelocityReport) -> list[str]:
    turned = ", rpy_deg: [0.0, 0.0, 180.0]" if twist.reverse else ""
    frame = f"tf_frame: {json.dumps(twist.tf_frame)}" if twist.tf_frame else f"xyz_m: [0.0, 0.0, 0.0]{turned}"
    known = "from tf" if twist.tf_frame else "guess: where it sits is not in the bag; measure it"
    water = through_water(twist.topic)
    fuse = "true to fuse it" if water else "true to fuse it, through: water for a speed log"
    lines = [f"{name}:", "  kind: body_velocity", *_topic_lines(twist.topic), *(["  through: water"] if water else [])]
    if twist.mount:
        return [
            *lines,
            f"  enabled: false  # guess: true to fuse it; {twist.why}",
            "  axes: [x, y, z]",
            _mount_line(twist.mount),
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


_TO_STARBOARD = "xyz_m: [0.0, 0.0, 0.0], rpy_deg: [180.0, 0.0, 0.0]"
_UNKNOWN_MOUNT = (
    "  mount_sigma_m: 1.5  # guess: how far from the mount the place is that does not slip sideways (a car's rear axle); estimated with the run",
    "  mount_sigma_deg: 1.0  # guess: how far the way they roll is turned; estimated with the run",
)


def _wheels_block(name: str, item: OdometryReport) -> list[str]:
    turned = ["  mount: {rpy_deg: [0.0, 0.0, 180.0]}  # guess: its sign looks wrong"] if item.reverse else []
    return [
        f"{name}:", "  kind: body_velocity", f"  topic: {item.topic}",
        "  enabled: false  # guess: true to fuse it (it tells the heading, too), if held-out fixes are predicted no worse (fix_rmse_m); then delete check_speed_topic",
        "  axes: [x, y]  # guess: wheels do not slip sideways; x alone tells the heading by its cosine only, and may not converge",
        *turned,
        *_UNKNOWN_MOUNT,
    ]  # fmt: skip


def _velocity_block(name: str, twist: VelocityReport, gnss: GnssReport | None, off: str | None) -> list[str]:
    lines = [f"{name}:", "  kind: gnss_velocity", *_topic_lines(twist.topic)]
    if off is not None:
        lines.append(f"  enabled: false  # guess: {off}")
    else:
        lines[-1] += f"  # guess: a velocity in {twist.axes or EAST_AXES}; {twist.why}"
        lines += _filtered_lines(twist.topic)
    if twist.axes == NORTH_AXES:
        lines.append("  convention: ned  # guess: by the GNSS track")
    if (said := _of_antenna(twist, gnss)) is not None:
        return [*lines, f"  antenna: {_numbered('gnss', 0)}  # guess: {said}; it sits where that does"]
    frame = twist.tf_frame or (gnss.tf_frame if gnss else None)
    evidence = "from tf" if twist.tf_frame else "guess: the antenna of the GNSS receiver"
    return [*lines, *_antenna_lines(frame, evidence, gnss.keeps_m if gnss else 0.0)]


def _of_antenna(twist: VelocityReport, gnss: GnssReport | None) -> str | None:
    """Return what tells that a velocity is of the antenna of a receiver of which nothing tells the place; None: nothing does.

    A filter's output is of another place than the fixes that went into it.
    """
    if gnss is None or gnss.tf_frame or twist.tf_frame or filtered(gnss.topic) != filtered(twist.topic):
        return None
    if gnss.topic.partition(" ")[0] == twist.topic.partition(" ")[0]:
        return "of the same topic"
    told = twist.frame_id and twist.frame_id == gnss.frame_id and twist.frame_id.strip("/") not in WORLD_NAMES
    return f"both have the frame '{twist.frame_id}'" if told else None


def _antenna_lines(frame: str | None, evidence: str, keeps_m: float) -> list[str]:
    """Return where an antenna sits. Of two that keep their distance one is half of it, or more, from anywhere."""
    if frame is not None:
        return [f"  mount: {{tf_frame: {json.dumps(frame)}}}  # {evidence}"]
    off_m = max(_ANTENNA_OFF_M, keeps_m / 2.0)
    far = f": two antennas keep {keeps_m:.0f} m apart" if off_m > _ANTENNA_OFF_M else ""
    return [
        "  mount: {xyz_m: [0.0, 0.0, 0.0]}  # guess: where the antenna sits is not in the bag; measure it",
        f"  mount_sigma_m: {off_m:.1f}  # guess: how far off that may be{far}; estimated with the run; 0 once it is measured",
    ]


def _filtered_lines(topic: str) -> list[str]:
    return [f"  # guess: {_FILTERED}"] if filtered(topic) else []


def _compass_block(name: str, compass: CompassReport, off: str) -> list[str]:
    lines = [
        f"{name}:",
        "  kind: compass",
        *_topic_lines(compass.topic),
        f"  convention: {compass.convention}  # guess: {compass.why}",
    ]
    if compass.unit is not None:
        lines.append(f"  unit: {compass.unit}  # guess: by the size of its numbers")
    if compass.like:
        lines.append(f"  enabled: false  # guess: it repeats {compass.like}, and must not count twice")
    elif off:
        lines.append(f"  enabled: false  # guess: {off}")
    elif filtered(compass.topic):
        lines.append(f"  # guess: {_FILTERED}; enabled: false where it is a reference to compare with")
    lines += _mount_lines(compass)
    lines += _error_lines(compass)
    if (compass.msgtype == IMU or filtered(compass.topic)) and not compass.two_antennas:
        lines.append("  use_reported_sigma: false  # guess: drivers' orientation covariances are seldom measured")
    return lines


def _error_lines(compass: CompassReport) -> list[str]:
    """What turns a compass for a while or by the heading: iron, of which two antennas know nothing."""
    wander = compass.wander_deg or 0.0
    gnss = compass.two_antennas and wander < WANDERS_DEG
    usual = 0.2 if gnss else CompassConfig().wander_sigma_deg
    if gnss:
        lines = [
            "  deviation_sigma_deg: 0.0  # guess: a heading of GNSS by its topic or message; 1.5 for a magnetic compass"
        ]
        why = "a heading of GNSS; 0.5 for a magnetic compass"
    else:
        lines = ["  deviation_sigma_deg: 1.5  # guess: a magnetic compass; 0 for a GNSS compass"]
        why = "passing errors near iron; 0.2 for a GNSS compass"
    if wander > max(_WANDER_DEG, _LARGER * usual):
        usual, why = wander, "as it wanders beside the gyro; iron near it, or its own filter"
    return [*lines, f"  wander_sigma_deg: {usual:.1f}  # guess: {why}"]


def _mount_lines(compass: CompassReport) -> list[str]:
    """By how much the course says that a compass is turned in the craft, and how well a course tells it."""
    if compass.offset_deg is None:
        said = "no GNSS course to compare with: declination or a mount angle may be included; 1 for a true heading whose mount is known"
        return [f"  mount_offset_sigma_deg: {_UNKNOWN_DEG:.1f}  # guess: {said}"]
    lines = []
    sigma, why = abs(compass.offset_deg), "as far as it is off the GNSS course"
    if sigma > _TURNED_DEG:
        quarter = 90.0 * round(compass.offset_deg / 90.0)
        rest = abs(compass.offset_deg - quarter)
        # Of a vessel that is set sideways by turns, the mean course is no better than that.
        askew = round(compass.offset_deg), max(_LEEWAY_DEG, compass.scatter_deg or 0.0)
        yaw, sigma = (quarter, rest) if rest < 15.0 else askew
        why = "the course differs from the heading by leeway, so it shows no more than that"
        astern = ", unless the vessel goes astern most of the time: then 0" if compass.backwards else ""
        lines.append(
            f"  mount: {{rpy_deg: [0.0, 0.0, {yaw:.1f}]}}  # guess: constant offset to the GNSS course{astern}"
        )
    if compass.leeway_deg is not None and compass.leeway_deg > sigma:
        sigma, why = compass.leeway_deg, "as far as its offset to the GNSS course wanders: leeway, or the compass"
    if sigma > _COMPASS_SIGMA_DEG:
        lines.append(f"  mount_offset_sigma_deg: {sigma:.1f}  # guess: {why}")
    return lines


def _datum_line(inspection: Inspection) -> str:
    """The datum is where the frame of true or measured poses has its origin; without them any place will do."""
    for role in ("truth", "pose"):
        for item in inspection.odometry:
            if item.role == role and item.origin is not None:
                lat, lon, height = item.origin
                where = f"latitude_deg: {lat:.8f}, longitude_deg: {lon:.8f}, height_m: {height:.2f}"
                return f"datum: {{{where}}}  # guess: the origin of {item.topic}; {item.world}"
    frames = [item.frame_id for item in inspection.odometry if item.role == "pose"]
    if frames and not (inspection.gnss or _in_a_grid(inspection)):
        where = "latitude_deg: , longitude_deg: , height_m: 0"
        return f"# datum: {{{where}}}  # set it where the origin of '{frames[0]}' lies: nothing in the bag tells"
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
