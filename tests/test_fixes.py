# SPDX-License-Identifier: Apache-2.0
"""Fixes that say more than they know: repeated under new stamps, stamped in steps, noisier than they claim, without a height."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graphloc.app import smooth_recording
from graphloc.config import GnssConfig, load_config
from graphloc.eval.ekf._honest import run_honest
from graphloc.eval.metrics import held_out_errors
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import SENSORS
from graphloc.frames import Datum, Geodetic
from graphloc.frontends._sanity import lone_fixes
from graphloc.frontends.inspect import draft_config
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, PoseFix
from graphloc.origin import choose_datum, height_m
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.trajectory import Trajectory
from tests.bagfactory import START_NS, Item, Messages, S
from tests.heldbags import hold_bag, inspect_bag, read_recording
from tests.slowly import simulate_slowly
from tests.test_bag import KINDS
from tests.test_bag_bad_input import accounted, rows_of, vessel

MAKE = Messages(2)
DATUM = Datum(Geodetic(57.7, 11.9, 40.0))


def fixes(
    hz: int = 10, *, every: int = 1, seconds: int = 40, noise_m: float = 0.0, sigma_m: float = 0.1, step_ns: int = 1
) -> list[Item]:
    """A craft that turns at 2 m/s and 0.3 rad/s; the receiver measures at every `every`-th message only."""
    rng = np.random.default_rng(8)
    items: list[Item] = []
    place = np.zeros(3)
    for k in range(hz * seconds):
        t = k / hz
        if k % every == 0:
            place = np.array([6.7 * np.cos(0.3 * t), 6.7 * np.sin(0.3 * t), 0.0]) + noise_m * rng.normal(size=3)
        lla = DATUM.geodetic_from_enu(place[None, :])[0]
        stamp = START_NS + k * S // hz // step_ns * step_ns
        items.append(
            (
                "/fix",
                START_NS + k * S // hz,
                MAKE.fix(stamp, lla[0], lla[1], lla[2], covariance=(sigma_m**2 * np.eye(3)).ravel()),
            )
        )
    return items


def read(tmp_path: Path, items: list[Item], **gnss: object) -> Recording:
    path = hold_bag(tmp_path / "run", MAKE, items)
    recording = read_recording(path, vessel(imu=None, gnss={"topic": "/fix", **gnss}))
    assert recording.message_count == accounted(recording)
    return recording


def test_places_held_by_a_driver_count_once(tmp_path: Path) -> None:
    recording = read(tmp_path, fixes(10, every=10))
    stamps = [m.stamp_ns for m in recording.of(GnssPosition)]
    # The last one is not known to be held: nothing came after it.
    assert stamps[:40] == [START_NS + k * S for k in range(40)]
    assert len(stamps) == 49
    held = rows_of(recording, "gnss")
    assert len(held) == 351
    assert all(r.outcome is Outcome.REJECTED and "repeats the position" in r.reason for r in held)
    (line,) = recording.warnings
    assert "351 of 400 fixes repeat" in line


@pytest.mark.parametrize("default_m", [0.05, 1.5])
def test_fixes_that_state_nothing_are_not_of_rtk(default_m: float, tmp_path: Path) -> None:
    """Whatever they are taken for: else both sensors of a receiver may read them, or neither."""
    items = [
        (topic, at, MAKE.fix(at, 57.7, 11.9 + 1e-6 * k, 40.0, 2, np.zeros(9), 0))
        for k, (topic, at, _) in enumerate(fixes())
    ]
    used = {
        part: len(read(tmp_path / part, items, fixes=part, default_horizontal_sigma_m=default_m).of(GnssPosition))
        for part in ("rtk", "other")
    }
    assert used == {"rtk": 0, "other": len(items)}


@pytest.mark.parametrize("every", [1, 50])
def test_fixes_that_move_or_stand_are_kept(every: int, tmp_path: Path) -> None:
    """A receiver that says the same for 5 s holds still itself."""
    recording = read(tmp_path, fixes(10, every=every))
    assert len(recording.measurements) == 400
    assert recording.warnings == ()


def uneven_fixes(stamped_s: float, measured_s: float = 0.0, seconds: int = 60) -> list[Item]:
    """A car that brakes and turns at 6 to 14 m/s; its fixes at 5 Hz are measured and stamped that far, 1 sigma, about even times."""
    rng = np.random.default_rng(4)
    fine = np.arange(0.0, seconds + 1.0, 0.01)
    v, turned = 10.0 + 4.0 * np.sin(0.3 * fine), 1.5 * np.sin(0.2 * fine)
    way = np.cumsum(0.01 * v * np.exp(1j * turned))
    items: list[Item] = []
    for k in range(1, 5 * seconds):
        measured = k / 5.0 + measured_s * rng.normal()
        stamp_ns = START_NS + round((measured + stamped_s * rng.normal()) * S)
        at = np.interp(measured, fine, way)
        place = np.array([[at.real, at.imag, 0.0]]) + 0.015 * rng.normal(size=3)
        lla = DATUM.geodetic_from_enu(place)[0]
        items.append(
            ("/fix", stamp_ns, MAKE.fix(stamp_ns, lla[0], lla[1], lla[2], covariance=(0.02**2 * np.eye(3)).ravel()))
        )
    return items


def test_fixes_that_are_stamped_when_they_come_in_are_not_good_to_their_centimetres(tmp_path: Path) -> None:
    """10 ms at 13.8 m/s, the 90 % point of the speed: online, heading and place were outside their bounds half of the time."""
    (line,) = read(tmp_path, uneven_fixes(0.01)).warnings
    assert line.startswith("gnss: its stamps are uneven by 0.01")
    draft = draft_config(inspect_bag(tmp_path / "run"))
    (drafted,) = (row for row in draft.splitlines() if "min_horizontal_sigma_m" in row)
    floor_m = float(drafted.split()[1])
    assert floor_m == pytest.approx(0.138, rel=0.15)
    (tmp_path / "again").mkdir()
    assert read(tmp_path / "again", uneven_fixes(0.01), min_horizontal_sigma_m=floor_m).warnings == ()


@pytest.mark.parametrize(("stamped_s", "measured_s"), [(0.0, 0.01), (0.0, 0.0), (0.001, 0.0)])
def test_stamps_that_tell_when_a_fix_was_measured_are_believed(
    stamped_s: float, measured_s: float, tmp_path: Path
) -> None:
    assert not any("uneven" in said for said in read(tmp_path, uneven_fixes(stamped_s, measured_s)).warnings)
    assert "min_horizontal_sigma_m" not in draft_config(inspect_bag(tmp_path / "run"))


def stored_first(
    away_m: float, *, count: int = 100, silent_s: int = 0, noise_m: float = 0.0, back: bool = False
) -> list[Item]:
    """The first `count` fixes say another place; `back`: so do the last ones."""
    items, rng = fixes(10), np.random.default_rng(9)
    for k, (_, _, fix) in enumerate(items):
        if k < count or (back and k > 350):
            p = np.array([[0.6 * away_m, 0.8 * away_m, 0.0]]) + noise_m * rng.normal(size=3)
            fix.latitude, fix.longitude, fix.altitude = DATUM.geodetic_from_enu(p)[0]
    return items[:count] + items[count + 10 * silent_s :]


@pytest.mark.parametrize("away_m", [150.0, 3e3, 80e3, 500e3])
@pytest.mark.parametrize("count", [20, 250])
def test_a_place_of_before_the_run_is_no_fix(away_m: float, count: int, tmp_path: Path) -> None:
    """Receivers say where they were last until they have a fix, and some drivers call it one; even if that is most of the run."""
    items = stored_first(away_m, count=count)
    recording = read(tmp_path, items)
    assert len(recording.measurements) == 400 - count
    assert len([r for r in rows_of(recording, "gnss") if "had stored" in r.reason]) == count
    (line,) = recording.warnings
    assert f"gnss: its first {count} fixes repeat" in line
    seen = inspect_bag(tmp_path / "run")
    assert seen.gnss[0].fixes == 400 - count
    assert max(seen.gnss[0].extent_m) < 20.0
    assert [w.partition(":")[2] for w in seen.warnings if "had stored" in w] == [line.partition(":")[2]]


@pytest.mark.parametrize(
    "items",
    [
        stored_first(60.0),  # multipath jumps so far from a receiver that holds at rest
        stored_first(300.0, back=True),
        stored_first(300.0, noise_m=0.02),
        stored_first(300.0, silent_s=5),  # it went there
        stored_first(300.0, count=1),
    ],
    ids=["near", "comes back", "measured", "after a silence", "not repeated"],
)
def test_first_fixes_that_may_be_right_are_kept(items: list[Item], tmp_path: Path) -> None:
    assert len(read(tmp_path, items).measurements) == len(items)


def test_a_few_repeated_positions_are_no_pattern(tmp_path: Path) -> None:
    items = fixes(10)
    for k in range(20, 400, 40):
        items[k][2].latitude, items[k][2].longitude = items[k - 1][2].latitude, items[k - 1][2].longitude
    assert len(read(tmp_path, items).measurements) == 400


@pytest.mark.parametrize(("step_ns", "said"), [(1, 0), (S // 10, 0), (S, 1)])
def test_stamps_cut_to_seconds_are_reported(step_ns: int, said: int, tmp_path: Path) -> None:
    warnings = read(tmp_path, fixes(10, step_ns=step_ns)).warnings
    assert len(warnings) == said
    assert all("400 measurements have 40 stamps, 1 s apart" in line for line in warnings)


@pytest.mark.parametrize(
    ("hz", "noise_m", "sigma_m", "scale", "expected"),
    [
        (10, 0.5, 0.05, 1.0, 10.0),
        (10, 0.5, 0.05, 4.0, 10.0),  # of the scale that is configured already
        (10, 0.5, 0.05, 9.0, None),
        (10, 0.5, 0.5, 0.01, 1.0),  # the floor of the sigma is not what is scaled
        (10, 0.05, 0.05, 1.0, None),
        (10, 0.0, 0.05, 1.0, None),
        (1, 0.5, 0.05, 1.0, None),  # motion could be in it
        (1, 5.0, 0.5, 1.0, 10.0),  # but not that much
        (1, 5.0, 4.0, 1.0, None),
    ],
)
def test_noise_that_a_receiver_hides(
    hz: int, noise_m: float, sigma_m: float, scale: float, expected: float | None, tmp_path: Path
) -> None:
    """White noise of 0.5 m on fixes that claim 0.05 m: sigma_scale 10, in the warning and in the draft."""
    items = fixes(hz, noise_m=noise_m, sigma_m=sigma_m, seconds=200)
    lines = [w for w in read(tmp_path, items, sigma_scale=scale).warnings if "scatter" in w]
    assert len(lines) == (expected is not None)
    if expected is not None:
        assert float(lines[0].rsplit("sigma_scale:", 1)[1]) == pytest.approx(expected, rel=0.15)
    if scale == 1.0:
        found = [line for line in draft_config(inspect_bag(tmp_path / "run")).splitlines() if "sigma_scale:" in line]
        assert len(found) == (expected is not None)
        if expected is not None:
            assert float(found[0].split("sigma_scale:")[1].split("#")[0]) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(("hz", "noise_m", "expected"), [(1, 5.0, 5.0), (10, 5.0, 5.0), (10, 1.0, None)])
def test_noise_of_a_receiver_that_claims_none(hz: int, noise_m: float, expected: float | None, tmp_path: Path) -> None:
    """1.5 m is taken where nothing is reported: five times as noisy, the graph would blame the IMU."""
    items = fixes(hz, noise_m=noise_m, sigma_m=0.0, seconds=200)
    for _, _, message in items:
        message.position_covariance_type = 0
    said = [w for w in read(tmp_path, items).warnings if "scatter" in w]
    text = draft_config(inspect_bag(tmp_path / "run"))
    found = [
        float(line.split(":")[1].split("#")[0]) for line in text.splitlines() if "default_horizontal_sigma_m:" in line
    ]
    assert len(said) == len(found) == (expected is not None)
    assert found == pytest.approx([expected] if expected else [], rel=0.15)


@pytest.mark.parametrize(
    ("noise_m", "status", "claims", "expected"),
    [
        (0.01, 2, False, 0.05),  # a floor: scatter holds no slow error
        (0.08, 2, False, 0.08),
        (0.3, 2, False, None),  # a float, or DGPS
        (0.01, 0, False, None),  # smoothed by the receiver
        (0.01, 2, True, None),
    ],
)
def test_rtk_that_claims_nothing_is_drafted_as_it_scatters(
    noise_m: float, status: int, claims: bool, expected: float | None, tmp_path: Path
) -> None:
    """It counted as good to 1.5 m: bounds of half a metre, where 3 cm was true. Its slow error stays on, for DGPS says the same."""
    items = fixes(10, noise_m=noise_m, sigma_m=0.5, seconds=200)
    for _, _, message in items:
        message.status.status = status
        message.position_covariance_type = 2 if claims else 0
    read(tmp_path, items)
    (tmp_path / "drafted.yaml").write_text(draft_config(inspect_bag(tmp_path / "run")))
    gnss = load_config(tmp_path / "drafted.yaml", KINDS).sensors["gnss"]
    usual = GnssConfig()
    assert gnss.default_horizontal_sigma_m == pytest.approx(expected or usual.default_horizontal_sigma_m, rel=0.15)
    assert (gnss.default_vertical_sigma_m < usual.default_vertical_sigma_m) == (expected is not None)
    assert gnss.slow_error == usual.slow_error


@pytest.mark.parametrize(
    ("status", "sigma_m", "said"), [(0, 0.02, True), (1, 0.02, True), (2, 0.02, False), (0, 0.5, False)]
)
def test_fixes_that_claim_centimetres_without_a_status_of_rtk_are_left_to_the_user(
    status: int, sigma_m: float, said: bool, tmp_path: Path
) -> None:
    """Drivers claim them for nothing, or do not tell that it is RTK: beside an image 2 m off these give way, and nothing said so."""
    items = fixes(5, noise_m=0.015, sigma_m=sigma_m)
    for _, _, message in items:
        message.status.status = status
    read(tmp_path, items)
    lines = draft_config(inspect_bag(tmp_path / "run")).splitlines()
    (line,) = (line for line in lines if line.strip().startswith("slow_error:"))
    assert ("if RTK makes them as good as they claim" in line) == said
    assert line.strip().startswith("slow_error: {}") == (status < 2)


@pytest.mark.parametrize(("hz", "sigma_m", "said"), [(10, 1e4, 1), (2, 1e4, 1), (10, 20.0, 0)])
def test_fixes_that_claim_to_tell_nothing_are_reported(hz: int, sigma_m: float, said: int, tmp_path: Path) -> None:
    """A driver that writes 1e8 m^2: the track was 100 m off its fixes, and its bounds km, without a word."""
    lines = read(tmp_path, fixes(hz, noise_m=0.2, sigma_m=sigma_m, seconds=60)).warnings
    assert len(lines) == said
    assert all("gnss: its fixes claim a sigma of 10000 m" in line for line in lines)


def test_heights_of_zero_throughout_are_said_to_be_none(tmp_path: Path) -> None:
    items = fixes(10)
    for _, _, fix in items:
        fix.altitude = 0.0
    (line,) = read(tmp_path, items).warnings
    assert line.startswith("gnss: all 400 fixes have a height of 0, as from a receiver that has none")


@pytest.mark.parametrize("every", [1, 3])
def test_a_fix_without_a_height_is_a_horizontal_one(every: int, tmp_path: Path) -> None:
    """NavSatFix says NaN where there is no altitude; a fix without a latitude or longitude stays refused."""
    items = fixes(10)
    for _, _, fix in items[::every]:
        fix.altitude = np.nan
    items[1][2].latitude, items[2][2].longitude = np.nan, np.nan
    recording = read(tmp_path, items)
    found = {m.stamp_ns: m for m in recording.measurements if isinstance(m, GnssPosition)}
    assert len(found) == 398
    assert [r.reason for r in rows_of(recording, "gnss")] == ["run: latitude or longitude is NaN"] * 2
    flat = [m for m in found.values() if not m.has_height]
    assert {m.stamp_ns for m in flat} == {log for _, log, _ in items[::every]} & found.keys()
    assert all(m.cov_enu_m2[2, 2] >= 1e12 and m.cov_enu_m2[0, 0] == pytest.approx(0.01) for m in flat)
    (line,) = recording.warnings
    assert f"{len(flat)} of 398 fixes have no height" in line
    # Origin and waterline are taken from fixes that have one: all of those are at 40 m, the antenna in the body's origin.
    datum = choose_datum(recording, vessel(gnss={"topic": "/fix"}), SENSORS)
    assert datum.origin.height_m == pytest.approx(0.0 if every == 1 else 40.0, abs=1e-3)
    assert height_m(recording, vessel(gnss={"topic": "/fix"}), None, datum) == pytest.approx(0.0, abs=1e-3)
    (report,) = inspect_bag(tmp_path / "run").gnss
    assert report.without_height == len(flat)
    assert report.fixes == 398
    assert report.height_range_m < 0.01


def test_horizontal_fixes_tell_the_same_track() -> None:
    """Planar fixes beside the height prior: the horizontal track is that of fixes with their heights, batch and online."""
    run = simulate_slowly(Scenario(path="loops", duration_s=12.0, noise="drift", imu_hz=50.0), 2, rate_hz=2.5)
    flat = tuple(_flattened(m) if isinstance(m, GnssPosition) else m for m in run.recording.measurements)
    planar = replace(run.recording, measurements=flat)
    for solve in (smooth_recording, replay):
        whole, ours = (solve(recording, run.config).solution for recording in (run.recording, planar))
        apart = ours.trajectory.p_world_m - whole.trajectory.p_world_m
        assert np.sqrt((apart[:, :2] ** 2).sum(axis=1).mean()) < 0.05
        assert np.abs(apart[:, 2]).max() < 0.5
        assert ours.trajectory.cov is not None
        assert whole.trajectory.cov is not None
        assert np.median(ours.trajectory.cov[:, 0, 0] / whole.trajectory.cov[:, 0, 0]) == pytest.approx(1.0, rel=0.1)
        if not ours.stats.online:  # three numbers a fix, or two
            # A height is good to 2 x 0.3 m / sqrt(2), and its slow error of 5 m over 200 s walks 0.25 m^2 in a second: ten fixes at
            # a node have 0.25 x 0.1 x 9 x 19 / 6 = 0.71 m^2 of that each, so that of one square 0.2 are to be expected.
            share = 0.18 / (0.18 + 0.25 * 0.1 * 9.0 * 19.0 / 6.0)
            fewer = whole.stats.expected_cost - ours.stats.expected_cost
            every = share * sum(isinstance(m, GnssPosition) for m in flat)
            assert 0.7 * every < fewer <= 1.05 * every  # by their weights


LAKE = Datum(Geodetic(-16.0, -69.0, 3812.0))
EAST_M = np.array([5000.0, 0.0, 0.0])


def test_a_fix_without_a_height_on_a_lake_in_the_mountains_is_where_one_with_it_is() -> None:
    """At 0 m a degree is shorter by height over the Earth's radius: 5 km east of the datum, 3 m."""
    (row,) = (row for row in SENSORS if row.kind == "gnss")
    position = Geodetic(*LAKE.geodetic_from_enu(EAST_M[None])[0])
    fix = _flattened(GnssPosition(stamp_ns=0, sensor="gnss", seq=0, position=position, cov_enu_m2=np.eye(3)))
    hint = row.hint(fix, 0.0, LAKE)
    assert hint.p_world_m is not None
    assert hint.p_world_m[:2] == pytest.approx(EAST_M[:2], abs=0.01)
    there = Trajectory(
        stamps_ns=np.array([0, S]), p_world_m=np.array([EAST_M, EAST_M]), R_world_body=np.array([np.eye(3), np.eye(3)])
    )
    error = held_out_errors(there, [fix], LAKE, {"gnss": np.zeros(3)}).position_m
    assert error[:, :2] == pytest.approx(np.zeros((1, 2)), abs=0.01)


def test_the_filters_read_such_a_fix_as_the_graph_does() -> None:
    run = simulate(Scenario(path="loops", duration_s=20.0), 2)
    home = choose_datum(run.recording, run.config, SENSORS)
    said = [m for m in run.recording.measurements if not isinstance(m, PoseFix)]

    def moved(m: GnssPosition) -> GnssPosition:
        p = home.enu_from_geodetic(*(np.array([v]) for v in m.position)) + EAST_M
        return _flattened(replace(m, position=Geodetic(*LAKE.geodetic_from_enu(p)[0])))

    there = [moved(m) if isinstance(m, GnssPosition) else m for m in said]
    near, far = (
        run_honest(replace(run.recording, measurements=tuple(of), truth=None), run.config, datum).trajectory.p_world_m
        for of, datum in ((said, home), (there, LAKE))
    )
    assert np.abs(far - near - EAST_M).max() < 0.01


def _flattened(m: GnssPosition) -> GnssPosition:
    """The fix as the decoder makes it where there is no altitude."""
    return replace(
        m, position=m.position._replace(height_m=0.0), cov_enu_m2=np.diag([*np.diagonal(m.cov_enu_m2)[:2], 1e12])
    )


@pytest.mark.parametrize(("hz", "least_m"), [(10.0, 10.0), (1.0, 31.0), (0.2, 300.0)])
def test_single_fixes_to_which_no_craft_goes_and_comes_back_are_told(hz: float, least_m: float) -> None:
    """A car of 15 m/s that brakes hard in 2 s, stands and sets out; wrong ones next to each other, at the ends, and jumps that last are not."""
    t = np.arange(0.0, 300.0, 1.0 / hz)
    speed = 15.0 * np.clip(np.abs((t % 60.0) - 30.0) / 2.0 - 1.0, 0.0, 1.0)
    p = np.column_stack([np.cumsum(speed) / hz, 20.0 * np.sin(t / 7.0), 0.0 * t])
    p[len(t) // 2 :] += [0.0, 80.0, 0.0]
    wrong = np.arange(len(t) // 10, len(t) - 3, max(len(t) // 9, 4))
    wrong = wrong[np.abs(wrong - len(t) // 2) > 2]
    stamps_ns = START_NS + (t * S).astype(np.int64)
    assert not lone_fixes(stamps_ns, p).any()
    p[wrong, 1] += 1.2 * least_m + 3.0 * 2.0 * 15.0 / hz
    assert np.flatnonzero(lone_fixes(stamps_ns, p)).tolist() == wrong.tolist()
    p[0], p[-1] = [1e4, 0.0, 0.0], [1e4, 0.0, 0.0]
    p[wrong + 1] = p[wrong]
    assert not lone_fixes(stamps_ns, p).any()
    assert not lone_fixes(stamps_ns[:2], p[:2]).any()
