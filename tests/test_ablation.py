"""What each sensor bought: numbers by hand, and bad sensors that must show without truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from graphloc import app
from graphloc.ablations import _Job, _smoothed, ablate
from graphloc.blocks import MountConfig
from graphloc.config import GnssConfig, SlowErrorConfig
from graphloc.errors import SolveError
from graphloc.eval import ablation_page as page
from graphloc.eval.ablation import Ablated, Effect, Off, Vote, suspects
from graphloc.eval.consistency import contradiction
from graphloc.eval.holdout import HoldOut
from graphloc.eval.page import Cell, Grid
from graphloc.eval.plots import Line
from graphloc.eval.simulate import Scenario, SimulatedRun
from graphloc.factors import SENSORS
from graphloc.factors.velocity import VelocityConfig
from graphloc.frames import Array, Geodetic
from graphloc.ledger import Outcome
from graphloc.measurements import CompassHeading, GnssPosition, GnssVelocity, PoseFix, PoseMode
from graphloc.solution import Solution
from graphloc.time import stamps_of
from tests.slowly import simulate_slowly

OFF_DEG = 12.0


def made(rate_hz: float = 1.25, **changes: object) -> SimulatedRun:
    base = Scenario(duration_s=18.0, imu_hz=50.0, gnss_hz=2.0, compass_hz=2.0, noise="clean", false_fraction=0.2)
    return simulate_slowly(replace(base, **changes), 4, rate_hz)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def solved() -> tuple[SimulatedRun, Ablated, Solution]:
    """A compass that is 12 deg off, and no truth to tell; what came of it, and of the run with all of its sensors."""
    run, smooth, every = made(2.5, compass_offset_deg=OFF_DEG, path="loops", duration_s=24.0), app.smooth_recording, []

    def kept(*arguments: Any, **options: Any) -> app.Run:
        every.append(smooth(*arguments, **options))
        return every[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(app, "smooth_recording", kept)
        found = ablate(replace(run.recording, truth=None), run.config)
    (whole,) = every  # the others are solved alone
    return run, found, whole.solution


@pytest.fixture(scope="module")
def bad(solved: tuple[SimulatedRun, Ablated, Solution]) -> tuple[SimulatedRun, Ablated]:
    return solved[:2]


@pytest.fixture(scope="module")
def whole(solved: tuple[SimulatedRun, Ablated, Solution]) -> Solution:
    return solved[2]


def of(ablated: Ablated, name: str) -> Effect:
    return next(e for e in ablated.effects if e.without == name)


def test_a_bad_compass_shows_without_truth(bad: tuple[SimulatedRun, Ablated]) -> None:
    """12 deg over the root of its 1.06 deg, the 1 deg that its mount may be off, its deviation, and the heading's own bound."""
    _, found = bad
    compass = of(found, "compass")
    heading_deg = (compass.bound_deg or 0.0) / 1.96
    deviation_deg2 = 1.5**2 + 0.75**2  # B sin + C cos, and D, E likewise, at any heading
    expected = (
        OFF_DEG / np.sqrt(1.5**2 / 2.0 + 1.0 + deviation_deg2 + heading_deg**2) / 0.6745
    )  # the median of |N(0, 1)|
    assert compass.contradiction == pytest.approx(expected, rel=0.1)
    assert compass.apart_deg == pytest.approx(OFF_DEG, abs=1.0)
    assert found.basis == "full"
    assert suspects(found.effects)[0] == "compass"
    text = "\n".join(page.said(found))
    assert "CONTRADICTION: compass" in text
    assert "does not measure accuracy" in text
    assert "Warning: /truth: on another clock" in page.said(replace(found, warnings=("/truth: on another clock",)))
    # the matcher knows the heading, too, and is as far from the compass as that from it: fixes that may drift by 2 m do not tell
    assert "it cannot tell which is wrong" in text
    assert (of(found, "gnss").contradiction or 0.0) < 1.5


def test_of_two_that_contradict_each_other_the_rest_names_the_likelier_culprit() -> None:
    """Fixes good to centimetres that hardly drift know the heading of a vessel that turns to some degrees."""
    run = made(compass_offset_deg=OFF_DEG, path="loops", duration_s=24.0, gnss_sigma_m=0.05)
    steady = run.config.sensors["gnss"].model_copy(
        update={"slow_error": SlowErrorConfig(horizontal_sigma_m=0.1, vertical_sigma_m=0.2)}
    )
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, "gnss": steady}})
    found = ablate(replace(run.recording, truth=None), config)
    assert suspects(found.effects)[0] == "compass"
    assert "compass is the likelier culprit" in "\n".join(page.said(found))


def test_each_sensor_is_left_out_but_the_imu(bad: tuple[SimulatedRun, Ablated]) -> None:
    run, found = bad
    assert {e.without for e in found.effects} == {name for name, s in run.config.sensors.items() if s.enabled}
    assert "every state depends on it" in of(found, "imu").why_not
    assert of(found, "gnss").measurements == sum(isinstance(m, GnssPosition) for m in run.recording.measurements)
    assert of(found, "height").measurements == 0  # the recording has none: the configuration makes it
    assert of(found, "compass").fits.keys() == {"gnss", "matcher", "height"}
    assert of(found, "matcher").bound_m > found.full.bound_m  # type: ignore[operator]
    assert "cannot be left out" in page.grids(found)[0].as_text()


def test_against_truth_the_numbers_are_those_of_a_run_without_it() -> None:
    run = made(compass_hz=0.0, duration_s=12.0)
    found = ablate(run.recording, run.config)
    assert found.basis == "truth"
    gone = run.config.sensors["matcher"].model_copy(update={"enabled": False})
    config = run.config.model_copy(update={"sensors": {**run.config.sensors, "matcher": gone}})
    track = app.smooth_recording(run.recording, config).solution.trajectory
    inside = track.covers(run.truth.stamps_ns)
    stamps = run.truth.stamps_ns[inside]
    away = np.hypot(*(track.at(stamps).p_world_m - run.truth.at(stamps).p_world_m).T[:2])
    effect = of(found, "matcher")
    assert effect.worst_m == pytest.approx(away.max(), rel=0.02)
    assert effect.rmse_m == pytest.approx(np.sqrt(np.mean(away**2)), rel=0.02)
    at_ns = round((effect.worst_at_s or 0.0) * 1e9) + track.stamps_ns[0]
    assert abs(stamps[np.argmax(away)] - at_ns) < 0.2e9


def test_held_out_fixes_stand_in_for_truth_and_what_starts_all_cannot_go(tmp_path: Path) -> None:
    run = made(compass_hz=0.0, pose_hz=0.0, duration_s=10.0)
    recording = replace(run.recording, truth=None)
    found = ablate(recording, run.config, hold_out=HoldOut.parse("every:5"))
    assert found.basis == "held"
    gnss = of(found, "gnss")
    assert gnss.rmse_m is None
    assert gnss.why_not == "no other sensor tells the position"
    page.write(found, tmp_path, "ablate")
    assert "gnss cannot be left out" in (tmp_path / "ablation.html").read_text()
    told = json.loads((tmp_path / "ablation.json").read_text())
    assert told["basis"] == "held"
    assert len((tmp_path / "ablation.csv").read_text().splitlines()) == 1 + len(told["runs"])
    assert "| gnss |" in (tmp_path / "ablation.md").read_text()


@pytest.mark.parametrize("wrapped", [True, False])
def test_whatever_the_solver_says_is_a_row_in_the_users_words(monkeypatch: pytest.MonkeyPatch, wrapped: bool) -> None:
    """What is not ours, and what is ours around the solver's text; an error of our own words is kept."""
    run = made()
    deep = RuntimeError("Indeterminant linear system near variable 8646911284551352320")

    def fails(*_: object, **__: object) -> None:
        if not wrapped:
            raise deep
        raise SolveError(f"the solver failed: {deep}") from deep

    job = _Job(
        recording=run.recording,
        config=run.config,
        datum=app.choose_datum(run.recording, run.config),
        without=("height",),
    )
    monkeypatch.setattr(app, "solve", fails)
    said = _smoothed(job)
    assert isinstance(said, str)
    assert "8646911284551352320" not in said
    assert said.startswith("the remaining sensors do not determine")

    def ours(*_: object, **__: object) -> None:
        raise SolveError("no place: no fix")

    monkeypatch.setattr(app, "solve", ours)
    assert _smoothed(job) == "no place: no fix"


def test_with_one_sensor_alone_there_is_nothing_to_draw(tmp_path: Path) -> None:
    run = made(compass_hz=0.0, pose_hz=0.0)
    alone = {name: s for name, s in run.config.sensors.items() if s.kind in ("imu", "gnss")}
    kept = tuple(m for m in run.recording.measurements if m.sensor in alone)
    config = run.config.model_copy(update={"sensors": alone})
    found = ablate(replace(run.recording, truth=None, measurements=kept), config)
    assert found.basis == "full"
    page.write(found, tmp_path, "ablate")
    text = (tmp_path / "ablation.html").read_text()
    assert "gnss cannot be left out" in text
    assert "Over time" not in text


def test_no_spike_is_lost_over_time(bad: tuple[SimulatedRun, Ablated]) -> None:
    """A run of 50 000 states, one of which is far off."""
    off_m = np.full(50_000, 0.1)
    off_m[33_333] = 7.0
    away = Off(stamps_ns=np.arange(50_000) * 100_000_000, off_m=off_m, off_deg=None)
    (line,) = page.over_time(replace(bad[1], over_time={"gnss": away}, begin_ns=-2_000_000_000)).panels[0].marks
    assert isinstance(line, Line)
    assert line.x[0] == 2.0  # from the begin of the track, as the table's times
    assert len(line.y) < 5_000
    assert max(line.y) == 7.0


def test_a_name_cannot_end_a_cell_or_a_row() -> None:
    grid = Grid(title="t", head=("a", "b"), rows=((Cell(text="x|y\nz"), Cell(text="<i>")),))
    assert "| x\\|y z | <i> |" in grid.as_markdown().splitlines()
    assert "<i>" not in grid.as_html()


def test_a_contradiction_is_of_the_others_and_slow_errors_are_owned_to(
    bad: tuple[SimulatedRun, Ablated], whole: Solution
) -> None:
    """All fixes 8 m east of a 2 m slow error: sqrt of (8^2 / (2^2 + white + bound)), over what chi-square(3) has."""
    run, _ = bad
    datum = whole.datum

    def moved(m: GnssPosition) -> GnssPosition:
        enu = datum.enu_from_geodetic(*(np.array([v]) for v in m.position)) + np.array([8.0, 0.0, 0.0])
        return replace(m, position=type(m.position)(*(float(v[0]) for v in datum.geodetic_from_enu(enu).T)))

    shifted = tuple(moved(m) if isinstance(m, GnssPosition) else m for m in run.recording.measurements)
    found = contradiction(whole, replace(run.recording, measurements=shifted), run.config, "gnss", SENSORS)
    assert found is not None
    assert found.apart_m == pytest.approx(8.0, abs=0.4)
    sigma2 = 2.0**2 + 0.045 + np.median(whole.trajectory.cov[:, 0, 0])  # type: ignore[index]
    assert found.sigmas == pytest.approx(np.sqrt(8.0**2 / sigma2 / 2.366), rel=0.1)
    few = replace(run.recording, measurements=tuple(m for m in shifted if isinstance(m, CompassHeading))[:4])
    assert contradiction(whole, few, run.config, "compass", SENSORS) is None


def stated(solution: Solution, variances: tuple[float, ...]) -> Solution:
    """The solution with another covariance of its pose, along the world's axes."""
    track = solution.trajectory
    cov = np.tile(np.diag(variances), (len(track), 1, 1))
    return replace(solution, trajectory=replace(track, cov=cov))


def test_what_the_solution_knows_counts_along_the_worlds_axes(
    bad: tuple[SimulatedRun, Ablated], whole: Solution
) -> None:
    """Matches 3 m east of a track, which is known to 3 m east and to 1 cm north, while it turns."""
    run, _ = bad
    sensor = "matcher"
    own = run.recording.of(PoseFix, sensor)
    there = whole.trajectory.at(stamps_of(own))
    yaw = there.yaw_rad
    assert np.ptp(np.unwrap(yaw)) > 1.0
    cov = np.diag([0.01, 0.01, 1e-4])
    values = np.column_stack([there.p_world_m[:, 0] + 3.0, there.p_world_m[:, 1], yaw])
    moved = [replace(m, modes=(PoseMode(value=v, cov=cov, probability=1.0),)) for m, v in zip(own, values, strict=True)]
    config = run.config.model_copy(
        update={"sensors": {sensor: run.config.sensors[sensor].model_copy(update={"false_fraction": 0.0})}}
    )
    recording = replace(run.recording, measurements=tuple(moved))
    found = contradiction(stated(whole, (9.0, 1e-4, 1e-4, 1e-8, 1e-8, 1e-8)), recording, config, sensor, SENSORS)
    assert found is not None
    assert found.sigmas == pytest.approx(3.0 / np.sqrt((9.0 + 0.01) * chi2.median(3)), rel=0.02)


def test_the_false_ones_that_a_sensor_owns_to_do_not_count(bad: tuple[SimulatedRun, Ablated], whole: Solution) -> None:
    """Two of five are 40 m off: with a share of 0.4, the rest alone is judged."""
    run, _ = bad
    own = run.recording.of(PoseFix)
    there = whole.trajectory.at(stamps_of(own))
    rng = np.random.default_rng(1)
    right = np.column_stack([there.p_world_m[:, :2], there.yaw_rad]) + rng.normal(size=(len(own), 3)) * [0.1, 0.1, 0.01]
    wrong = np.arange(len(own)) % 5 < 2
    cov = np.diag([0.01, 0.01, 1e-4])

    def sigmas(values: Array, share: float, kept: NDArray[np.bool_]) -> float:
        made = [
            replace(m, modes=(PoseMode(value=v, cov=cov, probability=1.0),))
            for m, v, k in zip(own, values, kept, strict=True)
            if k
        ]
        matcher = run.config.sensors["matcher"].model_copy(update={"false_fraction": share})
        config = run.config.model_copy(update={"sensors": {"matcher": matcher}})
        recording = replace(run.recording, measurements=tuple(made))
        sure = stated(whole, (1e-8,) * 6)
        found = contradiction(sure, recording, config, "matcher", SENSORS)
        assert found is not None
        return found.sigmas

    alone = sigmas(right, 0.0, ~wrong)
    assert alone == pytest.approx(1.0, rel=0.35)
    assert sigmas(right + wrong[:, None] * [40.0, 0.0, 0.0], 0.4, wrong | True) == pytest.approx(alone, rel=0.1)


def test_a_velocity_counts_what_the_solution_knows_of_velocity(
    bad: tuple[SimulatedRun, Ablated], whole: Solution
) -> None:
    """Velocities 2 m/s off to the north, where the solution knows its own to 1 m/s."""
    run, _ = bad
    config = run.config.model_copy(update={"sensors": {"v": VelocityConfig(kind="gnss_velocity")}})
    track = whole.trajectory
    assert track.v_world_mps is not None
    made = tuple(
        GnssVelocity(
            stamp_ns=int(s), sensor="v", seq=k, v_enu_mps=v + np.array([0.0, 2.0, 0.0]), cov_m2ps2=np.eye(3) * 0.25
        )
        for k, (s, v) in enumerate(zip(track.stamps_ns[5:-5], track.v_world_mps[5:-5], strict=True))
    )
    known = replace(whole, v_cov=np.tile(np.eye(3), (len(track), 1, 1)))
    found = contradiction(known, replace(run.recording, measurements=made), config, "v", SENSORS)
    assert found is not None
    assert found.sigmas == pytest.approx(2.0 / np.sqrt((1.0 + 0.25) * chi2.median(3)), rel=0.02)


def test_an_antenna_within_what_its_mount_is_known_to_is_no_contradiction(
    bad: tuple[SimulatedRun, Ablated], whole: Solution
) -> None:
    """Fixes of an antenna 3 m ahead of where it is configured, in axes that are turned in body: 3 m over its 2 m, not over the noise."""
    run, _ = bad
    track = whole.trajectory
    mount = MountConfig(xyz_m=(0.0, 0.0, 0.0), rpy_deg=(10.0, 20.0, 90.0))
    p_m = track.p_world_m + track.R_world_body @ np.array([3.0, 0.0, 0.0])
    fixes = tuple(
        GnssPosition(
            stamp_ns=int(s),
            sensor="g",
            seq=k,
            position=Geodetic(*whole.datum.geodetic_from_enu(p)[0]),
            cov_enu_m2=np.eye(3) * 1e-4,
        )
        for k, (s, p) in enumerate(zip(track.stamps_ns[5:-5], p_m[5:-5], strict=True))
    )
    sure = stated(whole, (1e-8,) * 6)
    for mount_sigma_m in (0.0, 2.0):
        config = run.config.model_copy(
            update={
                "sensors": {
                    "g": GnssConfig(
                        kind="gnss", mount=mount, mount_sigma_m=mount_sigma_m, slow_error=SlowErrorConfig(enabled=False),
                        min_horizontal_sigma_m=0.01, min_vertical_sigma_m=0.01,
                    )
                }
            }
        )  # fmt: skip
        found = contradiction(sure, replace(run.recording, measurements=fixes), config, "g", SENSORS)
        assert found is not None
        assert found.sigmas == pytest.approx(3.0 / np.sqrt((mount_sigma_m**2 + 1e-4) * chi2.median(3)), rel=0.02)


def test_velocities_as_late_as_their_stamps_may_be_are_no_contradiction(
    bad: tuple[SimulatedRun, Ablated], whole: Solution
) -> None:
    """A circle of 5 m in 10 s, antenna 4 m ahead, all stamps 0.4 s late of 0.2: the antenna's acceleration over 0.2 s, not over the noise."""
    run, _ = bad
    track, rate, late_s = whole.trajectory, 2.0 * np.pi / 10.0, 0.4
    angle = rate * (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    out = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(track))])
    along = np.column_stack([-np.sin(angle), np.cos(angle), np.zeros(len(track))])
    R = np.stack([along, -out, np.tile([0.0, 0.0, 1.0], (len(track), 1))], axis=2)
    turning = replace(
        stated(whole, (1e-8,) * 6),
        trajectory=replace(
            stated(whole, (1e-8,) * 6).trajectory, p_world_m=5.0 * out, R_world_body=R, v_world_mps=5.0 * rate * along
        ),
        v_cov=np.tile(np.eye(3) * 1e-8, (len(track), 1, 1)),
        gyro_radps=np.tile([0.0, 0.0, rate], (len(track), 1)),
    )
    antenna_mps = 5.0 * rate * along - 4.0 * rate * out  # w x (4 m along)
    a_mps2 = -5.0 * rate**2 * out - 4.0 * rate**2 * along
    made = tuple(
        GnssVelocity(stamp_ns=int(s), sensor="v", seq=k, v_enu_mps=v, cov_m2ps2=np.eye(3) * 0.01)
        for k, (s, v) in enumerate(zip(track.stamps_ns[5:-5], (antenna_mps + late_s * a_mps2)[5:-5], strict=True))
    )
    for stamp_sigma_s in (0.0, 0.2):
        v = VelocityConfig(
            kind="gnss_velocity",
            mount=MountConfig(xyz_m=(4.0, 0.0, 0.0)),
            stamp_sigma_s=stamp_sigma_s,
            wander_sigma_mps=0.0,
        )
        config = run.config.model_copy(update={"sensors": {"v": v}})
        found = contradiction(turning, replace(run.recording, measurements=made), config, "v", SENSORS)
        assert found is not None
        off_mps = late_s * np.linalg.norm(a_mps2[0])
        sigma2 = 0.01 + (stamp_sigma_s * np.linalg.norm(a_mps2[0])) ** 2
        assert found.sigmas == pytest.approx(off_mps / np.sqrt(sigma2 * chi2.median(3)), rel=0.03)


def test_effects_and_fits_are_those_of_the_solution(bad: tuple[SimulatedRun, Ablated], whole: Solution) -> None:
    _, found = bad
    cov = whole.trajectory.cov
    assert cov is not None
    full = found.full
    assert full.bound_deg == pytest.approx(np.degrees(1.96 * np.sqrt(np.median(cov[:, 5, 5]))), rel=0.02)
    assert full.bound_m == pytest.approx(np.median(np.sqrt(5.991 * np.linalg.eigvalsh(cov[:, :2, :2])[:, 1])), rel=0.02)
    assert full.cost_ratio == pytest.approx(whole.stats.cost / whole.stats.expected_cost, rel=0.02)
    assert full.missing == 0.0
    used = [r for r in whole.ledger if r.sensor == "gnss" and r.outcome is Outcome.USED]
    size = np.sqrt(np.median([r.nis for r in used if r.nis is not None]))
    assert full.fits["gnss"] == pytest.approx(size / np.sqrt(chi2.median(3)), rel=0.02)


def test_what_is_left_votes_between_two_suspects(bad: tuple[SimulatedRun, Ablated]) -> None:
    _, found = bad
    for one_off, other_off, said in (
        (6.0, 0.9, "a is the likelier culprit"),
        (0.9, 6.0, "b is the likelier culprit"),
        (1.0, 1.1, "cannot tell which"),
        (0.2, 1.7, "leans against b"),
        (5.0, 4.0, "both are suspect"),
        (None, None, "nothing tells which"),
    ):
        voted = replace(found, votes=(Vote(one="a", other="b", one_off=one_off, other_off=other_off),))
        assert said in "\n".join(page.said(voted))
