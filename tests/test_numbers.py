# SPDX-License-Identifier: Apache-2.0
"""Headings that come as bare numbers without a stamp, as autopilots publish them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphloc.config import load_config
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import KINDS
from graphloc.frontends.bag import read_recording
from graphloc.frontends.inspect import draft_config
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition
from tests.bagfactory import Item, Messages, write_bag
from tests.heldbags import hold_bag, inspect_bag
from tests.test_bag_bad_input import accounted

DOUBLE, SINGLE = "std_msgs/msg/Float64", "std_msgs/msg/Float32"
LATE_NS = 20_000_000  # of the recorder
HEADING, YAW = "/mavros/global_position/compass_hdg", "/boat/yaw"


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate(
        Scenario(path="loops", duration_s=60.0, noise="clean", pose_hz=0.0, imu_hz=50.0, gnss_hz=5.0, compass_hz=5.0), 4
    )


@pytest.fixture(scope="module", params=[1, 2])
def bag(run: SimulatedRun, request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    make, imu = Messages(request.param), run.recording.imu
    assert imu is not None

    def number(msgtype: str, value: float) -> Any:
        return make.t[msgtype](data=value)

    items: list[Item] = [
        ("/imu", int(n) + LATE_NS, make.imu(int(n), a, w)) for n, a, w in zip(imu.stamps_ns, imu.accel_mps2, imu.gyro_radps, strict=True)
    ]  # fmt: skip
    for m in run.recording.measurements:
        at = m.stamp_ns + LATE_NS
        if isinstance(m, GnssPosition):
            items.append(("/fix", at, make.fix(m.stamp_ns, *m.position)))
            items.append(("/battery/ahead", at, number(DOUBLE, 24.0)))  # 'head' in its name, and no heading
            items.append(("/battery/volt", at, number(DOUBLE, 24.0)))
        elif isinstance(m, CompassHeading):
            items.append((HEADING, at, number(DOUBLE, (90.0 - np.degrees(m.yaw_rad)) % 360.0)))
            items.append((YAW, at, number(SINGLE, m.yaw_rad)))
    items.append((HEADING, items[-1][1] + 1, number(DOUBLE, np.nan)))
    return write_bag(tmp_path_factory.mktemp("numbers") / "run", make, sorted(items, key=lambda i: i[1]))


def both(bag: Path) -> str:
    """The draft, with that heading switched on which only repeats the other."""
    draft = draft_config(inspect_bag(bag))
    echo = f"enabled: false  # guess: it repeats {YAW}, and must not count twice"
    assert echo in draft
    return draft.replace(echo, "enabled: true  #")


def test_they_are_drafted_and_read_as_what_they_are(run: SimulatedRun, bag: Path, tmp_path: Path) -> None:
    drafted = tmp_path / "vessel.yaml"
    drafted.write_text(both(bag))
    config = load_config(drafted, KINDS)
    found = {s.topic: s for s in config.sensors.values() if s.kind == "compass"}
    assert set(found) == {HEADING, YAW}
    assert [(found[t].convention, found[t].unit) for t in (HEADING, YAW)] == [("ned", "deg"), ("enu", "rad")]
    recording = read_recording(bag, config)
    assert recording.message_count == accounted(recording)
    theirs = run.recording.of(CompassHeading)
    for name, sensor in config.of_kind("compass").items():
        ours = [m for m in recording.measurements if m.sensor == name and isinstance(m, CompassHeading)]
        assert [m.stamp_ns for m in ours] == [m.stamp_ns + LATE_NS for m in theirs]
        apart = np.array([a.yaw_rad - b.yaw_rad for a, b in zip(ours, theirs, strict=True)])
        assert np.abs(np.exp(1j * apart) - 1.0).max() < 1e-6
        assert {m.sigma_rad for m in ours} == {np.radians(sensor.sigma_deg)}
        assert any(w.startswith(f"{name}: std_msgs/Float") and "has no stamp" in w for w in recording.warnings)
    (row,) = (r for r in recording.rows if r.outcome is Outcome.MALFORMED)
    assert row.topic == HEADING
    assert "NaN" in row.reason


def test_a_number_that_no_course_confirms_is_left_out(bag: Path) -> None:
    draft = draft_config(inspect_bag(bag))
    assert "# orientation of /battery/ahead: left out as a compass" in draft
    assert "/battery/volt" not in draft


def test_the_wrong_unit_is_named(bag: Path, tmp_path: Path) -> None:
    drafted = tmp_path / "vessel.yaml"
    drafted.write_text(both(bag).replace("unit: deg", "unit: rad"))
    recording = read_recording(bag, load_config(drafted, KINDS))
    reasons = {r.reason for r in recording.rows if r.topic == HEADING}
    assert any("is beyond 20 turns: is it in another unit?" in reason for reason in reasons)


def drafted(tmp_path: Path, run: SimulatedRun, late_ns: int, unknown: float) -> str:
    """Of a bag with a heading in radians whose first ten are `unknown`, recorded so much after the fixes' stamps."""
    make, imu = Messages(2), run.recording.imu
    assert imu is not None
    items: list[Item] = [
        ("/imu", int(n), make.imu(int(n), a, w)) for n, a, w in zip(imu.stamps_ns, imu.accel_mps2, imu.gyro_radps, strict=True)
    ]  # fmt: skip
    headings = run.recording.of(CompassHeading)
    items += [("/fix", m.stamp_ns, make.fix(m.stamp_ns, *m.position)) for m in run.recording.of(GnssPosition)]  # fmt: skip
    items += [
        (YAW, m.stamp_ns + late_ns, make.t[DOUBLE](data=unknown if k < 10 else m.yaw_rad))
        for k, m in enumerate(headings)
    ]
    return draft_config(inspect_bag(hold_bag(tmp_path / "run", make, sorted(items, key=lambda i: i[1]))))


def test_what_says_that_it_does_not_know_is_no_unit(run: SimulatedRun, tmp_path: Path) -> None:
    assert "unit: rad" in drafted(tmp_path, run, 0, -999.0)


def test_a_recorder_of_another_time_is_named(run: SimulatedRun, tmp_path: Path) -> None:
    """A bag that was played and recorded again: stamps are of then, and what has none is of now."""
    draft = drafted(tmp_path, run, 10**16, 0.0)
    assert "left out as a compass; no GNSS course in motion at the times it was recorded (it has no stamp)" in draft
