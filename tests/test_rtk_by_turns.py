# SPDX-License-Identifier: Apache-2.0
"""A receiver whose RTK comes and goes: centimetres while it is there, honest bounds while it is not, and nothing missing."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import gtsam
import numpy as np
import pytest

from graphloc import app, keys
from graphloc.build import rows_of, shared_constants
from graphloc.config import GnssConfig, SensorConfig, SlowErrorConfig, VelocityConfig, VesselConfig
from graphloc.eval.drill import script
from graphloc.eval.ekf import run_honest
from graphloc.eval.holdout import HoldOut, telling
from graphloc.eval.report import Trust, verdict
from graphloc.eval.simulate import Scenario, SimulatedRun, simulate
from graphloc.factors import SENSORS
from graphloc.frames import Array, Geodetic
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, Measurement
from graphloc.recording import Recording
from graphloc.signals.frozen_receiver import FROZEN
from graphloc.solution import Cause, Health, Solution
from graphloc.solve._levels import _drawn_anew, _moved, _Span
from graphloc.trajectory import bounds_95
from tests.bagfactory import S
from tests.faults import arrivals_of, feed
from tests.slowly import with_few_states
from tests.test_online_faults import smoother

RTK_S, OTHER_S, SIGMA_M = 14.0, 16.0, {True: 0.02, False: 1.0}
TRACK = Scenario(path="loops", duration_s=75.0, imu_hz=25.0, gnss_hz=2.0, compass_hz=1.0, pose_hz=0.0)
LONGER = replace(TRACK, duration_s=105.0)


METRES = SlowErrorConfig(horizontal_sigma_m=2.0, vertical_sigma_m=4.0, time_constant_s=60.0)
CENTIMETRES = SlowErrorConfig(horizontal_sigma_m=0.03, vertical_sigma_m=0.06)


def receiver(
    rtk: Callable[[float], bool],
    off_m: Callable[[float], tuple[float, float]],
    track: Scenario = TRACK,
    rate_hz: float = 1.25,
) -> tuple[SimulatedRun, SimulatedRun]:
    """A run whose receiver has RTK at some times, s, and is so far off east and north: as one sensor, with the slow error of fixes without, and as two."""
    run = simulate(track, 3)
    truth, datum = run.truth, app.choose_datum(run.recording, run.config)

    def moved(m: Measurement, *, two: bool) -> Measurement:
        if not isinstance(m, GnssPosition):
            return m
        t = (m.stamp_ns - int(truth.stamps_ns[0])) * 1e-9
        here = [float(np.interp(m.stamp_ns, truth.stamps_ns, axis)) for axis in truth.p_world_m.T]
        noise = np.random.default_rng(m.seq).normal(0.0, 0.01 if rtk(t) else 0.5, 3)
        lla = datum.geodetic_from_enu(np.array([here]) + noise + [*off_m(t), 0.0])[0]
        name = "gnss_other" if two and not rtk(t) else "gnss"
        return replace(m, sensor=name, position=Geodetic(*lla), cov_enu_m2=SIGMA_M[rtk(t)] ** 2 * np.eye(3))

    gnss = run.config.sensors["gnss"]
    gnss = gnss.model_copy(update={"mount": gnss.mount.model_copy(update={"xyz_m": (0.0, 0.0, 0.0)})})

    def made(two: bool, **sensors: GnssConfig) -> SimulatedRun:
        config = with_few_states(run.config.model_copy(update={"sensors": {**run.config.sensors, **sensors}}), rate_hz)
        return replace(run, recording=run.recording.changed(partial(moved, two=two)), config=config)

    one = made(False, gnss=gnss.model_copy(update={"slow_error": METRES}))
    two = made(
        True,
        gnss=gnss.model_copy(update={"slow_error": CENTIMETRES, "fixes": "rtk"}),
        gnss_other=gnss.model_copy(update={"slow_error": METRES, "fixes": "other"}),
    )
    return one, two


def solved(run: SimulatedRun, solve: Callable[[Recording, VesselConfig], app.Run]) -> tuple[Solution, Array, Array]:
    """The solution, the horizontal errors (N,), m, and the times (N,), s, of its states."""
    solution = solve(run.recording, run.config).solution
    track, truth = solution.trajectory, run.truth
    true = np.column_stack([np.interp(track.stamps_ns, truth.stamps_ns, axis) for axis in truth.p_world_m.T])
    off_m = np.hypot(*(track.p_world_m - true)[:, :2].T)
    return solution, off_m, np.asarray((track.stamps_ns - int(truth.stamps_ns[0])) * 1e-9, dtype=float)


def comes_and_goes(t: float) -> bool:
    """RTK, in the end as well."""
    return t % (RTK_S + OTHER_S) < RTK_S


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_two_sensors_know_it_to_centimetres_where_there_is_rtk(
    solve: Callable[[Recording, VesselConfig], app.Run],
) -> None:
    """The other fixes are off by metres, anew each time."""
    slow_m = np.random.default_rng(5).normal(0.0, 2.0, (4, 2)).tolist()

    def off(t: float) -> tuple[float, float]:
        return (0.0, 0.0) if comes_and_goes(t) else tuple(slow_m[int(t // (RTK_S + OTHER_S))])

    one, _, t = solved(receiver(comes_and_goes, off, replace(TRACK, duration_s=44.0))[0], solve)
    bounds_m = bounds_95(np.asarray(one.trajectory.cov))[:, 0]
    assert np.median(bounds_m[[comes_and_goes(at) for at in t]]) > 2.5  # what the error of all fixes costs
    two, off_m, t = solved(receiver(comes_and_goes, off, rate_hz=2.5)[1], solve)
    rtk, bounds_m = np.array([comes_and_goes(at) for at in t]), bounds_95(np.asarray(two.trajectory.cov))[:, 0]
    assert np.median(bounds_m[rtk]) < 0.2
    assert np.percentile(off_m[rtk], 90) < 0.05
    assert np.mean(off_m < bounds_m) > 0.95
    assert Cause.SENSORS not in {reason.cause for reason in two.health_reason}
    assert np.mean([health is Health.GOOD for health in two.health]) > 0.9


def test_no_pose_is_good_beside_a_receiver_that_agrees_by_over_three_sigmas_of_its_slow_error() -> None:
    """Offline; 2 m is one sigma, and the fixes are constantly so far from the matches: with 5 m they may be right."""

    def good(away_m: float) -> float:
        with_matches = replace(TRACK, pose_hz=1.0, false_fraction=0.0, duration_s=20.0)
        _, two = receiver(lambda t: False, lambda t: (away_m, 0.0), with_matches)
        solution, *_ = solved(two, app.smooth_recording)
        return float(np.mean([health is Health.GOOD for health in solution.health]))

    assert (good(5.0), good(7.0)) == (1.0, 0.0)


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_poses_are_good_again_once_rtk_is_back_after_a_jump_of_the_other_fixes(
    solve: Callable[[Recording, VesselConfig], app.Run],
) -> None:
    """The other fixes, the last of which were 15 m off, come no more: for the rest of the run they were held against each pose."""
    with_matches = replace(TRACK, pose_hz=1.0, false_fraction=0.0, duration_s=64.0)
    _, two = receiver(
        lambda t: not 20.0 < t < 45.0, lambda t: (15.0, 0.0) if 30.0 < t < 45.0 else (0.0, 0.0), with_matches
    )
    solution, off_m, t = solved(two, solve)
    good = np.array([health is Health.GOOD for health in solution.health])
    assert not good[(t > 38.0) & (t < 44.0)].any()  # beside matches, the receiver agrees only by an error it hardly has
    assert solution.since_agreed_s["gnss_other"][(t > 42.0) & (t < 44.0)].min() > 8.0
    assert good[t > 57.0].all()
    assert off_m[t > 57.0].max() < 0.3


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_a_wrong_rtk_fix_is_not_followed(solve: Callable[[Recording, VesselConfig], app.Run]) -> None:
    """4 m off for 20 s: the fixes without RTK, which come at other times, were company that hides no jump but also shows none."""
    _, two = receiver(
        lambda t: t < 50.0, lambda t: (4.0, 0.0) if 20.0 < t < 40.0 else (0.0, 0.0), replace(TRACK, duration_s=53.0)
    )
    solution, off_m, t = solved(two, solve)
    jumped = (t > 22.0) & (t < 50.0)  # online it is found a second later
    assert np.sqrt(np.mean(off_m[jumped] ** 2)) < 1.0
    assert np.mean(off_m < bounds_95(np.asarray(solution.trajectory.cov))[:, 0]) > 0.9
    assert any("gnss: position jump" in line for line in (*solution.stats.warnings, *solution.stats.events))


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_a_wrong_rtk_fix_ends_where_rtk_does(solve: Callable[[Recording, VesselConfig], app.Run]) -> None:
    """4 m off from 30 to 40 s, then none; from 55 s on it is right again: ambiguities are resolved anew, so it was not 4 m off still."""
    _, two = receiver(
        lambda t: not 40.0 < t < 55.0,
        lambda t: (4.0, 0.0) if 30.0 < t < 40.0 else (0.0, 0.0),
        replace(TRACK, duration_s=64.0),
    )
    solution, off_m, t = solved(two, solve)
    back = t > 57.0
    assert off_m[back].max() < 0.2
    assert np.mean(off_m < bounds_95(np.asarray(solution.trajectory.cov))[:, 0]) > 0.95
    assert np.mean([health is Health.GOOD for health, after in zip(solution.health, back, strict=True) if after]) > 0.9


def test_a_jump_of_the_other_fixes_is_no_doubt_once_rtk_is_back() -> None:
    """Online: for 200 s each pose was 'degraded', as no other sensor measured position, though RTK did."""
    _, two = receiver(
        lambda t: not 20.0 < t < 45.0,
        lambda t: (15.0, 0.0) if 30.0 < t < 45.0 else (0.0, 0.0),
        replace(TRACK, duration_s=58.0),
    )
    solution, off_m, t = solved(two, app.replay_recording)
    assert any("position jump of gnss_other" in line for line in solution.stats.events)
    good = np.array([health is Health.GOOD for health in solution.health])
    assert not good[(t > 38.0) & (t < 44.0)].any()
    assert good[t > 50.0].all()
    assert off_m[t > 50.0].max() < 0.2


def test_rtk_that_comes_back_wrong_is_told_by_the_fixes_beside_it() -> None:
    """1.5 m off for the first 16 s after an outage of 30 s, then right for 17 s, lost again, and right: only the first part is wrong."""
    _, two = receiver(
        lambda t: t < 20.0 or 50.0 < t < 83.0 or t > 92.0,
        lambda t: (1.5, 0.0) if 50.0 < t < 66.0 else (0.0, 0.0),
        LONGER,
    )
    solution, off_m, t = solved(two, app.smooth_recording)
    assert off_m[(t > 50.0) & (t < 83.0)].max() < 0.2
    assert np.mean(off_m < bounds_95(np.asarray(solution.trajectory.cov))[:, 0]) > 0.95


def test_held_out_fixes_without_rtk_measure_nothing() -> None:
    """They are kept out as well, else the track would know what it is to predict; off by metres, they were all of its error."""
    _, two = receiver(comes_and_goes, lambda t: (0.0, 0.0) if comes_and_goes(t) else (1.5, -1.5))
    found = app.smooth_recording(replace(two.recording, truth=None), two.config, hold_out=HoldOut(every=5))
    held = [row.sensor for row in found.recording.rows if row.outcome is Outcome.HELD_OUT]
    assert set(held) == {"gnss", "gnss_other"}
    assert {m.sensor for m in found.held} == {"gnss"}
    assert len(found.held) == held.count("gnss")
    assert f"Another {held.count('gnss_other')} without RTK were kept out" in app.report_data(found).truth_statement
    alone = replace(found, solution=replace(found.solution, slow={}))  # as where no other sensor tells the drift
    assert ["a drift that they share" in app.truth_statement(made) for made in (found, alone)] == [False, True]
    row = replace(found.recording.rows[-1], sensor="velocity", outcome=Outcome.HELD_OUT)  # of a gap
    beside = replace(
        found,
        recording=replace(found.recording, rows=(*found.recording.rows, row, row)),
        config=found.config.with_sensors({"velocity": VelocityConfig(topic="/v")}),
    )
    said = app.report_data(beside).truth_statement
    assert f"Another {held.count('gnss_other')} without RTK were kept out" in said
    assert "The 2 GNSS velocities in the gaps were kept out" in said
    without = two.recording.where(lambda m: m.sensor != "gnss")
    _, left = HoldOut(every=5).split(without)
    assert telling(left, two.config) == left  # where there is nothing better


def test_held_out_fixes_of_other_kinds_and_of_no_sensor_are_told_from_none() -> None:
    """A kind of another package reads no fixes by turns, and says nothing of that."""

    class Loran(SensorConfig):
        """Fixes of a kind that is not in the package."""

        kind: Literal["loran"] = "loran"

    _, two = receiver(comes_and_goes, lambda _t: (0.0, 0.0))
    _, held = HoldOut(every=5).split(two.recording)
    others = tuple(replace(m, sensor=name) for m, name in zip(held, ("loran", "gone"), strict=False))
    config = two.config.with_sensors({"loran": Loran(topic="/loran")})
    assert telling(others, config) == others
    assert {m.sensor for m in telling((*held, *others), config)} == {"gnss", "loran", "gone"}


def test_a_receiver_that_hangs_repeats_what_it_said_last_with_rtk_or_without() -> None:
    _, two = receiver(comes_and_goes, lambda _t: (0.0, 0.0))
    begin_ns = int(two.truth.stamps_ns[0]) + 44 * S  # RTK until then, and none when it speaks again
    hangs = next(f for f in script(two.recording, two.config)[0] if f.name == "GNSS frozen, 30 s")
    during = [
        m
        for m in hangs.on(two.recording, begin_ns, 0).recording.of(GnssPosition)
        if 0 <= m.stamp_ns - begin_ns < 30 * S
    ]
    assert len(during) > 50
    assert len({(m.sensor, m.position) for m in during}) == 1
    assert during[0].sensor == "gnss"
    solution = app.solve(
        hangs.on(two.recording, begin_ns, 0).recording, two.config, app.choose_datum(two.recording, two.config)
    )
    frozen = [row for row in solution.ledger if row.reason.startswith(FROZEN)]
    assert len(frozen) == len(during)  # the next fix, which shows it, is without RTK
    assert any(line.startswith("gnss: for ") and FROZEN in line for line in solution.stats.warnings)


def test_it_is_one_receiver_to_a_filter() -> None:
    """Its slow error is shared by all fixes of a second, and after ten seconds of refusals any is taken."""
    one, two = receiver(comes_and_goes, lambda t: (0.0, 0.0) if comes_and_goes(t) else (4.0, 0.0))
    datum = app.choose_datum(one.recording, one.config)
    tracks = [run_honest(run.recording, run.config, datum).trajectory for run in (one, two)]
    np.testing.assert_array_equal(tracks[1].p_world_m, tracks[0].p_world_m)
    np.testing.assert_array_equal(tracks[1].cov, tracks[0].cov)


def elsewhere(run: SimulatedRun, **gnss: Any) -> SimulatedRun:
    """Its antenna is taken to sit 1 m ahead of where it does, which is to be found with the run."""
    receivers = run.config.of_kind("gnss")
    mount = receivers["gnss"].mount.model_copy(update={"xyz_m": (1.0, 0.0, 0.0)})
    unknown = {"mount": mount, "mount_sigma_m": 1.0, "stamp_sigma_s": 0.05, **gnss}
    changed = {name: block.model_copy(update=unknown) for name, block in receivers.items()}
    return replace(run, config=run.config.with_sensors(changed))


@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_it_has_one_antenna_and_one_clock(solve: Callable[[Recording, VesselConfig], app.Run]) -> None:
    """Found by what tells it, the fixes of RTK, it is known of the others as well; and it is said once."""
    _, two = receiver(comes_and_goes, lambda t: (0.0, 0.0) if comes_and_goes(t) else (2.0, -1.0), LONGER)
    run = solve(two.recording, elsewhere(two, mount_sigma_m=0.25).config)
    found = run.solution
    off_m, other_m = (found.antennas_off_m[name] for name in ("gnss", "gnss_other"))
    assert off_m[0] == pytest.approx(-1.0, abs=0.2)
    np.testing.assert_array_equal(other_m, off_m)
    lines = [w for w in (*found.stats.warnings, *found.stats.events) if "mount.xyz_m[0]" in w]
    assert len({line.partition("gnss")[2] for line in lines}) == 1, lines
    unmeasured = replace(run, recording=replace(run.recording, truth=None))
    reasons = verdict(app.report_data(unmeasured)).reasons
    told = [reason.text for reason in reasons if "Where the antenna of" in reason.text]
    assert len(told) == (1 if found.stats.online else 0)
    if run.calibration is not None:
        keys = [c.key for c in run.calibration.checks] + [s.key for s in run.calibration.suggestions]
        of = {key.split(".")[1] for key in keys}
        assert "gnss" in of
        assert "gnss_other" not in of
        (said,) = (s for s in run.calibration.suggestions if s.key == "sensors.gnss.mount.xyz_m[0]")
        assert "also of gnss_other" in said.action


def shared_with(name: str, config: VesselConfig) -> int | None:
    return shared_constants(name, config, rows_of(config, SENSORS))[1]


def test_parts_that_are_set_otherwise_have_constants_of_their_own() -> None:
    _, two = receiver(comes_and_goes, lambda _t: (0.0, 0.0))
    config = elsewhere(two).config
    assert shared_with("gnss_other", config) == list(config.sensors).index("gnss")
    assert shared_with("gnss", config) is None
    measured = config.sensors["gnss"].model_copy(update={"mount_sigma_m": 0.0})
    assert shared_with("gnss_other", config.with_sensors({"gnss": measured})) is None
    stern = {f"{name}_stern": config.sensors[name] for name in ("gnss", "gnss_other")}
    unclear = config.with_sensors(stern)  # of the same topic, or of none: two antennas are not one
    assert {shared_with(name, unclear) for name in unclear.of_kind("gnss")} == {None}


def test_online_resumes_with_its_one_antenna(tmp_path: Path) -> None:
    """What is known of it stands once in the snapshot, and holds for both."""
    short = replace(TRACK, duration_s=44.0)
    _, two = receiver(comes_and_goes, lambda t: (0.0, 0.0) if comes_and_goes(t) else (2.0, -1.0), short)
    config = elsewhere(two).config
    run = replace(two, config=config)
    came, path = arrivals_of(run), tmp_path / "snapshot.json"
    known, events = list[Any](), list[str]()
    for part in np.array_split(np.arange(len(came)), 2):
        events += feed(smoother(run, snapshot=path), run, came[part[0] : part[-1] + 1]).events
        known += [(name, number) for name, number, _ in json.loads(path.read_text())["anchor"]["constants"]]
    assert known == [("gnss", 0)] * 2
    assert any(event.startswith("resumed from a snapshot") for event in events)


def test_one_receiver_is_one_witness_against_another() -> None:
    """Which of two receivers is wrong is not told by one of them because it has RTK at times."""
    _, two = receiver(comes_and_goes, lambda _t: (0.0, 0.0))
    run = app.smooth_recording(two.recording, two.config)
    far = [
        replace(
            m, sensor="stern", seq=90_000 + k, position=m.position._replace(latitude_deg=m.position.latitude_deg + 1e-3)
        )
        for k, m in enumerate(two.recording.of(GnssPosition, "gnss"))
    ]
    stern = two.config.sensors["gnss"].model_copy(update={"fixes": "any", "topic": "/stern"})
    recording = replace(two.recording, measurements=(*two.recording.measurements, *far))
    beside = replace(run, recording=recording, config=two.config.with_sensors({"stern": stern}))
    (said,) = (reason for reason in verdict(app.report_data(beside)).reasons if "of stern" in reason.text)
    assert said.trust is Trust.NO
    assert "this run does not tell which" in said.text


def test_receivers_that_lose_rtk_together_may_be_lost_again_apart() -> None:
    """Both are silent from 10 s to 20 s, and the first one again, so that only its next level ends before the run does."""
    stamps = [[*range(11), *range(20, 31), *range(40, 51)], [*range(11), *range(20, 51)]]
    streams = [
        SimpleNamespace(
            number=n, measurements=[SimpleNamespace(stamp_ns=t * S) for t in own], state=own, anew=np.array(anew)
        )
        for n, (own, anew) in enumerate(zip(stamps, ([10, 30], [10]), strict=True))
    ]
    timeline = SimpleNamespace(slow_of=np.arange(51))
    case: Any = SimpleNamespace(
        streams=streams, problem=SimpleNamespace(timeline=timeline), levels=lambda _span: [np.ones(3)]
    )
    spans = _drawn_anew(case)
    assert sorted((span.of, span.gap_ns[0] // S, span.until_ns) for span in spans if span.of == 0) == [
        (0, 10, 30 * S),
        (0, 30, None),
    ]
    assert [(span.gap_ns, span.until_ns) for span in spans if span.of == 1] == [((10 * S, 20 * S), None)]


def test_rtk_that_is_back_for_one_fix_a_little_before_the_state_it_is_carried_to() -> None:
    """Errors that change every 20 s: that state is the first after 20 s, the fix came 40 ms earlier, and no later one."""
    stamps = [SimpleNamespace(stamp_ns=t * S // 100) for t in (0, 500, 1000, 1996)]
    stream = SimpleNamespace(number=0, measurements=stamps, state=[0, 50, 100, 200], anew=np.array([0]))
    timeline = SimpleNamespace(slow_of=np.repeat([0, 1], [200, 1]), slow_stamps_ns=np.array([0, 20 * S]))
    case: Any = SimpleNamespace(
        streams=[stream], problem=SimpleNamespace(timeline=timeline), levels=lambda _span: [np.ones(3)]
    )
    (span,) = _drawn_anew(case)
    assert span.gap_ns == (10 * S, 1996 * S // 100)


@pytest.mark.parametrize("lost_again", [False, True])
def test_another_level_after_an_outage_bends_the_track_and_steps_the_error(*, lost_again: bool) -> None:
    """Silent from 3 to 8 s, and from 11 to 13 s: bent as the track is, the error jumped at each second, and 4 m were not found.

    All fixes, which are the track less the error, stay met.
    """
    problem = SimpleNamespace(timeline=SimpleNamespace(stamps_ns=np.arange(16) * S, slow_stamps_ns=np.arange(16) * S))
    values = gtsam.Values()
    for k in range(16):
        values.insert(keys.pose(k), gtsam.Pose3())
        values.insert(keys.slow(0, k), np.zeros(3))
    case: Any = SimpleNamespace(
        streams=[SimpleNamespace(number=0)], problem=problem, settled=SimpleNamespace(values=values)
    )
    back = ((11 * S, 13 * S), (3, 11)) if lost_again else (None, (3,))
    moved = _moved(case, np.array([4.0, 0.0, 0.0]), _Span((3 * S, 8 * S), 8 * S, None, 0, *back))
    track = np.array([moved.atPose3(keys.pose(k)).translation()[0] for k in range(16)])
    error = np.array([moved.atVector(keys.slow(0, k))[0] for k in range(16)])
    assert np.flatnonzero(np.diff(error)).tolist() == list(back[1])
    np.testing.assert_allclose(track[3:9], np.arange(6) * 0.8)
    silent = [4, 5, 6, 7, *([12] if lost_again else [])]
    np.testing.assert_allclose(np.delete(track - error, silent), 0.0, atol=1e-12)
