# SPDX-License-Identifier: Apache-2.0
"""A receiver that says one place, or one but for noise, while the vessel goes on: told from one at rest, and not believed."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc import app
from graphloc.eval.simulate import Scenario
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends.inspect import inspect_bag, render
from graphloc.ledger import Outcome
from graphloc.measurements import GnssPosition, PoseFix
from graphloc.online._repeated_fix import RepeatedFixDetector
from graphloc.online._repeated_velocity import RepeatedVelocityDetector
from graphloc.signals.frozen_receiver import frozen_fixes, frozen_velocities
from graphloc.signals.series import line_fit
from tests.bagfactory import START_NS, Item, Messages, S, write_bag
from tests.slowly import simulate_slowly

DATUM = Datum(Geodetic(57.7, 11.9, 40.0))
Way = Callable[[Array], Array]


def said(way: Way, held_s: tuple[float, float], hz: float, noise_m: float) -> tuple[Array, Array, Array]:
    """Times (N,) s, latitudes and longitudes (N, 2), places (N, 2) m of a receiver that says one place in `held_s`."""
    t = np.arange(0.0, 60.0, 1.0 / hz)
    x = way(t)
    p = np.column_stack([x, 0.3 * x, 0.0 * x]) / np.hypot(1.0, 0.3)
    p[:, :2] += noise_m * np.random.default_rng(4).normal(size=(len(t), 2))
    held = np.flatnonzero((t >= held_s[0]) & (t < held_s[1]))
    p[held] = p[held[0]]
    return t, DATUM.geodetic_from_enu(p)[:, :2], p[:, :2]


def judged(way: Way, held_s: tuple[float, float], hz: float, noise_m: float) -> Array:
    t, lat_lon, p = said(way, held_s, hz, noise_m)
    return t[frozen_fixes(START_NS + np.round(t * S).astype(np.int64), lat_lon, p)]


def at(speed_mps: float) -> Way:
    return lambda t: speed_mps * t


@pytest.mark.parametrize(
    ("speed_mps", "held_s", "hz", "noise_m"),
    [
        (2.0, (20.0, 40.0), 1.0, 0.2),
        (2.0, (20.0, 40.0), 10.0, 0.3),
        (1.0, (20.0, 26.0), 5.0, 0.05),
        (15.0, (20.0, 24.0), 1.0, 1.0),
        (3.0, (30.0, 60.0), 5.0, 0.1),  # to the end: it stood from one fix to the next
        (8.0, (30.0, 60.0), 1.0, 0.3),
    ],
)
def test_all_but_the_first_fix_of_a_frozen_receiver_are_rejected(
    speed_mps: float, held_s: tuple[float, float], hz: float, noise_m: float
) -> None:
    found = judged(at(speed_mps), held_s, hz, noise_m)
    assert found[0] == pytest.approx(held_s[0] + 1.0 / hz)
    assert len(found) == round((held_s[1] - held_s[0]) * hz) - 1


@pytest.mark.parametrize("hz", [1.0, 5.0])
def test_one_whose_vessel_has_turned_back_meanwhile_is_frozen(hz: float) -> None:
    """Where it goes on, 60 m away, is less than half of the way at the speed before."""
    found = judged(lambda t: 10.0 * (np.minimum(t, 38.0) - np.maximum(t - 38.0, 0.0)), (20.0, 50.0), hz, 0.1)
    assert len(found) == round(30.0 * hz) - 1


@pytest.mark.parametrize("hz", [1.0, 5.0])
@pytest.mark.parametrize("scatters", [True, False])
def test_one_that_scatters_at_rest_does_not_repeat_there(hz: float, *, scatters: bool) -> None:
    """A slow ferry: at 0.6 m/s its fixes do not tell that it is under way. Its receiver may hold where it does so at rest."""

    def way(t: Array) -> Array:
        return 0.6 * np.maximum(t - 15.0, 0.0)

    t, lat_lon, p = said(way, (40.0, 52.0), hz, 0.3)
    if not scatters:
        lat_lon[t < 15.0] = lat_lon[0]
        p[t < 15.0] = p[0]
    stamps_ns = START_NS + np.round(t * S).astype(np.int64)
    frozen = t[(t > 40.0) & (t < 52.0) & scatters]
    assert t[frozen_fixes(stamps_ns, lat_lon, p)] == pytest.approx(frozen)
    for speed_mps in (0.0, 0.6):  # the fixes have drawn the estimate to rest, or not
        online = RepeatedFixDetector()
        for stamp_ns, place in zip(stamps_ns.tolist(), p, strict=True):
            online.note(stamp_ns, place, np.array([speed_mps * bool(stamp_ns > stamps_ns[0] + 16 * S), 0.0]), 0.15)
        old = [online.is_old(stamp_ns, place) for stamp_ns, place in zip(stamps_ns.tolist(), p, strict=True)]
        assert t[old] == pytest.approx(frozen)


@pytest.mark.parametrize(("hz", "noise_m"), [(1.0, 0.02), (5.0, 0.1)])
def test_one_that_freezes_in_a_turn_is_frozen(hz: float, noise_m: float) -> None:
    """At 6 m/s on a circle of 12 m: its fixes are no line. It goes on at the other side."""
    t = np.arange(0.0, 60.0, 1.0 / hz)
    told = np.where((t >= 20.0) & (t < 26.0), 20.0, t)
    places = 12.0 * np.column_stack([np.cos(told / 2.0), np.sin(told / 2.0)])
    noise = noise_m * np.random.default_rng(3).normal(size=places.shape)
    noise[told == 20.0] = noise[np.argmax(told == 20.0)]
    bad = frozen_fixes(START_NS + np.round(t * S).astype(np.int64), places + noise, places + noise)
    assert np.array_equal(np.flatnonzero(bad), np.flatnonzero((t > 20.0) & (t < 26.0)))


@pytest.mark.parametrize(
    ("way", "held_s", "hz"),
    [
        (lambda t: 2.0 * np.minimum(t, 20.0), (20.5, 60.0), 5.0),  # stops, with a receiver that holds at rest
        (lambda t: 2.0 * (np.minimum(t, 20.0) + np.maximum(t - 40.0, 0.0)), (20.5, 40.0), 5.0),  # and goes on
        (lambda t: 0.0 * t, (10.0, 60.0), 1.0),
        (lambda t: 12.0 * (t > 40.0), (10.0, 40.0), 1.0),  # at rest, and then multipath jumps
        (lambda t: rests(2.0, t) + 21.0 * (t >= 58.0), (20.0, 58.0), 1.0),
        (lambda t: rests(3.0, t) + 25.0 * (t >= 50.0), (20.0, 50.0), 5.0),
        (lambda t: 10.0 * np.minimum(t, 20.0) - 1.5 * np.clip(t - 17.0, 0.0, 3.0) ** 2, (20.0, 60.0), 1.0),  # brakes
        (lambda t: 12.0 * np.minimum(t, 20.0) - 2.0 * np.clip(t - 17.0, 0.0, 3.0) ** 2, (20.0, 60.0), 5.0),
        (lambda t: np.minimum(t, 20.0), (20.2, 60.0), 5.0),  # a robot at 1 m/s stops at once
        (lambda t: 2.0 * t, (20.0, 21.9), 10.0),  # a driver repeats
    ],
)
@pytest.mark.parametrize("noise_m", [0.0, 0.02])
def test_one_at_rest_or_that_repeats_for_a_moment_is_believed(
    way: Way, held_s: tuple[float, float], hz: float, noise_m: float
) -> None:
    assert len(judged(way, held_s, hz, noise_m)) == 0


def scattered(way: Way, held_s: tuple[float, float], hz: float, noise_m: float) -> Array:
    """The times at which a receiver is judged frozen whose one position scatters."""
    t, _, p = said(way, held_s, hz, noise_m)
    held = (t >= held_s[0]) & (t < held_s[1])
    p[held] += noise_m * np.random.default_rng(5).normal(size=(int(held.sum()), 2))
    return t[frozen_fixes(START_NS + np.round(t * S).astype(np.int64), p, p)]


@pytest.mark.parametrize("noise_m", [0.05, 0.15])
@pytest.mark.parametrize(
    ("speed_mps", "held_s", "hz"),
    [(5.0, (20.0, 40.0), 1.0), (2.0, (20.0, 40.0), 10.0), (2.5, (20.0, 26.0), 5.0), (15.0, (20.0, 24.0), 1.0)],
)
def test_a_frozen_position_with_noise_is_detected(
    speed_mps: float, held_s: tuple[float, float], hz: float, noise_m: float
) -> None:
    found = scattered(at(speed_mps), held_s, hz, noise_m)
    assert len(found) >= round((held_s[1] - held_s[0]) * hz) - 2  # it may begin with the last one on the way
    assert found.min() >= held_s[0] - 0.5
    assert found.max() < held_s[1]


@pytest.mark.parametrize("hz", [1.0, 5.0, 10.0])
@pytest.mark.parametrize(
    "way",
    [
        lambda t: rests(2.0, t) + 6.0 * (t > 24.0),  # brakes, and multipath jumps soon after
        lambda t: rests(4.0, t) + 10.0 * (t > 25.0),
        lambda t: rests(4.0, t) + 12.0 * (t > 40.0),  # at rest, and then multipath jumps
        lambda t: rests(0.6, t) + 5.0 * (t > 24.0),  # at the quay, soon after
        lambda t: 2.0 * np.minimum(t, 20.0) + 3.0 * np.maximum(t - 26.0, 0.0),  # sets off again
        lambda t: 2.0 * np.minimum(t, 20.0),
        lambda t: 0.15 * t + 10.0 * (t > 30.0),  # drifts
    ],
)
def test_one_that_scatters_at_rest_is_believed(way: Way, hz: float) -> None:
    for noise_m in (0.02, 0.1, 0.4):
        assert len(scattered(way, (59.0, 59.0 + 1.0 / hz), hz, noise_m)) == 0


def rests(speed_mps: float, t: Array) -> Array:
    """The way of one that brakes for 2 s, and is at rest from 20 s on."""
    return np.asarray(speed_mps * (np.minimum(t, 20.0) - np.clip(t - 18.0, 0.0, 2.0) ** 2 / 4.0))


@pytest.mark.parametrize("hz", [1.0, 10.0])
@pytest.mark.parametrize(
    ("way", "silent_s", "found"),
    [
        (lambda t: rests(2.0, t) + 2.0 * np.maximum(t - 30.0, 0.0), (30.0, 45.0), False),  # it went on meanwhile
        (lambda t: rests(1.0, t) + 3.0 * np.maximum(t - 30.0, 0.0), (30.0, 36.0), False),
        (lambda t: 8.0 * t, (30.0, 32.0), True),  # no craft is as far off by then
        (lambda t: 8.0 * t, (30.0, 55.0), True),  # it stood from one fix to the next
    ],
)
def test_what_comes_after_a_silence_tells_little_of_a_rest(
    way: Way, silent_s: tuple[float, float], found: bool, hz: float
) -> None:
    """A receiver that holds its place at rest, and then says nothing until the vessel is under way."""
    t, lat_lon, p = said(way, (20.0, 30.0), hz, 0.0)
    heard = (t < silent_s[0]) | (t >= silent_s[1])
    bad = frozen_fixes(START_NS + np.round(t[heard] * S).astype(np.int64), lat_lon[heard], p[heard])
    assert bad.any() == found


def test_a_frozen_receiver_is_as_good_as_a_silent_one() -> None:
    """Followed, the track is 26 to 36 m off there; nothing but IMU and compass is beside it."""
    run = simulate_slowly(
        Scenario(path="loops", duration_s=60.0, noise="drift", imu_hz=50.0, gnss_hz=5.0, compass_hz=2.0), 1
    )
    fixes = run.recording.of(GnssPosition)
    begin_ns, end_ns = fixes[0].stamp_ns + 25 * S, fixes[0].stamp_ns + 40 * S
    held = next(m for m in fixes if m.stamp_ns >= begin_ns)

    def heard(m: GnssPosition) -> GnssPosition:
        return replace(m, position=held.position) if begin_ns <= m.stamp_ns < end_ns else m

    left = tuple(
        heard(m) if isinstance(m, GnssPosition) else m for m in run.recording.measurements if not isinstance(m, PoseFix)
    )
    recording = replace(run.recording, measurements=left)
    solution = app.solve(recording, run.config, app.choose_datum(recording, run.config))
    track = solution.trajectory
    off_m = np.linalg.norm((track.p_world_m - run.truth.at(track.stamps_ns).p_world_m)[:, :2], axis=1)
    assert off_m.max() < 3.0
    rows = [r for r in solution.ledger if r.outcome is Outcome.REJECTED and "frozen" in r.reason]
    assert {r.seq for r in rows} == {m.seq for m in fixes if held.stamp_ns < m.stamp_ns < end_ns}
    assert {r.topic for r in rows} == {run.recording.topics["gnss"]}
    (line,) = (w for w in solution.stats.warnings if "frozen" in w)
    assert f"; {len(rows)} fixes rejected" in line


def velocities(hz: float, held_s: tuple[float, float], *, rounded_mps: float = 0.0, moving: bool = True) -> tuple[Array, NDArray[np.int64], Array]:  # fmt: skip
    """Times (N,), stamps (N,) and velocities (N, 3) of a receiver that repeats one for a while: if not moving, 0."""
    t = np.arange(0.0, 60.0, 1.0 / hz)
    v = np.array([2.0, 1.0, 0.0]) + 0.03 * np.random.default_rng(2).normal(size=(len(t), 3))
    if rounded_mps:
        v = np.round(v / rounded_mps) * rounded_mps
    held = (t >= held_s[0]) & (t < held_s[1])
    v[held] = v[np.argmax(held)] * moving
    return t, START_NS + np.round(t * S).astype(np.int64), v


def test_a_line_is_fitted_as_by_least_squares() -> None:
    """Normal equations solved for each axis: slope, residuals, and the slope's sigma for values good to 1."""
    rng = np.random.default_rng(4)
    t, places = rng.uniform(100.0, 130.0, 20), rng.normal(0.0, 5.0, (20, 2))
    A = np.column_stack([np.ones(20), t])
    found = line_fit(t, places)
    assert found.slope == pytest.approx(np.linalg.lstsq(A, places)[0][1])
    assert found.left == pytest.approx(places - A @ np.linalg.lstsq(A, places)[0])
    assert found.sigma == pytest.approx(np.sqrt(np.linalg.inv(A.T @ A)[1, 1]))


@pytest.mark.parametrize("hz", [2.0, 10.0])
def test_a_velocity_that_stays_the_same_for_seconds_is_frozen(hz: float) -> None:
    t, stamps_ns, v = velocities(hz, (20.0, 50.0))
    assert t[frozen_velocities(stamps_ns, v)] == pytest.approx(t[(t > 20.0) & (t < 50.0)])
    online, old = RepeatedVelocityDetector(), []
    for stamp_ns, v_mps in zip(stamps_ns.tolist(), v, strict=True):
        online.note(stamp_ns, v_mps)
        old.append(online.is_old(stamp_ns, v_mps))
    assert t[old] == pytest.approx(t[(t > 20.0 + 3.5 / hz) & (t < 50.0)])  # from the fifth on
    again = [online.is_old(stamp_ns, v_mps) for stamp_ns, v_mps in zip(stamps_ns.tolist(), v, strict=True)]
    assert t[again] == pytest.approx(t[(t > 20.0) & (t < 50.0)])


@pytest.mark.parametrize(
    "said",
    [
        velocities(5.0, (20.0, 22.0)),  # a driver that repeats
        velocities(5.0, (20.0, 50.0), moving=False),
        velocities(5.0, (20.0, 50.0), rounded_mps=0.1),  # as in NMEA: it is often the same
    ],
)
def test_a_velocity_that_may_stay_the_same_is_believed(said: tuple[Array, NDArray[np.int64], Array]) -> None:
    _, stamps_ns, v = said
    assert not frozen_velocities(stamps_ns, v).any()


def test_inspect_reports_a_frozen_receiver(tmp_path: Path) -> None:
    make = Messages(2)
    t, lat_lon, _ = said(at(2.0), (20.0, 40.0), 5.0, 0.1)
    items: list[Item] = [
        ("/fix", START_NS + round(s * S), make.fix(START_NS + round(s * S), lat, lon))
        for s, (lat, lon) in zip(t, lat_lon, strict=True)
    ]
    path = write_bag(tmp_path / "run", make, items, "mcap")
    assert "warning: /fix: for 19.8 s from 2023-11-14T22:13:40" in render(inspect_bag(path))
