# SPDX-License-Identifier: Apache-2.0
"""Headers without stamps, and clocks that count from their start: recording times take their place, or set them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graphloc.app import configured
from graphloc.config import ImuConfig, VesselConfig
from graphloc.frontends._clock import ClockStep, gain, leaps
from graphloc.frontends.inspect import draft_config
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition
from graphloc.time import duration_ns, seconds_text, utc_text
from tests.bagfactory import START_NS, Item, Messages, S
from tests.heldbags import hold_bag, inspect_bag, read_recording
from tests.test_bag_bad_input import accounted, vessel
from tests.test_inspect import drive, look

MAKE = Messages(2)
WAY_NS = {"/fix": 120_000_000, "/compass": 30_000_000, "/imu": 5_000_000}
STARTED_NS = START_NS - 900 * S  # of a clock that counts from then


def restamped(topics: dict[str, Any]) -> list[Item]:
    """The drive, each message recorded after its way; `topics`: what becomes of their stamps, ns."""
    items = []
    for topic, at_ns, msg in drive(MAKE, seconds=60):
        if topic in WAY_NS:
            stamp_ns = topics.get(topic, lambda ns: ns)(at_ns)
            msg.header = MAKE.header(stamp_ns, msg.header.frame_id)
            items.append((topic, at_ns + WAY_NS[topic], msg))
    return sorted(items, key=lambda item: item[1])


def read(tmp_path: Path, config: VesselConfig) -> Any:
    recording = read_recording(tmp_path / "run", config)
    assert recording.message_count == accounted(recording)
    return recording


@pytest.mark.parametrize(
    "stamped", [lambda _ns: 0, lambda _ns: START_NS, lambda ns: ns - ns % S], ids=["zero", "one stamp", "whole seconds"]
)
def test_headers_without_stamps_are_read_by_the_recording_times(tmp_path: Path, stamped: Callable[[int], int]) -> None:
    never = {"/fix": stamped, "/compass": stamped}
    found, config, text = look(tmp_path, restamped(never), MAKE)
    assert {t.topic: t.recorded for t in found.topics} == {"/imu": False, "/fix": True, "/compass": True}
    assert {n: config.sensors[n].stamps for n in ("imu", "gnss", "compass")} == {
        "imu": "header",
        "gnss": "recorded",
        "compass": "recorded",
    }
    assert (
        "stamps: recorded  # guess: its headers hold no stamps, or whole seconds only; recording times are late by"
        in text
    )
    late_s, _ = found.gnss[0].late_s or (0.0, 0.0)
    assert late_s == pytest.approx(-0.12, abs=0.02)  # the accelerometer tells how long a fix is on its way
    assert config.sensors["gnss"].time_offset_s == pytest.approx(late_s, abs=1e-3)
    assert config.sensors["gnss"].stamp_sigma_s == 0.05
    gnss = config.sensors["gnss"].model_copy(update={"time_offset_s": 0.0, "stamp_sigma_s": 0.0})
    recording = read(tmp_path, config.model_copy(update={"sensors": {**config.sensors, "gnss": gnss}}))
    for kind, way_ns in ((GnssPosition, WAY_NS["/fix"]), (CompassHeading, WAY_NS["/compass"])):
        stamps = [m.stamp_ns for m in recording.of(kind)]
        assert len(stamps) == 300  # every one of 5 Hz for 60 s
        assert stamps[:2] == [START_NS + way_ns, START_NS + way_ns + S // 5]
    assert recording.imu.stamps_ns[0] == START_NS
    assert any(w.startswith("gnss: stamps: recorded: recording times are used") for w in recording.warnings)
    said = read(tmp_path, config).warnings  # as drafted, with the receiver's offset
    assert not any(w.startswith("gnss: stamps: recorded") for w in said)


def test_fixes_of_whole_seconds_that_are_published_again_keep_their_stamps(tmp_path: Path) -> None:
    """A receiver of 1 Hz stamps its fixes when it measures them; its driver publishes each five times."""
    items, fix = [], None
    for topic, at_ns, msg in restamped({}):
        if topic == "/fix" and msg.header.stamp.nanosec == 0:
            fix = msg
        items.append((topic, at_ns, fix if topic == "/fix" else msg))
    found, config, _ = look(tmp_path, items, MAKE)
    assert not any(t.recorded for t in found.topics)
    fixes = [m for m in read(tmp_path, config).measurements if isinstance(m, GnssPosition)]
    late_ns = duration_ns(config.sensors["gnss"].time_offset_s)
    assert [m.stamp_ns - late_ns for m in fixes] == [START_NS + k * S for k in range(60)]


def test_a_truth_without_stamps_is_compared_by_the_recording_times(tmp_path: Path) -> None:
    items = restamped({})
    for k in range(200):
        at_ns = START_NS + k * S // 10
        items.append(("/truth", at_ns, MAKE.odometry(0, (0.1 * k, 0.0, 0.0))))
    path = hold_bag(tmp_path / "run", MAKE, items)
    recording = read_recording(path, vessel().model_copy(update={"truth_topic": "/truth"}))
    assert recording.truth is not None
    assert recording.truth.stamps_ns.tolist() == [START_NS + k * S // 10 for k in range(200)]
    assert "/truth: 200 of its headers hold no stamp: recording times are used" in recording.warnings


def test_without_the_key_a_message_without_a_stamp_names_it(tmp_path: Path) -> None:
    _, config, _ = look(tmp_path, restamped({"/fix": lambda _ns: 0}), MAKE)
    plain = config.sensors["gnss"].model_copy(update={"stamps": "header"})
    recording = read(tmp_path, config.model_copy(update={"sensors": {**config.sensors, "gnss": plain}}))
    rows = [r for r in recording.rows if r.sensor == "gnss"]
    assert len(rows) == 300
    assert {r.outcome for r in rows} == {Outcome.MALFORMED}
    assert all("header stamp is zero" in r.reason and "`stamps: recorded`" in r.reason for r in rows)


def test_a_clock_that_counts_from_its_start_is_set_by_one_that_tells_the_date(tmp_path: Path) -> None:
    """IMU and compass of one computer that counts from when it was switched on; the receiver knows the time."""
    counts = {topic: lambda ns: ns - STARTED_NS for topic in ("/imu", "/compass")}
    _, config, text = look(tmp_path, restamped(counts), MAKE)
    recording = read(tmp_path, config)
    # The receiver's message takes 115 ms longer than the IMU's; recording times cannot tell that.
    apart_ns = WAY_NS["/fix"] - WAY_NS["/imu"]
    assert recording.imu.stamps_ns[0] == pytest.approx(START_NS - apart_ns, abs=S // 1000)
    headings = [m.stamp_ns for m in recording.of(CompassHeading)]
    assert headings[0] == recording.imu.stamps_ns[0]  # of one clock, though it takes 25 ms longer
    assert config.sensors["gnss"].time_offset_s == pytest.approx(0.0, abs=0.2)  # by the accelerometer, of its latency
    assert "its clock is behind one that tells the date, by the recording times" in text
    assert not any("its clock is" in w for w in recording.warnings)


def test_clocks_that_all_count_from_their_start_keep_the_time_of_the_imu(tmp_path: Path) -> None:
    """A simulator's clock: nothing tells the date, and nothing is set."""
    _, config, _ = look(tmp_path, restamped(dict.fromkeys(WAY_NS, lambda ns: ns - STARTED_NS)), MAKE)
    assert all(abs(config.sensors[n].time_offset_s) < 0.2 for n in ("imu", "gnss", "compass"))
    assert read(tmp_path, config).imu.stamps_ns[0] == START_NS - STARTED_NS


@pytest.mark.parametrize(("share", "said"), [(0.01, "gains 0.54 s"), (-0.01, "loses 0.54 s"), (0.001, "")])
@pytest.mark.parametrize("topic", ["/fix", "/imu"])
def test_a_clock_that_drifts_is_drafted_and_set_right(topic: str, share: float, said: str, tmp_path: Path) -> None:
    """By a hundredth over 60 s; nine tenths of that lie between the first tenth and the last."""
    _, config, _ = look(tmp_path, restamped({topic: lambda ns: ns + round(share * (ns - START_NS))}), MAKE)
    name = topic.strip("/").replace("fix", "gnss")
    drifts = {n: s.clock_drift_ppm for n, s in config.sensors.items() if s.clock_drift_ppm}
    assert drifts == ({name: pytest.approx(1e6 * share, rel=0.02)} if said else {})
    recording = read(tmp_path, config)
    assert not any("during the run" in w for w in recording.warnings)
    fixes = [m.stamp_ns for m in recording.of(GnssPosition)]
    last_ns = (
        fixes[-1] - duration_ns(config.sensors["gnss"].time_offset_s)
        if topic == "/fix"
        else recording.imu.stamps_ns[-1]
    )
    true_ns = START_NS + (299 * S // 5 if topic == "/fix" else 1499 * S // 25)
    assert abs(last_ns - true_ns) < (5_000_000 if said else 70_000_000)
    plain = {n: sensor.model_copy(update={"clock_drift_ppm": 0.0}) for n, sensor in config.sensors.items()}
    warnings = read(tmp_path, config.model_copy(update={"sensors": plain})).warnings
    lines = [w for w in warnings if "during the run, by the recording times" in w]
    assert bool(lines) == bool(said)
    told = said if topic == "/fix" else ""  # else that the others' clocks do
    assert all(told in line and "set its clock_drift_ppm to" in line for line in lines)


@pytest.mark.parametrize("silent_s", [0, 500, 2000])
def test_a_silence_does_not_change_what_a_clock_gains(silent_s: int) -> None:
    """A silence of 500 of 3000 s made it 109 ppm; one of 2000 s hid it."""
    logs_ns = START_NS + np.arange(0, 3000 * S, S // 5)
    logs_ns = logs_ns[np.abs(logs_ns - START_NS - 1650 * S) >= silent_s // 2 * S]
    stamps_ns = logs_ns + (logs_ns - START_NS) // 10_000
    assert gain(stamps_ns, logs_ns).drift_ppm == pytest.approx(100.0, rel=0.01)


def test_a_clock_that_stands_does_not_drift() -> None:
    """A million ppm were drafted, which no configuration takes."""
    logs_ns = START_NS + np.arange(0, 60 * S, S // 10)
    found = gain(START_NS + np.arange(len(logs_ns)) % 3, logs_ns)
    assert found.drift_ppm == 0.0
    assert found.gained_s < -50.0


def test_a_clock_that_is_set_during_the_run_does_not_drift(tmp_path: Path) -> None:
    """A step is no drift: nothing is drafted, and the warning stays."""
    _, config, _ = look(tmp_path, restamped({"/fix": lambda ns: ns + S // 2 * (ns > START_NS + 30 * S)}), MAKE)
    assert config.sensors["gnss"].clock_drift_ppm == 0.0
    (line,) = [w for w in read(tmp_path, config).warnings if "during the run, by the recording times" in w]
    assert "synchronise the clocks" in line


@pytest.mark.parametrize(
    ("topic", "by_s", "way"), [("/fix", 3.3, "forward"), ("/fix", -3.3, "back"), ("/imu", 3, "forward")]
)
def test_a_clock_that_was_set_is_named_with_the_time(topic: str, by_s: float, way: str, tmp_path: Path) -> None:
    """By inspect, which drafted an offset as if it held throughout, and when the bag is read."""
    change = {topic: lambda ns: ns + round(by_s * S) * (ns > START_NS + 25 * S)}
    seen, config, _ = look(tmp_path, restamped(change), MAKE)
    (said,) = [w for w in seen.warnings if "was set" in w]
    assert said.startswith(f"the clock of {topic} was set {way} by {abs(by_s):.2f} s")
    assert utc_text(START_NS + 25 * S)[:18] in said  # to the second
    lines = [w for w in read(tmp_path, config).warnings if "the clock of" in w or "its clock is" in w]
    (line,) = lines  # nor an offset beside it, which holds on one side only
    whose, others = ("gnss", "gnss") if topic == "/fix" else ("imu", "gnss, compass")
    assert line.startswith(f"{others}: the clock of {whose} was set {way} by {abs(by_s):.2f} s")


@pytest.fixture(scope="module")
def as_it_was(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, VesselConfig, Any]:
    folder = tmp_path_factory.mktemp("right")
    found, config, _ = look(folder, restamped({}), MAKE)
    return found, config, read(folder, config)


@pytest.mark.parametrize(("by_s", "set_s"), [(18, 5), (-18, 25), (1, 50), (-3600, 25)])
def test_a_clock_that_is_set_by_whole_seconds_is_put_right(
    by_s: int, set_s: int, as_it_was: tuple[Any, VesselConfig, Any], tmp_path: Path
) -> None:
    """UTC and GPS time, a leap second, a time zone. It was told, and the vessel put where it was 18 s before; after an hour, all was lost."""
    wrong = lambda ns: ns + by_s * S * (ns >= START_NS + set_s * S)
    read_as = {}
    seen, drafted, _ = look(tmp_path, restamped({"/fix": wrong}), MAKE)
    both = {"set": (seen, drafted, read(tmp_path, drafted)), "right": as_it_was}
    for name, (found, config, recording) in both.items():
        read_as[name] = config, [(m.stamp_ns, m.seq) for m in recording.measurements]
        for said in (w for w in (*found.warnings, *recording.warnings) if "the clock of" in w):
            assert f"by {abs(by_s)}.00 s at {utc_text(START_NS + set_s * S + WAY_NS['/fix'])}" in said
            assert f": {300 - 5 * set_s} of its stamps are corrected" in said
        assert sum("corrected" in w for w in found.warnings) == (name == "set")
        assert sum("corrected" in w for w in recording.warnings) == (name == "set")
        assert not recording.clock_doubts
    assert read_as["set"] == read_as["right"]


def test_messages_that_are_late_by_a_whole_second_are_of_no_clock_that_was_set() -> None:
    """Nor are those of a recorder that was set, nor is one wrong stamp."""
    stamps_ns = START_NS + np.arange(0, 60 * S, S // 5)
    later_ns = S * (np.arange(300) >= 100)
    assert [at.by_s for _, at in leaps(stamps_ns + later_ns, stamps_ns)] == [1.0]
    for by_s in (1, 18, -18):
        assert leaps(stamps_ns, stamps_ns + by_s * later_ns) == []
    assert leaps(stamps_ns + 18 * S * (np.arange(300) == 100), stamps_ns) == []


@pytest.mark.parametrize("period_s", [0.5, 1.0, 2.0])
def test_messages_of_a_slow_sensor_in_bursts_are_of_no_clock_that_was_set(period_s: float) -> None:
    """Within a burst they come at once, and their stamps, seconds apart, seem to leap."""
    stamps_ns = START_NS + np.round(np.arange(0, 300) * period_s * S).astype(np.int64)
    for each in (2, 3, 4, 5, 7, 10, 15, 22, 31, 39):
        burst_ns = round(each * period_s * S)
        assert leaps(stamps_ns, (stamps_ns // burst_ns + 1) * burst_ns) == []


def test_of_two_receivers_on_one_topic_none_is_set_where_one_falls_silent() -> None:
    """The stamps of the right one were moved by what the other, of GPS time, is ahead."""
    own_ns = START_NS + np.arange(0, 300 * S, S)
    others_ns = own_ns[:150] + S // 2
    logs_ns = np.concatenate([own_ns, others_ns])
    order = np.argsort(logs_ns)
    stamps_ns = np.concatenate([own_ns, others_ns + 18 * S])
    assert leaps(stamps_ns[order], logs_ns[order]) == []


def test_clocks_that_are_set_together_are_one(tmp_path: Path) -> None:
    ahead = lambda ns: ns + 3 * S * (ns > START_NS + 25 * S)
    seen, config, _ = look(tmp_path, restamped(dict.fromkeys(WAY_NS, ahead)), MAKE)
    assert not any("was set" in w for w in (*seen.warnings, *read(tmp_path, config).warnings))


@pytest.mark.parametrize(
    "recorded_s", [lambda s: 2.0 * s, lambda s: 0.5 * s, lambda s: s + 20.0 * (s > 15.0)], ids=["slow", "fast", "pause"]
)
def test_what_a_slow_simulator_says_is_read_by_its_stamps(tmp_path: Path, recorded_s: Callable[[float], float]) -> None:
    """Fixes that end early had another usual latency than the IMU: their clock was said to be off by seconds."""
    asked = [item for item in restamped({}) if item[0] != "/fix" or item[1] < START_NS + 25 * S]
    items = [(name, START_NS + round(1e9 * recorded_s((at_ns - START_NS) / S)), m) for name, at_ns, m in asked]
    for k, (name, at_ns, m) in enumerate(items):
        if name == "/compass":
            yaw = np.degrees(2.0 * np.arctan2(m.quaternion.z, m.quaternion.w))
            items[k] = ("/heading", at_ns, MAKE.t["std_msgs/msg/Float64"](data=float(90.0 - yaw) % 360.0))
    found, config, text = look(tmp_path, items, MAKE)
    assert "time_offset_s" not in text
    assert "clock_drift_ppm" not in text
    recording = read(tmp_path, config)
    for warnings in (found.warnings, recording.warnings):
        assert [w[:14] for w in warnings if "recording took" in w or "clock" in w] == ["recording took"]
    stamps = {
        kind: [m.stamp_ns for m in recording.measurements if isinstance(m, kind)]
        for kind in (GnssPosition, CompassHeading)
    }
    assert stamps[GnssPosition] == [at_ns - WAY_NS["/fix"] for name, at_ns, _ in asked if name == "/fix"]
    measured = np.array([at_ns - WAY_NS["/compass"] for name, at_ns, _ in asked if name == "/compass"])
    assert np.abs(np.array(stamps[CompassHeading]) - measured).max() < 0.2 * S  # no stamp of its own


def test_a_clock_of_an_imu_that_runs_slow_is_not_the_recorders(tmp_path: Path) -> None:
    _, config, _ = look(tmp_path, restamped({"/imu": lambda ns: ns - (ns - START_NS) // 20}), MAKE)
    assert not any("recording took" in w for w in read(tmp_path, config).warnings)


def test_a_clock_that_is_set_is_not_said_to_drift_because_that_of_the_imu_does(tmp_path: Path) -> None:
    """A drift that was that of the IMU with its sign turned was proposed."""
    change = {"/fix": lambda ns: ns + S // 2 * (ns > START_NS + 30 * S), "/imu": lambda ns: ns + (ns - START_NS) // 50}
    _, config, _ = look(tmp_path, restamped(change), MAKE)
    plain = {n: sensor.model_copy(update={"clock_drift_ppm": 0.0}) for n, sensor in config.sensors.items()}
    warnings = read(tmp_path, config.model_copy(update={"sensors": plain})).warnings
    (line,) = [w for w in warnings if w.startswith("gnss: its clock") and "during the run" in w]
    assert "synchronise the clocks" in line


@pytest.mark.parametrize("apart_ns", [0, 20_000])
def test_imu_samples_that_are_stamped_in_bursts_are_laid_out_evenly(apart_ns: int, tmp_path: Path) -> None:
    """Five samples at 25 Hz are read, and stamped, when the last of them is there; a second of them is lost."""
    tick_ns = S // 25

    def burst(ns: int) -> int:
        k = (ns - START_NS) // tick_ns
        return START_NS + (k // 5 * 5 + 4) * tick_ns - (4 - k % 5) * apart_ns

    items = [i for i in restamped({"/imu": burst}) if i[0] != "/imu" or not 20 * S <= i[1] - START_NS < 21 * S]
    _, config, _ = look(tmp_path, items, MAKE)
    recording = read(tmp_path, config)
    true_ns = np.array([START_NS + k * tick_ns for k in range(1500) if not 500 <= k < 525])
    assert len(recording.imu) == len(true_ns)
    assert np.abs(recording.imu.stamps_ns - true_ns).max() < 1_000_000
    assert any("imu: its samples are stamped in bursts" in w for w in recording.warnings)
    assert config.sensors["imu"].gyro_noise_mdps_per_sqrt_hz == ImuConfig().gyro_noise_mdps_per_sqrt_hz


def test_copies_of_imu_samples_are_no_burst(tmp_path: Path) -> None:
    items = [i for item in restamped({}) for i in ([item, item] if item[0] == "/imu" else [item])]
    _, config, _ = look(tmp_path, items, MAKE)
    recording = read(tmp_path, config)
    assert len(recording.imu) == 1500
    assert not any("bursts" in w for w in recording.warnings)


@pytest.mark.parametrize("together", [5, 1])
def test_stamps_that_come_in_bursts_are_said(together: int, tmp_path: Path) -> None:
    """Fixes at 5 Hz that are recorded a second's at once, and stamped so."""
    items, fixes = [], 0
    for topic, at_ns, msg in restamped({"/fix": lambda _ns: 0}):
        wait_ns = (together - 1 - fixes % together) * (S // 5 - 1_000_000) if topic == "/fix" else 0
        fixes += topic == "/fix"
        items.append((topic, at_ns + wait_ns, msg))
    _, config, _ = look(tmp_path, sorted(items, key=lambda item: item[1]), MAKE)
    lines = [w for w in read(tmp_path, config).warnings if "stamped in bursts, 1.0 s apart" in w]
    assert len(lines) == (together > 1)


@pytest.mark.parametrize(
    ("stamp_ns", "others_ns", "recorded"),
    [
        (START_NS, 0, False),
        (0, 0, True),
        (900 * S, 0, True),
        (900 * S, START_NS - 900 * S, False),  # all count from when the computer was switched on
    ],
)
@pytest.mark.parametrize("kind", ["aerial", "apriltag"])
def test_scans_and_images_without_usable_stamps_are_drafted_by_the_recording_times(
    kind: str, stamp_ns: int, others_ns: int, recorded: bool, tmp_path: Path
) -> None:
    items = restamped(dict.fromkeys(WAY_NS, lambda ns: ns - others_ns))
    seen = {
        "aerial": MAKE.t["sensor_msgs/msg/PointCloud2"](
            header=MAKE.header(stamp_ns, "lidar"), height=1, width=0, fields=[], is_bigendian=False, point_step=12,
            row_step=0, data=np.zeros(0, np.uint8), is_dense=True,
        ),
        "apriltag": MAKE.t["sensor_msgs/msg/CompressedImage"](
            header=MAKE.header(stamp_ns, "camera"), format="jpeg", data=np.zeros(0, np.uint8)
        ),
    }  # fmt: skip
    items += [("/seen", START_NS + S // 10, seen[kind])]
    path = hold_bag(tmp_path / "run", MAKE, items)
    (tmp_path / "vessel.yaml").write_text(draft_config(inspect_bag(path)))
    (sensor,) = (s for s in configured(tmp_path / "vessel.yaml").sensors.values() if s.kind == kind)
    assert sensor.stamps == ("recorded" if recorded else "header")


@pytest.mark.parametrize(
    ("by_s", "said"), [(-18.0, ", as from GPS time to UTC: no"), (18.02, ", as from UTC to GPS time: no"), (-7.0, "")]
)
def test_a_clock_that_learns_the_leap_seconds_is_told_so(by_s: float, said: str) -> None:
    line = ClockStep(by_s, 1_700_000_000 * S).said("/fix")
    assert f"by {abs(by_s):.2f} s at" in line
    assert said in line
    assert said or "GPS time" not in line


@pytest.mark.parametrize("learned_s", [20, 45])
def test_sensors_whose_clock_is_set_are_judged_on_one_side_of_it(learned_s: int, tmp_path: Path) -> None:
    """GPS time until the receiver learns the leap seconds: some headings and fixes were compared with turns 18 s away, others left out."""

    def learns(ns: int) -> int:
        return ns + (18 * S if ns < START_NS + learned_s * S else 0)

    seen = []
    for name, topics in (("set", {"/fix": learns, "/compass": learns}), ("right", {})):
        (tmp_path / name).mkdir()
        found, _, _ = look(tmp_path / name, restamped(topics), MAKE)
        assert any("from GPS time to UTC" in w for w in found.warnings) == (name == "set")
        seen.append((found.compasses[0].samples, found.imus[0].mount.evidence))
    assert seen[0] == seen[1]


def test_stamps_as_text_keep_each_nanosecond() -> None:
    """19:11:37 UTC on 21 May 2015 is 1432235497 s; what no calendar has is said in seconds."""
    assert seconds_text(1_432_235_497_088_949_113) == "1432235497.088949113"
    assert utc_text(1_432_235_497_088_949_113) == "2015-05-21T19:11:37.088949113Z"
    assert utc_text(10**21 + 5) == "1000000000000.000000005s"
