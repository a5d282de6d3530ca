# SPDX-License-Identifier: Apache-2.0
"""What `inspect` finds out about a bag: plain frozen values, ready for JSON."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

from graphloc.config import SlowErrorConfig
from graphloc.frontends._fixes import Uneven
from graphloc.frontends.nmea import SPEEDS
from graphloc.plain import plain

Vec = tuple[float, float, float]
# Headings by two GNSS antennas: HDT and THS of a GNSS talker; topics of ublox_gps, septentrio_gnss_driver, mavros etc.
_TWO_ANTENNAS = re.compile(r"[ +]G[A-Z](HDT|THS)$|gps|gnss|nav_?heading|rel_?pos|dual|moving_?bas", re.IGNORECASE)
# Outputs of EKFs on receiver and IMU: of MAVROS, microstrain_inertial, robot_localization, xsens_mti.
_FILTERED = re.compile(r"filter|ekf|ukf|kalman|fused|fusion|local_position|global_position/global$", re.IGNORECASE)
TURNED_DEG = 10.0
"""Offset from the course from which a compass is taken for turned in the craft."""
_ASKEW_DEG = 15.0  # deviation from a multiple of 90 deg from which a compass sits askew
_ASTERN_DEG = 165.0  # offset of a compass from which a vessel that goes astern explains it as well
_DIFFERS = 1.5  # receivers differ if they wander by more than so many times the default slow error
# Least horizontal and vertical sigma of RTK that reports no covariance: its scatter holds no slow error.
_RTK_M = (0.05, 0.1)
_RTK_SCATTER_M = 0.1  # RTK scatters by less, DGPS, which has the same status, by more; a choice
FITS_WITH_FIXES = "what the IMU feels fits the motion of the fixes in the same messages"
"""Why the stamps of a heading or velocity are late that the fixes of the same messages tell."""
WATER = " (through water)"
"""Ending of the name of a stream of a Doppler log's velocities through water."""
FILTER = " (of a filter)"
"""Ending of the name of a stream whose messages say that a filter made them; see `filtered`."""
EAST_AXES, NORTH_AXES, BODY_AXES = "east, north, up", "north, east, down", "forward, left, up (body)"
STARBOARD_AXES, AHEAD = "forward, right, down (body)", "forward (body), and to a side that nothing shows"


def bare_topic(name: str) -> str:
    """Return the topic of a stream: its name without the NMEA sentence or the part of a message that it is of."""
    return name.partition(" ")[0]


def two_antennas(topic: str) -> bool:
    """Return whether a heading is by two GNSS antennas, by the name of its topic or its sentence."""
    return bool(_TWO_ANTENNAS.search(topic)) and not filtered(topic)


def through_water(topic: str) -> bool:
    """Return whether a velocity is through the water, by the name of its stream: its sentence is VHW, or it says so."""
    return topic.endswith(("VHW", WATER))


def of_log(topic: str) -> bool:
    """Return whether a velocity is a log's, along the vessel, by its NMEA sentence."""
    return topic.removesuffix(WATER).endswith(SPEEDS)


def of_nmea(topic: str) -> bool:
    """Return whether a place is from NMEA, by the name of its stream."""
    return " " in topic.removesuffix(FILTER)


def filtered(topic: str) -> bool:
    """Return whether a place, velocity or heading is a filter's output, by the name of its stream."""
    return bool(_FILTERED.search(topic))


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicReport:
    """A topic, or an NMEA sentence. Stamps are header stamps; None where messages of this type are not unpacked.

    Attributes:
        topic, msgtype, count: name; message type, of a sentence that of the same content; number of messages.
        undecodable: number of messages that cannot be decoded. broken: why, of the first one; '' if there is none.
        frame_id: of the first message that names a frame.
        start_ns, span_s, rate_hz: first stamp; time from the first to the last; 1 / median interval.
        gaps: number of intervals longer than 5 median ones, and 0.1 s. max_gap_s: the longest interval.
        repeated, backward: number of stamps equal to, or before, the preceding one. no_stamp: number of zero stamps.
        recorded: whether the headers hold no stamps, or whole seconds only, so that recording times are used instead.
        latency_s: recording time minus header stamp, without the drift of the clock: 5 %, 50 %, 95 % points.
        drift_ppm: by how much the clock runs fast, where that is clear; else 0.
        after_s: of a place by NMEA, its stamp or recording time minus the time in the sentence: 5 %, 50 %, 95 % points.
        unread: of an NMEA topic, the number of sentences that no sensor reads, by name, the most frequent one first.
    """

    topic: str
    msgtype: str
    count: int
    undecodable: int = 0
    broken: str = ""
    frame_id: str = ""
    start_ns: int | None = None
    span_s: float | None = None
    rate_hz: float | None = None
    gaps: int | None = None
    max_gap_s: float | None = None
    repeated: int | None = None
    backward: int | None = None
    no_stamp: int | None = None
    recorded: bool = False
    latency_s: Vec | None = None
    drift_ppm: float = 0.0
    after_s: Vec | None = None
    unread: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class MountGuess:
    """Mount of a sensor in body, and the evidence.

    Attributes:
        rpy_deg: roll, pitch, yaw. tf_frame: frame of tf that tells the mount; None if it is not from tf.
        evidence: in words. xyz_m: its position; None if unknown.
        yaw_told: whether anything tells its yaw.
        tilt_sigma_deg, yaw_sigma_deg: 1 sigma of roll and pitch each, and of yaw, beyond that of a mount that is known.
    """

    rpy_deg: Vec
    tf_frame: str | None
    evidence: str
    xyz_m: Vec | None = None
    yaw_told: bool = True
    tilt_sigma_deg: float = 0.0
    yaw_sigma_deg: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuReport:
    """An IMU, in its own axes.

    Attributes:
        gravity_size: median size of the acceleration, in the unit of the bag. gravity_axis: its direction, unit vector.
        accel_unit, gyro_unit, gravity: as `vessel.yaml` has them. why: a line on each that is not the standard.
        still_s: duration of standstill. gyro_bias_radps: mean rate in it; None without standstill.
        accel_noise_ug, gyro_noise_mdps: noise densities per sqrt(Hz) of the worst axis, at rest or in motion.
        reported_accel_ug, reported_gyro_mdps: noise densities by the covariances of the messages; None if unknown.
        mount: in body.
        fast: whether rates are in rad/s by its turns, though by their size deg/s would be likelier.
        missing: 'rates' or 'accelerations' where all of these are 0, as some drivers publish half an IMU; else ''.
        unfinite: number of samples with NaN.
    """

    topic: str
    gravity_size: float
    gravity_axis: Vec
    accel_unit: str
    gyro_unit: str
    gravity: str
    why: tuple[str, ...]
    still_s: float
    gyro_bias_radps: Vec | None
    accel_noise_ug: float
    gyro_noise_mdps: float
    reported_accel_ug: float | None
    reported_gyro_mdps: float | None
    mount: MountGuess
    fast: bool = False
    missing: str = ""
    unfinite: int = 0


class Change(NamedTuple):
    """Change of an error within `span_s`: `m`, 1 sigma of an axis, by `seen` independent values."""

    span_s: float
    m: float
    seen: float


class PartOfFixes(NamedTuple):
    """Either the RTK fixes or the other fixes of a receiver that has RTK at times.

    Attributes:
        share: share of all its fixes. sigma_m: median of the stated sigmas, east, north, up; None if none is stated.
        white_m: horizontal scatter of consecutive fixes; None if unknown. slow_m: 1 sigma of the slow error to assume.
    """

    share: float
    sigma_m: Vec | None
    white_m: float | None
    slow_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssReport:
    """A GNSS receiver.

    Attributes:
        topic, fixes: its stream; number of good fixes. statuses: number of messages by name of their status.
        known_covariance: share of fixes that report a covariance. reported_sigma_m: median sigma, east, north, up.
        scatter_m: white noise seen in the data, 1 sigma, east, north, up.
        white_m: horizontal scatter without motion in it; None unless fixes come fast, or scatter by more than a craft
            moves.
        height_range_m: from the 5 % to the 95 % point of the height. extent_m: bounding box of the track, east and
            north.
        travelled_m: length of the track. first: latitude, longitude (deg) and height (m) of the first good fix.
        slow_error: whether it has a slow error of metres, as without RTK. why: the evidence.
        frame_id, tf_frame: frame of its messages; the same where tf leads to it, else None.
        frozen, stored: warning if it repeats one position while the vessel moves, or one from before the run; else ''.
        in_radians: warning if its positions look like rad; else ''.
        wander: by how much its error changes along the way, by `wander_by`, wheels or a velocity; empty if unknown.
        without_place: number of fixes without a place: NaN, (0, 0), or beyond 90 and 180 deg.
        outliers: number of fixes so far off the others that no craft goes there and comes back.
        without_height: number of fixes without a height. spans_s: time from its first fix to its last.
        late_s: what should be added to its stamps by the accelerometer, s, and 1 sigma; None if that is not clear.
        late_by: whose motion told so: its own, or that of a velocity of the same device.
        hinted_s: as `late_s`, where an offset is likelier than none but not clear.
        felt_s: offset by its fixes alone, where that is clear; else None.
        uneven: how unevenly its fixes are stamped; None where stamps tell when each was measured.
        apart_m: by how much it and `apart_from`, the receiver that it agrees with best, wander against each other, 1
            sigma of an axis.
        keeps_m: least distance of its antenna and that of another receiver; 0 if unknown.
        by_turns: its RTK fixes, by status and stated sigma, and the others; None unless it has both.
        roams_m: diagonal of the box from the 10 % to the 90 % points of its positions.
        elsewhere: why it is not of this craft, beside another receiver; '' if it may be.
    """

    topic: str
    fixes: int
    statuses: dict[str, int]
    known_covariance: float
    reported_sigma_m: Vec | None
    scatter_m: Vec | None
    height_range_m: float
    extent_m: tuple[float, float]
    travelled_m: float
    first: Vec
    slow_error: bool
    why: str
    frame_id: str = ""
    tf_frame: str | None = None
    white_m: float | None = None
    frozen: str = ""
    stored: str = ""
    in_radians: str = ""
    wander: tuple[Change, ...] = ()
    wander_by: str = ""
    without_place: int = 0
    outliers: int = 0
    without_height: int = 0
    spans_s: float = 0.0
    late_s: tuple[float, float] | None = None
    late_by: str = ""
    hinted_s: tuple[float, float] | None = None
    felt_s: float | None = None
    uneven: Uneven | None = None
    apart_m: float = 0.0
    apart_from: str = ""
    keeps_m: float = 0.0
    by_turns: tuple[PartOfFixes, PartOfFixes] | None = None
    roams_m: float = 0.0
    elsewhere: str = ""

    @property
    def rtk_sigma_m(self) -> tuple[float, float] | None:
        """Horizontal and vertical sigma to assume of RTK that reports no covariance, m; None of other fixes.

        Also None of NMEA, whose quality tells it.
        """
        augmented = set(self.statuses) - {"no fix"} == {"gbas"}
        if not augmented or self.reported_sigma_m or self.scatter_m is None or of_nmea(self.topic):
            return None
        seen_m = max(self.scatter_m[:2]), self.scatter_m[2]
        return None if seen_m[0] > _RTK_SCATTER_M else (max(_RTK_M[0], seen_m[0]), max(_RTK_M[1], seen_m[1]))

    @property
    def differs(self) -> bool:
        """Whether its slow error, or that of the other receiver, is clearly larger than the default."""
        return self.slow_error and self.apart_m > _DIFFERS * SlowErrorConfig().horizontal_sigma_m


@dataclass(frozen=True, slots=True, kw_only=True)
class CompassReport:
    """An orientation that may be a compass, judged by the GNSS course in motion.

    Attributes:
        usable: whether it is a heading. convention: 'enu' or 'ned', the one that fits better.
        offset_deg: median of yaw minus course. scatter_deg: its scatter, 1 sigma, robust.
        leeway_deg: how far the offset wanders from half minute to half minute, by leeway or the compass; None if
            unknown. Of a vessel that is set sideways, this and the offset are None, unless two antennas are mounted
            athwart.
        one_way: whether most courses go one way: then leeway or a current may make any offset, all along.
        samples: number of courses compared. why: the judgement in words. unit: of bare numbers; else None.
        like: an orientation of the same device that says the same; else ''.
        wander_deg: wander of its error beside the gyroscope, 1 sigma in a minute; None if that is not told.
        deviation_deg: magnetic deviation beside the gyroscope, as `deviation_sigma_deg` counts it; None if that is not told.
        two_antennas: whether a GNSS receiver says it, by its sentence, its topic, or as an Imu with an orientation
            alone.
        late_s: what should be added to its stamps by the gyroscope, s, and 1 sigma; None if that is not told. All other
            fields are of corrected stamps.
        late_with_fixes: whether `late_s` is by the fixes of the same messages instead of the gyroscope.
        drifts: whether its north is its own, so that it drifts as a gyroscope does.
        mount: of the IMU of the same topic, if that tilts the x axis of the orientation; then yaw and offset are of the
            axes that this mount leads to. None of another compass.
    """

    topic: str
    msgtype: str
    usable: bool
    convention: str
    offset_deg: float | None
    scatter_deg: float | None
    samples: int
    why: str
    unit: str | None = None
    like: str = ""
    leeway_deg: float | None = None
    one_way: bool = False
    wander_deg: float | None = None
    deviation_deg: float | None = None
    two_antennas: bool = False
    late_s: tuple[float, float] | None = None
    late_with_fixes: bool = False
    drifts: bool = False
    mount: MountGuess | None = None

    @property
    def ahead(self) -> bool:
        """Whether it is along the course, nearly."""
        return self.usable and self.offset_deg is not None and abs(self.offset_deg) < 180.0 - _ASTERN_DEG

    @property
    def turned_deg(self) -> float:
        """Yaw of its mount that is assumed: a multiple of 90 deg, unless courses to several sides clearly say otherwise.

        It is 0 where leeway explains the offset, or nothing tells.
        """
        if self.offset_deg is None or abs(self.offset_deg) <= TURNED_DEG:
            return 0.0
        quarter = 90.0 * round(self.offset_deg / 90.0)
        if self.one_way or abs(self.offset_deg - quarter) < _ASKEW_DEG:
            return quarter
        return float(round(self.offset_deg))

    @property
    def backwards(self) -> bool:
        """Whether it is half a turn off the course: it is mounted backwards, or the vessel goes astern."""
        return self.usable and self.offset_deg is not None and abs(self.offset_deg) > _ASTERN_DEG


class Side(NamedTuple):
    """Factor from y of a log to what the IMU feels to port, and its 1 sigma: +1 if y is to port, -1 to starboard."""

    factor: float
    sigma: float

    @property
    def to_port(self) -> bool:
        """Whether y looks to port."""
        return self.factor > 0.0

    @property
    def said(self) -> str:
        """The evidence in words."""
        side = "port" if self.to_port else "starboard"
        return f"y looks to {side}, as what the IMU feels there is {self.factor:+.2f} +- {self.sigma:.2f} times what it says"


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityReport:
    """A velocity topic.

    Attributes:
        topic, msgtype, frame_id: of its messages. tf_frame: its frame, where tf leads to it; else None.
        axes: those that fit the GNSS track; 'unknown' if none fits, None if nothing tells. why: the evidence.
        late_s: see `GnssReport`. late_with_fixes: see `CompassReport`.
        reverse: whether it says astern throughout, which is taken for a wrong sign.
        mount: of a Doppler log, whose axes are known by its type; else None.
        sideways: whether it is a log, or mounted turned, and also tells a speed along its y.
        rpy_deg: rotation of its axes by tf, where the track does not deny it; else None.
        side: which way y points, where it tells a speed along y; None if it tells none, or nothing shows the side.
        rises: whether it also tells a speed up or down.
        unsided: whether it tells a speed along y, and nothing shows the side.
    """

    topic: str
    msgtype: str
    axes: str | None
    why: str
    tf_frame: str | None
    frame_id: str = ""
    late_s: tuple[float, float] | None = None
    late_with_fixes: bool = False
    reverse: bool = False
    mount: MountGuess | None = None
    sideways: bool = False
    rpy_deg: Vec | None = None
    side: Side | None = None
    rises: bool = False
    unsided: bool = False

    @property
    def looks(self) -> str | None:
        """Its axes in words, as far as they are known."""
        if self.side and not self.side.to_port:
            return STARBOARD_AXES
        return AHEAD if self.unsided else self.axes


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryReport:
    """An odometry or pose topic.

    Attributes:
        topic, msgtype, frame_id: of its messages.
        role: 'truth', 'check_speed', 'pose', or 'other' if it is no pose of the vessel. why: the evidence.
        max_speed_mps: largest forward speed that it reports.
        origin: latitude, longitude (deg) and height (m) of its frame's origin, if the frame is east-north-up by the
            fixes; else None. world: the evidence.
        grid: whether its positions are as large as in a map grid. reverse: see `VelocityReport`.
        fused: whether it is the output of a filter or an INS, which has used the fixes: by its name, or because wheels
            cannot know its frame.
    """

    topic: str
    msgtype: str
    frame_id: str
    role: str
    max_speed_mps: float
    why: str
    origin: Vec | None
    world: str
    grid: bool = False
    reverse: bool = False
    fused: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class MountedTopic:
    """A topic of clouds or images.

    Attributes:
        frame_id: frame of its first message. tf_frame: this frame, where tf leads to it; else None.
        info_topic: a camera's CameraInfo; else ''. info_why: what tells that, unless it is beside the images.
        listed: whether it holds a detector's findings instead of images. left_out: why it is not drafted; else ''.
        optical: mount of a camera's optical frame, xyz (m) and roll, pitch, yaw (deg), where the frame in tf is another
            one; else None.
        latency_s: recording time minus header stamp of its first message, s; None if that has no stamp.
    """

    topic: str
    frame_id: str
    tf_frame: str | None
    info_topic: str = ""
    info_why: str = ""
    listed: bool = False
    left_out: str = ""
    optical: tuple[Vec, Vec] | None = None
    latency_s: float | None = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """All that `inspect` found.

    `in_body`: by frame, its place (m) and rpy (deg) in body, if the axes of tf's body are ahead, to starboard, down;
    else empty.
    """

    source: str
    topics: tuple[TopicReport, ...]
    imus: tuple[ImuReport, ...] = ()
    gnss: tuple[GnssReport, ...] = ()
    compasses: tuple[CompassReport, ...] = ()
    odometry: tuple[OdometryReport, ...] = ()
    velocities: tuple[VelocityReport, ...] = ()
    lidars: tuple[MountedTopic, ...] = ()
    cameras: tuple[MountedTopic, ...] = ()
    tf_frames: tuple[str, ...] = ()
    body_frame: str = "base_link"
    in_body: Mapping[str, tuple[Vec, Vec]] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def usable(self) -> bool:
        """Whether any topic can be a sensor."""
        poses = any(o.role == "pose" or o.grid for o in self.odometry)
        compasses = any(c.usable for c in self.compasses)
        return bool(self.imus or self.gnss or compasses or poses or self.velocities or self.lidars or self.cameras)

    @property
    def in_a_grid(self) -> tuple[OdometryReport, ...]:
        """Odometries with positions in a map grid that stand for fixes, if there is no receiver."""
        return () if self.gnss else tuple(item for item in self.odometry if item.grid)

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data for JSON; numbers that are not finite become None."""
        tree = plain(asdict(self))
        assert isinstance(tree, dict)
        return tree
