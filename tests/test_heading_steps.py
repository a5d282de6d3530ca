# SPDX-License-Identifier: Apache-2.0
"""Steps of a compass's headings that the gyroscope does not show: iron that is moved on board, a wrong fix of a GNSS compass."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc import app
from graphloc.config import GnssConfig, TimelineConfig, VesselConfig
from graphloc.errors import SolveError
from graphloc.eval.metrics import errors
from graphloc.eval.simulate import Scenario, simulate
from graphloc.factors import INERTIAL, SENSORS
from graphloc.frames import Array, wrap_angle
from graphloc.measurements import CompassHeading
from graphloc.online import OnlineSmoother
from graphloc.recording import Recording
from graphloc.replay import replay
from graphloc.signals.heading_steps import HeadingStepDetector, heading_steps
from graphloc.solution import Health
from graphloc.solve._slow_steps import likelier
from tests.faults import arrivals_of, feed
from tests.slowly import simulate_slowly, with_few_states

AT_S, STEP_RAD = 45.0, np.radians(20.0)
ERRORS: dict[str, Callable[[float], float]] = {  # of the compass, by the time since `AT_S`, s
    "at once": lambda s: STEP_RAD * float(s >= 0.0),
    "damped": lambda s: -STEP_RAD * np.expm1(-max(s, 0.0)),
    "bridge": lambda s: STEP_RAD * np.exp(-0.5 * ((s - 8.0) / 4.0) ** 2),
}


def with_rtk(config: VesselConfig) -> VesselConfig:
    gnss = GnssConfig.model_validate(
        config.sensors["gnss"].model_dump() | {"slow_error": {"horizontal_sigma_m": 0.03, "vertical_sigma_m": 0.03}}
    )
    return config.model_copy(update={"sensors": {**config.sensors, "gnss": gnss}})


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
@pytest.mark.parametrize(
    ("error", "mount_deg"), [*((error, None) for error in ERRORS), ("at once", 0.0)], ids=[*ERRORS, "calibrated"]
)
def test_a_compass_that_steps_does_not_take_the_heading_along(
    online: bool, error: str, mount_deg: float | None
) -> None:
    """Nor where its mount was calibrated: iron may turn it nevertheless."""
    rates: dict[str, Any] = {"imu_hz": 50.0, "gnss_hz": 5.0, "compass_hz": 5.0, "pose_hz": 0.0, "gnss_sigma_m": 0.02}
    path: Any = (
        "entry" if error == "bridge" else "loops"
    )  # of a craft that turns as much all the time it may be a scale of the gyroscope
    run = simulate(Scenario(path=path, duration_s=75.0, noise="clean", **rates), seed=523)
    begin_ns = int(run.truth.stamps_ns[0])

    def turned(m: Any) -> Any:
        if not isinstance(m, CompassHeading):
            return m
        return replace(m, yaw_rad=float(m.yaw_rad + ERRORS[error]((m.stamp_ns - begin_ns) * 1e-9 - AT_S)))

    recording = replace(run.recording, measurements=tuple(map(turned, run.recording.measurements)))
    config = with_rtk(run.config)
    if mount_deg is not None:
        compass = config.sensors["compass"].model_copy(update={"mount_offset_sigma_deg": mount_deg})
        config = config.with_sensors({"compass": compass})
    solution = (replay(recording, config) if online else app.smooth_recording(recording, config)).solution
    track = solution.trajectory
    seen = run.truth.covers(track.stamps_ns) & (track.stamps_ns - begin_ns > 20e9)
    off = wrap_angle(track.yaw_rad[seen] - run.truth.at(track.stamps_ns[seen]).yaw_rad)
    assert np.degrees(np.sqrt(np.mean(off**2))) < 1.5
    assert track.cov is not None
    assert np.mean(np.abs(off) < 2.58 * np.sqrt(track.cov[seen, 5, 5])) > 0.95
    said = (*solution.stats.warnings, *solution.stats.events)
    assert any("compass: heading step of +" in line and "does not show" in line for line in said)
    assert not any("its biases change" in line or "sigmas" in line for line in said)  # nothing else is blamed


def test_offline_the_other_sensors_tell_whether_the_compass_or_the_gyroscope_is_wrong() -> None:
    """Of a gyroscope that shows nothing for 5 s: the compass was blamed, and the run up to 7 m off."""
    rates: dict[str, Any] = {"imu_hz": 50.0, "gnss_hz": 2.0, "compass_hz": 5.0, "pose_hz": 1.0}
    run = simulate(Scenario(path="loops", duration_s=60.0, noise="drift", **rates), seed=50)
    imu = run.recording.imu
    assert imu is not None
    t_s, gyro_radps = (imu.stamps_ns - imu.stamps_ns[0]) * 1e-9, imu.gyro_radps.copy()
    dead = (t_s >= AT_S - 5.0) & (t_s < AT_S)
    gyro_radps[dead] = np.random.default_rng(9).normal(
        0.0, 1e-3, (int(dead.sum()), 3)
    )  # noise, so that it is not frozen
    solution = app.smooth_recording(
        replace(run.recording, imu=replace(imu, gyro_radps=gyro_radps)), with_few_states(run.config, rate_hz=2.5)
    ).solution
    off = errors(solution.trajectory, run.truth)
    assert np.linalg.norm(off.position_m[:, :2], axis=1).max() < 1.5
    assert np.degrees(np.abs(off.heading_rad)).max() < 15.0  # in the gap, while she turns by 60 deg
    assert any("contradicts the other sensors, which agree" in line for line in solution.stats.warnings)
    assert not any("heading step" in line for line in solution.stats.warnings)


@pytest.mark.parametrize(
    ("with_steps", "without", "taken"),
    [
        ((True, 5.0), (True, 6.0), "with"),
        ((True, 6.0), (True, 5.0), "without"),
        ((False, 5.0), (True, 6.0), "without"),  # what has not converged is no solution
        ((True, 6.0), (False, 5.0), "with"),
        ((True, np.nan), (True, 6.0), "without"),
        (None, (True, 6.0), "without"),
    ],
)
def test_of_two_solutions_the_likelier_that_converged_is_taken(
    with_steps: tuple[bool, float] | None, without: tuple[bool, float], taken: str
) -> None:
    def solve(slow_steps: bool) -> Any:
        one = with_steps if slow_steps else without
        if one is None:
            raise SolveError("planted")
        return SimpleNamespace(
            result=SimpleNamespace(converged=one[0]), cost=one[1], name="with" if slow_steps else "without"
        )

    assert cast("Any", likelier(solve)).name == taken


def test_a_compass_that_has_stepped_is_not_off_its_mount_after_a_restart(tmp_path: Path) -> None:
    """By 20 deg: resumed, the estimate was no longer good, as the snapshot had the offset, but not that it came by a step."""
    rates: dict[str, Any] = {"imu_hz": 50.0, "gnss_hz": 2.0, "compass_hz": 5.0, "pose_hz": 0.0, "gnss_sigma_m": 0.02}
    run = simulate_slowly(Scenario(path="loops", duration_s=60.0, noise="clean", **rates), 523)
    begin_ns = int(run.truth.stamps_ns[0])
    came = [
        replace(a, m=replace(a.m, yaw_rad=float(a.m.yaw_rad + STEP_RAD)))
        if isinstance(a.m, CompassHeading) and a.m.stamp_ns - begin_ns > 25e9
        else a
        for a in arrivals_of(run)
    ]
    path, half = tmp_path / "snapshot.json", sum(a.m.stamp_ns - begin_ns < 45e9 for a in came)
    for part in (came[:half], came[half:]):
        fed = feed(OnlineSmoother(with_rtk(run.config), rows=SENSORS, inertial=INERTIAL, snapshot=path), run, part)
        assert fed.estimates[-1].health is Health.GOOD
    assert any(event.startswith("resumed from a snapshot") for event in fed.events)


def test_a_compass_that_has_stepped_is_not_off_its_mount_in_later_legs() -> None:
    """Of a run of more than half an hour, none of these was good."""
    rates: dict[str, Any] = {"imu_hz": 50.0, "gnss_hz": 1.0, "compass_hz": 2.0, "pose_hz": 0.0, "gnss_sigma_m": 0.02}
    run = simulate(Scenario(path="loops", duration_s=300.0, noise="clean", **rates), 523)
    begin_ns = int(run.truth.stamps_ns[0])
    turned = tuple(
        replace(m, yaw_rad=float(m.yaw_rad + STEP_RAD))
        if isinstance(m, CompassHeading) and m.stamp_ns - begin_ns > 40e9
        else m
        for m in run.recording.measurements
    )
    config = with_rtk(run.config).model_copy(update={"timeline": TimelineConfig(rate_hz=1.0, leg_s=100.0)})
    solution = app.smooth_recording(replace(run.recording, measurements=turned), config).solution
    assert any("overlapping legs" in line for line in solution.stats.events)
    assert all(health is Health.GOOD for health in solution.health)


HZ = 5.0
T = np.arange(0.0, 40.0, 1.0 / HZ)
TURNING = np.where(np.abs(T - 20.0) < 5.0, np.radians(12.0), 0.0)  # rad/s, from 15 to 25 s


def steps(
    yaw: Array,
    rate: Array,
    blind: NDArray[np.bool_] | None = None,
    online: bool = False,
    heard: NDArray[np.bool_] | None = None,
) -> list[tuple[float, float]]:
    """Return times, s, and sizes, deg, of the steps of headings `yaw` (N,) beside a gyroscope that shows `rate` (N,).

    Args:
        blind: (N - 1,) in which intervals it shows nothing. heard: (N,) which headings there are.
    """
    there = np.ones(len(T), dtype=bool) if heard is None else heard
    noise = np.random.default_rng(3).normal(0.0, np.radians(0.5), len(T))
    stamps_ns, headings, turned = (T * 1e9).astype(np.int64)[there], (yaw + noise)[there], (np.cumsum(rate) / HZ)[there]
    unseen: NDArray[np.bool_] = np.zeros(len(stamps_ns) - 1, dtype=bool) if blind is None else blind
    sigma = np.radians(1.0)
    if not online:
        found = heading_steps(stamps_ns, headings, turned, np.full(len(stamps_ns), sigma), unseen)
    else:
        detector = HeadingStepDetector()
        for k, stamp_ns in enumerate(stamps_ns.tolist()):
            by_gyro = float(turned[k] - turned[k - 1]) if k > 0 and not unseen[k - 1] else None
            detector.note(stamp_ns, float(headings[k]), by_gyro, sigma)
        found = list(detector.steps)
    return [(step.after_ns * 1e-9, float(np.degrees(step.size_rad))) for step in found]


HEADING = np.cumsum(TURNING) / HZ


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_steps_are_found_where_they_are(online: bool) -> None:
    """One of 20 deg from 8 to 30 s, across a turn, so there and back; with the sign of the headings."""
    there = 20.0 * ((T >= 8.0) & (T < 30.0))
    (first, up), (second, down) = steps(HEADING + np.radians(there), TURNING, online=online)
    assert np.isclose(first, 8.0)
    # Online the second is seen before it is clear that it came at once: the gyroscope has shown a turn by then.
    assert np.isclose(second, 30.0) or (online and 28.0 <= second <= 30.0)
    assert abs(up - 20.0) < 1.0
    assert abs(down + 20.0) < 1.0
    (found,) = steps(
        HEADING + np.radians(20.0 * (1.0 - np.exp(-np.maximum(T - 30.0, 0.0) / 0.8))), TURNING, online=online
    )
    assert (28.0 if online else 29.75) <= found[0] < 31.25


BRIDGE = np.radians(20.0) * np.exp(-0.5 * ((T - 32.0) / 2.5) ** 2)


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_what_goes_and_comes_back_within_seconds_is_a_step(online: bool) -> None:
    """By 20 deg, as under a bridge; once the gyroscope has shown a turn, and not while the craft turns by as much."""
    assert not steps(BRIDGE, np.zeros_like(T), online=online)
    (at_s, size_deg), *more = steps(HEADING + BRIDGE, TURNING, online=online)
    assert 23.0 < at_s < 28.0
    assert 8.0 < abs(size_deg) < 21.0
    assert len(more) < 3
    again = np.where(T > 26.0, TURNING[0] + np.radians(12.0), TURNING)
    assert not steps(np.cumsum(again) / HZ + 0.5 * BRIDGE, again, online=online)


@pytest.mark.parametrize("hz", [1, 5, 10, 20])
@pytest.mark.parametrize("wide_s", [3.0, 4.0, 5.0])
def test_the_way_back_from_under_a_bridge_is_a_part_of_the_step(wide_s: float, hz: int) -> None:
    """It was dropped, as it follows the way there: the offset stayed where the bridge had it, the heading up to 9 deg off online."""
    t = np.arange(0.0, 120.0, 1.0 / hz)
    turned = np.radians(12.0) * np.clip(t - 20.0, 0.0, 10.0)
    error = np.radians(20.0) * np.exp(-0.5 * ((t - 70.0) / wide_s) ** 2)
    heading = turned + error + np.random.default_rng(1).normal(0.0, np.radians(0.5), len(t))
    stamps_ns, sigma, silent = (t * 1e9).astype(np.int64), np.full(len(t), 0.03), np.zeros(len(t) - 1, dtype=bool)
    found = heading_steps(stamps_ns, heading, turned, sigma, silent)
    free = np.any([(stamps_ns >= step.after_ns) & (stamps_ns <= step.until_ns) for step in found], axis=0)
    assert free[np.abs(np.gradient(error, t)) > np.radians(1.0)].all()


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
@pytest.mark.parametrize("times", [-1.0, 0.0, 0.6, 1.4, 57.3])
def test_a_gyroscope_that_is_wrong_makes_no_steps(times: float, online: bool) -> None:
    """It has the wrong sign, shows nothing, is scaled, or is in deg/s: of two turns, so that each has another before or after it."""
    rate = TURNING - np.roll(TURNING, round(12.0 * HZ))
    assert not steps(np.cumsum(rate) / HZ, times * rate, online=online)


@pytest.mark.parametrize("hz", [5, 10, 50])
def test_headings_that_swing_in_a_swell_make_no_steps(hz: int) -> None:
    """By 8 deg within 11 s, as of a compass that is not gimballed: some swings were taken for steps of one that filters."""
    rng, t = np.random.default_rng(0), np.arange(0.0, 600.0, 1.0 / hz)
    turned = np.radians(30.0) * np.sin(t / 40.0)
    heading = turned + np.radians(8.0) * np.sin(2.0 * np.pi * t / 11.0) + rng.normal(0.0, np.radians(1.0), len(t))
    sigma, silent = np.full(len(t), np.radians(2.0)), np.zeros(len(t) - 1, dtype=bool)
    assert not heading_steps((t * 1e9).astype(np.int64), heading, turned, sigma, silent)


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_a_deviation_by_heading_makes_no_steps(online: bool) -> None:
    """15 deg of it, in a full turn."""
    rate = np.where(np.abs(T - 20.0) < 15.0, np.radians(12.0), 0.0)
    heading = np.cumsum(rate) / HZ
    assert not steps(heading + np.radians(15.0) * np.sin(heading + 0.5), rate, online=online)


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_what_is_no_step(online: bool) -> None:
    late = np.interp(T - 0.4, T, HEADING)
    assert not steps(late, TURNING, online=online)  # a compass that lags behind while the craft turns
    assert not steps(
        HEADING, np.zeros_like(T), online=online
    )  # a gyroscope that shows nothing of a turn of 12 deg/s for 10 s
    short = np.where(np.abs(T - 20.0) < 0.65, 0.0, TURNING)
    assert not steps(HEADING, short, online=online)  # or of a second of it
    outliers = np.where(np.isin(np.arange(len(T)), [40, 41, 90, 150]), 1.0, 0.0)
    assert not steps(HEADING + outliers, TURNING, online=online)  # some headings that are 57 deg off
    assert not steps(
        HEADING + np.radians(10.0) * np.clip((T - 5.0) / 30.0, 0.0, 1.0), TURNING, online=online
    )  # a wander
    stepped = HEADING + np.radians(20.0 * (T >= 8.0))
    assert steps(stepped, TURNING, online=online)
    # Where the gyroscope was silent the craft may have turned.
    assert not steps(stepped, TURNING, blind=np.abs(T[1:] - 8.0) < 0.3, online=online)


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_readings_that_are_flipped_are_no_steps_and_hide_none(online: bool) -> None:
    """Two in 25, at times one after the other, as of a GNSS compass with its antennas swapped; 360 deg after one was once a step."""
    flipped: Array = np.where(np.random.default_rng(7).random(len(T)) < 0.08, np.pi, 0.0)
    assert not steps(flipped, np.zeros_like(T), online=online)
    ((at_s, size_deg),) = steps(flipped + np.radians(20.0 * (T >= 20.0)), np.zeros_like(T), online=online)
    assert abs(at_s - 20.0) < 1.1 / HZ  # the reading before it may be flipped
    assert round(size_deg) == 20


@pytest.mark.parametrize("online", [False, True], ids=["offline", "online"])
def test_across_a_silence_of_the_compass_the_gyroscope_may_have_drifted(online: bool) -> None:
    """By 3 deg/s for 5 s."""
    heard = np.abs(T - 20.0) > 2.5
    drifted = np.radians(np.where(T < 20.0, 0.0, 15.0))
    assert not steps(drifted, np.zeros_like(T), online=online, heard=heard)


@pytest.mark.parametrize(("off_deg", "good"), [(25.0, False), (2.0, True)])
@pytest.mark.parametrize("solve", [app.smooth_recording, app.replay_recording], ids=["offline", "online"])
def test_no_pose_is_good_beside_a_compass_that_is_far_off_its_mount(
    solve: Callable[[Recording, VesselConfig], app.Run], off_deg: float, *, good: bool
) -> None:
    """Its mount is wrong, or that of the IMU: then the heading is as wrong as that."""
    rates: dict[str, Any] = {"imu_hz": 50.0, "gnss_hz": 2.0, "compass_hz": 2.0, "pose_hz": 1.0}
    run = simulate(Scenario(path="loops", duration_s=40.0, noise="clean", false_fraction=0.0, **rates), seed=11)
    turned = tuple(
        replace(m, yaw_rad=m.yaw_rad + np.radians(off_deg)) if isinstance(m, CompassHeading) else m
        for m in run.recording.measurements
    )
    solution = solve(replace(run.recording, measurements=turned), with_few_states(run.config, rate_hz=2.5)).solution
    late = slice(-20, None)
    assert all(h is Health.GOOD for h in solution.health[late]) == good
    assert all("off its mount" in why.text for why in solution.health_reason[late]) != good
