# SPDX-License-Identifier: Apache-2.0
"""Lines of JSON in and out: what each says, worked out by hand; and that no line is too bad."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from graphloc.config import VesselConfig, parse_config
from graphloc.errors import GraphlocError
from graphloc.estimate import Estimate, Event
from graphloc.factors import KINDS
from graphloc.frames import Datum, Geodetic
from graphloc.frontends.bag import read_recording
from graphloc.frontends.lines import MAX_LINE, Request, Trouble, parse
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity, ImuSample, Measurement, PoseFix
from graphloc.solution import Cause, Health, HealthReason
from graphloc.stream import Lines, as_json, run, serve
from tests.bagfactory import START_NS, Messages, write_bag

ROOT = Path(__file__).parent.parent
RAW: dict[str, Any] = {
    "datum": {"latitude_deg": 57.7, "longitude_deg": 11.9},
    "sensors": {
        "imu": {"topic": "/imu", "time_offset_s": 0.25},
        "gnss": {"topic": "/fix"},
        "compass": {"topic": "/heading"},
        "gnss_velocity": {"topic": "/vel"},
        "match": {"kind": "pose", "topic": "/match", "axes": ["x", "y", "yaw"]},
        "second": {"kind": "gnss", "topic": "/fix2", "enabled": False},
    },
}
CONFIG = parse_config(RAW, KINDS, "test")
CONFIG_OF_BAG = parse_config(
    {**RAW, "sensors": {k: v for k, v in RAW["sensors"].items() if k != "second"}}, KINDS, "test"
)
DATUM = Datum(Geodetic(57.7, 11.9, 0.0))
IMU: dict[str, Any] = {"type": "imu", "stamp": "5", "accel_mps2": [0, 0, 9.81], "gyro_radps": [0, 0, 0.1]}
FIX: dict[str, Any] = {"type": "gnss", "stamp": "5", "lat_deg": 57.7, "lon_deg": 11.9, "height_m": 2.0}
POSE: dict[str, Any] = {"type": "pose", "stamp": "5", "modes": [{"xyz_m": [1, 2, 3], "rpy_deg": [0, 0, 90]}]}
HEADING: dict[str, Any] = {"type": "heading", "stamp": "5", "heading_deg": 30.0}
VELOCITY: dict[str, Any] = {"type": "velocity", "stamp": "5", "v_enu_mps": [1, 2, -0.5]}
VALID = [IMU, FIX, POSE, HEADING, VELOCITY, {"type": "predict"}]


def said(line: dict[str, Any], config: VesselConfig = CONFIG) -> Any:
    return parse(json.dumps(line).encode(), 7, 3, config)


def refused(line: dict[str, Any] | bytes, words: str, outcome: Outcome = Outcome.MALFORMED) -> LedgerRow:
    found = parse(line if isinstance(line, bytes) else json.dumps(line).encode(), 7, 3, CONFIG)
    assert isinstance(found, Trouble), found
    assert (found.row.seq, found.row.topic, found.row.detail) == (3, "(stream)", "line 7")
    assert found.row.outcome is outcome
    assert words in found.row.reason
    assert len(found.row.reason) <= 200
    assert "\n" not in found.row.reason
    return found.row


def test_stamps_keep_every_nanosecond() -> None:
    # 1_700_000_000.123456789 needs 61 bits, a float has 53. The IMU's time_offset_s of 0.25 comes on top.
    exact = 1_700_000_000_123_456_789
    for stamp in ({"stamp": "1700000000.123456789"}, {"stamp_ns": exact}):
        rest = {k: v for k, v in IMU.items() if k != "stamp"}
        assert said({**rest, **stamp}).stamp_ns == exact + 250_000_000
        assert said({"type": "predict", **stamp}) == Request(exact)
    assert said({**FIX, "stamp": "1.5"}).stamp_ns == 1_500_000_000
    assert said({"type": "predict"}) == Request(None)


def test_imu() -> None:
    m = said(IMU)
    assert isinstance(m, ImuSample)
    assert (m.sensor, m.seq) == ("imu", 3)
    np.testing.assert_array_equal(m.accel_mps2, [0, 0, 9.81])
    np.testing.assert_array_equal(m.gyro_radps, [0, 0, 0.1])


def test_gnss_uncertainty() -> None:
    m = said(FIX)
    assert isinstance(m, GnssPosition)
    assert m.position == (57.7, 11.9, 2.0)
    np.testing.assert_allclose(m.cov_enu_m2, np.diag([2.25, 2.25, 16.0]))  # configured 1.5 m, 4 m
    np.testing.assert_allclose(said({**FIX, "sigma_m": [1, 2, 3]}).cov_enu_m2, np.diag([1.0, 4.0, 9.0]))
    full = [[2.0, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 4.0]]
    np.testing.assert_allclose(said({**FIX, "cov_enu_m2": full}).cov_enu_m2, full)
    refused({**FIX, "cov_enu_m2": full, "sigma_m": [1, 1, 1]}, "give one of sigma_m, cov_enu_m2")


def test_gnss_without_a_height_is_a_horizontal_fix() -> None:
    flat = said({key: value for key, value in FIX.items() if key != "height_m"})
    assert (flat.has_height, said(FIX).has_height) == (False, True)


def test_gnss_without_a_fix_is_rejected_as_from_a_bag() -> None:
    assert refused({**FIX, "status": "none"}, "no fix", Outcome.REJECTED).stamp_ns == 5_000_000_000
    refused({**FIX, "lat_deg": 0, "lon_deg": 0}, "the receiver had none", Outcome.REJECTED)
    refused({**FIX, "lat_deg": 111.9, "lon_deg": 57.7}, "look swapped")


def test_heading_is_a_compass_heading() -> None:
    m = said(HEADING)  # 30 deg east of north is 60 deg north of east
    assert isinstance(m, CompassHeading)
    assert m.yaw_rad == pytest.approx(np.pi / 3)
    assert m.sigma_rad == pytest.approx(1.5 * np.pi / 180)  # configured
    west = said({**HEADING, "heading_deg": 270, "sigma_deg": 2})
    assert abs(west.yaw_rad) == pytest.approx(np.pi)
    assert west.sigma_rad == pytest.approx(2 * np.pi / 180)
    assert said({"type": "heading", "stamp": "5", "yaw_rad": -1.0}).yaw_rad == pytest.approx(-1.0)
    assert said({**HEADING, "heading_deg": 0}).yaw_rad == pytest.approx(np.pi / 2)  # 0 is a heading, not its absence
    refused({**HEADING, "yaw_rad": 1.0}, "give one of heading_deg, yaw_rad")
    refused({"type": "heading", "stamp": "5"}, "give one of heading_deg, yaw_rad")
    refused({"type": "heading", "stamp": "5", "yaw_rad": 90}, "less than or equal")  # deg for rad


def test_configured_sigma_goes_first_where_the_reported_one_is_not_believed() -> None:
    sensors = {"compass": {"use_reported_sigma": False, "sigma_deg": 3.0}}
    m = said({**HEADING, "sigma_deg": 0.1}, parse_config({"sensors": sensors}, KINDS, "test"))
    assert m.sigma_rad == pytest.approx(np.pi / 60)


def test_velocity() -> None:
    m = said(VELOCITY)
    assert isinstance(m, GnssVelocity)
    np.testing.assert_array_equal(m.v_enu_mps, [1, 2, -0.5])
    np.testing.assert_allclose(m.cov_m2ps2, 0.09 * np.eye(3))
    np.testing.assert_allclose(said({**VELOCITY, "sigma_mps": [0.1, 0.2, 0.3]}).cov_m2ps2, np.diag([0.01, 0.04, 0.09]))
    level = said({**VELOCITY, "v_enu_mps": [1, 2, 0], "sigma_mps": [0.1, 0.2, 0.3]}).cov_m2ps2  # as in a bag: not told
    np.testing.assert_allclose(level[:2, :2], np.diag([0.01, 0.04]))
    assert level[2, 2] > 1e4
    down = parse_config({"sensors": {"v": {"kind": "gnss_velocity", "convention": "ned"}}}, KINDS, "test")  # of a bag
    np.testing.assert_array_equal(said(VELOCITY, down).v_enu_mps, [1, 2, -0.5])


def test_pose_with_modes() -> None:
    half = 0.5**0.5  # a quarter turn to the left
    modes = [
        {"xyz_m": [1, 2, 3], "rpy_deg": [0, 0, 90], "sigma_m": [0.1, 0.2, 9], "sigma_deg": [9, 9, 1], "probability": 0.6},
        {"xyz_m": [4, 5, 6], "quaternion_xyzw": [0, 0, half, half], "cov_m_rad": np.diag([1, 2, 3, 4, 5, 6]).tolist(), "probability": 0.3},
    ]  # fmt: skip
    m = said({**POSE, "modes": modes})
    assert isinstance(m, PoseFix)
    assert m.axes == ("x", "y", "yaw")
    np.testing.assert_allclose(m.modes[0].value, [1, 2, np.pi / 2])
    np.testing.assert_allclose(m.modes[0].cov, np.diag([0.01, 0.04, np.radians(1) ** 2]))
    np.testing.assert_allclose(m.modes[1].value, [4, 5, np.pi / 2])
    np.testing.assert_allclose(m.modes[1].cov, np.diag([1.0, 2.0, 6.0]))
    assert [mode.probability for mode in m.modes] == [0.6, 0.3]
    assert m.none_probability == pytest.approx(0.1)


def test_pose_refused() -> None:
    mode = POSE["modes"][0]
    refused({**POSE, "modes": []}, "modes")
    refused({**POSE, "modes": [mode, mode]}, "sum to more than 1")
    refused({**POSE, "modes": [{"xyz_m": [1, 2, 3]}]}, "no unit quaternion")  # yaw is among the axes
    refused({**POSE, "modes": [{**mode, "quaternion_xyzw": [0, 0, 0, 1]}]}, "give one of rpy_deg, quaternion_xyzw")


BAD: list[tuple[dict[str, Any] | bytes, str]] = [
    (b"{", "not JSON"),
    (b'{"type": "imu", "stamp": "5", "accel_mps2": [NaN, 0, 0], "gyro_radps": [0, 0, 0]}', "not JSON"),
    (b'{"type": "imu", "sensor": "\xff"}', "not JSON"),
    (b"[" * 10_000, "not JSON"),
    (b"1" * 6_000, "not JSON"),
    (b'"' + b"x" * MAX_LINE + b'"', "longer than 1048576 bytes"),
    (b"[]", "known 'type'"),
    (b"null", "known 'type'"),
    ({"type": "gnsss"}, "did you mean 'gnss'?"),
    ({"type": ["imu"]}, "known 'type'"),
    ({k: v for k, v in IMU.items() if k != "gyro_radps"}, "imu: 'gyro_radps' is missing"),
    ({**IMU, "gyro_radsp": 1}, "unknown key 'gyro_radsp'; did you mean 'gyro_radps'?"),
    ({**IMU, "accel_mps2": [0, 0]}, "accel_mps2.2"),
    ({**IMU, "accel_mps2": [0, 0, 0, 0]}, "accel_mps2"),
    ({**IMU, "accel_mps2": [0, 0, True]}, "valid number"),
    ({**IMU, "accel_mps2": [0, 0, "9.81"]}, "valid number"),
    ({**IMU, "accel_mps2": [0, 0, None]}, "valid number"),
    (json.dumps(IMU).replace("9.81", "1e999").encode(), "finite"),
    ({**IMU, "accel_mps2": [0, 0, 10**4000]}, "imu: accel_mps2.2"),
    ({**IMU, "stamp": 5.5}, "stamp: Input should be a valid string"),
    ({**IMU, "stamp": "1.0000000001"}, "nine"),
    ({**IMU, "stamp": "\u0661"}, "nine"),  # an Arabic digit is a digit for int()
    ({**IMU, "stamp": "-1"}, "nine"),
    ({**IMU, "stamp": "0.0"}, "zero"),
    ({**IMU, "stamp_ns": 5}, "give one of stamp, stamp_ns"),
    ({k: v for k, v in IMU.items() if k != "stamp"}, "give one of stamp, stamp_ns"),
    ({**FIX, "stamp": None, "stamp_ns": 2**63}, "too large"),
    ({**FIX, "stamp": None, "stamp_ns": 10**4000}, "too large"),
    ({**FIX, "stamp": None, "stamp_ns": True}, "valid integer"),
    ({**FIX, "stamp": "9999999999"}, "too large"),
    ({**FIX, "sensor": "gps"}, "no sensor 'gps' of kind gnss"),
    ({**FIX, "sensor": "imu"}, "no sensor 'imu' of kind gnss"),
    ({**FIX, "sigma_m": [0, 1, 1]}, "greater than 0"),
    ({**FIX, "sigma_m": 1}, "sigma_m"),
    ({"type": "predict", "sensor": "imu"}, "unknown key 'sensor'"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "words"), BAD, ids=range(len(BAD)))
def test_a_bad_line_is_told_and_counted(line: dict[str, Any] | bytes, words: str) -> None:
    refused(line, words)


def test_a_bad_line_counts_to_the_sensor_that_it_names() -> None:
    assert refused({**IMU, "sensor": "imu", "accel_mps2": 1}, "accel_mps2").sensor == "imu"
    assert refused({**IMU, "sensor": "nobody", "accel_mps2": 1}, "accel_mps2").sensor == ""


def test_which_sensor() -> None:
    assert said(FIX).sensor == "gnss"  # the only one that is switched on
    refused({**FIX, "sensor": "second"}, "switched off", Outcome.IGNORED)
    two = parse_config({"sensors": {n: {"kind": "gnss"} for n in ("bow", "stern")}}, KINDS, "test")
    assert said({**FIX, "sensor": "stern"}, two).sensor == "stern"
    assert "2 enabled sensors of kind gnss" in said(FIX, two).row.reason
    assert "0 enabled sensors of kind imu" in said(IMU, two).row.reason
    many = {f"{'receiver' * 8}{i}": {"kind": "gnss"} for i in range(9)}
    assert len(said({**FIX, "sensor": "x"}, parse_config({"sensors": many}, KINDS, "test")).row.reason) == 200


def test_a_fix_goes_to_the_sensor_that_reads_it() -> None:
    """Of a receiver whose RTK comes and goes; whoever sent all fixes to one of the two lost those of the other."""
    turns = {"gnss": {"kind": "gnss", "fixes": "rtk"}, "gnss_other": {"kind": "gnss", "fixes": "other"}}
    config = parse_config({"sensors": turns}, KINDS, "test")
    rtk = {**FIX, "status": "gbas", "sigma_m": [0.02, 0.02, 0.04]}
    others = [FIX, {**rtk, "status": "fix"}, {**rtk, "sigma_m": [0.5, 0.5, 1.0]}]
    for named in ({}, {"sensor": "gnss"}, {"sensor": "gnss_other"}):
        assert said({**rtk, **named}, config).sensor == "gnss"
        assert [said({**other, **named}, config).sensor for other in others] == ["gnss_other"] * 3
    alone = parse_config({"sensors": {"gnss": turns["gnss"]}}, KINDS, "test")
    assert said(FIX, alone).row.outcome is Outcome.IGNORED
    sets = {f"{name}_{side}": block for side in ("bow", "stern") for name, block in turns.items()}
    unclear = parse_config({"sensors": sets}, KINDS, "test")  # without topics nothing tells whose they are
    assert said({**FIX, "sensor": "gnss_other_stern"}, unclear).sensor == "gnss_other_stern"
    assert said({**rtk, "sensor": "gnss_stern"}, unclear).sensor == "gnss_stern"
    assert "'sensor' is missing" in said(rtk, unclear).row.reason


def test_stream_and_bag_give_the_same(tmp_path: Path) -> None:
    """All kinds in one bag and as lines; the IMU's time offset applies to both."""
    make, half = Messages(2), 0.5**0.5
    full = [[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 4.0]]
    six = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]) + 0.1
    items: list[tuple[str, int, Any]] = []
    lines: list[dict[str, Any]] = []
    for i in range(20):
        t = START_NS + i * 100_000_000 + 123
        accel, gyro, v = [0.1 * i, 0.3, 9.7], [0.01, 0.02 * i, 0.3], [0.3 * i, 1.0, 0.1]
        lat, lon, xyz = 57.71 + 1e-5 * i, 11.91, [0.5 * i, 2.0, 3.0]
        messages = {
            "/imu": make.imu(t, accel, gyro),
            "/fix": make.fix(t, lat, lon, 33.3, covariance=np.ravel(full), covariance_type=3),
            "/heading": make.compass(t, (0, 0, half, half)),
            "/vel": make.twist(t, v),
            "/match": make.pose(t, xyz, (0, 0, half, half), six),
        }
        items += [(topic, t, msg) for topic, msg in messages.items()]
        lines += [
            {"type": "imu", "stamp_ns": t, "accel_mps2": accel, "gyro_radps": gyro},
            {"type": "gnss", "stamp_ns": t, "lat_deg": lat, "lon_deg": lon, "height_m": 33.3, "cov_enu_m2": full},
            {"type": "heading", "stamp_ns": t, "heading_deg": 0.0},  # north: a quarter turn from east
            {"type": "velocity", "stamp_ns": t, "v_enu_mps": v},
            {"type": "pose", "stamp_ns": t, "modes": [{"xyz_m": xyz, "quaternion_xyzw": [0, 0, half, half], "cov_m_rad": six.tolist()}]},
        ]  # fmt: skip
    bag = read_recording(write_bag(tmp_path / "bag", make, items), CONFIG_OF_BAG)
    streamed = [parse(json.dumps(line).encode(), i + 1, i, CONFIG_OF_BAG) for i, line in enumerate(lines)]
    samples = [m for m in streamed if isinstance(m, ImuSample)]
    assert bag.imu is not None
    assert len(samples) == 20
    np.testing.assert_array_equal([m.stamp_ns for m in samples], bag.imu.stamps_ns)
    np.testing.assert_array_equal([m.accel_mps2 for m in samples], bag.imu.accel_mps2)
    np.testing.assert_array_equal([m.gyro_radps for m in samples], bag.imu.gyro_radps)
    others = [m for m in streamed if isinstance(m, Measurement) and not isinstance(m, ImuSample)]
    assert len(others) == len(bag.measurements) == 80
    for mine, his in zip(others, bag.measurements, strict=True):
        assert (mine.sensor, mine.stamp_ns, mine.seq, type(mine)) == (his.sensor, his.stamp_ns, his.seq, type(his))
        for one, other in zip(numbers(mine), numbers(his), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-15)


def numbers(m: Measurement) -> list[Any]:
    match m:
        case GnssPosition():
            return [m.position, m.cov_enu_m2]
        case CompassHeading():
            return [m.yaw_rad, m.sigma_rad]
        case GnssVelocity():
            return [m.v_enu_mps, m.cov_m2ps2]
        case PoseFix():
            return [*(mode.value for mode in m.modes), *(mode.cov for mode in m.modes)]
        case _:
            raise TypeError(m)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(), lambda x: st.lists(x, max_size=4) | st.dictionaries(st.text(), x, max_size=4)
)  # fmt: skip


@given(st.binary(max_size=200))
def test_no_bytes_raise(line: bytes) -> None:
    assert isinstance(parse(line, 1, 0, CONFIG), Trouble)


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@settings(max_examples=400)
@given(st.data())
def test_no_json_raises(data: st.DataObject) -> None:
    line = json.loads(json.dumps(data.draw(st.sampled_from(VALID))))
    holder = line["modes"][0] if line["type"] == "pose" and data.draw(st.booleans()) else line
    key = data.draw(st.sampled_from(sorted(holder)))
    if isinstance(holder[key], list) and data.draw(st.booleans()):
        holder[key][0] = data.draw(JSON)
    else:
        holder[key] = data.draw(JSON)
    assert isinstance(parse(json.dumps(line).encode(errors="replace"), 1, 0, CONFIG), Measurement | Request | Trouble)


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@given(st.floats(allow_nan=False, allow_infinity=False), st.sampled_from(["xyz_m", "rpy_deg"]))
def test_no_size_of_number_raises(x: float, key: str) -> None:
    for line in ({**IMU, "accel_mps2": [x, x, x]}, {**FIX, "height_m": x}, {**FIX, "cov_enu_m2": [[x, 0, 0], [0, x, x], [0, x, x]]},
                 {**POSE, "modes": [{**POSE["modes"][0], key: [x, x, x]}]}, {**VELOCITY, "v_enu_mps": [x, x, x]}):  # fmt: skip
        assert isinstance(said(line), Measurement | Trouble)


def estimate(stamp_ns: int = 1_700_000_000_000_000_007) -> Estimate:
    """Turned to the left by 90 deg in map; in odom 10 m west of there and not turned."""
    left = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return Estimate(
        stamp_ns=stamp_ns, p_world_m=np.array([10.0, 0.0, 2.0]), R_world_body=left, v_world_mps=np.array([0.0, 1.5, 0.0]),
        cov=np.diag([4.0, 1.0, 1.0, 0.01, 0.01, 0.0004]), v_cov=np.eye(3), p_odom_m=np.array([1.0, 0.0, 0.0]), R_odom_body=np.eye(3),
        step_cov=np.eye(6), gyro_radps=np.array([0.0, 0.0, 0.1]), gyro_cov=np.diag([1e-5, 2e-5, 3e-5]), accel_bias_mps2=np.zeros(3), gyro_bias_radps=np.zeros(3),
        health=Health.DEGRADED, reason=HealthReason("no match yet", Cause.SENSORS), since_agreed_s={"gnss": 0.5, "match": float("inf")},
    )  # fmt: skip


class Fake:
    """Waits for the first fix; then a new state at each further one. Its rows become final with the next measurement."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.fed: list[Measurement] = []
        self.fixes = 0
        self._said: list[str] = []
        self._rows: list[LedgerRow] = []

    @property
    def waiting_for(self) -> str:
        return "" if self.fixes else ("a fix" if self.fed else "measurements")

    @property
    def datum(self) -> Datum | None:
        return DATUM if self.fixes else None

    def feed(self, m: Measurement) -> Estimate | None:
        self.fed.append(m)
        if not isinstance(m, GnssPosition):
            return None
        self.fixes += 1
        self._said += ["started"] if self.fixes == 1 else []
        return estimate(m.stamp_ns) if self.fixes > 1 else None

    def predict(self, stamp_ns: int | None = None) -> Estimate | None:
        newest = [m.stamp_ns for m in self.fed if isinstance(m, ImuSample)]
        return estimate(stamp_ns or newest[-1]) if self.fixes else None

    def _row(self, m: Measurement) -> LedgerRow:
        return LedgerRow(
            seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic="", outcome=Outcome.USED, nis=float("inf")
        )

    def rows(self) -> list[LedgerRow]:
        found, self._rows = self._rows, [self._row(m) for m in self.fed[-1:]]
        return found

    def finish(self) -> list[LedgerRow]:
        self.fixes = 0  # the real one waits for a start again
        return self._rows

    def events(self) -> list[Event]:
        found, self._said = self._said, []
        return [Event(text, warns=False) for text in found]


def answers(*lines: dict[str, Any] | bytes, **options: Any) -> tuple[list[dict[str, Any]], Fake]:
    out, smoother = io.StringIO(), Fake()
    run([x if isinstance(x, bytes) else json.dumps(x).encode() for x in lines], out, smoother, CONFIG, **options)
    return [json.loads(line, parse_constant=pytest.fail) for line in out.getvalue().splitlines()], smoother


def kinds(found: list[dict[str, Any]]) -> list[str]:
    return [line["type"] for line in found]


def test_an_estimate_as_json() -> None:
    found = as_json(estimate(), DATUM)
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert (found["stamp"], found["stamp_ns"]) == ("1700000000.000000007", 1_700_000_000_000_000_007)
    # 10 m east at 57.7 deg: the prime vertical's radius is a / sqrt(1 - e^2 sin^2) = 6393446 m.
    assert found["lon_deg"] == pytest.approx(11.9 + np.degrees(10 / (6393446 * np.cos(np.radians(57.7)))), abs=1e-9)
    assert found["lat_deg"] == pytest.approx(57.7, abs=1e-7)
    assert found["height_m"] == pytest.approx(2.0, abs=1e-4)
    # The bow looks to the datum's north; that there lies counter-clockwise of it.
    assert found["heading_deg"] == pytest.approx(np.degrees(10 / 6393446 * np.tan(np.radians(57.7))), rel=0.005)
    assert (found["health"], found["reason"]) == ("degraded", "no match yet")
    assert found["since_agreed_s"] == {"gnss": 0.5, "match": None}
    here, odom, between = found["map"], found["odom"], found["map_from_odom"]
    half = 0.5**0.5
    assert isinstance(here, dict)
    assert isinstance(odom, dict)
    assert isinstance(between, dict)
    assert (here["xyz_m"], here["velocity_mps"]) == ([10.0, 0.0, 2.0], [0.0, 1.5, 0.0])
    np.testing.assert_allclose(here["quaternion_xyzw"], [0, 0, half, half])
    assert odom == {"xyz_m": [1.0, 0.0, 0.0], "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
    np.testing.assert_allclose(between["xyz_m"], [10.0, -1.0, 2.0])  # odom's x is north: 1 m along it is at 0 north
    np.testing.assert_allclose(between["quaternion_xyzw"], [0, 0, half, half])
    assert found["bound_95_m"] == pytest.approx(2.0 * np.sqrt(5.991464547))  # sigma 2 m on the long axis
    assert found["heading_bound_95_deg"] == pytest.approx(1.959963985 * np.degrees(0.02))
    assert found["cov_m_rad"] == np.diag([4.0, 1.0, 1.0, 0.01, 0.01, 0.0004]).tolist()


def test_roll_and_pitch() -> None:
    a = np.radians(10.0)  # pitch: Ry(a), bow down
    found = as_json(
        replace(estimate(), R_world_body=np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])),
        DATUM,
    )
    assert (found["roll_deg"], found["pitch_deg"], found["heading_deg"]) == pytest.approx((0.0, 10.0, 90.00014))


def test_a_session() -> None:
    found, smoother = answers(IMU, b"", b"nonsense", IMU, FIX, {**FIX, "stamp": "6"}, {**FIX, "sensor": "second"})
    assert kinds(found) == ["waiting", "waiting", "error", "event", "estimate", "end"]
    assert [line["for"] for line in found[:2]] == ["measurements", "a fix"]
    assert found[2]["line"] == 3
    assert "not JSON" in found[2]["reason"]
    assert found[3] == {"type": "event", "text": "started", "warns": False}
    assert found[4]["stamp_ns"] == 6_000_000_000
    assert "line" not in found[4]
    counts = {"imu": {"used": 2}, "gnss": {"used": 2}, "(stream)": {"malformed": 1}, "second": {"ignored": 1}}
    assert found[5] == {"type": "end", "lines": 7, "counts": counts}
    assert [m.seq for m in smoother.fed] == [0, 2, 3, 4]  # the bad line was an arrival, too; the blank one was not


def test_ledger_rows_add_up() -> None:
    found, _ = answers(IMU, b"nonsense", FIX, {"type": "predict"}, FIX, ledger=True)
    rows = [row for line in found if line["type"] == "ledger" for row in line["rows"]]
    assert sorted((row["seq"], row["outcome"]) for row in rows) == [
        (0, "used"),
        (1, "malformed"),
        (2, "used"),
        (3, "used"),
    ]
    assert {row["nis"] for row in rows if row["outcome"] == "used"} == {None}
    assert "ledger" not in kinds(answers(IMU, FIX)[0])


def test_each_predict_has_one_answer_that_names_its_line() -> None:
    ask = {"type": "predict", "stamp": "7.5"}
    found, _ = answers(ask, IMU, FIX, ask, {"type": "predict"})
    assert kinds(found) == ["waiting", "waiting", "waiting", "event", "estimate", "estimate", "end"]
    assert found[1] == {"type": "waiting", "for": "measurements", "line": 1}
    assert [(e["line"], e["stamp_ns"]) for e in found[4:6]] == [(4, 7_500_000_000), (5, 5_250_000_000)]


def test_a_rate_takes_estimates_at_imu_samples() -> None:
    lines: list[dict[str, Any]] = (
        [FIX] + [{**IMU, "stamp": f"{10 + 0.1 * k:.1f}"} for k in range(20)] + [{**FIX, "stamp": "12"}] * 3
    )
    found, _ = answers(
        *lines, rate_hz=2.0
    )  # samples from 10.25 to 12.15 s: new half seconds begin at 10, 10.5, 11, 11.5, 12
    assert [e["stamp"] for e in found if e["type"] == "estimate"] == [
        f"{s}000000" for s in ("10.250", "10.550", "11.050", "11.550", "12.050")
    ]


def test_lines_are_cut_and_bounded() -> None:
    stream = io.BytesIO(b"one\n" + b"x" * (3 * MAX_LINE) + b"\ntwo\n" + b"y" * MAX_LINE + b"\nlast")
    assert [len(line) for line in Lines(stream)] == [4, MAX_LINE + 1, 4, MAX_LINE + 1, 4]


def test_stop_between_lines() -> None:
    lines = Lines(io.BytesIO(b"one\ntwo\n"))
    found = []
    for line in lines:
        found.append(line)
        lines.stop()  # a signal while a line is worked on
        lines.stop()
    assert found == [b"one\n"]


SERVE = """
import os, sys
from pathlib import Path
import graphloc.stream as stream
from tests.test_stream import Fake
class Loud(Fake):
    def feed(self, m):
        os.write(1, b"a library prints\\n")
        return super().feed(m)
stream.OnlineSmoother = Loud
stream.serve(Path(sys.argv[1]))
"""


def serving(tmp_path: Path) -> subprocess.Popen[bytes]:
    config = tmp_path / "vessel.yaml"
    config.write_text(json.dumps(RAW))
    command = [sys.executable, "-c", SERVE, str(config)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe)


def test_a_signal_ends_with_the_end_line(tmp_path: Path) -> None:
    for number in (signal.SIGTERM, signal.SIGINT):
        with serving(tmp_path) as child:
            assert child.stdin is not None
            assert child.stdout is not None
            child.stdin.write(json.dumps(IMU).encode() + b"\n")
            child.stdin.flush()
            told = [json.loads(child.stdout.readline()) for _ in range(2)]
            assert kinds(told) == ["waiting", "waiting"]  # answered at once: the input is still open
            time.sleep(0.5)  # by now it waits for a line
            child.send_signal(number)
            child.wait(timeout=30)  # its input is still open
            rest, error = child.communicate()
            assert json.loads(rest) == {"type": "end", "lines": 1, "counts": {"imu": {"used": 1}}}
            assert error == b"a library prints\n"
            assert child.returncode == 0


def test_a_reader_that_goes_away_ends_it_quietly(tmp_path: Path) -> None:
    with serving(tmp_path) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        assert child.stderr is not None
        child.stdout.readline()
        child.stdout.close()
        child.stdin.write(b"nonsense\n")
        child.stdin.flush()
        assert child.wait(timeout=60) == 0
        assert child.stderr.read() == b""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            {"sensors": {"imu": {"mount": {"tf_frame": "imu_link"}}}},
            r"sensors\.imu\.mount\.tf_frame: no /tf_static .*vessel\.effective\.yaml",
        ),
        ({"sensors": {"match": {"kind": "pose"}}}, "set datum:"),
    ],
)
def test_what_only_a_bag_has_is_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = tmp_path / "vessel.yaml"
    path.write_text(json.dumps(change))
    with pytest.raises(GraphlocError, match=words):
        serve(path)


def test_the_documented_session_is_one() -> None:
    """Each line of the page's session that goes in is valid; those that come out have the keys of real ones."""
    text = (ROOT / "docs/online-stream.md").read_text()
    sent = [line[2:] for line in text.splitlines() if line.startswith("> {")]
    bad = [line for line in sent if isinstance(said(json.loads(line)), Trouble)]
    assert len(sent) >= 6
    assert len(bad) == 1  # the one that shows an error
    (shown,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    assert list(json.loads(shown)) == list(as_json(estimate(), DATUM))
    for kind in (
        "imu",
        "gnss",
        "heading",
        "velocity",
        "pose",
        "predict",
        "estimate",
        "waiting",
        "event",
        "ledger",
        "error",
        "end",
    ):
        assert f"| `{kind}` |" in text


def test_the_example_client_prints_poses(tmp_path: Path) -> None:
    (tmp_path / "vessel.yaml").write_text(json.dumps(RAW))
    (tmp_path / "lines.jsonl").write_text("\n".join(json.dumps(x) for x in (IMU, FIX, FIX)) + "\n")
    tool = tmp_path / "bin/graphloc"  # the command's place, with the fake behind it
    tool.parent.mkdir()
    tool.write_text(f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\ndel sys.argv[1:3]\n{SERVE}")
    tool.chmod(0o755)
    env = {**os.environ, "PATH": f"{tool.parent}:{os.environ['PATH']}"}
    command = [sys.executable, str(ROOT / "examples/stream_client.py"), "vessel.yaml", "lines.jsonl"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60, check=True)
    assert "5.000000000  57.7000000  11.9001" in done.stdout
    assert "graphloc" not in re.findall(
        r"^(?:from|import) (\w+)", (ROOT / "examples/stream_client.py").read_text(), re.MULTILINE
    )
    assert len((ROOT / "examples/stream_client.py").read_text().splitlines()) < 40
