# SPDX-License-Identifier: Apache-2.0
"""How fast the error of fixes changes, by wheels: what `inspect` says of it, and drafts."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from graphloc.config import BodyVelocityConfig, GnssConfig
from graphloc.frames import Array
from graphloc.frontends._assess import MeasuredMotion
from graphloc.frontends._assess_wander import WANDER_S, wander_m, way_of
from graphloc.frontends._streams import TopicData
from graphloc.frontends.decode import ODOMETRY
from graphloc.time import NS_PER_S
from tests.bagfactory import Messages
from tests.test_inspect import DATUM, drive, look

SIGMA_M, TIME_CONSTANT_S = 2.0, 20.0
CHANGE_M = float(np.sqrt(2.0 * SIGMA_M**2 * (1.0 - np.exp(-WANDER_S / TIME_CONSTANT_S))))


def wandering(t_s: Array, seed: int, sigma: float = SIGMA_M) -> Array:
    """Return a Gauss-Markov error (N, 2) at evenly spaced times."""
    rng = np.random.default_rng(seed)
    kept = np.exp(-(t_s[1] - t_s[0]) / TIME_CONSTANT_S)
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
    found = wander_m(wheels, *fixes(t, way(t, 1.0) + wandering(t, 3) + noise), 0.3)
    assert found == pytest.approx(CHANGE_M, rel=0.2)
    assert wander_m(wheels, *fixes(t, way(t, 1.0) + noise), 0.3) == pytest.approx(0.0, abs=0.15)


def test_wheels_that_tell_nothing() -> None:
    """At rest, seen for too short, not there, or slipping by as much as the fixes err: 20 m/s with a scale that changes by 3 %."""
    t = np.arange(0.0, 600.0, 0.5)
    error = wandering(t, 3)
    assert wander_m(odometry(t, 0.0 * way(t, 1.0)), *fixes(t, error), 0.0) is None
    short = t < 90.0
    assert wander_m(odometry(t[short], way(t[short], 1.0)), *fixes(t, way(t, 1.0) + error), 0.0) is None
    assert way_of(TopicData("/odom", ODOMETRY)) is None
    assert wander_m(odometry(t, way(t, 1.0)), *fixes(t[:0], error[:0]), 0.0) is None
    slip = np.cumsum(20.0 * 0.5 * (1.0 + wandering(t, 5, 0.02)[:, 0]))
    straight = np.column_stack([slip, np.zeros(len(t))])
    assert wander_m(odometry(t, straight), *fixes(t, np.column_stack([20.0 * t, 0.0 * t])), 0.0) is None


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
            m.pose.pose.position.x, m.pose.pose.position.y = (
                float(np.interp(stamp, stamps, enu[:, axis])) for axis in (1, 0)
            )
    found, config, text = look(tmp_path, items, make)
    receiver, wheels = config.sensors["gnss"], config.sensors["wheels"]
    assert isinstance(receiver, GnssConfig)
    assert isinstance(wheels, BodyVelocityConfig)
    assert wheels.axes == ("x", "y")
    assert not wheels.enabled
    drafted = receiver.slow_error
    assert found.gnss[0].wander_m == pytest.approx(CHANGE_M * sigma / SIGMA_M, rel=0.4)
    assert "by the wheels it changes by" in text
    change = np.sqrt(2.0 * drafted.horizontal_sigma_m**2 * (1.0 - np.exp(-WANDER_S / drafted.time_constant_s)))
    assert change == pytest.approx(found.gnss[0].wander_m, rel=0.05)
    assert (drafted.horizontal_sigma_m > 2.0) == (sigma == 5.0)


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
    assert (receiver.slow_error.time_constant_s < 20.0) == seen
    assert (receiver.slow_error.horizontal_sigma_m > 3.0) == seen
    assert ("by /fix_velocity it changes by" in text) == seen
