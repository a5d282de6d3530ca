# SPDX-License-Identifier: Apache-2.0
"""Sentences of NMEA 0183 as a source of places, headings and velocities; messages of other packages that say the same."""

import operator
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from functools import reduce
from math import cos, isnan, radians, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphloc.app import smooth_recording
from graphloc.config import (
    BodyVelocityConfig,
    CompassConfig,
    GnssConfig,
    VelocityConfig,
    VesselConfig,
    load_config,
    parse_config,
)
from graphloc.errors import ConfigError, InputError
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import KINDS
from graphloc.frontends import nmea
from graphloc.frontends._assess import NO_TRACK
from graphloc.frontends._assess_velocity import motions_of, velocity_report
from graphloc.frontends._contents import contents_of
from graphloc.frontends._rejections import Rejection
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends._types import OTHER_TYPES
from graphloc.frontends.decode import DECODERS
from graphloc.frontends.inspect import draft_config, render
from graphloc.frontends.msgtypes import TWIST
from graphloc.ledger import Outcome
from graphloc.measurements import BodyVelocity, CompassHeading, GnssPosition, GnssVelocity, PoseFix
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.heldbags import hold_bag, inspect_bag, read_recording
from tests.test_inspect import DATUM, drive, look

SENTENCE = "nmea_msgs/msg/Sentence"


def sealed(body: str) -> str:
    """With its checksum: the exclusive or of what is between $ and *."""
    return f"${body}*{reduce(operator.xor, body.encode()):02X}"


def test_a_place_is_above_the_ellipsoid() -> None:
    """48 deg 07.038' N, 11 deg 31' W, 545.4 m above a geoid that lies 46.9 m above the ellipsoid."""
    said = nmea.fix(sealed("GPGGA,123519,4807.038,N,01131.000,W,4,08,0.9,545.4,M,46.9,M,,") + "\r\n", ["GGA"])
    assert isinstance(said, nmea.Fix)
    assert said.latitude_deg == pytest.approx(48.0 + 7.038 / 60.0, abs=1e-9)
    assert said.longitude_deg == pytest.approx(-11.0 - 31.0 / 60.0, abs=1e-9)
    assert said.height_m == pytest.approx(592.3)
    assert (said.quality, said.hdop) == (4, 0.9)
    low = nmea.fix(sealed("GPGGA,123519,4807.038,N,01131.000,W,1,08,,545.4,M,,M,,"), ["GPGGA"])
    assert isinstance(low, nmea.Fix)
    assert isnan(low.height_m)  # the geoid is not told
    assert isnan(low.hdop)


@pytest.mark.parametrize(
    ("body", "quality"),
    [("GNGNS,122310.2,3722.425671,N,12258.856215,W,DN,14,0.9,1005.543,6.5,,", 2),
     ("GPGLL,3722.425671,N,12258.856215,W,122310,A,D", 2),
     ("GNRMC,122310.2,A,3722.425671,N,12258.856215,W,5.0,90.0,230324,,,R", 4),
     ("GPRMC,122310.2,A,3722.425671,N,12258.856215,W,5.0,90.0,230324,003.1,W", 1)],
)  # fmt: skip
def test_other_sentences_say_places_too(body: str, quality: int) -> None:
    said = nmea.fix(sealed(body), nmea.PLACES)
    assert isinstance(said, nmea.Fix)
    assert said.quality == quality
    assert said.latitude_deg == pytest.approx(37.0 + 22.425671 / 60.0, abs=1e-9)
    assert isnan(said.height_m) == ("GNS" not in body)


@pytest.mark.parametrize(
    ("body", "deg"),
    [("HEHDT,123.456,T", 123.456), ("GPTHS,77.52,A", 77.52), ("HCHDM,238.5,M", 238.5),
     ("HCHDG,101.1,2.0,E,7.1,W", 96.0), ("HCHDG,101.1,,,,", 101.1),
     ("PASHR,204132.000,010.51,T,+00.39,-00.79,-00.84,0.151,0.075,0.555,1,0", 10.51),
     ("PASHR,ATT,220712.0,123.4,1.0,2.0,0.002,0.003,0", 123.4)],
)  # fmt: skip
def test_headings_are_clockwise_from_north(body: str, deg: float) -> None:
    """HDG: what the needle says, deviation and variation east of it counted on. PASHR: of an INS, or by antennas."""
    assert nmea.heading_deg(sealed(body), nmea.HEADINGS) == pytest.approx(deg)


@pytest.mark.parametrize(
    ("body", "east_mps", "north_mps"),
    [("GPVTG,090.0,T,,M,010.0,N,018.5,K,A", 10.0 * 1852.0 / 3600.0, 0.0),
     ("GPVTG,180.0,T,,M,,N,036.0,K", 0.0, -10.0),
     ("GPVTG,,T,,M,0.18,N,0.33,K,D", 0.0, 0.0),  # at rest there is no course: noise, which is not to the north
     ("GPRMC,122310.2,A,3722.425671,N,12258.856215,W,10.0,270.0,230324,,,A", -10.0 * 1852.0 / 3600.0, 0.0)],
)  # fmt: skip
def test_velocities_are_east_and_north(body: str, east_mps: float, north_mps: float) -> None:
    assert nmea.velocity_mps(sealed(body), nmea.VELOCITIES) == pytest.approx((east_mps, north_mps), abs=6e-3)


@pytest.mark.parametrize(
    ("read", "text", "outcome", "says"),
    [
        (nmea.fix, sealed("GPGGA,123519,,,,,0,00,,,M,,M,,"), Outcome.REJECTED, "no fix"),
        (nmea.fix, sealed("GPGGA,123519,4807.0,N,01131.0,E,6,08,0.9,5.4,M,46.9,M,,"), Outcome.REJECTED, "dead reckoned"),
        (nmea.fix, sealed("GPGGA,123519,4807.0,N,01131.0,E,1,08,0.9,5.4,M,46.9,M,,")[:-2] + "00", Outcome.MALFORMED, "checksum"),
        (nmea.fix, sealed("GPGGA,123519,4807.0"), Outcome.MALFORMED, "GGA"),
        (nmea.fix, "$GPGGA,123519,4807.0,N,01131.0,E", Outcome.MALFORMED, "checksum"),
        (nmea.fix, sealed("GPGGA,123519,4807.0,N,01131.0,,1,08,0.9,5.4,M,46.9,M,,"), Outcome.MALFORMED, "hemisphere"),
        (nmea.fix, "", Outcome.MALFORMED, "no sentence"),
        (nmea.fix, "!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*24", Outcome.IGNORED, "AIS"),
        (nmea.fix, sealed("PUBX,00,1"), Outcome.IGNORED, "maker"),
        (nmea.fix, sealed("GPGSV,1,1,00"), Outcome.IGNORED, "GSV"),
        (nmea.fix, sealed("GPVTG,090.0,T,,M,010.0,N,018.5,K,A"), Outcome.IGNORED, "VTG"),
        (nmea.fix, sealed("GPRMC,122310.2,V,,,,,,,230324,,,N"), Outcome.REJECTED, "no fix"),
        (nmea.heading_deg, sealed("GPTHS,77.52,S"), Outcome.REJECTED, "not measured"),
        (nmea.heading_deg, sealed("HEHDT,,T"), Outcome.REJECTED, "no heading"),
        (nmea.heading_deg, sealed("PASHR,204132.000,,T,,,,,,,0,0"), Outcome.REJECTED, "no heading"),
        (nmea.heading_deg, sealed("PASHR,ATT,220712.0,123.4,1.0,2.0,0.002,0.003,1"), Outcome.REJECTED, "not fixed"),
        (nmea.heading_deg, sealed("PASHR,SAT,3,2,1,1,1"), Outcome.IGNORED, "no heading"),
        (nmea.velocity_mps, sealed("GPVTG,,T,,M,010.0,N,018.5,K,A"), Outcome.REJECTED, "no course"),
        (nmea.velocity_mps, sealed("GPVTG,,,,,,,,,N"), Outcome.REJECTED, "no fix"),
    ],
)  # fmt: skip
def test_what_says_nothing_says_why(read: Any, text: str, outcome: Outcome, says: str) -> None:
    said = read(text, (*nmea.PLACES, *nmea.HEADINGS, *nmea.VELOCITIES))
    assert isinstance(said, Rejection)
    assert said.outcome is outcome
    assert says in said.reason


def test_one_talker_is_not_another() -> None:
    text = sealed("HEHDT,123.456,T")
    assert nmea.heading_deg(text, ["HEHDT"]) == pytest.approx(123.456)
    said = nmea.heading_deg(text, ["GPHDT"])
    assert isinstance(said, Rejection)
    assert said.outcome is Outcome.IGNORED


def test_a_message_may_hold_a_burst() -> None:
    """The sentence that is wanted is found behind others, tag blocks and ends of lines."""
    bodies = ("GPGSV,1,1,00", "HEHDT,123.456,T", "GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,5,M,4,M,,")
    text = "\r\n".join(f"\\s:gps*00\\{sealed(body)}" for body in bodies) + "\r\n"
    assert nmea.identities(text) == [("GP", "GSV"), ("HE", "HDT"), ("GP", "GGA")]
    assert nmea.heading_deg(text, ["HDT"]) == pytest.approx(123.456)
    assert isinstance(nmea.fix(text, ["GPGGA"]), nmea.Fix)
    assert isinstance(nmea.fix(text, ["GNGGA"]), Rejection)


def test_a_velocity_that_begins_without_a_fix_still_tells_the_motion() -> None:
    stream = TopicData("/nmea GPVTG", TWIST)
    for k in range(60):
        speed = (np.nan, np.nan, np.nan) if k < 20 else (0.1 * k, 1.0, 0.0)
        stream.add((1 + k) * S, (1 + k) * S, speed, "run.db3")
    report = velocity_report(stream, NO_TRACK, None)
    (motion,) = motions_of([], [(stream, report)], [])
    assert motion.speed_mps == pytest.approx([np.hypot(0.1 * k, 1.0) for k in range(20, 60)])


def minutes(deg: float, sides: str, width: int) -> str:
    side, deg = sides[deg < 0.0], abs(deg)
    return f"{int(deg):0{width}d}{60.0 * (deg % 1.0):010.7f},{side}"


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    scenario = Scenario(
        path="loops", duration_s=40.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0
    )  # fmt: skip
    return simulate(scenario, 4)


@pytest.fixture(scope="module")
def bag(run: SimulatedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Receiver, gyro compass and fluxgate talk on one line (the velocity is that of the body), in sqlite3, which holds no definitions of messages."""
    make, imu = Messages(2), run.recording.imu
    assert imu is not None
    make.register("std_msgs/Header header\nstring sentence", SENTENCE)
    items: list[Item] = [
        ("/imu", int(n), make.imu(int(n), a, w)) for n, a, w in zip(imu.stamps_ns, imu.accel_mps2, imu.gyro_radps, strict=True)
    ]  # fmt: skip

    def say(stamp_ns: int, body: str) -> None:
        message = make.t[SENTENCE](header=make.header(stamp_ns, "gps"), sentence=sealed(body))
        items.append(("/nmea_sentence", stamp_ns, message))

    assert run.recording.truth is not None
    for m in run.recording.measurements:
        if isinstance(m, GnssPosition):
            lat, lon, height = m.position
            place = f"{minutes(lat, 'NS', 2)},{minutes(lon, 'EW', 3)}"
            say(m.stamp_ns, f"GPGGA,120000.00,{place},1,09,0.9,{height - 30.0:.3f},M,30.0,M,,")
            say(m.stamp_ns, "GPGSV,1,1,01,01,40,083,46")
            east, north, _ = run.recording.truth.at(np.array([m.stamp_ns])).v_world_mps[0]  # type: ignore[index]
            knots, course = np.hypot(east, north) * 3600.0 / 1852.0, np.degrees(np.arctan2(east, north)) % 360.0
            say(m.stamp_ns, f"VWVHW,,T,,M,{knots + 0.4:.2f},N,,K")
            say(m.stamp_ns, f"GPVTG,{course:.2f},T,,M,{knots:.3f},N,{knots * 1.852:.3f},K,A")
        elif isinstance(m, CompassHeading):
            say(m.stamp_ns, f"HEHDT,{(90.0 - np.degrees(m.yaw_rad)) % 360.0:.3f},T")
            say(m.stamp_ns, f"HCHDM,{(78.0 - np.degrees(m.yaw_rad)) % 360.0:.1f},M")
    return write_bag(tmp_path_factory.mktemp("nmea") / "run", make, sorted(items, key=lambda i: i[1]))


def test_a_bag_of_sentences_is_read_as_drafted(run: SimulatedRun, bag: Path, tmp_path: Path) -> None:
    """`inspect` finds receiver, compass and velocity on the line; so drafted, they are what the simulator's own messages say."""
    drafted = tmp_path / "vessel.yaml"
    drafted.write_text(draft_config(inspect_bag(bag)))
    config = load_config(drafted, KINDS)
    kinds = {name: (s.kind, getattr(s, "nmea", ()), s.enabled) for name, s in config.sensors.items()}
    assert kinds["gnss"] == ("gnss", ("GPGGA",), True)
    assert kinds["compass"] == ("compass", ("HEHDT",), True)
    assert kinds["compass_2"] == ("compass", ("HCHDM",), False)  # two of one mast are not two witnesses
    assert kinds["gnss_velocity"] == ("gnss_velocity", ("GPVTG",), True)
    assert kinds["body_velocity"] == ("body_velocity", ("VWVHW",), False)
    log = config.sensors["body_velocity"]
    assert isinstance(log, BodyVelocityConfig)
    assert log.through == "water"
    recording = read_recording(bag, config)
    assert recording.message_count == len(recording.measurements) + len(recording.imu or ()) + sum(
        r.count for r in recording.rows
    )
    assert all(r.outcome is Outcome.IGNORED for r in recording.rows)
    for kind in (GnssPosition, CompassHeading):
        ours, theirs = (r.of(kind) for r in (recording, run.recording))
        assert [m.stamp_ns for m in ours] == [m.stamp_ns for m in theirs]
        for a, b in zip(ours, theirs, strict=True):
            if isinstance(a, GnssPosition) and isinstance(b, GnssPosition):
                assert a.position == pytest.approx(b.position, abs=1e-3)
                assert a.position[:2] == pytest.approx(b.position[:2], abs=1e-8)
            elif isinstance(a, CompassHeading) and isinstance(b, CompassHeading):
                assert np.degrees(a.yaw_rad - b.yaw_rad) == pytest.approx(0.0, abs=1e-3)
    topics = {"imu": "/imu", "gnss": "/nmea_sentence", "compass": "/nmea_sentence"}
    known = {name: run.config.sensors[name].model_copy(update={"topic": topic}) for name, topic in topics.items()}
    sigmas = np.sqrt(np.diagonal(next(m.cov_enu_m2 for m in run.recording.of(GnssPosition))))
    said = {"default_horizontal_sigma_m": float(sigmas[0]), "default_vertical_sigma_m": float(sigmas[2])}
    known["gnss"] = known["gnss"].model_copy(update=said)
    measured = run.config.model_copy(update={"sensors": {**run.config.sensors, **known}, "truth_topic": None})
    tracks = [smooth_recording(r, measured).solution.trajectory for r in (read_recording(bag, measured), run.recording)]
    assert np.abs(tracks[0].p_world_m - tracks[1].p_world_m).max() < 0.01
    assert all(m.cov_m2ps2[2, 2] >= 1e6 for m in recording.of(GnssVelocity))


def test_lines_in_plain_strings_count_from_when_they_were_recorded(tmp_path: Path) -> None:
    """As loggers write them, bursts among them; a topic of strings that says something else is no instrument."""
    make, items = Messages(2), []
    begin_ns = 1_700_000_000 * S
    for k in range(40):
        place = f"{minutes(57.7 + 1e-5 * k, 'NS', 2)},{minutes(11.9, 'EW', 3)}"
        burst = "\r\n".join(sealed(b) for b in (f"GPGLL,{place},120000,A,A", f"HEHDT,{10.0 + k:.1f},T"))
        items += [
            ("/line", begin_ns + k * S, make.text(burst)),
            ("/status", begin_ns + k * S, make.text("under way")),
        ]
    bag, drafted = hold_bag(tmp_path / "run", make, items), tmp_path / "vessel.yaml"
    drafted.write_text(draft_config(inspect_bag(bag)))
    config = load_config(drafted, KINDS)
    lines = {(s.topic, s.nmea) for s in config.sensors.values() if isinstance(s, GnssConfig | CompassConfig)}
    assert lines == {("/line", ("GPGLL",)), ("/line", ("HEHDT",))}
    recording = read_recording(bag, config)
    fixes = recording.of(GnssPosition)
    assert [m.stamp_ns for m in fixes] == [begin_ns + k * S for k in range(40)]
    assert [m.position.latitude_deg for m in fixes] == pytest.approx([57.7 + 1e-5 * k for k in range(40)], abs=1e-8)
    headings = recording.of(CompassHeading)
    assert [np.degrees(m.yaw_rad) for m in headings] == pytest.approx([80.0 - k for k in range(40)])
    assert sum("has no stamp" in w for w in recording.warnings) == 2


def rmc_bag(path: Path, more: Callable[[float, float], list[str]], speeds: bool = True) -> Path:
    """40 s at 5 Hz in a circle, at 2 m/s, the first 4 s at rest; `more`: sentences beside RMC by speed (kn) and course (deg)."""
    make, items, lat, lon = Messages(2), list[Item](), 57.7, 11.9
    for k in range(200):
        mps, course = (2.0 if k > 20 else 0.0), (3.0 * k) % 360.0
        lat += 0.2 * mps * cos(radians(course)) / 111_400.0
        lon += 0.2 * mps * sin(radians(course)) / (111_400.0 * cos(radians(lat)))
        knots = mps * 3600.0 / 1852.0
        # At rest receivers leave the course out, or make one up.
        said = f"{knots:.3f},{course if k > 10 else 222.0:.1f}" if speeds else ","
        place = f"{minutes(lat, 'NS', 2)},{minutes(lon, 'EW', 3)}"
        bodies = [f"GPRMC,120000.00,A,{place},{said},141123,,,A", *more(knots, course)]
        items += [("/line", 1_700_000_000 * S + k * S // 5, make.text(sealed(body))) for body in bodies]
    return hold_bag(path, make, items)


@pytest.mark.parametrize(
    ("more", "speeds", "read"),
    [
        (lambda *_: [], True, ("GPRMC",)),
        (lambda *_: [], False, None),
        (lambda kn, deg: [f"GPVTG,{deg:.1f},T,,M,{kn:.3f},N,{kn * 1.852:.3f},K,A"], True, ("GPVTG",)),
        (lambda kn, deg: [f"GNVTG,{deg:.1f},T,,M,{kn:.3f},N,{kn * 1.852:.3f},K,A"], True, ("GNVTG",)),
        (lambda *_: ["GPVTG,,T,,M,,N,,K"], True, ("GPRMC",)),
        (lambda kn, deg: [f"GPVTG,{deg:.1f},T,,M,{kn:.3f},N,,K,A"] if deg % 6.0 else [], True, ("GPRMC",)),
    ],
    ids=["RMC", "without a speed", "VTG", "VTG of another talker", "empty VTG", "VTG every other time"],
)
def test_course_and_speed_of_rmc_are_drafted_where_no_vtg_says_them(
    more: Callable[[float, float], list[str]], speeds: bool, read: tuple[str, ...] | None, tmp_path: Path
) -> None:
    drafted, bag = tmp_path / "vessel.yaml", rmc_bag(tmp_path / "run", more, speeds)
    drafted.write_text(draft_config(inspect_bag(bag)))
    config = load_config(drafted, KINDS)
    assert config.of_kind("gnss")["gnss"].nmea == ("GPRMC",)
    used = config.of_kind("gnss_velocity")
    assert [sensor.nmea for sensor in used.values()] == ([read] if read else [])
    if read != ("GPRMC",):
        return
    velocities = [m for m in read_recording(bag, config).measurements if isinstance(m, GnssVelocity)]
    assert len(velocities) == 200
    # A course at rest says nothing: it is a velocity of zero, as well known to all sides.
    assert all(not m.v_enu_mps[:2].any() for m in velocities[:21])
    assert all(m.cov_m2ps2[0, 0] == m.cov_m2ps2[1, 1] == pytest.approx(0.3**2) for m in velocities)
    assert velocities[30].v_enu_mps[:2] == pytest.approx([2.0, 0.0], abs=2e-3)  # course 90


def gga_bag(path: Path, quality: Callable[[int], int], damaged: int = 0) -> Path:
    """200 fixes at 5 Hz on the way east; of the first `damaged` the checksum is wrong."""
    make, items = Messages(2), []
    for k in range(200):
        place = f"{minutes(57.7, 'NS', 2)},{minutes(11.9 + 1e-6 * k, 'EW', 3)}"
        line = sealed(f"GNGGA,120000.00,{place},{quality(k)},14,0.7,41.5,M,36.5,M,1.0,0001")
        line = line[:-2] + f"{int(line[-2:], 16) ^ 1:02X}" if k < damaged else line
        items.append(("/line", 1_700_000_000 * S + k * S // 5, make.text(line)))
    return hold_bag(path, make, items)


@pytest.mark.parametrize(
    ("quality", "slow_m"),
    [
        (lambda _: 4, {"gnss": 0.03}), (lambda k: 5 if k % 10 == 0 else 4, {"gnss": 0.03, "gnss_other": 0.3}),
        (lambda k: 1 if k % 10 == 0 else 4, {"gnss": 0.03, "gnss_other": 2.0}), (lambda _: 1, {"gnss": 2.0}),
    ],
    ids=["fixed", "float at times", "no RTK at times", "no RTK"],
)  # fmt: skip
def test_the_slow_error_is_drafted_by_quality(
    quality: Callable[[int], int], slow_m: dict[str, float], tmp_path: Path
) -> None:
    drafted = tmp_path / "vessel.yaml"
    drafted.write_text(draft_config(inspect_bag(gga_bag(tmp_path / "run", quality))))
    config = load_config(drafted, KINDS)
    assert {name: g.slow_error.horizontal_sigma_m for name, g in config.of_kind("gnss").items()} == slow_m
    fixes = Counter(m.sensor for m in read_recording(tmp_path / "run", config).measurements)
    assert fixes == ({"gnss": 180, "gnss_other": 20} if len(slow_m) > 1 else {"gnss": 200})


def test_a_damaged_sentence_is_not_one_without_a_fix(tmp_path: Path) -> None:
    seen = inspect_bag(gga_bag(tmp_path / "run", lambda _: 4, damaged=7))
    assert [g.statuses for g in seen.gnss] == [{"gbas": 193}]
    assert [t.undecodable for t in seen.topics if t.topic == "/line GNGGA"] == [7]
    assert "/line GNGGA: 7 messages cannot be decoded" in render(seen)


def lines_bag(path: Path, bodies: Callable[[int], list[str]], count: int, step_ns: int = S) -> Path:
    """`bodies(k)`: the sentences of step k, on one line."""
    make = Messages(2)
    items = [
        ("/line", 1_700_000_000 * S + k * step_ns, make.text(sealed(body))) for k in range(count) for body in bodies(k)
    ]
    return hold_bag(path, make, items)


def ahead(k: int, mps: float = 5.0) -> str:
    """Where a vessel is after k seconds northwards."""
    return f"{minutes(57.7 + k * mps / 111_400.0, 'NS', 2)},{minutes(11.9, 'EW', 3)}"


def test_a_line_that_is_read_is_not_said_to_be_of_no_known_type(tmp_path: Path) -> None:
    make = Messages(2)
    make.register("std_msgs/Header header\nstring sentence", SENTENCE)
    items = []
    for k in range(30):
        at = 1_700_000_000 * S + k * S
        said = make.t[SENTENCE](header=make.header(at), sentence=sealed(f"GPGLL,{ahead(k)},120000,A,A"))
        items.append(("/nmea", at, said))
    warnings = inspect_bag(hold_bag(tmp_path / "run", make, items)).warnings
    assert any("no whole IMU" in w for w in warnings)
    assert not any("/nmea" in w for w in warnings)


@pytest.mark.parametrize(("lost", "read"), [(5, ("GPGGA",)), (60, ("GPGLL",))])
def test_a_place_with_a_height_is_taken_before_one_without(lost: int, read: tuple[str, ...], tmp_path: Path) -> None:
    """A GLL more than GGA was worth more than heights, dilution and quality; far more fixes are."""

    def bodies(k: int) -> list[str]:
        gga = [f"GPGGA,120000.00,{ahead(k)},1,09,0.9,10.0,M,30.0,M,,"] if k >= lost else []
        return [f"GPGLL,{ahead(k)},120000,A,A", *gga]

    drafted = tmp_path / "vessel.yaml"
    drafted.write_text(draft_config(inspect_bag(lines_bag(tmp_path / "run", bodies, 100))))
    gnss = load_config(drafted, KINDS).sensors["gnss"]
    assert isinstance(gnss, GnssConfig)
    assert (gnss.enabled, gnss.nmea) == (True, read)


@pytest.mark.parametrize("height_m", [None, 40.0])
def test_the_curvature_of_the_earth_is_no_height(height_m: float | None, tmp_path: Path) -> None:
    """After 30 km the tangent plane of the first fix lies 70 m above the sea."""

    def bodies(k: int) -> list[str]:
        place = ahead(k, mps=100.0)
        told = f"GPGGA,120000.00,{place},1,09,0.9,{height_m},M,30.0,M,,"
        return [told if height_m else f"GPGLL,{place},120000,A,A"]

    seen = inspect_bag(lines_bag(tmp_path / "run", bodies, 300))
    assert seen.gnss[0].height_range_m == pytest.approx(0.0, abs=1e-6)
    assert "height ranges" not in draft_config(seen)
    assert "vertical_sigma_m" not in draft_config(seen)
    assert ("height 0.0 m" in render(seen)) == (height_m is not None)  # of none, no height is said
    (scatter,) = (line for line in render(seen).split("\n") if "scatter from fix to fix" in line)
    assert len(scatter.split()) == (9 if height_m else 8)


def test_a_height_that_drifts_is_no_reason_to_take_the_sentence_without_one(tmp_path: Path) -> None:
    """In a street canyon: GGA and RMC say one position, but GGA that it is bad, by its DOP, and how high it is."""

    def bodies(k: int) -> list[str]:
        place, height_m = ahead(k, 5.0), 10.0 + 60.0 * np.sin(k / 20.0)
        return [
            f"GNRMC,120000.00,A,{place},{5.0 / nmea.KNOT_MPS:.3f},0.0,141123,,,A",
            f"GNGGA,120000.00,{place},1,09,0.9,{height_m:.1f},M,30.0,M,,",
        ]

    bag, drafted = lines_bag(tmp_path / "run", bodies, 100, S), tmp_path / "vessel.yaml"
    drafted.write_text(draft_config(inspect_bag(bag)))
    assert load_config(drafted, KINDS).of_kind("gnss")["gnss"].nmea == ("GNGGA",)


@pytest.mark.parametrize("hz", [1, 10])
def test_a_receiver_that_changes_its_talker_is_one(hz: int, tmp_path: Path) -> None:
    """GP where it sees GPS satellites alone, GN with others: of the draft, which named one talker, half of the fixes were left."""

    def bodies(k: int) -> list[str]:
        talker = "GN" if k // 20 % 2 else "GP"
        place = ahead(k, 5.0 / hz)
        return [
            f"{talker}GGA,120000.00,{place},1,09,0.9,10.0,M,30.0,M,,",
            f"{talker}RMC,120000.00,A,{place},{5.0 / nmea.KNOT_MPS:.3f},0.0,141123,,,A",
        ]

    bag, drafted = lines_bag(tmp_path / "run", bodies, 100, S // hz), tmp_path / "vessel.yaml"
    drafted.write_text(draft_config(inspect_bag(bag)))
    config = load_config(drafted, KINDS)
    used = {
        name: s.nmea for name, s in {**config.of_kind("gnss"), **config.of_kind("gnss_velocity")}.items() if s.enabled
    }
    assert used == {"gnss": ("GPGGA", "GNGGA"), "gnss_velocity": ("GPRMC", "GNRMC")}
    measured = read_recording(bag, config).measurements
    assert len([m for m in measured if isinstance(m, GnssPosition)]) == 100
    assert len([m for m in measured if isinstance(m, GnssVelocity)]) == 100


@pytest.mark.parametrize("apart_ns", [0, S // 2])
@pytest.mark.parametrize("every", [1, 5])
def test_two_receivers_on_a_line_stay_two(every: int, apart_ns: int, tmp_path: Path) -> None:
    make, items = Messages(2), list[Item]()
    for k in range(100):
        at = 1_700_000_000 * S + k * S
        gga = f"GGA,120000.00,{ahead(k)},1,09,0.9,10.0,M,30.0,M,,"
        items.append(("/line", at, make.text(sealed("GN" + gga))))
        if k % every == 0:
            items.append(("/line", at + apart_ns, make.text(sealed("GP" + gga))))
    seen = inspect_bag(hold_bag(tmp_path / "run", make, items))
    assert [g.topic for g in seen.gnss] == ["/line GNGGA", "/line GPGGA"]


def test_a_clock_of_a_line_is_set_though_one_sentence_comes_later_and_one_has_no_stamps_of_its_own(
    tmp_path: Path,
) -> None:
    """Headings from after it hid that it was set; places of whole seconds, taken by their recording times, were moved as well."""
    make, items = Messages(2), [item for item in drive(Messages(2), seconds=60) if item[0] == "/imu"]
    make.register("std_msgs/Header header\nstring sentence", SENTENCE)
    first = items[0][1]
    for k in range(600):
        logged = first + k * S // 10
        stamp = logged + (18 * S if k < 400 else 0)
        bodies = {f"GPVTG,0.00,T,,M,{9.0 + 0.001 * k:.3f},N,16.668,K,A": stamp}
        bodies |= {f"GPGGA,120000.00,{ahead(k // 2, 2.5)},4,12,0.8,41.5,M,36.5,M,,": stamp // S * S}
        bodies |= {f"HEHDT,{0.01 * k:.3f},T": stamp} if k > 450 else {}
        for body, at in bodies.items():
            items.append(("/nmea", logged, make.t[SENTENCE](header=make.header(at, "gps"), sentence=sealed(body))))
    bag = contents_of(write_bag(tmp_path / "run", make, sorted(items, key=lambda item: item[1])))
    assert any("/nmea was set back by 18.00 s" in said for said in bag.warnings)
    places = bag.aligned["/nmea GPGGA"]
    np.testing.assert_array_equal(places.stamps_ns, places.logs_ns)


def test_two_receivers_that_are_recorded_to_the_second_stay_two(tmp_path: Path) -> None:
    """At 5 Hz most of their messages were recorded at one time, and so within no part of a step of each other: they were joined."""

    def bodies(k: int) -> list[str]:
        gga = f"GGA,120000.00,{ahead(k // 5)},1,09,0.9,10.0,M,30.0,M,,"
        return ["GN" + gga, "GP" + gga]

    make, items = Messages(2), list[Item]()
    for k in range(200):
        items += [("/line", 1_700_000_000 * S + k // 5 * S, make.text(sealed(body))) for body in bodies(k)]
    seen = inspect_bag(hold_bag(tmp_path / "run", make, items))
    assert [g.topic for g in seen.gnss] == ["/line GNGGA", "/line GPGGA"]


def test_a_sensor_that_hears_nothing_says_so_of_its_own_sentences(tmp_path: Path) -> None:
    """Most of what is on the line is for others, and no reason."""

    def bodies(k: int) -> list[str]:
        return [f"GPGLL,{ahead(k)},120000,A,A", "GPGSV,1,1,01,01,40,083,46", "GPVTG,,T,,M,,N,,K,N"]

    sensors = {
        "gnss": {"kind": "gnss", "topic": "/line", "nmea": ["GLL"]},
        "gnss_velocity": {"kind": "gnss_velocity", "topic": "/line", "nmea": ["VTG"]},
    }
    config = parse_config({"vessel": "boat", "sensors": sensors}, KINDS, "vessel.yaml")
    warnings = read_recording(lines_bag(tmp_path / "run", bodies, 50), config).warnings
    assert "gnss_velocity: none of the 150 messages on /line could be used, mostly: VTG: no fix" in warnings


def gps_fix(make: Messages, stamp_ns: int, lat: float, lon: float, *, status: int = 0, **told: float) -> Any:
    """A `gps_msgs/GPSFix` at 40 m with sigmas of 0.5, 0.5, 1 m; `told`: other fields, 0 where not given."""
    if "gps_msgs/msg/GPSFix" not in make.t:
        make.register(OTHER_TYPES["gps_msgs/msg/GPSFix"], "gps_msgs/msg/GPSFix")
    numbers = {n: 0.0 for n in ("track", "speed", "climb", "pitch", "roll", "dip", "time", "gdop", "pdop", "hdop", "vdop", "tdop", "err", "err_horz", "err_vert", "err_track", "err_speed", "err_climb", "err_time", "err_pitch", "err_roll", "err_dip")}  # fmt: skip
    lists = {n: np.zeros(0, dtype=np.int32) for n in ("satellite_used_prn", "satellite_visible_prn", "satellite_visible_z", "satellite_visible_azimuth", "satellite_visible_snr")}  # fmt: skip
    header = make.header(stamp_ns)
    state = make.t["gps_msgs/msg/GPSStatus"](header=header, satellites_used=0, satellites_visible=0, status=status, motion_source=0, orientation_source=0, position_source=0, **lists)  # fmt: skip
    return make.t["gps_msgs/msg/GPSFix"](header=header, status=state, latitude=lat, longitude=lon, altitude=40.0, position_covariance=np.diag([0.25, 0.25, 1.0]).ravel(), position_covariance_type=2, **(numbers | told))  # fmt: skip


def test_the_course_and_speed_of_a_gps_fix_are_a_velocity(tmp_path: Path) -> None:
    """gpsd_client and others say it nowhere else, and it was left out: nothing told the receiver's drift from motion."""
    make = Messages(2)
    drawn = drive(make, status=0, sigma_m=1.0, seconds=60)
    fixes = [(at, m) for topic, at, m in drawn if topic == "/fix"]
    p = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for _, m in fixes]).T)
    v = np.gradient(p, 0.2, axis=0)
    said = [item for item in drawn if item[0] == "/imu"]
    for (at, fix), (east, north, _) in zip(fixes, v, strict=True):
        speed = float(np.hypot(east, north))
        track = float(np.degrees(np.arctan2(east, north)) % 360.0) if speed > 0.05 else float("nan")
        told: dict[str, Any] = {"speed": speed, "track": track, "climb": float("nan")}
        said.append(("/gps", at, gps_fix(make, at, fix.latitude, fix.longitude, **told)))
    said.sort(key=lambda item: item[1])
    _, config, text = look(tmp_path, said, make)
    (velocity,) = config.of_kind("gnss_velocity").values()
    assert (velocity.topic, velocity.enabled) == ("/gps", True)
    assert "east, north, up" in text
    recording = read_recording(tmp_path / "run", config)
    read = recording.of(GnssVelocity)
    assert len(read) == len(fixes)
    np.testing.assert_allclose([m.v_enu_mps[:2] for m in read], v[:, :2], atol=0.05)
    assert all(m.cov_m2ps2[2, 2] > 1e5 for m in read)  # no climb


def test_a_gps_fix_without_a_speed_tells_no_velocity() -> None:
    make, nan = Messages(2), float("nan")
    for speed, track, status, why in ((nan, 0.0, 0, "no speed"), (3.0, nan, 0, "no track"), (3.0, 0.0, -1, "no fix")):
        fix = gps_fix(make, S, 57.7, 11.9, speed=speed, track=track, status=status)
        found = DECODERS["gnss_velocity", "gps_msgs/msg/GPSFix"](fix, S, 0, "v", VelocityConfig())
        assert isinstance(found, Rejection)
        assert why in found.reason


def test_a_gps_fix_at_rest_without_a_track_stands() -> None:
    """Its speed is noise, to all sides; taken for a track of 0, a receiver at rest moved north by 5 cm/s."""
    fix = gps_fix(Messages(2), S, 57.7, 11.9, speed=0.09, track=float("nan"))
    found = DECODERS["gnss_velocity", "gps_msgs/msg/GPSFix"](fix, S, 0, "v", VelocityConfig())
    assert isinstance(found, GnssVelocity)
    assert found.v_enu_mps[:2] == pytest.approx((0.0, 0.0))


def test_a_climb_that_the_driver_leaves_at_0_is_none() -> None:
    """On a hill it held the height back, with a sigma of 0.3 m/s."""
    make = Messages(2)
    for climb, told in ((0.0, False), (0.2, True)):
        fix = gps_fix(make, S, 57.7, 11.9, speed=3.0, track=90.0, climb=climb)
        found = DECODERS["gnss_velocity", "gps_msgs/msg/GPSFix"](fix, S, 0, "v", VelocityConfig())
        assert isinstance(found, GnssVelocity)
        assert found.v_enu_mps == pytest.approx((3.0, 0.0, climb))
        assert (found.cov_m2ps2[2, 2] < 1.0) == told


def test_messages_of_other_packages_say_the_same(tmp_path: Path) -> None:
    """A GPSFix with WAAS, a velocity as a bare vector, a pose without a covariance."""
    make, items = Messages(2), []
    for k in range(40):
        stamp = 1_700_000_000 * S + k * S // 5
        fix = gps_fix(make, stamp, 57.7, 11.9 + 1e-5 * k, status=33)
        items += [
            ("/gps", stamp, fix),
            ("/vel", stamp, make.t["geometry_msgs/msg/Vector3Stamped"](header=make.header(stamp), vector=make.vector((3.0, 0.0, 0.0)))),
            ("/pose", stamp, make.t["geometry_msgs/msg/PoseStamped"](header=make.header(stamp), pose=make.pose(stamp, (3.0 * k, 1.0, 0.0)).pose.pose)),
        ]  # fmt: skip
    path = hold_bag(tmp_path / "run", make, items)
    config = tmp_path / "vessel.yaml"
    config.write_text(
        "vessel: other\ndatum: {latitude_deg: 57.7, longitude_deg: 11.9, height_m: 40.0}\nsensors:\n  gnss: {kind: gnss, topic: /gps, min_status: sbas}\n"
        "  v: {kind: gnss_velocity, topic: /vel}\n  pose: {kind: pose, topic: /pose}\n"
    )
    found = read_recording(path, load_config(config, KINDS)).measurements
    fixes = [m for m in found if isinstance(m, GnssPosition)]
    assert len(fixes) == 40
    assert np.diagonal(fixes[3].cov_enu_m2) == pytest.approx([0.25, 0.25, 1.0])
    assert [m.v_enu_mps[0] for m in found if isinstance(m, GnssVelocity)] == [3.0] * 40
    assert [m.modes[0].value[0] for m in found if isinstance(m, PoseFix)] == [3.0 * k for k in range(40)]
    seen = inspect_bag(path)
    assert [g.statuses for g in seen.gnss] == [{"sbas": 40}]
    assert [v.topic for v in seen.velocities] == ["/vel"]
    assert [o.topic for o in seen.odometry] == ["/pose"]


@pytest.mark.parametrize(("kind", "asked"), [("gnss", "[VTG]"), ("compass", "[]"), ("gnss_velocity", "[gpvtg]")])
def test_sentences_that_do_not_say_it_are_refused_with_the_key(kind: str, asked: str, tmp_path: Path) -> None:
    path = tmp_path / "vessel.yaml"
    path.write_text(f"sensors:\n  it: {{kind: {kind}, topic: /line, nmea: {asked}}}\n")
    with pytest.raises(ConfigError, match=r"sensors\.it\.nmea"):
        load_config(path, KINDS)


@pytest.mark.parametrize(
    ("one", "other", "twice"),
    [("GGA", "GPGGA", True), ("GNGGA, RMC", "RMC", True), ("GPGGA", "GNGGA", False), ("GGA", "RMC", False)],
)
def test_a_sentence_is_read_once(one: str, other: str, twice: bool) -> None:
    """`GGA` is that of any talker, so that of one talker is among it."""
    blocks = {
        name: {"kind": "gnss", "topic": "/line", "nmea": asked.split(", ")}
        for name, asked in zip("ab", (one, other), strict=True)
    }
    with pytest.raises(ConfigError, match="a and b both read /line") if twice else nullcontext():
        parse_config({"sensors": blocks}, KINDS, "vessel.yaml")


@pytest.mark.parametrize(
    ("kind", "one", "other", "what"),
    [
        ("pose", ["x", "y"], ["y", "yaw"], "y of /pose"),
        ("pose", ["x", "y", "yaw"], ["y", "x"], "x, y of /pose"),
        ("pose", ["x", "y"], ["y", "x"], "/pose"),
        ("pose", ["x", "y"], ["z", "yaw"], ""),
        ("body_velocity", ["x"], ["x", "y"], "x of /pose"),
    ],
)
def test_an_axis_is_read_once(kind: str, one: list[str], other: list[str], what: str) -> None:
    blocks = {name: {"kind": kind, "topic": "/pose", "axes": axes} for name, axes in (("a", one), ("b", other))}
    refused = f"^vessel.yaml: .*sensors: a and b both read {what}, which would count twice: delete .*$"
    with pytest.raises(ConfigError, match=refused) if what else nullcontext():
        parse_config({"sensors": blocks}, KINDS, "vessel.yaml")


def test_blocks_that_are_not_parsed_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match="gnss: no SensorConfig"):
        VesselConfig.model_validate({"sensors": {"gnss": {"kind": "gnss", "topic": "/fix"}}})


def test_inspect_names_the_sentences_that_are_not_read(tmp_path: Path) -> None:
    """A driver that leaves checksums out, and makers' own headings, were passed over: `inspect` said that the type of the topic is not read."""
    make = Messages(2)
    make.register(OTHER_TYPES[SENTENCE], SENTENCE)
    sentence = make.t[SENTENCE]
    bodies = ["$GPGGA,120000.00,5742.0,N,01154.0,E,1,08,0.9,5.4,M,40.0,M,,", sealed("PSAT,HPR,120000.00,10.51,0.4,-0.8,N"),
              sealed("GPGSV,1,1,00"), "!AIVDM,1,1,,A,13u?etPv2;0n:dDPwUM1U1Cb069D,0*24"]  # fmt: skip
    items = [
        ("/nmea", START_NS + k * S, sentence(make.header(START_NS + k * S), body)) for k in range(5) for body in bodies
    ]
    found, _, _ = look(tmp_path, items, make)
    text = render(found)
    for named in ("GPGGA without a checksum (5)", "PSAT (5)", "GPGSV (5)", "AIVDM (5)"):
        assert named in text
    assert "of no type that is read" not in text


def test_sentences_that_are_read_are_not_named_as_unread() -> None:
    burst = (
        sealed("GPRMC,122310.2,A,3722.425671,N,12258.856215,W,10.0,270.0,230324,,,A") + "\r\n" + sealed("HEHDT,1.0,T")
    )
    assert nmea.unread(burst + "\r\n" + sealed("GPGSA,A,3")) == ["GPGSA"]
    assert nmea.unread(sealed("GPGGA,1") + "\0") == []  # as drivers end a string
    assert nmea.unread(sealed("GPGGA,1") + " \\s:gps*33\\" + sealed("GPHDT,1,T")) == []  # a tag block between


def test_a_heading_of_pashr_is_found_among_what_the_device_says_otherwise(tmp_path: Path) -> None:
    """Its satellites came as often as its heading, so that it was no compass; and first in a message, they hid the heading."""
    satellites, turned = "PASHR,SAT,3,2,1,1,1", "PASHR,ATT,220712.0,{:.1f},1.0,2.0,0.002,0.003,0"
    burst = f"{sealed(satellites)}\r\n{sealed(turned.format(123.4))}"
    assert nmea.heading_deg(burst, ("PASHR",)) == pytest.approx(123.4)
    bag, drafted = rmc_bag(tmp_path / "run", lambda _, deg: [satellites, turned.format(deg)]), tmp_path / "vessel.yaml"
    found = inspect_bag(bag)
    drafted.write_text(draft_config(found))
    config = load_config(drafted, KINDS)
    assert [sensor.nmea for sensor in config.of_kind("compass").values()] == [("PASHR",)]
    assert "PASHR,SAT (200)" in render(found)
    assert len(read_recording(bag, config).of(CompassHeading)) == 200


@pytest.mark.parametrize(
    ("body", "through", "mps"),
    [("VDVBW,4.0,1.0,A,-2.0,-0.5,A,0.1,A,0.2,A", "water", (4.0, -1.0)),
     ("VDVBW,4.0,1.0,A,-2.0,-0.5,A,0.1,A,0.2,A", "ground", (-2.0, 0.5)),
     ("VDVBW,4.0,,A,,,V", "water", (4.0,)), ("VMVHW,,T,,M,4.0,N,7.4,K", "water", (4.0,))],
)  # fmt: skip
def test_a_log_tells_speeds_ahead_and_to_port(body: str, through: str, mps: tuple[float, ...]) -> None:
    """VBW: to starboard positive, knots; an old one ends before the speeds of the stern."""
    said = nmea.log_velocity_mps(sealed(body), nmea.SPEEDS, through)
    assert said == pytest.approx(tuple(v * 1852.0 / 3600.0 for v in mps))


def test_a_speed_that_a_log_calls_invalid_is_none() -> None:
    said = nmea.log_velocity_mps(sealed("VDVBW,4.0,0.0,A,0.0,0.0,V"), nmea.SPEEDS, "ground")
    assert isinstance(said, Rejection)
    assert (said.outcome, said.reason) == (Outcome.REJECTED, "VBW: its speed over ground is not valid")


@pytest.mark.parametrize(("nmea_of_ground", "both"), [(("VBW",), True), (("VHW",), False), (("VHW", "VBW"), False)])
def test_of_one_line_only_vbw_is_read_over_ground_and_through_the_water(
    nmea_of_ground: tuple[str, ...], both: bool, bag: Path
) -> None:
    """It tells both; VHW would count twice."""
    ground = BodyVelocityConfig(topic="/nmea_sentence", nmea=nmea_of_ground)
    water = BodyVelocityConfig(topic="/nmea_sentence", through="water", nmea=("VBW", "VHW"))
    config = VesselConfig(sensors={"ground": ground, "water": water})
    refused = pytest.raises(InputError, match=r"sensors\.water and sensors\.ground read /nmea_sentence over ground and")
    with nullcontext() if both else refused:
        read_recording(bag, config)


@pytest.mark.parametrize("tracks_bottom", [True, False])
def test_a_ships_log_is_drafted_over_ground_and_through_the_water(
    tracks_bottom: bool, run: SimulatedRun, bag: Path, tmp_path: Path
) -> None:
    """VBW of a Doppler log; in deep water it loses the ground."""
    make, items, truth = Messages(2), list[Item](), run.recording.truth
    assert truth is not None
    make.register(OTHER_TYPES[SENTENCE], SENTENCE)
    for m in run.recording.of(GnssPosition):
        lat, lon, height = m.position
        place = f"{minutes(lat, 'NS', 2)},{minutes(lon, 'EW', 3)}"
        at = truth.at(np.array([m.stamp_ns]))
        ahead, port, _ = at.R_world_body[0].T @ at.v_world_mps[0] * 3600.0 / 1852.0  # type: ignore[index]
        ground = f"{ahead:.2f},{-port:.2f},A" if tracks_bottom else ",,V"
        for said in (
            f"GPGGA,120000.00,{place},1,09,0.9,{height:.3f},M,0.0,M,,",
            f"VDVBW,{ahead + 0.4:.2f},{-port:.2f},A,{ground},,V,,V",
        ):
            items.append(
                ("/nmea", m.stamp_ns, make.t[SENTENCE](header=make.header(m.stamp_ns, "gps"), sentence=sealed(said)))
            )
    _, config, text = look(tmp_path, items, make)
    logs = [s for s in config.sensors.values() if isinstance(s, BodyVelocityConfig)]
    assert [s.through for s in logs] == (["ground", "water"] if tracks_bottom else ["water"])
    assert all(s.nmea == ("VDVBW",) and s.axes == ("x", "y") for s in logs)
    (tmp_path / "vessel.yaml").write_text(text.replace("enabled: false", "enabled: true"))
    read = read_recording(tmp_path / "run", load_config(tmp_path / "vessel.yaml", KINDS)).of(BodyVelocity)
    fixes = len(run.recording.of(GnssPosition))
    assert len(read) == fixes * len(logs)


def test_a_time_of_day_is_that_of_the_place() -> None:
    burst = (
        sealed("GPZDA,1,2,3")
        + sealed("GNRMC,235959.50,A,3722.4,N,12258.8,W,10.0,270.0,230324,,,A")
        + sealed("GPGLL,3722.4,N,12258.8,W,000001,A")
    )
    assert nmea.time_of_day_s(burst, "GNRMC") == pytest.approx(86_399.5)
    assert nmea.time_of_day_s(burst, "GPGLL") == pytest.approx(1.0)
    assert isnan(nmea.time_of_day_s(sealed("GPGGA,,,,,,0"), "GPGGA"))
    assert isnan(nmea.time_of_day_s(burst, "GPGGA"))


@pytest.mark.parametrize(
    ("clock_s", "uneven_s", "offset_s"),
    [(0.0, 0.1, -0.4), (3.0, 0.1, 0.0), (-0.6, 0.1, 0.0), (0.0, 1.0, 0.0)],
    ids=["on time", "clock ahead", "clock behind", "whole seconds"],
)
def test_the_time_in_its_sentences_tells_how_late_a_receiver_is_stamped(
    clock_s: float, uneven_s: float, offset_s: float, tmp_path: Path
) -> None:
    """A boat's gateway passed its fixes on 0.4 to 0.6 s late, straight ahead, where the IMU tells nothing of it: 2 m at 3.5 m/s."""
    make, rng = Messages(2), np.random.default_rng(3)
    make.register(OTHER_TYPES[SENTENCE], SENTENCE)
    items: list[Item] = [
        ("/imu", START_NS + k * S // 50, make.imu(START_NS + k * S // 50, rng.normal((0.0, 0.0, 9.81), 0.05).tolist(), rng.normal(0.0, 0.002, 3).tolist()))
        for k in range(3000)
    ]  # fmt: skip
    for k in range(60):
        at_s = (START_NS // S) % 86_400 + k
        clock = f"{at_s // 3600:02d}{at_s // 60 % 60:02d}{at_s % 60:02d}.00"
        place = f"{minutes(57.7 + k * 3.5 / 111_400.0, 'NS', 2)},{minutes(11.9, 'EW', 3)}"
        late_s = 0.4 + clock_s + uneven_s * (rng.random() - 0.5)
        stamp_ns = START_NS + k * S + round(late_s * 1e9)
        for body in (f"GPGGA,{clock},{place},1,09,0.9,5.0,M,40.0,M,,", "GPVTG,0.0,T,,M,6.80,N,12.6,K,A"):
            items.append(
                ("/nmea", stamp_ns, make.t[SENTENCE](header=make.header(stamp_ns, "gps"), sentence=sealed(body)))
            )
    _, config, text = look(tmp_path, sorted(items, key=lambda i: i[1]), make)
    for kind in ("gnss", "gnss_velocity"):
        (sensor,) = config.of_kind(kind).values()
        assert sensor.time_offset_s == pytest.approx(offset_s, abs=0.03)
    assert ("right if the computer's clock is" in text) == (offset_s != 0.0)
