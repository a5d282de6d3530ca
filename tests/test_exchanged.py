# SPDX-License-Identifier: Apache-2.0
"""Velocities read in the wrong convention are named before anything is solved."""

import numpy as np
import pytest

from graphloc.config import GnssConfig, VelocityConfig
from graphloc.frames import Array, Datum, Geodetic
from graphloc.frontends._exchanged import exchanged_warnings
from graphloc.frontends._readings import Readings
from graphloc.frontends._run_warnings import _motions_of_fixes
from graphloc.measurements import GnssPosition, GnssVelocity

DATUM = Datum(Geodetic(59.3, 18.1, 20.0))
T_S = np.arange(0.0, 60.0, 0.5)


def circle() -> tuple[Array, Array]:
    """Places (N, 2) and velocities (N, 2) of 5 m/s on a circle of 50 m."""
    a = 0.1 * T_S
    return 50.0 * np.column_stack([np.cos(a), np.sin(a)]), 5.0 * np.column_stack([-np.sin(a), np.cos(a)])


def said(places: Array, velocities: Array, convention: str = "enu") -> list[str]:
    rng = np.random.default_rng(5)
    height = np.zeros((len(T_S), 1))
    lla = DATUM.geodetic_from_enu(np.hstack([places + rng.normal(0.0, 0.3, places.shape), height]))
    ns = (1e9 * T_S).astype(int).tolist()
    fixes = [
        GnssPosition(stamp_ns=t, sensor="gnss", seq=k, position=Geodetic(*at), cov_enu_m2=np.eye(3))
        for k, (t, at) in enumerate(zip(ns, lla, strict=True))
    ]
    velocities = np.hstack([velocities + rng.normal(0.0, 0.1, velocities.shape), height])
    moving = [
        GnssVelocity(stamp_ns=t, sensor="velocity", seq=k, v_enu_mps=v, cov_m2ps2=np.eye(3))
        for k, (t, v) in enumerate(zip(ns, velocities, strict=True))
    ]
    config = VelocityConfig.model_validate({"topic": "/v", "convention": convention})
    readings = [
        Readings("gnss", GnssConfig(topic="/fix"), values=[*fixes]),
        Readings("velocity", config, values=[*moving]),
    ]
    return exchanged_warnings(readings, _motions_of_fixes(readings))


@pytest.mark.parametrize(("convention", "other"), [("enu", "ned"), ("ned", "enu")])
def test_east_and_north_exchanged_are_named_with_the_cure(convention: str, other: str) -> None:
    places, velocities = circle()
    (line,) = said(places, velocities[:, ::-1], convention)
    assert line.startswith("velocity: its velocities differ from the motion of gnss by ")
    assert line.endswith(f"set convention: {other}")


def test_right_ones_late_ones_and_those_of_a_craft_at_rest_are_not() -> None:
    places, velocities = circle()
    assert said(places, velocities) == []
    assert said(places, np.roll(velocities, 4, axis=0)) == []
    assert said(0.0 * places, 0.0 * velocities) == []


def test_straight_to_the_north_east_both_fit() -> None:
    straight = np.column_stack([3.0 * T_S, 3.0 * T_S])
    assert said(straight, np.full((len(T_S), 2), 3.0)) == []
