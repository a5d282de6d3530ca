# SPDX-License-Identifier: Apache-2.0
"""How fast the error of fixes changes, by wheels: what `inspect` says of it, and drafts."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.config import BodyVelocityConfig, GnssConfig
from graphloc.frames import Array
from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends._assess_wander import SPANS_S, changes, slow_error_by, way_of
from graphloc.frontends._reports import Change
from graphloc.frontends._topic_data import TopicData
from graphloc.frontends.msgtypes import ODOMETRY
from graphloc.time import NS_PER_S
from tests.bagfactory import Messages
from tests.test_inspect import DATUM, drive, look

SIGMA_M, TIME_CONSTANT_S = 2.0, 20.0


def change_m(span_s: float, sigma: float = SIGMA_M, time_constant_s: float = TIME_CONSTANT_S) -> float:
    """Return by how much a Gauss-Markov error changes within a span, 1 sigma."""
    return float(np.sqrt(2.0 * sigma**2 * (1.0 - np.exp(-span_s / time_constant_s))))


def wandering(t_s: Array, seed: int, sigma: float = SIGMA_M, time_constant_s: float = TIME_CONSTANT_S) -> Array:
    """Return a Gauss-Markov error (N, 2) at evenly spaced times."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-(t_s[1] - t_s[0]) / time_constant_s)
    error = rng.normal(0.0, sigma, (1, 2))
    for push in rng.normal(0.0, sigma * np.sqrt(1.0 - kept**2), (len(t_s) - 1, 2)):
        error = np.vstack([error, kept * error[-1] + push])
    return error


def way(t_s: Array, speed: float, rate: float = 0.03) -> Array:
    """Return places (N, 2) on a circle."""
    return speed / rate * np.column_stack([np.sin(rate * t_s), 1.0 - np.cos(rate * t_s)])


def odometry(t_s: Array, places: Array) -> MeasuredMotion:
    found = TopicData("/odom", ODOMETRY)
    for t, (x, y) in zip(t_s, places, strict=True):
        stamp = int(t * NS_PER_S)
        found.add(stamp, stamp, (x, y, *np.zeros(8)), "a")
    motion = way_of(found)
    assert motion is not None
    return motion


def fixes(t_s: Array, places: Array) -> tuple[NDArray[np.int64], Array]:
    return np.asarray(t_s * NS_PER_S, dtype=np.int64), np.column_stack([places, np.zeros(len(places))])


def test_the_change_of_the_error_by_hand() -> None:
    """Wheels in a frame of their own, turned by 70 deg, that read 4 % too much; fixes that scatter by 0.3 m beside their slow error."""
    t = np.arange(0.0, 1500.0, 0.5)
    c, s = np.cos(1.2), np.sin(1.2)
    wheels = odometry(t, 1.04 * way(t, 1.0) @ np.array([[c, s], [-s, c]]))
    noise = 0.3 * np.random.default_rng(1).normal(size=(len(t), 2))
    found = changes(wheels, *fixes(t, way(t, 1.0) + wandering(t, 3) + noise), 0.3, turned=True)
    assert [change.span_s for change in found] == list(SPANS_S)
    assert [change.m for change in found] == pytest.approx([change_m(span_s) for span_s in SPANS_S], rel=0.25)
    right = changes(wheels, *fixes(t, way(t, 1.0) + noise), 0.3, turned=True)
    assert [change.m for change in right] == pytest.approx([0.0] * len(right), abs=0.15)


def test_a_steady_drift_of_the_heading_of_wheels_is_no_error_of_the_fixes() -> None:
    """By 0.23 deg/s, on a way with turns: of a car, a slow error of 12 m was drafted for one of 1.5 m, and no pose was ever good."""
    t = np.arange(0.0, 900.0, 0.5)
    course = 1.2 * np.sin(0.05 * t) + 0.9 * np.sin(0.021 * t + 1.0)
    places, seen = (
        np.cumsum(1.0 * np.column_stack([np.cos(a), np.sin(a)]), axis=0) for a in (course, course + 0.004 * t)
    )
    found = changes(odometry(t, seen), *fixes(t, places + wandering(t, 3)), 0.0, turned=True)
    assert [change.m for change in found] == pytest.approx([change_m(span_s) for span_s in SPANS_S], rel=0.3)


def test_a_velocity_tells_both_axes() -> None:
    """Straight on, an error across the way changes no chord's length, and a velocity to the east and north shows it."""
    t = np.arange(0.0, 600.0, 1.0)
    east = np.column_stack([5.0 * t, 0.0 * t])
    across = wandering(t, 3, 4.0, 60.0) * [0.0, 2.0**0.5]
    motion = replace(odometry(t, east), source="/vel")
    found = changes(motion, *fixes(t, east + across), 0.0, turned=False)
    assert found[0].seen == pytest.approx(2.0 * 60.0, rel=0.1)
    assert found[2].m > 1.5
    assert all(change.m < 0.5 for change in changes(motion, *fixes(t, east + across), 0.0, turned=True))


@pytest.mark.parametrize(("sigma", "time_constant_s"), [(8.0, 60.0), (4.0, 100.0), (12.0, 30.0), (3.0, 15.0)])
def test_a_large_error_that_changes_slowly_is_no_small_fast_one(sigma: float, time_constant_s: float) -> None:
    """Of ten seconds alone it was drafted as 4 m and 10 s, and two minutes of fixes counted as thirteen such errors (8 m, 60 s)."""
    found = []
    t = np.arange(0.0, 130.0, 1.0)
    motion = odometry(t, way(t, 8.0))
    for seed in range(10):
        seen = changes(motion, *fixes(t, way(t, 8.0) + wandering(t, seed, sigma, time_constant_s)), 0.1, turned=False)
        told = slow_error_by(seen, 2.0)
        assert told is not None
        found.append(told)
    # The mean of an error over a run is what no smoothing takes away.
    means = [
        size * np.sqrt(2.0 * last / 130.0 * (1.0 - last / 130.0 * -np.expm1(-130.0 / last))) for size, last in found
    ]
    last = time_constant_s
    true = sigma * np.sqrt(2.0 * last / 130.0 * (1.0 - last / 130.0 * -np.expm1(-130.0 / last)))
    assert 0.6 * true < np.median(means) < 2.0 * true * np.sqrt(max(1.0, 40.0 / last))


def test_what_changes_as_by_default_is_left_at_that() -> None:
    """2 m, 200 s; or what the fixes claim, 5 m; and less than either."""
    as_usual = [Change(span_s, change_m(span_s, 2.0, 200.0), 200.0 / span_s) for span_s in SPANS_S]
    assert slow_error_by((), 2.0) is None
    assert slow_error_by(as_usual, 2.0) is None
    assert slow_error_by([Change(c.span_s, 2.5 * c.m, c.seen) for c in as_usual], 5.0) is None
    small = slow_error_by([Change(span_s, change_m(span_s, 1.0, 5.0), 1e5) for span_s in SPANS_S], 2.0)
    assert small is not None
    assert small[0] == 2.0  # what does not change shows in no change
    far = slow_error_by([Change(c.span_s, 4.0 * c.m, 100.0 * c.seen) for c in as_usual], 2.0)
    assert far == pytest.approx((8.0, 200.0), rel=0.25)


def test_wheels_that_tell_nothing() -> None:
    """At rest, seen for too short, not there, or slipping by as much as the fixes err: 20 m/s with a scale that changes by 3 %."""
    t = np.arange(0.0, 600.0, 0.5)
    error = wandering(t, 3)
    assert not changes(odometry(t, 0.0 * way(t, 1.0)), *fixes(t, error), 0.0, turned=True)
    short = t < 90.0
    assert not changes(odometry(t[short], way(t[short], 1.0)), *fixes(t, way(t, 1.0) + error), 0.0, turned=True)
    assert way_of(TopicData("/odom", ODOMETRY)) is None
    assert not changes(odometry(t, way(t, 1.0)), *fixes(t[:0], error[:0]), 0.0, turned=True)
    slip = np.cumsum(20.0 * 0.5 * (1.0 + wandering(t, 5, 0.02)[:, 0]))
    straight = np.column_stack([slip, np.zeros(len(t))])
    assert not changes(odometry(t, straight), *fixes(t, np.column_stack([20.0 * t, 0.0 * t])), 0.0, turned=True)


@pytest.mark.parametrize("sigma", [SIGMA_M, 5.0])
def test_fixes_that_wander_are_drafted_as_fast_as_they_do(sigma: float, tmp_path: Path) -> None:
    """And as large, where they wander farther than a slow error is by default; and wheels as what does not slip sideways."""
    make = Messages(2)
    items = drive(make, status=1, sigma_m=0.8, seconds=220)
    told = [(stamp, m) for topic, stamp, m in items if topic == "/fix"]
    stamps = np.array([stamp for stamp, _ in told])
    enu = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for _, m in told]).T)
    error = wandering((stamps - stamps[0]) / NS_PER_S, 7, sigma)
    away = DATUM.geodetic_from_enu(enu + np.column_stack([error, np.zeros(len(error))]))
    for (_, m), (lat, lon, _) in zip(told, away, strict=True):
        m.latitude, m.longitude = float(lat), float(lon)
    for topic, stamp, m in items:
        if topic == "/wheel/odom":
            # In a frame of its own: one that is that of the fixes, east or north ahead, is a filter's.
            east, north = (float(np.interp(stamp, stamps, enu[:, axis])) for axis in (0, 1))
            m.pose.pose.position.x, m.pose.pose.position.y = 0.8 * east - 0.6 * north, 0.6 * east + 0.8 * north
    found, config, text = look(tmp_path, items, make)
    receiver, wheels = config.sensors["gnss"], config.sensors["wheels"]
    assert isinstance(receiver, GnssConfig)
    assert isinstance(wheels, BodyVelocityConfig)
    assert wheels.axes == ("x", "y")
    assert not wheels.enabled
    drafted = receiver.slow_error
    assert found.gnss[0].wander[0].m == pytest.approx(change_m(10.0, sigma), rel=0.4)
    assert "by the wheels it changes by" in text
    drafted_m = change_m(10.0, drafted.horizontal_sigma_m, drafted.time_constant_s)
    assert drafted_m == pytest.approx(found.gnss[0].wander[0].m, rel=0.3)
    assert (drafted.horizontal_sigma_m > 4.0) == (sigma == 5.0)


@pytest.mark.parametrize(("sigma", "late_s", "filtered"), [(5.0, 0.5, False), (0.1, 0.5, False), (5.0, 0.0, True)])
def test_a_velocity_shows_it_as_well(sigma: float, late_s: float, filtered: bool, tmp_path: Path) -> None:
    """Without wheels a receiver among houses had a slow error of 2 m, whatever its velocity said; braking is none, however late it is said."""
    make, rng = Messages(2), np.random.default_rng(2)
    items = [item for item in drive(make, status=1, sigma_m=0.8, seconds=130) if item[0] != "/wheel/odom"]
    stamps = np.array([stamp for topic, stamp, _ in items if topic == "/fix"])
    told = [m for topic, _, m in items if topic == "/fix"]
    enu = DATUM.enu_from_geodetic(*np.array([(m.latitude, m.longitude, m.altitude) for m in told]).T)
    t = (stamps - stamps[0]) / NS_PER_S
    away = DATUM.geodetic_from_enu(enu + np.column_stack([wandering(t, 7, sigma), np.zeros(len(t))]))
    for m, (lat, lon, _) in zip(told, away, strict=True):
        m.latitude, m.longitude = float(lat), float(lon)
    speeds = np.gradient(enu, t, axis=0) + 0.1 * rng.normal(size=enu.shape)
    topic = "/ekf/velocity" if filtered else "/fix_velocity"
    items += [
        (topic, at, make.twist(at, v))
        for at, v in zip((stamps + round(late_s * NS_PER_S)).tolist(), speeds, strict=True)
    ]
    _, config, text = look(tmp_path, sorted(items, key=lambda item: item[1]), make)
    receiver = config.sensors["gnss"]
    assert isinstance(receiver, GnssConfig)
    seen = sigma > 1.0 and not filtered
    assert (receiver.slow_error.time_constant_s < 100.0) == seen
    assert (receiver.slow_error.horizontal_sigma_m > 3.0) == seen
    assert ("by /fix_velocity it changes by" in text) == seen
