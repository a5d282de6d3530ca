"""A recording through the online mode: order of arrival, matches made under way, a run folder like any other."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from graphloc import app
from graphloc.cli import app as cli
from graphloc.errors import SolveError
from graphloc.estimate import Event
from graphloc.eval.metrics import compare_to_truth
from graphloc.eval.simulate import Scenario, SimulatedRun, bl_scenario, simulate
from graphloc.gather import Gathering, _live, with_busy_warning
from graphloc.ledger import LedgerRow, Outcome
from graphloc.measurements import GnssPosition, ImuSample, PoseFix
from graphloc.replay import Replayed, _timed, arrivals, replay
from graphloc.solution import Cause, HealthReason
from tests.slowly import simulate_slowly


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    scenario = replace(bl_scenario(1, "drift"), duration_s=20.0, imu_hz=50.0, gnss_hz=5.0)
    return simulate_slowly(scenario, 4, 5.0)


@pytest.fixture(scope="module")
def whole(run: SimulatedRun) -> Replayed:
    return replay(run.recording, run.config)


def test_messages_come_in_the_order_of_the_log(scanned_bag: Path) -> None:
    """Those of a bag by their number, whatever their stamps; and all of them, once."""
    recording, _ = app.load([scanned_bag / "run"], scanned_bag / "vessel.yaml")
    fixes = recording.of(GnssPosition)
    late = replace(fixes[10], stamp_ns=fixes[10].stamp_ns - 3_000_000_000)  # came when it came, says another time
    changed = replace(recording, measurements=tuple(late if m is fixes[10] else m for m in recording.measurements))
    order = [m.seq for m in arrivals(changed)]
    assert order == sorted(order)
    assert recording.imu is not None
    every = [*recording.imu.seqs.tolist(), *(m.seq for m in recording.measurements if m.seq >= 0)]
    assert sorted(order) == sorted(every)


def test_what_a_front_end_made_comes_when_the_imu_is_there(run: SimulatedRun) -> None:
    """Its number says when it was made, after the bag was read: not when the vessel had it."""
    names = {m.sensor for m in run.recording.measurements if not isinstance(m, GnssPosition)}
    made = replace(run.recording, source="a.bag", topics={**run.recording.topics, **dict.fromkeys(names, "(made)")})
    newest_ns = 0
    waited = 0
    for m in arrivals(made):
        if isinstance(m, ImuSample):
            newest_ns = m.stamp_ns
        elif m.sensor in names:
            assert m.stamp_ns <= newest_ns or newest_ns == int(run.recording.imu.stamps_ns[-1])  # type: ignore[union-attr]
            waited += 1
    assert waited > 100


def test_each_pose_is_as_it_was_known_then(run: SimulatedRun, whole: Replayed) -> None:
    """What comes later changes nothing of what was said before; and each message has one row."""
    imu = run.recording.imu
    assert imu is not None
    half_ns = int(imu.stamps_ns[len(imu) // 2])
    n = int(np.searchsorted(imu.stamps_ns, half_ns))
    first = replay(
        replace(
            run.recording,
            imu=imu.where(slice(n)),
            measurements=tuple(m for m in run.recording.measurements if m.stamp_ns < half_ns),
        ),
        run.config,
    )  # fmt: skip
    a, b = first.solution.trajectory, whole.solution.trajectory
    np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns[: len(a)])
    np.testing.assert_allclose(a.p_world_m, b.p_world_m[: len(a)], atol=1e-9)
    assert compare_to_truth(b, run.truth).position_rmse_m < 0.6
    rows = Counter(row.seq for row in whole.solution.ledger if row.seq >= 0)
    assert set(rows.values()) == {1}
    assert len(whole.solution.ledger) == run.recording.message_count or len(rows) == len(imu) + sum(
        m.seq >= 0 for m in run.recording.measurements
    )


@pytest.mark.usefixtures("map_alone")
def test_scans_are_matched_around_its_own_prediction(scanned_bag: Path, tmp_path: Path) -> None:
    """From a bag to a run folder; no match is made before there is a pose, and each turn that is refused says why."""
    done = CliRunner().invoke(
        cli,
        [
            "replay",
            str(scanned_bag / "run"),
            "-c",
            str(scanned_bag / "vessel.yaml"),
            "-o",
            str(tmp_path / "out"),
            "--json",
        ],
    )
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout[: done.stdout.rindex("}") + 1])
    assert told["Against truth"]["graphloc online"]["position_rmse_m"] < 0.8
    assert told["verdict"]["graphloc online"]["said"] in ("can be trusted", "use with care", "do not rely on it")
    aerial = told["ledger"]["aerial"]
    assert aerial["used"] > 5
    text = (tmp_path / "out/ledger.csv").read_text()
    assert "there was no estimate to match around" in text
    assert (tmp_path / "out/report.html").stat().st_size > 10_000
    assert (tmp_path / "out/solution.tum").read_text().count("\n") > 25


def test_a_run_that_never_starts_says_what_it_waited_for(run: SimulatedRun) -> None:
    without = run.recording.where(lambda m: not isinstance(m, GnssPosition))
    alone = without.where(lambda m: m.sensor == "compass")
    with pytest.raises(SolveError, match="waiting for a position"):
        replay(alone, run.config)


def test_a_run_without_a_usable_fix_says_what_became_of_them(run: SimulatedRun) -> None:
    """`smooth` said that the map grid is not named; `replay` of the same bag, only that it waited for three fixes."""
    why = "a position in a map grid: set grid to its name"
    lost = [
        LedgerRow(seq=m.seq, stamp_ns=m.stamp_ns, sensor=m.sensor, topic="/utm", outcome=Outcome.MALFORMED, reason=why)
        for m in run.recording.of(GnssPosition)
    ]
    without = run.recording.where(lambda m: not isinstance(m, (GnssPosition, PoseFix)))
    without = replace(without, rows=(*without.rows, *lost))
    config = run.config.model_copy(
        update={
            "datum": None,
            "truth_topic": None,
            "sensors": {n: s for n, s in run.config.sensors.items() if s.kind in ("imu", "gnss", "compass")},
        }
    )
    with pytest.raises(SolveError, match=f"waiting for .*fixes.*: {len(lost)} messages of gnss: {why}"):
        replay(without, config)


def test_ctrl_c_keeps_what_there_is(run: SimulatedRun) -> None:
    def status(at_s: float, *_: object) -> None:
        if at_s > 9.0:
            raise KeyboardInterrupt

    found = replay(run.recording, run.config, stoppable=True, status=status)
    stamps = found.solution.trajectory.stamps_ns
    assert 8.5 < (stamps[-1] - int(run.truth.stamps_ns[0])) / 1e9 < 9.5
    assert any("interrupted at 9" in line for line in found.solution.stats.warnings)
    assert run.recording.imu is not None
    every = sorted([m.seq for m in run.recording.measurements if m.seq >= 0] + run.recording.imu.seqs.tolist())
    assert sorted(row.seq for row in found.solution.ledger if row.seq >= 0) == every


def test_ctrl_c_before_the_start_is_said_to_be_that(run: SimulatedRun) -> None:
    def status(*_: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):  # not that it never started
        replay(run.recording, run.config, stoppable=True, status=status)


def test_compare_has_it_beside_the_filters(run: SimulatedRun) -> None:
    compared = app.simulated(run, compare=True)
    names = [f.name for f in compared.filters]
    assert names[0] == "graphloc online"
    assert "BL EKF" in names
    table = next(t for t in app.tables(compared) if t.title == "Against truth").as_dict()
    offline, online = (table[name]["position_rmse_m"] for name in ("graphloc", "graphloc online"))
    assert offline is not None
    assert online is not None
    assert offline <= online + 0.05
    assert (
        compared.online is not None
    )  # whose first pose is seconds after the offline one; so are the times of its events
    after_s = (compared.online.trajectory.stamps_ns[0] - compared.solution.trajectory.stamps_ns[0]) / 1e9
    assert after_s > 4.0
    assert any(line.startswith(f"at {after_s:.0f} s: started") for line in compared.online.stats.events)


def test_a_guessed_heading_is_reported_with_its_times(whole: Replayed) -> None:
    """Doubted in the first 26 of the estimates, 5 a second: for 5 s."""
    estimates = whole.estimates
    doubt = "the heading is a guess: 2 candidates explain the motion so far"
    first_ns = estimates[0].stamp_ns
    guessed = HealthReason(f"95 % bound 3 m; {doubt}", Cause.GUESSED_HEADING)
    some = [replace(e, reason=guessed if k <= 25 else HealthReason()) for k, e in enumerate(estimates)]
    (said,) = _timed([(first_ns, Event(doubt, heading_guessed=True))], some)
    assert said.text.startswith(f"at 0 s: {doubt}; it stays so until 5 s (5 s) and is not rated good")
    assert "start.heading_deg" in said.text
    every = [replace(e, reason=guessed) for e in estimates]
    assert "to the end of the run" in _timed([(first_ns, Event(doubt, heading_guessed=True))], every)[0].text
    again_ns = first_ns + 3_000_000_000  # restarted, with a guess of its own
    first, second = _timed([(ns, Event(doubt, heading_guessed=True)) for ns in (first_ns, again_ns)], some)
    assert "until 3 s (3 s)" in first.text
    assert "until 5 s (2 s)" in second.text
    assert _timed([(first_ns + 2_000_000_000, Event("rebuilt"))], some) == [Event("at 2 s: rebuilt")]
    early_ns = first_ns - 7_000_000_000  # times count from there, and how long it stays so from the first pose
    (said,) = _timed([(first_ns - 10, Event(doubt, heading_guessed=True))], some, early_ns)
    assert said.text.startswith(f"at 7 s: {doubt}; it stays so until 12 s (5 s) and is not rated good")


def test_the_start_is_told_but_no_warning(whole: Replayed) -> None:
    stats = whole.solution.stats
    for routine in ("started at", "time per update"):
        assert any(routine in line for line in stats.events)
        assert not any(routine in line for line in stats.warnings)


@pytest.mark.parametrize(("busy", "said"), [(2, False), (5, True)])
def test_scans_that_were_never_tried_are_said_where_they_are_many(busy: int, said: bool) -> None:
    """Of all scans, not of those that gave no match: ten of fifteen or twelve were matched."""
    run = simulate(Scenario(duration_s=10.0, pose_hz=1.0), 0)
    matched = run.recording.of(PoseFix)
    gathering = Gathering(replace(run.recording, measurements=tuple(matched[:10]), rows=()))
    for k in range(busy):
        gathering.refuse("matcher", run.recording.imu.stamps_ns[k], _live._BUSY)  # type: ignore[union-attr]  # noqa: SLF001
    config: Any = SimpleNamespace(of_kind=lambda kind: {"matcher": None} if kind == "aerial" else {})
    warned = with_busy_warning(gathering.recording(), config).warnings
    assert any(f"{busy} scans were never tried" in line for line in warned) is said
