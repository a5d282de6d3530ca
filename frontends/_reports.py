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
# HDT and THS of a GNSS receiver; topics of ublox_gps, septentrio_gnss_driver, mavros and their like.
_TWO_ANTENNAS = re.compile(r"[ +]G[A-Z](HDT|THS)$|gps|gnss|nav_?heading|rel_?pos|dual|moving_?bas", re.IGNORECASE)
# Of MAVROS, microstrain_inertial, robot_localization, xsens_mti: what an EKF makes of receiver and IMU.
_FILTERED = re.compile(r"filter|ekf|ukf|kalman|fused|fusion|local_position|global_position/global$", re.IGNORECASE)
TURNED_DEG = 10.0
"""Off the course, from which a compass is taken for turned in the craft."""
_ASKEW_DEG = 15.0  # off a quarter turn, from which it sits askew
_ASTERN_DEG = 165.0  # from which a vessel that goes astern explains an offset of its compass as well
_DIFFERS = 1.5  # times the default of a slow error
# Horizontal, vertical: less is believed of no receiver that claims nothing; scatter holds no slow error.
_RTK_M = (0.05, 0.1)
_RTK_SCATTER_M = 0.1  # RTK scatters by less, DGPS, which has the same status, by more; a choice
FITS_WITH_FIXES = "what the IMU feels fits the motion of the fixes in the same messages"
"""Why the stamps of a heading, or a velocity, are late, where it does not tell that itself."""
WATER = " (through water)"
"""At the end of the name of a stream of those of a Doppler log's messages that say so."""
FILTER = " (of a filter)"
"""At the end of the name of a stream whose messages say that a filter made them; see `filtered`."""
EAST_AXES, NORTH_AXES, BODY_AXES = "east, north, up", "north, east, down", "forward, left, up (body)"
STARBOARD_AXES, AHEAD = "forward, right, down (body)", "forward (body), and to a side that nothing shows"


def bare_topic(name: str) -> str:
    """Return the topic of a stream by its name, without the sentence of NMEA, or the kind of message, that the stream is of."""
    return name.partition(" ")[0]


def two_antennas(topic: str) -> bool:
    """Return whether a heading is one of GNSS, by the name of its topic or its sentence."""
    return bool(_TWO_ANTENNAS.search(topic)) and not filtered(topic)


def through_water(topic: str) -> bool:
    """Return whether a velocity is through the water, by the name of its stream: its sentence of NMEA, or what its messages say."""
    return topic.endswith(("VHW", WATER))


def of_log(topic: str) -> bool:
    """Return whether a velocity is a log's, along the vessel, by its sentence of NMEA."""
    return topic.removesuffix(WATER).endswith(SPEEDS)


def of_nmea(topic: str) -> bool:
    """Return whether a place is one of NMEA, by the name of its stream."""
    return " " in topic.removesuffix(FILTER)


def filtered(topic: str) -> bool:
    """Return whether a place or velocity is a filter's output, by the name of its topic, or what its messages say."""
    return bool(_FILTERED.search(topic))


@dataclass(frozen=True, slots=True, kw_only=True)
class TopicReport:
    """A topic. Stamps are header stamps; None where messages of this type are not unpacked.

    Attributes:
        broken: why the first of the undecodable messages is that; '' where there is none.
        gaps: intervals longer than 5 usual ones (and 0.1 s); max_gap_s: the longest interval.
        repeated, backward: stamps equal to, or before, the one before; no_stamp: zero stamps.
        recorded: whether the headers hold no stamps, or whole seconds only, so that the recording times stand for them here.
        latency_s: recording time minus header stamp: 5 %, 50 %, 95 % points; without what the clock gains.
        drift_ppm: by how much the clock runs fast, where that is clear; else 0.
        after_s: of a place by NMEA, how long after the time that it tells it is stamped, or recorded: 5 %, 50 %, 95 % points.
        unread: of NMEA, the sentences that no sensor reads, by name, the most frequent one first, and how many there are of each.
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
    """Rotation of a sensor in body, deg, or the frame of tf that knows it; and the evidence.

    `xyz_m`: its place, where known. `yaw_told`: whether anything tells its yaw. `yaw_sigma_deg`: how well, 1 sigma, where it is not a
    quarter turn; else None.
    """

    rpy_deg: Vec
    tf_frame: str | None
    evidence: str
    xyz_m: Vec | None = None
    yaw_told: bool = True
    yaw_sigma_deg: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuReport:
    """An IMU, in its own axes and in the units of the bag.

    Attributes:
        gravity_size: median size of the acceleration; gravity_axis: its direction, unit vector.
        accel_unit, gyro_unit, gravity: as `vessel.yaml` has them; why: one line each, where not the standard.
        still_s: standstill found; gyro_bias_radps is from it (None without).
        accel_noise_ug, gyro_noise_mdps: noise densities, of the worst axis, at rest or in motion.
        reported_accel_ug, reported_gyro_mdps: densities that the messages' covariances amount to.
        fast: whether its rates are in rad/s, by its turns, though by their size deg/s would be likelier.
        missing: 'rates' or 'accelerations' where all of these are 0: half an IMU, as some drivers publish it; else ''.
        unfinite: samples that hold NaN.
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
    """By how much an error changes within `span_s`: m, 1 sigma of an axis; `seen`: by how many independent values."""

    span_s: float
    m: float
    seen: float


class PartOfFixes(NamedTuple):
    """Fixes of a receiver that has RTK at times: those of it, or the others.

    Attributes:
        share: of all its fixes. sigma_m: median that they state, east, north, up. white_m: scatter of consecutive ones. slow_m: how large
            their slow error is taken.
    """

    share: float
    sigma_m: Vec | None
    white_m: float | None
    slow_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class GnssReport:
    """A GNSS receiver.

    Attributes:
        statuses: fixes by status name; known_covariance: share of fixes that report one.
        reported_sigma_m: median sigma east, north, up; scatter_m: the white part seen in the data, the same.
        white_m: the horizontal scatter, where no motion is in it: fixes come fast, or scatter by more than a craft would.
        spans_s: time from its first fix to its last. late_s: what should be added to its stamps by the accelerometer, and
            1 sigma; None where that does not tell. late_by: whose motion told so: its own, or that of a velocity of the same device.
        hinted_s: likewise, where that is likelier than none and not clear. felt_s: the same by the fixes alone, where that is clear; else None.
        frozen, stored: warning where it repeats one position while the vessel moves, or one of before the run; '' where it does not.
        in_radians: warning where its positions look like rad; '' where they do not.
        wander: by how much their error changes along the way, by `wander_by`, wheels or a velocity; empty where these do not tell.
        uneven: how unevenly its fixes are stamped; None where these tell when each was measured.
        apart_m: by how much it and `apart_from`, the receiver it agrees with best, wander against each other, 1 sigma of an axis.
        keeps_m: how far its antenna and that of another receiver are apart at least; 0 where nothing tells.
        by_turns: the fixes of RTK, by their status and what they state, and the others, where both come.
        without_place: fixes that state none: NaN, 0, 0, or beyond 90 and 180 deg.
        without_height: fixes without one. height_range_m: 5 % to 95 % of the height. extent_m: the track's bounding box, east and north.
        roams_m: diagonal of the box, 10 % to 90 %, of the places. elsewhere: why it is not of this craft, beside another one; '' where it may be.
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
        """Horizontal and vertical sigma that its fixes are taken for, m: of RTK that reports no covariance; None for others. NMEA tells it by its quality."""
        augmented = set(self.statuses) - {"no fix"} == {"gbas"}
        if not augmented or self.reported_sigma_m or self.scatter_m is None or of_nmea(self.topic):
            return None
        seen_m = max(self.scatter_m[:2]), self.scatter_m[2]
        return None if seen_m[0] > _RTK_SCATTER_M else (max(_RTK_M[0], seen_m[0]), max(_RTK_M[1], seen_m[1]))

    @property
    def differs(self) -> bool:
        """Whether its slow error, or that of the other receiver, is clearly larger than taken by default."""
        return self.slow_error and self.apart_m > _DIFFERS * SlowErrorConfig().horizontal_sigma_m


@dataclass(frozen=True, slots=True, kw_only=True)
class CompassReport:
    """An orientation that may be a compass, judged by the GNSS course in motion.

    Attributes:
        usable: whether it fits the course; convention: the better one.
        offset_deg: mean of yaw minus course; scatter_deg: its circular standard deviation.
        leeway_deg: how far that wanders, from half minute to half minute: leeway, or the compass; None where it is not told.
            Of a vessel that is set sideways, both are None, but of two antennas athwart.
        samples: courses compared; why: the judgement in words. unit: of bare numbers, else None.
        like: an orientation that says the same, of the same device, else ''.
        wander_deg: how far its error wanders beside the gyroscope, 1 sigma for a minute; None where that does not tell.
        two_antennas: whether a GNSS receiver says it, by its sentence, its topic, or as an Imu with an orientation alone.
        late_s: what should be added to its stamps by the gyroscope, s, and 1 sigma; None where that does not tell. What is said above is
            of corrected stamps. late_with_fixes: not the gyroscope tells it, but the fixes of the same messages.
        drifts: whether its north is its own, so that it drifts as a gyroscope does.
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
    wander_deg: float | None = None
    two_antennas: bool = False
    late_s: tuple[float, float] | None = None
    late_with_fixes: bool = False
    drifts: bool = False

    @property
    def ahead(self) -> bool:
        """Whether it is that of the course, nearly."""
        return self.usable and self.offset_deg is not None and abs(self.offset_deg) < 180.0 - _ASTERN_DEG

    @property
    def turned_deg(self) -> float:
        """By how much it is taken to be turned in the craft: by quarters, unless the course says otherwise; 0 where leeway explains that, or nothing tells."""
        if self.offset_deg is None or abs(self.offset_deg) <= TURNED_DEG:
            return 0.0
        quarter = 90.0 * round(self.offset_deg / 90.0)
        return quarter if abs(self.offset_deg - quarter) < _ASKEW_DEG else float(round(self.offset_deg))

    @property
    def backwards(self) -> bool:
        """Whether it is half a turn off the course, as one that is mounted backwards, or of a vessel that goes astern."""
        return self.usable and self.offset_deg is not None and abs(self.offset_deg) > _ASTERN_DEG


class Side(NamedTuple):
    """By how much what is felt to the side goes with y of a log, to port: +1, or -1 of one to starboard; 1 sigma."""

    factor: float
    sigma: float

    @property
    def to_port(self) -> bool:
        """Whether y looks to port."""
        return self.factor > 0.0

    @property
    def said(self) -> str:
        """The evidence, in words."""
        side = "port" if self.to_port else "starboard"
        return f"y looks to {side}, as what the IMU feels there is {self.factor:+.2f} +- {self.sigma:.2f} times what it says"


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityReport:
    """A velocity topic: the axes that fit the GNSS track (unknown: none does; None: nothing to judge by), and why.

    `late_s` as of a receiver, `late_with_fixes` as of a compass. `reverse`: it says astern throughout, which is taken for a wrong sign. `mount`: of one whose own axes are known by its type.
    `sideways`: a log's, or that of one which sits turned, that tells its speed to the side, too. `rpy_deg`: how its axes sit by tf, where the
    track does not deny it. `side`: which way y looks, where it tells a speed to the side; None: it tells none, or nothing shows which.
    `rises`: whether it tells a speed up or down, too. `unsided`: whether it tells a speed to a side, and nothing shows which.
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
    """An odometry or pose topic: role is 'truth', 'check_speed', 'pose', or 'other' of what is no pose of the vessel.

    `origin`: latitude, longitude (deg) and height (m) of its frame's origin, where the frame is
    east-north-up by the fixes; `world`: the evidence. `grid`: whether its positions are as large as in a map grid. `reverse`: as of a
    velocity. `fused`: whether it is the output of a filter or an INS, by its name or as no wheels know its frame: the fixes are in it already.
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
    """A topic of clouds or images: the frame of its first message.

    Attributes:
        tf_frame: the same where tf leads to it, else None. info_topic: a camera's CameraInfo, else ''; info_why: what tells
            that, where it does not lie beside it. listed: it holds what a detector found, not images. left_out: why it is not
            drafted, else ''. optical: mount of a camera's optical frame, xyz (m) and roll, pitch, yaw (deg), where tf's frame of it
            is another one.
        latency_s: recording time minus header stamp of its first message, s; None where that has no stamp.
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
    """All of it.

    `in_body`: places (m) and rpy (deg) of frames in body, where tf has its body's axes ahead, to starboard, down.
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
        """Whether any of it can be a sensor."""
        poses = any(o.role == "pose" or o.grid for o in self.odometry)
        compasses = any(c.usable for c in self.compasses)
        return bool(self.imus or self.gnss or compasses or poses or self.velocities or self.lidars or self.cameras)

    @property
    def in_a_grid(self) -> tuple[OdometryReport, ...]:
        """Positions in a map grid that stand for fixes, where no receiver tells a latitude."""
        return () if self.gnss else tuple(item for item in self.odometry if item.grid)

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain data for JSON; numbers that are not finite become None."""
        tree = plain(asdict(self))
        assert isinstance(tree, dict)
        return tree
